"""The least error that a set of sensors allows, by the filter's Riccati equation, and how it changes with each sensor.

The best filter of a set S has the covariance X, the stabilising solution of

    A X + X A' - X M X + process = 0,   M = sum over S of c_j' c_j / r_j,

and the cost J(S) = trace(W X W'), which is the square of the H2 norm of the error system, the least trace(T) of Zhang
et al. (Front. Mech. Eng. 2021), Eq. 14. With M = sum_j d_j c_j' c_j / r_j it is a function of how much d_j of each
sensor is there. That is convex: Y = 1/X may be any for which

    Y A + A' Y + Y process Y <= M(d),   linear in (Y, d) by Schur's complement,

and J(d) is the least trace(W Y^-1 W') over them, a convex function minimised over a convex set. So its tangent at any
d lies below it everywhere: with Lambda of (A - X M)' Lambda + Lambda (A - X M) + W'W = 0,

    J(S) >= J(d) - sum_j g_j (s_j - d_j),   g_j = c_j X Lambda X c_j' / r_j >= 0,   s_j = 1 where j is in S, else 0.

One Riccati and one Lyapunov equation bound the costs of all sets at once. More of any sensor never raises the cost.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import schur, solve_continuous_are, solve_continuous_lyapunov

from fmus.component import Vector
from observers.modes import growing_modes
from selection.estimation import Estimation, EstimationError, deviations, unseen_by

# Of the terms of the Riccati equation, how much may be left over: the Schur vectors of a Hamiltonian matrix of some
# tens of rows leave 1e-14 to 1e-11; one step of Newton's method brings back what it lost.
LEFT_OVER, LOST = 1e-11, 1e-7
# How far the cost may be from that by scipy's solver. It works on a pencil that is not balanced the same way.
AGREED = 1e-6


class Tangent(NamedTuple):
    """J(S) >= offset - sum of `slopes` (m,) over S, for every set S; `cost` is J where it touches."""

    offset: float
    slopes: Vector
    cost: float


class Filter(NamedTuple):
    """The best filter of a set at rest: gain L (n, s), covariance of its error X (n, n), trace(W X W'), evidence.

    States are those of `Estimation.on(members)`. `left_over` is the residual of the Riccati equation relative to its
    terms, `decay` [1/s] the slowest rate at which errors die out, `trace_again` the cost by the Lyapunov equation of
    the error system with this gain, which knows nothing of the Riccati equation.
    """

    gain: Vector
    covariance: Vector
    trace: float
    trace_again: float
    left_over: float
    decay: float


class Costs:
    """The costs of sets of sensors, each solved for once, and tangents; `solves` counts Riccati equations."""

    def __init__(self, system: Estimation) -> None:
        self.solves = 0
        self._known: dict[frozenset[int], Vector | None] = {}
        self._grows = bool(growing_modes(system.A))
        self.system = system.scaled(_above_zero(filter_sizes(system)))

    def cost(self, members: Sequence[int]) -> float:
        """J of a set; infinite where it does not see a mode that does not die out."""
        variances = self.variances(members)
        return np.inf if variances is None else float(variances.sum())

    def variances(self, members: Sequence[int]) -> Vector | None:
        """The variance of each element of z (k,), whose sum is J; None where that is infinite."""
        key = frozenset(members)
        if key not in self._known:
            self._known[key] = self._solve(sorted(key))
        return self._known[key]

    def _solve(self, members: list[int]) -> Vector | None:
        if self._grows and unseen_by(self.system, members):
            return None
        seen = self.system.on(members)
        X = self._riccati(seen.A, seen.C.T @ seen.C, seen.process)
        return np.einsum("ij,jk,ik->i", seen.W, X, seen.W)

    def tangent(self, use: Vector) -> Tangent | None:
        """The tangent of J where `use` (m,) of each sensor is there; None where that sees not all it must see."""
        if self._grows and unseen_by(self.system, np.flatnonzero(use > 0.0).tolist()):
            return None
        A, C, W = self.system.A, self.system.C, self.system.W
        M = (C.T * use) @ C
        X = self._riccati(A, M, self.system.process)
        worth = solve_continuous_lyapunov((A - X @ M).T, -W.T @ W)
        seen = C @ X
        slopes = np.maximum(np.einsum("ij,jk,ik->i", seen, worth, seen), 0.0)
        cost = float(np.trace(W @ X @ W.T))
        return Tangent(cost + float(slopes @ use), slopes, cost)

    def _riccati(self, A: Vector, M: Vector, Q: Vector) -> Vector:
        self.solves += 1
        return covariance(A, M, Q)


def covariance(A: Vector, M: Vector, Q: Vector) -> Vector:
    """The stabilising solution X (n, n) of A X + X A' - X M X + Q = 0, from the stable subspace of its Hamiltonian.

    Raises EstimationError: there is none, or it cannot be told from none.
    """
    n = len(A)
    _, vectors, stable = schur(np.block([[A.T, -M], [-Q, -A]]), sort="lhp")
    if stable != n:
        raise EstimationError([f"the Riccati equation has no stabilising solution: {stable} of {n} modes are stable"])
    try:
        X = _symmetric(np.linalg.solve(vectors[:n, :n].T, vectors[n:, :n].T))
    except np.linalg.LinAlgError as error:
        raise EstimationError(["the Riccati equation has no stabilising solution: a mode is not seen"]) from error
    left = _left_over(A, M, Q, X)
    if left > LEFT_OVER:
        X = _symmetric(solve_continuous_lyapunov(A - X @ M, -(Q + X @ M @ X)))
        left = _left_over(A, M, Q, X)
    if not left <= LOST:
        raise EstimationError([f"the Riccati equation is left with {left:.1e} of its terms, wants {LOST:g} or less"])
    return X


def best_filter(system: Estimation, members: Sequence[int]) -> Filter:
    """The best filter of a set by scipy's solver, and by it the cost certified.

    Raises EstimationError: a mode that does not die out is not seen, it is named; there is no stabilising solution;
    the residual is not small, or the error system has another H2 norm.
    """
    _refuse_unseen(system, members)
    own = system.on(members)
    sizes = _above_zero(filter_sizes(own))
    seen = own.scaled(sizes)
    if members:
        try:
            X = _symmetric(np.asarray(solve_continuous_are(seen.A.T, seen.C.T, seen.process, np.eye(len(seen.C)))))
        except np.linalg.LinAlgError as error:
            raise EstimationError([f"the Riccati equation has no stabilising solution: {error}"]) from error
    else:
        X = _symmetric(np.asarray(solve_continuous_lyapunov(seen.A, -seen.process)))
    M = seen.C.T @ seen.C
    left = _left_over(seen.A, M, seen.process, X)
    if not left <= LOST:
        raise EstimationError([f"the Riccati equation is left with {left:.1e} of its terms, wants {LOST:g} or less"])
    trace = float(np.trace(seen.W @ X @ seen.W.T))
    gain = X @ seen.C.T
    again, decay = error_norm(seen, gain)
    if not abs(again - trace) <= AGREED * trace:
        raise EstimationError([f"the cost is {trace:.6g} by the Riccati equation, {again:.6g} of the error system"])
    spread = np.outer(sizes, sizes)
    gain = gain * sizes[:, None] / np.sqrt(own.noise)
    return Filter(gain, X * spread, trace, again, left, decay)


def error_norm(system: Estimation, gain: Vector) -> tuple[float, float]:
    """The square of the H2 norm of the error system with a gain (n, m), and the slowest decay of errors [1/s].

    From (A - L C) X + X (A - L C)' + process + L R L' = 0 as trace(W X W'). Raises EstimationError: errors grow.
    """
    closed = system.A - gain @ system.C
    decay = -float(np.linalg.eigvals(closed).real.max())
    if not decay > 0.0:
        raise EstimationError([f"with this gain errors grow by {-decay:.3g}/s"])
    X = solve_continuous_lyapunov(closed, -(system.process + (gain * system.noise) @ gain.T))
    return float(np.trace(system.W @ X @ system.W.T)), decay


def filter_sizes(system: Estimation) -> Vector:
    """Deviations of the states (n,) as the noise moves them: in these units Riccati equations keep the most digits.

    Of a system with modes that do not die out, those of the error of the best filter of all sensors. Raises
    EstimationError: these do not see one of them.
    """
    if not growing_modes(system.A):
        return deviations(system)
    _refuse_unseen(system, range(len(system.sensors)))
    X = covariance(system.A, (system.C.T / system.noise) @ system.C, system.process)
    return np.asarray(np.sqrt(np.maximum(np.diag(X), 0.0)))


def _refuse_unseen(system: Estimation, members: Sequence[int]) -> None:
    """Nothing where a set sees every mode that does not die out. Raises EstimationError: it names set and modes."""
    unseen = unseen_by(system, members)
    if unseen:
        named = f"{', '.join(system.sensors[m] for m in members)} does not see" if members else "nothing sees"
        raise EstimationError([f"undetectable: {named} {unseen}"])


def _above_zero(sizes: Vector) -> Vector:
    return np.where(sizes > 0.0, sizes, 1.0)


def _left_over(A: Vector, M: Vector, Q: Vector, X: Vector) -> float:
    """The residual of the Riccati equation, of its largest term."""
    drift, corrected = A @ X, X @ M @ X
    terms = max(np.abs(drift).max(), np.abs(corrected).max(), np.abs(Q).max(), np.finfo(float).tiny)
    return float(np.abs(drift + drift.T - corrected + Q).max() / terms)


def _symmetric(X: NDArray[Any]) -> Vector:
    return np.asarray(0.5 * (X + X.T), dtype=np.float64)
