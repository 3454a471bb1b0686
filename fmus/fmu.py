"""An FMU file as a Component: signals in SI units, start values set explicitly, the step in C."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from fmus.adapter import Message
from fmus.binding import bind_units
from fmus.component import (
    WARNING,
    ConfigurationError,
    Native,
    Problem,
    Reversal,
    Role,
    Signal,
    StepError,
    Vector,
)
from fmus.description import FmuDescription, FmuKind, Validation, describe
from fmus.exchange import Stepping
from fmus.model import unknown
from fmus.proof import Proof, takes_back
from fmus.slave import Slave
from fmus.units import Unit, UnitError, parse_unit
from fmus.variable import Variable

__all__ = ["FmuComponent", "FmuDescription", "Message", "describe", "load_fmu"]

_ROUNDING = 1e-9  # relative: a start value this close to a bound, or to a whole number, is meant to be it


def load_fmu(
    path: str | Path,
    *,
    starts: Mapping[str, float | str] | None = None,
    name: str = "",
    role: Role = "plant",
    validation: Validation = "warn",
    units: Mapping[str, str] | None = None,
    kind: FmuKind | None = None,
    stepping: Stepping | None = None,
) -> FmuComponent:
    """The FMU at `path` as a component called `name` (its model's name when empty).

    `starts` are values in SI units, by variable name, for parameters, for outputs and states that may be given a start
    value, and for inputs (the value held where nothing is wired); an array's scalars are named `name[1]`, `name[1,2]`.
    Strings take text; structural parameters resize the arrays that hang on them. It is run by Co-Simulation where it
    offers that, unless `kind` asks for Model Exchange (`me`), whose states are integrated as `stepping` says.
    `validation` is as `describe` has it; `units` are for variables that declare none, see `bind_units`.

    Raises ConfigurationError: the FMU cannot be run here, or a start value names no such variable, or one that cannot
    be set, or lies outside the range the FMU declares; all such problems at once.
    """
    description = bind_units(describe(path, validation), units or {}, name or "the FMU")
    if kind is not None:
        try:
            description = description.run_as(kind)
        except ConfigurationError as error:
            raise ConfigurationError(f"{path}: {error}") from error
    if not description.runnable:
        raise ConfigurationError([Problem(f"{path}: {reason}") for reason in description.reasons])
    return FmuComponent(description, starts or {}, name or description.model_name, role, stepping)


class FmuComponent:
    """An FMU in the shape of a Component.

    Values on the bus are in SI units where the FMU declares a unit; where it does not, `Signal.unit` is empty and
    values pass as they are. `applied_starts` holds, after `start`, every start value that was set, in the FMU's own
    unit. Integers and booleans pass as doubles (exact up to 2^53); a number for an integer input is rounded.
    """

    def __init__(
        self,
        description: FmuDescription,
        starts: Mapping[str, float | str],
        name: str,
        role: Role = "plant",
        stepping: Stepping | None = None,
    ) -> None:
        description = description.restructured({k: v for k, v in starts.items() if not isinstance(v, str)})
        self.description, self.name, self.role = description, name, role
        self.sha256, self.tool, self.fmi_version = description.sha256, description.tool, description.fmi_version
        self.applied_starts: dict[str, float | str] = {}
        given, self._starts = _plan_starts(description, starts, name)
        on_bus = [variable for variable in description.variables if variable.on_bus]
        self._input_variables = [variable for variable in on_bus if variable.causality == "input"]
        self._output_variables = [variable for variable in on_bus if variable.causality == "output"]
        self.inputs: tuple[Signal, ...] = tuple(
            replace(signal, start=given.get(signal.name, signal.start))
            for variable in self._input_variables
            for signal in _signals(variable)
        )
        self._given, self._stepping = dict(starts), stepping
        shaping = [variable for variable in description.variables if variable.structural or variable.type == "String"]
        self._shaping = {scalar for variable in shaping for scalar in variable.scalar_names()}
        self._slave = Slave(description, name, stepping)
        self._slave.adapter.carry(self._input_variables)
        self._t0 = 0.0
        self._u = np.zeros(len(self.inputs))
        self._u_address = self._u.ctypes.data
        self.select_outputs(scalar for variable in self._output_variables for scalar in variable.scalar_names())

    def select_outputs(self, names: Iterable[str]) -> None:
        """Let only these outputs be fetched after each step; `outputs` and `feedthrough` then hold no others.

        To be called between runs, before `start`. The outputs keep the FMU's order; an array is fetched as a whole.

        Raises ConfigurationError: there is no such output.
        """
        wanted = set(names)
        known = [scalar for variable in self._output_variables for scalar in variable.scalar_names()]
        lacking = [Problem(unknown(name, known, f"output of {self.name}")) for name in sorted(wanted.difference(known))]
        if lacking:
            raise ConfigurationError(lacking)
        chosen = [v for v in self._output_variables if not wanted.isdisjoint(v.scalar_names())]
        self.outputs: tuple[Signal, ...] = tuple(signal for variable in chosen for signal in _signals(variable))
        self.feedthrough = _feedthrough(self.description, chosen, self._input_variables)
        self._slave.free()
        self._slave.adapter.fetch(chosen)
        self._y = np.zeros(len(self.outputs))
        self._y_address = self._y.ctypes.data

    def hold_inputs(self, names: Iterable[str]) -> None:
        """Let these inputs be set at `start` only: no step passes them again, whatever then stands on the bus.

        For inputs where nothing is wired. To be called between runs; an array is held when all its scalars are named.

        Raises ConfigurationError: there is no such input.
        """
        wanted, known = set(names), [signal.name for signal in self.inputs]
        lacking = [Problem(unknown(name, known, f"input of {self.name}")) for name in sorted(wanted.difference(known))]
        if lacking:
            raise ConfigurationError(lacking)
        self._slave.free()
        held = {variable.name for variable in self._input_variables if wanted.issuperset(variable.scalar_names())}
        self._slave.adapter.carry(self._input_variables, held)

    def prove(self) -> None:
        """Make an instance and let go of it again. Raises ConfigurationError: none came of it."""
        self._slave.prove()

    def start(self, t0: float, u: Vector) -> Vector:
        """A fresh instance, initialised at t0 [s] with inputs u: the initial outputs, shape (n_outputs,), SI units.

        Raises StepError: the FMU refused.
        """
        self._t0, self._u[:] = t0, u
        self._slave.start(t0, self._starts, self._u, self._y)
        self.applied_starts = {
            scalar: value
            for variable, values in self._starts
            for scalar, value in zip(variable.scalar_names(), values, strict=True)
        }
        return self._y.copy()

    def restart(self, t0: float, u: Vector) -> Vector:
        """As `start`, but of the instance there is, by the FMU's own reset, which `start` does not trust."""
        self._u[:] = u
        self._slave.restart(t0, self._starts, self._u, self._y)
        return self._y.copy()

    def step(self, t: float, h: float, u: Vector) -> Vector:
        """Advance from t to t + h [s] with inputs u held: the outputs at t + h, shape (n_outputs,), SI units.

        The C function called is the one that `native` names. Raises StepError: a status above warning.
        """
        self._u[:] = u
        status = self._slave.step(t, h, self._u_address, self._y_address)
        if status > WARNING:
            raise self.failure(status, t)
        return self._y.copy()

    def native(self) -> Native:
        """The step for C; before `start` and after `close` it returns the status ERROR."""
        return self._slave.native()

    def reversal(self) -> Reversal | None:
        """How C takes it back; to be asked after `start` and before the first step. None where `proof` does not hold.

        From now on the FMU is told that steps may be taken back, and Model Exchange's solver starts anew wherever a
        state is kept. The derivatives are those of the FMU where they proved right.
        """
        proof = self.proof()
        if not proof.holds:
            return None
        return self._slave.past().reversal(proof.derivatives.knowns, proof.derivatives.unknowns)

    def proof(self) -> Proof:
        """Whether the FMU can be taken back, as another component of it showed, once in this process.

        It is tried with the start values the FMU itself gives, and where it does not start with those, with this
        component's. Meanwhile there is no other instance, and one that was started is started afresh afterwards: after
        its first step the question comes too late. Raises StepError: too late, or it does not start again.
        """
        texts = {name: value for name, value in self._given.items() if name in self._shaping}
        found = self._proof(texts)
        return found if found.started or texts == self._given else self._proof(self._given)

    def _proof(self, starts: Mapping[str, float | str]) -> Proof:
        key = (self.sha256, self.description.kind, self._stepping, frozenset(starts.items()))
        was_running = self._slave.running

        def another() -> FmuComponent:
            if was_running and self._slave.adapter.table.time != self._t0:
                raise StepError("whether it can be taken back is to be asked before its first step", part=self.name)
            self._slave.free()
            return FmuComponent(self.description, starts, self.name, self.role, self._stepping)

        found = takes_back(key, self.description, another)
        if was_running and not self._slave.running:
            self._slave.start(self._t0, self._starts, self._u, self._y)
        return found

    def failure(self, status: int, time: float) -> StepError:
        """The error for a step from `time` [s] that ended in `status`, with the FMU's last message on it."""
        return self._slave.failure(status, time)

    @property
    def slave(self) -> Slave:
        """What calls the FMU, for those who question it call by call."""
        return self._slave

    @property
    def starts(self) -> list[tuple[Variable, tuple[float | str, ...]]]:
        """The start values that `start` sets, in the FMU's own units."""
        return self._starts

    @property
    def log(self) -> list[Message]:
        """The FMU's messages since `start`, oldest first: all, or the first 64 and the last 192."""
        return self._slave.adapter.log()

    @property
    def log_dropped(self) -> int:
        """How many messages since `start` are not in `log`."""
        return self._slave.adapter.dropped()

    def close(self) -> None:
        """Free the instance and let go of the library; may be called again. A step afterwards is an error."""
        self._slave.unload()


def _signals(variable: Variable) -> list[Signal]:
    """The scalars of a variable as signals, in its own unit where this project knows that unit, else in SI units."""
    unit, quantity = _display(variable)
    sizes = [value for value in variable.start if not isinstance(value, str)] or [0.0] * variable.size
    return [
        Signal(
            name=name,
            unit=unit,
            start=quantity.to_si(start),
            description=variable.description,
            nominal=abs(quantity.factor) * variable.nominal,
            minimum=quantity.to_si(variable.minimum),
            maximum=quantity.to_si(variable.maximum),
            kind=variable.kind,
        )
        for name, start in zip(variable.scalar_names(), sizes, strict=True)
    ]


def _display(variable: Variable) -> tuple[str, Unit]:
    """The name of the unit that values are declared in, and what brings the FMU's own values into it."""
    if variable.quantity is None:
        return "", Unit()
    if variable.kind != "real":
        return "1", Unit()
    try:
        if variable.unit and parse_unit(variable.unit) == variable.quantity:
            return variable.unit, Unit()
    except UnitError:
        pass
    return variable.quantity.si_name(), variable.quantity


def _feedthrough(
    description: FmuDescription, outputs: Sequence[Variable], inputs: Sequence[Variable]
) -> frozenset[tuple[str, str]]:
    everything = frozenset(variable.name for variable in inputs)
    return frozenset(
        (y, u)
        for output in outputs
        for source in inputs
        if source.name in description.dependencies.get(output.name, everything)
        for y in output.scalar_names()
        for u in source.scalar_names()
    )


def _plan_starts(
    description: FmuDescription, starts: Mapping[str, float | str], name: str
) -> tuple[dict[str, float], list[tuple[Variable, tuple[float | str, ...]]]]:
    """The start values of inputs in the unit of their signals, and those to set in the FMU, in its own units."""
    owners = {scalar: variable for variable in description.variables for scalar in variable.scalar_names()}
    problems: list[Problem] = []
    given: dict[str, float | str] = {}
    for scalar, value in starts.items():
        variable = owners.get(scalar)
        if variable is None:
            settable = [s for s, v in owners.items() if v.settable]
            problems.append(Problem(unknown(scalar, settable, f"variable of {name}")))
            continue
        given[scalar] = value if isinstance(value, str) else (variable.quantity or Unit()).from_si(value)
        wrong = start_refusal(variable, given[scalar])
        if wrong:
            problems.append(Problem(f"{name}.{scalar} {wrong}"))
    if problems:
        raise ConfigurationError(problems)
    plan: list[tuple[Variable, tuple[float | str, ...]]] = []
    for variable in description.variables:
        bus_input = variable.causality == "input" and variable.on_bus
        names = variable.scalar_names()
        asked = any(scalar in given for scalar in names)
        if variable.settable and not bus_input and (asked or (variable.start and not variable.structural)):
            values = variable.start or (0.0,) * variable.size
            plan.append((variable, tuple(given.get(s, value) for s, value in zip(names, values, strict=True))))
    inputs = {
        scalar: _display(variable)[1].to_si(float(given[scalar]))
        for scalar, variable in owners.items()
        if scalar in given and variable.causality == "input" and variable.on_bus
    }
    return inputs, plan


def start_refusal(variable: Variable, value: float | str) -> str:
    """What is wrong with text, or with a number in the variable's own unit, as its start value; empty where nothing."""
    return _text_refusal(variable) if isinstance(value, str) else _refusal(variable, value)


def _text_refusal(variable: Variable) -> str:
    """What is wrong with text as a start value; empty when nothing is."""
    if variable.type != "String":
        return f"wants a number, its type is {variable.type}"
    if not variable.settable or variable.shape:
        return f"cannot be set: its causality is {variable.causality}, its shape {variable.shape}"
    return ""


def _refusal(variable: Variable, value: float) -> str:
    """What is wrong with a start value in the variable's own unit; empty when nothing is."""
    if not variable.settable or variable.type in ("String", "Binary"):
        described = f"causality is {variable.causality}, its variability {variable.variability or 'not given'}"
        return f"cannot be set: its {described}, its type {variable.type}"
    if math.isnan(value):
        return "wants a number, got NaN"
    if variable.kind != "real" and (math.isinf(value) or abs(value - round(value)) > _ROUNDING * abs(value)):
        return f"wants a whole number, got {value:.9g}"
    if variable.kind == "boolean" and value not in (0.0, 1.0):
        return f"wants 0 or 1, got {value:.9g}"
    slack = _ROUNDING * abs(value)
    if not variable.minimum - slack <= value <= variable.maximum + slack:
        bounds = f"{variable.minimum:.9g} to {variable.maximum:.9g}"
        return f"wants {bounds} {variable.unit}".rstrip() + f", got {value:.9g}"
    return ""
