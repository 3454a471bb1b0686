"""Which entries of A and C are not zero, and what that alone says of observability."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array, eye_array, kron, vstack
from scipy.sparse.csgraph import maximum_flow

from fmus.component import Vector
from fmus.interface import dependence
from fmus.linearmodel import LinearModel
from fmus.modelstructure import ModelStructure
from fmus.statespace import Differentiable, StateSpace, linearised, scales
from selection.branch import Branch
from selection.residues import generic_model
from selection.rowspace import Field, Rows

Pattern = NDArray[np.bool_]

# Of differences, an entry is zero where it is below this share of its row, or of ten times what they are worth.
NOTHING = 1e-9
# How far around a point an FMU's entries are looked for, of the sizes of states and inputs, and at how many places: off
# special values, like an air-fuel ratio of one, yet on the same side of what is compared, like two pressures nearby.
AROUND, PLACES = 1e-4, 4


@dataclass(frozen=True)
class Structure:
    """Where A (n, n) and the outputs' gradients C (q, n) are other than zero, and how that was found."""

    A: Pattern
    C: Pattern
    source: str


def branch_structure(branch: Branch, seed: int = 0) -> Structure:
    """The structure of a model on a branch: what is not zero for random states, inputs and parameters.

    An entry that is zero for all of them is zero here for certain; one that is not is not but by a chance of its degree
    over 2^61. What is zero at special values alone, as at an air-fuel ratio of one, is not zero here.
    """
    found = generic_model(branch, Field(), seed)
    return Structure(found.A != 0, found.C != 0, "the model's equations on the branch that it takes at the point")


def widest_structure(system: LinearModel) -> Structure:
    """What is not zero on any branch, by the sparsity of the symbolic Jacobian."""
    equations = system.traced.equations
    declared = dependence(equations, 1, "x")[system.declared_outputs]
    shown = np.eye(len(system.states), dtype=bool)[system.shown_states]
    return Structure(dependence(equations, 0, "x"), np.concatenate([shown, declared]), "all branches of the model")


def observed_structure(system: Differentiable, space: StateSpace, declared: ModelStructure, seed: int = 0) -> Structure:
    """The structure of an FMU: where an entry is not zero at the point or at places around it.

    What the FMU declares not to depend is zero whatever rounding leaves there.
    """
    rng = np.random.default_rng(seed)
    spaces = [space]
    for _ in range(PLACES):
        x = _nearby(space.x0, scales(space.states), rng)
        u = np.clip(
            _nearby(space.u0, scales(space.inputs), rng),
            [s.minimum for s in space.inputs],
            [s.maximum for s in space.inputs],
        )
        spaces.append(linearised(system, x, u))
    A = np.any([_others_than_zero(one.A, one) for one in spaces], axis=0)
    C = np.any([_others_than_zero(one.C, one) for one in spaces], axis=0)
    states = [s.name for s in space.states]
    for rows, names in ((A, declared.derivatives), (C, [s.name for s in space.outputs])):
        for row, name in zip(rows, names, strict=False):
            if name in declared.depends and name not in states:
                row &= [state in declared.depends[name] for state in states]
    rungs = " and ".join(sorted({one.rung for one in spaces}))
    return Structure(A, C, f"{rungs} at the point and {PLACES} places around it, and what the FMU declares")


def _nearby(values: Vector, sizes: Vector, rng: np.random.Generator) -> Vector:
    return values + AROUND * np.maximum(np.abs(values), sizes) * rng.uniform(-1.0, 1.0, len(values))


def _others_than_zero(entries: Vector, space: StateSpace) -> Pattern:
    reach = np.abs(entries) * scales(space.states)
    least = max(NOTHING, 10.0 * space.error) if space.rung == "differences" else 0.0
    return reach > least * reach.sum(axis=1, keepdims=True)


def structurally_observable(A: Pattern, C: Pattern) -> bool:
    """Whether there are numbers for the entries with which (C, A) is observable.

    Shields and Pearson (IEEE TAC 21(2), 1976), here as Andersson, Frisk and Eriksson (IFAC 2005), Theorem 1, have it: a
    matrix of n columns of blocks, with n - 1 rows of blocks I, -A, each a column further than the one above, and below
    them C once in every column, has structural rank n^2. That rank is the size of a matching in the bipartite graph of
    its entries.
    """
    n = len(A)
    if not n or not len(C):
        return not n
    a, c = csr_array(A.astype(float)), csr_array(C.astype(float))
    states, first, next_ = eye_array(n), eye_array(n - 1, n), eye_array(n - 1, n, k=1)
    matrix = vstack([kron(first, states) + kron(next_, a), kron(states, c)], format="csr")
    matrix.eliminate_zeros()  # of dense blocks kron keeps the zeros
    return _largest_matching(coo_array(matrix)) == n * n


def _largest_matching(matrix: coo_array) -> int:
    """How many entries can be chosen with no two in a row or a column: the structural rank.

    As the flow through the bipartite graph with capacities of one, by Dinic's algorithm: the matching of
    scipy.sparse.csgraph did not end within ten minutes on such a matrix of a hundred states.
    """
    (rows, columns), (i, j) = matrix.shape, matrix.coords
    source, sink = rows + columns, rows + columns + 1
    begins = np.concatenate([np.full(rows, source), i, rows + np.arange(columns)]).astype(np.int32)
    ends = np.concatenate([np.arange(rows), rows + j, np.full(columns, sink)]).astype(np.int32)
    edges = csr_array((np.ones(len(begins), dtype=np.int32), (begins, ends)), shape=(sink + 1, sink + 1))
    return int(maximum_flow(edges, source, sink, method="dinic").flow_value)


def distances(A: Pattern, C: Pattern, lags: Sequence[int]) -> NDArray[np.int64]:
    """In which derivative of each sensor's value each state appears first, shape (s, n); -1 where in none.

    That is the shortest way in the graph of the structure, one more for a sensor with a lag.
    """
    found = np.full(C.shape, -1, dtype=np.int64)
    reached = C.copy()
    for k in range(len(A)):
        found[(found < 0) & reached] = k
        reached = (reached.astype(np.int64) @ A) > 0
    return np.where(found < 0, -1, found + np.array(lags, dtype=np.int64)[:, None])


def free_rows(A: Pattern, C: Pattern, lags: Sequence[int], field: Field, seed: int) -> Rows:
    """A system of this structure whose entries are independent: random residues."""
    rng = np.random.default_rng([seed, field.bits])
    a, c = (field.random(rng, pattern.shape) * pattern for pattern in (A, C))
    return Rows(a, c, np.array(lags, dtype=np.int64))


def error_probability(states: int, sets: int, lags: Sequence[int], degree: int, field: Field) -> float:
    """A bound on the chance that any index of so many sets is wrong, from the degree of the entries of A and C.

    A row c A^k has entries of degree (k + 1) `degree`, a minor of O_rho at most n rho `degree`. For each set and rho at
    most n + 1 such minors, for the rank and for each unit vector outside, must not vanish at the random point; each
    does with a chance of at most its degree over the number of residues (Schwartz, J. ACM 27(4), 1980).
    """
    steps = states + max(lags, default=0)
    minors = sum((states + 1) * states * rho * degree for rho in range(1, steps + 1))
    return min(1.0, sets * minors / (field.prime - 1))
