"""What a single signal shows: its last, smallest, largest and mean value, and how briefly it holds one."""

from __future__ import annotations

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
