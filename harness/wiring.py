"""From a scenario to a system: components by name, every wire checked, the order of the parts and what is held."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

from fmus.component import Component, ConfigurationError, Signal
from fmus.model import unknown
from fmus.units import UnitError, parse_unit
from fmus.whereabouts import doing
from harness.arrays import off_bus, spread
from harness.assembly import Built, assemble, find_output, output
from harness.clock import CrankGrid, Grid, Pace, read_clock, read_pace
from harness.crank import build_crank
from harness.findings import Findings
from harness.native import library
from harness.order import Wire
from harness.places import Places
from harness.points import horizon
from harness.replay import build_replay
from harness.resolve import resolve
from harness.scenario import CrankPart, ModelPart, Part, Scenario, SensorPart, WireSpec
from harness.sensor import build_sensor
from harness.source import build_source
from harness.sourcepart import ReplayPart, SourcePart
from harness.system import System

_NAME = re.compile(r"[A-Za-z_]\w*$")
NOWHERE = Places()


def wire(scenario: Scenario, places: Places = NOWHERE) -> System:
    """The system a scenario describes.

    `places` are those of the document that `clock` and `parts` stand in; relative paths of FMUs start at its folder.

    Raises ConfigurationError with every problem found, each at its place: unknown names, units that do not fit, wires
    that are missing, observers wired to the truth, algebraic loops, settings that nobody declared.
    """
    found = Findings(places)
    grid = read_clock(scenario.clock, found.at("clock"))
    library()
    built: dict[str, Built | None] = {}
    try:
        _build(scenario, grid, built, found)
        wires = _wires(scenario, built, found)
        _check_wires(wires, built, scenario, found)
        system = assemble(scenario, grid, built, wires, found)
    except BaseException:
        _close(built)
        raise
    if system is None or found.problems:
        _close(built)
        raise ConfigurationError(found.problems)
    return system


def _close(built: Mapping[str, Built | None]) -> None:
    for part in built.values():
        if part is not None:
            part.component.close()


def _build(scenario: Scenario, grid: Grid, built: dict[str, Built | None], found: Findings) -> None:
    """Fills `built` with every part as declared; None for those that have problems."""
    for name in scenario.parts:
        built[name] = None
        if not _NAME.match(name):
            found.at("parts", name).tell(f"a part's name wants letters, digits and _, got '{name}'")
    for name, spec in scenario.parts.items():
        here = found.at("parts", name)
        if isinstance(spec, ModelPart):
            pace = read_pace(spec.every, spec.at, grid, here)
            with doing("wiring", name):
                resolved = resolve(spec, name, pace.step, here, scenario.validation)
            if resolved is not None:
                built[name] = Built(
                    resolved.component, _own_pace(resolved.component, pace, grid, here), resolved.settings
                )
        elif isinstance(spec, SourcePart) and _known_unit(spec.unit, here.at("unit")):
            built[name] = Built(build_source(spec, horizon(grid), here), Pace(), {})
        elif isinstance(spec, ReplayPart):
            replay = build_replay(spec, grid, here)
            built[name] = None if replay is None else Built(replay, Pace(), {})
    waiting = {name: spec for name, spec in scenario.parts.items() if isinstance(spec, SensorPart | CrankPart)}
    while waiting:
        ready = [name for name, spec in waiting.items() if _measured(spec, scenario).partition(".")[0] not in waiting]
        if not ready:
            for name, spec in waiting.items():
                found.at("parts", name, "of").tell(f"{name} measures {spec.of}: these sensors only measure each other")
            return
        for name in ready:
            _build_measuring(name, waiting.pop(name), scenario, grid, built, found)


def _build_measuring(
    name: str,
    spec: SensorPart | CrankPart,
    scenario: Scenario,
    grid: Grid,
    built: dict[str, Built | None],
    found: Findings,
) -> None:
    """Builds a part that reads a signal of another: a sensor, or a crank with an angle to read."""
    here = found.at("parts", name)
    of = _measured(spec, scenario)
    source = find_output(of, built, here.at("of")) if of else None
    if of and source is None:
        return
    measured = None if source is None else output(source, built)
    if isinstance(spec, CrankPart):
        if measured is None and not isinstance(grid, CrankGrid):
            here.tell(
                f"{name} wants `of`, a signal that is the crankshaft's angle: the clock of this campaign is in time"
            )
            return
        if measured is not None and not parse_unit(measured.unit).same_dimension(parse_unit("deg")):
            here.at("of").add(f"wants an angle, got {measured.unit} from {of}")
            return
        built[name] = Built(build_crank(spec, measured, grid, here), Pace(), {})
        return
    assert measured is not None, "the schema wants a sensor to measure something"
    pace = read_pace(spec.every, spec.at, grid, here)
    if pace.own:
        here.at("every").add(f"wants a crank angle, since a sensor samples at instants of the clock, got {spec.every}")
    period = pace.step
    if isinstance(grid, CrankGrid) and (spec.lag or spec.delay):
        here.tell(f"{name} has a lag or a delay, which a sensor on a crank clock cannot have yet")
        return
    built[name] = Built(build_sensor(spec, measured, period, scenario.seed, name, here), pace, {})


def _measured(spec: SensorPart | CrankPart, scenario: Scenario) -> str:
    """The signal a part reads; of a crank that names none, the angle that the clock steers to."""
    clock = scenario.clock.crank
    return spec.of or (clock.angle if clock is not None else None) or ""


def _own_pace(component: Component, pace: Pace, grid: Grid, found: Findings) -> Pace:
    """The pace of a part that wants steps of one length: on a crank clock, a grid of its own."""
    description = getattr(component, "description", None)
    if not isinstance(grid, CrankGrid) or pace.own or description is None or description.kind != "cs":
        return pace
    if description.capabilities.get("canHandleVariableCommunicationStepSize", True):
        return pace
    given = description.capabilities.get("fixedInternalStepSize")
    if given:
        return Pace(own=float(given), step=float(given))
    found.at("every").add(
        "wants a time, like 1 ms: this FMU takes only steps of one length, and a crank clock makes others"
    )
    return pace


def _known_unit(unit: str, found: Findings) -> bool:
    try:
        parse_unit(unit)
    except UnitError as error:
        found.add(str(error))
        return False
    return True


def _wires(scenario: Scenario, built: Mapping[str, Built | None], found: Findings) -> list[Wire]:
    """All wires between parts without problems, in the order of the inputs they enter; problems for the others."""
    wires = []
    for name, spec in scenario.parts.items():
        part = built[name]
        given = _given(spec, scenario)
        here = found.at("parts", name, "wires") if isinstance(spec, ModelPart) else found.at("parts", name)
        if part is None:
            for input_name, one in given.items() if isinstance(spec, ModelPart) else ():
                find_output(one.source, built, here.at(input_name))
            continue
        inputs = [signal.name for signal in part.component.inputs]
        sources = {source: one.component for source, one in built.items() if one is not None}
        given = spread(given, part.component, sources, here)
        for input_name in given:
            if input_name not in inputs:
                why = off_bus(input_name, part.component)
                told = why or unknown(input_name, inputs, f"input of {name}")
                here.at(input_name).add(told)
        depends = {input_name for _, input_name in part.component.feedthrough}
        for input_name in inputs:
            if input_name not in given:
                here.tell(f"{name}.{input_name} wants a wire; write `wires: {{{input_name}: part.output}}`")
                continue
            one = given[input_name]
            quiet = here.at(input_name) if isinstance(spec, ModelPart) else Findings(found.places)
            source = find_output(one.source, built, quiet) if one.source else None
            if source is not None:
                late = one.delay == 1 or _jacobi(built, source[0], name, scenario)
                wires.append(Wire(*source, name, input_name, input_name in depends, late))
    return wires


def _given(spec: Part, scenario: Scenario) -> Mapping[str, WireSpec]:
    """The wires of a part by input, as declared."""
    if isinstance(spec, ModelPart):
        return spec.wires
    of = _measured(spec, scenario) if isinstance(spec, SensorPart | CrankPart) else ""
    return {"of": WireSpec.model_validate({"from": of})} if of else {}


def _jacobi(built: Mapping[str, Built | None], source: str, target: str, scenario: Scenario) -> bool:
    """Whether a wire is one between plants and controllers that all see each other's values of the instant before."""
    ends = (built[source], built[target])
    coupled = all(end is not None and end.component.role in ("plant", "controller") for end in ends)
    return coupled and scenario.coupling.method == "jacobi"


