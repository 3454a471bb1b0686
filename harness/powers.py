"""The power of a detection: from which magnitude on an observer finds what there is to find, and how sure that is."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from scipy.stats import binomtest

from fmus.units import parse_unit
from harness.axes import covered, magnitudes, numbers
from harness.criteria import Judged
from harness.record import COMPLETE
from harness.reportaxes import Power

# A metric this near to what counts as found counts, and one this far outside of [0, 1] is a share still.
ROUNDING = 1e-9


class Share(NamedTuple):
    """Of the cases of one magnitude how many were found, and the Clopper-Pearson interval of the share."""

    magnitude: float
    hits: int
    cases: int
    failed: int
    lower: float
    upper: float

    @property
    def share(self) -> float:
        """The share of the cases that were found."""
        return self.hits / self.cases


def clopper_pearson(hits: int, cases: int, confidence: float) -> tuple[float, float]:
    """The interval of a share of which `hits` of `cases` were seen (Clopper & Pearson 1934); covers that often or more.

    Its ends are the probabilities with which so many hits or more, or so many or fewer, have (1 - confidence)/2.
    """
    found = binomtest(hits, cases).proportion_ci(confidence, method="exact")
    return float(found.low), float(found.high)


def smallest_found(shares: Sequence[Share], wanted: float) -> Share | None:
    """The least magnitude above zero from which on the share is at least `wanted`, at all larger ones too, or None."""
    found = None
    for one in sorted(shares, key=lambda one: -one.magnitude):
        if one.magnitude <= 0.0 or one.share < wanted - ROUNDING:
            break
        found = one
    return found


def powers_content(
    powers: Sequence[Power], cases: Sequence[Judged], observers: Sequence[Sequence[str]]
) -> list[dict[str, Any]]:
    """What powers.json holds: of each observer, at each value of the axis, the smallest magnitude found and all shares.

    A failed case, and one in which the metric has no value, count as not found; one in which it is not measured does
    not count. Where a metric is no share from 0 to 1, `problem` says so, and nothing is told of that observer.
    """
    return [_power(power, cases, names) for power, names in zip(powers, observers, strict=True)]


def _power(power: Power, cases: Sequence[Judged], observers: Sequence[str]) -> dict[str, Any]:
    counted = covered(power, cases)
    against, size = numbers(power.against, counted), magnitudes(power.magnitudes, counted)
    grid: dict[float, dict[float, list[Judged]]] = {}
    for case, at, magnitude in zip(counted, against.values, size.values, strict=True):
        grid.setdefault(at, {}).setdefault(magnitude, []).append(case)
    lines = []
    for observer in observers:
        metric = power.metric_of(observer)
        problem = _no_share(metric, counted)
        points = [] if problem else [_point(power, metric, at, found) for at, found in sorted(grid.items())]
        lines.append({"observer": observer, "problem": problem, "points": points})
    return {
        "title": power.title,
        "metric": power.metric,
        "magnitude": power.magnitudes,
        "magnitude_unit": size.unit,
        "against": power.against,
        "against_unit": against.unit,
        "hit": power.hit,
        "share": power.share.si("1"),
        "confidence": power.confidence.si("1"),
        "experiments": power.experiments,
        "cases": len(counted),
        "failed": sum(case.outcome not in COMPLETE for case in counted),
        "note": power.note,
        "lines": lines,
    }


def _point(power: Power, metric: str, at: float, found: Mapping[float, Sequence[Judged]]) -> dict[str, Any]:
    shares = [_share(power, metric, size, cases) for size, cases in sorted(found.items())]
    told = [share for share in shares if share is not None]
    smallest = smallest_found(told, power.share.si("1"))
    return {
        "at": at,
        "smallest": None if smallest is None else smallest.magnitude,
        "shares": [{**share._asdict(), "share": share.share} for share in told],
    }


def _share(power: Power, metric: str, magnitude: float, cases: Sequence[Judged]) -> Share | None:
    """How many of the cases of one magnitude were found; None where the metric is measured in none."""
    failed = [case for case in cases if case.outcome not in COMPLETE]
    measured = [case for case in cases if case.outcome in COMPLETE and metric in case.metrics]
    count = len(failed) + len(measured)
    if not count:
        return None
    hits = sum(_value(metric, case) >= power.hit - ROUNDING for case in measured)
    return Share(magnitude, hits, count, len(failed), *clopper_pearson(hits, count, power.confidence.si("1")))


def _value(metric: str, case: Judged) -> float:
    """The metric as a plain number, whatever unit it is shown in."""
    value, unit = case.metrics[metric]
    return parse_unit(unit).to_si(value)


def _no_share(metric: str, cases: Sequence[Judged]) -> str:
    """What is wrong with a metric that is no share; empty where nothing is."""
    for case in cases:
        if metric in case.metrics:
            value = _value(metric, case)
            if not (math.isnan(value) or -ROUNDING <= value <= 1.0 + ROUNDING):
                return f"{metric} wants a share from 0 to 1, got {value:.6g} in {case.label}"
    return ""
