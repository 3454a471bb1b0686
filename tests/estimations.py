"""Estimation problems to test selection by error with: random ones, and the engine with the paper's sensors."""

from __future__ import annotations

from functools import cache
from itertools import combinations

import numpy as np
import scipy.linalg
from engine_sensors import WANTED, measured

from benchmarks.selection import engine
from fmus.statespace import scales
from fmus.units import parse_unit
from selection.estimation import Estimation, estimation_of
from selection.measures import Noise, plant
from selection.observability import Measured


def random_estimation(seed: int, n: int, m: int, growth: float = -0.5, wanted: int = 2) -> Estimation:
    """Random matrices, noise on all states, and `growth` the fastest mode's real part."""
    rng = np.random.default_rng(seed)
    A, G = rng.normal(size=(2, n, n))
    A = A - (np.linalg.eigvals(A).real.max() - growth) * np.eye(n)
    return given(A, rng.normal(size=(m, n)), G @ G.T, np.exp(rng.normal(size=m)), np.eye(n)[:wanted])


def given(A, C, process, noise, W) -> Estimation:
    """An estimation of these matrices; states x0, x1, ..., sensors y0, y1, ..., none with a state of its own."""
    A, C, process, noise, W = (np.array(one, dtype=float) for one in (A, C, process, noise, W))
    states, sensors = (tuple(f"{letter}{i}" for i in range(k)) for letter, k in (("x", len(A)), ("y", len(C))))
    return Estimation(A, C, process, noise, W, states, sensors, (None,) * len(C))


@cache
def engine_estimation() -> Estimation:
    """The 13 states of the turbocharged engine with the throttle open, and its 17 sensors, six with a state each."""
    return _with_sensors(measured("open"))


@cache
def engine_estimation_as_started() -> Estimation:
    """The same where its start values settle."""
    found, _ = engine()
    return _with_sensors(found)


def _with_sensors(found: Measured) -> Estimation:
    space = found.space
    gradients = np.concatenate([space.C, np.eye(len(space.states))])[found.places]
    signals = {s.name: s for s in (*space.states, *space.outputs)}
    noise = np.array([0.01 * signals[n].nominal * parse_unit(signals[n].unit).factor for n in found.sensors])
    made = plant(space.A, gradients, np.array(found.time_constants), scales(space.states), Noise(noise, 0.01, 0.01))
    return estimation_of(made, WANTED, [s.name for s in space.states], found.sensors)


def scipy_cost(system: Estimation, members: tuple[int, ...]) -> float:
    """J by scipy's Riccati solver, as one would write it; infinite where there is no stabilising solution."""
    own = system.on(members)
    if not members:
        if np.linalg.eigvals(own.A).real.max() >= 0.0:
            return np.inf
        X = scipy.linalg.solve_continuous_lyapunov(own.A, -own.process)
    else:
        try:
            X = scipy.linalg.solve_continuous_are(own.A.T, own.C.T, own.process, np.diag(own.noise))
        except np.linalg.LinAlgError:
            return np.inf
    return float(np.trace(own.W @ X @ own.W.T))


def subsets(count: int, *sizes: int) -> list[tuple[int, ...]]:
    """All sets of so many of `count` sensors."""
    return [members for size in sizes for members in combinations(range(count), size)]
