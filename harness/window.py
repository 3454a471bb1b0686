"""The rows of a record that a metric looks at: from one time or crank angle to another, without copies."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from fmus.component import Signal
from fmus.units import UnitError, parse_unit
from harness.quantity import Measure

Vector = NDArray[np.float64]
# Rows are counted as inside a window when they miss its ends by less than this, relative to the time or angle.
ROUNDING = 1e-9


class Recorded(Protocol):
    """A record as metrics see it: signals in SI, each column read when it is asked for.

    `time` (n,) [s], `crank` (n,) [deg] where the clock is one of crank angle; both never fall.
    """

    @property
    def signals(self) -> tuple[Signal, ...]:
        """What was recorded."""

    @property
    def time(self) -> Vector:
        """The instants [s], shape (n,)."""

    @property
    def crank(self) -> Vector | None:
        """The crank angles [deg], shape (n,), or None."""

    def __getitem__(self, name: str) -> Vector:
        """One signal, shape (n,), in SI."""

    def pieces(self, names: Sequence[str]) -> Iterator[tuple[Vector, ...]]:
        """Some signals in SI, by stretches of rows that follow each other, each shape (rows,)."""


@dataclass(frozen=True)
class Window:
    """Rows of a record that follow each other, as views of its columns.

    They start at `after`, a time or a crank angle; `angle` names a signal that holds the crank angle [rad].
    """

    record: Recorded
    rows: slice
    after: Measure | None = None
    angle: str | None = None

    @property
    def time(self) -> Vector:
        """The instants [s], shape (n,)."""
        return self.record.time[self.rows]

    @property
    def since(self) -> float:
        """The instant the window starts at [s]: `after`, or the record's first where that is later or there is none."""
        time = self.record.time
        if self.after is None or not len(time):
            return float(time[0]) if len(time) else np.nan
        if is_angle(self.after):
            return float(np.interp(degrees(self.after), _reached(self.record, self.angle), time))
        return max(self.after.si("s"), float(time[0]))

    @property
    def crank(self) -> Vector:
        """The crank angles [deg], shape (n,)."""
        return crank_angle(self.record, self.angle)[self.rows]

    def column(self, name: str) -> Vector:
        """A signal in SI, shape (n,)."""
        return self.record[name][self.rows]

    def difference(self, name: str, other: str) -> Vector:
        """One signal minus another, shape (n,), without both of them in memory as a whole: a new array."""
        found = np.concatenate([one - minus for one, minus in self.record.pieces([name, other])] or [np.empty(0)])
        return found[self.rows]


def window(record: Recorded, after: Measure | None, until: Measure | None, angle: str | None) -> Window:
    """The rows with after <= t <= until, ends included; where an end is a crank angle, from or up to reaching it."""
    first, stop = 0, None
    if after is not None:
        edge, along = _edge(record, after, angle)
        first = int(np.searchsorted(along, edge - ROUNDING * max(1.0, abs(edge)), side="left"))
    if until is not None:
        edge, along = _edge(record, until, angle)
        stop = int(np.searchsorted(along, edge + ROUNDING * max(1.0, abs(edge)), side="right"))
    return Window(record, slice(first, stop), after, angle)


def crank_angle(record: Recorded, angle: str | None) -> Vector:
    """The crank angle of each row [deg], shape (n,): that of the clock, or of the signal `angle` [rad].

    A signal that jumps back at the end of a revolution or of a cycle is unwound; it moves less than 180 deg a row.
    Raises ValueError: neither is there.
    """
    if angle is None:
        if record.crank is None:
            raise ValueError("wants rows with a crank angle, got a record in time and no signal named for it")
        return record.crank
    crank = np.degrees(record[angle])
    return np.unwrap(crank, period=360.0) if np.any(np.diff(crank) < 0) else crank


def is_angle(edge: Measure) -> bool:
    """True where an end of a window is a crank angle."""
    try:
        return parse_unit(edge.unit).same_dimension(parse_unit("deg"))
    except UnitError:
        return False


def degrees(angle: Measure) -> float:
    """An angle in degrees. Raises UnitError: it is none."""
    angle.si("rad")
    return angle.value * (parse_unit(angle.unit).factor / parse_unit("deg").factor)


def _edge(record: Recorded, edge: Measure, angle: str | None) -> tuple[float, Vector]:
    """An end of a window, and what it is an end along: time [s] or the crank angle reached [deg]."""
    return (degrees(edge), _reached(record, angle)) if is_angle(edge) else (edge.si("s"), record.time)


def _reached(record: Recorded, angle: str | None) -> Vector:
    """The largest crank angle up to each row [deg], shape (n,)."""
    crank = crank_angle(record, angle)
    return crank if angle is None else np.maximum.accumulate(crank)
