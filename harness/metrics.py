"""The measures of a record: each a pure function of arrays, and how a campaign names its arguments."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from harness.arguments import Arguments, Convergence, Discrete, Errors, One, SignedError, Within

Vector = NDArray[np.float64]


def rmse(error: Vector) -> float:
    """Root of the mean square of an error or error norm: sqrt(mean(e^2)); error (n,), in its unit, NaN where n = 0."""
    return float(np.sqrt(np.mean(error**2))) if len(error) else np.nan


def max_error(error: Vector) -> float:
    """Largest magnitude of an error or error norm: max |e|; error (n,), in its unit, NaN where n = 0."""
    return float(np.max(np.abs(error))) if len(error) else np.nan


def bias(error: Vector) -> float:
    """Mean of estimate minus truth: mean(e); error (n,), in its unit, NaN where n = 0."""
    return float(np.mean(error)) if len(error) else np.nan


def share_within(error: Vector, bound: Vector) -> float:
    """Share of the rows where |e| <= bound, from 0 to 1; error and bound (n,). A row that is NaN is not within."""
    return float(np.mean(np.abs(error) <= bound)) if len(error) else np.nan


def accuracy(time: Vector, truth: Vector, estimate: Vector) -> float:
    """Share of the rows where two discrete signals are equal, from 0 to 1; all (n,)."""
    return float(np.mean(truth == estimate)) if len(time) else np.nan


def detection(time: Vector, truth: Vector, estimate: Vector) -> Mapping[str, float | Vector]:
    """How fast and how cleanly a discrete estimate follows a discrete truth; all (n,).

    A change of the truth at row k to v is detected at the first row j >= k with estimate_j = v, before the truth
    changes again or the window ends: delay t_j - t_k [s]; otherwise it is missed and its delay is infinite. It is
    pending from k to j (to the end of that stretch where missed). A false alarm is a change of the estimate to a value
    other than the truth while no detection is pending. `delay_median` and `delay_p95` count missed changes; p95 is the
    smallest delay that at least 95 % of the changes do not exceed. `delay` holds all delays, `false_alarms_per_min` is
    over the length of the window, `accuracy` the share of equal rows.
    """
    changes = np.flatnonzero(np.diff(truth)) + 1
    ends = np.append(changes, len(truth))[1:]
    pending = np.zeros(len(truth), dtype=bool)
    delays = np.full(len(changes), np.inf)
    for index, (start, end) in enumerate(zip(changes, ends, strict=True)):
        matches = np.flatnonzero(estimate[start:end] == truth[start])
        if len(matches):
            delays[index] = time[start + matches[0]] - time[start]
            end = start + matches[0] + 1
        pending[start:end] = True
    moves = np.flatnonzero(np.diff(estimate)) + 1
    alarms = np.count_nonzero((estimate[moves] != truth[moves]) & ~pending[moves])
    minutes = (time[-1] - time[0]) / 60.0 if len(time) > 1 else 0.0
    return {
        "delay": delays,
        "delay_median": float(np.median(delays)) if len(delays) else np.nan,
        "delay_p95": percentile(delays, 95.0),
        "missed": float(np.count_nonzero(np.isinf(delays))),
        "changes": float(len(delays)),
        "false_alarms": float(alarms),
        "false_alarms_per_min": alarms / minutes if minutes > 0 else np.nan,
        "accuracy": accuracy(time, truth, estimate),
    }


def convergence_rate(time: Vector, error: Vector, demanded: float) -> Mapping[str, float]:
    """The rate at which an error norm decays: minus the slope of the least-squares line through (t, ln |e|) [1/s].

    `ratio` is the rate over the demanded one. Rows with e = 0 have no logarithm and are left out; time and error (n,).
    NaN where fewer than two rows remain.
    """
    rows = np.abs(error) > 0
    if np.count_nonzero(rows) < 2:
        return {"": np.nan, "ratio": np.nan}
    centred = time[rows] - np.mean(time[rows])
    slope = np.sum(centred * np.log(np.abs(error[rows]))) / np.sum(centred**2)
    return {"": float(-slope), "ratio": float(-slope / demanded)}


def dwell_min(time: Vector, signal: Vector) -> float:
    """Shortest time between two changes of a discrete signal [s].

    The length of the window where it changes at most once; time and signal (n,).
    """
    changes = np.flatnonzero(np.diff(signal)) + 1
    if len(changes) >= 2:
        return float(np.min(np.diff(time[changes])))
    return float(time[-1] - time[0]) if len(time) else np.nan


def final(time: Vector, signal: Vector) -> float:
    """Value of a signal (n,) at the last row, in its unit; NaN where n = 0."""
    return float(signal[-1]) if len(signal) else np.nan


def minimum(time: Vector, signal: Vector) -> float:
    """Smallest value of a signal (n,), in its unit; NaN where n = 0."""
    return float(np.min(signal)) if len(signal) else np.nan


def maximum(time: Vector, signal: Vector) -> float:
    """Largest value of a signal (n,), in its unit; NaN where n = 0."""
    return float(np.max(signal)) if len(signal) else np.nan


def mean(time: Vector, signal: Vector) -> float:
    """Mean over the rows of a signal (n,), in its unit; NaN where n = 0."""
    return float(np.mean(signal)) if len(signal) else np.nan


def percentile(samples: Vector, percent: float) -> float:
    """The smallest sample that at least `percent` % of the samples do not exceed; NaN without samples."""
    ordered = np.sort(samples)
    if not len(ordered) or np.isnan(ordered[-1]):
        return np.nan
    return float(ordered[max(int(np.ceil(percent / 100.0 * len(ordered) - 1e-9)), 1) - 1])


class Result(NamedTuple):
    """What one value of a metric is: `error` (a difference), `signal` (with its offset), or a fixed unit."""

    of: str
    sampled: bool = False


@dataclass(frozen=True)
class Kind:
    """A function of arrays, the arguments it is given in a campaign, and what its values are by suffix."""

    function: Callable[..., float | Mapping[str, float | Vector]]
    arguments: type[Arguments]
    results: Mapping[str, Result]


ERROR, SIGNAL, SHARE = {"": Result("error")}, {"": Result("signal")}, {"": Result("1")}
KINDS: Mapping[str, Kind] = {
    "rmse": Kind(rmse, Errors, ERROR),
    "max_error": Kind(max_error, Errors, ERROR),
    "bias": Kind(bias, SignedError, ERROR),
    "share_within": Kind(share_within, Within, SHARE),
    "accuracy": Kind(accuracy, Discrete, SHARE),
    "detection": Kind(
        detection,
        Discrete,
        {
            "delay": Result("s", sampled=True),
            "delay_median": Result("s"),
            "delay_p95": Result("s"),
            "missed": Result("1"),
            "changes": Result("1"),
            "false_alarms": Result("1"),
            "false_alarms_per_min": Result("1/min"),
            "accuracy": Result("1"),
        },
    ),
    "convergence_rate": Kind(convergence_rate, Convergence, {"": Result("1/s"), "ratio": Result("1")}),
    "dwell_min": Kind(dwell_min, One, {"": Result("s")}),
    "final": Kind(final, One, SIGNAL),
    "minimum": Kind(minimum, One, SIGNAL),
    "maximum": Kind(maximum, One, SIGNAL),
    "mean": Kind(mean, One, SIGNAL),
}
