"""What a set of sensors is worth for a subset of states: information without disturbances, error with them.

States count in units of their sizes, sensors in units of their noise, both stated with the result; so the measures are
without unit and balanced. A sensor of standard deviation sigma at each sample of period h carries white noise of
intensity sigma^2 h.

Information. The observability Gramian W of x' = A x with the noise's inverse as weight is the inverse covariance of the
best estimate of the initial state from all of the measurements to come. That of x_1, with x_2 unknown too, is the Schur
complement W_1 = W_11 - W_12 W_22^-1 W_21. Given are its least eigenvalue, log det W_1, and trace W_1^-1. What is wanted
of W_1 would drown in the rounding of W; so factors R with W = R'R are computed, never W: by doubling in the discrete
system that the Cayley transform makes (Penzl, Linear Algebra Appl. 285, 1998; the Gramian is the same), with QR
factorisations. Gramians of sensors add, so each is made once, and factors of a set's sensors are put below each other.
A sensor's own state is unknown too, but it is in no other sensor's equations: its part is eliminated before.

Error. The steady covariance of the Kalman filter at the sampling instants, x(k|k), with white noise on every state, by
the discrete algebraic Riccati equation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag, expm, qr, solve_discrete_are

from fmus.component import Vector
from observers.modes import growing_modes, unseen_modes
from selection.numerical import EPS

# A singular value of R below this share of the largest is rounding: QR factorisations are exact to the precision times
# the size of the matrix, and there are some tens of them.
RESOLVED = 1e3 * EPS
_MOST_DOUBLINGS = 60


class Noise(NamedTuple):
    """Standard deviations of sensors in SI at each sample, the period of samples [s], and what moves the states.

    `process` is the intensity of the white noise on each state, one for all or of shape (n,): the state's deviation
    after a second, of its size, were it left alone; so a covariance of (process size)^2 each second.
    """

    sensors: Vector
    period: float
    process: float | Vector


@dataclass(frozen=True)
class Plant:
    """x' = A x in units of the states' sizes, and the sensors' gradients (s, n) in units of their noise at a sample.

    `time_constants` [s] are those of the sensors; one above 0 adds a state in units of what a sensor's noise is.
    """

    A: Vector
    sensors: Vector
    time_constants: Vector
    noise: Noise


class Information(NamedTuple):
    """Least eigenvalue, logarithm of the determinant and trace of the inverse of W_1; None where `why` says why."""

    least: float | None
    log_det: float | None
    trace_inverse: float | None
    why: str = ""


class Error(NamedTuple):
    """Deviations of the wanted states' estimates in units of their sizes, (n_1,); None where `why` says why."""

    deviations: Vector | None
    why: str = ""

    @property
    def rms(self) -> float | None:
        """The root of their mean square."""
        return None if self.deviations is None else float(np.sqrt(np.mean(self.deviations**2)))


def plant(A: Vector, sensors: Vector, time_constants: Vector, sizes: Vector, noise: Noise) -> Plant:
    """The plant from A and gradients in SI. Raises ValueError: a size or a standard deviation is not above zero."""
    for values, what in ((sizes, "size of a state"), (noise.sensors, "standard deviation of a sensor's noise")):
        if not (np.isfinite(values).all() and (values > 0.0).all()):
            raise ValueError(f"a {what} is {values.min():g}")
    scaled = sensors * sizes / noise.sensors[:, None]
    return Plant(A * sizes / sizes[:, None], scaled, time_constants, noise)


def gramian_factors(plant: Plant) -> Vector:
    """R of each sensor, with its own state eliminated: shape (s, n, n). Raises ValueError: a mode does not die out."""
    growing = growing_modes(plant.A)
    if growing:
        raise ValueError(f"no Gramian over all time: a mode of {growing[0].real:.3g}/s does not die out")
    n = len(plant.A)
    found = np.zeros((len(plant.sensors), n, n))
    for i, tau in enumerate(plant.time_constants):
        A, C = augmented(plant, [i])
        factor = gramian_factor(A, C / np.sqrt(plant.noise.period))
        if tau > 0.0:
            # With the sensor's own state first, the lower right block of R is the factor of the Schur complement.
            order = [n, *range(n)]
            factor = _triangular(factor[:, order], n + 1)[1:, 1:]
        found[i] = factor
    return found


def gramian_factor(A: Vector, C: Vector) -> Vector:
    """R, upper triangular (n, n), with R'R the solution W of A'W + W A + C'C = 0, for A whose modes all die out."""
    n = len(A)
    # Any positive shift does; this one halves the largest and the smallest rate's distance from the unit circle.
    rates = np.abs(np.linalg.eigvals(A).real)
    shift = float(np.sqrt(rates.min() * rates.max()))
    inverse = np.linalg.inv(shift * np.eye(n) - A)
    step = (shift * np.eye(n) + A) @ inverse
    factor = _triangular(np.sqrt(2.0 * shift) * C @ inverse, n)
    for _ in range(_MOST_DOUBLINGS):
        added = factor @ step
        factor = _triangular(np.concatenate([factor, added]), n)
        if np.linalg.norm(added) <= EPS * np.linalg.norm(factor):
            return factor
        step = step @ step
    raise ValueError("the Gramian does not converge")


