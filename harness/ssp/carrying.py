"""Signals on their way along the connections of an SSP, and the parts that do to them what a wire cannot."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from fmus.component import Kind, Problem
from fmus.units import Unit, UnitError
from fmus.variable import Variable
from harness.ssp.busunits import BusUnits
from harness.ssp.graph import ElementPath, Graph, Hop, Node, Route, dotted
from harness.ssp.passage import Passage, table_of_numbers
from harness.ssp.starts import number_with_unit
from harness.ssp.structure import Linear, Table

_TRANSFORMATIONS = "harness.ssp.transformations"
_NO_UNIT = Unit()


class Carried(NamedTuple):
    """A signal under way: its name in the campaign, and what is still to be done to its values.

    `unit` is the one that the values under that name have, `kind` says what kind of numbers they are.
    """

    text: str
    unit: Unit
    passage: Passage
    kind: Kind

    @property
    def as_it_is(self) -> bool:
        """Whether a wire carries it: nothing is to be done to it."""
        return self.passage.nothing and self.keeps_dimension

    @property
    def keeps_dimension(self) -> bool:
        """Whether what is to be done leaves its dimension."""
        return self.unit.same_dimension(self.passage.unit or _NO_UNIT)

    def as_sensor(self) -> dict[str, Any]:
        """The sensor that does what is to be done, which leaves the dimension."""
        sensor: dict[str, Any] = {"use": "sensor", "of": self.text}
        if self.passage.nothing:
            return sensor
        if self.passage.factor != 1.0:
            sensor["gain"] = self.passage.factor
        if self.passage.offset:
            sensor["bias"] = number_with_unit(self.passage.offset, (self.passage.unit or _NO_UNIT).si_name())
        return sensor


@dataclass
class Names:
    """Names of parts, each given once."""

    taken: set[str] = field(default_factory=set)

    def new(self, wanted: str) -> str:
        """A name like what is wanted, and nobody else's."""
        plain = re.sub(r"\W", "_", wanted, flags=re.ASCII)
        plain = plain if re.match(r"[A-Za-z_]", plain) else f"_{plain}"
        free, number = plain, 2
        while free in self.taken:
            free, number = f"{plain}_{number}", number + 1
        self.taken.add(free)
        return free


