"""What the `use` of a part stands for: an FMU, or a module with a MODEL or a `make`; and its settings in SI."""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np

from fmus.binding import bind_units
from fmus.component import Component, ConfigurationError, Signal
from fmus.description import Validation, describe
from fmus.export import cached_fmu
from fmus.fmu import load_fmu
from fmus.model import Model, ModelError, unknown
from fmus.units import parse_unit
from harness.findings import Findings
from harness.fmusettings import read_fmu_settings
from harness.scenario import ModelPart
from harness.settings import read_arguments, read_settings

# Settings that every exported FMU has besides its own.
SOLVER = (Signal("solver.method"), Signal("solver.step", "s"), Signal("solver.tolerance"))


class Resolved(NamedTuple):
    """A component and the settings it was made with, in SI, by variable or argument name; its model, if it has one."""

    component: Component
    settings: Mapping[str, float]
    model: Model | None = None


def resolve(
    spec: ModelPart, part: str, step: float, found: Findings, validation: Validation = "warn"
) -> Resolved | None:
    """The component of a plant, observer or controller; None where problems were found.

    `step` [s] is what the part steps by, 0 where that changes: a `make` with an argument `sample_time` is given it
    unless the settings say otherwise, and the sample time of a sampled model is to be a multiple of it, or 0: each
    step. `validation` is for FMU files.
    """
    try:
        if spec.use.endswith(".fmu"):
            return _from_file(spec, part, found, validation)
        if _is_plain(spec, found):
            return _from_module(spec, part, step, found)
        return None
    except ConfigurationError as error:
        for problem in error.problems:
            found.at("use").tell(f"{part}: {problem}")
        return None


def _from_file(spec: ModelPart, part: str, found: Findings, validation: Validation) -> Resolved | None:
    path = found.folder / spec.use
    if not path.is_file():
        found.at("use").add(f"wants an FMU, but there is no file {path}")
        return None
    if spec.parameter_set is not None:
        found.at("set").add("wants a model in a module: an FMU has no named sets; give the values under `with`")
        return None
    described = describe(path, validation)
    if spec.kind is not None:
        described = described.run_as(spec.kind)
    try:
        described = bind_units(described, spec.units, part)
    except ConfigurationError as error:
        for problem in error.problems:
            found.at("units").tell(str(problem))
        return None
    read = read_fmu_settings(described, spec.settings, found.at("with"))
    # With wrong settings it is loaded as it comes, so that what is wrong with its wires is told too.
    starts, stepping = ({}, None) if read is None else read[1]
    component = load_fmu(
        path,
        starts=starts,
        name=part,
        role=spec.role or "plant",
        validation=validation,
        units=spec.units,
        kind=spec.kind,
        stepping=stepping,
    )
    return Resolved(component, {name: value for name, value in starts.items() if not isinstance(value, str)})


def _is_plain(spec: ModelPart, found: Findings) -> bool:
    """Whether a module's part leaves out what only an FMU is told; a problem for each that it does not."""
    keys = [key for key in ("role", "kind", "units") if getattr(spec, key)]
    for key in keys:
        found.at(key).add(f"wants an .fmu: {spec.use} says this of itself")
    return not keys


def _from_module(spec: ModelPart, part: str, step: float, found: Findings) -> Resolved | None:
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
        return _from_model(given, spec, part, spec.settings, step, found)
    elif callable(given):
        return _made(given, spec, part, step, found)
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
        found.add(unknown(name, ["source", "sensor", "replay", *_shipped()], "module"))
    except (ImportError, SyntaxError, ValueError) as error:
        found.add(f"{name} cannot be imported: {error}")
    return None


def _shipped() -> Iterable[str]:
    """The modules of plants, controllers and observers that can be used by name."""
    for package in ("fmus.plants", "fmus.controllers", "observers"):
        for module in pkgutil.iter_modules(importlib.import_module(package).__path__, f"{package}."):
            yield module.name


