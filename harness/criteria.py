"""Acceptance: what a campaign demands of its metrics, read from text and judged over its cases."""

from __future__ import annotations

import math
import operator
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fmus.units import UnitError, parse_unit
from harness.arguments import Result
from harness.definitions import Value
from harness.percentile import percentile
from harness.record import COMPLETE
from harness.validation import nearest_hint

Vector = NDArray[np.float64]

COMPARISONS: Mapping[str, Callable[[float, float], bool]] = {
    "<=": operator.le,
    ">=": operator.ge,
    "==": operator.eq,
    "!=": operator.ne,
    "<": operator.lt,
    ">": operator.gt,
}
# Over the cases, or over the samples of all cases pooled. `worst` and `best` depend on the comparison.
AGGREGATES: Mapping[str, Callable[[Vector], float]] = {
    "median": lambda values: float(np.median(values)),
    "mean": lambda values: float(np.mean(values)),
    "p95": lambda values: percentile(values, 95.0),
    "p5": lambda values: percentile(values, 5.0),
    "min": lambda values: float(np.min(values)),
    "max": lambda values: float(np.max(values)),
}
EXTREMES = ("worst", "best")
_COMPARISON = re.compile(r"<=|>=|==|!=|<|>|=")
_NUMBER = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?")
_NAME = re.compile(r"[A-Za-z_]\w*(?:\.[A-Za-z_]\w*)*$")
_CALL = re.compile(r"([A-Za-z_]\w*)\s*\((.*)\)$")


class CriterionError(ValueError):
    """A criterion that cannot be read; `offset` counts characters from the start of its text."""

    def __init__(self, message: str, offset: int = 0) -> None:
        self.offset = offset
        super().__init__(message)


class Side(NamedTuple):
    """`factor` times a metric (over the cases by `aggregate`, case by case where empty), or a number with its unit."""

    factor: float
    metric: str = ""
    aggregate: str = ""
    unit: str = ""
    absolute: bool = False


@dataclass(frozen=True)
class Criterion:
    """`left` compared with `right`; `experiment` as written, `covered` the experiments it is judged over."""

    text: str
    left: Side
    comparison: str
    right: Side
    experiment: str = ""
    covered: tuple[str, ...] = ("",)


@dataclass(frozen=True)
class Judged:
    """What acceptance and the report need of one case."""

    key: str
    label: str
    experiment: str
    outcome: str
    metrics: Mapping[str, Value] = field(default_factory=dict)
    samples: Mapping[str, Sequence[float]] = field(default_factory=dict)
    values: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Verdict:
    """One criterion and what came; `case` is the key of the case that decides, `reason` says why it failed."""

    text: str
    experiment: str
    value: float
    bound: float
    unit: str
    passed: bool
    case: str = ""
    reason: str = ""


def parse_criterion(text: str, known: Mapping[str, tuple[str, Result]]) -> Criterion:
    """The criterion written as `metric < 20 ms`, `p95(metric) < 20 ms`, or `metric < 0.5 * other_metric`.

    `known` are the values that the metrics give. Raises CriterionError: it is none of these, or names no known metric.
    """
    found = list(_COMPARISON.finditer(text))
    if len(found) != 1 or found[0][0] == "=":
        offset = found[0].start() if found else 0
        wanted = f"one of {' '.join(COMPARISONS)} between a metric and a bound"
        raise CriterionError(
            f"'{text}' wants {wanted}, got {' and '.join(match[0] for match in found) or 'none'}", offset
        )
    match = found[0]
    left = _side(text[: match.start()], 0, known)
    right = _side(text[match.end() :], match.end(), known)
    comparison = match[0]
    if not left.metric:
        flipped = {"<": ">", ">": "<", "<=": ">=", ">=": "<="}
        left, right, comparison = right, left, flipped.get(comparison, comparison)
    if not left.metric:
        raise CriterionError(f"'{text}' wants a metric on one side, got numbers on both")
    if right.metric and bool(left.aggregate) != bool(right.aggregate):
        raise CriterionError(f"'{text}' wants an aggregate like p95(...) on both sides or on none", match.end())
    return Criterion(text, left, comparison, right)


def _side(text: str, offset: int, known: Mapping[str, tuple[str, Result]]) -> Side:
    offset += len(text) - len(text.lstrip())
    text = text.strip()
    number = _NUMBER.match(text)
    if not number:
        return _reference(text, offset, 1.0, known)
    rest = text[number.end() :]
    if rest.lstrip().startswith("*"):
        name = rest.lstrip()[1:]
        return _reference(name.strip(), offset + len(text) - len(name.lstrip()), float(number[0]), known)
    try:
        parse_unit(rest)
    except UnitError as error:
        hint = f"; write '{number[0]} * {rest.strip()}' for a multiple of it" if rest.strip() in known else ""
        raise CriterionError(f"{error}{hint}", offset + number.end()) from None
    return Side(float(number[0]), unit=rest.strip())


def _reference(text: str, offset: int, factor: float, known: Mapping[str, tuple[str, Result]]) -> Side:
    call = _CALL.match(text)
    aggregate, name = (call[1], call[2].strip()) if call else ("", text)
    names = [*AGGREGATES, *EXTREMES]
    if call and aggregate not in names:
        raise CriterionError(f"no aggregate is named '{aggregate}'{nearest_hint(aggregate, names)}", offset)
    if not _NAME.match(name):
        raise CriterionError(f"wants a metric or a number with a unit, got '{text}'", offset)
    if name not in known:
        raise CriterionError(f"no metric is named '{name}'{nearest_hint(name, known)}", offset)
    if known[name][1].sampled and (not aggregate or aggregate in EXTREMES):
        raise CriterionError(f"'{name}' holds many samples a case: wants an aggregate like p95({name})", offset)
    return Side(factor, name, aggregate, absolute=known[name][1].of == "signal")


