"""Draws rankings: each measure's values against the medians of the metric, the better ones to the left and below."""

from __future__ import annotations

import math
from collections.abc import Mapping

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Drawing
from matplotlib.ticker import MaxNLocator

from reports.figures import INK, STYLE, svg
from reports.numbers import axis_label, short
from reports.rankings import Ranked, Ranking

COLUMNS = 3
# An axis of values above zero whose largest is more than so many times the least is logarithmic.
LOGARITHMIC = 30.0
# More observers than this have no names beside their points: they would hide each other.
MOST_NAMED = 12
POINT_COLOUR = "#3b6fb6"


def scatter(ranking: Ranking, titles: Mapping[str, str], name: str) -> str:
    """A panel a measure; an observer without a value of the measure is an open mark at the right edge.

    Points have the names of their observers beside them where they are few.
    """
    columns = min(COLUMNS, len(ranking.measures))
    rows = math.ceil(len(ranking.measures) / columns)
    with matplotlib.rc_context(STYLE):
        drawing = Drawing(figsize=(9.6, 0.3 + 2.7 * rows), layout="constrained")
        axes = drawing.subplots(rows, columns, sharey=True, squeeze=False)
        for axis, measure in zip(axes.flat, ranking.measures, strict=False):
            _panel(axis, measure, ranking)
            if len(measure.values) <= MOST_NAMED:
                _names(axis, measure, ranking, titles)
        for axis in axes.flat[len(ranking.measures) :]:
            axis.set_axis_off()
        drawing.supylabel(axis_label(f"{ranking.metric}, median", ranking.unit), fontsize=9.5)
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
    axis.set_xlabel(axis_label(measure.title, measure.unit), fontsize=8.5)


def _names(axis: Axes, measure: Ranked, ranking: Ranking, titles: Mapping[str, str]) -> None:
    """The observers beside their points, towards the middle of the panel."""
    axis.get_xlim(), axis.get_ylim()  # only then is known where the points lie in the panel
    for observer, value in measure.values.items():
        median = ranking.medians[observer]
        if math.isfinite(value) and math.isfinite(median):
            across, _ = axis.transAxes.inverted().transform(axis.transData.transform((value, median)))
            aside, side = (5, "left") if across < 0.6 else (-5, "right")
            text, at = titles.get(observer, observer), (value, median)
            axis.annotate(text, at, (aside, 3), textcoords="offset points", horizontalalignment=side, fontsize=8)
