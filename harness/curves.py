"""A metric against an axis of the campaign: each observer's median over the cases, and the band of most of them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from harness.axes import covered, numbers
from harness.criteria import Judged
from harness.percentile import percentile
from harness.record import COMPLETE
from harness.reportaxes import Curve

# What the band is between, percentiles by nearest rank.
BAND = (5.0, 95.0)


def curves_content(
    curves: Sequence[Curve], cases: Sequence[Judged], observers: Sequence[Sequence[str]], units: Mapping[str, str]
) -> list[dict[str, Any]]:
    """What curves.json holds: of each curve a panel a value of its other axis, of each observer a point a value.

    `observers` are those of each curve, `units` those of the metrics' values.
    """
    return [_curve(curve, cases, names, units) for curve, names in zip(curves, observers, strict=True)]


def _curve(curve: Curve, cases: Sequence[Judged], observers: Sequence[str], units: Mapping[str, str]) -> dict[str, Any]:
    counted = covered(curve, cases)
    axis = numbers(curve.against, counted)
    panels: dict[str, dict[float, list[Judged]]] = {}
    for case, at in zip(counted, axis.values, strict=True):
        panel = case.values[curve.panels] if curve.panels is not None else ""
        panels.setdefault(panel, {}).setdefault(at, []).append(case)
    return {
        "title": curve.title,
        "metric": curve.metric,
        "unit": units.get(curve.metric_of(observers[0]), "1"),
        "better": curve.better,
        "against": curve.against,
        "against_unit": axis.unit,
        "panels_by": curve.panels or "",
        "experiments": curve.experiments,
        "cases": len(counted),
        "failed": sum(case.outcome not in COMPLETE for case in counted),
        "band": list(BAND),
        "note": curve.note,
        "panels": [
            {
                "value": panel,
                "lines": [
                    {"observer": observer, "points": _points(curve, curve.metric_of(observer), found)}
                    for observer in observers
                ],
            }
            for panel, found in panels.items()
        ],
    }


def _points(curve: Curve, metric: str, found: Mapping[float, Sequence[Judged]]) -> list[dict[str, Any]]:
    """A point for each value of the axis at which the metric was measured, or a case failed."""
    worst = math.inf if curve.better == "lower" else -math.inf
    points = []
    for at, cases in sorted(found.items()):
        failed = sum(case.outcome not in COMPLETE for case in cases)
        measured = [case.metrics[metric].value for case in cases if metric in case.metrics]
        known = [value for value in measured if not math.isnan(value)]
        values = np.array(known + [worst] * failed)
        if len(values):
            low, high = (percentile(values, percent) for percent in BAND)
            median = float(np.median(values))
            points.append({"at": at, "median": median, "low": low, "high": high, "cases": len(known), "failed": failed})
    return points