def bound_misfit(criterion: Criterion, units: Mapping[str, str]) -> str:
    """What is wrong between the units of the two sides, given those of the metrics; empty where nothing is."""
    wanted = units[criterion.left.metric]
    got = units[criterion.right.metric] if criterion.right.metric else criterion.right.unit
    if (not got and not criterion.right.metric) or parse_unit(got).same_dimension(parse_unit(wanted)):
        return ""
    return f"'{criterion.text}': {criterion.left.metric} is in {wanted}, the bound in {got or '1'}"


def judge(criterion: Criterion, cases: Sequence[Judged], units: Mapping[str, str]) -> Verdict:
    """The verdict over the cases it covers; a failed case, a missing metric or a value not finite fails it.

    `units` are those of the metrics' values. A bound without unit is in the metric's. Without an aggregate each case is
    compared and the worst one is shown.
    """
    unit = criterion.right.unit or units[criterion.left.metric]
    covered = [case for case in cases if case.experiment in criterion.covered]
    if criterion.left.aggregate in ("", *EXTREMES):
        verdict = _case_by_case(criterion, covered, units, unit)
    else:
        value = _over_cases(criterion.left, covered, units, unit, criterion.comparison)
        bound = _over_cases(criterion.right, covered, units, unit, criterion.comparison)
        verdict = _verdict(criterion, value, bound, unit, "")
    failed = next((case for case in covered if case.outcome not in COMPLETE), None)
    if failed is not None:
        reason = f"{failed.label} ended with {failed.outcome or 'no outcome'}"
        return Verdict(verdict.text, verdict.experiment, verdict.value, verdict.bound, unit, False, failed.key, reason)
    if not covered:
        return Verdict(criterion.text, criterion.experiment, math.nan, verdict.bound, unit, False, "", "covers no case")
    return verdict


def _case_by_case(criterion: Criterion, cases: Sequence[Judged], units: Mapping[str, str], unit: str) -> Verdict:
    values = [_in_case(criterion.left, case, unit) for case in cases]
    if criterion.right.aggregate or not criterion.right.metric:
        bounds = [_over_cases(criterion.right, cases, units, unit, criterion.comparison)] * len(cases)
    else:
        bounds = [_in_case(criterion.right, case, unit) for case in cases]
    if not cases:
        return _verdict(criterion, math.nan, math.nan, unit, "")
    margins = [_margin(criterion.comparison, value, bound) for value, bound in zip(values, bounds, strict=True)]
    ranked = sorted(range(len(cases)), key=lambda index: margins[index])
    decisive = ranked[-1] if criterion.left.aggregate == "best" else ranked[0]
    case = cases[decisive]
    return _verdict(criterion, values[decisive], bounds[decisive], unit, case.key, case.label)


def _margin(comparison: str, value: float, bound: float) -> float:
    """How far a value is on the right side of its bound; -inf where one is not finite."""
    if not (math.isfinite(value) and math.isfinite(bound)):
        return -math.inf
    if comparison.startswith("<"):
        return bound - value
    if comparison.startswith(">"):
        return value - bound
    return abs(value - bound) * (-1.0 if comparison == "==" else 1.0)


def _in_case(side: Side, case: Judged, unit: str) -> float:
    if not side.metric:
        return side.factor
    if side.metric not in case.metrics:
        return math.nan
    value = case.metrics[side.metric]
    return side.factor * _converted(value.value, value.unit, unit, side)


def _converted(value: float, unit: str, wanted: str, side: Side) -> float:
    """`value` in another unit; a difference keeps clear of the units' offsets."""
    if unit == wanted:
        return value
    source, target = parse_unit(unit), parse_unit(wanted)
    return target.from_si(source.to_si(value)) if side.absolute else value * (source.factor / target.factor)


def _over_cases(side: Side, cases: Sequence[Judged], units: Mapping[str, str], unit: str, comparison: str) -> float:
    """A side over all cases; on the right of a `<` the worst bound is the smallest."""
    if not side.metric:
        return side.factor
    pooled: list[float] = []
    for case in cases:
        if side.metric in case.samples:
            pooled += [_converted(one, units[side.metric], unit, side) for one in case.samples[side.metric]]
        else:
            pooled.append(_in_case(side._replace(factor=1.0), case, unit))
    values = np.array(pooled)
    if not len(values) or np.isnan(values).any():
        return math.nan
    smallest = (side.aggregate == "worst") == comparison.startswith("<")
    aggregate = ("min" if smallest else "max") if side.aggregate in EXTREMES else side.aggregate
    return side.factor * AGGREGATES[aggregate](values)


def _verdict(criterion: Criterion, value: float, bound: float, unit: str, key: str, label: str = "") -> Verdict:
    passed = math.isfinite(value) and math.isfinite(bound) and COMPARISONS[criterion.comparison](value, bound)
    where = f" in {label}" if label else ""
    reason = ""
    if not math.isfinite(value):
        reason = f"{criterion.left.metric} has no finite value{where}"
    elif not passed:
        reason = f"{value:.6g} {unit} is not {criterion.comparison} {bound:.6g} {unit}{where}"
    return Verdict(criterion.text, criterion.experiment, value, bound, unit, passed, key, reason)
