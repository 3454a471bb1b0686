"""Which dynamics does the plant obey? A bank of residual generators, one for each distinguishable signature."""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fmus.hybrid import Automaton, Location
from fmus.model import ModelError
from observers.affine import (
    NEGLIGIBLE,
    error_matrix,
    overshoot,
    scaled_location,
    slowest_gain,
    spectral_abscissa,
)

Array = NDArray[np.float64]


class Signature(NamedTuple):
    """Locations that no residual can tell apart, and the generator they share.

    `locations` numbers, ascending; `location` the dynamics of the last of them; `gain` L (n, p);
    `bound` the spectral abscissa that Eq. 9 asks for, and `abscissa` the one it has, 1/s.
    """

    locations: tuple[int, ...]
    location: Location
    gain: Array
    bound: float
    abscissa: float


def signature_classes(automaton: Automaton) -> tuple[tuple[int, ...], ...]:
    """Location numbers grouped by what residuals can distinguish.

    Two locations with equal A, B, C differ by E_i - E_j at most. If a v with A v = E_i - E_j and C v = 0 exists,
    then x + v obeys the one location's equations where x obeys the other's, with the same u and y: no function of
    u and y tells them apart, whatever the initial state. With H = A - L C this is v = H^-1 (E_i - E_j),
    C H^-1 (E_i - E_j) = 0, for every L that makes H regular. The residual of their shared generator then vanishes in
    both, and its z differs from x by v in all but the one it is built on. Otherwise the residual settles at
    C H^-1 (E_i - E_j) /= 0 and each gets a generator of its own.
    """
    classes: list[list[int]] = []
    for number, location in enumerate(automaton.locations, start=1):
        for members in classes:
            if _indistinguishable(automaton.locations[members[0] - 1], location, automaton.scales):
                members.append(number)
                break
        else:
            classes.append([number])
    return tuple(tuple(members) for members in classes)


def _indistinguishable(one: Location, other: Location, scales: Array) -> bool:
    a, b = scaled_location(one, scales), scaled_location(other, scales)
    for left, right in ((a.A, b.A), (a.B, b.B), (a.C, b.C)):
        if np.linalg.norm(left - right) > NEGLIGIBLE * np.linalg.norm(left):
            return False
    step = a.E - b.E
    both = np.vstack([a.A, a.C])
    shift = np.linalg.lstsq(both, np.concatenate([step, np.zeros(len(a.C))]), rcond=None)[0]
    missed = np.linalg.norm(a.A @ shift - step) + np.linalg.norm(a.C @ shift)
    return bool(missed <= NEGLIGIBLE * max(float(np.linalg.norm(step)), 1.0))


@lru_cache(maxsize=64)
def design_signatures(
    automaton: Automaton, delay: float, threshold: tuple[float, ...], entry_error: float, fastest: float
) -> tuple[Signature, ...]:
    """The generators whose own residual is within the threshold a time `delay` [s] after their location is entered.

        alpha(H) <= -(1/delay) log(n ||C|| k(H) Z0/eps)                    (Eq. 9)

    Norms are taken in the coordinates x/scale and r/eps, so Z0 = `entry_error` counts in scales and `threshold`
    eps (p,) is in the outputs' units. Of all poles of the pattern the slowest that do are taken.

    Raises ModelError: a demand that is not positive or cannot be met with poles up to `fastest` [1/s].
    """
    for name, value in (("delay", delay), ("entry_error", entry_error), ("threshold", min(threshold))):
        if not value > 0.0:
            raise ModelError(f"{name} wants a value above 0, got {value:g}")
    signatures = []
    for members in signature_classes(automaton):
        location = automaton.locations[members[-1] - 1]

        def bound(gain: Array, location: Location = location) -> float:
            return settling_abscissa(location, gain, automaton.scales, delay, threshold, entry_error)

        def satisfied(gain: Array, location: Location = location) -> bool:
            return spectral_abscissa(error_matrix(location, gain, automaton.scales)) <= bound(gain, location)

        limits = ", ".join(f"{limit:g}" for limit in threshold)
        demand = f"a delay of {delay:g} s with threshold {limits} and entry error {entry_error:g} (Eq. 9)"
        try:
            gain = slowest_gain(location, automaton.scales, satisfied, fastest, demand)
        except ModelError as error:
            raise ModelError(f"location {members[-1]}: {error}") from error
        achieved = spectral_abscissa(error_matrix(location, gain, automaton.scales))
        signatures.append(Signature(members, location, gain, bound(gain), achieved))
    return tuple(signatures)


def settling_abscissa(
    location: Location, gain: Array, scales: Array, delay: float, threshold: tuple[float, ...], entry_error: float
) -> float:
    """Right-hand side of Eq. 9 for one generator, 1/s."""
    matrix = error_matrix(location, gain, scales)
    output_norm = float(np.linalg.norm(location.C * scales / np.array(threshold)[:, None], 2))
    return -np.log(output_norm * overshoot(matrix) * entry_error) / delay


def residual(signature_output: Any, z: Any, y: Any) -> Any:
    """r_j = C_j z_j - y (Eq. 7), shape (p,); `signature_output` is C_j."""
    return signature_output @ z - y


def within(r: Any, threshold: Any) -> Any:
    """1 where every |r| <= eps, else 0 (Eq. 8); r and threshold (p,)."""
    inside: Any = 1.0
    for value, limit in zip(r, threshold, strict=True):
        inside = inside * np.where(np.abs(value) <= limit, 1.0, 0.0)
    return inside


def persist(decided: Any, doubted: Any, seen: Any, persistence: Any) -> tuple[Any, Any]:
    """Decision and count of samples against it, after a sample that looks like `seen` (0 or 1).

    The decision turns once `persistence` samples in a row contradict it; 1 is the paper's Eq. 8, at once.
    """
    doubted = np.where(np.abs(seen - decided) > 0.5, doubted + 1.0, 0.0)
    turns = doubted >= persistence
    return np.where(turns, 1.0 - decided, decided), np.where(turns, 0.0, doubted)
