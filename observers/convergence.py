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

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linprog

from fmus.hybrid import Automaton
from fmus.model import ModelError
from observers.affine import error_matrix, overshoot, scaled_location, slowest_gain, spectral_abscissa

Array = NDArray[np.float64]

# Share of the decay demanded over one dwell time that the free error may use up; the rest is for the drive v.
FREE_SHARE = 0.5


class Bound(NamedTuple):
    """Radii of the error in units of the scales, sqrt(sum_i (error_i/scale_i)^2).

    `published` Eq. 20 with V by Eq. 19 as printed; `ball` the corrected invariant ball at the instants a location
    is found; `peak` what the error stays under at all times once in that ball; `rate_radius` the error from which
    on a dwell time shrinks it by e^{-mu D}. `drive_published` and `drive` are V by Eq. 19 and component by component, 1/s.
    """

    published: float
    ball: float
    peak: float
    rate_radius: float
    drive_published: float
    drive: float


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
    gains: Sequence[Array],
    state_bounds: Array,
    input_bounds: Array,
    rate: float,
    dwell: float,
    delay: float,
) -> Bound:
    """The radii that the error is proven to stay in, for |x_i| <= `state_bounds` (n,) and |u| <= `input_bounds` (m,).

    A radius is infinite where its denominator is not positive. Proposition 3.3.1, corrected as the module says.
    """
    published = ball = rate_radius = drive_published = drive = 0.0
    slopes = []
    for number, (location, gain) in enumerate(zip(automaton.locations, gains, strict=True), start=1):
        matrix = error_matrix(location, gain, automaton.scales)
        factor, abscissa = overshoot(matrix), spectral_abscissa(matrix)
        entered = [edge.target for edge in automaton.transitions if edge.source == number]
        if not entered:
            continue
        printed = max(_printed_drive(automaton, gain, number, i, state_bounds, input_bounds) for i in entered)
        tight = max(_drive(automaton, gain, number, i, state_bounds, input_bounds) for i in entered)
        left = factor * np.exp(abscissa * (dwell - delay))
        published = max(published, _ratio(factor * printed * delay, 1.0 - np.exp(abscissa * dwell)))
        ball = max(ball, _ratio(factor * tight * delay, 1.0 - left))
        rate_radius = max(rate_radius, _ratio(factor * tight * delay, np.exp(-rate * dwell) - left))
        drive_published, drive = max(drive_published, printed), max(drive, tight)
        slopes.append((factor, factor * tight * delay))
    peak = max((factor * ball + driven for factor, driven in slopes), default=0.0)
    return Bound(published, ball, peak, rate_radius, drive_published, drive)


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


def _drive(automaton: Automaton, gain: Array, j: int, i: int, x: Array, u: Array) -> float:
    """Norm of the largest |v| component by component, over the states of location i within the bounds, and |u| <= U."""
    there, here, scales = automaton.locations[i - 1], automaton.locations[j - 1], automaton.scales
    rows = ((there.A - here.A) - gain @ (there.C - here.C)) / scales[:, None]
    constants = (there.E - here.E) / scales
    from_input = (np.abs(there.B - here.B) / scales[:, None]) @ u
    leaving = [edge for edge in automaton.transitions if edge.source == i]
    inside = {
        "A_ub": np.array([edge.normal for edge in leaving]) if leaving else None,
        "b_ub": np.array([-edge.offset for edge in leaving]) if leaving else None,
    }
    largest = np.zeros(len(scales))
    for index, (row, constant, added) in enumerate(zip(rows, constants, from_input, strict=True)):
        for sign in (1.0, -1.0):
            found = linprog(-sign * row * x, bounds=[(-1.0, 1.0)] * len(x), **_within_box(inside, x))
            if found.status == 0:
                largest[index] = max(largest[index], -found.fun + sign * constant + added)
    return float(np.linalg.norm(largest))


def _within_box(inside: dict[str, Array | None], x: Array) -> dict[str, Array | None]:
    """The half spaces in the coordinates x/bound, each row normalised."""
    if inside["A_ub"] is None:
        return inside
    rows = inside["A_ub"] * x
    size = np.linalg.norm(rows, axis=1)
    return {"A_ub": rows / size[:, None], "b_ub": inside["b_ub"] / size}
