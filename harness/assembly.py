"""Puts built parts in their order on a bus: the system of a scenario whose parts and wires are known."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Literal, NamedTuple

from fmus.component import Component, Signal
from fmus.model import unknown
from fmus.units import parse_unit
from harness.arrays import off_bus
from harness.clock import CrankGrid, Grid, Pace
from harness.findings import Findings
from harness.held import HeldComponent
from harness.order import AlgebraicLoop, Order, Wire, connected, copied_wires, held_wires, order_together
from harness.reversal import why_not
from harness.scenario import Coupling, Scenario
from harness.system import Group, Slot, System

# Parts that put values by, for late wires and as first guesses; names that no part of a campaign can have.
HELD, GUESSED = "(held)", "(guessed"


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
    sensors = {name: part.component.role == "sensor" for name, part in whole.items()}
    loops: Literal["refused", "solved"] = "solved" if scenario.coupling.solve else "refused"
    try:
        order = order_together(sensors, wires, _together(scenario, whole, wires), loops)
    except AlgebraicLoop as error:
        first = error.wires[0]
        found.at("parts", first.part, "wires", first.input).tell(str(error))
        return None
    recorded = _recorded(scenario, built, found)
    clocked = _clocked(scenario, built, found)
    _check_clusters(order, whole, wires, found)
    if found.problems:
        return None
    if recorded is not None:
        needed = {f"{entry.source}.{entry.output}" for entry in wires} | {name for name in clocked if name}
        _fetch_only(whole, needed.union(recorded))
    everything = sum(len(part.component.outputs) for part in whole.values())
    names, instead = _with_heads(order, wires, whole)
    bus: list[Signal] = []
    outputs: dict[str, range] = {}
    for name, part in whole.items():
        outputs[name] = range(len(bus), len(bus) + len(part.component.outputs))
        bus += [replace(signal, name=f"{name}.{signal.name}") for signal in part.component.outputs]
    place = {signal.name: index for index, signal in enumerate(bus)}
    entering = {(entry.part, entry.input): place[f"{entry.source}.{entry.output}"] for entry in wires}
    entering |= {entrance: place[signal] for entrance, signal in instead.items()}
    slots = []
    for name in names:
        component = whole[name].component
        inputs = tuple(entering[name, signal.name] for signal in component.inputs)
        slots.append(Slot(name, component, inputs, outputs[name], whole[name].pace))
    speed, angle = (place[name] if name else None for name in clocked)
    system = System(
        grid=grid,
        parts=tuple(slots),
        bus=tuple(bus),
        wires=tuple(wires),
        held=held_wires(order.parts, wires),
        recorded=tuple(range(everything)) if recorded is None else tuple(place[name] for name in recorded),
        every=scenario.record.every,
        speed=speed,
        angle=angle,
        settings={name: dict(part.settings) for name, part in whole.items() if not name.startswith("(")},
        notes=tuple(_notes(scenario, whole, grid)),
        groups=tuple(_groups(order, names, place, scenario.coupling)),
        coupling=scenario.coupling,
    )
    return _steered(system, found) if isinstance(grid, CrankGrid) and grid.steer == "exact" else system


def _together(scenario: Scenario, built: Mapping[str, Built], wires: Sequence[Wire]) -> list[frozenset[str]]:
    """The groups of plants that feed each other, where they are to take smaller steps."""
    if scenario.coupling.error is None:
        return []
    plants = [name for name, part in built.items() if part.component.role == "plant"]
    return connected(plants, [wire for wire in wires if wire.source in plants and wire.part in plants])


def _check_clusters(order: Order, built: Mapping[str, Built], wires: Sequence[Wire], found: Findings) -> None:
    """Whether the parts of each cluster can be taken back, and are stepped at the same instants."""
    for cluster in order.clusters:
        inside = next(wire for wire in wires if wire.source in cluster.parts and wire.part in cluster.parts)
        for name in cluster.parts:
            here = found.at("parts", name)
            reason = why_not(built[name].component)
            if reason:
                here.tell(f"{name} is one of parts that feed each other and wants to be taken back for it: {reason}")
            if built[name].pace != built[cluster.parts[0]].pace or built[name].pace.own:
                here.at("every").add(
                    f"wants to be that of {cluster.parts[0]}, since they are solved together: {inside}"
                )


def _with_heads(
    order: Order, wires: Sequence[Wire], whole: dict[str, Built]
) -> tuple[list[str], dict[tuple[str, str], str]]:
    """The order with the parts that put values by, added to `whole`; and what enters where instead of the wires.

    The values of late wires are put by at the begin of an instant, those among plants that take smaller steps at the
    begin of each of those. A loop has its torn signals' values put by at its head.
    """
    names = list(order.parts)
    instead: dict[tuple[str, str], str] = {}

    def put_by(head: str, late: Sequence[Wire], at: int, pace: Pace) -> None:
        if not late:
            return
        carried = {f"{one.source}.{one.output}": output((one.source, one.output), whole) for one in late}
        signals = [replace(signal, name=name) for name, signal in carried.items()]
        whole[head] = Built(HeldComponent(signals), pace, {})
        names.insert(at, head)
        instead.update({(one.part, one.input): f"{head}.{one.source}.{one.output}" for one in late})
        instead.update({(head, name): name for name in carried})

    late = copied_wires(order.parts, wires)
    for number, cluster in enumerate(order.clusters, start=1):
        inside = [wire for wire in late if not cluster.torn and {wire.source, wire.part} <= set(cluster.parts)]
        pace = whole[cluster.parts[0]].pace
        put_by(f"{GUESSED} {number})", cluster.torn or inside, names.index(cluster.parts[0]), pace)
        late = tuple(wire for wire in late if wire not in inside)
    put_by(HELD, late, 0, Pace())
    return names, instead


def _groups(order: Order, names: Sequence[str], place: Mapping[str, int], coupling: Coupling) -> Iterator[Group]:
    for number, cluster in enumerate(order.clusters, start=1):
        head = f"{GUESSED} {number})"
        with_head = (head, *cluster.parts) if head in names else cluster.parts
        signals = dict.fromkeys(f"{wire.source}.{wire.output}" for wire in cluster.torn)
        torn = tuple((place[f"{head}.{signal}"], place[signal]) for signal in signals)
        kind = (coupling.solve or "") if torn else "smaller steps"
        yield Group(kind, names.index(with_head[0]), len(with_head), torn, cluster.cycle)


def _steered(system: System, found: Findings) -> System:
    """The system with the parts up to the plant whose angle the clock steers to as a group of their own."""
    here = found.at("clock", "crank", "steer")
    if system.angle is None:
        here.add("wants an `angle` to steer to")
        return system
    index = next(index for index, slot in enumerate(system.parts) if system.angle in slot.outputs)
    for slot in system.parts[: index + 1]:
        reason = "" if slot.name.startswith("(") else why_not(slot.component)
        if reason:
            here.add(f"exact wants {slot.name}, which is stepped before the angle is known, to be taken back: {reason}")
        if slot.pace != Pace():
            here.add(f"exact wants {slot.name}, stepped before the angle is known, to be stepped at every instant")
    if any(group.first <= index for group in system.groups):
        here.add("exact wants no parts that feed each other up to the one whose angle it is")
    return replace(system, steered=Group("steered", 0, index + 1))


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
