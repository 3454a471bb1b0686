"""A model's exact derivatives at a point, by CasADi."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import casadi as ca
import numpy as np

from fmus.component import Signal, Vector
from fmus.jacobians import Point, jacobians
from fmus.model import Model, ModelError, unknown
from fmus.statespace import Partials
from fmus.tracing import Traced, trace
from fmus.units import Unit, parse_unit

EXACT = "exact"

# t, x, m, u, p in the units that the model declares.
Arguments = tuple[float, Vector, Vector, Vector, Vector]


class LinearModel:
    """A model as it can be made linear: x' and y with exact derivatives, in SI units, parameters held.

    `starts` are start values by scalar name, in declared units. The outputs are the states that are not local and the
    outputs that the model declares, as its FMU has them; integers and booleans are neither inputs nor outputs here.
    Discrete states have their start values, or those that the model's transition gives them at the point entered.

    Raises ModelError: it cannot be traced, has no continuous state, or a start value is of nothing declared.
    """

    def __init__(self, model: Model, starts: Mapping[str, float] | None = None) -> None:
        self.model, self.name = model, model.name
        self.traced: Traced = trace(model)
        if not model.states:
            raise ModelError(f"{model.name} wants continuous states to be made linear, it has none")
        scalars = {s.name: s for signals in self._declared for s in _scalars(signals)}
        for name in starts or {}:
            if name not in scalars:
                raise ModelError(f"{model.name}: {unknown(name, scalars, 'variable with a start value')}")
        self.states, self._all_inputs, parameters, discrete = (
            tuple(replace(s, start=(starts or {}).get(s.name, s.start)) for s in _scalars(signals))
            for signals in self._declared
        )
        self.parameters = np.array([float(s.start) for s in parameters])
        self.parameter_names = tuple(s.name for s in parameters)
        self._discrete_start = np.array([float(s.start) for s in discrete])
        self.discrete = self._discrete_start
        self._real_inputs = [i for i, s in enumerate(self._all_inputs) if s.kind == "real"]
        self.inputs = tuple(self._all_inputs[i] for i in self._real_inputs)
        shown = [i for i, s in enumerate(self.states) if not s.local]
        declared = [(i, s) for i, s in enumerate(_scalars(model.outputs)) if s.kind == "real"]
        self.outputs = (*(self.states[i] for i in shown), *(s for _, s in declared))
        self.shown_states, self.declared_outputs = shown, [i for i, _ in declared]
        self._x, self._y = (_units(signals) for signals in (self.states, self.outputs))
        self._u = _units(self._all_inputs)
        self._jacobians = jacobians(model)

    @property
    def _declared(self) -> tuple[Sequence[Signal], ...]:
        model = self.model
        return model.states, model.inputs, model.parameters, model.discrete

    def native_point(self, x: Vector, u: Vector) -> tuple[Vector, Vector]:
        """States and all inputs in the units that the model declares."""
        given = np.array([float(np.asarray(s.start)) for s in self._all_inputs])
        given[self._real_inputs] = [self._u[i].from_si(v) for i, v in zip(self._real_inputs, u, strict=True)]
        return np.array([unit.from_si(v) for unit, v in zip(self._x, x, strict=True)]), given

    def values(self, x: Vector, u: Vector) -> tuple[Vector, Vector]:
        """x' and y, SI."""
        at = self._point(x, u)
        rates, declared = self._jacobians.values(at)
        y = np.concatenate([at.x[self.shown_states], declared[self.declared_outputs]])
        return rates * _factors(self._x), np.array([u.to_si(v) for u, v in zip(self._y, y, strict=True)], dtype=float)

    def slopes(self, x: Vector, u: Vector) -> Vector:
        """A, shape (n, n)."""
        return self.partials(x, u).A

    def partials(self, x: Vector, u: Vector) -> Partials:
        """A, B, C, D in SI, exact but for rounding. Raises ModelError: an entry is not finite; it is named."""
        found = self._jacobians.at(self._point(x, u))
        n, states = len(self.states), _factors(self._x)
        over, inputs = _factors(self._y)[:, None], _factors(self._u)[self._real_inputs]
        shown = np.eye(n)[self.shown_states]
        C = np.concatenate([shown, found.C[self.declared_outputs]])
        D = np.concatenate([np.zeros((len(shown), len(self._u))), found.D[self.declared_outputs]])
        A = found.A * states[:, None] / states
        C = C * over / states
        self._refuse_not_finite(np.concatenate([A, C]))
        B = found.B[:, self._real_inputs] * states[:, None] / inputs
        D = D[:, self._real_inputs] * over / inputs
        return Partials(A, B, C, D, EXACT, float(np.finfo(float).eps), "derivatives of its equations")

    def _point(self, x: Vector, u: Vector) -> Point:
        states, inputs = self.native_point(x, u)
        return Point(states, self.discrete, inputs, self.parameters)

    def enter(self, x: Vector, u: Vector) -> None:
        """Discrete states become those that the transition gives at this point.

        Raises ModelError: it changes states or does not come to an end.
        """
        self.discrete = self._discrete_start
        if self.model.transition is None:
            return
        states, inputs = self.native_point(x, u)
        for _ in range(100):
            place = 0.0, states, self.discrete, inputs, self.parameters
            after, discrete = self.traced.transition(*place, self._above(place))
            if not np.array_equal(np.asarray(after).ravel(), states):
                raise ModelError(f"{self.model.name}: an event at this point changes its states")
            before, self.discrete = self.discrete, np.asarray(discrete, dtype=float).ravel()
            if np.array_equal(before, self.discrete):
                return
        raise ModelError(f"{self.model.name}: its discrete states do not settle at this point")

    def _above(self, place: Arguments) -> Vector:
        """The side of each indicator; within a nanosecond of its zero the one that it goes to."""
        z = np.asarray(self.traced.indicators(*place), dtype=float).ravel()
        symbols = self.traced.indicators.sx_in()
        (expression,) = self.traced.indicators.call(symbols)
        dx, _ = self.traced.equations.call(symbols)
        rate = ca.Function("rate", symbols, [ca.jtimes(expression, symbols[1], dx)])
        dz = np.asarray(rate(*place), dtype=float).ravel()
        return np.where(np.abs(z) <= 1e-9 * np.abs(dz), dz > 0.0, z > 0.0).astype(float)

    def _refuse_not_finite(self, by_x: Vector) -> None:
        bad = np.argwhere(~np.isfinite(by_x))
        if len(bad):
            row, column = bad[0]
            rows = [f"der({s.name})" for s in self.states] + [s.name for s in self.outputs]
            raise ModelError(
                f"{self.model.name}: d {rows[row]} / d {self.states[column].name} is {by_x[row, column]} at this point"
            )


def _scalars(signals: Sequence[Signal]) -> list[Signal]:
    return [
        replace(signal, name=name, start=float(start), shape=())
        for signal in signals
        for name, start in zip(signal.scalar_names(), signal.scalar_starts(), strict=True)
    ]


def _units(signals: Sequence[Signal]) -> list[Unit]:
    return [parse_unit(signal.unit) for signal in signals]


def _factors(units: Sequence[Unit]) -> Vector:
    return np.array([unit.factor for unit in units], dtype=float)
