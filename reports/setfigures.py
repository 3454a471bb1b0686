"""Drawings of a selection of sensors: structure, which states are seen, pairs, and indices of all sets."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import matplotlib
import numpy as np
from matplotlib.colors import Normalize
from matplotlib.figure import Figure as Drawing
from matplotlib.ticker import MaxNLocator

from reports.figures import INK, STYLE, svg

# A cell's height and width, and what a letter of a label takes [inches].
CELL, LETTER = 0.27, 0.078
NEVER = "never"


def structure_matrix(
    rows: Sequence[str], columns: Sequence[str], always: np.ndarray, sometimes: np.ndarray, name: str
) -> str:
    """An X where an element is not zero, in parentheses where that is so at some of the points only.

    `always` and `sometimes` are of shape (rows, columns); a line parts the first len(columns) rows from the others.
    """
    with matplotlib.rc_context(STYLE | {"axes.grid": False}):
        drawing, axis = _grid(rows, columns)
        for row, column in np.ndindex(*always.shape):
            if sometimes[row, column]:
                text = "X" if always[row, column] else "(X)"
                axis.text(column + 0.5, row + 0.5, text, ha="center", va="center", fontsize=9)
        for edge in range(len(rows) + 1):
            heavy = edge in (0, len(columns), len(rows))
            axis.axhline(edge, color=INK, linewidth=0.8 if heavy else 0.3, alpha=1.0 if heavy else 0.35)
        for edge in range(len(columns) + 1):
            axis.axvline(edge, color=INK, linewidth=0.3, alpha=0.35)
        return svg(drawing, name)


def number_matrix(rows: Sequence[str], columns: Sequence[str], values: np.ndarray, name: str) -> str:
    """Whole numbers, the smaller the better, coloured; NaN is never. `values` (rows, columns)."""
    finite = values[np.isfinite(values)]
    low, high = (float(finite.min()), float(finite.max())) if len(finite) else (0.0, 1.0)
    norm = Normalize(low, high if high > low else low + 1.0)
    with matplotlib.rc_context(STYLE | {"axes.grid": False}):
        drawing, axis = _grid(rows, columns)
        colours = matplotlib.colormaps["cividis_r"].with_extremes(bad="none")
        axis.pcolormesh(values, norm=norm, cmap=colours, edgecolors=INK, linewidth=0.3, shading="flat")
        for row, column in np.ndindex(*values.shape):
            value = float(values[row, column])
            known = np.isfinite(value)
            colour = INK if not known else "white" if float(norm(value)) > 0.55 else "black"
            text = f"{value:.0f}" if known else "-"
            axis.text(column + 0.5, row + 0.5, text, ha="center", va="center", color=colour, fontsize=8.5)
        return svg(drawing, name)


def index_histogram(counts: Mapping[str, Mapping[str, int]], name: str) -> str:
    """How many sets have each index, a bar each, in layers by number of sensors; logarithmic where they differ much."""
    sizes = sorted(counts, key=int)
    named = {index for per_size in counts.values() for index in per_size}
    indices = [*sorted((index for index in named if index != NEVER), key=int), *({NEVER} & named)]
    totals = [sum(counts[size].get(index, 0) for size in sizes) for index in indices]
    with matplotlib.rc_context(STYLE):
        drawing = Drawing(figsize=(max(5.0, 1.6 + 0.62 * len(indices)), 3.2), layout="constrained")
        axis = drawing.subplots()
        shades = matplotlib.colormaps["cividis"](np.linspace(0.1, 0.9, max(len(sizes), 1)))
        width = 0.8 / max(len(sizes), 1)
        for place, (size, shade) in enumerate(zip(sizes, shades, strict=True)):
            heights = [counts[size].get(index, 0) for index in indices]
            left = np.arange(len(indices)) - 0.4 + (place + 0.5) * width
            label = f"{size} sensor" + ("" if size == "1" else "s")
            axis.bar(left, heights, width, color=shade, label=label, edgecolor="none")
        for place, total in enumerate(totals):
            tallest = max(counts[size].get(indices[place], 0) for size in sizes)
            axis.annotate(str(total), (place, tallest), ha="center", va="bottom", fontsize=8.5)
        if max(totals) > 50:
            axis.set_yscale("log")
            axis.set_ylim(0.6, None)
        else:
            axis.yaxis.set_major_locator(MaxNLocator(6, integer=True))
        axis.set_xticks(range(len(indices)), indices)
        axis.set_xlabel("observability index of the estimate")
        axis.set_ylabel("sets")
        axis.grid(axis="x", visible=False)
        axis.legend(loc="upper left", bbox_to_anchor=(1.005, 1.02), borderaxespad=0.0)
        return svg(drawing, name)


def _grid(rows: Sequence[str], columns: Sequence[str]) -> tuple[Drawing, matplotlib.axes.Axes]:
    """An empty drawing with a cell for each row and column, the names beside and above."""
    left = 0.25 + LETTER * max(map(len, rows), default=1)
    above = 0.25 + LETTER * max(map(len, columns), default=1)
    width = 1.45 * CELL * len(columns)
    drawing = Drawing(figsize=(left + width, above + CELL * len(rows)), layout="constrained")
    axis = drawing.subplots()
    axis.set_xlim(0, len(columns))
    axis.set_ylim(len(rows), 0)
    axis.set_xticks(np.arange(len(columns)) + 0.5, columns, rotation=90)
    axis.set_yticks(np.arange(len(rows)) + 0.5, rows)
    axis.xaxis.tick_top()
    axis.tick_params(length=0)
    axis.spines[:].set_visible(False)
    return drawing, axis
