"""Declared figures for plotly.js: stacked panels that one axis links, thinned without losing extremes."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from typing import Any

import numpy as np

from reports.envelope import Vector, envelope
from reports.faultwindows import Window, labelled
from reports.traces import FAULT_COLOUR, POINTS, TRUTH_COLOUR, Figure, Panel, Trace

# Points that all interactive traces of a page may have together.
PAGE_POINTS = 150_000


def interactive(figure: Figure, points: int) -> dict[str, Any]:
    """The figure for plotly.js: `data` and `layout`, at most about `points` points a trace, extremes kept."""
    count = len(figure.panels)
    gap = min(0.06, 0.2 / count)
    height = (1.0 - gap * (count - 1)) / count
    data: list[dict[str, Any]] = []
    axis = figure.axis
    shapes = [*map(_shade, figure.windows), *(_firing(at) for at, _ in axis.marks)]
    annotations = [
        _note(window.label, x=window.since, y=1.0, xref="x", yref="paper") | {"yshift": -14 * row}
        for row, window in labelled(figure.windows)
    ]
    annotations += [
        _note(cylinder, x=at, y=1.0, xref="x", yref="paper", yanchor="bottom") | {"xanchor": "center"}
        for at, cylinder in axis.marks
    ]
    ticks = {"tickvals": axis.ticks} if axis.ticks else {}
    reach = {"range": axis.reach} if axis.reach else {}
    layout: dict[str, Any] = {
        "height": 90 + 190 * count,
        "margin": {"l": 90, "r": 10, "t": 34, "b": 50},
        "modebar": {"bgcolor": "rgba(0,0,0,0)", "color": TRUTH_COLOUR, "activecolor": FAULT_COLOUR},
        "paper_bgcolor": "rgba(0,0,0,0)",
        "plot_bgcolor": "rgba(0,0,0,0)",
        "font": {"family": "system-ui, sans-serif", "size": 12},
        "hovermode": "x",
        "hoversubplots": "axis",
        "xaxis": {
            "title": {"text": axis.label},
            "anchor": "y" if count == 1 else f"y{count}",
            **ticks,
            **reach,
            **_AXIS,
        },
        "shapes": shapes,
        "annotations": annotations,
    }
    for number, panel in enumerate(figure.panels):
        suffix = str(number + 1) if number else ""
        top = 1.0 - number * (height + gap)
        layout[f"yaxis{suffix}"] = {"domain": [max(top - height, 0.0), top], "title": {"text": panel.label}, **_AXIS}
        if all(trace.discrete for trace in panel.traces):
            layout[f"yaxis{suffix}"] |= {"tickformat": "d", "nticks": 8, "tick0": 0, **_whole_ticks(panel)}
        layout[f"legend{suffix}"] = {
            "y": top,
            "yanchor": "top",
            "x": 1.01,
            "xanchor": "left",
            "bgcolor": "rgba(0,0,0,0)",
        }
        data += [_line(trace, suffix, points) for trace in panel.traces]
        for value, label in panel.lines:
            shapes.append(_level(value, f"y{suffix}"))
            annotations.append(_note(label, x=0.005, y=value, xref="paper", yref=f"y{suffix}"))
    return {"data": data, "layout": layout}


def points_a_trace(figures: Sequence[Figure]) -> int:
    """Points each interactive trace may have so that the page stays small."""
    traces = sum(len(panel.traces) for figure in figures for panel in figure.panels)
    return max(500, min(POINTS, PAGE_POINTS // max(traces, 1)))


_AXIS = {
    "showline": True,
    "linewidth": 1,
    "zeroline": False,
    "ticks": "outside",
    "ticklen": 4,
    "gridcolor": "rgba(128,128,128,0.2)",
}


def _line(trace: Trace, suffix: str, points: int) -> dict[str, Any]:
    along, values = envelope(trace.along, trace.values, points)
    unit = "" if trace.unit == "1" else f" {trace.unit}"
    return {
        "type": "scatter",
        "mode": "lines",
        "name": trace.name,
        "x": _packed(along, "f8"),
        "y": _packed(values, "f4"),
        "xaxis": "x",
        "yaxis": f"y{suffix}",
        "legend": f"legend{suffix}",
        "line": {
            "color": trace.colour,
            "dash": trace.dash,
            "width": 4 if trace.is_truth else 1.6,
            "shape": "hv" if trace.discrete else "linear",
        },
        "opacity": trace.strength * (0.6 if trace.is_truth else 1.0),
        "legendgroup": trace.name,
        "showlegend": trace.strength == 1.0,
        "hovertemplate": f"%{{y:.4~g}}{unit}<extra>{trace.name}</extra>",
    }


def _whole_ticks(panel: Panel) -> dict[str, Any]:
    reach = max(float(np.ptp(trace.values)) for trace in panel.traces)
    return {"dtick": 1} if reach <= 8 else {}


def _packed(values: Vector, kind: str) -> dict[str, str]:
    return {"dtype": kind, "bdata": base64.b64encode(np.ascontiguousarray(values, dtype=f"<{kind}").tobytes()).decode()}


def _level(value: float, yref: str) -> dict[str, Any]:
    line = {"color": TRUTH_COLOUR, "width": 1.2, "dash": "dash"}
    return {"type": "line", "xref": "paper", "x0": 0, "x1": 1, "yref": yref, "y0": value, "y1": value, "line": line}


def _shade(window: Window) -> dict[str, Any]:
    span = {"xref": "x", "x0": window.since, "x1": window.until, "yref": "paper", "y0": 0, "y1": 1}
    return {"type": "rect", **span, "fillcolor": FAULT_COLOUR, "opacity": 0.15, "line": {"width": 0}, "layer": "below"}


def _firing(at: float) -> dict[str, Any]:
    line = {"color": TRUTH_COLOUR, "width": 1, "dash": "dot"}
    return {"type": "line", "xref": "x", "x0": at, "x1": at, "yref": "paper", "y0": 0, "y1": 1, "line": line}


def _note(text: str, *, x: float, y: float, xref: str, yref: str, yanchor: str = "top") -> dict[str, Any]:
    place = {"x": x, "y": y, "xref": xref, "yref": yref, "xanchor": "left", "yanchor": yanchor}
    return {"text": text, **place, "showarrow": False, "font": {"size": 11}}
