"""The observability index in floating point: ranks by singular values, as with any numerical software.

The states are divided by their sizes, and every row C A^k by its norm, which changes no rank. A singular value counts
where it is above `tolerance` times the largest; by default that is the larger side of the matrix times the precision
of a double, as in numpy.linalg.matrix_rank. What comes out still depends on it: it is here to be compared.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fmus.component import Vector

Indices = NDArray[np.int64]
EPS = float(np.finfo(float).eps)
# Singular value decompositions handed to NumPy at once.
_CHUNK = 4096


@dataclass(frozen=True)
class Scaled:
    """A system with states divided by their sizes: A (n, n) [1/s], sensors' gradients (s, n), time constants (s,) [s].

    A time constant of 0 is a sensor without delay; one above adds the state tau y' = x_T - y, in units of x_T's size.
    """

    A: Vector
    sensors: Vector
    time_constants: Vector

    @property
    def slow(self) -> NDArray[np.bool_]:
        """Which sensors add a state, shape (s,)."""
        return self.time_constants > 0.0


@dataclass(frozen=True)
class Found:
    """Of each set: the index of the subset of states, and of the whole state with the sensors' own; 0 where never."""

    subset: Indices
    whole: Indices


def scaled(A: Vector, sensors: Vector, time_constants: Vector, sizes: Vector) -> Scaled:
    """The system with states in units of `sizes`. Raises ValueError: one of them is zero or not finite."""
    if not (np.isfinite(sizes).all() and (sizes > 0.0).all()):
        raise ValueError(f"state {int(np.argmin(np.isfinite(sizes) & (sizes > 0.0)))} has the size {sizes.min():g}")
    return Scaled(A * sizes / sizes[:, None], sensors * sizes, time_constants)


def numerical_indices(
    system: Scaled,
    sets: Sequence[tuple[int, ...]],
    wanted: Sequence[int],
    tolerance: float | None = None,
    tell: Callable[[int], None] = lambda done: None,
) -> Found:
    """Definitions 1 and 3 with ranks by singular values: the least rho with rank O_rho = n_1 + rank O_rho,2.

    `wanted` are the states x_1; O_rho,2 are the columns of the others, those of the sensors among them.
    """
    rows = observability_rows(system)
    subset, whole = (np.zeros(len(sets), dtype=np.int64) for _ in range(2))
    for places, members in _alike(sets, system.slow):
        slow = int(system.slow[members[0]].sum())
        subset[places], whole[places] = _indices(rows, members, system.slow, slow, list(wanted), tolerance)
        tell(len(places))
    return Found(subset, whole)


def observability_rows(system: Scaled) -> Vector:
    """Rows c A^k of each sensor over (x, its own state), each of norm 1 or 0; shape (s, n + s, n + 1)."""
    n, s = len(system.A), len(system.sensors)
    found = np.zeros((s, n + s, n + 1))
    for i, (gradient, tau) in enumerate(zip(system.sensors, system.time_constants, strict=True)):
        A = np.zeros((n + 1, n + 1))
        A[:n, :n] = system.A
        row = np.append(gradient, 0.0)
        if tau > 0.0:
            A[n, :n], A[n, n] = gradient / tau, -1.0 / tau
            row = np.eye(n + 1)[n]
        for k in range(n + s):
            norm = np.linalg.norm(row)
            row = row / norm if norm > 0.0 else row
            found[i, k] = row
            row = row @ A
    return found


def _alike(
    sets: Sequence[tuple[int, ...]], slow: NDArray[np.bool_]
) -> Iterator[tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """Sets of one size with one number of slow sensors: their places, and their members."""
    kinds: dict[tuple[int, int], list[int]] = {}
    for place, members in enumerate(sets):
        kinds.setdefault((len(members), int(slow[list(members)].sum())), []).append(place)
    for places in kinds.values():
        for begin in range(0, len(places), _CHUNK):
            chunk = np.array(places[begin : begin + _CHUNK])
            yield chunk, np.array([sets[i] for i in chunk])


def _indices(
    rows: Vector,
    members: NDArray[np.int64],
    slow: NDArray[np.bool_],
    added: int,
    wanted: list[int],
    tolerance: float | None,
) -> tuple[Indices, Indices]:
    n = rows.shape[2] - 1
    others = [k for k in range(n + added) if k not in wanted]
    subset, whole = (np.zeros(len(members), dtype=np.int64) for _ in range(2))
    alive = np.arange(len(members))
    matrix = np.zeros((len(members), 0, n + added))
    for rho in range(1, n + added + 1):
        matrix = np.concatenate([matrix, _augmented(rows[:, rho - 1], members[alive], slow, added)], axis=1)
        rank = ranks(matrix, tolerance)
        asked = subset[alive] == 0
        reached = np.zeros(len(alive), dtype=bool)
        reached[asked] = rank[asked] == len(wanted) + ranks(matrix[asked][:, :, others], tolerance)
        subset[alive[reached]] = rho
        full = (whole[alive] == 0) & (rank == n + added)
        whole[alive[full]] = rho
        going = (subset[alive] == 0) | (whole[alive] == 0)
        alive, matrix = alive[going], matrix[going]
        if not len(alive):
            break
    return subset, whole


def _augmented(rows: Vector, members: NDArray[np.int64], slow: NDArray[np.bool_], added: int) -> Vector:
    """Rows of the members of each set over (x, the states of its slow sensors), shape (sets, size, n + added)."""
    n = rows.shape[1] - 1
    found = np.zeros((*members.shape, n + added))
    found[:, :, :n] = rows[members][:, :, :n]
    is_slow = slow[members]
    column = n + np.cumsum(is_slow, axis=1) - 1
    sets, places = np.nonzero(is_slow)
    found[sets, places, column[sets, places]] = rows[members[sets, places], n]
    return found


def ranks(matrices: Vector, tolerance: float | None) -> Indices:
    """Numbers of singular values above the tolerance, shape (matrices,)."""
    if 0 in matrices.shape:
        return np.zeros(len(matrices), dtype=np.int64)
    values = np.linalg.svd(matrices, compute_uv=False)
    least = EPS * max(matrices.shape[1:]) if tolerance is None else tolerance
    return (values > least * values[:, :1]).sum(axis=1)


def hidden_states(system: Scaled, members: Sequence[int], tolerance: float | None = None) -> list[int]:
    """The states that take part in what a set does not see: where a null vector of O has an entry."""
    slow = system.slow[list(members)]
    added, n = int(slow.sum()), len(system.A)
    rows = observability_rows(system)
    every = [_augmented(rows[:, k], np.array([members]), system.slow, added)[0] for k in range(n + added)]
    _, values, right = np.linalg.svd(np.concatenate(every))
    least = (EPS * max(n + added, len(every) * len(members)) if tolerance is None else tolerance) * values[0]
    null = right[(values > least).sum() :]
    # Entries of a unit vector that rounding makes of zeros are smaller than a square root of the precision.
    return [int(j) for j in np.nonzero(np.abs(null).max(axis=0, initial=0.0) > np.sqrt(EPS))[0] if j < n]
