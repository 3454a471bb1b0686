"""Draws rankings: each measure's values against the medians of the metric, the better ones to the left and below."""

from __future__ import annotations

import math

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Drawing
from matplotlib.ticker import MaxNLocator

from reports.figures import INK, STYLE, svg
from reports.numbers import short
from reports.rankings import Ranked, Ranking

COLUMNS = 3
# An axis of values above zero whose largest is more than so many times the least is logarithmic.
LOGARITHMIC = 30.0
POINT_COLOUR = "#3b6fb6"


def scatter(ranking: Ranking, name: str) -> str:
    """A panel a measure; an observer without a value of the measure is an open mark at the right edge."""
    rows = math.ceil(len(ranking.measures) / COLUMNS)
    with matplotlib.rc_context(STYLE):
        drawing = Drawing(figsize=(9.6, 0.3 + 2.7 * rows), layout="constrained")
        axes = drawing.subplots(rows, COLUMNS, sharey=True, squeeze=False)
        for axis, measure in zip(axes.flat, ranking.measures, strict=False):
            _panel(axis, measure, ranking)
        for axis in axes.flat[len(ranking.measures) :]:
            axis.set_axis_off()
        drawing.supylabel(
            f"{ranking.metric}, median" + (f" [{ranking.unit}]" if ranking.unit != "1" else ""), fontsize=9.5
        )
        return svg(drawing, name)


def _panel(axis: Axes, measure: Ranked, ranking: Ranking) -> None:
    medians = np.array([ranking.medians[observer] for observer in measure.values])
    values = np.array(list(measure.values.values()))
    drawn = np.isfinite(values) & np.isfinite(medians)
    axis.plot(values[drawn], medians[drawn], "o", color=POINT_COLOUR, alpha=0.7, markersize=5)
    for scale, shown in ((axis.set_xscale, values[drawn]), (axis.set_yscale, medians[np.isfinite(medians)])):
        if len(shown) and shown.min() > 0.0 and shown.max() > LOGARITHMIC * shown.min():
            scale("log")
    if (values[drawn] == np.round(values[drawn])).all():
        axis.xaxis.set_major_locator(MaxNLocator(6, integer=True))
    if measure.higher_is_better:
        axis.invert_xaxis()
    if ranking.higher_is_better and not axis.yaxis_inverted():
        axis.invert_yaxis()
    without = np.isnan(values) & np.isfinite(medians)
    if without.any():
        edge = axis.get_yaxis_transform()
        at = np.full(int(without.sum()), 0.985)
        axis.plot(at, medians[without], "o", color=INK, fillstyle="none", markersize=5, transform=edge)
    lost = int(np.isinf(medians).sum())
    remark = f"\n{lost} failed" if lost else ""
    axis.set_title(f"rank correlation {short(measure.correlation, 2)}{remark}", loc="left", fontsize=9)
    axis.set_xlabel(measure.title, fontsize=8.5)
