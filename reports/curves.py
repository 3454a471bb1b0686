"""Reads curves.json of a run and draws each observer's median, with its band, against an axis of the campaign."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Drawing

from reports.figures import STYLE, svg
from reports.folder import Run, read_entries
from reports.numbers import axis_label
from reports.scatter import LOGARITHMIC

COLUMNS = 3


@dataclass(frozen=True)
class Point:
    """A metric over the `cases` at one value of the axis, failed ones counted as the worst: infinite."""

    at: float
    median: float
    low: float
    high: float
    cases: int
    failed: int


@dataclass(frozen=True)
class Panel:
    """At one value of the other axis (empty where there is none) the points of each observer."""

    value: str
    lines: Mapping[str, tuple[Point, ...]]


@dataclass(frozen=True)
class Curve:
    """One question: a metric of several observers against an axis; `band` are the percentiles it is drawn between."""

    title: str
    metric: str
    unit: str
    higher_is_better: bool
    against: str
    against_unit: str
    panels_by: str
    experiments: tuple[str, ...]
    cases: int
    failed: int
    band: tuple[float, float]
    note: str
    panels: tuple[Panel, ...]


def read_curves(run: Run) -> tuple[Curve, ...]:
    """The curves of a run; none where the file is not there: none are declared, or it was never run to its end.

    Raises RunFolderError: the file does not hold what the contract says.
    """
    return read_entries(run.path / "curves.json", "curve", _curve)


def draw_curve(curve: Curve, titles: Mapping[str, str], colours: Mapping[str, str], name: str) -> str:
    """A panel a value of the other axis; a line and a band an observer, a cross at the edge where its cases failed."""
    columns = min(COLUMNS, len(curve.panels)) or 1
    rows = math.ceil(len(curve.panels) / columns) or 1
    with matplotlib.rc_context(STYLE):
        drawing = Drawing(figsize=(9.6, 0.5 + 2.9 * rows), layout="constrained")
        axes = drawing.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
        for axis, panel in zip(axes.flat, curve.panels, strict=False):
            for observer, points in panel.lines.items():
                _line(axis, points, titles.get(observer, observer), colours[observer])
            if curve.panels_by:
                axis.set_title(f"{curve.panels_by} = {panel.value}", loc="left", fontsize=9)
        for index, axis in enumerate(axes.flat):
            axis.tick_params(labelbottom=index + columns >= len(curve.panels))
            if index >= len(curve.panels):
                axis.set_axis_off()
        drawn = [point.median for panel in curve.panels for line in panel.lines.values() for point in line]
        shown = np.array([median for median in drawn if math.isfinite(median)])
        if len(shown) and shown.min() > 0.0 and shown.max() > LOGARITHMIC * shown.min():
            axes.flat[0].set_yscale("log")
        drawing.supxlabel(axis_label(curve.against, curve.against_unit), fontsize=9.5)
        drawing.supylabel(axis_label(f"{curve.metric}, median", curve.unit), fontsize=9.5)
        handles, labels = axes.flat[0].get_legend_handles_labels()
        drawing.legend(handles, labels, loc="outside right upper")
        return svg(drawing, name)


def _line(axis: Axes, points: Sequence[Point], title: str, colour: str) -> None:
    at = np.array([point.at for point in points])
    median, low, high = (np.array([getattr(point, key) for point in points]) for key in ("median", "low", "high"))
    whole = np.isfinite(median)
    axis.plot(at[whole], median[whole], "o-", color=colour, markersize=3.5, linewidth=1.4, label=title)
    banded = whole & np.isfinite(low) & np.isfinite(high)
    axis.fill_between(at[banded], low[banded], high[banded], color=colour, alpha=0.18, linewidth=0)
    edge = np.full(int((~whole).sum()), 0.98)
    axis.plot(at[~whole], edge, "x", color=colour, markersize=6, transform=axis.get_xaxis_transform())


def _curve(entry: Mapping[str, Any]) -> Curve:
    worst = -math.inf if entry["better"] == "higher" else math.inf
    low, high = entry["band"]
    return Curve(
        title=str(entry["title"]),
        metric=str(entry["metric"]),
        unit=str(entry["unit"]),
        higher_is_better=entry["better"] == "higher",
        against=str(entry["against"]),
        against_unit=str(entry["against_unit"]),
        panels_by=str(entry["panels_by"]),
        experiments=tuple(map(str, entry["experiments"])),
        cases=int(entry["cases"]),
        failed=int(entry["failed"]),
        band=(float(low), float(high)),
        note=str(entry["note"]),
        panels=tuple(_panel(panel, worst) for panel in entry["panels"]),
    )


def _panel(entry: Mapping[str, Any], worst: float) -> Panel:
    lines = {str(line["observer"]): tuple(_point(point, worst) for point in line["points"]) for line in entry["lines"]}
    return Panel(str(entry["value"]), lines)


def _point(entry: Mapping[str, Any], worst: float) -> Point:
    median, low, high = (worst if entry[key] is None else float(entry[key]) for key in ("median", "low", "high"))
    return Point(float(entry["at"]), median, low, high, int(entry["cases"]), int(entry["failed"]))
