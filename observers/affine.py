"""One affine Luenberger observer: gains from a pole pattern, and its exact sampled form."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm
from scipy.signal import place_poles

from fmus.hybrid import Location
from fmus.model import ModelError

Array = NDArray[np.float64]

# Relative size under which a singular value counts as zero: far above rounding, far below any designed quantity.
NEGLIGIBLE = 1e-9
# Fastest poles that a sample time bears, times that sample time: the pattern's real part decays by e^-2 a sample.
FASTEST = 2.0


class Sampled(NamedTuple):
    """x(k) = state x(k-1) + input u + before y(k-1) + now y(k) + constant.

    `state` (n, n), `input` (n, m), `before` and `now` (n, p), `constant` (n,); or the same with leading axes.
    """

    state: Any
    input: Any
    before: Any
    now: Any
    constant: Any


def sample_observer(location: Location, gain: Array, sample_time: float) -> Sampled:
    """The observer x' = (A - G C) x + B u + E + G y over one sample [s], exact for the inputs assumed.

    u is held over (k-1, k], y runs straight from y(k-1) to y(k). With H = A - G C and y = y0 + s (y1 - y0)/h,

        x(h) = e^{Hh} x + int_0^h e^{H(h-s)} (B u + E + G y(s)) ds,

    all of it read off one matrix exponential of the augmented system (Van Loan). `gain` (n, p).
    """
    n, m, p = location.A.shape[0], location.B.shape[1], location.C.shape[0]
    constants = m + 1 + p
    block = np.zeros((n + constants + p, n + constants + p))
    block[:n, :n] = location.A - gain @ location.C
    block[:n, n : n + constants] = np.hstack([location.B, location.E[:, None], gain])
    block[n + m + 1 : n + constants, n + constants :] = np.eye(p)
    transition = expm(block * sample_time)[:n]
    held = transition[:, n + m + 1 : n + constants]
    rising = transition[:, n + constants :] / sample_time
    return Sampled(transition[:, :n], transition[:, n : n + m], held - rising, rising, transition[:, n + m])


def advance(sampled: Sampled, x: Any, u: Any, before: Any, now: Any) -> Any:
    """x(k) of one observer from x(k-1) (n,), u (m,), y(k-1) and y(k) (p,); for numbers and symbols."""
    return sampled.state @ x + sampled.input @ u + sampled.before @ before + sampled.now @ now + sampled.constant


def pole_pattern(order: int) -> NDArray[np.complexfloating[Any, Any]]:
    """Eigenvalues with real part -1, spread along the imaginary axis with spacing 1, shape (order,), complex.

    Only the spectral abscissa enters Eq. 9 and Proposition 3.3.1, so all share it; they are kept apart because
    coincident eigenvalues make the condition number k(H) infinite.
    """
    return -1.0 + 1j * (np.arange(order) - (order - 1) / 2.0)


def scaled_location(location: Location, scales: Array) -> Location:
    """The location in the coordinates x/scales, in which the norm of a state means something."""
    return Location(
        A=location.A * scales / scales[:, None],
        B=location.B / scales[:, None],
        C=location.C * scales,
        E=location.E / scales,
    )


def place(location: Location, scales: Array, abscissa: float) -> Array:
    """The gain G (n, p) that gives A - G C the pole pattern with spectral abscissa `abscissa` < 0 [1/s].

    Raises ModelError: (A, C) is not observable, or the poles found are not those wanted.
    """
    n = len(scales)
    scaled = scaled_location(location, scales)
    require_observable(scaled)
    wanted = -abscissa * pole_pattern(n)
    found = place_poles(scaled.A.T, scaled.C.T, wanted).gain_matrix.T
    got = np.linalg.eigvals(scaled.A - found @ scaled.C)
    error = np.max(np.abs(got[np.argsort(got.imag)] - wanted))
    if not error <= 1e-3 * abs(abscissa):
        raise ModelError(f"poles at {abscissa:.4g} 1/s wanted, missed by {error:.2g}: take slower ones")
    return found * scales[:, None]


def require_observable(location: Location) -> None:
    """Nothing where (A, C) is observable. Raises ModelError naming the mode that y does not see."""
    for mode in np.linalg.eigvals(location.A):
        test = np.vstack([location.A - mode * np.eye(len(location.A)), location.C])
        if np.linalg.svd(test, compute_uv=False)[-1] <= NEGLIGIBLE * np.linalg.norm(test, 2):
            raise ModelError(f"not observable: the mode with eigenvalue {mode:.4g} 1/s does not reach the outputs")


def error_matrix(location: Location, gain: Array, scales: Array) -> Array:
    """H = A - G C in the coordinates x/scales, shape (n, n)."""
    return (location.A - gain @ location.C) * scales / scales[:, None]


def overshoot(matrix: Array) -> float:
    """n k(H) in ||e^{Ht}|| <= n k(H) e^{alpha t} (Proposition 3.1.2); k = ||X|| ||X^-1||, eigenvectors of norm 1."""
    return len(matrix) * float(np.linalg.cond(np.linalg.eig(matrix)[1]))


def fastest_poles(sample_time: float) -> float:
    """The bandwidth that a sample time [s] bears, 1/s. Raises ModelError: the sample time is not positive."""
    if not sample_time > 0.0:
        raise ModelError(f"sample_time wants a value above 0 s, got {sample_time:g}")
    return FASTEST / sample_time


def spectral_abscissa(matrix: Array) -> float:
    """Largest real part of the eigenvalues, 1/s."""
    return float(np.max(np.linalg.eigvals(matrix).real))


def slowest_gain(
    location: Location, scales: Array, satisfied: Callable[[Array], bool], fastest: float, demand: str
) -> Array:
    """The gain (n, p) of the slowest pole pattern that makes `satisfied` true.

    Bisection in the logarithm of the bandwidth, to 0.1 %, between `fastest` [1/s] and a millionth of it: faster poles
    than needed only amplify noise.

    Raises ModelError: not even poles at `fastest` satisfy it; `demand` says in words what was asked for.
    """
    best = place(location, scales, -fastest)
    if not satisfied(best):
        raise ModelError(
            f"{demand} cannot be met with poles up to {fastest:.4g} 1/s, the fastest this sample time bears"
        )
    slow, fast = 1e-6 * fastest, fastest
    while fast > 1.001 * slow:
        middle = float(np.sqrt(slow * fast))
        gain = place(location, scales, -middle)
        if satisfied(gain):
            fast, best = middle, gain
        else:
            slow = middle
    return best
