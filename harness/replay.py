"""Replays: recorded measurements in the place of a plant. The arithmetic is in replay.c and points.c.

Row k of a record has what the file holds at t_k, or at the crank angle of instant k. So a record replayed on its own
instants gives its own columns bit for bit, and sensors and observers see what they saw of the plant.
"""

from __future__ import annotations

import ctypes
import re
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from fmus.component import OK, Native, Reversal, Role, Signal, StepError, Vector
from harness.clock import CrankGrid, Grid
from harness.findings import Findings
from harness.native import library, native_reversal, native_step
from harness.points import Horizon, Points, PointsState, check_reach, horizon
from harness.recording import Asked, Axis, Recording, open_recording
from harness.sourcepart import ReplayPart

_NAME = re.compile(r"[A-Za-z_]\w*$")


class Replayed(NamedTuple):
    """An output and the points it shows, in SI."""

    signal: Signal
    points: Points


class _Replay(ctypes.Structure):
    _fields_ = [
        ("count", ctypes.c_int64),
        ("signals", ctypes.c_void_p),
        ("counts", ctypes.c_int64),
        *((name, ctypes.c_double) for name in ("numerator", "denominator", "origin")),
        *((name, ctypes.c_int64) for name in ("k", "kept")),
    ]


class ReplayComponent:
    """Recorded signals, each with the points of its own: over time, or over the crank angle of a clock."""

    role: Role = "plant"
    inputs: Sequence[Signal] = ()
    feedthrough: frozenset[tuple[str, str]] = frozenset()

    def __init__(self, replayed: Sequence[Replayed], clock: CrankGrid | None = None) -> None:
        self.outputs: Sequence[Signal] = tuple(signal for signal, _ in replayed)
        self.points = tuple(points for _, points in replayed)
        self.clock = clock
        self._state: _Replay | None = None

    def start(self, t0: float, u: Vector) -> Vector:
        """What was recorded at t0 [s], or at the origin, shape (signals,). Raises StepError: nothing was."""
        self._signals = (PointsState * len(self.points))(*(points.state() for points in self.points))
        self._state = _Replay(len(self.points), ctypes.addressof(self._signals))
        if self.clock is not None:
            self._state.counts = 1
            self._state.numerator, self._state.denominator = self.clock.numerator, self.clock.denominator
            self._state.origin = self.clock.origin
        return self._called("crankbench_replay_start", t0)

    def step(self, t: float, h: float, u: Vector) -> Vector:
        """What was recorded at t + h [s], or the next crank angle, shape (signals,). Raises StepError: nothing was."""
        return self._called("crankbench_replay_step", t, h)

    def native(self) -> Native:
        """The step in C."""
        return native_step("crankbench_replay_step", self._started())

    def reversal(self) -> Reversal:
        """Keeping and going back in C."""
        return native_reversal("crankbench_replay_keep", "crankbench_replay_restore", self._started())

    def failure(self, status: int, begin: float) -> StepError:
        """Why a step from `begin` [s] ended with a status: what was recorded does not reach so far."""
        spans = ", ".join(dict.fromkeys(points.span for points in self.points))
        return StepError(f"recorded is {spans}; `ends: hold` holds the nearest", time=begin, status=status)

    def close(self) -> None:
        """Forget the state: it wants a start before the next step."""
        self._state = None

    def _started(self) -> _Replay:
        if self._state is None:
            raise StepError("the replay wants a start before it is stepped")
        return self._state

    def _called(self, function: str, *times: float) -> Vector:
        outputs = np.empty(len(self.points))
        arguments = [ctypes.c_double(time) for time in times]
        ends = (None, ctypes.c_void_p(outputs.ctypes.data))
        status = getattr(library(), function)(ctypes.byref(self._started()), *arguments, *ends)
        if status != OK:
            raise self.failure(status, times[0])
        return outputs


def build_replay(spec: ReplayPart, grid: Grid, found: Findings) -> ReplayComponent | None:
    """The replay a scenario describes; None where something is wrong with it, which goes to `found`."""
    before = len(found.problems)
    for name in spec.signals:
        if not _NAME.match(name):
            found.at("signals", name).tell(f"a signal's name wants letters, digits and _, got '{name}'")
    axis, reach = Axis("time", "s", spec.time, spec.time_unit), horizon(grid)
    clock = None
    if spec.crank is not None:
        if not isinstance(grid, CrankGrid):
            found.at("crank").add("wants a crank clock, got one in time: leave it out")
            return None
        axis, reach, clock = Axis("crank", "deg", spec.crank, spec.crank_unit), _turn(grid), grid
    columns = [signal.column for signal in spec.signals.values()]
    with open_recording(spec.file, columns, axis, found) as recording:
        if recording is None:
            return None
        replayed = [_replayed(name, recording, spec, (axis, reach), found) for name in spec.signals]
    whole = [one for one in replayed if one is not None]
    for signal, points in {one.points.span: one for one in reversed(whole)}.values():
        check_reach(points, reach.start, reach.stop, found.at("signals", signal.name))
    return ReplayComponent(whole, clock) if len(found.problems) == before else None


def _turn(grid: CrankGrid) -> Horizon:
    """The horizon of a crank clock in crank angle [deg]; where it stops at a time, that is its origin alone."""
    steps = 0 if grid.endless else grid.steps
    last, stop = (grid.origin + count * grid.degrees for count in (max(steps - 1, 0), steps))
    return Horizon(grid.origin, last, stop, 1e-6 * grid.degrees)


def _replayed(
    name: str, recording: Recording, spec: ReplayPart, over: tuple[Axis, Horizon], found: Findings
) -> Replayed | None:
    here, given, (axis, reach) = found.at("signals", name), spec.signals[name], over
    recorded = recording.read(Asked(given.column, given.unit, here, "column", given.kind))
    if recorded is None:
        return None
    discrete = recorded.kind != "real"
    if discrete and given.between == "linear":
        here.at("between").add(f"wants hold for {recorded.kind} values, got linear")
    between = "hold" if discrete else given.between or spec.between
    points = Points(recorded.times, recorded.values, between, spec.ends, reach.edge, axis.unit)
    signal = Signal(name, recorded.unit, description=f"recorded as {given.column}", kind=recorded.kind)
    return Replayed(signal, points)
