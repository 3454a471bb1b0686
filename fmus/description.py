"""What an FMU says of itself: variables, units, capabilities, and what stands in the way of running it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal
from xml.etree import ElementTree

from fmus.archive import unpack
from fmus.binary import misfit
from fmus.component import ConfigurationError, Problem
from fmus.modelxml import checked_description
from fmus.toolchain import FMI3_PLATFORMS, library_suffix, native_platform
from fmus.variable import Variable, read_variable

# What becomes of the rules of the standard that a model description breaks: refused, read all the same and told of,
# or not looked for.
Validation = Literal["strict", "warn", "off"]


@dataclass(frozen=True)
class FmuDescription:
    """An FMU unpacked and read, not yet run.

    `kinds` are of `cs`, `me`, `se`. `dependencies` gives for an output the variables it depends on algebraically, and
    lacks an output whose dependencies are undeclared. `reasons` stand in the way of running it here, `cautions` do not:
    rules of the standard it breaks, and what it asks for that is not looked after.
    """

    fmi_version: str
    kinds: tuple[str, ...]
    model_name: str
    tool: str
    token: str = field(repr=False)
    model_identifier: str
    platforms: tuple[str, ...]
    library: Path | None
    folder: Path
    sha256: str
    variables: tuple[Variable, ...] = field(repr=False)
    dependencies: Mapping[str, frozenset[str]] = field(repr=False)
    capabilities: Mapping[str, bool | int | float | str] = field(repr=False)
    log_categories: tuple[str, ...] = ()
    reasons: tuple[str, ...] = ()
    cautions: tuple[str, ...] = ()

    @property
    def runnable(self) -> bool:
        """True when nothing known stands in the way of running it here."""
        return not self.reasons

    def to_json(self) -> dict[str, Any]:
        """The description as `crankbench inspect --json` prints it."""
        return {
            "fmi_version": self.fmi_version,
            "kinds": list(self.kinds),
            "model_name": self.model_name,
            "tool": self.tool,
            "platforms": list(self.platforms),
            "sha256": self.sha256,
            "variables": [_variable_json(variable) for variable in self.variables],
            "capabilities": dict(self.capabilities),
            "runnable": self.runnable,
            "reasons": list(self.reasons),
            "cautions": list(self.cautions),
        }


def describe(path: str | Path, validation: Validation = "warn") -> FmuDescription:
    """What the FMU at `path` says of itself; see FmuDescription.

    A model description that breaks rules of the standard is refused under `strict`; under `warn` it is read all the
    same, and the rules it breaks are `cautions`; under `off` they are not looked for.

    Raises ConfigurationError: the archive is refused, or its model description cannot be read, or is refused.
    """
    unpacked = unpack(path)
    try:
        return _described(unpacked.folder, unpacked.sha256, validation)
    except ConfigurationError as error:
        raise ConfigurationError([Problem(f"{path}: {problem}") for problem in error.problems]) from error


@lru_cache(maxsize=64)
def _described(folder: Path, sha256: str, validation: Validation) -> FmuDescription:
    read, broken = _read(folder, validation)
    relative = _relative_quantities(folder)
    units = {unit.name: unit.baseUnit for unit in read.unitDefinitions}
    variables = tuple(read_variable(v, units, v.name in relative) for v in read.modelVariables)
    interface = read.coSimulation or read.modelExchange or read.scheduledExecution
    if interface is None:
        raise ConfigurationError("the model description names neither Co-Simulation nor Model Exchange")
    identifier = interface.modelIdentifier or ""
    version = int(read.fmiVersion.split(".")[0])
    kinds = [("cs", read.coSimulation), ("me", read.modelExchange), ("se", read.scheduledExecution)]
    library = _library(folder, identifier, version)
    platforms = _platforms(folder, identifier)
    capabilities = _capabilities(interface)
    return FmuDescription(
        fmi_version=read.fmiVersion,
        kinds=tuple(name for name, present in kinds if present is not None),
        model_name=read.modelName or "",
        tool=read.generationTool or "",
        token=read.guid or "",
        model_identifier=identifier,
        platforms=platforms,
        library=library,
        folder=folder,
        sha256=sha256,
        variables=variables,
        dependencies={
            unknown.variable.name: frozenset(v.name for v in unknown.dependencies)
            for unknown in read.outputs
            if unknown.dependencies is not None
        },
        capabilities=capabilities,
        log_categories=tuple(category.name for category in read.logCategories),
        reasons=_reasons(version, read.coSimulation is not None, library, platforms),
        cautions=(*broken, *_cautions(capabilities, variables)),
    )


def _read(folder: Path, validation: Validation) -> tuple[Any, list[str]]:
    """FMPy's model description, and the rules of the standard it breaks where those are looked for."""
    from fmpy.model_description import ValidationError, read_model_description

    checked_description(folder)
    try:
        return read_model_description(folder, validate=validation != "off"), []
    except ValidationError as error:
        broken = [str(problem) for problem in error.problems]
    except SyntaxError as error:
        raise ConfigurationError(f"the model description is not XML: {error}") from error
    except Exception as error:  # FMPy raises plain Exception for a version or a build description it does not take
        broken = [str(error)]
    if validation == "strict":
        raise ConfigurationError([Problem(f"breaks a rule of the standard: {rule}") for rule in broken])
    try:
        return read_model_description(folder, validate=False), broken
    except Exception as error:
        raise ConfigurationError(f"the model description cannot be read: {error}") from error


