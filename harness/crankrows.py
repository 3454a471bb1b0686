"""Signals over crank angle: rows at equal angles, their cycles, and windows that come again every cycle."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from harness.arguments import NO_CRANK_ANGLE, Arguments, CrankRows
from harness.quantity import Measure, Quantity
from harness.scenario import Scenario
from harness.window import Window, degrees

Vector = NDArray[np.float64]
# Two crank angles are the same where they differ by less than this share of the distance between rows.
ROUNDING = 1e-6


class Spacing(NamedTuple):
    """Rows at equal crank angles: row j at `first` + j `apart` [deg], `per_cycle` of them a cycle."""

    first: float
    apart: float
    per_cycle: int

    def from_angle(self, angle: float) -> int:
        """The first row at or after a crank angle [deg], counted from the first row on; may lie outside the rows."""
        return math.ceil((angle - self.first) / self.apart - ROUNDING)

    def angles(self, count: int) -> Vector:
        """The crank angles of the first `count` rows [deg]."""
        return self.first + self.apart * np.arange(count, dtype=float)


def over_crank(window: Window, names: Sequence[str], step: float | None, cycle: float) -> tuple[Spacing, list[Vector]]:
    """The signals at rows of equal crank angle: the rows themselves, or interpolated every `step` [deg].

    Interpolation is linear between the rows, at the multiples of `step` that the window holds. No rows come back where
    those of the window are not at equal angles that divide the cycle, or where the angle falls between two rows.
    """
    crank = window.crank
    turns = np.diff(crank)
    nothing = Spacing(0.0, cycle, 1), [np.empty(0) for _ in names]
    if not len(turns):
        return nothing
    if step is None:
        apart = float(crank[-1] - crank[0]) / len(turns)
        per_cycle = round(cycle / apart) if apart > 0 else 0
        if not divides(apart, cycle) or float(np.max(np.abs(turns - apart))) > ROUNDING * apart:
            return nothing
        return Spacing(float(crank[0]), apart, per_cycle), [window.column(name) for name in names]
    if float(np.min(turns)) < 0:
        return nothing
    del turns
    first = math.ceil(crank[0] / step - ROUNDING)
    count = math.floor(crank[-1] / step + ROUNDING) - first + 1
    spacing = Spacing(first * step, step, round(cycle / step))
    angles = spacing.angles(max(count, 0))
    return spacing, [np.interp(angles, crank, window.column(name)) for name in names]


def divides(apart: float, cycle: float) -> bool:
    """True where a whole number of rows makes a cycle."""
    per_cycle = round(cycle / apart) if apart > 0 else 0
    return per_cycle > 0 and abs(per_cycle * apart - cycle) <= ROUNDING * apart


def window_means(values: Vector, spacing: Spacing, start: float, stop: float) -> Vector:
    """The mean of the rows with start <= angle < stop [deg] in each cycle that has all of them, shape (cycles,)."""
    first = spacing.from_angle(start)
    width = spacing.from_angle(stop) - first
    first %= spacing.per_cycle
    if width < 1 or first + width > len(values):
        return np.empty(0)
    windows = np.lib.stride_tricks.sliding_window_view(values, width)[first :: spacing.per_cycle]
    return np.asarray(np.mean(windows, axis=1))


def by_cycle(values: Vector, spacing: Spacing) -> Vector:
    """The whole cycles from the first row on, shape (cycles, rows a cycle); the rest is left out."""
    cycles = len(values) // spacing.per_cycle
    return values[: cycles * spacing.per_cycle].reshape(cycles, spacing.per_cycle)


def rows_apart(scenario: Scenario) -> float | None:
    """The crank angle from row to row of a record [deg]; None on a time clock."""
    clock = scenario.clock.crank
    if clock is None:
        return None
    step = degrees(clock.step) if clock.step is not None else degrees(clock.cycle) / (clock.per_cycle or 1)
    return step * scenario.record.every


class OverCrank(Arguments):
    """A measure over crank angle: what a cycle is, and how far apart its rows are where they are interpolated."""

    cycle: Quantity = Field(Measure(720.0, "deg"), description="crank angle of an engine cycle")
    step: Quantity | None = Field(
        None, description="crank angle between rows, interpolated; the rows of a crank clock where absent"
    )

    @model_validator(mode="after")
    def _whole_cycle(self) -> OverCrank:
        for name, angle in {"cycle": self.cycle, "step": self.step}.items():
            if angle is not None and degrees(angle) <= 0:
                raise ValueError(f"{name} wants a crank angle above 0 deg, got {angle}")
        if self.step is not None and not divides(degrees(self.step), degrees(self.cycle)):
            raise ValueError(f"step wants to divide the cycle of {self.cycle}, got {self.step}")
        return self

    def over_crank(self, window: Window) -> tuple[Spacing, list[Vector]]:
        """The signals it looks at, at rows of equal crank angle."""
        step = degrees(self.step) if self.step is not None else None
        return over_crank(window, self.names(), step, degrees(self.cycle))

    def apart(self, rows: CrankRows) -> float | None:
        """The crank angle between the rows that it measures [deg], where it is known before a run."""
        return degrees(self.step) if self.step is not None else rows.apart if rows.angle is None else None

    def crank_misfits(self, rows: CrankRows) -> list[str]:
        """Rows without crank angle, or at angles that do not divide the cycle."""
        if rows.unknown:
            return [f"{NO_CRANK_ANGLE}, and how far apart its rows are to be, `step: 1 deg`"]
        apart = self.apart(rows)
        if apart is None:
            return [f"wants the `step` that the signals are interpolated at over {rows.angle}, like `step: 1 deg`"]
        if not divides(apart, degrees(self.cycle)):
            return [f"wants a `step` like `step: 1 deg`: rows {apart:g} deg apart do not divide the cycle {self.cycle}"]
        return []

    def arrays(self, window: Window) -> tuple[Any, ...]:
        """(spacing of the rows, signals...)."""
        spacing, columns = self.over_crank(window)
        return spacing, *columns
