"""Exports a model by name, with start values as a campaign would give them."""

from __future__ import annotations

import importlib
import inspect
import pkgutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, get_type_hints

import numpy as np

from fmus.component import ConfigurationError, Problem
from fmus.export import build_fmu
from fmus.model import Model, ModelError, unknown
from fmus.units import parse_unit
from harness.findings import Findings
from harness.places import Place, Places, read_yaml
from harness.resolve import SOLVER, read_settings
from harness.scenario import read_measure

# Where a short name like `driveline` is looked for.
PACKAGES = ("fmus.plants", "observers")


def build_model(
    name: str, path: Path, fmi: int, platforms: Sequence[str], parameter_set: str | None, settings: Sequence[str]
) -> Path:
    """The FMU at `path` of the model called `name`: a shipped one's short name, a module, or module:attribute.

    `settings` are `name=value`: start values, or the arguments of a `make`. Raises ConfigurationError.
    """
    if path.suffix != ".fmu":
        raise ConfigurationError(f"--out wants a file that ends in .fmu, got {path}")
    given, places = _read_settings(settings)
    found = find_model(name)
    try:
        if isinstance(found, Model):
            return build_fmu(found, path, fmi, platforms, _starts(found, parameter_set, given, places))
        if parameter_set is not None:
            raise ConfigurationError(f"{name} is made from its arguments and has no named sets; give them by --with")
        return build_fmu(_made(name, found, given, places), path, fmi, platforms)
    except ModelError as error:
        raise ConfigurationError(f"{name}: {error}") from error


def find_model(name: str) -> Model | Callable[..., Any]:
    """The model called `name`, or the function that makes it. Raises ConfigurationError: there is none."""
    module_name, _, attribute = name.partition(":")
    shipped = {
        module.name: f"{package}.{module.name}"
        for package in reversed(PACKAGES)
        for module in pkgutil.iter_modules(importlib.import_module(package).__path__)
    }
    full_name = shipped.get(module_name, module_name)
    try:
        module = importlib.import_module(full_name)
    except ModuleNotFoundError as error:
        if error.name is not None and not f"{full_name}.".startswith(f"{error.name}."):
            raise ConfigurationError(f"{full_name} wants the module '{error.name}', which is not installed") from error
        raise ConfigurationError(unknown(module_name, shipped, "model")) from error
    names = [attribute] if attribute else ["MODEL", "make"]
    found = next((getattr(module, one) for one in names if hasattr(module, one)), None)
    if isinstance(found, Model) or callable(found):
        return found
    raise ConfigurationError(f"{name} wants a Model or a function that makes one in {full_name}, got neither")


def _read_settings(settings: Sequence[str]) -> tuple[dict[str, Any], Places]:
    given: dict[str, Any] = {}
    spots: dict[tuple[str | int, ...], Place] = {}
    problems = []
    for setting in settings:
        name, equals, text = setting.partition("=")
        place = Place(f"--with {setting}")
        if not equals or not name.strip():
            problems.append(Problem("wants name=value, like k='1500 N.m/rad'", *place))
        else:
            given[name.strip()], _ = read_yaml(text, place.file)
            spots[(name.strip(),)] = place
    if problems:
        raise ConfigurationError(problems)
    return given, Places("", spots)


def _starts(model: Model, parameter_set: str | None, given: Mapping[str, Any], places: Places) -> dict[str, float]:
    """Start values by scalar name, in the units the model declares."""
    found = Findings(places)
    signals = (*model.parameters, *model.states, *model.discrete, *SOLVER)
    units = {scalar: parse_unit(signal.unit) for signal in signals for scalar in signal.scalar_names()}
    starts: dict[str, float] = {}
    if parameter_set is not None and parameter_set not in model.parameter_sets:
        raise ConfigurationError(f"--set: {unknown(parameter_set, model.parameter_sets, 'parameter set')}")
    chosen = model.parameter_sets[parameter_set] if parameter_set is not None else {}
    for signal in model.parameters:
        if signal.name in chosen:
            values = np.broadcast_to(np.asarray(chosen[signal.name], dtype=float), signal.shape).ravel()
            starts |= zip(signal.scalar_names(), map(float, values), strict=True)
    in_si = read_settings(signals, given, found)
    if in_si is None:
        raise ConfigurationError(found.problems)
    return starts | {name: units[name].from_si(value) for name, value in in_si.items()}


def _made(name: str, make: Callable[..., Any], given: Mapping[str, Any], places: Places) -> Model:
    """What `make` returns for arguments as written, in SI where its annotation names a unit."""
    hints = get_type_hints(make, include_extras=True)
    parameters = inspect.signature(make).parameters
    problems = [
        Problem(unknown(argument, parameters, "argument"), *places.of((argument,)))
        for argument in given
        if argument not in parameters
    ]
    required = [one for one, parameter in parameters.items() if parameter.default is inspect.Parameter.empty]
    problems += [Problem(f"{name} wants --with {one}=...") for one in required if one not in given]
    arguments = {}
    for argument, raw in given.items():
        unit = next(
            (extra for extra in getattr(hints.get(argument), "__metadata__", ()) if isinstance(extra, str)), None
        )
        try:
            arguments[argument] = raw if unit is None else read_measure(raw).si(unit)
        except ValueError as error:
            problems.append(Problem(str(error), *places.of((argument,))))
    if problems:
        raise ConfigurationError(problems)
    made = make(**arguments)
    if not isinstance(made, Model):
        raise ConfigurationError(f"{name} wants to be a Model to be exported, got {type(made).__name__}")
    return made
