"""The FMI variables of a model, in the order of their value references."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from fmus.component import Kind, Signal
from fmus.model import Model, ModelError, unknown
from fmus.tracing import Traced
from fmus.units import difference_unit

Pattern = NDArray[np.bool_]

METHODS = {"rk4": 1, "rodas4": 2}
# Phases of runtime/instance.h in which a variable may be set.
_BEFORE = 1 | 2
_ALWAYS = _BEFORE | 4 | 8 | 16
_BETWEEN_STEPS = _BEFORE | 4 | 8


@dataclass(frozen=True)
class Variable:
    """One FMI variable; its value reference is its place in the list."""

    name: str
    kind: Kind
    causality: str
    variability: str
    initial: str
    start: float
    unit: str
    description: str
    nominal: float
    minimum: float
    maximum: float
    settable: int
    derivative_of: int | None = None
    dependencies: tuple[int, ...] | None = None

    @property
    def has_start(self) -> bool:
        """True where the description states a start value."""
        return self.initial == "exact" or self.causality == "input"


@dataclass(frozen=True)
class Interface:
    """The variables of an exported model: [time | x | x' | u | y | z | m | p | solver settings]."""

    model: Model
    variables: tuple[Variable, ...]
    sizes: Mapping[str, int]

    def offset(self, block: str) -> int:
        """Value reference of the first variable of a block: X, DX, U, Y, Z, M, P or S."""
        order = ("X", "DX", "U", "Y", "Z", "M", "P", "S")
        return 1 + sum(self.sizes[name] for name in order[: order.index(block)])

    def block(self, name: str) -> range:
        """Value references of a block."""
        first = self.offset(name)
        return range(first, first + self.sizes[name])


def _scalars(signals: Iterable[Signal], **common: Any) -> list[Variable]:
    variables = []
    for signal in signals:
        for name, start in zip(signal.scalar_names(), signal.scalar_starts(), strict=True):
            variables.append(
                Variable(
                    name=name,
                    kind=signal.kind,
                    start=float(start),
                    unit=signal.unit,
                    description=signal.description,
                    nominal=signal.nominal,
                    minimum=signal.minimum,
                    maximum=signal.maximum,
                    **common,
                )
            )
    return variables


def _state_variables(model: Model, assigned: Collection[str]) -> tuple[list[Variable], list[Variable]]:
    states: list[Variable] = []
    for signal in model.states:
        causality = "local" if signal.local else "output"
        states += _scalars([signal], causality=causality, variability="continuous", initial="exact", settable=_BEFORE)
    discrete: list[Variable] = []
    for signal in model.discrete:
        computed = signal.name in assigned
        discrete += _scalars(
            [signal],
            causality="local" if signal.local else "output",
            variability="discrete",
            initial="calculated" if computed else "exact",
            settable=0 if computed else _BEFORE,
        )
    return states, discrete


def _per_second(unit: str) -> str:
    if unit == "1":
        return "1/s"
    unit = difference_unit(unit)
    return f"{unit}2" if unit.endswith("/s") else f"{unit}/s"


def _setting(name: str, kind: Kind, start: float, unit: str, description: str) -> Variable:
    return Variable(
        name, kind, "parameter", "fixed", "exact", start, unit, description, 1.0, -math.inf, math.inf, _BEFORE
    )


def _assigned_by_transition(traced: Traced) -> set[str]:
    """Names of the discrete states that the transition computes."""
    model = traced.model
    if model.transition is None:
        return set()
    depends = dependence(traced.transition, 1, "m")
    result, row = set(), 0
    arguments = traced.transition.sx_in()
    values = traced.transition.call(arguments)[1]
    for signal in model.discrete:
        unchanged = all(ca.is_equal(values[row + i], arguments[2][row + i]) for i in range(signal.size))
        if not unchanged and not depends[row : row + signal.size].any():
            result.add(signal.name)
        row += signal.size
    return result


def dependence(function: ca.Function, output: int, argument: str) -> Pattern:
    """Which elements of an output depend on which of an argument, from the sparsity of the Jacobian."""
    index = function.name_in().index(argument)
    rows, columns = function.size1_out(output), function.size1_in(index)
    if not rows or not columns:
        return np.zeros((rows, columns), dtype=bool)
    return np.asarray(ca.DM(function.jac_sparsity(output, index), 1).full(), dtype=bool)


def _product(a: Pattern, b: Pattern) -> Pattern:
    return (a.astype(int) @ b.astype(int)) > 0


@dataclass(frozen=True)
class Dependencies:
    """Structural dependence of derivatives (dx), outputs (y) and discrete states (m) on states and inputs.

    Outputs and states (x) include what a sampling instant or an event at the end of the step passes on at once.
    """

    x_u: Pattern
    dx_x: Pattern
    dx_u: Pattern
    y_x: Pattern
    y_u: Pattern
    m_x: Pattern
    m_u: Pattern


def dependencies(traced: Traced) -> Dependencies:
    """The structural dependence of a traced model."""
    equations, transition, sample = traced.equations, traced.transition, traced.sample

    def of_m(argument: str) -> Pattern:
        pattern = dependence(sample, 1, argument) | dependence(transition, 1, argument)
        indicated = dependence(traced.indicators, 0, argument)
        return pattern | _product(dependence(transition, 1, "above"), indicated)

    m_x, m_u = of_m("x"), of_m("u")
    y_m = dependence(equations, 1, "m")
    reset_u = dependence(sample, 0, "u") | dependence(transition, 0, "u")
    y_x = dependence(equations, 1, "x")
    return Dependencies(
        x_u=reset_u,
        dx_x=dependence(equations, 0, "x"),
        dx_u=dependence(equations, 0, "u"),
        y_x=y_x | _product(y_m, m_x),
        y_u=dependence(equations, 1, "u") | _product(y_m, m_u) | _product(y_x, reset_u),
        m_x=m_x,
        m_u=m_u,
    )


def interface(traced: Traced, overrides: Mapping[str, float] | None = None) -> Interface:
    """The FMI variables of a traced model; `overrides` replaces start values by scalar name, in declared units.

    Raises ModelError: an override names no variable with a start value.
    """
    found = declared_interface(traced.model, _assigned_by_transition(traced))
    found = replace(found, variables=_with_dependencies(found, dependencies(traced)))
    return with_starts(found, overrides or {})


def declared_interface(model: Model, assigned: Collection[str] = ()) -> Interface:
    """The FMI variables that a model's declarations alone give, without dependencies.

    `assigned` names the discrete states that have no start value because the transition computes them.
    """
    states, discrete = _state_variables(model, assigned)
    derivatives = [
        replace(
            state,
            name=f"der({state.name})",
            causality="local",
            initial="calculated",
            start=0.0,
            unit=_per_second(state.unit),
            description=f"derivative of {state.name}",
            nominal=1.0,
            minimum=-math.inf,
            maximum=math.inf,
            settable=0,
            derivative_of=1 + i,
        )
        for i, state in enumerate(states)
    ]
    inputs = []
    for signal in model.inputs:
        variability = "continuous" if signal.kind == "real" else "discrete"
        inputs += _scalars([signal], causality="input", variability=variability, initial="", settable=_ALWAYS)
    outputs = []
    for signal in model.outputs:
        variability = "continuous" if signal.kind == "real" else "discrete"
        outputs += _scalars([signal], causality="output", variability=variability, initial="calculated", settable=0)
    indicators = _scalars(
        [Signal(name, description="event indicator") for name in model.indicator_names],
        causality="local",
        variability="continuous",
        initial="calculated",
        settable=0,
    )
    parameters = _scalars(
        model.parameters, causality="parameter", variability="tunable", initial="exact", settable=_BETWEEN_STEPS
    )
    settings = []
    if states:
        settings = [
            _setting("solver.method", "integer", METHODS[model.solver_method], "1", "1 RK4, 2 RODAS4"),
            _setting("solver.step", "real", model.solver_step, "s", "longest internal step, first step if adaptive"),
            _setting("solver.tolerance", "real", model.solver_tolerance, "1", "RODAS4 error control; 0 fixes the step"),
        ]
    time = Variable(
        "time", "real", "independent", "continuous", "", 0.0, "s", "simulation time", 1.0, -math.inf, math.inf, 0
    )
    sizes = {
        "X": len(states), "DX": len(derivatives), "M": len(discrete), "U": len(inputs), "Y": len(outputs),
        "Z": len(indicators), "P": len(parameters), "S": len(settings),
    }  # fmt: skip
    listed = [time, *states, *derivatives, *inputs, *outputs, *indicators, *discrete, *parameters, *settings]
    return Interface(model, tuple(listed), sizes)


def _with_dependencies(found: Interface, patterns: Dependencies) -> tuple[Variable, ...]:
    variables = list(found.variables)
    x0, u0 = found.offset("X"), found.offset("U")

    def known(row_x: Pattern, row_u: Pattern) -> tuple[int, ...]:
        return tuple(int(i) + x0 for i in np.flatnonzero(row_x)) + tuple(int(i) + u0 for i in np.flatnonzero(row_u))

    for i, reference in enumerate(found.block("X")):
        passed_on = tuple(int(j) + u0 for j in np.flatnonzero(patterns.x_u[i]))
        variables[reference] = replace(variables[reference], dependencies=(x0 + i, *passed_on))
    for name, on_x, on_u in (
        ("DX", patterns.dx_x, patterns.dx_u),
        ("M", patterns.m_x, patterns.m_u),
        ("Y", patterns.y_x, patterns.y_u),
    ):
        for i, reference in enumerate(found.block(name)):
            variables[reference] = replace(variables[reference], dependencies=known(on_x[i], on_u[i]))
    return tuple(variables)


def with_starts(found: Interface, overrides: Mapping[str, float]) -> Interface:
    """The interface with start values replaced by the name of the scalar, in declared units.

    Raises ModelError: a name is no variable with a start value.
    """
    variables = list(found.variables)
    places = {variable.name: i for i, variable in enumerate(variables) if variable.has_start}
    for name, value in overrides.items():
        if name not in places:
            raise ModelError(f"{found.model.name}: {unknown(name, places, 'variable with a start value')}")
        variables[places[name]] = replace(variables[places[name]], start=float(value))
    return replace(found, variables=tuple(variables))
