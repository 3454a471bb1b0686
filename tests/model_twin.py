"""A model stepped in plain Python: RK4 and located events, as the exported FMU does it; for tests."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from fmus.component import Vector
from fmus.jacobians import point
from fmus.model import FlatModel, Model
from fmus.tracing import trace

Rates = Callable[[float, Vector], Vector]


class ModelTwin:
    """A model between events and over them; `x`, `m` are its states and discrete states in declared units.

    `traced` evaluates the derivatives by CasADi, some ten times as fast as the functions on floats.
    """

    def __init__(
        self, model: Model, values: Mapping[str, float], parameter_set: str | None = None, traced: bool = False
    ) -> None:
        self.model, self.flat, self.t = model, FlatModel(model), 0.0
        at = point(model, dict(values), parameter_set)
        self.x, self.m, self.u, self.p = at.x, at.m, at.u, at.p
        self._equations = trace(model).equations if traced else None
        self._settle()

    def values(self) -> dict[str, float]:
        """States, discrete states and outputs by name."""
        model = self.model
        _, y = self.flat.derivatives_and_outputs(self.t, list(self.x), list(self.m), list(self.u), list(self.p))
        names = [signal.name for signal in (*model.states, *model.discrete, *model.outputs)]
        return dict(zip(names, [*map(float, self.x), *map(float, self.m), *map(float, y)], strict=True))

    def step(self, h: float, longest: float) -> None:
        """Advance by h [s] in equal steps no longer than `longest`, the rest anew after each event."""
        end = self.t + h
        while self.t < end:
            begin, span = self.t, end - self.t
            pieces = 1 if span <= longest * (1 + 1e-9) else math.ceil(span / longest - 1e-9)
            for k in range(1, pieces + 1):
                after = begin + k * (span / pieces) if k < pieces else end
                x1 = self._rk4(after - self.t)
                if self._crossed(after, x1):
                    low, high = 0.0, after - self.t
                    while high - low > 1e-13 * max(high, abs(self.t)) + 1e-15:
                        middle = low + 0.5 * (high - low)
                        if self._crossed(self.t + middle, self._rk4(middle)):
                            high = middle
                        else:
                            low = middle
                    self.x, self.t = self._rk4(high), self.t + high
                    self._settle()
                    break
                self.x, self.t = x1, after

    def turn(self, state: str, target: float, longest: float) -> None:
        """Advance until a state that grows is at `target`, by the secant method on the last step."""
        place = [signal.name for signal in self.model.states].index(state)
        while True:
            rate = self._rates(self.t, self.x)[place]
            ahead = (target - self.x[place]) / rate
            if ahead <= 1e-14 * max(self.t, 1e-3):
                return
            self.step(min(ahead, longest), longest)

    def _rates(self, t: float, x: Vector) -> Vector:
        if self._equations is not None:
            return np.array(self._equations(t, x, self.m, self.u, self.p)[0]).ravel()
        arguments: Sequence[list[float]] = [list(values) for values in (x, self.m, self.u, self.p)]
        return np.array(self.flat.derivatives_and_outputs(t, *arguments)[0], dtype=float)

    def _rk4(self, h: float) -> Vector:
        t, x = self.t, self.x
        k1 = self._rates(t, x)
        k2 = self._rates(t + 0.5 * h, x + 0.5 * h * k1)
        k3 = self._rates(t + 0.5 * h, x + 0.5 * h * k2)
        k4 = self._rates(t + h, x + h * k3)
        result: Vector = x + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
        return result

    def _indicators(self, t: float, x: Vector) -> Vector:
        return np.array(self.flat.indicators(t, list(x), list(self.m), list(self.u), list(self.p)), dtype=float)

    def _crossed(self, t: float, x: Vector) -> bool:
        z = self._indicators(t, x)
        return bool(np.any(np.where(self._above > 0.5, z < 0.0, z > 0.0)))

    def _settle(self) -> None:
        """Transitions until nothing changes; within a nanosecond of a zero an indicator counts as past it."""
        for _ in range(100):
            z, ahead = (self._indicators(self.t, x) for x in (self.x, self.x + 1e-9 * self._rates(self.t, self.x)))
            above = np.where(np.abs(z) <= np.abs(ahead - z), ahead > z, z > 0.0).astype(float)
            arguments = [list(values) for values in (self.x, self.m, self.u, self.p, above)]
            x, m = self.flat.transition(self.t, *arguments)
            before, self.x, self.m = (self.x, self.m), np.array(x, dtype=float), np.array(m, dtype=float)
            self._above = above
            if np.array_equal(before[0], self.x) and np.array_equal(before[1], self.m):
                return
        raise AssertionError("the events never settle")