def _check_wires(wires: Sequence[Wire], built: Mapping[str, Built | None], scenario: Scenario, found: Findings) -> None:
    """Units, kinds, and that no observer reads the truth."""
    for entry in wires:
        source, target = built[entry.source], built[entry.part]
        assert source is not None and target is not None, "wires join built parts only"
        here = found.at("parts", entry.part, "wires", entry.input)
        given = output((entry.source, entry.output), built)
        wanted = next(signal for signal in target.component.inputs if signal.name == entry.input)
        if not parse_unit(given.unit).same_dimension(parse_unit(wanted.unit)):
            told = f"{entry.part}.{entry.input} wants {_named(wanted)}, got {_named(given)} from {entry.source}"
            here.tell(told + _binding(entry, given, wanted, wires))
        if wanted.kind != "real" and given.kind == "real" and source.component.role != "source":
            here.tell(f"{entry.part}.{entry.input} wants {wanted.kind} values, got real ones from {entry.source}")
        if source.component.role == "plant" and target.component.role == "observer":
            truth = f"{entry.source}.{entry.output}"
            here.tell(
                f"{entry.part}.{entry.input} reads the truth, {truth}: put a sensor between, "
                f"like `{entry.output}_sensor: {{use: sensor, of: {truth}}}`"
            )


def _binding(entry: Wire, given: Signal, wanted: Signal, wires: Sequence[Wire]) -> str:
    """How to bind a unit to the side of a wire that has none; nothing where both have one."""
    if given.unit and wanted.unit:
        return ""
    part, name, unit = entry.source, entry.output, wanted.unit
    if given.unit:
        part, name, unit = entry.part, entry.input, given.unit
    before = [one for one in wires if one.part == part and one.input == "of"]
    while before and not given.unit:  # a sensor reads in the unit of what it measures
        part, name = before[0].source, before[0].output
        before = [one for one in wires if one.part == part and one.input == "of"]
    variable = name.partition("[")[0]
    return f"; {part} does not declare the unit of {name}: bind it, like `{part}: {{units: {{{variable}: {unit}}}}}`"


def _named(signal: Signal) -> str:
    return {"": "no unit", "1": "a number without a unit"}.get(signal.unit, signal.unit)
