"""Reads parameter sets (SSV) and parameter mappings (SSM) of an SSP."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from fmus.component import Problem
from harness.ssp.document import child, children, local_name
from harness.ssp.references import Content, Document, Told
from harness.ssp.structure import Assignment, Transformation, Value
from harness.ssp.vocabulary import Vocabulary, read_number, read_transformation


class Entry(NamedTuple):
    """What a mapping makes of one parameter."""

    target: str
    transformation: Transformation | None
    suppressed: bool


Mapped = Mapping[str, Sequence[Entry]]


def read_bindings(document: Document, element: Any, fmu: Path | None = None) -> Iterator[Assignment]:
    """The values of all parameter bindings of an element, in order: a later one stands above an earlier one.

    `fmu` is the element's, where it is a component. What is wrong goes to the document's problems.
    """
    told = document.told
    for binding in children(element, "ssd:ParameterBindings/ssd:ParameterBinding"):
        found = document.content(binding, child(binding, "ssd:ParameterValues"), "ssv", fmu)
        mapping = child(binding, "ssd:ParameterMapping")
        mapped = None if mapping is None else document.content(mapping, mapping, "ssm", fmu)
        if found is None or (mapping is not None and mapped is None):
            continue
        entries = None if mapped is None else _read_mapping(mapped, told.problems)
        yield from _read_set(found, binding.get("prefix", ""), entries, told)


def _read_mapping(content: Content, problems: list[Problem]) -> Mapped:
    """The entries of a mapping by the name of the parameter; a problem for each target that is mapped to twice."""
    found: dict[str, list[Entry]] = {}
    taken: dict[str, str] = {}
    for one in children(content.root, "ssm:MappingEntry"):
        source, target = one.get("source"), one.get("target")
        if target in taken:
            message = f"both {taken[target]} and {source} are mapped to {target}: a parameter takes one value"
            problems.append(Problem(message, *content.vocabulary.place(one)))
            continue
        taken[target] = source
        suppressed = one.get("suppressUnitConversion") in ("true", "1")
        found.setdefault(source, []).append(Entry(target, read_transformation(one), suppressed))
    return found


def _read_set(content: Content, prefix: str, mapping: Mapped | None, told: Told) -> Iterator[Assignment]:
    """The values of a set by the names they are meant for: with the prefix, or as the mapping says, all at once.

    Where there is a mapping only what it names is applied; what it names and the set lacks is noted.
    """
    named: set[str] = set()
    for one in children(content.root, "ssv:Parameters/ssv:Parameter"):
        name = prefix + one.get("name")
        named.add(name)
        value = _value(one, content.vocabulary, told.problems)
        if value is None:
            continue
        if mapping is None:
            yield Assignment(name, value)
        else:
            yield from (Assignment(entry.target, value, *entry[1:]) for entry in mapping.get(name, ()))
    told.notes += [
        f"{content.vocabulary.shown}: the mapping names {name}, which is no parameter of the set"
        for name in mapping or ()
        if name not in named
    ]


def _value(element: Any, vocabulary: Vocabulary, problems: list[Problem]) -> Value | None:
    """The value of a parameter; None and a problem where it is none that can be given to an FMU."""
    name = element.get("name")
    (given,) = (one for one in element if local_name(one) != "Annotations")
    kind, place = local_name(given), vocabulary.place(given)
    if kind == "Binary":
        problems.append(Problem(f"{name} is of the type Binary, which no parameter here takes", *place))
        return None
    if kind in ("String", "Enumeration"):
        listed = [one.get("value") for one in children(given, "ssv:Value")]
        texts = listed or [given.get("value", "")]
        items = vocabulary.enumerations.get(given.get("name"), {}) if kind == "Enumeration" else {}
        return Value(kind, tuple(texts), place, items=items)
    numbers = [read_number(text) for text in given.get("value").split()]
    if not numbers or not all(math.isfinite(number) for number in numbers):
        problems.append(Problem(f"{name} wants finite numbers, got '{given.get('value')}'", *place))
        return None
    return Value(kind, tuple(numbers), place, unit=vocabulary.unit(given.get("unit")))
