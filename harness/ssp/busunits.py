"""The unit of every connector of an SSP's graph: as given, as its FMU declares it, or as what it is joined to says."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from fmus.component import Problem
from fmus.units import Unit, parse_unit, spelling
from harness.ssp.graph import Graph, Node, Route, dotted
from harness.ssp.structure import NamedUnit


class Bound(NamedTuple):
    """A unit as a campaign writes it, and what it means."""

    text: str
    unit: Unit


class BusUnits:
    """Units by node. Where nothing says the unit of an FMU's variable, or of an open input, its connections do.

    A problem goes to the graph where they say several.
    """

    def __init__(self, graph: Graph, routes: Sequence[tuple[Node, Route]]) -> None:
        self._graph = graph
        self._deduced: dict[Node, NamedUnit] = {}
        said: dict[Node, list[NamedUnit]] = {}
        for target, route in routes:
            chain = [route.source, *(hop.target for hop in route.hops)]
            known = [unit for node in chain if (unit := self._firm(node)) is not None]
            for node, nearest in ((route.source, known[:1]), (target, known[-1:])):
                if self._firm(node) is None and self._may_have_one(node):
                    said.setdefault(node, []).extend(nearest)
        for node, units in said.items():
            self._deduce(node, units)

    def of(self, node: Node) -> Unit | None:
        """The unit that a node's number is in; None where it has none, or nothing says it."""
        found = self._firm(node) or self._deduced.get(node)
        return None if found is None else found.meaning

    def declared(self, node: Node) -> Unit | None:
        """The unit that an FMU declares for a variable of real numbers; None for anything else."""
        variable = self._graph.variable(node)
        return variable.quantity if variable is not None and variable.kind == "real" else None

    def bound(self, node: Node) -> Bound | None:
        """The unit to bind to an FMU's variable that declares none, or to give to a source; None where none is known.

        It is the SI unit of the dimension where a campaign has no name for the unit.
        """
        found = self._firm(node) or self._deduced.get(node)
        if found is None or found.meaning is None or self.declared(node) is not None:
            return None
        text = spelling(found.meaning, found.name) or found.meaning.si_name()
        return Bound(text, parse_unit(text))

    def _firm(self, node: Node) -> NamedUnit | None:
        """The unit that a connector gives, else the one its FMU's variable declares, where its meaning is known."""
        connector = self._graph.connectors.get(node)
        if not self._may_have_one(node):
            return None
        if connector is not None and connector.unit is not None and connector.unit.meaning is not None:
            return connector.unit
        declared = self.declared(node)
        variable = self._graph.variable(node)
        return None if declared is None or variable is None else NamedUnit(variable.unit, declared)

    def _may_have_one(self, node: Node) -> bool:
        variable = self._graph.variable(node)
        return variable is None or variable.kind == "real"

    def _deduce(self, node: Node, units: Sequence[NamedUnit]) -> None:
        meanings = {unit.meaning: unit for unit in units}
        if len(meanings) > 1:
            names = " and ".join(unit.name or "1" for unit in meanings.values())
            connector = self._graph.connectors.get(node)
            message = f"{dotted(node)} has no unit, and is joined to {names}: its connector wants a unit"
            self._graph.problems.append(Problem(message, *(connector.place if connector is not None else ())))
        elif units:
            self._deduced[node] = units[0]
