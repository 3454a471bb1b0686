"""What an FMU says of itself: variables, units, capabilities, and what stands in the way of running it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

from fmus.archive import unpack
from fmus.binary import misfit
from fmus.clocks import Clock
from fmus.component import ConfigurationError, Problem
from fmus.exchange import solver_missing
from fmus.library import exported_names, missing_libraries
from fmus.modeltext import FmuKind, Offer, Validation, read_model_text
from fmus.sources import Build
from fmus.toolchain import FMI3_PLATFORMS, library_suffix, native_platform
from fmus.variable import Variable


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


def forget() -> None:
    """Forget what this process knows of FMUs described before; what is kept on disk stays."""
    _described.cache_clear()


@lru_cache(maxsize=64)
def _described(folder: Path, sha256: str, validation: Validation) -> FmuDescription:
    text = read_model_text(folder, sha256, validation)
    version = int(text.fmi_version.split(".")[0])
    builds = {build.identifier: build for build in text.builds}
    interfaces: dict[FmuKind, Interface] = {}
    for offer in text.offers:
        identifier, capabilities = offer.identifier, offer.capabilities
        library, platforms = _library(folder, identifier, version), _platforms(folder, identifier)
        build = builds.get(identifier)
        interfaces[offer.kind] = Interface(
            identifier,
            platforms,
            library,
            build,
            capabilities,
            (*_reasons(offer, version, library, platforms, build, folder), *_clock_reasons(offer, text.clocks)),
            (*_cautions(offer.kind, capabilities, text.variables), *_clock_cautions(text.clocks)),
        )
    chosen_kind = next(iter(interfaces))
    chosen = interfaces[chosen_kind]
    return FmuDescription(
        fmi_version=text.fmi_version,
        kinds=tuple(interfaces),
        kind=chosen_kind,
        model_name=text.model_name,
        tool=text.tool,
        token=text.token,
        model_identifier=chosen.identifier,
        platforms=chosen.platforms,
        library=chosen.library,
        build=chosen.build,
        folder=folder,
        sha256=sha256,
        interfaces=interfaces,
        states=text.states,
        indicators=text.indicators,
        clocks=text.clocks,
        variables=text.variables,
        dependencies=text.dependencies,
        capabilities=chosen.capabilities,
        log_categories=text.log_categories,
        reasons=chosen.reasons,
        cautions=(*text.broken, *chosen.cautions),
    )


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


def _resized(variable: Variable, sizes: Mapping[str, int]) -> Variable:
    shape = tuple(sizes[size] if isinstance(size, str) else size for size in variable.dimensions)
    if shape == variable.shape:
        return variable
    start = variable.start[:1] * math.prod(shape) if len(set(variable.start)) == 1 else ()
    return replace(variable, shape=shape, start=start)


def _clock_reasons(offer: Offer, clocks: tuple[Clock, ...]) -> tuple[str, ...]:
    reasons = [clock.refusal for clock in clocks if clock.refusal]
    if offer.kind == "cs" and any(clock.ticked for clock in clocks) and not offer.capabilities.get("hasEventMode"):
        reasons.append("it has clocks that want ticks, but no event mode to tick them in")
    return tuple(reasons)


def _clock_cautions(clocks: tuple[Clock, ...]) -> tuple[str, ...]:
    still = [clock.name for clock in clocks if clock.causality == "input" and clock.variability == "triggered"]
    return (f"its triggered clocks are never ticked: {', '.join(still)}",) if still else ()


# The functions without which nothing is run, by version and kind; those for types of values come beside them.
_FUNCTIONS = {
    (1, "cs"): ("InstantiateSlave", "InitializeSlave", "DoStep", "TerminateSlave", "FreeSlaveInstance"),
    (1, "me"): ("InstantiateModel", "Initialize", "GetDerivatives", "EventUpdate", "FreeModelInstance"),
    (2, "cs"): ("Instantiate", "SetupExperiment", "EnterInitializationMode", "DoStep", "FreeInstance"),
    (2, "me"): ("Instantiate", "SetupExperiment", "GetDerivatives", "NewDiscreteStates", "FreeInstance"),
    (3, "cs"): ("InstantiateCoSimulation", "EnterInitializationMode", "DoStep", "FreeInstance"),
    (3, "me"): ("InstantiateModelExchange", "GetContinuousStateDerivatives", "UpdateDiscreteStates", "FreeInstance"),
}


def _lacking_functions(library: Path, kind: FmuKind, version: int, identifier: str) -> list[str]:
    """Functions that a library does not export and that nothing runs without; empty where its names are not read."""
    names = exported_names(library)
    prefix = f"{identifier}_fmi" if version == 1 else f"fmi{version}"
    return [prefix + name for name in _FUNCTIONS.get((version, kind), ()) if names and prefix + name not in names]


def _reasons(
    offer: Offer, version: int, library: Path | None, platforms: tuple[str, ...], build: Build | None, folder: Path
) -> tuple[str, ...]:
    kind, identifier = offer.kind, offer.identifier
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
    elif lacking := _lacking_functions(library, kind, version, identifier):
        reasons.append(f"its binary lacks functions of the standard: {', '.join(lacking)}")
    if kind == "me" and (unsolvable := solver_missing()):
        reasons.append(unsolvable)
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