def _relative_quantities(folder: Path) -> frozenset[str]:
    """Names of the variables that are differences: their unit's offset does not apply. FMPy does not read this."""
    file = folder / "modelDescription.xml"
    if b"relativeQuantity" not in file.read_bytes():
        return frozenset()
    root = ElementTree.parse(file).getroot()
    types: frozenset[str | None] = frozenset()
    for folder_name in ("TypeDefinitions", "ModelVariables"):
        types = frozenset(
            element.get("name")
            for element in root.iterfind(f"{folder_name}/*")
            if any(_is_relative(part, types) for part in (element, *element))
        )
    return frozenset(name for name in types if name is not None)


def _is_relative(element: ElementTree.Element, types: frozenset[str | None]) -> bool:
    """True for what calls itself relative, or says nothing and is declared of a type that is."""
    own = element.get("relativeQuantity")
    return own in ("true", "1") if own is not None else element.get("declaredType") in types - {None}


def _library(folder: Path, identifier: str, version: int) -> Path | None:
    native = native_platform()
    names = [FMI3_PLATFORMS.get(native, native)]
    if version < 3:
        names = [native, *names, *(["darwin64"] if native.endswith("darwin") else [])]
    paths = (folder / "binaries" / name / (identifier + library_suffix()) for name in names)
    return next((path for path in paths if path.is_file()), None)


def _platforms(folder: Path, identifier: str) -> tuple[str, ...]:
    """The binaries' folders that hold a library of the model's name, and `c-code` where sources come with it."""
    binaries = folder / "binaries"
    found = sorted(file.parent.name for file in binaries.glob(f"*/{_escaped(identifier)}.*") if _is_library(file))
    return (*dict.fromkeys(found), *(["c-code"] if any((folder / "sources").glob("*.c")) else []))


def _escaped(name: str) -> str:
    return "".join(f"[{c}]" if c in "*?[" else c for c in name)


def _is_library(file: Path) -> bool:
    return file.suffix in (".so", ".dll", ".dylib")


def _capabilities(interface: Any) -> dict[str, bool | int | float | str]:
    names = sorted(name for name in dir(interface) if not name.startswith("_") and name != "modelIdentifier")
    return {name: value for name in names if (value := getattr(interface, name)) is not None}


def _reasons(version: int, cosimulation: bool, library: Path | None, platforms: tuple[str, ...]) -> tuple[str, ...]:
    reasons = []
    if version not in (2, 3):
        reasons.append(f"it is of FMI {version}.0; 2.0 and 3.0 are run")
    if not cosimulation:
        reasons.append("it offers no Co-Simulation, the only kind that is run")
    if library is None:
        reasons.append(f"it has no binary for {native_platform()}; it has {', '.join(platforms) or 'none'}")
    elif wrong := misfit(library, native_platform()):
        reasons.append(wrong)
    return tuple(reasons)


def _cautions(capabilities: Mapping[str, Any], variables: tuple[Variable, ...]) -> list[str]:
    cautions = []
    if capabilities.get("needsExecutionTool"):
        cautions.append("it says it needs the tool it was made with to run")
    if not capabilities.get("canHandleVariableCommunicationStepSize", True):
        cautions.append("it says every step must have the same length")
    if capabilities.get("canBeInstantiatedOnlyOncePerProcess"):
        cautions.append("it says it can stand only once in a process")
    off_bus = [v.name for v in variables if v.causality in ("input", "output") and not v.on_bus and not v.alias]
    if off_bus:
        cautions.append(f"not on the bus, being no numbers or held by a clock: {', '.join(off_bus)}")
    return cautions


def _variable_json(variable: Variable) -> dict[str, Any]:
    start: Any = list(variable.start) if variable.shape else next(iter(variable.start), None)
    return {
        "name": variable.name,
        "causality": variable.causality,
        "variability": variable.variability,
        "type": variable.type,
        "unit": variable.unit,
        "start": _plain(start),
        "shape": list(variable.shape),
        "description": variable.description,
        "si_unit": "" if variable.quantity is None else variable.quantity.si_name(),
        "minimum": _plain(variable.minimum),
        "maximum": _plain(variable.maximum),
    }


def _plain(value: Any) -> Any:
    """The value with what JSON has no number for (infinity, NaN) written as text."""
    if isinstance(value, list):
        return [_plain(item) for item in value]
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value
