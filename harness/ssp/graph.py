"""Nested systems as one flat graph: the FMUs in it, where each connector gets its value from, and what is assigned."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from fmus.component import ConfigurationError, Problem
from fmus.model import unknown
from fmus.variable import Variable
from harness.places import Place
from harness.ssp.facts import Facts, read_facts
from harness.ssp.structure import (
    INWARD,
    OUTWARD,
    Assignment,
    Component,
    Connection,
    Connector,
    DictionaryReference,
    End,
    System,
    Transformation,
)
from harness.ssp.vocabulary import REAL, WHOLE

# The path of an element from the top, and the name of a connector of it. The path of a signal dictionary begins with
# an empty name, which no element has.
ElementPath = tuple[str, ...]
Node = tuple[ElementPath, str]


class Hop(NamedTuple):
    """One connection in the direction in which values flow; indices restrict it to a scalar of an array."""

    source: Node
    source_indices: tuple[int, ...]
    target: Node
    target_indices: tuple[int, ...]
    transformation: Transformation | None
    suppressed: bool
    place: Place


class Route(NamedTuple):
    """The connections that a value takes from where it comes from, the first first."""

    source: Node
    indices: tuple[int, ...]
    hops: tuple[Hop, ...]


@dataclass(frozen=True)
class Instance:
    """An FMU in its place."""

    path: ElementPath
    component: Component
    facts: Facts


@dataclass
class Graph:
    """The flat graph; connectors of the top system have the path ()."""

    instances: dict[ElementPath, Instance] = field(default_factory=dict)
    connectors: dict[Node, Connector] = field(default_factory=dict)
    incoming: dict[Node, list[Hop]] = field(default_factory=dict)
    assigned: dict[Node, Assignment] = field(default_factory=dict)
    problems: list[Problem] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def variable(self, node: Node) -> Variable | None:
        """The variable of an FMU that a node is; None for others."""
        instance = self.instances.get(node[0])
        return None if instance is None else instance.facts.owner(node[1])

    def items(self, node: Node) -> Mapping[str, int]:
        """The items of the enumeration that a node is of: of its FMU's variable, else of its connector."""
        instance, connector = self.instances.get(node[0]), self.connectors.get(node)
        of_fmu = {} if instance is None else instance.facts.items.get(node[1], {})
        return of_fmu or ({} if connector is None else connector.items)

    def route(self, node: Node, indices: tuple[int, ...] = ()) -> Route | None:
        """Where the value of a node comes from; None and a problem where connections go round in a circle."""
        hops: list[Hop] = []
        seen: list[tuple[Node, tuple[int, ...]]] = []
        while True:
            hop = self._entering(node, indices)
            if hop is None or (hops and node[0] in self.instances):
                return Route(node, indices, tuple(reversed(hops)))
            if (node, indices) in seen:
                around = hops[seen.index((node, indices)) :]
                circle = ", ".join(f"{dotted(one.source)} -> {dotted(one.target)}" for one in around)
                self.problems.append(Problem(f"connections go round in a circle: {circle}", *hop.place))
                return None
            seen.append((node, indices))
            hops.append(hop)
            indices = hop.source_indices if hop.target_indices == indices else indices
            node = hop.source

    def _entering(self, node: Node, indices: tuple[int, ...]) -> Hop | None:
        hops = self.incoming.get(node, [])
        exact = [hop for hop in hops if hop.target_indices == indices]
        whole = [hop for hop in hops if hop.target_indices == ()]
        return next(iter((*exact, *whole)), None)


def dotted(node: Node) -> str:
    """A node as messages call it."""
    path, name = node
    return ".".join([*(part for part in path if part), name])


def flatten(system: System) -> Graph:
    """The flat graph of a system. Problems, each with its place, and notes are in it."""
    graph = Graph()
    _enter(graph, system, (), {})
    _assign(graph, system, ())
    return graph


