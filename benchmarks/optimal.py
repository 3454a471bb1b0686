"""The best sets of sensors by error: the search beside every set by scipy's solver, and how search and program grow."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Sequence
from itertools import combinations
from pathlib import Path
from typing import NamedTuple

import matplotlib
import numpy as np
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from scipy.linalg import solve_continuous_are

from benchmarks.measure import Measure, in_turn
from benchmarks.page import STYLE
from benchmarks.selection import engine
from fmus.statespace import scales
from fmus.units import parse_unit
from selection.estimation import Estimation, estimation_of
from selection.greedy import exchanged, grown_sets
from selection.h2 import Program, SdpError, scaling
from selection.measures import Noise, plant
from selection.optimal import Proven, Terms, Whole, best_set
from selection.riccati import Costs
from selection.tangents import Tangents

EXHAUSTIVE = "every set by scipy's Riccati solver"
SAMPLED = f"{EXHAUSTIVE}, from a sample"
MOST = 5
# States and sensors of random networks, and how many sensors the best set has.
NETWORKS = ((10, 10), (20, 20), (30, 30), (50, 40), (100, 60))
CHOSEN = 3
# The program is not tried where it would take minutes: its work grows with the sixth power of the states.
MOST_STATES_OF_PROGRAM = 30
# A search that has not ended after so many branches counts as not ended.
MOST_BRANCHES = 20_000
# Sets of which scipy's time is taken where all would take hours.
SAMPLE = 10


class SearchGrowth(NamedTuple):
    """Seconds by (states, sensors): of the greedy sets, of the search with it, of one program; NaN where not ended."""

    sizes: tuple[tuple[int, int], ...]
    greedy: tuple[float, ...]
    search: tuple[float, ...]
    program: tuple[float, ...]
    exhaustive: tuple[float, ...]

    def measures(self) -> list[Measure]:
        """The search beside scipy's solver, for every size."""
        return [
            Measure(f"best {CHOSEN} of {m} sensors, {n} states", ours, peer, SAMPLED)
            for (n, m), ours, peer in zip(self.sizes, self.search, self.exhaustive, strict=True)
            if math.isfinite(ours)
        ]


def beside_every_set(rounds: int = 3) -> list[Measure]:
    """The best sets of 1 to 5 of the engine's 17 sensors; a run gives all five, the peer's from all 9,401 sets.

    Raises RuntimeError: they are not the same sets, or a search did not end.
    """
    system = engine_estimation()
    ours: list[Proven] = []
    theirs: list[tuple[int, ...]] = []

    def search() -> None:
        ours[:] = best_of_each(system, MOST)[1]

    def exhaust() -> None:
        sets = [list(combinations(range(len(system.sensors)), size)) for size in range(1, MOST + 1)]
        theirs[:] = [min(some, key=lambda members: scipy_cost(system, members)) for some in sets]

    search()
    least, peer = min(in_turn([_timed(search)], rounds)), in_turn([_timed(exhaust)], 1)[0]
    if [one.sensors for one in ours] != theirs or not all(one.proven for one in ours):
        raise RuntimeError(f"the search gives {[one.sensors for one in ours]}, every set {theirs}")
    return [Measure(f"best sets of 1 to {MOST} of 17 sensors", least, peer, EXHAUSTIVE, 1 / 10)]


def growing(networks: Sequence[tuple[int, int]] = NETWORKS) -> SearchGrowth:
    """The best 3 sensors on random networks, all states disturbed, three of them to be estimated."""
    rows = [_network(n, m) for n, m in networks]
    return SearchGrowth(tuple(networks), *zip(*rows, strict=True))


def best_of_each(system: Estimation, most: int) -> tuple[Costs, list[Proven]]:
    """The proven best sets of up to so many sensors, from greedy sets and exchanges, and what was solved for them."""
    costs = Costs(system)
    terms = Terms(np.ones(len(system.sensors)))
    tangents = Tangents(costs, terms.prices)
    found = []
    for one in grown_sets(tangents, terms, most):
        known = [exchanged(tangents, terms, one.sensors)]
        found.append(best_set(Whole(tangents), tangents, terms, len(one.sensors), known, MOST_BRANCHES))
    return costs, found


