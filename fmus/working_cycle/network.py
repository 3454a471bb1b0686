"""Places full of gas, and the restrictions between them: each flow is booked where it leaves and where it enters."""

from __future__ import annotations

from typing import Any

from fmus.working_cycle.contents import Contents, Ledger
from fmus.working_cycle.orifice import Stream, carried, cooled, orifice


class Network:
    """Contents by place, the ledger of what moves between them, and the heat that left [W]."""

    def __init__(self, places: dict[str, Contents], near: Any) -> None:
        self.places, self.ledger, self.heat, self._near = places, Ledger(), 0.0, near

    def passes(self, source: str, target: str, area: Any) -> Any:
        """W [kg/s] through an orifice of an effective area [m2] from the back of `source` to the front of `target`."""
        a, b = self.places[source].back, self.places[target].front
        W = orifice(a, b, area, self._near)
        self.ledger.move(source, target, carried(W, a, b))
        return W

    def cools(self, source: str, target: str, area: Any, effectiveness: Any, coolant: Any) -> Any:
        """W [kg/s] through a cooler of an effective area [m2], an effectiveness and the coolant's temperature [K]."""
        a, b = self.places[source].back, self.places[target].front
        stream = cooled(orifice(a, b, area, self._near), a, b, effectiveness, coolant)
        self.ledger.move(source, target, stream)
        self.heat = self.heat + stream.leaves - stream.enters
        return stream.W

    def drives(self, source: str, target: str, W: Any, power: Any) -> None:
        """Book W [kg/s] through a machine that gives a power [W] to the gas on the way."""
        stream: Stream = carried(W, self.places[source].back, self.places[target].front)
        self.ledger.move(source, target, stream._replace(enters=stream.enters + power))

    def loses(self, place: str, power: Any) -> None:
        """Book heat [W] that a place loses to its walls."""
        self.ledger.gain(place, -power)
        self.heat = self.heat + power
