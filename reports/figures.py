"""Static figures as inline SVG of repeatable bytes: declared signals, heat map, histograms, confusion, delays."""

from __future__ import annotations

import io
import re
from collections.abc import Mapping, Sequence
from textwrap import fill
from typing import Any

import matplotlib
import numpy as np
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure as Drawing
from matplotlib.ticker import MaxNLocator

from reports.envelope import Vector, envelope
from reports.errors import Confusion, Errors
from reports.faultwindows import labelled
from reports.numbers import short
from reports.traces import FAULT_COLOUR, TRUTH_COLOUR, Figure

# Ink is a colour nothing else has, replaced in the SVG by the page's own text colour.
INK = "#010203"
# A heat map of more columns than this has room for colours only.
MOST_NUMBERED = 10
STYLE: dict[Any, Any] = {
    "svg.hashsalt": "crankbench",
    "svg.fonttype": "none",
    "figure.facecolor": "none",
    "axes.facecolor": "none",
    "font.size": 9.5,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.8,
    "axes.grid": True,
    "grid.color": TRUTH_COLOUR,
    "grid.alpha": 0.25,
    "grid.linewidth": 0.6,
    "legend.frameon": False,
    **{key: INK for key in ("text.color", "axes.labelcolor", "axes.edgecolor", "xtick.color", "ytick.color")},
}
# Points a trace may have in a static figure, and bins of a histogram.
POINTS, BINS = 1200, 81


def signals(figure: Figure, name: str) -> str:
    """The declared figure: stacked panels over one axis, thresholds dashed, fault windows shaded, firings dotted."""
    with matplotlib.rc_context(STYLE):
        drawing = Drawing(figsize=(9.6, 0.7 + 1.75 * len(figure.panels)), layout="constrained")
        axes = drawing.subplots(len(figure.panels), 1, sharex=True, squeeze=False)[:, 0]
        for panel, axis in zip(figure.panels, axes, strict=True):
            for trace in panel.traces:
                along, values = envelope(trace.along, trace.values, POINTS)
                style = {"solid": "-", "dash": "--", "dot": ":", "dashdot": "-."}[trace.dash]
                axis.plot(
                    along,
                    values,
                    color=trace.colour,
                    linestyle=style,
                    linewidth=3.0 if trace.is_truth else 1.3,
                    alpha=trace.strength * (0.6 if trace.is_truth else 1.0),
                    drawstyle="steps-post" if trace.discrete else "default",
                    label=trace.name if trace.strength == 1.0 else None,
                )
            for value, label in panel.lines:
                axis.axhline(value, color=TRUTH_COLOUR, linewidth=1.0, linestyle=(0, (5, 4)))
                axis.annotate(label, (0.005, value), xycoords=("axes fraction", "data"), va="top", fontsize=8.5)
            for window in figure.windows:
                axis.axvspan(window.since, window.until, color=FAULT_COLOUR, alpha=0.15, linewidth=0)
            for at, cylinder in figure.axis.marks:
                axis.axvline(at, color=INK, linewidth=0.8, linestyle=":")
                if panel is figure.panels[0]:
                    place = {"xycoords": ("data", "axes fraction"), "ha": "center", "va": "bottom"}
                    axis.annotate(cylinder, (at, 1.01), fontsize=8.5, **place)
            if panel is figure.panels[0]:
                for row, window in labelled(figure.windows):
                    axis.annotate(
                        window.label,
                        (window.since, 1.0),
                        (0.0, -11.0 * row),
                        xycoords=("data", "axes fraction"),
                        textcoords="offset points",
                        va="top",
                        fontsize=8.5,
                    )
            axis.set_ylabel(panel.label)
            if all(trace.discrete for trace in panel.traces):
                axis.yaxis.set_major_locator(MaxNLocator(6, integer=True))
            axis.legend(loc="upper left", bbox_to_anchor=(1.005, 1.02), borderaxespad=0.0)
        axes[-1].set_xlabel(figure.axis.label)
        if figure.axis.ticks:
            axes[-1].set_xticks(figure.axis.ticks)
        if figure.axis.reach:
            axes[-1].set_xlim(figure.axis.reach)
        return svg(drawing, name)