def engine_estimation() -> Estimation:
    """The turbocharged engine with the paper's 17 sensors, a hundredth of the nominal value their noise."""
    measured, wanted = engine()
    space = measured.space
    gradients = np.concatenate([space.C, np.eye(len(space.states))])[measured.places]
    signals = {s.name: s for s in (*space.states, *space.outputs)}
    noise = [0.01 * signals[name].nominal * parse_unit(signals[name].unit).factor for name in measured.sensors]
    made = plant(
        space.A, gradients, np.array(measured.time_constants), scales(space.states), Noise(np.array(noise), 0.01, 0.01)
    )
    return estimation_of(made, wanted, [s.name for s in space.states], measured.sensors)


def scipy_cost(system: Estimation, members: Sequence[int]) -> float:
    """The cost of a set as one would write it."""
    own = system.on(members)
    X = solve_continuous_are(own.A.T, own.C.T, own.process, np.diag(own.noise))
    return float(np.trace(own.W @ X @ own.W.T))


def network(n: int, m: int) -> Estimation:
    """A stable random network: each state depends on a neighbour in a ring and on three others by chance."""
    rng = np.random.default_rng([n, m])
    ring = np.eye(n, dtype=bool) | np.roll(np.eye(n, dtype=bool), 1, axis=1) | (rng.random((n, n)) < 3.0 / n)
    A = ring * rng.normal(size=(n, n))
    A -= (np.linalg.eigvals(A).real.max() + 0.5) * np.eye(n)
    C = np.eye(n)[rng.permutation(n)[:m]]
    noise = np.exp(rng.normal(size=m))
    names = tuple(f"x{i}" for i in range(n)), tuple(f"y{i}" for i in range(m))
    return Estimation(A, C, np.eye(n), noise, np.eye(n)[:3], *names, (None,) * m)


def _network(n: int, m: int) -> tuple[float, float, float, float]:
    system = network(n, m)
    terms = Terms(np.ones(m))

    def greedy() -> None:
        grown_sets(Tangents(Costs(system), terms.prices), terms, CHOSEN)

    def search() -> None:
        if not all(one.proven for one in best_of_each(system, CHOSEN)[1]):
            raise TimeoutError

    def program() -> None:
        built = Program(system, scaling(system, "deviation"))
        built.solve(0.0, np.zeros(m))

    def exhaust() -> None:
        rng = np.random.default_rng(0)
        for _ in range(SAMPLE):
            scipy_cost(system, sorted(rng.choice(m, CHOSEN, replace=False)))

    sets = sum(math.comb(m, size) for size in range(1, CHOSEN + 1))
    solved = _ended(program) if n <= MOST_STATES_OF_PROGRAM else math.nan
    return _ended(greedy), _ended(search), solved, _ended(exhaust) * sets / SAMPLE


def _ended(work: Callable[[], None]) -> float:
    """The seconds that work takes; NaN where it does not come to its end."""
    try:
        return _timed(work)()
    except (TimeoutError, SdpError):
        return math.nan


def _timed(work: Callable[[], None]) -> Callable[[], float]:
    def run() -> float:
        begin = time.process_time()
        work()
        return time.process_time() - begin

    return run


def draw_growth(growth: SearchGrowth, path: Path) -> None:
    """The seconds against the states, on logarithmic axes, as SVG."""
    states = [n for n, _ in growth.sizes]
    lines = (
        ("every set by scipy, from a sample", growth.exhaustive, "C3"),
        ("one semidefinite program", growth.program, "C2"),
        ("best sets, proven", growth.search, "C0"),
        ("greedy sets", growth.greedy, "C1"),
    )
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(6.4, 3.8), layout="constrained")
        axis = figure.add_subplot()
        for name, seconds, colour in lines:
            axis.plot(states, seconds, "o-", color=colour, label=name, linewidth=1.0)
        axis.set(xscale="log", yscale="log", xlabel="states / sensors", ylabel="seconds of processor time")
        axis.set_xticks(states, [f"{n} / {m}" for n, m in growth.sizes])
        axis.minorticks_off()
        axis.legend()
        temporary = path.with_suffix(".tmp")
        path.parent.mkdir(exist_ok=True)
        FigureCanvasSVG(figure).print_svg(temporary, metadata={"Date": None})
        os.replace(temporary, path)
