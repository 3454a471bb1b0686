"""From a scenario to a system: components by name, every wire checked, the order of the parts and what is held."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

from fmus.component import Component, ConfigurationError, Signal
from fmus.model import unknown
from fmus.units import UnitError, parse_unit
from fmus.whereabouts import doing
from harness.arrays import off_bus, spread
from harness.findings import Findings
from harness.native import library
from harness.order import AlgebraicLoop, Wire, held_wires, order_parts
from harness.places import Places
from harness.resolve import resolve
from harness.scenario import Measure, ModelPart, Scenario, SensorPart, SourcePart
from harness.sensor import build_sensor
from harness.source import build_source
from harness.system import Slot, System, TimeGrid

MOST_STEPS = 100_000_000
_NAME = re.compile(r"[A-Za-z_]\w*$")
NOWHERE = Places()


class _Built(NamedTuple):
    component: Component
    period: int
    settings: Mapping[str, float]


def wire(scenario: Scenario, places: Places = NOWHERE) -> System:
    """The system a scenario describes.

    `places` are those of the document that `clock` and `parts` stand in; relative paths of FMUs start at its folder.

    Raises ConfigurationError with every problem found, each at its place: unknown names, units that do not fit, wires
    that are missing, observers wired to the truth, algebraic loops, settings that nobody declared.
    """
    found = Findings(places)
    grid = _grid(scenario, found.at("clock", "time"))
    library()
    built: dict[str, _Built | None] = {}
    try:
        _build(scenario, grid, built, found)
        wires = _wires(scenario, built, found)
        _check_wires(wires, built, scenario, found)
        system = _assemble(scenario, grid, built, wires, found)
    except BaseException:
        _close(built)
        raise
    if system is None or found.problems:
        _close(built)
        raise ConfigurationError(found.problems)
    return system


def _close(built: Mapping[str, _Built | None]) -> None:
    for part in built.values():
        if part is not None:
            part.component.close()


def _grid(scenario: Scenario, found: Findings) -> TimeGrid:
    clock = scenario.clock.time
    step, start, stop = (found.at(key).value(getattr(clock, key), "s") for key in ("step", "start", "stop"))
    if not step > 0.0:
        found.at("step").add(f"wants a positive step, got {clock.step}")
        return TimeGrid(start, 1.0, 0)
    if not stop > start:
        found.at("stop").add(f"wants a time after the start, {clock.start}, got {clock.stop}")
        return TimeGrid(start, step, 0)
    ratio = (stop - start) / step
    if ratio > MOST_STEPS:
        found.at("step").add(f"wants at most {MOST_STEPS} steps, got {ratio:.9g} of {clock.step}; take a longer step")
        return TimeGrid(start, step, 0)
    steps = math.floor(ratio + 1e-6)
    if steps == 0 and not found.problems:
        found.at("step").add(f"wants at least one step up to {clock.stop}, got {clock.step}")
    return TimeGrid(start, step, steps)


def _period(every: Measure | None, grid: TimeGrid, found: Findings) -> int:
    """The period of a part in steps of the clock."""
    if every is None:
        return 1
    ratio = min(found.value(every, "s") / grid.step, float(MOST_STEPS))
    period = round(ratio)
    if period < 1 or abs(ratio - period) > 1e-6 * period:
        near = sorted({max(1, math.floor(ratio)), max(1, math.ceil(ratio))})
        nearest = " or ".join(f"{count * grid.step:.9g} s" for count in near)
        found.add(f"wants a multiple of the clock's step, {grid.step:.9g} s, got {every}; near are {nearest}")
        return 1
    return period


def _build(scenario: Scenario, grid: TimeGrid, built: dict[str, _Built | None], found: Findings) -> None:
    """Fills `built` with every part as declared; None for those that have problems."""
    for name in scenario.parts:
        built[name] = None
        if not _NAME.match(name):
            found.at("parts", name).tell(f"a part's name wants letters, digits and _, got '{name}'")
    for name, spec in scenario.parts.items():
        here = found.at("parts", name)
        if isinstance(spec, ModelPart):
            period = _period(spec.every, grid, here.at("every"))
            with doing("wiring", name):
                resolved = resolve(spec, name, period * grid.step, here, scenario.validation)
            if resolved is not None:
                built[name] = _Built(resolved.component, period, resolved.settings)
        elif isinstance(spec, SourcePart) and _known_unit(spec.unit, here.at("unit")):
            built[name] = _Built(build_source(spec, grid.step, here), 1, {})
    waiting = {name: spec for name, spec in scenario.parts.items() if isinstance(spec, SensorPart)}
    while waiting:
        ready = [name for name, spec in waiting.items() if spec.of.partition(".")[0] not in waiting]
        if not ready:
            for name, spec in waiting.items():
                found.at("parts", name, "of").tell(f"{name} measures {spec.of}: these sensors only measure each other")
            return
        for name in ready:
            spec = waiting.pop(name)
            here = found.at("parts", name)
            period = _period(spec.every, grid, here.at("every"))
            source = _find_output(spec.of, built, here.at("of"))
            if source is not None:
                measured = _output(source, built)
                sensor = build_sensor(spec, measured, period * grid.step, scenario.seed, name, here)
                built[name] = _Built(sensor, period, {})


def _known_unit(unit: str, found: Findings) -> bool:
    try:
        parse_unit(unit)
    except UnitError as error:
        found.add(str(error))
        return False
    return True


def _output(source: tuple[str, str], built: Mapping[str, _Built | None]) -> Signal:
    part = built[source[0]]
    assert part is not None, "only outputs of built parts are found"
    return next(signal for signal in part.component.outputs if signal.name == source[1])


def _find_output(text: str, built: Mapping[str, _Built | None], found: Findings) -> tuple[str, str] | None:
    """Part and output of `part.output`, or of `part` with one output; None where the part has problems itself."""
    part, _, output = text.partition(".")
    if part not in built:
        found.add(unknown(part, built, "part"))
        return None
    source = built[part]
    if source is None:
        return None
    names = [signal.name for signal in source.component.outputs]
    if output in names:
        return part, output
    if output:
        why = off_bus(output, source.component)
        told = f"{text} {why}" if why else unknown(text, [f"{part}.{name}" for name in names], "signal")
        found.add(told)
    elif len(names) == 1 or "value" in names:
        return part, names[0] if len(names) == 1 else "value"
    else:
        listed = ", ".join(f"{part}.{name}" for name in names) or "none"
        found.add(f"wants one output of {part}, got '{text}'; there are {listed}")
    return None


def _wires(scenario: Scenario, built: Mapping[str, _Built | None], found: Findings) -> list[Wire]:
    """All wires between parts without problems, in the order of the inputs they enter; problems for the others."""
    wires = []
    for name, spec in scenario.parts.items():
        part = built[name]
        given = {"of": spec.of} if isinstance(spec, SensorPart) else spec.wires if isinstance(spec, ModelPart) else {}
        here = found.at("parts", name) if isinstance(spec, SensorPart) else found.at("parts", name, "wires")
        if part is None:
            for input_name, text in spec.wires.items() if isinstance(spec, ModelPart) else ():
                _find_output(text, built, here.at(input_name))
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
            quiet = Findings(found.places) if isinstance(spec, SensorPart) else here.at(input_name)
            source = _find_output(given[input_name], built, quiet) if given[input_name] else None
            if source is not None:
                wires.append(Wire(*source, name, input_name, input_name in depends))
    return wires


def _check_wires(
    wires: Sequence[Wire], built: Mapping[str, _Built | None], scenario: Scenario, found: Findings
) -> None:
    """Units, kinds, and that no observer reads the truth."""
    for entry in wires:
        source, target = built[entry.source], built[entry.part]
        assert source is not None and target is not None, "wires join built parts only"
        here = found.at("parts", entry.part, "wires", entry.input)
        given = _output((entry.source, entry.output), built)
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


def _assemble(
    scenario: Scenario, grid: TimeGrid, built: Mapping[str, _Built | None], wires: Sequence[Wire], found: Findings
) -> System | None:
    """The system of parts that fit together; None where there are problems."""
    whole = {name: part for name, part in built.items() if part is not None}
    try:
        order = order_parts({name: part.component.role == "sensor" for name, part in whole.items()}, wires)
    except AlgebraicLoop as error:
        first = error.wires[0]
        found.at("parts", first.part, "wires", first.input).tell(str(error))
        return None
    recorded = _recorded(scenario, built, found)
    if found.problems:
        return None
    if recorded is not None:
        _fetch_only(whole, {f"{entry.source}.{entry.output}" for entry in wires}.union(recorded))
    bus: list[Signal] = []
    outputs: dict[str, range] = {}
    for name, part in whole.items():
        outputs[name] = range(len(bus), len(bus) + len(part.component.outputs))
        bus += [replace(signal, name=f"{name}.{signal.name}") for signal in part.component.outputs]
    place = {signal.name: index for index, signal in enumerate(bus)}
    entering = {(entry.part, entry.input): place[f"{entry.source}.{entry.output}"] for entry in wires}
    slots = []
    for name in order:
        component = whole[name].component
        inputs = tuple(entering[name, signal.name] for signal in component.inputs)
        slots.append(Slot(name, component, inputs, outputs[name], whole[name].period))
    held = held_wires(order, wires)
    settings = {name: dict(part.settings) for name, part in whole.items()}
    columns = tuple(range(len(bus))) if recorded is None else tuple(place[name] for name in recorded)
    return System(grid, tuple(slots), tuple(bus), tuple(wires), held, columns, settings)


def _fetch_only(built: Mapping[str, _Built], needed: Iterable[str]) -> None:
    """Spares FMUs the outputs that are neither wired nor recorded."""
    by_part: dict[str, list[str]] = {name: [] for name in built}
    for signal in needed:
        name, _, output = signal.partition(".")
        by_part[name].append(output)
    for name, part in built.items():
        select = getattr(part.component, "select_outputs", None)
        if select is not None:
            select(by_part[name])


def _recorded(scenario: Scenario, built: Mapping[str, _Built | None], found: Findings) -> list[str] | None:
    """Names of the signals to record; None where the scenario leaves it at all of them."""
    if scenario.record is None:
        return None
    names: dict[str, None] = {}
    for index, text in enumerate(scenario.record):
        part = built.get(text)
        if part is not None:
            names |= dict.fromkeys(f"{text}.{signal.name}" for signal in part.component.outputs)
        elif text not in built:
            source = _find_output(text, built, found.at("record", index))
            if source is not None:
                names[".".join(source)] = None
    return list(names)
