"""What a step in crank angle passes of an engine cycle: the pieces before and after the cycle's end, windows in it."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

CYCLE = 720.0  # deg
# Crank angles that differ by less are the same: the sums of a clock's steps, converted from rad, are off by rounding.
ROUNDING = 1e-6  # deg


class Piece(NamedTuple):
    """A stretch of crank angle, from `begin` to `end` [deg in the cycle], and a signal on it, linear between its ends.

    A piece that is not there has the length 0.
    """

    begin: Any
    end: Any
    at_begin: Any
    at_end: Any

    @property
    def length(self) -> Any:
        """In deg, 0 or more."""
        return self.end - self.begin

    def within(self, begin: Any, end: Any) -> Piece:
        """The part of it between two angles."""
        first = np.minimum(np.maximum(self.begin, begin), self.end)
        last = np.maximum(np.minimum(self.end, end), first)
        # A piece of no length has one value, whichever way it is interpolated.
        slope = (self.at_end - self.at_begin) / np.maximum(self.length, ROUNDING)
        return Piece(
            first, last, self.at_begin + slope * (first - self.begin), self.at_begin + slope * (last - self.begin)
        )

    def integral(self) -> Any:
        """The integral of the signal over crank angle [its unit times deg], exact for what is linear."""
        return self.length * (self.at_begin + self.at_end) / 2.0


class Passed(NamedTuple):
    """What a step passes: a piece of the cycle it begins in, whether it ends that cycle, a piece of the next one."""

    before: Piece
    ends: Any
    after: Piece


def pass_step(begin: Any, end: Any, at_begin: Any, at_end: Any, origin: Any) -> Passed:
    """The pieces of a step from `begin` to `end` [deg, counted on]; cycles begin at `origin` + n 720 deg.

    The signal is linear between `at_begin` and `at_end`. The step is shorter than a cycle and goes forward: one of no
    length or backwards passes nothing. For floats, arrays and symbols alike.
    """
    r = begin - origin - CYCLE * np.floor((begin - origin + ROUNDING) / CYCLE)
    step = Piece(r, r + np.maximum(end - begin, 0.0), at_begin, at_end)
    ends = np.logical_and(end > begin, step.end >= CYCLE - ROUNDING)
    after = step.within(CYCLE, 2.0 * CYCLE)
    return Passed(step.within(-CYCLE, CYCLE), ends, after._replace(begin=after.begin - CYCLE, end=after.end - CYCLE))


def passes(begin: Any, end: Any, place: Any) -> Any:
    """Whether a step from `begin` to `end` [deg, counted on] goes forward to or over `place` + n 720 deg, any n."""
    return np.floor((end - place + ROUNDING) / CYCLE) > np.floor((begin - place + ROUNDING) / CYCLE)