def heat_map(rows: Sequence[str], columns: Sequence[str], values: np.ndarray, label: str, name: str) -> str:
    """Scenarios by observers: `values` (rows, columns), inf where cases failed, NaN where nothing was measured."""
    finite = values[np.isfinite(values)]
    positive = len(finite) > 0 and finite.min() > 0 and finite.max() / finite.min() > 10
    low, high = (float(finite.min()), float(finite.max())) if len(finite) else (0.0, 1.0)
    high = high if high > low else low + 1.0
    norm = LogNorm(low, high) if positive else Normalize(low, high)
    with matplotlib.rc_context(STYLE | {"axes.grid": False}):
        crowded = len(columns) > MOST_NUMBERED  # then headings stand upright, and colours have to do
        headings = [column if crowded else fill(column, 17) for column in columns]
        lines = 0.4 * max(map(len, headings)) if crowded else max(heading.count("\n") for heading in headings) + 1
        width = 1.4 + 0.075 * max(map(len, rows)) + 1.25 * len(columns)
        drawing = Drawing(
            figsize=(min(max(width, 4.5), 11.5), 0.35 + 0.18 * lines + 0.27 * len(rows)), layout="constrained"
        )
        axis = drawing.subplots()
        colours = matplotlib.colormaps["cividis_r"].with_extremes(bad="none", over="none")
        mesh = axis.pcolormesh(
            np.where(np.isfinite(values), values, np.nan),
            norm=norm,
            cmap=colours,
            edgecolors=INK,
            linewidth=0.4,
            shading="flat",
        )
        for row, column in np.ndindex(*values.shape):
            value = float(values[row, column])
            if crowded and np.isfinite(value):
                continue
            text = (
                "x"
                if crowded and np.isinf(value)
                else short(value)
                if np.isfinite(value)
                else "failed"
                if np.isinf(value)
                else "·"
            )
            dark = np.isfinite(value) and float(norm(value)) > 0.55
            colour = INK if not np.isfinite(value) else "white" if dark else "black"
            axis.text(column + 0.5, row + 0.5, text, ha="center", va="center", color=colour, fontsize=9)
        axis.set_xticks(np.arange(len(columns)) + 0.5, headings, rotation="vertical" if crowded else "horizontal")
        axis.set_yticks(np.arange(len(rows)) + 0.5, rows)
        axis.xaxis.tick_top()
        axis.tick_params(length=0)
        axis.invert_yaxis()
        axis.spines[:].set_visible(False)
        if len(finite):
            bar = drawing.colorbar(mesh, cax=axis.inset_axes((1.03, 0.0, 0.03, 1.0)), label=label)
            ticks = (np.geomspace if positive else np.linspace)(low, high, 3).tolist()
            bar.set_ticks(ticks, labels=[short(tick, 2) for tick in ticks])
            bar.minorticks_off()
        return svg(drawing, name)


def error_histograms(errors: Sequence[Errors], titles: Sequence[str], colours: Sequence[str], name: str) -> str:
    """One row an observer over one error axis: share of the samples a bin, logarithmic so that rare errors show."""
    unit = errors[0].unit
    reach = (
        max((float(np.quantile(np.abs(pooled.values), 0.999)) for pooled in errors if len(pooled.values)), default=0.0)
        or 1.0
    )
    edges = np.linspace(-reach, reach, BINS + 1)
    with matplotlib.rc_context(STYLE):
        drawing = Drawing(figsize=(9.6, 0.8 + 1.1 * len(errors)), layout="constrained")
        axes = drawing.subplots(len(errors), 1, sharex=True, sharey=True, squeeze=False)[:, 0]
        for pooled, title, colour, axis in zip(errors, titles, colours, axes, strict=True):
            total = max(len(pooled.values), 1)
            counts, _ = np.histogram(np.clip(pooled.values, -reach, reach), edges)
            axis.stairs(100 * counts / total, edges, fill=True, color=colour, alpha=0.85)
            axis.set_ylim(bottom=1e-3, top=100)
            axis.set_yscale("log")
            axis.minorticks_off()
            axis.set_yticks([0.001, 0.1, 10], labels=["0.001", "0.1", "10"])
            axis.axvline(0.0, color=INK, linewidth=0.7)
            axis.set_title(f"{title}: {_spread(pooled.values, unit)}", loc="left", fontsize=9)
        drawing.supylabel("share of samples [%]", fontsize=9.5)
        axes[-1].set_xlabel(f"estimate - {errors[0].pair.truth} [{unit}]")
        return svg(drawing, name)


