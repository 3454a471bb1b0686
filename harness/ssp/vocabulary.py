"""The common content of SSP documents: units, enumerations, types and transformations."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from fmus.units import Unit, UnitError, parse_unit
from harness.places import Place
from harness.ssp.document import NAMESPACES, child, children, local_name
from harness.ssp.structure import Connector, Linear, NamedUnit, Table, Transformation

# The types of the standard, by what a bus of numbers makes of them.
REAL, WHOLE = (
    frozenset({"Real", "Float64", "Float32"}),
    frozenset({"Integer", "Enumeration"} | {f"{sign}Int{bits}" for sign in ("", "U") for bits in (8, 16, 32, 64)}),
)
# A type is in this namespace; a `Clock` of the description's own only refers to one.
_TYPES = frozenset(f"{{{NAMESPACES['ssc']}}}{name}" for name in REAL | WHOLE | {"Boolean", "String", "Binary", "Clock"})
_TABLES = {f"{kind}MappingTransformation": kind for kind in ("Boolean", "Integer", "Enumeration")}
_SAME_FACTOR = 1e-9  # relative: up to this a unit's name means what it means in fmus.units


@dataclass(frozen=True)
class Vocabulary:
    """The units and enumerations that a document defines, and what messages call it."""

    shown: str
    units: Mapping[str, Unit]
    enumerations: Mapping[str, Mapping[str, int]]

    @staticmethod
    def of(root: Any, prefix: str, shown: str) -> Vocabulary:
        """The words of the document under its top element, whose own elements have this prefix."""
        units = {one.get("name"): _unit(one) for one in children(root, f"{prefix}:Units/ssc:Unit")}
        enumerations = {
            one.get("name"): {item.get("name"): int(item.get("value")) for item in children(one, "ssc:Item")}
            for one in children(root, f"{prefix}:Enumerations/ssc:Enumeration")
        }
        return Vocabulary(shown, units, enumerations)

    def place(self, element: Any) -> Place:
        """Where an element of the document stands."""
        return Place(self.shown, element.sourceline or 0)

    def unit(self, name: str | None) -> NamedUnit | None:
        """A unit by name: as the document defines it, else as the name is known; None for no name."""
        if not name:
            return None
        if name in self.units:
            return NamedUnit(name, self.units[name])
        try:
            return NamedUnit(name, parse_unit(name))
        except UnitError:
            return NamedUnit(name, None)

    def connector(self, element: Any, kind: str) -> Connector:
        """A connector, or an entry of a signal dictionary."""
        of_type: Any = next((one for one in element if one.tag in _TYPES), None)
        name = "" if of_type is None else local_name(of_type)
        return Connector(
            name=element.get("name"),
            kind=kind,
            place=self.place(element),
            type=name,
            unit=self.unit(of_type.get("unit")) if of_type is not None else None,
            items=self.enumerations.get(of_type.get("name"), {}) if name == "Enumeration" else {},
            sizes=tuple(int(one.get("size", "0")) for one in children(element, "ssc:Dimension")),
            clocked=child(element, "ssd:Clock") is not None,
        )


def read_transformation(element: Any) -> Transformation | None:
    """The transformation of a connection or of an entry of a mapping; None where there is none."""
    linear = child(element, "ssc:LinearTransformation")
    if linear is not None:
        return Linear(float(linear.get("factor", "1")), float(linear.get("offset", "0")))
    for name, kind in _TABLES.items():
        found = child(element, f"ssc:{name}")
        if found is not None:
            entries = [(one.get("source"), one.get("target")) for one in children(found, "ssc:MapEntry")]
            if kind == "Enumeration":
                return Table("Enumeration", tuple(entries))
            numbers = tuple((read_number(source), read_number(target)) for source, target in entries)
            return Table("Boolean" if kind == "Boolean" else "Integer", numbers)
    return None


def read_number(text: str) -> float:
    """A number or a boolean as XML Schema writes it."""
    return {"true": 1.0, "false": 0.0}[text.strip()] if text.strip() in ("true", "false") else float(text)


def _unit(element: Any) -> Unit:
    """A unit definition; the unit known by its name where that means the same."""
    base: Any = child(element, "ssc:BaseUnit")
    exponents = tuple(int(base.get(name, "0")) for name in ("kg", "m", "s", "A", "K", "mol", "cd", "rad"))
    found = Unit(exponents, float(base.get("factor", "1")), float(base.get("offset", "0")))
    try:
        known = parse_unit(element.get("name"))
    except UnitError:
        return found
    same = found.same_dimension(known) and math.isclose(found.factor, known.factor, rel_tol=_SAME_FACTOR)
    return known if same and math.isclose(found.offset, known.offset, rel_tol=_SAME_FACTOR) else found
