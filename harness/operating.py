"""A model by name, or an FMU, made linear at the operating point that a user names, or where it settles from there."""

from __future__ import annotations

import importlib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fmus.component import ConfigurationError, Problem, Signal, StepError, Vector
from fmus.description import Validation, describe
from fmus.linearfmu import linear_fmu
from fmus.linearmodel import LinearModel
from fmus.model import Model, ModelError, unknown
from fmus.modelstructure import read_structure
from fmus.rungs import Source
from fmus.statespace import StateSpace, at, linearised, settle
from fmus.steady import SteadyError
from fmus.units import UnitError, parse_unit
from harness.building import find_model, made_model, set_values
from harness.findings import Findings
from harness.fmusettings import as_signal, read_fmu_settings
from harness.places import Place, Places, read_yaml
from harness.quantity import read_measure
from harness.settings import read_settings
from harness.worker import isolated
from selection.branch import Branch
from selection.structure import Structure, branch_structure, observed_structure

# Commas between settings, not those inside brackets: `L[1,2]=3,k=4 N.m/rad`.
_BETWEEN = re.compile(r",(?=\s*[\w.]+(?:\[[^\]]*\])?\s*=)")


class Operation(NamedTuple):
    """What a user asks: a model's name or an FMU's file, the point as `name=value`, and whether to settle from there.

    `seconds` bounds what an FMU may take, which runs in a process of its own. `about` are `name=value` of what a
    reference shows at rest with these inputs: deviations are from there, and what the model does there counts as rest.
    """

    target: str
    point: Sequence[str] = ()
    parameter_set: str | None = None
    settled: bool = False
    validation: Validation = "warn"
    seconds: float = 60.0
    about: Sequence[str] = ()


@dataclass(frozen=True)
class Operating:
    """A system at its operating point, and the model where it is one; of an FMU there is the structure observed.

    `sensors` are the signals that a model's module declares can be measured, `accuracies` how exact, as shares, and
    `lags` the states of actuators and sensors; empty where it declares none.
    """

    space: StateSpace
    model: LinearModel | None = None
    observed: Structure | None = None
    sensors: tuple[str, ...] = ()
    accuracies: Mapping[str, float] = field(default_factory=dict)
    lags: tuple[str, ...] = ()

    def structure(self) -> Structure:
        """Which entries of A and C are not zero at the point. Raises ConfigurationError: exact arithmetic fails."""
        if self.model is None:
            assert self.observed is not None
            return self.observed
        try:
            return branch_structure(Branch(self.model, self.space.x0, self.space.u0))
        except ModelError as error:
            raise ConfigurationError(f"{self.model.name}: {error}") from error


def operate(operation: Operation) -> Operating:
    """The system that a user asks for, made linear at the point asked for.

    Raises ConfigurationError: no such model or FMU, a setting that does not fit, no derivatives, no equilibrium.
    """
    found = _operated(operation)
    return replace(found, space=_about(found.space, operation.about)) if operation.about else found


def _operated(operation: Operation) -> Operating:
    given, places = _read_point(operation.point)
    if operation.target.endswith(".fmu"):
        return _fmu(operation, given, places)
    found, (module, _) = find_model(operation.target)
    try:
        model = found if isinstance(found, Model) else made_model(operation.target, found, {}, places)
        system, values = _started(model, operation, given, places)
        x, u = at(system.states, values), at(system.inputs, values)
        if operation.settled:
            x = settle(system, x, u)
        space = linearised(system, x, u)
    except (ModelError, SteadyError) as error:
        raise ConfigurationError(f"{operation.target}: {error}") from error
    declared = importlib.import_module(module)
    return Operating(
        space,
        system,
        sensors=tuple(getattr(declared, "SENSORS", ())),
        accuracies=getattr(declared, "ACCURACIES", {}),
        lags=tuple(getattr(declared, "LAGS", ())),
    )


