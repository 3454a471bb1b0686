"""What is in each volume, and the ledger of what moves between them: what one loses another gets.

A volume's states are its mass [kg], internal energy [J] and mass of burnt gas [kg], so that what is conserved is a
linear function of the states, which RK4 and RODAS4 conserve to rounding.

Burnt gas is transported in N cells of equal mass m/N, from the volume's front to its back, which share p and T. Cell k
passes on to the next W_k = W_in + k/N (W_out - W_in), so that all masses stay equal; N = 1 is mixed. A step of the
fraction at the front arrives after m/W, spread by sqrt(1/N) of that.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

from fmus.working_cycle.mixture import Gas, gas, gas_constant, temperature
from fmus.working_cycle.orifice import Stream


class Contents(NamedTuple):
    """The gas in a volume as seen at its front and at its back, its mean burnt fraction, and its cells."""

    front: Gas
    back: Gas
    F: Any
    cells: tuple[Any, ...]


def contents(mass: Any, energy: Any, burnt: Iterable[Any], volume: Any) -> Contents:
    """The gas of a volume [m3] with mass [kg], energy [J] and burnt gas by cell [kg]: p = m R T/V, T of u = U/m."""
    masses = list(burnt)
    cells = tuple(len(masses) * cell / mass for cell in masses)
    F = sum(masses[1:], masses[0]) / mass
    T = temperature(energy / mass, F)
    p = mass * gas_constant(F) * T / volume
    front = gas(p, T, cells[0])
    return Contents(front, front if len(cells) == 1 else gas(p, T, cells[-1]), F, cells)


class Ledger:
    """Sums of what goes into each place: at the front or the back, as mass, burnt gas and energy."""

    def __init__(self) -> None:
        self._flows: dict[tuple[str, str], tuple[Any, Any]] = {}
        self._energy: dict[str, Any] = {}

    def move(self, source: str, target: str, stream: Stream) -> None:
        """Book a stream from the back of `source` to the front of `target`."""
        self._add(source, "back", -stream.W, -stream.burnt, -stream.leaves)
        self._add(target, "front", stream.W, stream.burnt, stream.enters)

    def gain(self, place: str, power: Any) -> None:
        """Book a power [W] that comes into a place as heat or work."""
        self._energy[place] = self._energy.get(place, 0.0) + power

    def make(self, place: str, mass: Any, burnt: Any, power: Any) -> None:
        """Book mass and burnt gas [kg/s] that come into being at the front of a place, and the power [W] they bring."""
        self._add(place, "front", mass, burnt, power)

    def _add(self, place: str, end: str, W: Any, burnt: Any, power: Any) -> None:
        before = self._flows.get((place, end), (0.0, 0.0))
        self._flows[place, end] = (before[0] + W, before[1] + burnt)
        self.gain(place, power)

    def mass(self, place: str) -> Any:
        """dm/dt [kg/s]."""
        return self._at(place, "front")[0] + self._at(place, "back")[0]

    def energy(self, place: str) -> Any:
        """dU/dt [W]."""
        return self._energy.get(place, 0.0)

    def burnt(self, place: str, cells: tuple[Any, ...]) -> list[Any]:
        """d/dt of the mass of burnt gas of each cell [kg/s], front first."""
        N = len(cells)
        (W_front, front), (W_back, back) = self._at(place, "front"), self._at(place, "back")
        between = []
        for k in range(1, N):
            W = W_front - k / N * (W_front + W_back)  # both go in
            between.append(W * np.where(W >= 0.0, cells[k - 1], cells[k]))
        into = [front, *between, -back]
        return [into[k] - into[k + 1] for k in range(N)]

    def _at(self, place: str, end: str) -> tuple[Any, Any]:
        return self._flows.get((place, end), (0.0, 0.0))
