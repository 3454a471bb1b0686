"""Reads powers.json of a run and draws from which magnitude on each observer finds what there is to find."""

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
from reports.numbers import axis_label, with_unit
from reports.traces import TRUTH_COLOUR

COLUMNS = 3
# More values of the axis than this have no panel of their own, only a place in the first and in the table.
MOST_PANELS = 9


@dataclass(frozen=True)
class Share:
    """Of the `cases` of one magnitude how many were found, and the interval of the share."""

    magnitude: float
    hits: int
    cases: int
    failed: int
    share: float
    lower: float
    upper: float


@dataclass(frozen=True)
class Point:
    """At one value of the axis the smallest magnitude that is found, None where none is, and the shares of all."""

    at: float
    smallest: float | None
    shares: tuple[Share, ...]

    @property
    def telling(self) -> Share | None:
        """The share of the smallest magnitude found; where none is, that of the largest there was to find."""
        above = [share for share in self.shares if share.magnitude > 0.0]
        found = [share for share in above if share.magnitude == self.smallest]
        return found[0] if found else above[-1] if above else None

    @property
    def without(self) -> Share | None:
        """The share at magnitude zero, where there is nothing to find."""
        return next((share for share in self.shares if share.magnitude == 0.0), None)


@dataclass(frozen=True)
class Line:
    """One observer: its points, or the `problem` that its metric is no share."""

    observer: str
    problem: str
    points: tuple[Point, ...]


@dataclass(frozen=True)
class Power:
    """One question: from which magnitude on is at least `share` of the cases found, against an axis?"""

    title: str
    metric: str
    magnitude: tuple[str, ...]
    magnitude_unit: str
    against: str
    against_unit: str
    hit: float
    share: float
    confidence: float
    experiments: tuple[str, ...]
    cases: int
    failed: int
    note: str
    lines: tuple[Line, ...]

    @property
    def observers(self) -> list[str]:
        """Everyone it speaks of."""
        return [line.observer for line in self.lines]

    @property
    def sizes(self) -> list[float]:
        """All magnitudes at which anything was measured."""
        return [share.magnitude for line in self.lines for point in line.points for share in point.shares]

    @property
    def values(self) -> list[float]:
        """The values of the axis at which anything was measured."""
        return sorted({point.at for line in self.lines for point in line.points})


def read_powers(run: Run) -> tuple[Power, ...]:
    """The powers of a run; none where the file is not there: none are declared, or it was never run to its end.

    Raises RunFolderError: the file does not hold what the contract says.
    """
    return read_entries(run.path / "powers.json", "power", _power)


def draw_power(power: Power, titles: Mapping[str, str], colours: Mapping[str, str], name: str) -> str:
    """The smallest magnitudes found against the axis; below, at each value of the axis, the shares with intervals.

    Dotted is the largest magnitude that there was, dashed the share that is wanted.
    """
    values = power.values if len(power.values) <= MOST_PANELS else []
    rows = 1 + math.ceil(len(values) / COLUMNS)
    largest = max(power.sizes, default=0.0) or 1.0
    with matplotlib.rc_context(STYLE):
        drawing = Drawing(figsize=(9.6, 0.6 + 2.6 * rows), layout="constrained")
        grid = drawing.add_gridspec(rows, COLUMNS)
        above = drawing.add_subplot(grid[0, :])
        for line in power.lines:
            _smallest(above, line.points, titles.get(line.observer, line.observer), colours[line.observer], largest)
        above.axhline(largest, color=TRUTH_COLOUR, linewidth=1.0, linestyle=":")
        above.set_ylim(0.0, 1.18 * largest)
        above.set_xlabel(axis_label(power.against, power.against_unit))
        above.set_ylabel(axis_label("smallest found", power.magnitude_unit))
        above.legend(loc="upper left", bbox_to_anchor=(1.005, 1.02), borderaxespad=0.0)
        for index, at in enumerate(values):
            axis = drawing.add_subplot(grid[1 + index // COLUMNS, index % COLUMNS])
            for place, line in enumerate(power.lines):
                shares = [share for point in line.points if point.at == at for share in point.shares]
                _shares(axis, shares, colours[line.observer], place - (len(power.lines) - 1) / 2)
            axis.axhline(100.0 * power.share, color=TRUTH_COLOUR, linewidth=1.0, linestyle=(0, (5, 4)))
            axis.set_ylim(-4.0, 104.0)
            axis.set_title(f"{power.against} = {with_unit(at, power.against_unit)}", loc="left", fontsize=9)
            axis.set_xlabel(axis_label("magnitude", power.magnitude_unit))
            if index % COLUMNS == 0:
                axis.set_ylabel("found [%]")
        return svg(drawing, name)


def _smallest(axis: Axes, points: Sequence[Point], title: str, colour: str, largest: float) -> None:
    """A line through what is found, broken where nothing is: an open mark above the `largest` magnitude there was."""
    found = [math.nan if point.smallest is None else point.smallest for point in points]
    axis.plot([point.at for point in points], found, "o-", color=colour, label=title)
    nothing = [point.at for point in points if point.smallest is None]
    axis.plot(nothing, [1.09 * largest] * len(nothing), "^", color=colour, fillstyle="none", markersize=7)


def _shares(axis: Axes, shares: Sequence[Share], colour: str, place: float) -> None:
    """The shares over magnitude, each with its interval, a little aside so that none hides another."""
    if not shares:
        return
    size = np.array([share.magnitude for share in shares])
    aside = 0.012 * max(float(np.ptp(size)), 1e-12) * place
    share, lower, upper = (
        100.0 * np.array([getattr(one, key) for one in shares]) for key in ("share", "lower", "upper")
    )
    axis.errorbar(
        size + aside, share, (share - lower, upper - share), fmt="o-", color=colour, markersize=3, linewidth=1.0,
        elinewidth=0.8,
    )  # fmt: skip


def _power(entry: Mapping[str, Any]) -> Power:
    return Power(
        title=str(entry["title"]),
        metric=str(entry["metric"]),
        magnitude=tuple(map(str, entry["magnitude"])),
        magnitude_unit=str(entry["magnitude_unit"]),
        against=str(entry["against"]),
        against_unit=str(entry["against_unit"]),
        hit=float(entry["hit"]),
        share=float(entry["share"]),
        confidence=float(entry["confidence"]),
        experiments=tuple(map(str, entry["experiments"])),
        cases=int(entry["cases"]),
        failed=int(entry["failed"]),
        note=str(entry["note"]),
        lines=tuple(
            Line(str(line["observer"]), str(line["problem"]), tuple(map(_point, line["points"])))
            for line in entry["lines"]
        ),
    )


def _point(entry: Mapping[str, Any]) -> Point:
    smallest = entry["smallest"]
    shares = tuple(
        Share(
            magnitude=float(one["magnitude"]),
            hits=int(one["hits"]),
            cases=int(one["cases"]),
            failed=int(one["failed"]),
            share=float(one["share"]),
            lower=float(one["lower"]),
            upper=float(one["upper"]),
        )
        for one in entry["shares"]
    )
    return Point(float(entry["at"]), None if smallest is None else float(smallest), shares)