def _enter(graph: Graph, system: System, path: ElementPath, dictionaries: Mapping[str, ElementPath]) -> None:
    """Puts the instances, connectors and connections of a system into the graph, the inner ones first."""
    for name, entries in system.dictionaries.items():
        scope = ("", *path, name)
        dictionaries = {**dictionaries, name: scope}
        graph.connectors.update({(scope, entry): connector for entry, connector in entries.items()})
    graph.connectors.update({(path, name): connector for name, connector in system.connectors.items()})
    facts: dict[Path, Facts] = {}
    for name, element in system.elements.items():
        match element:
            case System():
                _enter(graph, element, (*path, name), dictionaries)
            case Component():
                _enter_component(graph, element, (*path, name), facts)
            case DictionaryReference() if element.dictionary not in dictionaries:
                told = unknown(element.dictionary, dictionaries, "signal dictionary")
                graph.problems.append(Problem(f"{name}: {told}", *element.place))
    for connection in system.connections:
        hop = _hop(graph, system, path, connection, dictionaries)
        if hop is not None:
            _connect(graph, hop)


def _enter_component(graph: Graph, component: Component, path: ElementPath, known: dict[Path, Facts]) -> None:
    try:
        facts = known.get(component.fmu) or read_facts(component.fmu)
    except ConfigurationError as error:
        graph.problems += [Problem(f"{component.name}: {one}", *component.place) for one in error.problems]
        return
    known[component.fmu] = facts
    if component.kind and component.kind not in facts.description.kinds:
        offered = " and ".join(facts.description.kinds)
        message = f"{component.name} is to be run by {component.kind}, its FMU offers {offered}"
        graph.problems.append(Problem(message, *component.place))
    graph.instances[path] = Instance(path, component, facts)
    graph.connectors.update({(path, name): connector for name, connector in component.connectors.items()})
    for name, connector in component.connectors.items():
        if facts.owner(name) is None:
            graph.notes.append(f"{dotted((path, name))} is a connector of no variable of its FMU")
        else:
            wrong = _misfit(connector, facts.owner(name))
            if wrong:
                graph.problems.append(Problem(f"{dotted((path, name))} {wrong}", *connector.place))


def _misfit(connector: Connector, variable: Variable | None) -> str:
    """How a connector contradicts the variable it stands for; empty where it does not."""
    assert variable is not None, "only connectors of variables are held against them"
    families = (REAL, WHOLE, frozenset({"Boolean"}), frozenset({"String"}), frozenset({"Binary"}), frozenset({"Clock"}))
    if connector.type and not any({connector.type, variable.type} <= family for family in families):
        return f"is of the type {connector.type}, its FMU's variable of the type {variable.type}"
    sides = {"input": "input", "output": "output"}
    got = variable.causality
    if connector.kind in sides and got in sides and got != connector.kind:
        return f"is an {connector.kind}, its FMU's variable an {got}"
    return ""


def _connect(graph: Graph, hop: Hop) -> None:
    """Puts a hop into the graph; a problem where another enters its target already."""
    others = graph.incoming.setdefault(hop.target, [])
    for other in others:
        if other.target_indices == hop.target_indices or () in (other.target_indices, hop.target_indices):
            both = f"{dotted(other.source)} and {dotted(hop.source)}"
            graph.problems.append(Problem(f"{dotted(hop.target)} takes one connection, got {both}", *hop.place))
            return
    others.append(hop)


def _hop(
    graph: Graph, system: System, path: ElementPath, connection: Connection, dictionaries: Mapping[str, ElementPath]
) -> Hop | None:
    """A connection with its direction; None and a problem where an end is unknown or no value can flow."""
    start = _end(graph, system, path, connection.start, dictionaries, connection.place)
    end = _end(graph, system, path, connection.end, dictionaries, connection.place)
    if start is None or end is None:
        return None
    flows = (start[1], end[1])
    if flows in (("out", "in"), ("out", "either"), ("either", "in")):
        source, target, ends = start[0], end[0], (connection.start, connection.end)
    elif flows in (("in", "out"), ("either", "out"), ("in", "either")):
        source, target, ends = end[0], start[0], (connection.end, connection.start)
    else:
        kinds = " and ".join(f"{one} ({graph.connectors[node[0]].kind})" for one, node in
                             ((connection.start, start), (connection.end, end)))  # fmt: skip
        message = f"no value flows between {kinds}: one must give what the other takes"
        graph.problems.append(Problem(message, *connection.place))
        return None
    return Hop(
        source,
        ends[0].indices,
        target,
        ends[1].indices,
        connection.transformation,
        connection.suppressed,
        connection.place,
    )


