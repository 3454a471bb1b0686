"""modelDescription.xml and buildDescription.xml of an exported model, for FMI 2.0 and FMI 3.0."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence

from fmus.interface import Interface, Variable
from fmus.units import BASE, parse_unit

GENERATOR = "crankbench"
_TYPES = {2: {"real": "Real", "integer": "Integer", "boolean": "Boolean"},
          3: {"real": "Float64", "integer": "Int32", "boolean": "Boolean"}}  # fmt: skip
_CATEGORIES = ("logStatusWarning", "logStatusDiscard", "logStatusError", "logStatusFatal")


def _number(value: float, kind: str = "real") -> str:
    if kind == "boolean":
        return "true" if value else "false"
    if kind == "integer":
        return str(round(value))
    return repr(float(value))


def _text(root: ET.Element) -> str:
    ET.indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ET.tostring(root, encoding="unicode") + "\n"


def _unit_definitions(root: ET.Element, variables: Sequence[Variable]) -> None:
    definitions = ET.SubElement(root, "UnitDefinitions")
    for name in sorted({variable.unit for variable in variables if variable.kind == "real"}):
        unit = parse_unit(name)
        attributes = {base: str(power) for base, power in zip(BASE, unit.exponents, strict=True) if power}
        if unit.factor != 1.0:
            attributes["factor"] = _number(unit.factor)
        if unit.offset != 0.0:
            attributes["offset"] = _number(unit.offset)
        ET.SubElement(ET.SubElement(definitions, "Unit", name=name), "BaseUnit", attributes)


def _categories(root: ET.Element) -> None:
    categories = ET.SubElement(root, "LogCategories")
    for name in _CATEGORIES:
        ET.SubElement(categories, "Category", name=name)


def _range(variable: Variable) -> dict[str, str]:
    attributes = {}
    if variable.kind == "real":
        attributes["unit"] = variable.unit
        if variable.nominal != 1.0:
            attributes["nominal"] = _number(variable.nominal)
    if variable.kind != "boolean":
        if math.isfinite(variable.minimum):
            attributes["min"] = _number(variable.minimum, variable.kind)
        if math.isfinite(variable.maximum):
            attributes["max"] = _number(variable.maximum, variable.kind)
    return attributes


def _common(variable: Variable) -> dict[str, str]:
    attributes = {"causality": variable.causality, "variability": variable.variability}
    if variable.initial:
        attributes["initial"] = variable.initial
    if variable.description:
        attributes["description"] = variable.description
    return attributes


def _needs_initial_unknown(interface: Interface, reference: int) -> bool:
    variable = interface.variables[reference]
    if variable.causality == "output":
        return variable.initial == "calculated"
    return variable.derivative_of is not None


def fmi2_description(interface: Interface, identifier: str, token: str, version: str) -> str:
    """modelDescription.xml of FMI 2.0 for a native FMU of both kinds, with `identifier` as model identifier."""
    capabilities = {
        "modelIdentifier": identifier,
        "canGetAndSetFMUstate": "true",
        "canSerializeFMUstate": "true",
        "providesDirectionalDerivative": "true",
    }
    stepping = {"canHandleVariableCommunicationStepSize": "true"}
    kinds = {"ModelExchange": capabilities, "CoSimulation": capabilities | stepping}
    return _fmi2(interface, kinds, token, f"{GENERATOR} {version}", ("model.c",))


def python_description(interface: Interface, identifier: str, token: str, version: str) -> str:
    """modelDescription.xml of FMI 2.0 for Co-Simulation with Python inside."""
    capabilities = {
        "modelIdentifier": identifier,
        "needsExecutionTool": "true",
        "canHandleVariableCommunicationStepSize": "true",
    }
    return _fmi2(interface, {"CoSimulation": capabilities}, token, f"{GENERATOR} {version} with PythonFMU", ())


def _fmi2(
    interface: Interface, kinds: Mapping[str, Mapping[str, str]], token: str, tool: str, sources: Sequence[str]
) -> str:
    """The description for the kinds with their capabilities.

    Time is not listed, which FMI 2.0 leaves free and the FMI Library complains of: so a variable's
    index, which counts from 1, is its value reference.
    """
    variables = interface.variables
    root = ET.Element(
        "fmiModelDescription",
        fmiVersion="2.0",
        modelName=interface.model.name,
        guid=token,
        description=interface.model.description,
        generationTool=tool,
        variableNamingConvention="structured",
        numberOfEventIndicators=str(len(interface.block("Z"))),
    )
    for kind, capabilities in kinds.items():
        element = ET.SubElement(root, kind, dict(capabilities))
        if sources:
            listing = ET.SubElement(element, "SourceFiles")
            for name in sources:
                ET.SubElement(listing, "File", name=name)
    _unit_definitions(root, variables)
    _categories(root)
    ET.SubElement(root, "DefaultExperiment", startTime="0.0", stopTime="1.0")
    listed = ET.SubElement(root, "ModelVariables")
    for reference, variable in enumerate(variables[1:], start=1):
        element = ET.SubElement(
            listed, "ScalarVariable", {"name": variable.name, "valueReference": str(reference), **_common(variable)}
        )
        typed = _range(variable)
        if variable.has_start:
            typed["start"] = _number(variable.start, variable.kind)
        if variable.derivative_of is not None:
            typed["derivative"] = str(variable.derivative_of)
        ET.SubElement(element, _TYPES[2][variable.kind], typed)

    structure = ET.SubElement(root, "ModelStructure")
    outputs = [reference for reference, variable in enumerate(variables) if variable.causality == "output"]
    derivatives = list(interface.block("DX"))
    unknowns = [reference for reference in range(len(variables)) if _needs_initial_unknown(interface, reference)]
    for name, references in (("Outputs", outputs), ("Derivatives", derivatives), ("InitialUnknowns", unknowns)):
        if not references:
            continue
        block = ET.SubElement(structure, name)
        for reference in references:
            attributes = {"index": str(reference)}
            known = variables[reference].dependencies
            if name != "InitialUnknowns" and known is not None:
                attributes["dependencies"] = " ".join(str(one) for one in known)
            ET.SubElement(block, "Unknown", attributes)
    return _text(root)


def fmi3_description(interface: Interface, identifier: str, token: str, version: str) -> str:
    """modelDescription.xml of FMI 3.0 for both kinds, with `identifier` as model identifier."""
    variables = interface.variables
    root = ET.Element(
        "fmiModelDescription",
        fmiVersion="3.0",
        modelName=interface.model.name,
        instantiationToken=token,
        description=interface.model.description,
        generationTool=f"{GENERATOR} {version}",
        variableNamingConvention="structured",
    )
    capabilities = {
        "modelIdentifier": identifier,
        "canGetAndSetFMUState": "true",
        "canSerializeFMUState": "true",
        "providesDirectionalDerivatives": "true",
        "providesAdjointDerivatives": "true",
    }
    stepping = {"canHandleVariableCommunicationStepSize": "true", "hasEventMode": "true"}
    ET.SubElement(root, "ModelExchange", capabilities)
    ET.SubElement(root, "CoSimulation", capabilities | stepping)
    _unit_definitions(root, variables)
    _categories(root)
    ET.SubElement(root, "DefaultExperiment", startTime="0.0", stopTime="1.0")
    listed = ET.SubElement(root, "ModelVariables")
    for reference, variable in enumerate(variables):
        attributes = {"name": variable.name, "valueReference": str(reference), **_common(variable), **_range(variable)}
        if variable.has_start:
            attributes["start"] = _number(variable.start, variable.kind)
        if variable.derivative_of is not None:
            attributes["derivative"] = str(variable.derivative_of)
        ET.SubElement(listed, _TYPES[3][variable.kind], attributes)

    structure = ET.SubElement(root, "ModelStructure")
    outputs = [reference for reference, variable in enumerate(variables) if variable.causality == "output"]
    unknowns = [reference for reference in range(len(variables)) if _needs_initial_unknown(interface, reference)]
    for name, references in (
        ("Output", outputs),
        ("ContinuousStateDerivative", interface.block("DX")),
        ("InitialUnknown", unknowns),
        ("EventIndicator", interface.block("Z")),
    ):
        for reference in references:
            attributes = {"valueReference": str(reference)}
            known = variables[reference].dependencies
            if name in ("Output", "ContinuousStateDerivative") and known is not None:
                attributes["dependencies"] = " ".join(str(one) for one in known)
            ET.SubElement(structure, name, attributes)
    return _text(root)


def build_description(identifier: str) -> str:
    """buildDescription.xml of FMI 3.0: one C99 file that includes the others."""
    root = ET.Element("fmiBuildDescription", fmiVersion="3.0")
    configuration = ET.SubElement(root, "BuildConfiguration", modelIdentifier=identifier)
    sources = ET.SubElement(configuration, "SourceFileSet", language="C99", compilerOptions="-fno-math-errno")
    ET.SubElement(sources, "SourceFile", name="model.c")
    ET.SubElement(configuration, "Library", name="m", description="C mathematics library, where it is separate")
    return _text(root)
