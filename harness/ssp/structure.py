"""What an SSP says, as read: systems, components, connectors, connections and the values of parameters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, NamedTuple

from fmus.units import Unit
from harness.places import Place

# The type of our own annotations, and the element in them that holds JSON: SSP 1.0 allows no bare text there.
ANNOTATION = "crankbench"
OWN_NAMESPACE = "urn:crankbench"
ANNOTATED = f"{{{OWN_NAMESPACE}}}json"
# A connector's kind, seen from outside of what it belongs to: whether values come out of it, or go in.
OUTWARD = frozenset({"output", "calculatedParameter", "local", "constant"})
INWARD = frozenset({"input", "parameter", "structuralParameter"})


class NamedUnit(NamedTuple):
    """A unit by the name that a document gives it, and what it means; None where the document does not say."""

    name: str
    meaning: Unit | None


@dataclass(frozen=True)
class Linear:
    """target = factor source + offset, after any conversion of units, in the target's unit."""

    factor: float
    offset: float


@dataclass(frozen=True)
class Table:
    """A mapping of values: of booleans and integers as numbers, of enumerations by the names of their items."""

    kind: Literal["Boolean", "Integer", "Enumeration"]
    entries: tuple[tuple[float | str, float | str], ...]


Transformation = Linear | Table


@dataclass(frozen=True)
class Connector:
    """One connector of a component, a system or a signal dictionary; `type` is empty where none is given.

    `sizes` are those of an array's dimensions, 0 where the description leaves one open.
    """

    name: str
    kind: str
    place: Place
    type: str = ""
    unit: NamedUnit | None = None
    items: Mapping[str, int] = field(default_factory=dict)
    sizes: tuple[int, ...] = ()
    clocked: bool = False


class End(NamedTuple):
    """One end of a connection: a connector of an element, or of the system itself where `element` is empty."""

    element: str
    connector: str
    indices: tuple[int, ...] = ()

    def __str__(self) -> str:
        index = f"[{','.join(map(str, self.indices))}]" if self.indices else ""
        return f"{self.element}.{self.connector}{index}" if self.element else f"{self.connector}{index}"


@dataclass(frozen=True)
class Connection:
    """Two connectors joined; which way values flow follows from their kinds."""

    start: End
    end: End
    suppressed: bool
    transformation: Transformation | None
    place: Place


@dataclass(frozen=True)
class Value:
    """The value of a parameter as written: numbers, or text for the types String and Enumeration."""

    type: str
    values: tuple[float | str, ...]
    place: Place
    unit: NamedUnit | None = None
    items: Mapping[str, int] = field(default_factory=dict)


@dataclass(frozen=True)
class Assignment:
    """A value meant for the variable of this name, prefix and mapping applied."""

    name: str
    value: Value
    transformation: Transformation | None = None
    suppressed: bool = False


@dataclass(frozen=True)
class Component:
    """An FMU in a system; `kind` is how it is to be run, empty where that is left open."""

    name: str
    fmu: Path
    source: str
    kind: Literal["", "cs", "me"]
    connectors: Mapping[str, Connector]
    assignments: tuple[Assignment, ...]
    place: Place
    annotation: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class DictionaryReference:
    """A place in a system where the signals of a dictionary can be reached."""

    name: str
    dictionary: str
    connectors: Mapping[str, Connector]
    place: Place


@dataclass(frozen=True)
class System:
    """Elements by name, the connections between them, and the values given to what is inside."""

    name: str
    connectors: Mapping[str, Connector]
    elements: Mapping[str, Component | DictionaryReference | System]
    connections: tuple[Connection, ...]
    dictionaries: Mapping[str, Mapping[str, Connector]]
    assignments: tuple[Assignment, ...]
    place: Place


@dataclass(frozen=True)
class Structure:
    """One system structure description of an SSP: its system, its default experiment [s], what it has besides.

    `step` [s] is what annotations of other tools tell their masters to step by, None where none does.
    `notes` tell of what it says and nothing is made of; `variants` are the other descriptions in the package.
    """

    name: str
    description: str
    version: str
    system: System
    sha256: str
    start: float | None = None
    stop: float | None = None
    step: float | None = None
    annotation: Mapping[str, Any] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    variants: tuple[str, ...] = ()