def _end(
    graph: Graph,
    system: System,
    path: ElementPath,
    end: End,
    dictionaries: Mapping[str, ElementPath],
    place: Place,
) -> tuple[Node, str] | None:
    """The node of an end, and whether values come `out` of it there, go `in`, or `either`; None and a problem."""
    if not end.element:
        node, known, turned = (path, end.connector), system.connectors, True
    else:
        element = system.elements.get(end.element)
        if element is None:
            told = unknown(end.element, system.elements, f"element of {system.name}")
            graph.problems.append(Problem(f"connection to {end}: {told}", *place))
            return None
        node, known, turned = ((*path, end.element), end.connector), element.connectors, False
        if isinstance(element, DictionaryReference) and element.dictionary in dictionaries:
            scope = dictionaries[element.dictionary]
            if end.connector in known and (scope, end.connector) not in graph.connectors:
                entries = [name for owner, name in graph.connectors if owner == scope]
                told = unknown(end.connector, entries, f"signal of the dictionary {element.dictionary}")
                graph.problems.append(Problem(f"connection to {end}: {told}", *place))
                return None
            node = (scope, end.connector)
        elif isinstance(element, DictionaryReference):
            return None
    if end.connector not in known:
        told = unknown(end.connector, known, f"connector of {end.element or system.name}")
        graph.problems.append(Problem(f"connection to {end}: {told}", *place))
        return None
    return node, _flow(graph, node, known[end.connector], turned, place)


def _flow(graph: Graph, node: Node, connector: Connector, turned: bool, place: Place) -> str:
    if node[0][:1] != ("",):
        if connector.kind in INWARD | OUTWARD:
            return "out" if (connector.kind in OUTWARD) != turned else "in"
        message = f"{dotted(node)} is of the kind {connector.kind}, which does not say which way values flow"
        graph.problems.append(Problem(message, *place))
    return "either"


def _assign(graph: Graph, system: System, path: ElementPath) -> None:
    """Puts the values given in a system into the graph: inner ones first, so that outer ones stand above them."""
    for name, element in system.elements.items():
        if isinstance(element, System):
            _assign(graph, element, (*path, name))
        elif isinstance(element, Component):
            for one in element.assignments:
                instance = graph.instances.get((*path, name))
                if instance is not None:
                    _put(graph, one, [((*path, name), one.name)] if instance.facts.owner(one.name) else [], name)
    for one in system.assignments:
        _put(graph, one, list(_named(graph, system, path, one.name)), system.name)


def _put(graph: Graph, assignment: Assignment, nodes: list[Node], owner: str) -> None:
    for node in nodes:
        graph.assigned[node] = assignment
    if not nodes:
        place = assignment.value.place
        graph.notes.append(f"{place.file}:{place.line}: {assignment.name} is nothing in {owner}, and is left out")


def _named(graph: Graph, system: System, path: ElementPath, name: str) -> Iterator[Node]:
    """Every connector and variable that has a hierarchical name in a system."""
    if name in system.connectors:
        yield path, name
    for element_name, element in system.elements.items():
        inside, rest = (*path, element_name), name.removeprefix(f"{element_name}.")
        if rest == name:
            continue
        if isinstance(element, System):
            yield from _named(graph, element, inside, rest)
        elif inside in graph.instances and graph.instances[inside].facts.owner(rest) is not None:
            yield inside, rest
