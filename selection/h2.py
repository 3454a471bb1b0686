"""The semidefinite program of H2 sensor selection: the error of the best filter against a weighted l1 norm of its gain.

Zhang, Shaver, Lana, Gosala, Le, Langenderfer (Front. Mech. Eng. 2021, 10.3389/fmech.2021.611992), Eqs. 8 to 15. With
P > 0 and Q = P L, for a system as in `selection.estimation`, G G' the process noise and H H' the sensors':

    minimise (1 - alpha) trace(T) + alpha sum_j w_j ||Q_j||_1   subject to
    [[T, [P G, -Q H]'], [[P G, -Q H], P]] >= 0,   P A + A' P - Q C - C' Q' + W'W <= 0.

T's block of the process is G'P G at the least and its blocks beside the diagonal do not count; so here the variable is
the sensors' block T_v alone, trace(T) = trace(P G G') + trace(T_v) and [[T_v, -(Q H)'], [-Q H, P]] >= 0. That is the
same problem with a matrix inequality of fewer rows. `published_inequalities` evaluates those of the paper on what came
out, with NumPy.

What is solved is scaled: states by the sizes given, sensors by their noise, and z so that trace(T) is 1 with all
sensors; so alpha = 1/2 pays for one sensor as much as that trace. In units of the states' standard deviations the
solver keeps eight digits of the engine's trace(T), in units of nominal values four or five. P and Q are stretched by
one factor more, which changes nothing but how large the numbers are that the solver meets: without it it ends
inaccurate where weights grow large.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy.linalg import solve_continuous_lyapunov

from fmus.component import Vector
from selection.estimation import Estimation, EstimationError
from selection.methods import Scaling
from selection.riccati import best_filter, error_norm, filter_sizes

if TYPE_CHECKING:
    import cvxpy

SOLVER = "CLARABEL"
# How close the solver is to come: where the solution is used as it is, and where it says which sensors to take.
_CLOSE, _CLOSE_WEIGHED = 1e-8, 1e-7
# An inequality may be violated by this share of its matrix; trace(T) may be off the H2 norm with the gain returned by
# this share. Where the solver comes as close as it is to they are kept with digits to spare.
VIOLATED, OFF = 1e-6, 1e-4
# Below this share of the largest ||Q_j||_1 with alpha = 0 a sensor counts as hardly used, [I]: the paper gives its
# epsilon for its own scaling only.
HARDLY = 1e-3
# Weights have converged where no sensor's w_j ||Q_j||_1 moves by more; rounding to whole sensors wants no more digits.
SETTLED, MOST_ROUNDS = 1e-2, 30
# What the largest ||Q_j||_1 with alpha = 0 is in the solver's numbers, chosen: with 50 to 1000 the engine's problem is
# solved at every alpha, with 1 and with 0.2 at none above 1/100.
_STRETCHED = 100.0


class SdpError(ArithmeticError):
    """The solver did not solve the problem, or what it returned does not hold: its status, or how far it is off."""


class Residuals(NamedTuple):
    """How far what the solver returned is from what was asked, each relative and 0 at best.

    `performance` and `stability` are the violations of the two matrix inequalities, `definite` that of P > 0. `norm` is
    (trace(T) - ||error system||^2)/trace(T) with the gain returned: above zero where alpha is, for T bounds it.
    """

    performance: float
    stability: float
    definite: float
    norm: float


@dataclass(frozen=True)
class Solution:
    """What the solver returned for one alpha and one set of weights.

    `trace` is trace(T) in the units of z; `norms` (m,) are ||Q_j||_1 in the scaled problem, and `gain` L (n, m) is in
    the units of the system. P, Q are scaled. `status` is the solver's word.
    """

    alpha: float
    trace: float
    norms: Vector
    gain: Vector
    P: Vector
    Q: Vector
    status: str
    residuals: Residuals
    iterations: int


@dataclass(frozen=True)
class Relaxed:
    """The reweighted problem at its end: the solution, the weights it was solved with, and what they say.

    `counted` (m,) is w_j ||Q_j||_1 and its sum the relaxed number of sensors; `settled` whether it stopped moving.
    """

    solution: Solution
    weights: Vector
    counted: Vector
    rounds: int
    settled: bool

    @property
    def number(self) -> int:
        """q: the relaxed number of sensors, rounded."""
        return round(float(self.counted.sum()))

    def chosen(self, must: Sequence[int] = ()) -> tuple[int, ...]:
        """Those of `must` and, up to q of the others, those with the largest ||Q_j||_1."""
        others = [j for j in np.argsort(-self.solution.norms, kind="stable") if j not in must]
        return tuple(sorted((*must, *(int(j) for j in others[: self.number]))))


class Program:
    """The problem of one system, compiled once; alpha and weights are its parameters.

    `sizes` (n,) are the states' scaling. Raises EstimationError: a size is zero, the best filter of all sensors does
    not exist.
    """

    def __init__(self, system: Estimation, sizes: Vector) -> None:
        import cvxpy as cp  # takes half a second

        self.system, self.sizes = system, sizes
        self.scaled = scaled = system.scaled(sizes)
        best = best_filter(scaled, range(len(system.sensors)))
        if not best.trace > 0.0:
            raise EstimationError(["the error is zero with all sensors: nothing disturbs what is wanted"])
        self.unit = best.trace
        A, C = scaled.A, scaled.C
        n, m = len(A), len(C)
        worth = solve_continuous_lyapunov((A - best.gain @ C).T, -scaled.W.T @ scaled.W / self.unit)
        self._stretch = _STRETCHED / float(np.abs(worth @ best.gain).sum(axis=0).max())
        W = scaled.W * np.sqrt(self._stretch / self.unit)
        self._P: Any = cp.Variable((n, n), symmetric=True)
        self._Q: Any = cp.Variable((n, m))
        self._T: Any = cp.Variable((m, m), symmetric=True)
        self._worth: Any = cp.Parameter(nonneg=True)
        self._weights: Any = cp.Parameter(m, nonneg=True)
        P, Q, T = self._P, self._Q, self._T
        stability = P @ A + A.T @ P - Q @ C - C.T @ Q.T + W.T @ W
        constraints = [cp.bmat([[T, -Q.T], [-Q, P]]) >> 0, -0.5 * (stability + stability.T) >> 0]
        trace = cp.trace(P @ scaled.process) + cp.trace(T)
        used = self._weights @ cp.sum(cp.abs(Q), axis=0)
        self._problem: cvxpy.Problem = cp.Problem(
            cp.Minimize(self._worth * (trace / self._stretch) + used), constraints
        )

    def solve(self, alpha: float, weights: Vector) -> Solution:
        """The solution for an alpha in [0, 1) and weights (m,) of ||Q_j||_1.

        Raises SdpError: the solver's status is any but optimal, or what it returned does not hold.
        """
        import cvxpy as cp

        if not 0.0 <= alpha < 1.0:
            raise SdpError(f"alpha wants 0 or more and less than 1, got {alpha:g}")
        self._worth.value, self._weights.value = 1.0 - alpha, alpha * weights / self._stretch
        close = _CLOSE if alpha == 0.0 else _CLOSE_WEIGHED
        try:
            with warnings.catch_warnings():
                # What this warns of, an inaccurate status, is refused below.
                warnings.filterwarnings("ignore", "Solution may be inaccurate")
                self._problem.solve(solver=SOLVER, tol_gap_abs=close, tol_gap_rel=close, tol_feas=close)
        except cp.error.SolverError as error:
            raise SdpError(f"alpha {alpha:.3g}: {SOLVER} failed: {error}") from error
        status = str(self._problem.status)
        if status != cp.OPTIMAL:
            raise SdpError(f"alpha {alpha:.3g}: {SOLVER} ended with the status {status}, wants {cp.OPTIMAL}")
        P, Q, T = (np.asarray(one.value, dtype=float) / self._stretch for one in (self._P, self._Q, self._T))
        trace = float(np.trace(P @ self.scaled.process) + np.trace(T))
        try:
            gain = np.asarray(np.linalg.solve(P, Q), dtype=np.float64)
            residuals = self._residuals(P, Q, T, gain, trace)
        except (np.linalg.LinAlgError, EstimationError) as error:
            raise SdpError(f"alpha {alpha:.3g}: {SOLVER} said {status}, but L = P^-1 Q is no gain: {error}") from error
        worst = max(residuals[:3])
        if not worst <= VIOLATED or residuals.norm < -OFF or (alpha == 0.0 and residuals.norm > OFF):
            told = ", ".join(f"{name} {value:.1e}" for name, value in residuals._asdict().items())
            raise SdpError(f"alpha {alpha:.3g}: {SOLVER} said {status}, but what it returned is off: {told}")
        iterations = int(self._problem.solver_stats.num_iters or 0)
        gain = gain * self.sizes[:, None] / np.sqrt(self.system.noise)
        norms = np.abs(Q).sum(axis=0)
        return Solution(alpha, trace * self.unit, norms, gain, P, Q, status, residuals, iterations)

    def _residuals(self, P: Vector, Q: Vector, T: Vector, gain: Vector, trace: float) -> Residuals:
        A, C, W = self.scaled.A, self.scaled.C, self.scaled.W / np.sqrt(self.unit)
        performance = np.block([[T, -Q.T], [-Q, P]])
        drift = P @ A + A.T @ P - Q @ C - C.T @ Q.T
        norm, _ = error_norm(self.scaled, gain)
        return Residuals(
            _below_zero(performance, np.abs(performance).max()),
            _below_zero(-(drift + W.T @ W), max(np.abs(drift).max(), np.abs(P @ A).max())),
            _below_zero(P, np.abs(P).max()),
            (trace - norm / self.unit) / trace,
        )


def refit(system: Estimation, members: Sequence[int]) -> Solution:
    """The problem with alpha = 0 on the rows of the sensors chosen: L = P^-1 Q and trace(T) of the best filter.

    States are those of `system.on(members)`; they are scaled by `filter_sizes`, since without the l1 norm the scaling
    changes nothing but digits. Raises as `Program` and `solve`.
    """
    own = system.on(members)
    return Program(own, scaling(own, "deviation")).solve(0.0, np.zeros(len(members)))


def reweighted(program: Program, alpha: float, full: Solution, must: Sequence[int] = ()) -> Relaxed:
    """The problem with w_j = 1/(||Q_j||_1 + epsilon) of the solution before, until w_j ||Q_j||_1 stays (Section 2.4).

    It begins with equal weights, 1 over the largest ||Q_j||_1 of `full`, the solution with alpha = 0, of which epsilon
    is the share HARDLY. Sensors of `must` weigh nothing. Raises SdpError.
    """
    largest = float(full.norms.max())
    free = np.array([float(j not in must) for j in range(len(full.norms))])
    weights, counted = free / largest, np.full(len(free), np.inf)
    rounds = 0
    while True:
        rounds += 1
        solution = program.solve(alpha, weights)
        before, counted = counted, weights * solution.norms
        settled = bool(np.abs(counted - before).max() <= SETTLED)
        if settled or rounds == MOST_ROUNDS:
            return Relaxed(solution, weights, counted, rounds, settled)
        weights = free / (solution.norms + HARDLY * largest)


def scaling(system: Estimation, by: Scaling) -> Vector:
    """Sizes of the states (n,): their `deviation` by `filter_sizes`, or the `nominal` ones that they are in already.

    Raises EstimationError: one is zero or not finite; it is named.
    """
    sizes = filter_sizes(system) if by == "deviation" else np.ones(len(system.A))
    still = [state for state, size in zip(system.states, sizes, strict=True) if not 0.0 < size < np.inf]
    if still:
        raise EstimationError([f"a scaling of the states by {by} is singular: no noise moves {', '.join(still)}"])
    return sizes


def published_inequalities(system: Estimation, P: Vector, Q: Vector, unit: float) -> tuple[float, float]:
    """trace(T) and the largest violation of the paper's two inequalities by P and Q of a system that is scaled.

    T is the least that the first one allows, [P G, -Q H]' P^-1 [P G, -Q H] with G G' = process, for which the block
    matrix is singular; violations are relative to the matrices. W is over the root of `unit`.
    """
    values, vectors = np.linalg.eigh(system.process)
    G = vectors * np.sqrt(np.maximum(values, 0.0))
    both = np.concatenate([P @ G, -Q * np.sqrt(system.noise)], axis=1)
    T = both.T @ np.linalg.solve(P, both)
    performance = np.block([[T, both.T], [both, P]])
    drift = P @ system.A + system.A.T @ P - Q @ system.C - system.C.T @ Q.T
    stability = -(drift + system.W.T @ system.W / unit)
    worst = max(
        _below_zero(performance, np.abs(performance).max()),
        _below_zero(stability, max(np.abs(drift).max(), np.abs(P @ system.A).max())),
    )
    return float(np.trace(T)), worst


def _below_zero(matrix: Vector, size: float) -> float:
    """How far the least eigenvalue of a matrix is below zero, of its size; 0 where it is not."""
    least = float(np.linalg.eigvalsh(0.5 * (matrix + matrix.T))[0])
    return max(0.0, -least / max(size, np.finfo(float).tiny))
