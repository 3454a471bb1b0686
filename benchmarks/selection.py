"""The observability index of sets of sensors, exact by structure, beside ranks by dense singular values in NumPy."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from benchmarks.measure import Measure, side_by_side
from fmus.linearmodel import LinearModel
from fmus.plants.turbo_si import MODEL, SENSORS
from fmus.sensing import TEMPERATURE_LAG
from fmus.statespace import at, linearised, scales, settle
from selection.branch import Branch
from selection.measures import Noise, augmented, plant
from selection.numerical import Scaled, numerical_indices, scaled
from selection.observability import Measured, Options, observe, subset_index
from selection.rowspace import Field, spanned_units
from selection.structure import branch_structure, free_rows

ESTIMATE = ("p_im", "T_im", "p_em")
STACKED, ONE_BY_ONE = "dense SVD in NumPy, stacked", "dense SVD in NumPy, set by set"
STATES, SENSORS_OF_100 = (10, 30, 100, 300), (1, 3, 10, 30)
# Of random networks: how many states each state depends on besides itself.
DEGREE = 4

Sets = list[tuple[int, ...]]


def beside_dense_svd(rounds: int = 10) -> list[Measure]:
    """All 680 triples, and all 131,071 sets, of the engine's 17 sensors; a run gives the indices of all of them.

    Raises RuntimeError: the two ways to the numerical index do not agree.
    """
    measured, wanted = engine()
    system = _scaled(measured)
    triples, every = _sets(3), _sets(*range(1, 18))
    stacked = numerical_indices(system, triples, wanted).subset
    if not np.array_equal(stacked, one_by_one(system, triples, wanted)):
        raise RuntimeError("ranks of stacked matrices are not those of the same matrices one by one")

    def structural(sets: Sets) -> Callable[[], float]:
        return _timed(lambda: observe(measured, wanted, sets, "structural", Options()))

    def numerical(sets: Sets) -> Callable[[], float]:
        return _timed(lambda: numerical_indices(system, sets, wanted))

    alone = side_by_side(structural(triples), _timed(lambda: one_by_one(system, triples, wanted)), max(1, rounds // 3))
    together = side_by_side(structural(triples), numerical(triples), rounds)
    all_sets = side_by_side(structural(every), numerical(every), max(1, rounds // 10))
    return [
        Measure("structural index of 680 triples", *alone, ONE_BY_ONE, 1 / 5),
        Measure("structural index of 680 triples", *together, STACKED, 1 / 5),
        Measure("structural index of 131,071 sets", *all_sets, STACKED),
    ]


def on_networks(states: Sequence[int] = STATES, sensors: Sequence[int] = SENSORS_OF_100) -> list[Measure]:
    """One set of sensors on random networks: 3 sensors on so many states, and so many sensors on 100 states.

    The numerical index goes to the same derivative; it mostly ends without an answer, its matrices being too badly
    conditioned.
    """
    sizes = [*((n, 3) for n in states), *((100, s) for s in sensors if s != 3)]
    return [Measure(f"index from {s} sensors on a network of {n} states", *_network(n, s), STACKED) for n, s in sizes]


def engine() -> tuple[Measured, list[int]]:
    """The turbocharged engine at rest with the paper's 17 sensors, and the places of the states to estimate."""
    system = LinearModel(MODEL)
    u = at(system.inputs, {})
    x = settle(system, at(system.states, {}), u)
    taus = tuple(TEMPERATURE_LAG if name.startswith("T_") else 0.0 for name in SENSORS)
    structure = branch_structure(Branch(system, x, u))
    names = [signal.name for signal in system.states]
    measured = Measured(linearised(system, x, u), SENSORS, taus, structure, system)
    return measured, [names.index(name) for name in ESTIMATE]


def one_by_one(system: Scaled, sets: Sets, wanted: Sequence[int]) -> NDArray[np.int64]:
    """Definition 3 as it is written, for each set: O_rho grows until rank O_rho = n_1 + rank O_rho,2."""
    n = len(system.A)
    noise = Noise(np.ones(len(system.sensors)), 1.0, 0.0)
    whole = plant(system.A, system.sensors, system.time_constants, np.ones(n), noise)
    found = []
    for members in sets:
        A, row = augmented(whole, members)
        others = [j for j in range(len(A)) if j not in wanted]
        matrix, index = np.zeros((0, len(A))), 0
        for rho in range(1, len(A) + 1):
            row = row / np.linalg.norm(row, axis=1, keepdims=True)
            matrix = np.concatenate([matrix, row])
            if np.linalg.matrix_rank(matrix) == len(wanted) + np.linalg.matrix_rank(matrix[:, others]):
                index = rho
                break
            row = row @ A
        found.append(index)
    return np.array(found)


def _network(n: int, s: int) -> tuple[float, float]:
    """Seconds of one set, ours and by singular values, to the index of the whole state."""
    rng = np.random.default_rng([n, s])
    # A ring, so that every state reaches every sensor, and what else chance adds.
    A = np.eye(n, dtype=bool) | np.roll(np.eye(n, dtype=bool), 1, axis=1) | (rng.random((n, n)) < (DEGREE - 1) / n)
    C = np.zeros((s, n), dtype=bool)
    C[np.arange(s), rng.choice(n, s, replace=False)] = True
    rows = free_rows(A, C, [0] * s, Field(), 0)
    values = Scaled(A * rng.normal(size=(n, n)), C.astype(float), np.zeros(s))
    every = tuple(range(s))
    if not subset_index(spanned_units(rows, [every], Field()), range(n)).all():
        raise RuntimeError(f"the network of {n} states is not observable from its {s} sensors")
    ours = _timed(lambda: spanned_units(rows, [every], Field()))
    return side_by_side(ours, _timed(lambda: numerical_indices(values, [every], range(n))), 1 if n > 100 else 3)


def _scaled(measured: Measured) -> Scaled:
    space = measured.space
    gradients = np.concatenate([space.C, np.eye(len(space.states))])[measured.places]
    return scaled(space.A, gradients, np.array(measured.time_constants), scales(space.states))


def _sets(*sizes: int) -> Sets:
    return [members for size in sizes for members in combinations(range(len(SENSORS)), size)]


def _timed(work: Callable[[], object]) -> Callable[[], float]:
    def run() -> float:
        begin = time.process_time()
        work()
        return time.process_time() - begin

    return run
