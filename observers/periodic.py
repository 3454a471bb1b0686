"""Observers of periodic inputs in crank angle: the systems, their gains by the paper, and whether they converge.

Chauvin, Petit, Rouchon, Corde: Periodic input observer design, application for imbalance diagnosis, SAE 2006.

The system x' = A x + A0 w, y = C x (Eq. 1) is driven by w = sum_{|k| <= h} c_k e^{i k w0 alpha}, which repeats every
T0 of crank angle, w0 = 2 pi/T0. In crank angle [rad], at the speed omega [rad/s],

    dx/dalpha = (A/omega) x + (A0/omega) w                      where A counts per second,
    dx/dalpha = A x + A0 w                                      where A counts per radian.

With d_k = c_k e^{i k w0 alpha} the reference model (Eq. 3) and the error of the observer (Eq. 5) do not depend on the
angle any more: d_k' = i k w0 d_k, and w = sum d_k. All that is computed here is in z = (x, d_0, Re d_1, Im d_1, ...,
Re d_h, Im d_h), which has n + m (2h + 1) components; w = d_0 + 2 sum_{k >= 1} Re d_k, since w is real.

Over one period the turning ends where it began, so the Floquet multipliers of Eq. 5 are those of z: exp(T0 eig(M)).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm, solve_continuous_lyapunov

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

# Relative size under which a singular value of a frequency response counts as none: far above rounding, and far below
# what could be told from noise.
UNSEEN = 1e-9
# Below which share of a sum's diagonal its last doubling counts as nothing, and how often it is doubled at most.
ENDED, DOUBLINGS = 1e-15, 40


class PeriodicSystem(NamedTuple):
    """x' = A x + A0 w, y = C x with w of period `period` [rad] and harmonics 0 to `harmonics`.

    `A` (n, n), `A0` (n, m), `C` (p, n); they count `per` second or radian of crank angle.
    """

    A: Array
    A0: Array
    C: Array
    period: float
    harmonics: int
    per: Literal["s", "rad"] = "s"

    @property
    def order(self) -> float:
        """w0 = 2 pi/T0, how often w repeats in 2 pi rad: 0.5 for 720 deg."""
        return float(2.0 * np.pi / self.period)

    @property
    def size(self) -> int:
        """Components of z."""
        n, m = self.A0.shape
        return n + m * (2 * self.harmonics + 1)

    def rates(self, omega: float) -> tuple[Array, Array]:
        """A (n, n) and A0 (n, m) in crank angle at the speed `omega` [rad/s], 1/rad."""
        return (self.A / omega, self.A0 / omega) if self.per == "s" else (self.A, self.A0)


class Gains(NamedTuple):
    """L (n, p) and L_k of k = 0 ... h, `harmonics` (h + 1, m, p), complex; L_-k is the conjugate of L_k.

    Of the continuous observer (Eq. 4) they count per radian: L in [x]/[y]/rad, L_k in [w]/[y]/rad. Of a sampled one
    they count per sample: [x]/[y] and [w]/[y].
    """

    state: Array
    harmonics: ComplexArray

    def stacked(self) -> Array:
        """The gain of z, (n + m (2h + 1), p), real."""
        rows = [self.state, self.harmonics[0].real]
        for one in self.harmonics[1:]:
            rows += [one.real, one.imag]
        return np.vstack(rows)

    def times(self, state: float, harmonics: float) -> Gains:
        """L times the one, L_k times the other."""
        return Gains(self.state * state, self.harmonics * harmonics)


def gains_of(stacked: Array, system: PeriodicSystem) -> Gains:
    """The Gains whose `stacked` this is."""
    n, m = system.A0.shape
    parts = np.split(stacked[n:], 2 * system.harmonics + 1)
    complex_ones = [parts[0] + 0j, *(a + 1j * b for a, b in zip(parts[1::2], parts[2::2], strict=True))]
    return Gains(stacked[:n], np.array(complex_ones).reshape(system.harmonics + 1, m, -1))


def responses(system: PeriodicSystem, omega: float) -> ComplexArray:
    """X_k = (i k w0 - A)^-1 A0 for k = 0 ... h, (h + 1, n, m): what x does in step with w = e^{i k w0 alpha}.

    Raises numpy.linalg.LinAlgError: the system itself oscillates so.
    """
    A, A0 = system.rates(omega)
    unit = np.eye(len(A))
    orders = 1j * system.order * np.arange(system.harmonics + 1)
    return np.array([np.linalg.solve(s * unit - A, A0) for s in orders])


def input_row(system: PeriodicSystem) -> Array:
    """H (m, n + m (2h + 1)) of w = H z."""
    n, m = system.A0.shape
    blocks = [
        np.zeros((m, n)),
        np.eye(m),
        *(b for _ in range(system.harmonics) for b in (2 * np.eye(m), np.zeros((m, m)))),
    ]
    return np.hstack(blocks)


def output_row(system: PeriodicSystem) -> Array:
    """(p, n + m (2h + 1)) of y = C x, of z."""
    return np.hstack([system.C, np.zeros((len(system.C), system.size - len(system.A)))])


def internal_model(system: PeriodicSystem, omega: float) -> Array:
    """F of z' = F z, the reference model (Eq. 3) in crank angle, 1/rad."""
    n, m = system.A0.shape
    A, A0 = system.rates(omega)
    F = np.zeros((system.size, system.size))
    F[:n, :n], F[:n, n:] = A, A0 @ input_row(system)[:, n:]
    for k in range(1, system.harmonics + 1):
        re = n + m * (2 * k - 1)
        im, turn = re + m, k * system.order * np.eye(m)
        F[re : re + m, im : im + m], F[im : im + m, re : re + m] = -turn, turn
    return F


