"""Values that an SSP gives to parameters, start values and open inputs, as a campaign writes them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from fmus.component import Problem
from fmus.fmu import start_refusal
from fmus.units import Unit, UnitError, parse_unit
from fmus.variable import Variable
from harness.fmusettings import as_signal
from harness.ssp.busunits import BusUnits
from harness.ssp.graph import ElementPath, Graph, Hop, Instance, Node, dotted
from harness.ssp.passage import Passage, convert_number, meaning, table_of_numbers
from harness.ssp.structure import Assignment, Linear, Table, Transformation

Scalars = tuple[float | str, ...]
_NO_UNIT = Unit()


class Starts:
    """Start values by node; what is wrong with one goes to the graph's problems."""

    def __init__(self, graph: Graph, units: BusUnits) -> None:
        self._graph, self._units = graph, units
        self._names: dict[ElementPath, list[str]] = {}
        for path, name in dict.fromkeys((*graph.assigned, *graph.incoming)):
            self._names.setdefault(path, []).append(name)

    def settings(self, instance: Instance) -> dict[str, Any]:
        """What stands under `with` for an FMU: the values given to it, also by connections of parameters."""
        found: dict[str, Any] = {}
        for name in self._names.get(instance.path, ()):
            node, variable = (instance.path, name), instance.facts.owner(name)
            if variable is None:
                continue
            if variable.causality == "input" and variable.on_bus:
                if node in self._graph.assigned and node in self._graph.incoming:
                    self._graph.notes.append(f"the start value of {dotted(node)} is left out: a connection gives it")
                continue
            numbers = self._along(node) if node in self._graph.incoming else self.given(node)
            written = None if numbers is None else self._written(node, variable, numbers)
            if written is not None:
                found[name] = written
        return found

    def given(self, node: Node) -> Scalars | None:
        """The numbers assigned to a node, in its unit (an FMU's variable: the one it declares); None for none."""
        assignment = self._graph.assigned.get(node)
        if assignment is None:
            return None
        inside = node[0] in self._graph.instances
        unit = self._unit(node) if inside else self._units.of(node)
        if inside and unit is None and meaning(assignment.value.unit) is not None:
            self._graph.notes.append(f"{dotted(node)} declares no unit: its value is taken as the number that it is")
        try:
            return _numbers(assignment, unit, self._graph.items(node))
        except ValueError as error:
            self._graph.problems.append(Problem(f"{dotted(node)} {error}", *assignment.value.place))
            return None

    def _unit(self, node: Node) -> Unit | None:
        """The unit of an FMU's variable: declared, else bound to it."""
        declared, bound = self._units.declared(node), self._units.bound(node)
        return declared if declared is not None else None if bound is None else bound.unit

    def _along(self, node: Node) -> Scalars | None:
        """The value that connections of parameters bring to an FMU's parameter: the outermost that is given."""
        route = self._graph.route(node)
        if route is None:
            return None
        if route.source[0] in self._graph.instances:
            message = (
                f"{dotted(node)} is set from {dotted(route.source)}, which an FMU computes: no start value is known"
            )
            self._graph.problems.append(Problem(message, *route.hops[-1].place))
            return None
        numbers = self.given(route.source)
        for hop in route.hops:
            numbers = self.given(hop.target) if numbers is None else self._carried(numbers, hop)
        return numbers

    def _carried(self, numbers: Scalars, hop: Hop) -> Scalars | None:
        unit, wanted = (None, None) if hop.suppressed else (self._units.of(hop.source), self._units.of(hop.target))
        try:
            carried = tuple(_moved(one, unit, wanted, hop.transformation, {}, {}) for one in numbers)
            if hop.target[0] in self._graph.instances:  # the connector's unit may be another than the variable's
                own = self._unit(hop.target)
                carried = tuple(_moved(one, self._units.of(hop.target), own, None, {}, {}) for one in carried)
        except ValueError as error:
            self._graph.problems.append(Problem(f"{dotted(hop.source)} -> {dotted(hop.target)} {error}", *hop.place))
            return None
        return carried

    def open_input(self, node: Node, name: str, variable: Variable) -> dict[str, Any]:
        """The constant source for an FMU's input that nothing is connected to, or for one scalar of it, by its name."""
        given = self.given((node[0], name)) or self.given(node) or variable.start or (0.0,)
        number = given[variable.scalar_names().index(name)] if len(given) == variable.size > 1 else given[0]
        refused = start_refusal(variable, number)
        if refused:
            self._graph.problems.append(Problem(f"{dotted((node[0], name))} {refused}"))
        bound = self._units.bound(node)
        unit = as_signal(variable).unit if bound is None else bound.text
        if variable.kind != "real" or isinstance(number, str):
            return {"use": "source", "unit": "1", "constant": 0 if isinstance(number, str) else round(number)}
        quantity = self._unit(node) or _NO_UNIT
        return {"use": "source", "unit": unit, "constant": _text(number, variable, quantity, unit)}

    def system_input(self, node: Node, target: Node, passage: Passage | None) -> dict[str, Any]:
        """The constant source for an input of a system, in the unit of its connector.

        Where the input is given no value, it is the one that makes the first target start as its FMU does, or 0 where
        `passage`, what becomes of it on its way there, is not known.
        """
        bound, own = self._units.bound(node), self._units.of(node)
        text, unit = ("1", _NO_UNIT) if bound is None else bound
        given = self.given(node)
        variable = self._graph.variable(target)
        number = 0.0
        if given is not None and not isinstance(given[0], str):
            number = convert_number(given[0], own, unit)
        elif variable is not None and variable.start and passage is not None and passage.factor:
            start, wanted = variable.start[0], self._unit(target) or _NO_UNIT
            if not isinstance(start, str):
                same = passage.nothing and wanted == unit
                number = start if same else unit.from_si((wanted.to_si(start) - passage.offset) / passage.factor)
        return {"use": "source", "unit": text, "constant": number_with_unit(number, text)}

    def _written(self, node: Node, variable: Variable, numbers: Scalars) -> Any:
        """The numbers of a variable as a campaign has them; None and a problem where they are none for it."""
        size = 1 if node[1] != variable.name else variable.size
        place = self._graph.assigned[node].value.place if node in self._graph.assigned else ()
        refused = [f"wants {size} values, got {len(numbers)}"] if len(numbers) not in (1, size) else []
        refused += [text for number in numbers if (text := start_refusal(variable, number))]
        if refused:
            self._graph.problems.append(Problem(f"{dotted(node)} {refused[0]}", *place))
            return None
        bound = self._units.bound(node)
        quantity = variable.quantity or (Unit() if bound is None else bound.unit)
        unit = as_signal(variable).unit if bound is None else bound.text
        written = [_text(number, variable, quantity, unit) for number in numbers]
        return written[0] if len(written) == 1 else written