def _triangular(rows: Vector, n: int) -> Vector:
    factor = np.asarray(np.linalg.qr(rows, mode="r"))
    return np.concatenate([factor, np.zeros((n - len(factor), n))]) if len(factor) < n else factor


def information(factors: Vector, wanted: Sequence[int]) -> Information:
    """What a set knows of the wanted states, from the factors of its sensors, shape (size, n, n)."""
    n = factors.shape[2]
    others = [j for j in range(n) if j not in wanted]
    rows = factors.reshape(-1, n)
    part, size = rows[:, list(wanted)], float(np.linalg.norm(rows))
    if others:
        # What of the wanted columns is at right angles to the others: its square is the Schur complement. Columns that
        # are zero but for rounding, of states that are not seen themselves, take nothing away from it.
        Q, R, _ = qr(rows[:, others], pivoting=True)
        rank = int((np.abs(np.diag(R)) > n * EPS * size).sum())
        part = Q[:, rank:].T @ part
    values = np.linalg.svd(part, compute_uv=False) if len(part) >= len(wanted) else np.zeros(len(wanted))
    if values[-1] <= RESOLVED * size:
        return Information(None, None, None, "information on a state is zero, or less than rounding tells from zero")
    return Information(float(values[-1] ** 2), float(2.0 * np.log(values).sum()), float((1.0 / values**2).sum()))


def augmented(plant: Plant, members: Sequence[int]) -> tuple[Vector, Vector]:
    """A and C of a set with the states of its slow sensors behind the plant's; C in units of noise at a sample."""
    n, slow = len(plant.A), [m for m in members if plant.time_constants[m] > 0.0]
    A = block_diag(plant.A, np.diag([-1.0 / plant.time_constants[m] for m in slow])) if slow else plant.A.copy()
    C = np.zeros((len(members), n + len(slow)))
    for i, m in enumerate(members):
        if m in slow:
            place = n + slow.index(m)
            A[place, :n] = plant.sensors[m] / plant.time_constants[m]
            C[i, place] = 1.0
        else:
            C[i, :n] = plant.sensors[m]
    return A, C


def kalman_error(plant: Plant, members: Sequence[int], wanted: Sequence[int]) -> Error:
    """The steady error of the Kalman filter at the samples of a set of sensors."""
    A, C = augmented(plant, members)
    unseen = unseen_modes(A, C)
    if unseen:
        return Error(None, f"undetectable: a mode of {unseen[0].real:.3g}/s is not seen and does not die out")
    n, period = len(plant.A), plant.noise.period
    intensity = np.zeros((len(A), len(A)))
    intensity[:n, :n] = np.square(plant.noise.process) * np.eye(n)
    F, Q = sampled(A, intensity, period)
    R = np.eye(len(C))
    try:
        before = solve_discrete_are(F.T, C.T, Q, R)
    except np.linalg.LinAlgError as error:
        return Error(None, f"no steady filter: {error}")
    spread = C @ before @ C.T + R
    gain = np.linalg.solve(spread, C @ before).T
    rest = np.eye(len(A)) - gain @ C
    after = rest @ before @ rest.T + gain @ gain.T
    residual = F @ after @ F.T + Q - before
    variances = np.diag(after)[:n]
    # A state that nothing disturbs is known, and rounding leaves something on either side of zero.
    known = np.sqrt(EPS) * np.abs(before).max()
    if not np.abs(residual).max() <= 1e-6 * np.abs(before).max() or variances.min() < -known:
        return Error(None, f"no steady filter: the Riccati equation has a residual of {np.abs(residual).max():.1e}")
    return Error(np.sqrt(np.maximum(variances, 0.0)[list(wanted)]))


def sampled(A: Vector, intensity: Vector, period: float) -> tuple[Vector, Vector]:
    """exp(A h) and the covariance that white noise of this intensity makes in a period h [s].

    Over a part of the period in which no mode goes far by the exponential of one matrix (Van Loan, IEEE TAC 23(3),
    1978), which for the whole would hold the inverse of what dies out; then doubled.
    """
    n = len(A)
    far = 2.0 * float(np.abs(A).sum(axis=0).max()) * period
    doublings = int(np.ceil(np.log2(max(far, 1.0))))
    both = expm(np.block([[-A, intensity], [np.zeros((n, n)), A.T]]) * (period / 2.0**doublings))
    F = both[n:, n:].T
    Q = F @ both[:n, n:]
    for _ in range(doublings):
        Q = Q + F @ Q @ F.T
        F = F @ F
    return F, 0.5 * (Q + Q.T)
