"""How the observers stand: which metrics compare, and each one's median, p95 and worst, failures counted."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from reports.definitions import definitions
from reports.folder import Case, Run

# Kinds of metric, and parts of a metric with several values, of which more is better, and of which less is. Of others
# a criterion with > and a number says that more is better.
BETTER_WHEN_HIGHER = ("accuracy", "share_within", "convergence_rate", "confusion", "true_positive_rate")
BETTER_WHEN_LOWER = (
    "rmse",
    "max_error",
    "bias",
    "nrmse",
    "settling",
    "crank_error",
    "harmonic_error",
    "delay_median",
    "delay_p95",
    "missed",
    "false_alarms",
    "false_alarms_per_min",
    "false_alarms_per_hour",
    "false_alarms_per_cycle",
    "false_positive_rate",
)
# Kinds, and parts of a metric, of which neither more nor less is better.
UNRANKED = ("nees", "changes", "faults", "cycles", "dropped")
# Kinds and parts that have a sign, and are the better the nearer to zero they are.
NEAR_ZERO = (("bias", ""), ("harmonic_error", "amplitude"), ("harmonic_error", "phase"))
# Kinds that are written in capitals.
ACRONYMS = ("rmse", "nrmse", "nees", "nis")


@dataclass(frozen=True)
class Quantity:
    """One thing several observers are measured by: `metrics` maps the observer to its metric."""

    label: str
    unit: str
    higher_is_better: bool
    metrics: Mapping[str, str]


@dataclass(frozen=True)
class Standing:
    """One metric over many cases, in the metric's unit; `p95`: 95 % of the cases are at least this good.

    A failed case counts as infinitely bad, a case to which the metric does not apply is not counted.
    """

    observer: str
    metric: str
    measured: int
    failed: int
    median: float
    p95: float
    worst: float
    worst_case: str


def observers(run: Run) -> dict[str, str]:
    """Titles of the observers by part: as the report section names them, else the parts compared with a truth."""
    declared = (run.campaign.get("report") or {}).get("observers") or {}
    if declared:
        return {name: str((entry or {}).get("title") or _title(name)) for name, entry in declared.items()}
    parts = dict.fromkeys(definition.part for definition in definitions(run).values() if definition.part)
    return {part: _title(part) for part in parts}


def quantities(run: Run) -> list[Quantity]:
    """What the observers are measured by: metrics of one kind, truth, window, setting and unit are one quantity.

    One of which neither more nor less is better is a quantity of its own.
    """
    known = definitions(run)
    grouped: dict[tuple[Any, ...], dict[str, str]] = {}
    labels: dict[tuple[Any, ...], str] = {}
    for metric in run.metric_names():
        base, _, part = metric.partition(".")
        definition = known.get(metric) or known.get(base)
        observer = observer_of(run, metric)
        unranked = definition is None or {definition.kind, part} & set(UNRANKED)
        if definition is None or unranked or not definition.pairs or not observer:
            key: tuple[Any, ...] = (metric,)
            label = metric
        else:
            truths = tuple(dict.fromkeys(truth for truth, _ in definition.pairs))
            key = (
                definition.kind,
                truths,
                definition.window,
                definition.settings,
                part,
                unit_of(run, metric),
            )
            label = f"{_readable(definition.kind)} of {', '.join(truths)}"
            label += f" ({definition.settings})" if definition.settings else ""
            label += f": {part.replace('_', ' ')}" if part else ""
            label += ", magnitude" if (definition.kind, part) in NEAR_ZERO else ""
        if observer in grouped.get(key, {}):
            key, label = (metric,), metric
        grouped.setdefault(key, {})[observer] = metric
        labels.setdefault(key, label)
    return [
        Quantity(
            labels[key],
            unit_of(run, next(iter(metrics.values()))),
            _higher_is_better(run, metrics.values()),
            metrics,
        )
        for key, metrics in grouped.items()
    ]


def observer_of(run: Run, metric: str) -> str:
    """The observer a metric belongs to: as the report section lists it, else the part of the metric's last signal."""
    base = metric.partition(".")[0]
    for name, entry in ((run.campaign.get("report") or {}).get("observers") or {}).items():
        if {metric, base} & set((entry or {}).get("metrics") or ()):
            return str(name)
    definition = definitions(run).get(base)
    return definition.part if definition and definition.part in observers(run) else ""


