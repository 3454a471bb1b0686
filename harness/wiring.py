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
from harness.faults import Sampling, tells_faults
from harness.findings import Findings
from harness.native import library
from harness.onwire import Given, OnWire, build_on_wire, check_smaller_steps, check_swaps, faulty_wires, reads, rewired
from harness.order import Wire
from harness.places import Places
from harness.points import horizon
from harness.replay import build_replay
from harness.resolve import resolve
from harness.scenario import CrankPart, ModelPart, Part, Scenario, SensorPart, SwapPart, WireSpec
from harness.sensor import build_sensor
from harness.source import build_source
from harness.sourcepart import ReplayPart, SourcePart
from harness.swap import build_swap
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
        on_wires = _build(scenario, grid, built, found)
        wires = _wires(scenario, built, found)
        _check_wires(wires, built, scenario, found)
        swaps = [name for name, spec in scenario.parts.items() if isinstance(spec, SwapPart)]
        check_swaps(wires, on_wires, swaps, _components(built), found)
        if scenario.coupling.error is not None:
            check_smaller_steps(wires, on_wires, swaps, _components(built), found)
        system = assemble(scenario, grid, built, rewired(wires, on_wires, swaps), found)
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


def _components(built: Mapping[str, Built | None]) -> dict[str, Component]:
    return {name: part.component for name, part in built.items() if part is not None}


def _build(scenario: Scenario, grid: Grid, built: dict[str, Built | None], found: Findings) -> Mapping[str, OnWire]:
    """Fills `built` with every part, None where it has problems; those on wires stand before the part they lead to.

    So what an order leaves open is decided as if a wire had nothing on it. Returns the parts on wires.
    """
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
    on_wires = faulty_wires(scenario.parts, _components(built), found)
    so_far = dict(built)
    built.clear()
    for name, part in so_far.items():
        built |= {standing: None for standing, one in on_wires.items() if one.part == name}
        built[name] = part
    waiting = {name: reads(spec, scenario.clock) for name, spec in scenario.parts.items() if isinstance(spec, _READING)}
    waiting |= {name: {"of": one.source} for name, one in on_wires.items()}
    while waiting:
        heads = {name: {text.partition(".")[0] for text in texts.values()} for name, texts in waiting.items()}
        ready = [name for name in waiting if not heads[name] & waiting.keys()]
        if not ready:
            for name, texts in waiting.items():
                told = f"{name} measures {' and '.join(texts.values())}: these sensors only measure each other"
                _where_read(name, on_wires, found).tell(told)
            break
        for name in ready:
            built[name] = _build_reading(name, waiting.pop(name), scenario, grid, on_wires, built, found)
    return on_wires


_READING = SensorPart | CrankPart | SwapPart


def _where_read(name: str, on_wires: Mapping[str, OnWire], found: Findings) -> Findings:
    """Where it is written what a sensor, a crank, a swap or a part on a wire reads."""
    one = on_wires.get(name)
    return found.at("parts", name) if one is None else found.at("parts", one.part, "wires", one.key)


def _build_reading(
    name: str,
    texts: Mapping[str, str],
    scenario: Scenario,
    grid: Grid,
    on_wires: Mapping[str, OnWire],
    built: Mapping[str, Built | None],
    found: Findings,
) -> Built | None:
    """A sensor, a crank, a swap or a part on a wire, made to the signals it reads; None where there is a problem."""
    spec, components = scenario.parts.get(name), _components(built)
    here = _where_read(name, on_wires, found)
    given: list[Given] = []
    for input_name, text in texts.items():
        where = here.at("between") if isinstance(spec, SwapPart) else here.at(input_name)
        # What is wrong with the source of a faulty wire is told with the wires.
        source = find_output(text, built, where if spec is not None else Findings(found.places))
        if source is None:
            return None
        given.append(Given(".".join(source), output(source, built), components[source[0]]))
    if isinstance(spec, CrankPart):
        return _build_crank(name, spec, given[0].signal if given else None, grid, here)
    if isinstance(spec, SensorPart):
        return _build_sensor(name, spec, given[0].signal, scenario.seed, grid, here)
    everywhere = read_pace(None, None, grid, here)
    sampling = Sampling(grid, everywhere)
    if isinstance(spec, SwapPart):
        return Built(build_swap(spec, given, sampling, here), everywhere, {})
    target = components.get(on_wires[name].part)
    if target is None:
        return None
    faults = here.at("faults")
    return Built(build_on_wire(name, on_wires[name], given[0], target, sampling, scenario.seed, faults), everywhere, {})


def _build_crank(name: str, spec: CrankPart, measured: Signal | None, grid: Grid, here: Findings) -> Built | None:
    if measured is None and not isinstance(grid, CrankGrid):
        here.tell(f"{name} wants `of`, a signal that is the crankshaft's angle: the clock of this campaign is in time")
        return None
    if measured is not None and not parse_unit(measured.unit).same_dimension(parse_unit("deg")):
        here.at("of").add(f"wants an angle, got {measured.unit} from {spec.of}")
        return None
    return Built(build_crank(spec, measured, grid, here), Pace(), {})


def _build_sensor(name: str, spec: SensorPart, measured: Signal, seed: int, grid: Grid, here: Findings) -> Built | None:
    pace = read_pace(spec.every, spec.at, grid, here)
    if pace.own:
        here.at("every").add(f"wants a crank angle, since a sensor samples at instants of the clock, got {spec.every}")
    return Built(build_sensor(spec, measured, Sampling(grid, pace), seed, name, here), pace, {})


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
    read = reads(spec, scenario.clock).items()
    return {input_name: WireSpec.model_validate({"from": text}) for input_name, text in read}


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
        if tells_faults(source.component, entry.output):
            fault = f"{entry.source}.{entry.output}"
            told = f"{entry.part}.{entry.input} reads {fault}, the truth about faults"
            here.tell(f"{told}: metrics read it, no part does")
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
