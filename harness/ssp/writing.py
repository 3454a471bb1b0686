"""Writes a system structure with its FMUs and parameters as an SSP archive: the same structure gives the same bytes."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from io import BytesIO
from typing import Any, Literal

from lxml import etree

from fmus.units import BASE, Unit
from harness.ssp.document import NAMESPACES, ROOTS
from harness.ssp.package import DEFAULT
from harness.ssp.structure import (
    ANNOTATED,
    ANNOTATION,
    OWN_NAMESPACE,
    Component,
    Connection,
    Connector,
    Linear,
    Structure,
    Value,
)
from harness.ssp.vocabulary import REAL

Version = Literal["1.0", "2.0"]
SET_NAME = "parameters"  # of every component's set: importers that know sets by name find them all under one
_EPOCH = (1980, 1, 1, 0, 0, 0)  # the earliest time a zip can hold
_IMPLEMENTATIONS = {"cs": "CoSimulation", "me": "ModelExchange"}


def write_package(structure: Structure) -> bytes:
    """The archive of a structure whose top system holds components alone, each with `source` in the archive.

    A component's assignments become a parameter set beside its FMU.
    """
    components = [one for one in structure.system.elements.values() if isinstance(one, Component)]
    files = {DEFAULT: _bytes(_description(structure, components))}
    for component in components:
        files[component.source] = component.fmu.read_bytes()
        if component.assignments:
            files[_set_source(component)] = _bytes(_parameter_set(component, structure.version))
    buffer = BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            entry = zipfile.ZipInfo(name, _EPOCH)
            entry.compress_type, entry.external_attr = zipfile.ZIP_DEFLATED, 0o644 << 16
            archive.writestr(entry, content)
    return buffer.getvalue()


def _description(structure: Structure, components: Sequence[Component]) -> Any:
    attributes = {"version": structure.version, "name": structure.name, "description": structure.description}
    root = _root("ssd", attributes)
    system = _add(root, "ssd:System", name=structure.system.name)
    elements = _add(system, "ssd:Elements")
    for component in components:
        _add_component(elements, component)
    if structure.system.connections:
        connections = _add(system, "ssd:Connections")
        for connection in structure.system.connections:
            _add_connection(connections, connection)
    _add_units(root, "ssd", [one.unit for component in components for one in component.connectors.values()])
    experiment = _add(root, "ssd:DefaultExperiment", startTime=structure.start, stopTime=structure.stop)
    assert experiment is not None, "what was added is there"
    _annotate(root, structure.annotation)
    return root


def _add_component(elements: Any, component: Component) -> None:
    made = _add(
        elements,
        "ssd:Component",
        name=component.name,
        type="application/x-fmu-sharedlibrary",
        source=component.source,
        implementation=_IMPLEMENTATIONS.get(component.kind, "any"),
    )
    if component.connectors:
        connectors = _add(made, "ssd:Connectors")
        for connector in component.connectors.values():
            _add_connector(connectors, connector)
    if component.assignments:
        _add(_add(made, "ssd:ParameterBindings"), "ssd:ParameterBinding", source=_set_source(component))
    _annotate(made, component.annotation)


def _add_connector(connectors: Any, connector: Connector) -> None:
    made = _add(connectors, "ssd:Connector", name=connector.name, kind=connector.kind)
    if connector.type:
        _add(made, f"ssc:{connector.type}", unit=None if connector.unit is None else connector.unit.name)
    for size in connector.sizes:
        _add(made, "ssc:Dimension", size=size)


def _add_connection(connections: Any, connection: Connection) -> None:
    attributes: dict[str, Any] = {}
    for side, end in (("start", connection.start), ("end", connection.end)):
        indices = " ".join(map(str, end.indices)) or None
        attributes |= {f"{side}Element": end.element, f"{side}Connector": end.connector, f"{side}Indices": indices}
    if connection.suppressed:
        attributes["suppressUnitConversion"] = "true"
    made = _add(connections, "ssd:Connection", **attributes)
    if isinstance(connection.transformation, Linear):
        _add(made, "ssc:LinearTransformation", **connection.transformation.__dict__)


def _parameter_set(component: Component, of_version: str) -> Any:
    root = _root("ssv", {"version": of_version, "name": SET_NAME})
    parameters = _add(root, "ssv:Parameters")
    for one in component.assignments:
        _add_value(_add(parameters, "ssv:Parameter", name=one.name), one.value)
    _add_units(root, "ssv", [one.value.unit for one in component.assignments])
    return root


def _add_value(parameter: Any, value: Value) -> None:
    unit = None if value.unit is None else value.unit.name
    _add(parameter, f"ssv:{value.type}", value=" ".join(_written(one, value.type) for one in value.values), unit=unit)


def _written(value: float | str, kind: str) -> str:
    """One value of a parameter as XML Schema has it."""
    if isinstance(value, str):
        return value
    if kind == "Boolean":
        return "true" if value else "false"
    return repr(value) if kind in REAL else str(round(value))


def _add_units(root: Any, prefix: str, units: Sequence[Any]) -> None:
    """The definitions of all units named, by name."""
    meanings: dict[str, Unit] = {unit.name: unit.meaning for unit in units if unit is not None}
    if not meanings:
        return
    made = _add(root, f"{prefix}:Units")
    for name, unit in sorted(meanings.items()):
        exponents = {base: power for base, power in zip(BASE, unit.exponents, strict=True) if power}
        scale = {
            key: one for key, one, usual in (("factor", unit.factor, 1.0), ("offset", unit.offset, 0.0)) if one != usual
        }
        _add(_add(made, "ssc:Unit", name=name), "ssc:BaseUnit", **exponents, **scale)


def _annotate(element: Any, annotation: Mapping[str, Any]) -> None:
    if annotation:
        made = _add(_add(element, "ssd:Annotations"), "ssc:Annotation", type=ANNOTATION)
        etree.SubElement(made, ANNOTATED, nsmap={ANNOTATION: OWN_NAMESPACE}).text = json.dumps(annotation)


def _root(prefix: str, attributes: Mapping[str, str]) -> Any:
    names = {name: NAMESPACES[name] for name in (prefix, "ssc")}
    root = etree.Element(f"{{{NAMESPACES[prefix]}}}{ROOTS[prefix]}", nsmap=names)
    for key, text in {**attributes, "generationTool": f"crankbench {version('crankbench')}"}.items():
        if text:
            root.set(key, text)
    return root


def _add(parent: Any, tag: str, /, **attributes: Any) -> Any:
    """An element added to its parent; attributes that are None or empty are left out."""
    prefix, _, local = tag.partition(":")
    made = etree.SubElement(parent, f"{{{NAMESPACES[prefix]}}}{local}")
    for key, value in attributes.items():
        if value is not None and value != "":
            made.set(key, repr(value) if isinstance(value, float) else str(value))
    return made


def _bytes(root: Any) -> bytes:
    return bytes(etree.tostring(root, pretty_print=True, xml_declaration=True, encoding="UTF-8"))


def _set_source(component: Component) -> str:
    return f"resources/{component.name}.ssv"
