"""Puts a model and recorded readings of its sensors into the form that maximum likelihood wants, and asks it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.linalg import expm

from fmus.component import ConfigurationError, Vector
from fmus.statespace import StateSpace, scales
from harness.recordedstates import Course, Rows
from selection import likelihood
from selection.likelihood import Sampling, maximum_likelihood

# Intervals that differ by less than this share of their mean are one.
_ONE = 1e-6
# Where the search begins: what the residuals say, but no less than this share of a state's size.
_LEAST = 1e-3


class LikelyNoise(NamedTuple):
    """By state its noise in SI, unit/sqrt(s), and the standard error of its logarithm; and the log-likelihood."""

    process: Mapping[str, float]
    errors: Mapping[str, float]
    log_likelihood: float


def likely_noise(
    space: StateSpace,
    courses: Sequence[Course],
    edges: Sequence[Rows],
    sensors: Mapping[str, float],
    lags: Sequence[str],
    first: Mapping[str, float],
) -> LikelyNoise:
    """The noise of all states but the lags that makes readings of the sensors likeliest; see `selection.likelihood`.

    `sensors` are the deviations of the readings in SI by name, in the order of the courses' y. Lags that are no sensor
    are known, and so are the inputs: both are taken as straight between the rows `edges`. A sensor's own lag is a
    state without noise. The search begins at `first`, in SI by name.

    Raises ConfigurationError: intervals that are not one, lags that are not known, no filter.
    """
    names = [s.name for s in space.states]
    kept = [i for i, name in enumerate(names) if name not in lags or name in sensors]
    known = [i for i in range(len(names)) if i not in kept]
    intervals = np.concatenate([np.diff(c.time[e]) for c, e in zip(courses, edges, strict=True)])
    period = float(intervals.mean())
    if np.ptp(intervals) > _ONE * period:
        between = f"{intervals.min():g} to {intervals.max():g} s"
        raise ConfigurationError(f"a likelihood wants rows at one interval, got {between}; --average makes some")
    if any(np.isnan(course.x[:, known]).any() for course in courses):
        missing = [names[i] for i in known if any(np.isnan(course.x[:, i]).any() for course in courses)]
        raise ConfigurationError(f"a likelihood wants to know {', '.join(missing)}; record them, or their commands")
    sizes, noise = scales(space.states)[kept], np.array(list(sensors.values()))
    A = space.A[np.ix_(kept, kept)] * sizes / sizes[:, None]
    rows = np.array([space.output_row(name) for name in sensors])
    through = np.array([_feedthrough(space, name) for name in sensors])
    rest = np.array([_at_point(space, name) for name in sensors])
    moved = [k for k, i in enumerate(kept) if names[i] not in lags]
    system = Sampling(A, rows[:, kept] * sizes / noise[:, None], np.ones(len(noise)), period, moved)
    made = []
    for course, edge in zip(courses, edges, strict=True):
        x, u = course.x[edge] - space.x0, course.u[edge] - space.u0
        drive = (space.rates[kept] + x[:, known] @ space.A[np.ix_(kept, known)].T + u @ space.B[kept].T) / sizes
        beside = rest + x[:, known] @ rows[:, known].T + u @ through.T
        start = np.where(np.isnan(x[0, kept]), 0.0, x[0, kept]) / sizes
        made.append(likelihood.Course(_held(A, drive, period), (course.y[edge] - beside) / noise, start))
    start = np.array([max(first.get(names[kept[k]], 0.0) / sizes[k], _LEAST) for k in moved])
    try:
        found = maximum_likelihood(system, start, made)
    except ValueError as error:
        raise ConfigurationError(f"no likelihood: {error}") from error
    told = [names[kept[k]] for k in moved]
    process = dict(zip(told, map(float, found.process * sizes[moved]), strict=True))
    return LikelyNoise(process, dict(zip(told, map(float, found.errors), strict=True)), found.log_likelihood)


def _held(A: Vector, drive: Vector, h: float) -> Vector:
    """What a drive (k, n), straight between the instants, adds in each interval of h [s]: (k - 1, n).

    The integral of exp(A (h - s)) (g_0 + s (g_1 - g_0)/h) over the interval, by one exponential (Van Loan, IEEE TAC
    23(3), 1978).
    """
    n = len(A)
    block = np.zeros((3 * n, 3 * n))
    block[:n, :n], block[:n, n : 2 * n], block[n : 2 * n, 2 * n :] = A, np.eye(n), np.eye(n)
    whole = expm(block * h)
    once, ramp = whole[:n, n : 2 * n], whole[:n, 2 * n :] / h
    return np.asarray(drive[:-1] @ once.T + np.diff(drive, axis=0) @ ramp.T)


def _feedthrough(space: StateSpace, name: str) -> Vector:
    for i, signal in enumerate(space.outputs):
        if signal.name == name:
            return space.D[i]
    return np.zeros(len(space.inputs))


def _at_point(space: StateSpace, name: str) -> float:
    for signals, values in ((space.outputs, space.y0), (space.states, space.x0)):
        for signal, value in zip(signals, values, strict=True):
            if signal.name == name:
                return float(value)
    raise KeyError(name)
