"""Puts built parts in their order on a bus: the system of a scenario whose parts and wires are known."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

from fmus.component import Component, Signal
from fmus.model import unknown
from fmus.units import parse_unit
from harness.arrays import off_bus
from harness.clock import CrankGrid, Grid, Pace
from harness.findings import Findings
from harness.held import HeldComponent
from harness.order import AlgebraicLoop, Wire, copied_wires, held_wires, order_parts
from harness.scenario import Scenario
from harness.system import Slot, System

# The part that puts values by for late wires; a name that no part of a campaign can have.
HELD = "(held)"


class Built(NamedTuple):
    """A component, when it is stepped, and the settings it was made with, in SI."""

    component: Component
    pace: Pace
    settings: Mapping[str, float]


def output(source: tuple[str, str], built: Mapping[str, Built | None]) -> Signal:
    """The signal of a part's output that `find_output` found."""
    part = built[source[0]]
    assert part is not None, "only outputs of built parts are found"
    return next(signal for signal in part.component.outputs if signal.name == source[1])


def find_output(text: str, built: Mapping[str, Built | None], found: Findings) -> tuple[str, str] | None:
    """Part and output of `part.output`, or of `part` with one output; None where the part has problems itself."""
    part, _, name = text.partition(".")
    if part not in built:
        found.add(unknown(part, built, "part"))
        return None
    source = built[part]
    if source is None:
        return None
    names = [signal.name for signal in source.component.outputs]
    if name in names:
        return part, name
    if name:
        why = off_bus(name, source.component)
        told = f"{text} {why}" if why else unknown(text, [f"{part}.{one}" for one in names], "signal")
        found.add(told)
    elif len(names) == 1 or "value" in names:
        return part, names[0] if len(names) == 1 else "value"
    else:
        listed = ", ".join(f"{part}.{one}" for one in names) or "none"
        found.add(f"wants one output of {part}, got '{text}'; there are {listed}")
    return None


def assemble(
    scenario: Scenario, grid: Grid, built: Mapping[str, Built | None], wires: Sequence[Wire], found: Findings
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
    clocked = _clocked(scenario, built, found)
    if found.problems:
        return None
    if recorded is not None:
        needed = {f"{entry.source}.{entry.output}" for entry in wires} | {name for name in clocked if name}
        _fetch_only(whole, needed.union(recorded))
    copied = copied_wires(order, wires)
    if copied:
        carried = {f"{one.source}.{one.output}": output((one.source, one.output), whole) for one in copied}
        signals = [replace(signal, name=name) for name, signal in carried.items()]
        whole[HELD] = Built(HeldComponent(signals), Pace(), {})
        order = (HELD, *order)
    bus: list[Signal] = []
    outputs: dict[str, range] = {}
    for name, part in whole.items():
        outputs[name] = range(len(bus), len(bus) + len(part.component.outputs))
        bus += [replace(signal, name=f"{name}.{signal.name}") for signal in part.component.outputs]
    place = {signal.name: index for index, signal in enumerate(bus)}
    entering = {(entry.part, entry.input): place[f"{entry.source}.{entry.output}"] for entry in wires}
    entering |= {(one.part, one.input): place[f"{HELD}.{one.source}.{one.output}"] for one in copied}
    entering |= {(HELD, name): place[name] for name in {f"{one.source}.{one.output}" for one in copied}}
    slots = []
    for name in order:
        component = whole[name].component
        inputs = tuple(entering[name, signal.name] for signal in component.inputs)
        slots.append(Slot(name, component, inputs, outputs[name], whole[name].pace))
    everything = len(bus) - len(outputs.get(HELD, ()))
    speed, angle = (place[name] if name else None for name in clocked)
    return System(
        grid=grid,
        parts=tuple(slots),
        bus=tuple(bus),
        wires=tuple(wires),
        held=held_wires(order, wires),
        recorded=tuple(range(everything)) if recorded is None else tuple(place[name] for name in recorded),
        every=scenario.record.every,
        speed=speed,
        angle=angle,
        settings={name: dict(part.settings) for name, part in whole.items() if name != HELD},
        notes=tuple(_notes(scenario, whole, grid)),
    )


def _notes(scenario: Scenario, built: Mapping[str, Built], grid: Grid) -> Iterable[tuple[str, str]]:
    """What a reader of the record should know of how parts are stepped."""
    for name, part in built.items():
        if part.pace.own:
            step = f"steps of {part.pace.own:g} s of its own"
            yield name, f"it makes {step} and is sampled at the instants of the crank clock, its last value standing"
    if isinstance(grid, CrankGrid) and scenario.clock.crank and not scenario.clock.crank.angle:
        speed = scenario.clock.crank.speed
        yield speed.partition(".")[0], f"the crank angle is that of {speed} at the begin of each step, not steered to"


def _clocked(scenario: Scenario, built: Mapping[str, Built | None], found: Findings) -> tuple[str, str]:
    """The names of the signals that a crank clock reads for speed and angle; empty where it reads none."""
    clock = scenario.clock.crank
    if clock is None:
        return "", ""
    names = []
    for key, text, unit in (("speed", clock.speed, "rad/s"), ("angle", clock.angle, "rad")):
        here = found.at("clock", "crank", key)
        source = find_output(text, built, here) if text else None
        names.append(".".join(source) if source else "")
        if source:
            got = output(source, built).unit
            if not parse_unit(got).same_dimension(parse_unit(unit)):
                bind = f"; bind its unit under `units` of {source[0]}" if not got else ""
                here.add(f"wants {unit}, got {got or 'no unit'} from {text}{bind}")
    return names[0], names[1]


def _fetch_only(built: Mapping[str, Built], needed: Iterable[str]) -> None:
    """Spares FMUs the outputs that are neither wired nor recorded."""
    by_part: dict[str, list[str]] = {name: [] for name in built}
    for signal in needed:
        name, _, one = signal.partition(".")
        by_part[name].append(one)
    for name, part in built.items():
        select = getattr(part.component, "select_outputs", None)
        if select is not None:
            select(by_part[name])


def _recorded(scenario: Scenario, built: Mapping[str, Built | None], found: Findings) -> list[str] | None:
    """Names of the signals to record; None where the scenario leaves it at all of them."""
    if scenario.record.signals is None:
        return None
    names: dict[str, None] = {}
    for index, text in enumerate(scenario.record.signals):
        part = built.get(text)
        if part is not None:
            names |= dict.fromkeys(f"{text}.{signal.name}" for signal in part.component.outputs)
        elif text not in built:
            source = find_output(text, built, found.at("record", index))
            if source is not None:
                names[".".join(source)] = None
    return list(names)
