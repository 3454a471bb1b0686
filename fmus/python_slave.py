"""A model stepped by its own Python source inside an FMU, for models that cannot be traced into C.

The FMU's interpreter must find this package. It is slow, and what the native runtime does with
derivatives, FMU states, RODAS4 and Model Exchange it does not do.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, ClassVar

from pythonfmu import Boolean, Fmi2Causality, Fmi2Initial, Fmi2Slave, Fmi2Variability, Integer, Real

from fmus.interface import Interface, declared_interface
from fmus.model import FlatModel, Model

_TYPES = {"real": Real, "integer": Integer, "boolean": Boolean}
_MAX_EVENTS = 1000


class ModelSlave(Fmi2Slave):
    """The FMI 2.0 slave of `model`, which a subclass names; value references as in the native export."""

    model: ClassVar[Model]

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.modelName = options.get("model_name", type(self).__name__)
        self.interface: Interface = declared_interface(self.model)
        self.flat = FlatModel(self.model)
        self.values = [variable.start for variable in self.interface.variables]
        self.above = [0.0] * len(self.model.indicator_names)
        self.samples = 0
        self.start_time = 0.0
        for reference, variable in enumerate(self.interface.variables):
            causality = "local" if variable.causality == "independent" else variable.causality
            registered = _TYPES[variable.kind](
                f"v{reference}",  # the description that importers read is written by the exporter
                causality=getattr(Fmi2Causality, causality),
                variability=getattr(Fmi2Variability, variable.variability),
                initial=getattr(Fmi2Initial, variable.initial) if variable.initial else None,
                getter=self._getter(reference),
                setter=self._setter(reference),
            )
            self.register_variable(registered)

    def _getter(self, reference: int) -> Callable[[], float]:
        return lambda: self.values[reference]

    def _setter(self, reference: int) -> Callable[[float], None]:
        def put(value: float) -> None:
            self.values[reference] = float(value)

        return put

    def _block(self, name: str) -> list[float]:
        block = self.interface.block(name)
        return self.values[block.start : block.stop]

    def _put(self, name: str, values: list[Any]) -> None:
        block = self.interface.block(name)
        self.values[block.start : block.stop] = [float(value) for value in values]

    def _derivatives(self, t: float, x: list[float]) -> list[float]:
        derivatives, _ = self.flat.derivatives_and_outputs(t, x, self._block("M"), self._block("U"), self._block("P"))
        return [float(value) for value in derivatives]

    def _indicators(self, t: float, x: list[float]) -> list[float]:
        z = self.flat.indicators(t, x, self._block("M"), self._block("U"), self._block("P"))
        return [float(value) for value in z]

    def _update_outputs(self, t: float) -> None:
        self.values[0] = t
        arguments = (t, self._block("X"), self._block("M"), self._block("U"), self._block("P"))
        derivatives, outputs = self.flat.derivatives_and_outputs(*arguments)
        self._put("DX", derivatives)
        self._put("Y", outputs)
        self._put("Z", self.flat.indicators(*arguments))

    def _settle(self, t: float) -> None:
        for _ in range(100):
            x, m = self._block("X"), self._block("M")
            z = self._indicators(t, x)
            # The rate of z by a difference over a nanosecond decides where z is zero.
            dx = self._derivatives(t, x)
            later = self._indicators(t + 1e-9, [a + 1e-9 * b for a, b in zip(x, dx, strict=True)])
            above = [
                float(b > a) if abs(a) <= abs(b - a) and b != a else float(a > 0) for a, b in zip(z, later, strict=True)
            ]
            new_x, new_m = self.flat.transition(t, x, m, self._block("U"), self._block("P"), above)
            changed = above != self.above or list(map(float, new_x)) != x or list(map(float, new_m)) != m
            self.above = above
            self._put("X", new_x)
            self._put("M", new_m)
            if not changed:
                return
        raise ArithmeticError(f"chattering: the events at t = {t!r} s never settle")

    def setup_experiment(self, start_time: float, stop_time: float | None, tolerance: float | None) -> None:
        """Begin at `start_time` [s]."""
        self.start_time = self.values[0] = start_time

    def exit_initialization_mode(self) -> None:
        """Settle the events at the start. Raises ValueError: a solver that Python does not have is asked for."""
        settings = self._block("S")
        if settings and settings[0] != 1:
            raise ValueError("solver.method: with Python inside there is RK4 (1) only")
        if self.model.indicator_names:
            z = self._indicators(self.start_time, self._block("X"))
            self.above = [float(value > 0) for value in z]
            self._settle(self.start_time)
        self._update_outputs(self.start_time)

    def do_step(self, current_time: float, step_size: float) -> bool:
        """From `current_time` over `step_size` [s]: RK4 between located events and sampling instants."""
        end = current_time + step_size
        t = current_time
        while self.model.sample is not None and t < end:
            period = self.values[self._reference(self.model.sample_time)]
            due = self.start_time + (self.samples + 1) * period if period else end
            if due > end + 1e-6 * period:
                break
            self._integrate(t, min(due, end))
            t = min(due, end)
            arguments = (t, self._block("X"), self._block("M"), self._block("U"), self._block("P"))
            new_x, new_m = self.flat.sample(*arguments)
            self._put("X", new_x)
            self._put("M", new_m)
            self.samples += 1
            if self.model.indicator_names:
                self._settle(t)
        self._integrate(t, end)
        self._update_outputs(end)
        return all(math.isfinite(value) for value in self._block("X"))

    def _reference(self, name: str) -> int:
        return [variable.name for variable in self.interface.variables].index(name)

    def _integrate(self, begin: float, end: float) -> None:
        if not self.model.states or begin >= end:
            return
        events, t = 0, begin
        while t < end:
            pieces = max(1, math.ceil((end - t) / self._block("S")[1] - 1e-9))
            h, first = (end - t) / pieces, t
            for k in range(1, pieces + 1):
                after = first + k * h if k < pieces else end
                x = self._block("X")
                new = self._rk4(t, x, after - t)
                if self._crossed(after, new):
                    low, high = 0.0, after - t
                    while high - low > 1e-13 * max(high, abs(t)) + 1e-15 and low < 0.5 * (low + high) < high:
                        middle = 0.5 * (low + high)
                        crossed = self._crossed(t + middle, self._rk4(t, x, middle))
                        low, high = (low, middle) if crossed else (middle, high)
                    self._put("X", self._rk4(t, x, high))
                    t += high
                    self._settle(t)
                    events += 1
                    if events > _MAX_EVENTS:
                        raise ArithmeticError(f"chattering: more than {_MAX_EVENTS} events in one step, at t = {t!r} s")
                    break
                self._put("X", new)
                t = after

    def _rk4(self, t: float, x: list[float], h: float) -> list[float]:
        def ahead(k: list[float], by: float) -> list[float]:
            return [a + by * b for a, b in zip(x, k, strict=True)]

        k1 = self._derivatives(t, x)
        k2 = self._derivatives(t + 0.5 * h, ahead(k1, 0.5 * h))
        k3 = self._derivatives(t + 0.5 * h, ahead(k2, 0.5 * h))
        k4 = self._derivatives(t + h, ahead(k3, h))
        return [a + h / 6.0 * (b + 2.0 * c + 2.0 * d + e) for a, b, c, d, e in zip(x, k1, k2, k3, k4, strict=True)]

    def _crossed(self, t: float, x: list[float]) -> bool:
        z = self._indicators(t, x)
        return any(value < 0 if above else value > 0 for value, above in zip(z, self.above, strict=True))
