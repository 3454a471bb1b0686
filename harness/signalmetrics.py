"""What signals show by themselves: last, smallest, largest and mean value, shortest stay, how far they are apart."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]


def final(signal: Vector) -> float:
    """Value of a signal (n,) at the last row, in its unit; NaN where n = 0."""
    return float(signal[-1]) if len(signal) else np.nan


def minimum(signal: Vector) -> float:
    """Smallest value of a signal (n,), in its unit; NaN where n = 0."""
    return float(np.min(signal)) if len(signal) else np.nan


def maximum(signal: Vector) -> float:
    """Largest value of a signal (n,), in its unit; NaN where n = 0."""
    return float(np.max(signal)) if len(signal) else np.nan


def mean(signal: Vector) -> float:
    """Mean over the rows of a signal (n,), in its unit; NaN where n = 0.

    The rows of a time clock are uniform in time, those of a crank clock in crank angle: the mean is over that.
    """
    return float(np.mean(signal)) if len(signal) else np.nan


def dwell_min(time: Vector, signal: Vector) -> float:
    """Shortest time between two changes of a discrete signal [s].

    The length of the window where it changes at most once; time and signal (n,).
    """
    changes = np.flatnonzero(np.diff(signal)) + 1
    if len(changes) >= 2:
        return float(np.min(np.diff(time[changes])))
    return float(time[-1] - time[0]) if len(time) else np.nan


def spread(*signals: Vector) -> Mapping[str, float]:
    """Mean over the rows of the largest less the smallest of several signals, each (n,), in the first one's unit.

    `.final` is that of the last row. NaN where n = 0.
    """
    largest, smallest = signals[0].copy(), signals[0].copy()
    for signal in signals[1:]:
        np.maximum(largest, signal, out=largest)
        np.minimum(smallest, signal, out=smallest)
    largest -= smallest
    return {"": mean(largest), "final": final(largest)}