def transition(system: PeriodicSystem, omega: float, step: float) -> Array:
    """z(alpha + step) = Phi z(alpha) at a constant speed, exactly; `step` [rad].

    d_k turns by k w0 step. What of x is not in step with d, x - sum X_k d_k, moves by e^{A step} alone.
    """
    n = len(system.A)
    turned = expm(internal_model(system, omega)[n:, n:] * step)
    together, alone = in_step(system, omega), expm(system.rates(omega)[0] * step)
    result = np.zeros((system.size, system.size))
    result[:n, :n], result[:n, n:], result[n:, n:] = alone, together @ turned - alone @ together, turned
    return result


def in_step(system: PeriodicSystem, omega: float) -> Array:
    """X (n, m (2h + 1)) of x = X d, the state that repeats with d = (d_0, Re d_1, Im d_1, ...)."""
    X = responses(system, omega)
    return np.hstack([X[0].real, *(block for one in X[1:] for block in (2 * one.real, -2 * one.imag))])


# Gains by the paper.


def full_measurement_gains(
    A: Array, A0: Array, C: Array, L_tilde: Array, alpha_squared: Sequence[float]
) -> tuple[Array, Array]:
    """L = (A - L~) C^-1 (Eq. 6), L_k = alpha_k^2 A0' P C^-1 (Eq. 7) with P L~ + L~' P = -I (Eq. 8).

    L (n, p) and L_k (h + 1, m, p) in the independent variable in which A and A0 are given: L in 1/unit of it, L_k in
    [w]/[y] per unit of it. `alpha_squared` (h + 1,). The number of L_k is the same in every unit, because A0 counts
    1/unit and P unit: which unit was meant changes the observer.

    Raises ValueError: C is not square, or L~ is not stable.
    """
    n = len(A)
    if C.shape != (n, n):
        raise ValueError(f"gains of full measurement want as many outputs as states, {n}, got {len(C)}")
    if not np.linalg.eigvals(L_tilde).real.max() < 0.0:
        raise ValueError(f"L~ wants eigenvalues in the left half-plane, got {np.linalg.eigvals(L_tilde)}")
    inverse = np.linalg.inv(C)
    P = solve_continuous_lyapunov(L_tilde.T, -np.eye(n))
    return (A - L_tilde) @ inverse, np.array([squared * A0.T @ P @ inverse for squared in alpha_squared])


def partial_measurement_gains(
    A: Array, A0: Array, C: Array, L: Array, orders: Sequence[float], epsilon: float, sign: Literal["minus", "plus"]
) -> ComplexArray:
    """L_k = -+ epsilon beta^2 ((i k w0 - (A - L C))^-1 A0)' C' (Eq. 9), (h + 1, m, p), ' the Hermitian transpose.

    `epsilon` is the product with beta^2, `orders` are k w0 in the independent variable of A. The paper prints the minus
    sign; with its own Eq. 4 the plus sign is what descends. Its P_k has an undefined P in place of A - L C.
    """
    unit, closed = np.eye(len(A)), A - L @ C
    signed = epsilon if sign == "plus" else -epsilon
    return np.array(
        [signed * np.linalg.solve(1j * order * unit - closed, A0).conj().T @ C.T.conj() for order in orders]
    )


# Convergence.


def error_matrix(system: PeriodicSystem, gains: Gains, omega: float) -> Array:
    """M of z~' = M z~, the error of the continuous observer (Eq. 5) in crank angle, 1/rad."""
    return internal_model(system, omega) - gains.stacked() @ output_row(system)


def sampled_error(system: PeriodicSystem, gain: Array, omega: float, step: float) -> Array:
    """z~(k|k) = (I - K C) Phi z~(k-1|k-1): what the sampled observer does to its error in a step of `step` [rad].

    `gain` K (n + m (2h + 1), p), per sample.
    """
    return (np.eye(system.size) - gain @ output_row(system)) @ transition(system, omega, step)


def multipliers(system: PeriodicSystem, gains: Gains, omega: float) -> ComplexArray:
    """Floquet multipliers of Eq. 5 over one period at a constant speed, largest first: exp(T0 eig(M))."""
    return _sorted(np.exp(system.period * np.linalg.eigvals(error_matrix(system, gains, omega))))


