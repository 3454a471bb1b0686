"""Exports a model by name, with start values as a campaign would give them."""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fmus.component import ConfigurationError, Problem
from fmus.export import build_fmu
from fmus.model import Model, ModelError, unknown
from fmus.python_export import build_python_fmu
from fmus.tracing import TraceError
from fmus.units import parse_unit
from harness.findings import Findings
from harness.places import Place, Places, read_yaml
from harness.resolve import SOLVER
from harness.settings import read_arguments, read_settings

# Where a short name like `driveline` is looked for.
PACKAGES = ("fmus.plants", "fmus.controllers", "observers")


class Export(NamedTuple):
    """What a user asks of an export: `settings` are `name=value`, start values or the arguments of a `make`."""

    path: Path
    fmi: int = 2
    platforms: Sequence[str] = ("native",)
    parameter_set: str | None = None
    settings: Sequence[str] = ()


def build_model(name: str, export: Export) -> Path:
    """The native FMU of the model called `name`: a shipped one's short name, a module, or module:attribute.

    Raises ConfigurationError: no such model, a setting that does not fit, a model that cannot be traced.
    """
    given, places = _checked(export)
    path, fmi, platforms, parameter_set, _ = export
    found, _ = find_model(name)
    try:
        if isinstance(found, Model):
            return build_fmu(found, path, fmi, platforms, _starts(found, parameter_set, given, places))
        if parameter_set is not None:
            raise ConfigurationError(f"{name} is made from its arguments and has no named sets; give them by --with")
        return build_fmu(made_model(name, found, given, places), path, fmi, platforms)
    except TraceError as error:
        raise ConfigurationError(f"{name}: {error}; as it stands it can be built with --python only") from error
    except ModelError as error:
        raise ConfigurationError(f"{name}: {error}") from error


def build_with_python(name: str, export: Export) -> Path:
    """The FMU with Python inside of a Model that a module holds, for one that cannot be traced into C.

    Raises ConfigurationError: no such model, a setting that does not fit, or something that only a native FMU has.
    """
    given, places = _checked(export)
    if export.fmi != 2 or tuple(export.platforms) != ("native",):
        raise ConfigurationError("an FMU with Python inside is FMI 2 and for the platforms of PythonFMU only")
    found, place = find_model(name)
    if not isinstance(found, Model):
        raise ConfigurationError(f"{name} wants to be a Model in a module to hold Python inside, got a function")
    try:
        starts = _starts(found, export.parameter_set, given, places)
        return build_python_fmu(*place, export.path, starts)
    except ModelError as error:
        raise ConfigurationError(f"{name}: {error}") from error


def _checked(export: Export) -> tuple[dict[str, Any], Places]:
    if export.path.suffix != ".fmu":
        raise ConfigurationError(f"--out wants a file that ends in .fmu, got {export.path}")
    return _read_settings(export.settings)


def find_model(name: str) -> tuple[Model | Callable[..., Any], tuple[str, str]]:
    """The model called `name`, or the function that makes it; and its module and name there.

    Raises ConfigurationError: there is none.
    """
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
    held = next((one for one in names if hasattr(module, one)), "")
    found = getattr(module, held, None)
    if isinstance(found, Model) or callable(found):
        return found, (full_name, held)
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
    starts = set_values(model, parameter_set)
    in_si = read_settings(signals, given, found)
    if in_si is None:
        raise ConfigurationError(found.problems)
    return starts | {name: units[name].from_si(value) for name, value in in_si.items()}


def set_values(model: Model, parameter_set: str | None) -> dict[str, float]:
    """The values of a named parameter set by scalar name, in the units the model declares; empty for no set.

    Raises ConfigurationError: the model has no such set.
    """
    if parameter_set is None:
        return {}
    if parameter_set not in model.parameter_sets:
        raise ConfigurationError(f"--set: {unknown(parameter_set, model.parameter_sets, 'parameter set')}")
    chosen = model.parameter_sets[parameter_set]
    found: dict[str, float] = {}
    for signal in model.parameters:
        if signal.name in chosen:
            values = np.broadcast_to(np.asarray(chosen[signal.name], dtype=float), signal.shape).ravel()
            found |= zip(signal.scalar_names(), map(float, values), strict=True)
    return found


def made_model(name: str, make: Callable[..., Any], given: Mapping[str, Any], places: Places) -> Model:
    """The Model that `make` returns for arguments as a campaign would give them."""
    found = Findings(places)
    arguments = read_arguments(make, given, None, found)
    if arguments is None:
        raise ConfigurationError(found.problems)
    made = make(**arguments)
    if not isinstance(made, Model):
        raise ConfigurationError(f"{name} wants to be a Model to be exported, got {type(made).__name__}")
    return made
