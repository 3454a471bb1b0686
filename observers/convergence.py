"""How far from the truth a hybrid observer can be, and the gains that make it converge fast enough (Prop. 3.3.1).

With zeta the error in the coordinates x/scale, c = n k(F_j), alpha = alpha(F_j), D the dwell time, Delta the
detection delay, and v what drives the error while the plant has moved from j to i and the observer not yet:

    v = [(A_i - A_j) - G_j (C_i - C_j)] x + (B_i - B_j) u + E_i - E_j.

Where the paper does not hold together, and what is computed instead:
- (24) bounds the free error by c e^{alpha t}; (26) and so (20) lose that c. Kept, one interval of dwell gives
  ||zeta(t2')|| <= c e^{alpha (D - Delta)} ||zeta(t1')|| + c V Delta,
  where t2 - t1' may be as short as D - Delta, since the first change may be found late and the second at once.
- (19) has no E_i - E_j, although the driveline's locations differ in it, and bounds every component of x by one X.
- (28) asks for the rate mu outside the ball M_0; at its edge (27) gives no decay at all. The rate holds from a
  larger radius on.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linprog

from fmus.hybrid import Automaton, Transition
from fmus.model import ModelError
from observers.affine import NEGLIGIBLE, error_matrix, overshoot, scaled_location, slowest_gain, spectral_abscissa

Array = NDArray[np.float64]

# Share of the decay demanded over one dwell time that the free error may use up; the rest is for the drive v.
FREE_SHARE = 0.5


class Bound(NamedTuple):
    """Radii of the error in units of the scales, sqrt(sum_i (error_i/scale_i)^2).

    `published` Eq. 20 with V by Eq. 19 as printed; `ball` the corrected invariant ball at the instants a location
    is found; `peak` what the error stays under at all times once in that ball; `rate_radius` the error from which
    on a dwell time shrinks it by e^{-mu D}. `sharp` and `sharp_peak` are `ball` and `peak` with the matrix exponentials
    themselves in place of n k(F) e^{alpha t}, and with a drive that grows from 0 where it vanishes on the guard.
    `drive_published` and `drive` are V by Eq. 19 and component by component, 1/s.
    """

    published: float
    ball: float
    peak: float
    rate_radius: float
    sharp: float
    sharp_peak: float
    drive_published: float
    drive: float


@lru_cache(maxsize=64)
def design_gains(automaton: Automaton, rate: float, dwell: float, delay: float, fastest: float) -> tuple[Array, ...]:
    """Gains G_i (n, p) of the continuous observer, one a location, that give the rate mu = `rate` [1/s].

        n k(F_i) e^{alpha(F_i) (D - Delta)} <= e^{-mu D} / 2

    with the slowest poles of the pattern that do. The half leaves room for the drive v: the rate then holds for
    errors from 2 n k(F) V Delta e^{mu D} on.

    Raises ModelError: `dwell` [s] is not above `delay` [s], or no poles up to `fastest` [1/s] suffice.
    """
    if not 0.0 <= delay < dwell:
        raise ModelError(f"dwell wants a time above the delay {delay:g} s (Proposition 3.3.1), got {dwell:g} s")
    if not rate > 0.0:
        raise ModelError(f"rate wants a value above 0 1/s, got {rate:g}")
    gains = []
    for number, location in enumerate(automaton.locations, start=1):

        def satisfied(gain: Array, index: int = number - 1) -> bool:
            matrix = error_matrix(automaton.locations[index], gain, automaton.scales)
            left = overshoot(matrix) * np.exp(spectral_abscissa(matrix) * (dwell - delay))
            return bool(left <= FREE_SHARE * np.exp(-rate * dwell))

        demand = f"a rate of {rate:g} 1/s with dwell {dwell:g} s and delay {delay:g} s (Proposition 3.3.1)"
        try:
            gains.append(slowest_gain(location, automaton.scales, satisfied, fastest, demand))
        except ModelError as error:
            raise ModelError(f"location {number}: {error}") from error
    return tuple(gains)


def error_bound(
    automaton: Automaton,
    gains: tuple[Array, ...],
    largest_states: tuple[float, ...],
    largest_inputs: tuple[float, ...],
    rate: float,
    dwell: float,
    delay: float,
    guard_speed: float = np.inf,
) -> Bound:
    """The radii the error is proven to stay in, for |x_i| <= `largest_states` (n,), |u| <= `largest_inputs` (m,).

    `guard_speed` bounds |d/dt (normal . x)| where a guard is crossed, in scales per second.
    A radius is infinite where its denominator is not positive. Proposition 3.3.1, corrected as the module says.
    """
    state_bounds, input_bounds = np.array(largest_states), np.array(largest_inputs)
    published = ball = rate_radius = drive_published = drive = 0.0
    slopes, sharp_slopes = [], []
    for number, (location, gain) in enumerate(zip(automaton.locations, gains, strict=True), start=1):
        matrix = error_matrix(location, gain, automaton.scales)
        factor, abscissa = overshoot(matrix), spectral_abscissa(matrix)
        entered = [edge.target for edge in automaton.transitions if edge.source == number]
        if not entered:
            continue
        printed = max(_printed_drive(automaton, gain, number, i, state_bounds, input_bounds) for i in entered)
        drives = {i: _drive(automaton, gain, number, i, state_bounds, input_bounds) for i in entered}
        tight = max(float(np.linalg.norm(one)) for one in drives.values())
        left = factor * np.exp(abscissa * (dwell - delay))
        published = max(published, _ratio(factor * printed * delay, 1.0 - np.exp(abscissa * dwell)))
        ball = max(ball, _ratio(factor * tight * delay, 1.0 - left))
        rate_radius = max(rate_radius, _ratio(factor * tight * delay, np.exp(-rate * dwell) - left))
        drive_published, drive = max(drive_published, printed), max(drive, tight)
        slopes.append((factor, factor * tight * delay))
        sharp_slopes.append(
            _sharp(automaton, gain, number, drives, state_bounds, input_bounds, dwell, delay, guard_speed)
        )
    peak = max((factor * ball + driven for factor, driven in slopes), default=0.0)
    sharp = max((_ratio(driven, 1.0 - left) for _, left, driven in sharp_slopes), default=0.0)
    sharp_peak = max((largest * sharp + driven for largest, _, driven in sharp_slopes), default=0.0)
    return Bound(published, ball, peak, rate_radius, sharp, sharp_peak, drive_published, drive)


def _ratio(above: float, below: float) -> float:
    return above / below if below > 0.0 else np.inf


def _printed_drive(automaton: Automaton, gain: Array, j: int, i: int, x: Array, u: Array) -> float:
    """V of Eq. 19: ||(A_i - A_j) - G_j (C_i - C_j)|| X + ||B_i - B_j|| U, scaled, in the maximum norm."""
    there, here = (scaled_location(automaton.locations[k - 1], automaton.scales) for k in (i, j))
    moved = (there.A - here.A) - (gain / automaton.scales[:, None]) @ (there.C - here.C)
    largest_state = float(np.max(x / automaton.scales))
    return float(
        np.linalg.norm(moved, np.inf) * largest_state
        + np.linalg.norm(there.B - here.B, np.inf) * np.max(u, initial=0.0)
    )


def _drive(automaton: Automaton, gain: Array, j: int, i: int, x: Array, u: Array) -> Array:
    """Largest |v| component by component (n,), over the states of location i within the bounds, and |u| <= U."""
    rows, constants, from_input = _scaled_drive(automaton, gain, j, i)
    leaving = [edge for edge in automaton.transitions if edge.source == i]
    planes = np.array([edge.normal * x for edge in leaving]).reshape(-1, len(x))
    sizes = np.linalg.norm(planes, axis=1)
    outside = np.array([-edge.offset for edge in leaving])
    inside = {"A_ub": planes / sizes[:, None], "b_ub": outside / sizes} if leaving else {}
    largest = np.where(np.any(rows != 0.0, axis=1), 0.0, np.abs(constants) + np.abs(from_input) @ u)
    for index, (row, constant, added) in enumerate(zip(rows, constants, np.abs(from_input) @ u, strict=True)):
        for sign in (1.0, -1.0) if np.any(row) else ():
            found = linprog(-sign * row * x, bounds=[(-1.0, 1.0)] * len(x), **inside)
            if found.status == 0:
                largest[index] = max(largest[index], -found.fun + sign * constant + added)
    return largest


def _scaled_drive(automaton: Automaton, gain: Array, j: int, i: int) -> tuple[Array, Array, Array]:
    """v = rows x + constants + inputs u, scaled: (n, n), (n,), (n, m)."""
    there, here, scales = automaton.locations[i - 1], automaton.locations[j - 1], automaton.scales
    rows = ((there.A - here.A) - gain @ (there.C - here.C)) / scales[:, None]
    return rows, (there.E - here.E) / scales, (there.B - here.B) / scales[:, None]


def _sharp(
    automaton: Automaton,
    gain: Array,
    j: int,
    drives: Mapping[int, Array],
    x: Array,
    u: Array,
    dwell: float,
    delay: float,
    guard_speed: float,
) -> tuple[float, float, float]:
    """max_t ||e^{Ft}||, max_{t >= D - Delta} ||e^{Ft}||, and the largest error that v builds up within Delta.

    Where v = q g(x) with g the guard that was crossed, v begins at 0 and grows no faster than |q| max |g'|. The drive
    is integrated by the trapezoidal rule over |e^{Fs}|, component by component.
    """
    matrix = error_matrix(automaton.locations[j - 1], gain, automaton.scales)
    values, vectors = np.linalg.eig(matrix)
    inverse = np.linalg.inv(vectors)

    def exponentials(times: Array) -> Array:
        return ((vectors * np.exp(times[:, None, None] * values)) @ inverse).real

    slow = -1.0 / spectral_abscissa(matrix)
    norms = np.linalg.norm(exponentials(np.linspace(0.0, 10.0 * slow, 400)), 2, axis=(1, 2))
    late = np.linalg.norm(exponentials(dwell - delay + np.linspace(0.0, 10.0 * slow, 400)), 2, axis=(1, 2))
    times = np.linspace(0.0, delay, 101)
    kernel = np.abs(exponentials(times))
    driven = 0.0
    for edge in automaton.transitions:
        if edge.source != j:
            continue
        growth = _growth(automaton, gain, edge.target, edge, x, u, guard_speed)
        for last in range(1, len(times)):
            drive = np.minimum(drives[edge.target], times[: last + 1, None] * growth)
            pushed = np.einsum("tij,tj->ti", kernel[last::-1], drive)
            driven = max(driven, float(np.linalg.norm(np.trapezoid(pushed, times[: last + 1], axis=0))))
    return float(np.max(norms)), float(np.max(late)), driven


def _growth(
    automaton: Automaton, gain: Array, i: int, edge: Transition, x: Array, u: Array, guard_speed: float
) -> Array:
    """Largest rate of |v| by component (n,), scaled; infinite where v does not vanish on the guard's plane."""
    rows, constants, from_input = _scaled_drive(automaton, gain, edge.source, i)
    normal = edge.normal * automaton.scales
    share = rows * automaton.scales @ normal / (normal @ normal)
    rest = np.linalg.norm(rows * automaton.scales - np.outer(share, normal)) + np.linalg.norm(
        constants - share * edge.offset
    )
    if rest > NEGLIGIBLE * max(float(np.linalg.norm(rows * automaton.scales)), 1.0) or np.any(from_input):
        return np.full(len(x), np.inf)
    location = automaton.locations[i - 1]
    fastest = (
        np.abs(edge.normal @ location.A) @ x
        + np.abs(edge.normal @ location.B) @ u
        + abs(float(edge.normal @ location.E))
    )
    return np.abs(share) * min(fastest, guard_speed * float(np.linalg.norm(normal)))
