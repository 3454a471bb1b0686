"""What the `use` of a part stands for: an FMU, or a module with a MODEL or a `make`; and its settings in SI."""

from __future__ import annotations

import importlib
import inspect
import pkgutil
import re
from collections.abc import Callable, Iterable, Mapping
from types import ModuleType
from typing import Annotated, Any, NamedTuple, get_args, get_origin, get_type_hints

import numpy as np

from fmus.component import Component, ConfigurationError, Signal
from fmus.description import Variable, describe
from fmus.export import cached_fmu
from fmus.fmu import load_fmu
from fmus.model import Model, ModelError, unknown
from fmus.units import UnitError, parse_unit
from harness.findings import Findings
from harness.scenario import Measure, ModelPart, read_measure

# Settings that every exported FMU has besides its own.
SOLVER = (Signal("solver.method"), Signal("solver.step", "s"), Signal("solver.tolerance"))
_LIST = re.compile(r"\s*\[(?P<numbers>[^\]]*)\]\s*(?P<unit>.*)$")


class Resolved(NamedTuple):
    """A component and the settings it was made with, in SI, by variable or argument name."""

    component: Component
    settings: Mapping[str, float]


def resolve(spec: ModelPart, part: str, found: Findings) -> Resolved | None:
    """The component of a plant, observer or controller; None where problems were found."""
    try:
        return _from_file(spec, part, found) if spec.use.endswith(".fmu") else _from_module(spec, part, found)
    except ConfigurationError as error:
        for problem in error.problems:
            found.at("use").tell(f"{part}: {problem}")
        return None


def _from_file(spec: ModelPart, part: str, found: Findings) -> Resolved | None:
    path = found.folder / spec.use
    if not path.is_file():
        found.at("use").add(f"wants an FMU, but there is no file {path}")
        return None
    if spec.parameter_set is not None:
        found.at("set").add("wants a model in a module: an FMU has no named sets; give the values under `with`")
        return None
    variables = [variable for variable in describe(path).variables if variable.settable and variable.on_bus]
    starts = read_settings((_as_signal(variable) for variable in variables), spec.settings, found.at("with"))
    return None if starts is None else Resolved(load_fmu(path, starts=starts, name=part), starts)


def _as_signal(variable: Variable) -> Signal:
    """A variable of an FMU, with its unit as this project writes it."""
    unit = "1"
    if variable.quantity is not None:
        try:
            unit = variable.unit if parse_unit(variable.unit) == variable.quantity else variable.quantity.si_name()
        except UnitError:
            unit = variable.quantity.si_name()
    return Signal(variable.name, unit, shape=variable.shape)


def _from_module(spec: ModelPart, part: str, found: Findings) -> Resolved | None:
    module_name, _, attribute = spec.use.partition(":")
    module = _import(module_name, found.at("use"))
    if module is None:
        return None
    given = next(
        (getattr(module, name) for name in ((attribute,) if attribute else ("MODEL", "make")) if hasattr(module, name)),
        None,
    )
    if given is None and attribute:
        public = [name for name in vars(module) if not name.startswith("_")]
        found.at("use").add(unknown(attribute, public, f"model in {module_name}"))
    elif given is None:
        found.at("use").add(f"wants a module with a MODEL or a make, got {module_name}, which has neither")
    elif isinstance(given, Model):
        return _from_model(given, spec, part, spec.settings, found)
    elif callable(given):
        return _made(given, spec, part, found)
    else:
        found.at("use").add(f"wants a Model or a function that makes one, got {type(given).__name__}")
    return None


def _import(name: str, found: Findings) -> ModuleType | None:
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        if error.name is None or not (name == error.name or name.startswith(f"{error.name}.")):
            found.add(f"{name} wants the module '{error.name}', which is not installed")
            return None
        found.add(unknown(name, ["source", "sensor", *_shipped()], "module"))
    except (ImportError, SyntaxError, ValueError) as error:
        found.add(f"{name} cannot be imported: {error}")
    return None


def _shipped() -> Iterable[str]:
    """The modules of plants and observers that can be used by name."""
    for package in ("fmus.plants", "observers"):
        for module in pkgutil.iter_modules(importlib.import_module(package).__path__, f"{package}."):
            yield module.name


def _from_model(
    model: Model, spec: ModelPart, part: str, settings: Mapping[str, Any], found: Findings
) -> Resolved | None:
    """The model's FMU with the parameter set and the settings applied."""
    signals = (*model.parameters, *model.states, *model.discrete, *SOLVER)
    chosen = _parameter_set(model, spec.parameter_set, found.at("set"))
    given = read_settings(signals, settings, found.at("with"))
    if chosen is None or given is None:
        return None
    try:
        component = load_fmu(cached_fmu(model), starts={**chosen, **given}, name=part, role=model.role)
    except ModelError as error:
        found.at("use").tell(f"{part}: {error}")
        return None
    return Resolved(component, {**chosen, **given})


def _parameter_set(model: Model, name: str | None, found: Findings) -> dict[str, float] | None:
    """The values of a named parameter set in SI; None and a problem where the model has no such set."""
    if name is None:
        return {}
    if name not in model.parameter_sets:
        found.add(unknown(name, model.parameter_sets, f"parameter set of {model.name}"))
        return None
    values: dict[str, float] = {}
    for signal in model.parameters:
        if signal.name in model.parameter_sets[name]:
            unit = parse_unit(signal.unit)
            numbers = np.asarray(model.parameter_sets[name][signal.name], dtype=float)
            flat = np.broadcast_to(numbers, signal.shape).ravel()
            values |= {scalar: unit.to_si(float(v)) for scalar, v in zip(signal.scalar_names(), flat, strict=True)}
    return values


