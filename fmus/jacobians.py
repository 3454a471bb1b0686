"""The exact Jacobians of a model at a point, and which of their elements are not zero."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from fmus.component import Signal, Vector
from fmus.model import Model, ModelError, unknown
from fmus.tracing import trace

Matrix = NDArray[np.float64]
Pattern = NDArray[np.bool_]


class Point(NamedTuple):
    """Where a model is evaluated: flat states, discrete states, inputs and parameters in declared units, and time."""

    x: Vector
    m: Vector
    u: Vector
    p: Vector
    t: float = 0.0


class Linear(NamedTuple):
    """A model to first order at a point: x' = dx + A (x - x0) + B (u - u0), y = y0 + C (x - x0) + D (u - u0)."""

    dx: Vector
    y: Vector
    A: Matrix
    B: Matrix
    C: Matrix
    D: Matrix


class Structure(NamedTuple):
    """Which elements of A (x' on x), B (x' on u), C (y on x) and D (y on u) are not zero."""

    A: Pattern
    B: Pattern
    C: Pattern
    D: Pattern


def point(model: Model, values: Mapping[str, Any] | None = None, parameter_set: str | None = None) -> Point:
    """The point of start values, the `parameter_set` and then `values` by name, in declared units.

    A name is that of a state, discrete state, input or parameter, or of a scalar of one like `L[1,2]`.

    Raises ModelError: there is no such name or set.
    """
    given = dict(values or {})
    known = [*model.states, *model.discrete, *model.inputs, *model.parameters]
    names = {name for signal in known for name in (signal.name, *signal.scalar_names())}
    for name in given:
        if name not in names:
            raise ModelError(f"{model.name}: {unknown(name, names, 'state, input or parameter')}")
    if parameter_set is not None:
        if parameter_set not in model.parameter_sets:
            raise ModelError(f"{model.name}: {unknown(parameter_set, model.parameter_sets, 'parameter set')}")
        given = {**model.parameter_sets[parameter_set], **given}

    def flat(signals: Iterable[Signal]) -> Vector:
        return np.array([number for signal in signals for number in _scalars(signal, given)], dtype=float)

    return Point(flat(model.states), flat(model.discrete), flat(model.inputs), flat(model.parameters))


def _scalars(signal: Signal, given: Mapping[str, Any]) -> Vector:
    numbers = signal.scalar_starts()
    if signal.name in given:
        numbers = np.broadcast_to(np.asarray(given[signal.name], dtype=float), signal.shape).astype(float).ravel()
    for i, name in enumerate(signal.scalar_names()):
        if signal.shape and name in given:
            numbers[i] = given[name]
    return numbers


@dataclass(frozen=True)
class Jacobians:
    """Values and exact derivatives of a model's equations, by `jacobians`."""

    model: Model
    _values: ca.Function
    _derivatives: ca.Function

    def values(self, at: Point) -> tuple[Vector, Vector]:
        """x' (nx,) and y (ny,) at a point."""
        dx, y = self._values(at.t, at.x, at.m, at.u, at.p)
        return dx.full().ravel(), y.full().ravel()

    def at(self, at: Point) -> Linear:
        """The model to first order at a point, by automatic differentiation: exact but for rounding."""
        dx, y, *matrices = (found.full() for found in self._derivatives(at.t, at.x, at.m, at.u, at.p))
        return Linear(dx.ravel(), y.ravel(), *matrices)

    def structure(self, points: Iterable[Point]) -> Structure:
        """Which elements are not zero at any of the points.

        A branch of `np.where`, `np.minimum` or `np.maximum` that is not taken contributes an exact zero: over points of
        one regime this is the structure of that regime, where the symbolic one is that of all regimes at once.

        Raises ModelError: a derivative is not finite; ValueError: there is no point.
        """
        linear = [self.at(one) for one in points]
        if not linear:
            raise ValueError(f"the structure of {self.model.name} wants one point or more, got none")
        for one in linear:
            self._refuse_not_finite(one)
        return Structure(*(np.any([getattr(one, name) != 0.0 for one in linear], axis=0) for name in "ABCD"))

    def _refuse_not_finite(self, linear: Linear) -> None:
        model = self.model
        names = [name for signal in (*model.states, *model.outputs) for name in signal.scalar_names()]
        rows = np.block([[linear.A, linear.B], [linear.C, linear.D]])
        wrong = [name for name, row in zip(names, rows, strict=True) if not np.isfinite(row).all()]
        if wrong:
            raise ModelError(f"{model.name} has no finite derivative at one of the points of {', '.join(wrong)}")


def jacobians(model: Model) -> Jacobians:
    """What evaluates a model's equations and their Jacobians; it is traced once. Raises TraceError."""
    equations = trace(model).equations
    inputs = equations.sx_in()
    dx, y = equations.call(inputs)
    _, x, _, u, _ = inputs
    matrices = [ca.densify(ca.jacobian(of, by)) for of in (dx, y) for by in (x, u)]
    return Jacobians(
        model,
        ca.Function("values", inputs, [ca.densify(dx), ca.densify(y)]),
        ca.Function("derivatives", inputs, [ca.densify(dx), ca.densify(y), *matrices]),
    )
