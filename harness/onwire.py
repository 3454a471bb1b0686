"""What stands on wires: a part for the faults of each wire that has some, and the swaps behind the signals they swap.

Wires are first those the scenario speaks of, from a part's output to the input it enters; units, kinds and truth are
judged by them. `rewired` then leads them through what stands between.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

from fmus.component import Component, Signal
from harness.arrays import endings
from harness.faults import Sampling, read_faults, timed
from harness.findings import Findings
from harness.order import Wire
from harness.scenario import Clock, CrankPart, Fault, ModelPart, Part, SensorPart, SwapPart
from harness.sensor import Errors, SensorComponent

_NO_LETTERS = re.compile(r"\W+")


class OnWire(NamedTuple):
    """A wire with faults: the part and the input it enters, under which key it is written, its source as written."""

    part: str
    input: str
    key: str
    source: str
    faults: Sequence[Fault]


class Given(NamedTuple):
    """A signal and the component that gives it; `name` is part.output."""

    name: str
    signal: Signal
    source: Component


def faulty_wires(
    parts: Mapping[str, Part], components: Mapping[str, Component | None], found: Findings
) -> dict[str, OnWire]:
    """The wires with faults, by the name of the part that stands on each: PART__INPUT, of letters, digits and _.

    A wire between arrays is one wire a scalar.
    """
    named: dict[str, OnWire] = {}
    for part, spec in parts.items():
        for key, wire in spec.wires.items() if isinstance(spec, ModelPart) else ():
            component = components.get(part)
            for index in endings(key, component.inputs if component else ()) if wire.faults else ():
                name = f"{part}__{_NO_LETTERS.sub('_', key + index).strip('_')}"
                if name in parts or name in named:
                    told = f"the part that stands on this wire is named {name}, and so is another; rename that one"
                    found.at("parts", part, "wires", key, "faults").tell(told)
                else:
                    named[name] = OnWire(part, key + index, key, wire.source + index, wire.faults)
    return named


def reads(spec: Part, clock: Clock) -> dict[str, str]:
    """What a sensor, a crank or a swap reads, as written, by input; nothing of other parts.

    A crank that names nothing reads the angle that the clock steers to, where it does.
    """
    if isinstance(spec, SwapPart):
        return dict(zip(("first", "second"), spec.between, strict=True))
    if isinstance(spec, SensorPart):
        return {"of": spec.of}
    steered = clock.crank.angle if clock.crank is not None else None
    of = (spec.of or steered) if isinstance(spec, CrankPart) else None
    return {"of": of} if of else {}


def build_on_wire(
    name: str,
    wire: OnWire,
    given: Given,
    target: Component,
    sampling: Sampling,
    seed: int,
    found: Findings,
) -> SensorComponent:
    """The part that stands on a wire; what is wrong with its faults goes to `found`.

    What a plant gives or is given through it is the truth, as the plant's own signals are.
    """
    faults = read_faults(wire.faults, given.signal.unit, sampling, found)
    truth = given.source.role == "plant" or target.role == "plant"
    built = SensorComponent(
        given.signal,
        Errors(faults=faults),
        sampling.pace.step,
        seed=seed,
        part=name,
        role="plant" if truth else given.source.role,
        timed=timed(given.source),
    )
    wanted = next((signal for signal in target.inputs if signal.name == wire.input), None)
    if wanted is not None and wanted.kind != "real" and given.signal.kind != "real" and built.outputs[0].kind == "real":
        told = f"{wire.part}.{wire.input} wants {wanted.kind} values, which these faults do not leave; use"
        found.tell(f"{told} stuck, drop_out or a delay of whole steps")
    return built


def check_smaller_steps(
    wires: Sequence[Wire],
    on_wires: Mapping[str, OnWire],
    swaps: Iterable[str],
    components: Mapping[str, Component],
    found: Findings,
) -> None:
    """That no faults stand between plants, where those that feed each other take smaller steps than the clock."""
    told = "plants that feed each other take smaller steps (coupling.error), which faults between them cannot count"
    for entry in wires:
        plants = components[entry.source].role == components[entry.part].role == "plant"
        name = next((name for name, one in on_wires.items() if (one.part, one.input) == (entry.part, entry.input)), "")
        if plants and name:
            found.at("parts", entry.part, "wires", on_wires[name].key, "faults").tell(told)
        if plants and entry.part in swaps:
            found.at("parts", entry.part).tell(told)


def check_swaps(
    wires: Sequence[Wire],
    on_wires: Mapping[str, OnWire],
    swaps: Iterable[str],
    components: Mapping[str, Component],
    found: Findings,
) -> None:
    """That what reads one of two swapped signals may read the other: kinds fit, and no observer is given the truth."""
    behind = [Wire(name, "value", one.part, one.input, False) for name, one in on_wires.items() if name in components]
    for swap in swaps:
        pair = [(entry.source, entry.output) for entry in wires if entry.part == swap]
        readers = [entry for entry in (*wires, *behind) if entry.part != swap]
        for own, other in zip(pair, reversed(pair), strict=True):
            source = components[other[0]]
            given = next(signal for signal in source.outputs if signal.name == other[1])
            for entry in readers:
                if (entry.source, entry.output) != own:
                    continue
                target = components[entry.part]
                wanted = next(signal for signal in target.inputs if signal.name == entry.input)
                reads = f"while {'.'.join(own)} is swapped, {entry.part}.{entry.input}"
                here = found.at("parts", swap, "between")
                if source.role == "plant" and target.role == "observer":
                    here.tell(f"{reads} reads the truth, {'.'.join(other)}: swap it with a sensor of that")
                if wanted.kind != "real" and given.kind == "real" and source.role != "source":
                    here.tell(f"{reads} wants {wanted.kind} values, got real ones from {'.'.join(other)}")


def rewired(wires: Sequence[Wire], on_wires: Mapping[str, OnWire], swaps: Iterable[str]) -> list[Wire]:
    """The wires as led through the parts that stand on them, and from the swaps that stand behind their sources.

    A signal swapped twice passes the swaps in their order.
    """
    through = {(one.part, one.input): name for name, one in on_wires.items()}
    led: list[Wire] = []
    for entry in wires:
        name = through.get((entry.part, entry.input))
        if name is None:
            led.append(entry)
        else:
            led.append(Wire(entry.source, entry.output, name, "of", True))
            led.append(entry._replace(source=name, output="value"))
    for swap in swaps:
        ends = {(entry.source, entry.output): entry.input for entry in led if entry.part == swap}
        led = [
            entry._replace(source=swap, output=ends[entry.source, entry.output])
            if entry.part != swap and (entry.source, entry.output) in ends
            else entry
            for entry in led
        ]
    return led
