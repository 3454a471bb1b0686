"""Sources: inputs known in advance. The arithmetic is in source.c and points.c.

Over (k-1, k] a source holds the value it has at t_{k-1}; row 0 of a record has its value at t_0. A point of a table
and the jump of a step act from the instant they fall on, as measured to a millionth of the clock's step: a step at
2 s on a clock of 1 ms is in row 2001 for the first time, whatever the last bit of 2.0 says.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np

from fmus.component import OK, Native, Reversal, Role, Signal, StepError, Vector
from fmus.units import parse_unit
from harness.cycles import read_cycle
from harness.faults import Timed
from harness.findings import Findings
from harness.native import call, native_reversal, native_step
from harness.points import Horizon, Points, PointsState, check_reach, point
from harness.quantity import Measure
from harness.recording import Asked, Axis, open_recording
from harness.sourcepart import Chirp, Cycle, FiledTable, Ramp, Sine, SourcePart, Step, Table
from harness.tablefile import TableError

# In the order of source.c.
POINTS = 0
WAVES = ("sine", "linear chirp", "logarithmic chirp")


class Wave(NamedTuple):
    """mean + amplitude sin(angle) in SI, with x the time since `begin`, the start of the run where that is None.

    sine: angle = omega x + phase. A chirp's x is kept in 0 ... duration. linear chirp: angle = omega x + rate x^2 +
    phase. logarithmic chirp: angle = omega (exp(rate x) - 1)/rate + phase.
    """

    shape: Literal["sine", "linear chirp", "logarithmic chirp"]
    mean: float
    amplitude: float
    omega: float
    phase: float
    begin: float | None = None
    duration: float = 0.0
    rate: float = 0.0


class _Source(ctypes.Structure):
    _fields_ = [
        ("kind", ctypes.c_int64),
        ("points", PointsState),
        *((name, ctypes.c_double) for name in ("mean", "amplitude", "omega", "phase", "begin", "duration", "rate")),
    ]


class SourceComponent:
    """A source of points in time or a wave. The output is named `value`."""

    role: Role = "source"
    timed: Timed = "begin"
    inputs: Sequence[Signal] = ()
    feedthrough: frozenset[tuple[str, str]] = frozenset()

    def __init__(self, unit: str, given: Points | Wave) -> None:
        self.outputs: Sequence[Signal] = (Signal("value", unit),)
        self.given = given
        self._state: _Source | None = None

    def start(self, t0: float, u: Vector) -> Vector:
        """The value at t0 [s], shape (1,). Raises StepError: there is none."""
        if isinstance(self.given, Points):
            self._state = _Source(kind=POINTS, points=self.given.state())
        else:
            shape, mean, amplitude, omega, phase, begin, duration, rate = self.given
            begin = t0 if begin is None else begin
            kind = 1 + WAVES.index(shape)
            self._state = _Source(kind, PointsState(), mean, amplitude, omega, phase, begin, duration, rate)
        return self.step(t0, 0.0, u)

    def step(self, t: float, h: float, u: Vector) -> Vector:
        """The value held over a step from t [s], which is the value at t, shape (1,). Raises StepError."""
        status, value = call("crankbench_source_step", self._started(), t, h)
        if status != OK:
            raise self.failure(status, t)
        return value

    def native(self) -> Native:
        """The step in C."""
        return native_step("crankbench_source_step", self._started())

    def reversal(self) -> Reversal:
        """Keeping and going back in C, which do nothing: all that a source remembers is where to look first."""
        return native_reversal("crankbench_stateless_keep", "crankbench_stateless_keep", self._started())

    def failure(self, status: int, begin: float) -> StepError:
        """Why a step from `begin` [s] ended with a status: its points do not reach so far."""
        span = self.given.span if isinstance(self.given, Points) else ""
        return StepError(f"it has values at {span}, none at {begin:.9g} s", time=begin, status=status)

    def close(self) -> None:
        """Forget the state: it wants a start before the next step."""
        self._state = None

    def _started(self) -> _Source:
        if self._state is None:
            raise StepError("the source wants a start before it is stepped")
        return self._state


def build_source(spec: SourcePart, horizon: Horizon, found: Findings) -> SourceComponent:
    """The source a scenario describes; what is wrong with it goes to `found`."""
    return SourceComponent(spec.unit, _given(spec, horizon, found))


def _given(spec: SourcePart, horizon: Horizon, found: Findings) -> Points | Wave:
    unit = spec.unit
    if spec.constant is not None:
        return point(found.at("constant").value(spec.constant, unit))
    if spec.step is not None:
        return _step(spec.step, unit, horizon, found.at("step"))
    if spec.ramp is not None:
        return _ramp(spec.ramp, unit, horizon, found.at("ramp"))
    if spec.sine is not None:
        return _sine(spec.sine, unit, found.at("sine"))
    if spec.chirp is not None:
        return _chirp(spec.chirp, unit, found.at("chirp"))
    if spec.cycle is not None:
        return _cycle(spec.cycle, unit, horizon, found)
    if isinstance(spec.table, FiledTable):
        return _filed_table(spec.table, unit, horizon, found.at("table"))
    assert spec.table is not None, "the schema wants one of them"
    return _table(spec.table, unit, horizon, found.at("table"))


def _step(step: Step, unit: str, horizon: Horizon, found: Findings) -> Points:
    values = (found.at("from").value(step.start, unit), found.at("to").value(step.to, unit))
    return Points(np.array((-math.inf, found.at("at").value(step.at, "s"))), np.array(values), edge=horizon.edge)


def _ramp(ramp: Ramp, unit: str, horizon: Horizon, found: Findings) -> Points:
    times = (found.at("at").value(ramp.at, "s"), found.at("until").value(ramp.until, "s"))
    if times[1] <= times[0]:
        found.at("until").add(f"wants a time after {ramp.at}, got {ramp.until}; a jump is a step")
    values = (found.at("from").value(ramp.start, unit), found.at("to").value(ramp.to, unit))
    return Points(np.array(times), np.array(values), "linear", edge=horizon.edge)


def _sine(sine: Sine, unit: str, found: Findings) -> Wave:
    return Wave(
        "sine",
        mean=found.at("mean").value(sine.mean, unit),
        amplitude=found.at("amplitude").difference(sine.amplitude, unit),
        omega=2.0 * math.pi * found.at("frequency").value(sine.frequency, "Hz"),
        phase=found.at("phase").value(sine.phase, "rad"),
    )


def _chirp(chirp: Chirp, unit: str, found: Findings) -> Wave:
    duration = found.at("duration").value(chirp.duration, "s")
    if duration <= 0.0:
        found.at("duration").add(f"wants more than 0 s, got {chirp.duration}")
        duration = 1.0
    begin, end = found.at("from").value(chirp.start, "Hz"), found.at("to").value(chirp.to, "Hz")
    for key, given, frequency in (("from", chirp.start, begin), ("to", chirp.to, end)):
        if chirp.sweep == "linear" and frequency < 0.0:
            found.at(key).add(f"wants 0 Hz or more, got {given}")
        elif chirp.sweep == "logarithmic" and frequency <= 0.0:
            found.at(key).add(f"wants more than 0 Hz for a logarithmic sweep, got {given}")
            begin = end = 1.0
    logarithmic = chirp.sweep == "logarithmic" and begin != end  # of one frequency both are a sine
    return Wave(
        "logarithmic chirp" if logarithmic else "linear chirp",
        mean=found.at("mean").value(chirp.mean, unit),
        amplitude=found.at("amplitude").difference(chirp.amplitude, unit),
        omega=2.0 * math.pi * begin,
        phase=found.at("phase").value(chirp.phase, "rad"),
        begin=found.at("begin").value(chirp.begin, "s"),
        duration=duration,
        rate=math.log(end / begin) / duration if logarithmic else math.pi * (end - begin) / duration,
    )


def _table(table: Table, unit: str, horizon: Horizon, found: Findings) -> Points:
    def column(key: str, measures: Sequence[Measure], wanted: str) -> list[float]:
        return [found.at(key, index).value(measure, wanted) for index, measure in enumerate(measures)]

    times, values = column("time", table.time, "s"), column("value", table.value, unit)
    if len(times) != len(values) or not times:
        found.add(f"wants as many values as times and at least one, got {len(values)} and {len(times)}")
        return point(0.0)
    for index in range(1, len(times)):
        if times[index] <= times[index - 1]:
            found.at("time", index).add(f"wants a time after {table.time[index - 1]}, got {table.time[index]}")
            return point(0.0)
    points = Points(np.array(times), np.array(values), table.between, table.ends, horizon.edge)
    return _reaching(points, horizon, found)


def _filed_table(table: FiledTable, unit: str, horizon: Horizon, found: Findings) -> Points:
    axis = Axis("time", "s", table.time, table.time_unit)
    with open_recording(table.file, [table.value], axis, found) as recording:
        asked = Asked(table.value, table.unit, found, "value")
        recorded = recording.read(asked) if recording is not None else None
    if recorded is None:
        return point(0.0)
    if not parse_unit(recorded.unit).same_dimension(parse_unit(unit)):
        found.at("value").add(f"wants {unit}, got {recorded.unit} in '{table.value}' of {table.file}")
        return point(0.0)
    points = Points(recorded.times, recorded.values, table.between, table.ends, horizon.edge)
    return _reaching(points, horizon, found)


def _cycle(cycle: Cycle, unit: str, horizon: Horizon, found: Findings) -> Points:
    here = found.at("cycle")
    if not parse_unit("m/s").same_dimension(parse_unit(unit)):
        found.at("unit").add(f"wants a unit of speed for a drive cycle, like m/s, got {unit}")
    try:
        times, speeds = read_cycle(cycle.name)
    except TableError as error:
        here.at("name").add(str(error))
        return point(0.0)
    begin = here.at("begin").value(cycle.begin, "s")
    points = Points(begin + times, speeds, "linear", cycle.ends, horizon.edge)
    return _reaching(points, horizon, here)


def _reaching(points: Points, horizon: Horizon, found: Findings) -> Points:
    """The points, checked to reach wherever a step begins."""
    check_reach(points, horizon.start, horizon.last, found)
    return points
