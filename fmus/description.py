"""What an FMU says of itself: variables, units, capabilities, and what stands in the way of running it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal
from xml.etree import ElementTree

from fmus.archive import unpack
from fmus.binary import misfit
from fmus.clocks import Clock
from fmus.component import ConfigurationError, Problem
from fmus.exchange import solver_missing
from fmus.library import missing_libraries
from fmus.modelxml import checked_description
from fmus.sources import Build, SourceSet
from fmus.toolchain import FMI3_PLATFORMS, library_suffix, native_platform
from fmus.variable import Variable, read_variable

# What becomes of the rules of the standard that a model description breaks: refused, read all the same and told of,
# or not looked for.
Validation = Literal["strict", "warn", "off"]

_ELEMENTS = {"cs": "CoSimulation", "me": "ModelExchange", "se": "ScheduledExecution"}
# Co-Simulation, Model Exchange, Scheduled Execution.
FmuKind = Literal["cs", "me", "se"]


@dataclass(frozen=True)
class Interface:
    """One kind in which an FMU may be run: the library that has it, how it is built, and what stands in its way."""

    identifier: str
    platforms: tuple[str, ...]
    library: Path | None
    build: Build | None
    capabilities: Mapping[str, bool | int | float | str]
    reasons: tuple[str, ...]
    cautions: tuple[str, ...]


@dataclass(frozen=True)
class FmuDescription:
    """An FMU unpacked and read, not yet run.

    `kinds` are those it offers; it is run as `kind`, Co-Simulation where it offers that, and `run_as` gives another.
    The library, the capabilities and what stands in the way are those of that kind. A library that is None is built
    from sources where there is a `build`. `states` and `indicators` count Model Exchange's. `dependencies` gives for an
    output the variables it depends on algebraically, and lacks an output whose dependencies are undeclared. `reasons`
    stand in the way of running it here, `cautions` do not: rules of the standard it breaks, and what it asks for that
    is not looked after.
    """

    fmi_version: str
    kinds: tuple[FmuKind, ...]
    kind: FmuKind
    model_name: str
    tool: str
    token: str = field(repr=False)
    model_identifier: str
    platforms: tuple[str, ...]
    library: Path | None
    build: Build | None = field(repr=False)
    folder: Path
    sha256: str
    interfaces: Mapping[FmuKind, Interface] = field(repr=False)
    states: int
    indicators: int
    clocks: tuple[Clock, ...] = field(repr=False)
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

    @property
    def event_mode(self) -> bool:
        """True where Co-Simulation is to hand over at events: it can, and has clocks, which only tick there."""
        return self.kind == "cs" and bool(self.capabilities.get("hasEventMode")) and bool(self.clocks)

    def run_as(self, kind: FmuKind) -> FmuDescription:
        """The description of the same FMU run in that kind. Raises ConfigurationError: it does not offer it."""
        if kind not in self.interfaces:
            raise ConfigurationError(f"it offers {' and '.join(self.kinds)}, not {kind}")
        chosen = self.interfaces[kind]
        general = [text for text in self.cautions if text not in self.interfaces[self.kind].cautions]
        return replace(
            self,
            kind=kind,
            model_identifier=chosen.identifier,
            platforms=chosen.platforms,
            library=chosen.library,
            build=chosen.build,
            capabilities=chosen.capabilities,
            reasons=chosen.reasons,
            cautions=(*general, *chosen.cautions),
        )

    def restructured(self, sizes: Mapping[str, float]) -> FmuDescription:
        """The description with arrays sized as these values of structural parameters say.

        An array of another size than before has start values where the FMU gives one for all its places.
        """
        known = {v.name: int(v.start[0]) for v in self.variables if v.structural and v.start and not v.shape}
        given = {name: round(value) for name, value in sizes.items() if name in known}
        if not given:
            return self
        return replace(self, variables=tuple(_resized(v, {**known, **given}) for v in self.variables))

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
    version = int(read.fmiVersion.split(".")[0])
    kinds: dict[FmuKind, Any] = {"cs": read.coSimulation, "me": read.modelExchange, "se": read.scheduledExecution}
    offered = {kind: interface for kind, interface in kinds.items() if interface is not None}
    if not offered:
        raise ConfigurationError("the model description names neither Co-Simulation nor Model Exchange")
    if version == 1:
        capabilities = _capabilities_of_fmi1(folder)
    clocks = _clocks(folder) if version == 3 else ()
    builds = {build.identifier: build for build in _builds(read)}
    interfaces: dict[FmuKind, Interface] = {}
    for kind, interface in offered.items():
        identifier = interface.modelIdentifier or ""
        library, platforms = _library(folder, identifier, version), _platforms(folder, identifier)
        if version > 1:
            capabilities = _capabilities(interface)
        if version == 3:
            capabilities["providesDirectionalDerivative"] = _gives_derivatives(folder, kind)
        build = builds.get(identifier)
        interfaces[kind] = Interface(
            identifier,
            platforms,
            library,
            build,
            capabilities,
            (*_reasons(kind, library, platforms, build, folder), *_clock_reasons(kind, capabilities, clocks)),
            (*_cautions(kind, capabilities, variables), *_clock_cautions(clocks)),
        )
    chosen_kind = next(iter(interfaces))
    chosen = interfaces[chosen_kind]
    return FmuDescription(
        fmi_version=read.fmiVersion,
        kinds=tuple(interfaces),
        kind=chosen_kind,
        model_name=read.modelName or "",
        tool=read.generationTool or "",
        token=read.guid or "",
        model_identifier=chosen.identifier,
        platforms=chosen.platforms,
        library=chosen.library,
        build=chosen.build,
        folder=folder,
        sha256=sha256,
        interfaces=interfaces,
        states=read.numberOfContinuousStates,
        indicators=read.numberOfEventIndicators,
        clocks=clocks,
        variables=variables,
        dependencies={
            unknown.variable.name: frozenset(v.name for v in unknown.dependencies)
            for unknown in read.outputs
            if unknown.dependencies is not None
        },
        capabilities=chosen.capabilities,
        log_categories=tuple(category.name for category in read.logCategories),
        reasons=chosen.reasons,
        cautions=(*broken, *chosen.cautions),
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


def _resized(variable: Variable, sizes: Mapping[str, int]) -> Variable:
    shape = tuple(sizes[size] if isinstance(size, str) else size for size in variable.dimensions)
    if shape == variable.shape:
        return variable
    start = variable.start[:1] * math.prod(shape) if len(set(variable.start)) == 1 else ()
    return replace(variable, shape=shape, start=start)


def _capabilities_of_fmi1(folder: Path) -> dict[str, bool | int | float | str]:
    """What a Co-Simulation FMU of FMI 1 says it can; FMPy does not read this."""
    root = ElementTree.parse(folder / "modelDescription.xml").getroot()
    implementation = root.find("Implementation")
    found: dict[str, bool | int | float | str] = {}
    for element in () if implementation is None else implementation.iter("Capabilities"):
        for name, text in element.items():
            found[name] = text in ("true", "1") if name.startswith("can") else text
    if implementation is not None:
        found["needsExecutionTool"] = implementation.find("CoSimulation_Tool") is not None
    return found


def _clocks(folder: Path) -> tuple[Clock, ...]:
    """The clocks of an FMU of FMI 3, with their periods; FMPy does not read those."""
    file = folder / "modelDescription.xml"
    if b"<Clock" not in file.read_bytes():
        return ()
    found = []
    for element in ElementTree.parse(file).getroot().iterfind("ModelVariables/Clock"):
        resolution = _number(element, "resolution")
        interval, shift = _number(element, "intervalDecimal"), _number(element, "shiftDecimal")
        if interval is None and resolution:
            interval, shift = _number(element, "intervalCounter"), _number(element, "shiftCounter")
            interval, shift = None if interval is None else interval / resolution, (shift or 0.0) / resolution
        found.append(
            Clock(
                element.get("name", ""),
                int(element.get("valueReference", "0")),
                element.get("causality", "local"),
                element.get("intervalVariability", ""),
                interval,
                shift or 0.0,
            )
        )
    return tuple(found)


def _number(element: ElementTree.Element, name: str) -> float | None:
    try:
        return float(element.get(name, ""))
    except ValueError:
        return None


def _clock_reasons(kind: FmuKind, capabilities: Mapping[str, Any], clocks: tuple[Clock, ...]) -> tuple[str, ...]:
    reasons = [clock.refusal for clock in clocks if clock.refusal]
    if kind == "cs" and any(clock.ticked for clock in clocks) and not capabilities.get("hasEventMode"):
        reasons.append("it has clocks that want ticks, but no event mode to tick them in")
    return tuple(reasons)


def _clock_cautions(clocks: tuple[Clock, ...]) -> tuple[str, ...]:
    still = [clock.name for clock in clocks if clock.causality == "input" and clock.variability == "triggered"]
    return (f"its triggered clocks are never ticked: {', '.join(still)}",) if still else ()


def _builds(read: Any) -> list[Build]:
    """What FMPy read of how the FMU is built from sources."""
    return [
        Build(
            configuration.modelIdentifier or "",
            tuple(
                SourceSet(
                    tuple(part.sourceFiles),
                    tuple((d.name, d.value or "") for d in part.preprocessorDefinitions if not d.optional),
                    tuple(part.includeDirectories),
                    part.language or "",
                )
                for part in configuration.sourceFileSets
            ),
        )
        for configuration in read.buildConfigurations or ()
    ]


def _gives_derivatives(folder: Path, kind: FmuKind) -> bool:
    """Whether an FMI 3 FMU says it gives directional derivatives: FMPy looks for the attribute of FMI 2."""
    interface = ElementTree.parse(folder / "modelDescription.xml").getroot().find(_ELEMENTS[kind])
    return interface is not None and interface.get("providesDirectionalDerivatives") in ("true", "1")


def _reasons(
    kind: FmuKind, library: Path | None, platforms: tuple[str, ...], build: Build | None, folder: Path
) -> tuple[str, ...]:
    reasons = []
    if kind == "se":
        reasons.append("it offers Scheduled Execution alone, which is not run")
    if library is None:
        refusal = None if build is None else build.refusal(folder)
        if refusal != "":
            found = ", ".join(platforms) or "none"
            reasons.append(f"it has no binary for {native_platform()}; it has {found}")
        if refusal:
            reasons.append(refusal)
    elif wrong := misfit(library, native_platform()):
        reasons.append(wrong)
    elif missing := missing_libraries(library, folder):
        reasons.append(f"its binary wants {', '.join(missing)}, neither installed nor shipped in it")
    if kind == "me" and (lacking := solver_missing()):
        reasons.append(lacking)
    return tuple(reasons)


def _cautions(kind: FmuKind, capabilities: Mapping[str, Any], variables: tuple[Variable, ...]) -> list[str]:
    cautions = []
    if capabilities.get("needsExecutionTool"):
        cautions.append("it says it needs the tool it was made with to run")
    if kind == "cs" and not capabilities.get("canHandleVariableCommunicationStepSize", True):
        grid = capabilities.get("fixedInternalStepSize")
        steps = f", a multiple of {grid} s" if grid else ""
        cautions.append(f"it says every step must have the same length{steps}: it runs on its fixed grid")
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