def _from_model(
    model: Model, spec: ModelPart, part: str, settings: Mapping[str, Any], step: float, found: Findings
) -> Resolved | None:
    """The model's FMU with the parameter set and the settings applied."""
    signals = (*model.parameters, *model.states, *model.discrete, *SOLVER)
    chosen = _parameter_set(model, spec.parameter_set, found.at("set"))
    given = read_settings(signals, settings, found.at("with"))
    # With wrong settings the part is made as declared, so that what is wrong with its wires is told too.
    starts = {} if chosen is None or given is None else {**chosen, **given}
    if not _samples_on_steps(model, starts, step, found):
        return None
    try:
        component = load_fmu(_exported(_Same(model)), starts=starts, name=part, role=model.role)
    except ModelError as error:
        found.at("use").tell(f"{part}: {error}")
        return None
    return Resolved(component, starts, model)


def _samples_on_steps(model: Model, starts: Mapping[str, float], step: float, found: Findings) -> bool:
    """Whether a sampled model samples at ends of the part's steps; a problem where it does not."""
    if not model.sample_time:
        return True
    declared = next(signal for signal in model.parameters if signal.name == model.sample_time)
    period = starts.get(declared.name, parse_unit(declared.unit).to_si(float(declared.start)))
    if period == 0.0:
        return True
    if step == 0.0:
        wanted = "wants 0 s, to sample at each step of the crank clock; or give the part an `every` in time"
        found.at("with", declared.name).add(f"{wanted}, got {period:.9g} s")
        return False
    ratio = period / step
    if round(ratio) >= 1 and abs(ratio - round(ratio)) <= 1e-6 * ratio:
        return True
    found.at("with", declared.name).add(f"wants a multiple of what the part steps by, {step:.9g} s, got {period:.9g} s")
    return False


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


def _made(make: Callable[..., Any], spec: ModelPart, part: str, step: float, found: Findings) -> Resolved | None:
    """What a `make` returns for the part's settings, each converted as the argument is annotated."""
    arguments = read_arguments(make, spec.settings, step, found.at("with"))
    if arguments is None:
        return None
    try:
        made: Any = _made_model(_Call(make, repr(arguments), arguments))
    except _NoModel as result:
        made = result.made
    except ConfigurationError as error:
        for problem in error.problems:
            found.at("with").tell(f"{part}: {problem}")
        return None
    except ValueError as error:
        found.at("with").tell(f"{part}: {error}")
        return None
    numbers = {name: float(value) for name, value in arguments.items() if isinstance(value, (int, float))}
    if isinstance(made, Model):
        resolved = _from_model(made, spec, part, {}, step, found)
        return resolved and resolved._replace(settings={**numbers, **resolved.settings})
    if not isinstance(made, Component):
        found.at("use").add(f"wants make to return a Model or a Component, got {type(made).__name__}")
        return None
    if spec.parameter_set is not None:
        found.at("set").add("wants a Model: this component has no named sets; give the values under `with`")
        return None
    return Resolved(made, numbers)


@dataclass(frozen=True)
class _Call:
    """A call of a `make`; two with arguments that read the same are one."""

    make: Callable[..., Any]
    text: str
    arguments: Mapping[str, Any] = field(compare=False)


class _NoModel(Exception):
    def __init__(self, made: Any) -> None:
        self.made = made


@lru_cache(maxsize=128)
def _made_model(call: _Call) -> Model:
    """The model that a `make` returns, designed once for all cases of a process. Raises _NoModel with anything else."""
    made = call.make(**call.arguments)
    if not isinstance(made, Model):
        raise _NoModel(made)
    return made


@dataclass(frozen=True, eq=False)
class _Same:
    """A model that equals only itself."""

    model: Model

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Same) and self.model is other.model

    def __hash__(self) -> int:
        return id(self.model)


@lru_cache(maxsize=128)
def _exported(same: _Same) -> Path:
    """The FMU of a model, traced once for all cases of a process."""
    return cached_fmu(same.model)
