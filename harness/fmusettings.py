"""What stands under `with` of an FMU: start values, sizes of arrays, text, and how Model Exchange is stepped."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from fmus.component import ConfigurationError, Signal
from fmus.description import FmuDescription
from fmus.exchange import Stepping, read_stepping
from fmus.units import UnitError, parse_unit
from fmus.variable import Variable
from harness.findings import Findings
from harness.settings import read_settings

_STEPPING = "solver."


class FmuSettings(NamedTuple):
    """Start values in SI, or text, by variable; and the stepping of Model Exchange."""

    starts: Mapping[str, float | str]
    stepping: Stepping


def read_fmu_settings(
    description: FmuDescription, settings: Mapping[str, Any], found: Findings
) -> tuple[FmuDescription, FmuSettings] | None:
    """The FMU with its arrays sized as set, and its settings; None and the problems in `found` where one is wrong.

    Of an FMU run by Model Exchange, `solver.method`, `solver.tolerance` and `solver.step` are those of the stepping,
    also where it has variables of these names, which are about its Co-Simulation.
    """
    before = len(found.problems)
    exchange = description.kind == "me"
    steps = {key: raw for key, raw in settings.items() if exchange and key.startswith(_STEPPING)}
    stepping = _stepping(steps, found)
    rest = {key: raw for key, raw in settings.items() if key not in steps}
    sizes = _sizes(description, rest, found)
    sized = description.restructured(sizes)
    texts = _texts(sized, rest, found)
    others = {key: raw for key, raw in rest.items() if key not in texts and key not in sizes}
    signals = [as_signal(v) for v in sized.variables if _numeric(v) and not (exchange and v.name.startswith(_STEPPING))]
    numbers = read_settings(_with_refusals(sized, signals, others, found), others, found)
    if numbers is None or len(found.problems) > before:
        return None
    return sized, FmuSettings({**sizes, **numbers, **texts}, stepping)


def as_signal(variable: Variable) -> Signal:
    """A variable of an FMU, with its unit as this project writes it."""
    unit = "1"
    if variable.quantity is not None:
        try:
            unit = variable.unit if parse_unit(variable.unit) == variable.quantity else variable.quantity.si_name()
        except UnitError:
            unit = variable.quantity.si_name()
    return Signal(variable.name, unit, shape=variable.shape)


def _numeric(variable: Variable) -> bool:
    return variable.settable and variable.on_bus


def _with_refusals(
    description: FmuDescription, signals: list[Signal], settings: Mapping[str, Any], found: Findings
) -> list[Signal]:
    """The signals, and a problem for each setting of a variable that is there but cannot be set."""
    names = {signal.name for signal in signals}
    fixed = {v.name: v for v in description.variables if v.name not in names}
    extra = []
    for key in settings:
        variable = fixed.get(key)
        if variable is not None:
            found.at(key).add(f"cannot be set: {_reason(variable)}")
            extra.append(Signal(key, "1", shape=variable.shape))
    return [*signals, *extra]


def _reason(variable: Variable) -> str:
    """Why a variable takes no setting."""
    if variable.alias:
        return "it is another name of a variable"
    if variable.type in ("Binary", "Clock") or variable.clocked:
        return f"it is of the type {variable.type}{' and held by a clock' if variable.clocked else ''}"
    if variable.variability == "constant":
        return "it is constant"
    if variable.causality in ("independent", "calculatedParameter"):
        return f"its causality is {variable.causality}"
    return f"it is computed: its causality is {variable.causality}, and it has no start value of its own"


def _stepping(settings: Mapping[str, Any], found: Findings) -> Stepping:
    before = len(found.problems)
    given = {key: raw for key, raw in settings.items() if key in ("solver.tolerance", "solver.step")}
    numbers = read_settings((Signal("solver.tolerance"), Signal("solver.step", "s")), given, found) or {}
    others = {key: raw for key, raw in settings.items() if key not in given}
    if len(found.problems) == before:
        try:
            return read_stepping({key.removeprefix(_STEPPING): value for key, value in {**others, **numbers}.items()})
        except ConfigurationError as error:
            for problem in error.problems:
                found.tell(str(problem))
    return Stepping()


def _sizes(description: FmuDescription, settings: Mapping[str, Any], found: Findings) -> dict[str, float]:
    before = len(found.problems)
    structural = [v for v in description.variables if v.structural]
    given = {v.name: settings[v.name] for v in structural if v.name in settings}
    sizes = read_settings((as_signal(v) for v in structural), given, found) or {}
    for variable in structural:
        value = sizes.get(variable.name)
        low, high = max(variable.minimum, 0.0), variable.maximum
        if value is not None and not (value == round(value) and low <= value <= high):
            found.at(variable.name).add(f"wants a whole number, {low:.9g} to {high:.9g}, got {value:.9g}")
    return sizes if len(found.problems) == before else {}


def _texts(description: FmuDescription, settings: Mapping[str, Any], found: Findings) -> dict[str, str]:
    texts: dict[str, str] = {}
    known = {v.name: v for v in description.variables if v.type == "String" and v.settable and not v.shape}
    for key in known:
        if key in settings:
            if not isinstance(settings[key], str):
                found.at(key).add(f"wants text, got {settings[key]!r}")
            texts[key] = str(settings[key])
    return texts
