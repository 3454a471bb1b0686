"""What the model description of an FMU says, read by FMPy once and kept beside the unpacked FMU."""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import cache
from importlib.metadata import version as installed_version
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal
from xml.etree import ElementTree

from fmus.clocks import Clock
from fmus.component import ConfigurationError, Problem
from fmus.modelxml import checked_description
from fmus.sources import Build, SourceSet
from fmus.toolchain import cache_folder
from fmus.units import Unit
from fmus.variable import Variable, read_variable

# What becomes of the rules of the standard that a model description breaks: refused, read all the same and told of,
# or not looked for.
Validation = Literal["strict", "warn", "off"]

_ELEMENTS = {"cs": "CoSimulation", "me": "ModelExchange", "se": "ScheduledExecution"}
# Co-Simulation, Model Exchange, Scheduled Execution.
FmuKind = Literal["cs", "me", "se"]

Capabilities = Mapping[str, bool | int | float | str]


@dataclass(frozen=True)
class Offer:
    """One kind in which an FMU may be run, and what it says it can in it."""

    kind: FmuKind
    identifier: str
    capabilities: Capabilities


@dataclass(frozen=True)
class ModelText:
    """A model description as it stands, whatever the machine; fields as FmuDescription has them.

    `broken` are the rules of the standard that it breaks.
    """

    fmi_version: str
    model_name: str
    tool: str
    token: str
    states: int
    indicators: int
    offers: tuple[Offer, ...]
    builds: tuple[Build, ...]
    clocks: tuple[Clock, ...]
    variables: tuple[Variable, ...]
    dependencies: Mapping[str, frozenset[str]]
    log_categories: tuple[str, ...]
    broken: tuple[str, ...]


def read_model_text(folder: Path, sha256: str, validation: Validation) -> ModelText:
    """The model description of the FMU unpacked at `folder`, whose archive has this hash.

    Kept in the cache: what was read before, by the same programs, is not read by FMPy again. What is refused is not
    kept. Raises ConfigurationError: it cannot be read, or is refused.
    """
    kept = cache_folder() / "descriptions" / f"{sha256}-{validation}-{_readers()}.json"
    found = _kept(kept)
    if found is None:
        found = _read_anew(folder, validation)
        _keep(found, kept)
    return found


@cache
def _readers() -> str:
    """A hash of what reads: another reading is another text."""
    sources = ("modeltext.py", "modelxml.py", "variable.py", "units.py", "clocks.py", "sources.py")
    digest = hashlib.sha256(installed_version("fmpy").encode())
    for source in sources:
        digest.update(files("fmus").joinpath(source).read_bytes())
    return digest.hexdigest()[:16]


def _kept(path: Path) -> ModelText | None:
    try:
        raw = json.loads(path.read_text(encoding="utf-8"))
        return ModelText(
            **{
                **raw,
                "offers": tuple(Offer(**offer) for offer in raw["offers"]),
                "builds": tuple(_build(build) for build in raw["builds"]),
                "clocks": tuple(Clock(**clock) for clock in raw["clocks"]),
                "variables": tuple(_variable(variable) for variable in raw["variables"]),
                "dependencies": {name: frozenset(others) for name, others in raw["dependencies"].items()},
                "log_categories": tuple(raw["log_categories"]),
                "broken": tuple(raw["broken"]),
            }
        )
    except (OSError, ValueError, TypeError, KeyError):  # nothing kept, or not what is written here
        return None


def _build(raw: Mapping[str, Any]) -> Build:
    sets = (
        SourceSet(
            tuple(part["files"]),
            tuple((name, value) for name, value in part["definitions"]),
            tuple(part["includes"]),
            part["language"],
        )
        for part in raw["sets"]
    )
    return Build(raw["identifier"], tuple(sets), tuple(raw["libraries"]))


def _variable(raw: dict[str, Any]) -> Variable:
    quantity = raw["quantity"]
    if quantity is not None:
        raw["quantity"] = Unit(tuple(quantity["exponents"]), quantity["factor"], quantity["offset"])
    for name in ("start", "shape", "dimensions"):
        raw[name] = tuple(raw[name])
    return Variable(**raw)


def _keep(text: ModelText, path: Path) -> None:
    """Write it whole or not at all; where it cannot be written, it is read again next time."""
    raw = asdict(text)
    raw["dependencies"] = {name: sorted(others) for name, others in text.dependencies.items()}
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, partial = tempfile.mkstemp(dir=path.parent)
        with os.fdopen(handle, "w", encoding="utf-8") as file:
            json.dump(raw, file)
        os.replace(partial, path)
    except OSError:
        return


def _read_anew(folder: Path, validation: Validation) -> ModelText:
    read, broken = _read(folder, validation)
    relative = _relative_quantities(folder)
    units = {unit.name: unit.baseUnit for unit in read.unitDefinitions}
    version = int(read.fmiVersion.split(".")[0])
    kinds: dict[FmuKind, Any] = {"cs": read.coSimulation, "me": read.modelExchange, "se": read.scheduledExecution}
    offers = []
    for kind, interface in kinds.items():
        if interface is not None:
            capabilities = _capabilities(interface) if version > 1 else _capabilities_of_fmi1(folder)
            if version == 3:
                capabilities["providesDirectionalDerivative"] = _gives_derivatives(folder, kind)
            offers.append(Offer(kind, interface.modelIdentifier or "", capabilities))
    if not offers:
        raise ConfigurationError("the model description names neither Co-Simulation nor Model Exchange")
    return ModelText(
        fmi_version=read.fmiVersion,
        model_name=read.modelName or "",
        tool=read.generationTool or "",
        token=read.guid or "",
        states=read.numberOfContinuousStates,
        indicators=read.numberOfEventIndicators,
        offers=tuple(offers),
        builds=tuple(_builds(read)),
        clocks=_clocks(folder) if version == 3 else (),
        variables=tuple(read_variable(v, units, v.name in relative) for v in read.modelVariables),
        dependencies={
            unknown.variable.name: frozenset(v.name for v in unknown.dependencies)
            for unknown in read.outputs
            if unknown.dependencies is not None
        },
        log_categories=tuple(category.name for category in read.logCategories),
        broken=tuple(broken),
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


def _capabilities(interface: Any) -> dict[str, bool | int | float | str]:
    names = sorted(name for name in dir(interface) if not name.startswith("_") and name != "modelIdentifier")
    return {name: value for name in names if (value := getattr(interface, name)) is not None}


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


def _gives_derivatives(folder: Path, kind: FmuKind) -> bool:
    """Whether an FMI 3 FMU says it gives directional derivatives: FMPy looks for the attribute of FMI 2."""
    interface = ElementTree.parse(folder / "modelDescription.xml").getroot().find(_ELEMENTS[kind])
    return interface is not None and interface.get("providesDirectionalDerivatives") in ("true", "1")