def confusion(matrix: Confusion, name: str) -> str:
    """True by estimated class, each row in percent of the samples of that true class."""
    counts = matrix.counts
    shares = 100.0 * counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
    size = len(matrix.classes)
    with matplotlib.rc_context(STYLE | {"axes.grid": False}):
        drawing = Drawing(figsize=(1.6 + 1.05 * size, 0.9 + 0.72 * size), layout="constrained")
        axis = drawing.subplots()
        axis.pcolormesh(shares, vmin=0, vmax=100, cmap="Blues", edgecolors=INK, linewidth=0.4)
        for row, column in np.ndindex(size, size):
            colour = "white" if shares[row, column] > 55 else "black"
            text = f"{short(shares[row, column], 3)} %\n{counts[row, column]:,}".replace(
                ",", "\N{NARROW NO-BREAK SPACE}"
            )
            axis.text(column + 0.5, row + 0.5, text, ha="center", va="center", color=colour, fontsize=9)
        axis.set_xticks(np.arange(size) + 0.5, list(matrix.classes))
        axis.set_yticks(np.arange(size) + 0.5, list(matrix.classes))
        axis.set_xlabel(f"estimated: {matrix.pair.estimate}")
        axis.set_ylabel(f"true: {matrix.pair.truth}")
        axis.tick_params(length=0)
        axis.invert_yaxis()
        axis.spines[:].set_visible(False)
        return svg(drawing, name)


def delays(
    samples: Mapping[str, Vector], unit: str, titles: Mapping[str, str], colours: Mapping[str, str], name: str
) -> str:
    """Distribution of pooled delays, one row an observer: share of the changes in each bin; missed ones as text."""
    finite = [values[np.isfinite(values)] for values in samples.values()]
    reach = max((float(values.max()) for values in finite if len(values)), default=0.0) or 1.0
    edges = np.linspace(0.0, reach * 1.0001, BINS // 2 + 1)
    with matplotlib.rc_context(STYLE):
        drawing = Drawing(figsize=(5.6, 0.9 + 1.6 * len(samples)), layout="constrained")
        axes = drawing.subplots(len(samples), 1, sharex=True, squeeze=False)[:, 0]
        for (observer, values), found, axis in zip(samples.items(), finite, axes, strict=True):
            counts, _ = np.histogram(found, edges)
            axis.stairs(
                100 * counts / max(len(values), 1),
                edges,
                fill=True,
                color=colours.get(observer, TRUTH_COLOUR),
                alpha=0.85,
            )
            for share, style in ((0.5, "-"), (0.95, "--")):
                if len(values) and np.isfinite(level := np.quantile(values, share, method="inverted_cdf")):
                    axis.axvline(float(level), color=INK, linewidth=1.0, linestyle=style)
            missed = len(values) - len(found)
            axis.set_title(
                f"{titles.get(observer, observer)}: {len(values)} changes, {missed} missed", loc="left", fontsize=9
            )
            axis.set_ylabel("share [%]")
        axes[-1].set_xlabel(f"delay [{unit}]  (line: median, dashed: p95)")
        return svg(drawing, name)


def svg(drawing: Drawing, name: str) -> str:
    """The drawing as an SVG element for a page: no date, ids prefixed by `name`, text in the page's colour and font."""
    buffer = io.StringIO()
    FigureCanvasSVG(drawing).print_svg(buffer, metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r'\bid="([^"]+)"', rf'id="{name}-\1"', text)
    text = re.sub(r"url\(#([^)]+)\)", rf"url(#{name}-\1)", text)
    text = re.sub(r'href="#([^"]+)"', rf'href="#{name}-\1"', text)
    text = re.sub(r"font: ([\d.]+px) [^;\"]+", r"font-size: \1", text)
    return text.replace(INK, "currentColor").strip()


def _spread(values: Vector, unit: str) -> str:
    if not len(values):
        return "no samples"
    mean, rms, largest = values.mean(), np.sqrt(np.mean(values**2)), np.abs(values).max()
    return f"mean {short(float(mean), 3)}, rms {short(float(rms), 3)}, max {short(float(largest), 3)} {unit}"
