"""The gain that a Kalman filter settles to at an operating point, by the Riccati equation."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_discrete_are

from fmus.model import ModelError
from observers.kalman import Interval, discretise
from observers.modes import mode_name

Array = NDArray[np.float64]

# How close to 1 the modulus of a sampled eigenvalue counts as 1, and to 0 a singular value of matrices whose rows are
# of size 1: above what rounding leaves of an eigenvalue of multiplicity two, the root of 1e-16.
MARGINAL, NONE = 1e-7, 1e-7
TINY = 1e-300


class Stationary(NamedTuple):
    """A filter at rest: gain (n, m), covariance P- before and P+ after a correction (n, n), S (m, m)."""

    gain: Array
    before: Array
    after: Array
    innovation_covariance: Array


def stationary(A: Array, C: Array, density: Array, variance: Array, h: float, states: list[str]) -> Stationary:
    """The filter at rest of x' = A x + w sampled every h [s], y = C x + v, by the discrete Riccati equation

        P- = Phi (P- - P- C' (C P- C' + R)^-1 C P-) Phi' + Q,   K = P- C' (C P- C' + R)^-1

    with Phi, Q of kalman.discretise; w has the spectral density diag(`density`) (n,), v the variance `variance` (m,).
    `states` names the states, for messages.

    Raises ModelError: a mode that does not decay is not seen by y (the pair is not detectable), or is moved by no
    noise, so that a filter never comes to rest.
    """
    interval = discretise(A, density, h)
    deviation = np.sqrt(variance)
    scaled = C / deviation[:, None]
    _require(interval, scaled, h, states)
    try:
        found = solve_discrete_are(interval.transition.T, scaled.T, interval.noise, np.eye(len(variance)))
    except (np.linalg.LinAlgError, ValueError) as error:
        raise ModelError(f"the Riccati equation has no stabilising solution: {error}") from error
    before = np.asarray(found, dtype=np.float64)
    S = scaled @ before @ scaled.T + np.eye(len(variance))
    gain = np.asarray(np.linalg.solve(S, scaled @ before).T, dtype=np.float64)
    left = np.eye(len(A)) - gain @ scaled
    decay = np.abs(np.linalg.eigvals(interval.transition @ left)).max()
    if not decay < 1.0:
        raise ModelError(f"the Riccati equation has no stabilising solution: errors grow by {decay:.12g} a sample")
    after = left @ before @ left.T + gain @ gain.T
    return Stationary(gain / deviation, before, after, S * np.outer(deviation, deviation))


def _require(interval: Interval, C: Array, h: float, states: list[str]) -> None:
    """Nothing where y sees, and the noise moves, every mode that does not decay. Raises ModelError naming the others.

    By the test of Popov, Belevitch and Hautus for each eigenvalue z of Phi of modulus 1 and more: [Phi - z I; C] has
    full column rank, [Phi - z I, Q] full row rank.
    """
    transition, noise = interval
    outputs = C / np.maximum(np.linalg.norm(C, axis=1, keepdims=True), TINY)
    inputs = noise / max(float(np.abs(noise).max(initial=0.0)), TINY)
    unseen: list[str] = []
    unmoved: list[str] = []
    for z in np.linalg.eigvals(transition):
        if abs(z) < 1.0 - MARGINAL or z.imag < 0.0:
            continue
        shifted = transition - z * np.eye(len(transition))
        for test, messages in (
            (np.vstack([shifted, outputs]), unseen),
            (np.hstack([shifted, inputs]).conj().T, unmoved),
        ):
            _, singular, right = np.linalg.svd(test)
            if singular[-1] <= NONE:
                messages.append(mode_name(np.log(complex(z)) / h, right[-1], states))
    if unseen:
        raise ModelError(f"not detectable: the sensors do not see {', nor '.join(dict.fromkeys(unseen))}")
    if unmoved:
        raise ModelError(f"no process noise moves {', nor '.join(dict.fromkeys(unmoved))}: its gain would end at zero")
