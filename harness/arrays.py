"""Wires between whole arrays, as the wires between their scalars that they stand for."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

from fmus.component import Component, Signal
from harness.findings import Findings
from harness.scenario import WireSpec

_SCALAR = re.compile(r"(?P<array>.+)\[(?P<index>[\d,]+)\]$")


def spread(
    given: Mapping[str, WireSpec],
    component: Component,
    sources: Mapping[str, Component],
    found: Findings,
) -> dict[str, WireSpec]:
    """The wires `given` by input, with each wire between arrays spread over their scalars; the others as they are.

    A problem where the arrays are not of one shape, or where only one side is an array.
    """
    arrays = _arrays([signal.name for signal in component.inputs])
    wires: dict[str, WireSpec] = {}
    for name, spec in given.items():
        if name not in arrays:
            wires[name] = spec
            continue
        text = spec.source
        part, _, output = text.partition(".")
        wanted = arrays[name]
        if part not in sources:
            wires |= {f"{name}[{index}]": spec for index in wanted}
            continue
        offered = _arrays([signal.name for signal in sources[part].outputs]).get(output)
        if offered is None:
            found.at(name).add(f"wants {_size(wanted)}, got the single value {text}; wire {name}[{wanted[0]}] ...")
        elif offered != wanted:
            found.at(name).add(f"wants {_size(wanted)}, got {_size(offered)} from {text}")
        for index in wanted:
            one = f"{text}[{index}]" if offered == wanted else ""
            wires[f"{name}[{index}]"] = spec.model_copy(update={"source": one})
    return wires


def endings(name: str, signals: Sequence[Signal]) -> list[str]:
    """What the scalars of an array among the signals add to its name, like `[1,2]`; of a scalar, or an unknown: ''."""
    return [f"[{index}]" for index in _arrays([signal.name for signal in signals]).get(name, ())] or [""]


def off_bus(name: str, component: Component) -> str:
    """Why a variable that an FMU has cannot be wired; empty where it has no such variable."""
    variables = getattr(getattr(component, "description", None), "variables", ())
    variable = next((variable for variable in variables if variable.name == name), None)
    if variable is None:
        return ""
    if variable.type in ("String", "Binary", "Clock"):
        return f"is of the type {variable.type}, which no wire carries: wires carry numbers"
    if variable.clocked:
        return "has a value only while its clock ticks, which no wire carries"
    return f"is {variable.causality}, neither an input nor an output"


def _arrays(names: Sequence[str]) -> dict[str, list[str]]:
    """The indices of the scalars of each array among these names, in their order."""
    arrays: dict[str, list[str]] = {}
    for name in names:
        match = _SCALAR.match(name)
        if match:
            arrays.setdefault(match["array"], []).append(match["index"])
    return {array: indices for array, indices in arrays.items() if array not in names}


def _size(indices: Sequence[str]) -> str:
    return f"an array of {'x'.join(indices[-1].split(','))} values"