def foremost(run: Run, quantity: Quantity) -> bool:
    """Whether the report section lists one of its metrics as an observer's own; true of all where it lists none.

    `found` lists all values of that metric, `found.delay_median` that one.
    """
    declared = ((run.campaign.get("report") or {}).get("observers") or {}).values()
    listed = {metric for entry in declared for metric in (entry or {}).get("metrics") or ()}
    return not listed or any({metric, metric.partition(".")[0]} & listed for metric in quantity.metrics.values())


def unit_of(run: Run, metric: str) -> str:
    """The unit the metric's values are in; samples named `located.delay` are in that of `located.delay_median`."""
    units = (
        case.metrics[name].unit for case in run.cases for name in (metric, f"{metric}_median") if name in case.metrics
    )
    return next(units, "1")


def standing(
    run: Run,
    metric: str,
    observer: str,
    higher_is_better: bool,
    cases: Sequence[Case] | None = None,
) -> Standing:
    """Median, p95 and worst of a metric over `cases`, all where None; of its magnitude where it is to be near zero."""
    base, _, part = metric.partition(".")
    definition = definitions(run).get(base)
    near_zero = definition is not None and (definition.kind, part) in NEAR_ZERO
    sign = -1.0 if higher_is_better else 1.0
    values, failed = [], []
    for case in run.cases if cases is None else cases:
        value = case.metrics[metric].value if metric in case.metrics else math.nan
        if not math.isnan(value):
            values.append((abs(value) if near_zero else sign * value, case.label))
        elif not case.complete:
            failed.append((math.inf, case.label))
    ranked = sorted(values + failed, key=lambda pair: pair[0])
    costs = np.array([cost for cost, _ in ranked])
    return Standing(
        observer=observer,
        metric=metric,
        measured=len(values),
        failed=len(failed),
        median=sign * _quantile(costs, 0.5),
        p95=sign * _quantile(costs, 0.95),
        worst=sign * costs[-1] if ranked else math.nan,
        worst_case=ranked[-1][1] if ranked else "",
    )


def leaderboard(run: Run, quantity: Quantity) -> list[Standing]:
    """The observers of a quantity, best median first."""
    rows = [standing(run, metric, observer, quantity.higher_is_better) for observer, metric in quantity.metrics.items()]
    sign = -1.0 if quantity.higher_is_better else 1.0
    return sorted(
        rows,
        key=lambda row: (math.isnan(row.median), sign * row.median, sign * row.p95),
    )


def scenarios(run: Run) -> dict[str, list[Case]]:
    """Cases by what was varied but the seed, in the order of the campaign."""
    grouped: dict[str, list[Case]] = {}
    for case in run.cases:
        grouped.setdefault(case.scenario, []).append(case)
    return grouped


def _quantile(costs: np.ndarray, share: float) -> float:
    if not len(costs):
        return math.nan
    if np.isfinite(costs).all():
        return float(np.quantile(costs, share))
    return float(np.quantile(costs, share, method="higher"))


def _higher_is_better(run: Run, metrics: Any) -> bool:
    known = definitions(run)
    texts = [criterion.text for criterion in run.criteria or ()]
    for metric in metrics:
        base, _, part = metric.partition(".")
        said = {part, known[base].kind if base in known else ""}
        if said.intersection(BETTER_WHEN_HIGHER):
            return True
        if said.intersection(BETTER_WHEN_LOWER):
            continue
        if any(re.match(rf"\s*(\w+\()?\s*{re.escape(metric)}\s*\)?\s*>=?\s*[-+.\d]", text) for text in texts):
            return True
    return False


def _readable(kind: str) -> str:
    return kind.upper() if kind in ACRONYMS else kind.replace("_", " ").capitalize()


def _title(name: str) -> str:
    return name.replace("_", " ").capitalize()
