"""Histograms of errors that a campaign declares: a panel an estimate, the same bins in all, from the cases' records."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure as Drawing

from fmus.units import parse_unit
from reports.along import Ends, rows_between
from reports.declared import si
from reports.figures import INK, STYLE, svg
from reports.folder import Case, Run, RunFolderError
from reports.numbers import axis_label, short
from reports.signals import Vector, find_recorded, open_with
from reports.traces import ends_of

Pair = tuple[str, str]
# Panels side by side.
COLUMNS = 3


@dataclass(frozen=True)
class Errors:
    """Estimate minus truth of one pair over the rows that count: how many lie in each bin, and in all; in the unit."""

    truth: str
    estimate: str
    counts: Vector
    rows: int
    mean: float
    rms: float
    largest: float


@dataclass(frozen=True)
class Histogram:
    """A declared histogram over the records of `cases`; where it cannot be drawn, `problem` says why.

    `edges` are those of the bins, the first and the last of which hold what lies beyond, in `unit`.
    """

    title: str
    unit: str = "1"
    edges: Vector | None = None
    panels: tuple[Errors, ...] = ()
    experiments: tuple[str, ...] = ()
    cases: int = 0
    recorded: int = 0
    logarithmic: bool = False
    ends: tuple[str, str] = ("", "")
    problem: str = ""


def declared_histograms(run: Run) -> list[Histogram]:
    """Every histogram of the campaign's report section."""
    return [_histogram(run, entry) for entry in (run.campaign.get("report") or {}).get("histograms") or ()]


def draw_histogram(found: Histogram, titles: Mapping[str, str], colours: Mapping[str, str], name: str) -> str:
    """A panel a pair: the share of its rows in each bin, over one error axis and one axis of shares for all."""
    columns = min(COLUMNS, len(found.panels))
    rows = math.ceil(len(found.panels) / columns)
    named = _names(found.panels, titles)
    with matplotlib.rc_context(STYLE):
        drawing = Drawing(figsize=(9.6, 0.6 + 2.3 * rows), layout="constrained")
        axes = drawing.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
        for index, axis in enumerate(axes.flat):
            axis.tick_params(labelbottom=index + columns >= len(found.panels))
            if index >= len(found.panels):
                axis.set_axis_off()
                continue
            errors = found.panels[index]
            colour = colours[errors.estimate.partition(".")[0]]
            shares = 100.0 * errors.counts / max(errors.rows, 1)
            axis.stairs(shares, found.edges, fill=True, color=colour, alpha=0.85)
            axis.axvline(0.0, color=INK, linewidth=0.7)
            told = ", ".join(
                f"{what} {short(value, 3)}"
                for what, value in (("mean", errors.mean), ("rms", errors.rms), ("max", errors.largest))
            )
            axis.set_title(f"{named[index]}\n{told}", loc="left", fontsize=9)
        if found.logarithmic:
            axes.flat[0].set_yscale("log")
        drawing.supylabel("share of the rows [%]", fontsize=9.5)
        truths = list(dict.fromkeys(errors.truth for errors in found.panels))
        drawing.supxlabel(
            axis_label(f"estimate - {truths[0] if len(truths) == 1 else 'truth'}", found.unit), fontsize=9.5
        )
        return svg(drawing, name)


def _names(panels: Sequence[Errors], titles: Mapping[str, str]) -> list[str]:
    """The observers by their titles; estimates of one that has several go by their own names."""
    parts = [errors.estimate.partition(".")[0] for errors in panels]
    several = Counter(parts)
    return [
        titles.get(part, part) if several[part] == 1 else errors.estimate
        for part, errors in zip(parts, panels, strict=True)
    ]


def _histogram(run: Run, entry: Mapping[str, Any]) -> Histogram:
    title, pairs = str(entry.get("title") or "Errors"), [(str(one), str(other)) for one, other in entry["pairs"]]
    experiments = tuple(map(str, entry.get("experiments") or ()))
    asked = [case for case in run.cases if not experiments or case.experiment in experiments]
    names = sorted({name for pair in pairs for name in pair})
    cases = [case for case in asked if len(find_recorded(run, case, names).signals) == len(names)]
    if not cases:
        where = ", ".join(experiments) or "the campaign"
        return Histogram(title, problem=f"no case of {where} left a record of {', '.join(names)}")
    column = find_recorded(run, cases[0], names).signals[pairs[0][0]]
    unit = column.shown_in(str(entry.get("unit") or ""))
    factor = parse_unit(unit).factor
    ends, angle = ends_of(entry), str(entry.get("angle") or "")
    try:
        sums = np.array([[0.0, 0.0, 0.0, 0.0]] * len(pairs))  # rows, sum, sum of squares, largest
        for index, error in _errors(run, cases, pairs, ends, angle, factor):
            rows, total, squares, largest = sums[index]
            reached = max(largest, float(np.max(np.abs(error), initial=0.0)))
            sums[index] = rows + len(error), total + error.sum(), squares + error @ error, reached
        bins = int(entry.get("bins") or 60)
        told = si(entry.get("reach"), column.unit)
        reach = (sums[:, 3].max() or 1.0) if told is None else told / factor
        edges = np.linspace(-reach, reach, bins + 1)
        counts = np.zeros((len(pairs), bins))
        for index, error in _errors(run, cases, pairs, ends, angle, factor):
            counts[index] += np.histogram(np.clip(error, -reach, reach), edges)[0]
    except (KeyError, RunFolderError) as error:
        return Histogram(title, problem=str(error.args[0]))
    return Histogram(
        title,
        unit,
        edges,
        tuple(_of_pair(*of) for of in zip(pairs, counts, sums, strict=True)),
        experiments,
        len(asked),
        len(cases),
        entry.get("scale") == "log",
        (str(entry.get("from") or ""), str(entry.get("to") or "")),
    )


def _errors(
    run: Run, cases: Sequence[Case], pairs: Sequence[Pair], ends: Ends, angle: str, factor: float
) -> Iterator[tuple[int, Vector]]:
    """The errors of each pair by its number, in the unit of that factor, where both are finite, piece by piece."""
    names = sorted({name for pair in pairs for name in pair})
    for case in cases:
        with open_with(run, case, [*names, *([angle] if angle else [])]) as file:
            for rows in rows_between(file, names, ends, angle if ends.by_crank else None):
                for index, (truth, estimate) in enumerate(pairs):
                    error = (rows.signals[estimate] - rows.signals[truth]) / factor
                    yield index, error[np.isfinite(error)]


def _of_pair(pair: Pair, counts: Vector, sums: Vector) -> Errors:
    rows, total, squares, largest = map(float, sums)
    many = rows or math.nan
    return Errors(*pair, counts, int(rows), total / many, math.sqrt(squares / many) if rows else math.nan, largest)
