"""From a case of a campaign to an SSP: an FMU for every part, the wires as connections, the parameters as applied."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fmus.component import ConfigurationError
from fmus.units import Unit
from fmus.whole import write_whole
from harness.campaign import Campaign, Case
from harness.findings import Findings
from harness.order import Wire
from harness.places import Place
from harness.scenario import ModelPart, Scenario
from harness.ssp.components import Components
from harness.ssp.structure import Component, Connection, End, Linear, Structure
from harness.ssp.structure import System as Described
from harness.ssp.writing import Version, write_package
from harness.system import System
from harness.wiring import wire

_PLACE = Place()
_NO_UNIT = Unit()
# Keys of a campaign that an SSP has no place for.
_LEFT_OUT = ("record", "experiments", "vary", "metrics", "accept", "report", "limits")


@dataclass(frozen=True)
class Exported:
    """The file that was written, and what it does not say as the campaign does."""

    path: Path
    notes: tuple[str, ...]


def export_case(
    campaign: Campaign, case: Case, path: Path, version: Version, platforms: tuple[str, ...] = ("native",)
) -> Exported:
    """Write the system of a case as an SSP of this version; our own FMUs in it are built for these platforms.

    Raises ConfigurationError: the case cannot be wired, or has what an SSP cannot hold; every such thing at its place.
    """
    found = Findings(case.places)
    if case.scenario.clock.time is None:
        found.at("clock").tell("a clock in crank angle cannot be exported: an SSP is stepped in time")
        raise ConfigurationError(found.problems)
    with wire(case.scenario, case.places) as system, tempfile.TemporaryDirectory(prefix="ssp-") as scratch:
        components = Components(case, system, version, platforms, Path(scratch), found)
        structure = _structure(campaign, components)
        if found.problems:
            raise ConfigurationError(found.problems)
        write_whole(path, write_package(structure))
        notes = [*components.notes, *_notes(case, system)]
    if len(campaign.cases) > 1:
        notes.insert(0, f"one case of {len(campaign.cases)}: {case.label}")
    left = [key for key in _LEFT_OUT if campaign.written.get(key)]
    if left:
        notes.append(f"of the campaign is left out: {', '.join(left)}")
    return Exported(path, tuple(notes))


def _structure(campaign: Campaign, components: Components) -> Structure:
    """The structure of a wired case; problems go to the components' findings.

    The elements follow each other in the order in which they are stepped here. What an SSP has no words for, and a way
    back needs, stands in annotations.
    """
    case, system = components.case, components.system
    clock = case.scenario.clock.time
    assert clock is not None, "only what steps in time is exported"
    slots = [slot for slot in system.parts if slot.name in case.scenario.parts]
    made = {slot.name: components.component(slot) for slot in slots}
    elements = {name: component for name, component in made.items() if component is not None}
    _refuse_wires(case.scenario, components.found)
    connections = tuple(_connections(components, elements))
    annotation: dict[str, Any] = {
        "step": str(clock.step),
        "parts": list(case.scenario.parts),
        "order": [slot.name for slot in slots],
        "held": [str(one) for one in system.held],
    }
    coupling = case.scenario.coupling.model_dump(mode="json", exclude_defaults=True)
    top = Described(campaign.name, {}, elements, connections, {}, (), _PLACE)
    return Structure(
        name=campaign.name,
        description=str(campaign.written.get("description") or ""),
        version=components.version,
        system=top,
        sha256="",
        start=clock.start.si("s"),
        stop=clock.stop.si("s"),
        annotation={**annotation, **({"coupling": coupling} if coupling else {})},
    )


def _connections(components: Components, elements: Mapping[str, Component]) -> Iterator[Connection]:
    """The wires as connections; one between numbers in two units converts them in so many words."""
    for one in components.system.wires:
        if one.source not in elements or one.part not in elements:
            continue
        start, end = _end(components, one.source, one.output), _end(components, one.part, one.input)
        before, after = components.unit(one.source, one.output), components.unit(one.part, one.input)
        if before is None or after is None or before.meaning == after.meaning:
            yield Connection(start, end, False, None, _PLACE)
            continue
        given, wanted = before.meaning or _NO_UNIT, after.meaning or _NO_UNIT
        warning = "importers that know no LinearTransformation pass the number as it is"
        components.notes.append(f"{one} converts {before.name} to {after.name}: {warning}")
        linear = Linear(given.factor / wanted.factor, (given.offset - wanted.offset) / wanted.factor)
        yield Connection(start, end, True, linear, _PLACE)


def _refuse_wires(scenario: Scenario, found: Findings) -> None:
    """A problem for each wire with more to it than a connection says."""
    for name, spec in scenario.parts.items():
        for key, given in spec.wires.items() if isinstance(spec, ModelPart) else ():
            if given.delay or given.faults:
                what = "delay" if given.delay else "faults"
                here = found.at("parts", name, "wires", key)
                here.add(f"wants no {what} to be exported: put a sensor between that has them")


def _end(components: Components, part: str, signal: str) -> End:
    """The end of a connection: a scalar of an array by its indices."""
    variable = components.variable(part, signal)
    if variable is None or not variable.shape:
        return End(part, signal)
    return End(part, variable.name, tuple(int(index) for index in signal.rpartition("[")[2].rstrip("]").split(",")))


def _notes(case: Case, system: System) -> Iterator[str]:
    """What a tool that steps all FMUs side by side does otherwise."""
    sources = {slot.name for slot in system.parts if not slot.component.inputs}
    held = set(system.held)
    now: list[Wire] = [one for one in system.wires if one not in held and one.source not in sources]
    if now:
        yield (
            "read in the same instant here, a step later by tools that step all FMUs side by side: "
            + ", ".join(map(str, now))
        )
    if case.scenario.coupling.model_dump(exclude_defaults=True):
        yield "the coupling stands in an annotation: other tools couple as they do"