def sampled_multipliers(system: PeriodicSystem, gain: Array, omega: float, step: float) -> ComplexArray:
    """Floquet multipliers of the sampled observer over one period at a constant speed, largest first.

    eig((I - K C) Phi)^(T0/step). T0/step may be broken, as on a clock in time: the map does not depend on the angle.
    """
    values = np.linalg.eigvals(sampled_error(system, gain, omega, step)).astype(np.complex128)
    powers = np.zeros_like(values)
    moved = values != 0.0
    powers[moved] = np.exp(np.log(values[moved]) * (system.period / step))
    return _sorted(powers)


def monodromy(
    system: PeriodicSystem, gains_at: Callable[[float], Gains], speed: Callable[[float], float], steps: int = 720
) -> Array:
    """What Eq. 5 does to z~ over one period while the speed [rad/s] varies with the angle [rad] and repeats.

    A product of exponentials of M in the middle of `steps` equal steps: right to the square of the step.
    """
    step = system.period / steps
    result = np.eye(system.size)
    for j in range(steps):
        omega = speed((j + 0.5) * step)
        result = expm(error_matrix(system, gains_at(omega), omega) * step) @ result
    return result


def sampled_monodromy(
    system: PeriodicSystem, gain_at: Callable[[float], Array], speed: Callable[[float], float], step: float
) -> Array:
    """What the sampled observer does to its error over one period while the speed varies with the angle and repeats.

    It takes the mean of the speeds at the two ends of a step, as the component does; the plant is taken to move at
    that speed, too.
    """
    result = np.eye(system.size)
    for j in range(round(system.period / step)):
        omega = 0.5 * (speed(j * step) + speed((j + 1) * step))
        result = sampled_error(system, gain_at(omega), omega, step) @ result
    return result


def variance_gain(maps: Sequence[tuple[Array, Array, Array]]) -> Array:
    """Variance of w in that of white noise on y, stationary, (m,): stages in a row, the one that sees y first.

    `maps` holds of each stage the error's map (N, N), the gain (N, p) and H (m, N). The first stage sees y + v; each
    other one sees the w of the stage before, and so e_j+ = map_j e_j + K_j H_{j-1} e_{j-1}+. Discrete Lyapunov
    equation.
    """
    whole, driven = np.zeros((0, 0)), np.zeros((0, maps[0][1].shape[1]))
    before: Array | None = None
    for moved, gain, row in maps:
        n, N = len(whole), len(moved)
        passed = np.zeros((N, n)) if before is None else gain @ before @ whole
        pushed = -gain if before is None else gain @ before @ driven
        whole = np.block([[whole, np.zeros((n, N))], [passed, moved]])
        driven = np.vstack([driven, pushed])
        before = np.hstack([np.zeros((len(row), n)), row])
    assert before is not None, "asked of one stage or more"
    covariance = summed(whole, driven @ driven.T)
    return np.diag(before @ covariance @ before.T).copy()


def summed(A: Array, Q: Array) -> Array:
    """S = sum_j A^j Q A'^j, which solves S = A S A' + Q, for A with eigenvalues within the unit circle and Q >= 0.

    Summed by doubling, S <- S + A S A', A <- A^2: sums of what is positive semidefinite, in which no unit of a state
    is lost beside that of another.

    Raises ValueError: the sum has no end.
    """
    for _ in range(DOUBLINGS):
        added = A @ Q @ A.T
        Q = Q + added
        A = A @ A
        if not np.isfinite(Q).all():
            break
        if (np.diag(added) <= ENDED * np.diag(Q)).all():
            return Q
    raise ValueError(f"the sum has no end in 2^{DOUBLINGS} terms: A wants eigenvalues within the unit circle")


def unseen_harmonics(system: PeriodicSystem, omega: float) -> list[tuple[int, str]]:
    """The harmonics k that y does not tell apart from none, with the reason.

    G_k = C (i k w0 - A)^-1 A0 wants the rank m, by singular values relative to the largest of |C| |X_k|.
    """
    A, A0 = system.rates(omega)
    unit, found = np.eye(len(A)), []
    for k in range(system.harmonics + 1):
        shifted = 1j * k * system.order * unit - A
        singular = np.linalg.svd(shifted, compute_uv=False)
        if singular[-1] <= UNSEEN * max(singular[0], float(np.finfo(float).tiny)):
            found.append((k, "A has an eigenvalue at i k w0 itself, which cannot be told from the input"))
            continue
        X = np.linalg.solve(shifted, A0)
        response = np.linalg.svd(system.C @ X, compute_uv=False)
        size = np.linalg.norm(system.C, 2) * np.linalg.norm(X, 2)
        rank = int((response > UNSEEN * size).sum())
        if rank < A0.shape[1]:
            found.append((k, f"C (i k w0 - A)^-1 A0 has the rank {rank} in place of {A0.shape[1]}"))
    return found


def _sorted(values: ComplexArray) -> ComplexArray:
    return values[np.argsort(-np.abs(values), kind="stable")]