def read_settings(signals: Iterable[Signal], settings: Mapping[str, Any], found: Findings) -> dict[str, float] | None:
    """Settings in SI by scalar name; each key a signal or a scalar of an array, each value a quantity or several.

    None and the problems in `found` where one is of no signal, of another dimension or of another shape.
    """
    before = len(found.problems)
    whole = {signal.name: signal for signal in signals}
    scalars = {
        name: Signal(name, signal.unit) for signal in whole.values() if signal.shape for name in signal.scalar_names()
    }
    values: dict[str, float] = {}
    for key, raw in settings.items():
        signal = whole.get(key) or scalars.get(key)
        if signal is None:
            found.at(key).add(unknown(key, whole, "parameter or start value"))
        else:
            values |= zip(signal.scalar_names(), _numbers(raw, signal, found.at(key)), strict=False)
    return values if len(found.problems) == before else None


def _numbers(raw: Any, signal: Signal, found: Findings) -> list[float]:
    """The scalars of a signal, row-major, in SI."""
    measures = read_measures(raw, found)
    if measures is None:
        return []
    if len(measures) == 1 and not isinstance(raw, (list, tuple)):
        measures = measures * signal.size
    if len(measures) != signal.size:
        found.add(f"wants {signal.size} values, shape {signal.shape}, got {len(measures)}")
        return []
    return [found.value(measure, signal.unit) for measure in measures]


def read_measures(raw: Any, found: Findings) -> list[Measure] | None:
    """The quantities of `5 N.m`, 5, true, `[4, 5] N.m` or nested lists of those, row-major; None where it is none."""
    if isinstance(raw, bool):
        return [Measure(float(raw), "")]
    if isinstance(raw, (list, tuple)) and not isinstance(raw, Measure):
        rows = [read_measures(value, found) for value in raw]
        return (
            None
            if any(row is None for row in rows)
            else [measure for row in rows if row is not None for measure in row]
        )
    match = _LIST.match(raw) if isinstance(raw, str) else None
    try:
        if match:
            return [read_measure(f"{number} {match['unit']}") for number in match["numbers"].split(",")]
        return [read_measure(raw)]
    except ValueError as error:
        found.add(str(error))
        return None


def _made(make: Callable[..., Any], spec: ModelPart, part: str, found: Findings) -> Resolved | None:
    """What a `make` returns for the part's settings, each converted as the argument is annotated."""
    before = len(found.problems)
    arguments = _arguments(make, spec.settings, found.at("with"))
    if len(found.problems) > before:
        return None
    try:
        made = make(**arguments)
    except ValueError as error:
        found.at("with").tell(f"{part}: {error}")
        return None
    numbers = {name: float(value) for name, value in arguments.items() if isinstance(value, (int, float))}
    if isinstance(made, Model):
        resolved = _from_model(made, spec, part, {}, found)
        return resolved and Resolved(resolved.component, {**numbers, **resolved.settings})
    if not isinstance(made, Component):
        found.at("use").add(f"wants make to return a Model or a Component, got {type(made).__name__}")
        return None
    if spec.parameter_set is not None:
        found.at("set").add("wants a Model: this component has no named sets; give the values under `with`")
        return None
    return Resolved(made, numbers)


def _arguments(make: Callable[..., Any], settings: Mapping[str, Any], found: Findings) -> dict[str, Any]:
    parameters = inspect.signature(make).parameters
    hints = get_type_hints(make, include_extras=True)
    named = [name for name, p in parameters.items() if p.kind in (p.KEYWORD_ONLY, p.POSITIONAL_OR_KEYWORD)]
    open_ended = any(p.kind is p.VAR_KEYWORD for p in parameters.values())
    arguments = {}
    for key, raw in settings.items():
        if key in named:
            arguments[key] = _argument(raw, hints.get(key, Any), found.at(key))
        elif open_ended:
            arguments[key] = raw
        else:
            found.at(key).add(unknown(key, named, "argument"))
    for name in named:
        if parameters[name].default is inspect.Parameter.empty and name not in settings:
            found.at(name).add(f"wants a value; write `with: {{{name}: ...}}`")
    return arguments


def _argument(raw: Any, hint: Any, found: Findings) -> Any:
    """A setting as an annotation asks for it: in SI where it names a unit, else a plain number, else as written."""
    unit, numeric = _annotation(hint)
    if raw is None or (unit is None and numeric is None):
        return raw
    if numeric is int and isinstance(raw, int) and not isinstance(raw, bool):
        return raw
    measures = read_measures(raw, found)
    if measures is None:
        return raw
    values = [found.value(measure, unit or "1") for measure in measures]
    if numeric is int:
        if any(value != round(value) for value in values):
            found.add(f"wants an integer, got {raw}")
        values = [round(value) for value in values]
    listed = isinstance(raw, (list, tuple)) or (isinstance(raw, str) and _LIST.match(raw))
    return values if listed else values[0]


def _annotation(hint: Any) -> tuple[str | None, type | None]:
    """The unit an annotation names, and the kind of number it is; None where it says nothing."""
    if get_origin(hint) is Annotated:
        inner, *extras = get_args(hint)
        unit = next((extra for extra in extras if isinstance(extra, str)), None)
        return unit, _annotation(inner)[1] or float
    if hint in (int, float):
        return None, hint
    for member in get_args(hint) if get_origin(hint) is not None and get_origin(hint) is not dict else ():
        unit, numeric = _annotation(member)
        if unit is not None:
            return unit, numeric
    return None, None
