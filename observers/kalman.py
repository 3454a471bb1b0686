"""The linear-Gaussian steps that Kalman filters share: an interval's transition and noise, predict, correct."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Of the series over the shortest piece, where the norm of A d is at most one half: what is left out is below rounding.
PIECE = 0.5
TRANSITION_TERMS, NOISE_TERMS = 14, 17
MOST_HALVINGS = 60
# Of a diagonal element: a pivot of the Cholesky factor below this is zero but for rounding.
NEGLIGIBLE = 1e-13


class Gaussian(NamedTuple):
    """What is believed of the states: mean (n,) and covariance (n, n)."""

    mean: Array
    covariance: Array


class Interval(NamedTuple):
    """x(k) = transition x(k-1) + w, w of covariance `noise`; both (n, n)."""

    transition: Array
    noise: Array


class Corrected(NamedTuple):
    """The belief after a measurement, the gain (n, m), and the covariance (m, m) that the innovation was given."""

    belief: Gaussian
    gain: Array
    innovation_covariance: Array


class SingularInnovation(ValueError):
    """An innovation covariance that is singular: measurement `row` (from 0) says nothing that is not known exactly."""

    def __init__(self, row: int) -> None:
        self.row = row
        super().__init__(f"the innovation covariance is singular: measurement {row + 1} is known without it")


def discretise(A: Array, density: Array, h: float) -> Interval:
    """The transition and the noise of x' = A x + w over h [s], w white of spectral density diag(`density`) (n,).

        Phi(h) = e^{Ah},   Q(h) = int_0^h e^{As} diag(density) e^{A's} ds

    These are Van Loan's integrals (IEEE TAC 23(3), 1978). His one exponential holds e^{-Ah} too, which for a stiff A
    leaves no digit of Q; so both are summed as series over a piece d = h/2^s, |A d| <= 1/2,

        Phi(d) = sum (A d)^k/k!,   Q(d) = sum d^{k+1}/(k+1)! L^k(diag(density)),   L(X) = A X + X A'

    and doubled s times: Q(2d) = Q(d) + Phi(d) Q(d) Phi(d)', Phi(2d) = Phi(d)^2, where all terms are positive
    semidefinite. A (n, n) in 1/s; rows and columns of one scale keep s small.
    """
    piece, halvings = h, 0
    norm = float(np.abs(A).sum(axis=1).max(initial=0.0))
    while norm * piece > PIECE and halvings < MOST_HALVINGS:
        piece, halvings = 0.5 * piece, halvings + 1
    transition = term = np.eye(len(A))
    for k in range(1, TRANSITION_TERMS + 1):
        term = A @ term * (piece / k)
        transition = transition + term
    noise = term = np.diag(density * piece)
    for k in range(1, NOISE_TERMS + 1):
        half = A @ term
        term = (half + half.T) * (piece / (k + 1))
        noise = noise + term
    for _ in range(halvings):
        noise = noise + _symmetric(transition @ noise @ transition.T)
        transition = transition @ transition
    return Interval(transition, noise)


def predict_covariance(covariance: Array, interval: Interval) -> Array:
    """Phi P Phi' + Q, shape (n, n)."""
    return _symmetric(interval.transition @ covariance @ interval.transition.T) + interval.noise


def correct(prior: Gaussian, innovation: Array, C: Array, variance: Array) -> Corrected:
    """The belief after y = h(x) + v, v of variance `variance` (m,), C = dh/dx (m, n), innovation y - h(mean) (m,).

        S = C P C' + R,   K = P C' S^-1,   x+ = x + K (y - h(x)),   P+ = (I - K C) P (I - K C)' + K R K'

    The last is Joseph's form: symmetric and positive semidefinite whatever rounding did to K.

    Raises SingularInnovation.
    """
    P = prior.covariance
    cross = P @ C.T
    S = _symmetric(C @ cross) + np.diag(variance)
    gain = solve_gain(cross, S)
    kept = np.eye(len(P)) - gain @ C
    covariance = _symmetric(kept @ P @ kept.T) + _symmetric(gain * variance @ gain.T)
    return Corrected(Gaussian(prior.mean + gain @ innovation, covariance), gain, S)


def solve_gain(cross: Array, S: Array) -> Array:
    """K = cross S^-1 by the Cholesky factor of S; cross (n, m), S (m, m). Raises SingularInnovation."""
    factor = innovation_root(S)
    return np.asarray(np.linalg.solve(factor.T, np.linalg.solve(factor, cross.T)).T, dtype=np.float64)


def innovation_root(S: Array) -> Array:
    """The Cholesky factor L (m, m), S = L L'. Raises SingularInnovation: a pivot is zero but for rounding."""
    L = np.zeros_like(S)
    for j in range(len(S)):
        pivot = S[j, j] - L[j, :j] @ L[j, :j]
        if not pivot > NEGLIGIBLE * S[j, j]:
            raise SingularInnovation(j)
        L[j, j] = np.sqrt(pivot)
        L[j + 1 :, j] = (S[j + 1 :, j] - L[j + 1 :, :j] @ L[j, :j]) / L[j, j]
    return L


def normalised_square(innovation: Array, S: Array) -> float:
    """v' S^-1 v, which is chi-square of m degrees of freedom where the filter is consistent."""
    whitened = np.linalg.solve(innovation_root(S), innovation)
    return float(whitened @ whitened)


def _symmetric(matrix: Array) -> Array:
    """A product that is symmetric but for the order of its sums, made exactly so."""
    return 0.5 * (matrix + matrix.T)
