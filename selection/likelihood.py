"""Process noise by maximum likelihood: the diagonal that makes a Kalman filter's innovations as likely as they can be.

For a linear system with Gaussian noise the likelihood of its measurements is that of the innovations of its Kalman
filter (Schweppe, IEEE Trans. Information Theory 11(1), 1965; Mehra, IEEE TAC 15(2), 1970). Here the filter is the
stationary one, whose gain the Riccati equation gives, and the diagonal's logarithms are sought; that is the estimate
which EM comes to (Shumway and Stoffer, J. Time Series Analysis 3(4), 1982), by a quasi-Newton method in fewer steps.
What the measurements do not tell of a state's noise shows as a large standard error.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize

from fmus.component import Vector
from observers.modes import unseen_modes
from selection.measures import sampled

# Logarithms of the noise go this far from where they start: a factor of 3000.
REACH = 8.0
_MOST_DOUBLINGS = 60
# Half the width of the differences in the logarithms that make gradients, and that make the Hessian.
_WIDTH, _CURVED = 1e-4, 1e-2


@dataclass(frozen=True)
class Sampling:
    """x' = A x + g(t) + noise on the states `moved`, y = C x + e + noise of deviation `noise` (q,) each `period` [s].

    A (n, n), C (q, n), in units in which states and noise have like sizes.
    """

    A: Vector
    C: Vector
    noise: Vector
    period: float
    moved: Sequence[int]


class Course(NamedTuple):
    """One record: what is known to drive, (k, n) an interval, added to exp(A h) x; measurements (k, q) less e; x (n,).

    Row j of `drive` leads from instant j to j + 1.
    """

    drive: Vector
    measured: Vector
    start: Vector


class Likely(NamedTuple):
    """Deviations of the white noise on the moved states, unit/sqrt(s), the standard errors of their logarithms, the
    logarithm of the likelihood, and how often the filter ran. An error is infinite where the likelihood has no peak.
    """

    process: Vector
    errors: Vector
    log_likelihood: float
    evaluations: int


def log_likelihood(system: Sampling, process: Vector, courses: Sequence[Course]) -> float:
    """That of the measurements: -1/2 sum (log det 2 pi S + v' S^-1 v), v the innovations of the stationary filter.

    It is over all instants but the first, from whose measurement the filter starts. Raises ValueError: no filter.
    """
    return float(_many(system, np.log(process)[None], courses)[0])


def maximum_likelihood(system: Sampling, start: Vector, courses: Sequence[Course]) -> Likely:
    """The noise (p,) of the moved states that makes the courses likeliest, sought from `start`, within exp(8) of it.

    Raises ValueError: a mode does not die out and is not seen, or no filter rests at the start.
    """
    unseen = unseen_modes(system.A, system.C)
    if unseen:
        raise ValueError(f"a mode of {unseen[0].real:.3g}/s is not seen and does not die out")
    first = np.log(start)
    count, p = 0, len(first)

    def value_and_slope(z: Vector) -> tuple[float, Vector]:
        nonlocal count
        count += 2 * p + 1
        steps = _WIDTH * np.eye(p)
        values = -_many(system, np.concatenate([z[None], z + steps, z - steps]), courses)
        return float(values[0]), (values[1 : p + 1] - values[p + 1 :]) / (2.0 * _WIDTH)

    found = minimize(
        value_and_slope, first, jac=True, method="L-BFGS-B", bounds=[(z - REACH, z + REACH) for z in first]
    )
    z = np.asarray(found.x)
    return Likely(np.exp(z), _errors(system, z, first, courses), -float(found.fun), count)


def _errors(system: Sampling, z: Vector, first: Vector, courses: Sequence[Course]) -> Vector:
    """Standard errors from the curvature at the peak; infinite at a bound, or where all directions are not curved."""
    p = len(z)
    within = [i for i in range(p) if abs(z[i] - first[i]) < REACH - 2.0 * _CURVED]
    steps = _CURVED * np.eye(p)[within]
    pairs = [(i, j) for i in range(len(within)) for j in range(i)]
    places = [z, *(z + s for s in steps), *(z - s for s in steps)]
    places += [z + sign * (steps[i] + other * steps[j]) for i, j in pairs for sign in (1, -1) for other in (1, -1)]
    values = -_many(system, np.array(places), courses)
    m = len(within)
    hessian = np.diag((values[1 : m + 1] - 2.0 * values[0] + values[m + 1 : 2 * m + 1]) / _CURVED**2)
    for (i, j), (a, b, c, d) in zip(pairs, values[2 * m + 1 :].reshape(-1, 4), strict=True):
        # Rows: +(i + j), +(i - j), -(i + j), -(i - j).
        hessian[i, j] = hessian[j, i] = (a - b + c - d) / (4.0 * _CURVED**2)
    errors = np.full(p, np.inf)
    curves, axes = np.linalg.eigh(hessian) if m else (np.empty(0), np.empty((0, 0)))
    if m and curves.max() > 0.0:
        # A direction that is not curved tells nothing of the states in it.
        least = 1e-8 * curves.max()
        spread = (axes**2) @ (1.0 / np.maximum(curves, least))
        errors[within] = np.sqrt(spread)
    return errors


def _many(system: Sampling, logs: Vector, courses: Sequence[Course]) -> Vector:
    """The log-likelihoods of many noises at once, logs (b, p): (b,)."""
    n, h = len(system.A), system.period
    F = sampled(system.A, np.zeros((n, n)), h)[0]
    each = np.array([sampled(system.A, np.diag(np.eye(n)[i]), h)[1] for i in system.moved])
    Q = np.einsum("bp,pij->bij", np.exp(2.0 * logs), each)
    R = np.diag(system.noise**2)
    before = stationary_covariances(F, system.C, Q, R)
    S = system.C @ before @ system.C.T + R
    K = np.swapaxes(np.linalg.solve(S, system.C @ before), 1, 2)
    inverse, determinant = np.linalg.inv(S), np.linalg.slogdet(2.0 * np.pi * S)[1]
    total = np.zeros(len(logs))
    for course in courses:
        x = np.repeat(course.start[None], len(logs), axis=0)
        innovations = np.empty((len(course.measured) - 1, *S.shape[:2]))
        for k in range(len(course.measured)):
            v = course.measured[k] - x @ system.C.T
            if k:
                innovations[k - 1] = v
            x = x + np.einsum("bnq,bq->bn", K, v)
            if k < len(course.drive):
                x = x @ F.T + course.drive[k]
        squares = np.einsum("kbq,bqr,kbr->b", innovations, inverse, innovations, optimize=True)
        total -= 0.5 * (len(innovations) * determinant + squares)
    return total


def stationary_covariances(F: Vector, C: Vector, Q: Vector, R: Vector) -> Vector:
    """P = F P F' - F P C' (C P C' + R)^-1 C P F' + Q of many Q at once, Q and P (b, n, n), by doubling.

    The structure-preserving doubling of Chu, Fan, Lin and Wang (Int. J. Control 77(8), 2004): with G = C' R^-1 C and
    each step as far as all steps before. Raises ValueError: it does not come to rest.
    """
    n = len(F)
    A = np.broadcast_to(F.T, Q.shape).copy()
    G = np.broadcast_to(C.T @ np.linalg.solve(R, C), Q.shape).copy()
    H = Q
    for _ in range(_MOST_DOUBLINGS):
        both = np.linalg.inv(np.eye(n) + G @ H)
        A_both, At = A @ both, np.swapaxes(A, 1, 2)
        added = At @ H @ both @ A
        G = G + A_both @ G @ At
        H = H + 0.5 * (added + np.swapaxes(added, 1, 2))
        A = A_both @ A
        if not np.isfinite(H).all():
            break
        sizes = np.abs(H).max(axis=(1, 2))
        if (np.abs(added).max(axis=(1, 2)) <= 1e-13 * sizes).all():
            return H
    raise ValueError("the stationary filter's covariance does not come to rest")