def number_with_unit(number: float, unit: str) -> str | float:
    """A number as a campaign writes it; without a unit where it has none."""
    return number if unit in ("", "1") else f"{number!r} {unit}"


def _text(number: float | str, variable: Variable, quantity: Unit, unit: str) -> Any:
    if isinstance(number, str):
        return number
    if variable.kind == "boolean":
        return bool(number)
    if variable.kind == "integer":
        return round(number)
    known = parse_unit(unit)
    if known == quantity and quantity.from_si(quantity.to_si(number)) == number:
        return number_with_unit(number, unit)
    # In SI, as the number that comes out to the last digit where there is one.
    si = quantity.to_si(number)
    near = (si, math.nextafter(si, math.inf), math.nextafter(si, -math.inf))
    exact = next((one for one in near if quantity.from_si(one) == number), si)
    return number_with_unit(exact, quantity.si_name())


def _numbers(assignment: Assignment, wanted: Unit | None, items: Mapping[str, int]) -> Scalars:
    """The values of an assignment in a unit. Raises ValueError: one is no number where one is wanted, or unfit."""
    value = assignment.value
    unit = None if assignment.suppressed else meaning(value.unit)
    return tuple(
        one
        if value.type == "String"
        else _moved(one, unit, wanted, assignment.transformation, value.items or items, items)
        for one in value.values
    )


def _moved(
    number: float | str,
    unit: Unit | None,
    wanted: Unit | None,
    transformation: Transformation | None,
    source: Mapping[str, int],
    target: Mapping[str, int],
) -> float:
    """A number after conversion of its unit and a transformation; items of enumerations become numbers.

    Raises ValueError: an item is unknown, a table has no entry, or the units do not fit.
    """
    if isinstance(number, str):
        if number not in source:
            raise ValueError(f"wants an item of {', '.join(source) or 'an enumeration that is known'}, got '{number}'")
        number = float(source[number])
    try:
        number = convert_number(number, unit, wanted)
    except UnitError as error:
        raise ValueError(str(error)) from error
    match transformation:
        case Linear(factor, offset):
            return factor * number + offset
        case Table():
            entries = table_of_numbers(transformation, source, target)
            if number not in entries:
                raise ValueError(f"has no entry in its mapping for {number:g}")
            return entries[number]
    return number