@dataclass
class Carrier:
    """Carries signals along routes. `parts` are what connections do to values, made as they are met.

    `parts_of` names the parts of FMUs; those in `shown_alone` are sources and sensors, whose one output has the name of
    the part. Problems go to the graph.
    """

    graph: Graph
    units: BusUnits
    names: Names
    parts_of: Mapping[ElementPath, str]
    shown_alone: frozenset[ElementPath]
    parts: dict[str, dict[str, Any]] = field(default_factory=dict)

    def carried(self, route: Route, target: Node, opening: str, hint: str) -> Carried | None:
        """The signal at the end of a route, or None and a problem where none comes.

        `opening` is what the source of an open input is called, `hint` what parts on the way are called after.
        """
        begun = self._begun(route, opening)
        for hop in route.hops if begun is not None else ():
            try:
                assert begun is not None, "the loop is over nothing otherwise"
                begun = self._hopped(begun, hop, hint)
            except ValueError as error:
                self.tell(f"{dotted(hop.source)} -> {dotted(hop.target)} {error}", (hop,))
                return None
        if begun is None or self.graph.variable(target) is None:
            return begun
        declared, bound, passage = self.units.declared(target), self.units.bound(target), begun.passage
        try:
            if declared is not None and passage.unit is not None:
                passage = passage.converted(declared)
            else:
                passage = passage.read_as(declared if bound is None else bound.unit)
        except UnitError as error:
            self.tell(f"{dotted(target)} {error}", route.hops)
            return None
        return begun._replace(passage=passage)

    def flushed(self, carried: Carried, target: Node, route: Route, hint: str) -> str | None:
        """The name of the signal once all that is to be done to it is done; None and a problem where nothing can."""
        if carried.as_it_is:
            return carried.text
        if _is_whole_array(self.graph.variable(target), route):
            self.tell(f"{dotted(target)} is an array, whose values no part here transforms", route.hops)
            return None
        name = self.names.new(hint)
        if carried.keeps_dimension:
            self.parts[name] = carried.as_sensor()
            return name
        passage = carried.passage
        settings = {
            "factor": passage.factor,
            "offset": passage.offset,
            "from_unit": carried.unit.si_name(),
            "to_unit": (passage.unit or _NO_UNIT).si_name(),
        }
        self.parts[name] = {"use": f"{_TRANSFORMATIONS}:linear", "with": settings, "wires": {"u": carried.text}}
        return name

    def tell(self, message: str, hops: Sequence[Hop]) -> None:
        """Note a problem at the last of some connections."""
        self.graph.problems.append(Problem(message, *(hops[-1].place if hops else ())))

    def _begun(self, route: Route, opening: str) -> Carried | None:
        """The signal at the beginning of a route: of an FMU, or of the source for an open input."""
        path, name = route.source
        unit = self.units.of(route.source)
        if path not in self.graph.instances or not route.hops:
            return Carried(opening, unit or _NO_UNIT, Passage(unit), "real")
        variable = self.graph.variable(route.source)
        if variable is None or variable.causality != "output" or not variable.on_bus:
            self.tell(f"{dotted(route.source)} {_why_off_bus(variable)}", route.hops)
            return None
        index = f"[{','.join(map(str, route.indices))}]" if route.indices else ""
        text = self.parts_of[path] if path in self.shown_alone else f"{self.parts_of[path]}.{name}{index}"
        declared, bound = self.units.declared(route.source), self.units.bound(route.source)
        begun = declared if declared is not None else None if bound is None else bound.unit
        passage = Passage(begun)
        try:
            if unit is not None:
                passage = passage.read_as(unit) if declared is None else passage.converted(unit)
        except UnitError as error:
            self.tell(f"{dotted(route.source)} {error}", route.hops[:1])
            return None
        return Carried(text, begun or _NO_UNIT, passage, variable.kind)

    def _hopped(self, carried: Carried, hop: Hop, hint: str) -> Carried:
        """The signal behind a connection. Raises ValueError: units that do not fit, a table that cannot be."""
        passage, unit = carried.passage, self.units.of(hop.target)
        connector = self.graph.connectors.get(hop.target)
        if connector is not None and connector.clocked:
            raise ValueError("has a value only while a clock ticks, which no wire carries")
        if unit is not None:
            raw = hop.suppressed or passage.unit is None
            passage = passage.read_as(unit) if raw else passage.converted(unit)
        match hop.transformation:
            case Linear():
                passage = passage.transformed(hop.transformation)
            case Table():
                return self._tabled(carried._replace(passage=passage), hop, hop.transformation, hint)
        return carried._replace(passage=passage)

    def _tabled(self, carried: Carried, hop: Hop, table: Table, hint: str) -> Carried:
        """The signal behind a table of values. Raises ValueError: it has no whole numbers, or an item is unknown."""
        kind: Kind = "boolean" if table.kind == "Boolean" else "integer"
        if not carried.as_it_is or (carried.kind == "real" and hop.source[0] in self.graph.instances):
            raise ValueError(f"maps values of the type {table.kind}, and gets real numbers")
        entries = table_of_numbers(table, self.graph.items(hop.source), self.graph.items(hop.target))
        name = self.names.new(hint)
        self.parts[name] = {
            "use": f"{_TRANSFORMATIONS}:table",
            "with": {"entries": {f"{key:g}": int(value) for key, value in entries.items()}, "kind": kind},
            "wires": {"u": carried.text},
        }
        return Carried(name, _NO_UNIT, Passage(None), kind)


def _why_off_bus(variable: Variable | None) -> str:
    if variable is None:
        return "is no variable of its FMU"
    if not variable.on_bus:
        return f"is of the type {variable.type}, or held by a clock, which no wire carries"
    return f"is no output of its FMU, its causality is {variable.causality}: no wire carries it"


def _is_whole_array(variable: Variable | None, route: Route) -> bool:
    return variable is not None and bool(variable.shape) and not (route.hops and route.hops[-1].target_indices)
