"""What tests of observability hold results against: exact rational row spaces, and Lin's conditions."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import structural_rank

Row = list[Fraction]


class RationalSpace:
    """The row space of rational rows, by plain elimination."""

    def __init__(self) -> None:
        self.rows: list[Row] = []

    def reduced(self, row: Row) -> Row:
        for basis in self.rows:
            first = next(j for j, entry in enumerate(basis) if entry)
            row = [a - row[first] / basis[first] * b for a, b in zip(row, basis, strict=True)]
        return row

    def insert(self, row: Row) -> None:
        rest = self.reduced(row)
        if any(rest):
            self.rows.append(rest)

    def holds(self, row: Row) -> bool:
        return not any(self.reduced(row))


def rational_indices(A: Sequence[Sequence[int]], C: Sequence[Sequence[int]], lags: Sequence[int]) -> list[int]:
    """The least rho at which rows c A^k, k < rho - lag, hold each unit vector; 0 where they never do."""
    n = len(A)
    space, found = RationalSpace(), [0] * n
    rows = [[Fraction(entry) for entry in row] for row in C]
    for rho in range(1, n + max(lags, default=0) + 1):
        for i, lag in enumerate(lags):
            if rho > lag:
                space.insert(rows[i])
                rows[i] = [sum((rows[i][k] * A[k][j] for k in range(n)), Fraction(0)) for j in range(n)]
        for j in range(n):
            unit = [Fraction(int(j == k)) for k in range(n)]
            if not found[j] and space.holds(unit):
                found[j] = rho
    return found


def rational_augmented(
    A: Sequence[Sequence[int]], C: Sequence[Sequence[int]], lags: Sequence[int], tau: Fraction
) -> tuple[list[Row], list[Row]]:
    """A and C with a state tau z' = c x - z for each row of C that has a lag, which is measured in its place."""
    n, slow = len(A), [i for i, lag in enumerate(lags) if lag]
    size = n + len(slow)
    rows = [[*map(Fraction, row), *([Fraction(0)] * len(slow))] for row in A]
    outputs = []
    for place, i in enumerate(slow):
        rows.append([Fraction(entry) / tau for entry in C[i]] + [Fraction(0)] * len(slow))
        rows[-1][n + place] = -1 / tau
    for i, gradient in enumerate(C):
        row = [Fraction(0)] * size
        if lags[i]:
            row[n + slow.index(i)] = Fraction(1)
        else:
            row[:n] = map(Fraction, gradient)
        outputs.append(row)
    return rows, outputs


def lin_observable(A: np.ndarray, C: np.ndarray) -> bool:
    """Lin's conditions, dualised (IEEE TAC 19(3), 1974): every state reaches an output, and [A; C] has full rank.

    The second is that there is no contraction: a set of states that fewer rows depend on.
    """
    n = len(A)
    reached = C.any(axis=0)
    for _ in range(n):
        reached = reached | (reached @ A.astype(int) > 0)
    stacked = csr_array(np.concatenate([A, C]).astype(float))
    return bool(reached.all()) and structural_rank(stacked) == n


def chain(length: int) -> list[list[int]]:
    """A chain of integrators x_1' = x_2, x_2' = x_3, ...: from x_1 all are seen, one more with each derivative."""
    return [[int(j == i + 1) for j in range(length)] for i in range(length)]