def _about(space: StateSpace, given: Sequence[str]) -> StateSpace:
    """The same matrices about the values given, without what moves at the point.

    Raises ConfigurationError: a name that is no state, output or input, a value of another dimension.
    """
    problems: list[Problem] = []
    signals = {s.name: s for s in (*space.inputs, *space.outputs, *space.states)}
    values: dict[str, float] = {}
    for text in (part for several in given for part in _BETWEEN.split(several)):
        name, equals, value = (part.strip() for part in text.partition("="))
        if not equals or name not in signals:
            problems.append(Problem(f"--about {text}: {unknown(name, signals, 'state, output or input')}"))
            continue
        try:
            values[name] = read_measure(value).si(signals[name].unit)
        except (ValueError, UnitError) as error:
            problems.append(Problem(f"--about {name}: {error}"))
    if problems:
        raise ConfigurationError(problems)

    def moved(of: Sequence[Signal], at: Vector) -> Vector:
        return np.array([values.get(s.name, v) for s, v in zip(of, at, strict=True)])

    return replace(
        space,
        x0=moved(space.states, space.x0),
        u0=moved(space.inputs, space.u0),
        y0=moved(space.outputs, space.y0),
        rates=np.zeros(len(space.rates)),
    )


def _read_point(point: Sequence[str]) -> tuple[dict[str, Any], Places]:
    """The settings by name, and where each stands."""
    given: dict[str, Any] = {}
    spots: dict[tuple[str | int, ...], Place] = {}
    problems = []
    for text in (part for several in point for part in _BETWEEN.split(several)):
        name, equals, value = (part.strip() for part in text.partition("="))
        place = Place(f"--at {text.strip()}")
        if not equals or not name or not value:
            problems.append(Problem("wants name=value, like N='2000 rpm'", *place))
        else:
            given[name], _ = read_yaml(value, place.file)
            spots[(name,)] = place
    if problems:
        raise ConfigurationError(problems)
    return given, Places("", spots)


def _started(
    model: Model, operation: Operation, given: Mapping[str, Any], places: Places
) -> tuple[LinearModel, dict[str, float]]:
    """The model with its parameters set, and the values asked for in SI by scalar name."""
    found = Findings(places)
    signals = (*model.states, *model.inputs, *model.parameters, *model.discrete)
    values = read_settings(signals, given, found)
    if values is None:
        raise ConfigurationError(found.problems)
    units = {scalar: parse_unit(signal.unit) for signal in signals for scalar in signal.scalar_names()}
    declared = {name: units[name].from_si(value) for name, value in values.items()}
    return LinearModel(model, {**set_values(model, operation.parameter_set), **declared}), values


def _fmu(operation: Operation, given: Mapping[str, Any], places: Places) -> Operating:
    path = Path(operation.target)
    if not path.is_file():
        raise ConfigurationError(f"no FMU file '{path}'")
    if operation.parameter_set is not None:
        raise ConfigurationError("--set wants a model: an FMU has no named sets; give the values by --at")
    description = describe(path, operation.validation)
    found = Findings(places)
    structure = read_structure(description)
    scalars = {name: v for v in description.variables for name in v.scalar_names()}
    inside = [Signal(name, as_signal(scalars[name]).unit) for name in structure.states if name in scalars]
    states = read_settings(inside, {k: v for k, v in given.items() if k in {s.name for s in inside}}, found)
    rest = read_fmu_settings(description, {k: v for k, v in given.items() if k not in (states or {})}, found)
    if states is None or rest is None or found.problems:
        raise ConfigurationError(found.problems)
    source = Source(path, rest[1].starts, operation.validation)
    ended = isolated(linear_at, source, states, operation.settled, seconds=operation.seconds)
    if ended.kind == "result":
        space, seen = ended.value
        return Operating(space, observed=seen)
    if isinstance(ended.error, ConfigurationError):
        raise ended.error
    stage = f" while it was doing {ended.stage}" if ended.stage else ""
    raise ConfigurationError(f"{path}: {ended.error or f'{ended.kind}{stage}: {ended.message}'}")


def linear_at(source: Source, states: Mapping[str, float], settled: bool) -> tuple[StateSpace, Structure]:
    """An FMU made linear at these states, in SI by name, and what is seen of its structure; to be run on its own.

    Raises ConfigurationError: it gives no derivatives, does not settle, or ends a call in an error.
    """
    system = linear_fmu(source)
    try:
        x, u = at(system.states, states), at(system.inputs, source.starts_of(system.inputs))
        if settled:
            x = settle(system, x, u)
        space = linearised(system, x, u)
        return space, observed_structure(system, space, system.structure)
    except (StepError, SteadyError) as error:
        raise ConfigurationError(f"{source.path}: {getattr(error, 'message', error)}") from error
    finally:
        system.close()
