"""Sources: inputs known in advance. The arithmetic is in source.c.

Over (k-1, k] a source holds the value it has at t_{k-1}; row 0 of a record has its value at t_0. A point of a table
and the jump of a step act from the instant they fall on, as measured to a millionth of the clock's step: a step at
2 s on a clock of 1 ms is in row 2001 for the first time, whatever the last bit of 2.0 says.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Sequence
from typing import Literal

import numpy as np

from fmus.component import Native, Reversal, Role, Signal, StepError, Vector
from harness.faults import Timed
from harness.findings import Findings
from harness.native import address, call, native_reversal, native_step
from harness.scenario import Measure, Ramp, Sine, SourcePart, Step, Table

SHAPES = ("hold", "linear", "sine")


class _Source(ctypes.Structure):
    _fields_ = [
        *((name, ctypes.c_int64) for name in ("shape", "count")),
        *((name, ctypes.c_void_p) for name in ("times", "values")),
        *((name, ctypes.c_double) for name in ("mean", "amplitude", "omega", "phase", "t0", "edge")),
    ]


class SourceComponent:
    """A source in SI: points (times [s], values), held or linear, or mean + amplitude sin(omega (t - t0) + phase).

    `edge` [s] is how near a time must be to a point to be at it. The output is named `value`.
    """

    role: Role = "source"
    timed: Timed = "begin"
    inputs: Sequence[Signal] = ()
    feedthrough: frozenset[tuple[str, str]] = frozenset()

    def __init__(
        self,
        unit: str,
        shape: Literal["hold", "linear", "sine"],
        *,
        times: Sequence[float] = (0.0,),
        values: Sequence[float] = (0.0,),
        mean: float = 0.0,
        amplitude: float = 0.0,
        omega: float = 0.0,
        phase: float = 0.0,
        edge: float = 0.0,
    ) -> None:
        self.outputs: Sequence[Signal] = (Signal("value", unit),)
        self._state: _Source | None = None
        self.shape, self.edge = shape, edge
        self.times, self.values = np.array(times, dtype=float), np.array(values, dtype=float)
        self.mean, self.amplitude, self.omega, self.phase = mean, amplitude, omega, phase

    def start(self, t0: float, u: Vector) -> Vector:
        """The value at t0 [s], shape (1,)."""
        self._state = _Source(
            SHAPES.index(self.shape),
            len(self.times),
            address(self.times),
            address(self.values),
            self.mean,
            self.amplitude,
            self.omega,
            self.phase,
            t0,
            self.edge,
        )
        return self.step(t0, 0.0, u)

    def step(self, t: float, h: float, u: Vector) -> Vector:
        """The value held over a step from t [s], which is the value at t, shape (1,)."""
        return call("crankbench_source_step", self._started(), t, h)[1]

    def native(self) -> Native:
        """The step in C."""
        return native_step("crankbench_source_step", self._started())

    def reversal(self) -> Reversal:
        """Keeping and going back in C, which do nothing: a source has no state."""
        return native_reversal("crankbench_stateless_keep", "crankbench_stateless_keep", self._started())

    def close(self) -> None:
        """Forget the state: it wants a start before the next step."""
        self._state = None

    def _started(self) -> _Source:
        if self._state is None:
            raise StepError("the source wants a start before it is stepped")
        return self._state


def build_source(spec: SourcePart, step: float, found: Findings) -> SourceComponent:
    """The source a scenario describes, on a clock of `step` [s]; what is wrong with it goes to `found`."""
    edge = 1e-6 * step
    unit = spec.unit
    if spec.constant is not None:
        return SourceComponent(unit, "hold", values=(found.at("constant").value(spec.constant, unit),))
    if spec.step is not None:
        return _step(spec.step, unit, edge, found.at("step"))
    if spec.ramp is not None:
        return _ramp(spec.ramp, unit, edge, found.at("ramp"))
    if spec.sine is not None:
        return _sine(spec.sine, unit, found.at("sine"))
    assert spec.table is not None, "the schema wants one of them"
    return _table(spec.table, unit, edge, found.at("table"))


def _step(step: Step, unit: str, edge: float, found: Findings) -> SourceComponent:
    values = (found.at("from").value(step.start, unit), found.at("to").value(step.to, unit))
    return SourceComponent(
        unit, "hold", times=(-math.inf, found.at("at").value(step.at, "s")), values=values, edge=edge
    )


def _ramp(ramp: Ramp, unit: str, edge: float, found: Findings) -> SourceComponent:
    times = (found.at("at").value(ramp.at, "s"), found.at("until").value(ramp.until, "s"))
    if times[1] <= times[0]:
        found.at("until").add(f"wants a time after {ramp.at}, got {ramp.until}; a jump is a step")
    values = (found.at("from").value(ramp.start, unit), found.at("to").value(ramp.to, unit))
    return SourceComponent(unit, "linear", times=times, values=values, edge=edge)


def _sine(sine: Sine, unit: str, found: Findings) -> SourceComponent:
    return SourceComponent(
        unit,
        "sine",
        mean=found.at("mean").value(sine.mean, unit),
        amplitude=found.at("amplitude").difference(sine.amplitude, unit),
        omega=2.0 * math.pi * found.at("frequency").value(sine.frequency, "Hz"),
        phase=found.at("phase").value(sine.phase, "rad"),
    )


def _table(table: Table, unit: str, edge: float, found: Findings) -> SourceComponent:
    def column(key: str, measures: Sequence[Measure], wanted: str) -> list[float]:
        return [found.at(key, index).value(measure, wanted) for index, measure in enumerate(measures)]

    times, values = column("time", table.time, "s"), column("value", table.value, unit)
    if len(times) != len(values) or not times:
        found.add(f"wants as many values as times and at least one, got {len(values)} and {len(times)}")
        return SourceComponent(unit, "hold")
    for index in range(1, len(times)):
        if times[index] <= times[index - 1]:
            found.at("time", index).add(f"wants a time after {table.time[index - 1]}, got {table.time[index]}")
            break
    return SourceComponent(unit, table.between, times=times, values=values, edge=edge)
