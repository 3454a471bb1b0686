"""Runs a system: the laws of time and chance.

Time
    t_k = t_0 + k h, computed so from the integer k and never accumulated; parts get exactly that t.
Order
    In the step to instant k the parts are stepped in the system's order. Each gathers its inputs from the bus at its
    turn: a part stepped earlier shows its value at k, one stepped later its value at k-1; that wire is held, and the
    record lists it. The order follows direct feed-through, so only an input that no output depends on directly is held.
Period
    A part with a period of n steps is stepped where n divides k, over (k-n, k], from t_{k-n} with the step n h: at the
    end of its period. Between, its outputs stand. Nothing shows the future.
Rows
    Row k of the record holds the inputs that acted on (k-1, k] and the outputs at k: a source shows the value it had
    at t_{k-1} and held until t_k. Row 0 holds the initialised outputs. Truth, measurement and estimate in one row
    belong to one instant. Initialisation follows the order too; a held input sees the declared start value.
Chance
    The random numbers of a part depend on (seed, part name) and what they are for, and on nothing else: a part more or
    less, or a sensor made worse, changes no number of another.
Truth
    An observer never reads a plant but through a sensor; `wire` refuses it.
Repetition
    The same system gives the same bytes, however the run is cut into pieces.
Failure
    A status above warning, anything raised, or an output that is not finite ends the run as an outcome that names the
    part and the instant t_k it was stepped to; rows before k are kept. Warnings are counted.

The loop itself is loop.c; Python parts are called back from it.
"""

from __future__ import annotations

import ctypes
import math
import signal
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from types import FrameType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fmus.component import DIVERGED, ERROR, FATAL, OK, STATUS_NAMES, WARNING, Component, Native, StepError, Vector
from fmus.units import parse_unit
from harness.native import address, library, native_step
from harness.record import Record
from harness.system import Slot, System

Progress = Callable[[int, int], None]
# How many timed steps of a part loop.c keeps.
KEPT_TIMES = 256
# Between pieces of about this long the run answers to the keyboard and tells its progress.
PIECE_SECONDS = 0.05

_Call = ctypes.CFUNCTYPE(None, ctypes.c_double, ctypes.c_double)


class _PythonPart(ctypes.Structure):
    _fields_ = [("call", _Call), ("status", ctypes.c_int64)]


class _Part(ctypes.Structure):
    _fields_ = [
        *((name, ctypes.c_void_p) for name in ("step", "self", "u", "gathered", "inputs")),
        ("gathers", ctypes.c_int64),
        ("y", ctypes.c_void_p),
        *((name, ctypes.c_int64) for name in ("outputs", "period", "warnings", "timed")),
        ("took", ctypes.c_void_p),
    ]


class _Loop(ctypes.Structure):
    _fields_ = [
        *((name, ctypes.c_double) for name in ("t0", "h")),
        ("parts", ctypes.POINTER(_Part)),
        ("count", ctypes.c_int64),
        *((name, ctypes.c_void_p) for name in ("bus", "recorded")),
        ("columns", ctypes.c_int64),
    ]


class _Stop(ctypes.Structure):
    _fields_ = [(name, ctypes.c_int64) for name in ("part", "output", "k")]


class _Callback:
    """A part written in Python as a step that C calls; what it raises is kept, since C cannot pass it on."""

    def __init__(self, component: Component, u: Vector, y: Vector) -> None:
        self.component, self.u, self.y = component, u, y
        self.raised: BaseException | None = None
        self.state = _PythonPart(_Call(self._step), OK)

    def native(self) -> Native:
        """The step for C."""
        return native_step("crankbench_python_step", self.state)

    def _step(self, t: float, h: float) -> None:
        try:
            outputs = self.component.step(t, h, self.u.copy())
            if len(outputs) != len(self.y):
                raise ValueError(f"step wants to return {len(self.y)} outputs, got {len(outputs)}")
            self.y[:] = outputs
            self.state.status = OK
        except BaseException as error:
            self.raised = error


@contextmanager
def _interrupts_kept() -> Iterator[list[int]]:
    """Keeps a first interrupt from the keyboard until the run is between two pieces; a second acts at once.

    Inside a callback from C it would be lost. A handler that is not Python's own is left alone.
    """
    kept: list[int] = []
    ours = threading.current_thread() is threading.main_thread()
    if not ours or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield kept
        return

    def keep(number: int, frame: FrameType | None) -> None:
        if kept:
            signal.default_int_handler(number, frame)
        kept.append(number)

    signal.signal(signal.SIGINT, keep)
    try:
        yield kept
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)


class StartedSystem:
    """A system after initialisation: `bus` has the outputs of row 0, `advance` goes on from there.

    `failure` is what ended it early, None as long as nothing did.
    """

    def __init__(self, system: System) -> None:
        """Initialise all parts in order. Raises StepError."""
        self.system = system
        self.failure: StepError | None = None
        grid = system.grid
        self.bus = np.array([parse_unit(s.unit).to_si(float(np.asarray(s.start))) for s in system.bus], dtype=float)
        for slot in system.parts:
            self._start(slot)
        self._callbacks: dict[int, _Callback] = {}
        self._took = np.zeros((len(system.parts), KEPT_TIMES))
        self._arrays: list[NDArray[Any]] = []
        self._parts = (_Part * max(len(system.parts), 1))(*(self._entry(i) for i in range(len(system.parts))))
        self._recorded = np.array(system.recorded, dtype=np.int64)
        columns = len(system.recorded)
        self._loop = _Loop(
            grid.start, grid.step, self._parts, len(system.parts), address(self.bus), address(self._recorded), columns
        )

    def row(self) -> Vector:
        """The recorded signals as they stand on the bus, shape (columns,), SI."""
        return self.bus[self._recorded]

    @property
    def warnings(self) -> dict[str, int]:
        """How many steps of each part ended with a warning; parts without one are left out."""
        counts = zip(self.system.order, (part.warnings for part in self._parts), strict=False)
        return {name: count for name, count in counts if count}

    def wall(self, instant: int) -> dict[str, float]:
        """The time [s] each part took up to an instant: its steps times the median of those timed, one in 61.

        Parts never timed are left out.
        """
        entries = zip(self.system.parts, self._parts, self._took, strict=False)
        return {s.name: float(np.median(t[: p.timed])) * (instant // s.period) for s, p, t in entries if p.timed}

    def advance(self, begin: int, end: int, rows: Vector) -> int:
        """Step from instant `begin` to `end`, write rows begin+1 ... end, and return the instant reached.

        `rows` has shape (end - begin, columns), C order. Where the instant returned is not `end`, `failure` says why.
        What a Python part raised that is no Exception, like KeyboardInterrupt, passes through.
        """
        stop = _Stop()
        status = library().crankbench_advance(
            ctypes.byref(self._loop),
            ctypes.c_int64(begin),
            ctypes.c_int64(end),
            ctypes.c_void_p(rows.ctypes.data),
            ctypes.byref(stop),
        )
        if status == OK:
            return end
        self.failure = self._failure(status, stop)
        return stop.k - 1

    def _failure(self, status: int, stop: _Stop) -> StepError:
        slot = self.system.parts[stop.part]
        instant = self.system.grid.start + stop.k * self.system.grid.step
        callback = self._callbacks.get(stop.part)
        if callback is not None and status == FATAL:
            raised = callback.raised
            if isinstance(raised, Exception):
                return _as_step_error(raised, slot.name, instant)
            raise raised or KeyboardInterrupt  # what breaks in at the edge of a callback is a signal
        if status == DIVERGED:
            place = slot.outputs[stop.output]
            return StepError(_not_finite(self.system, self.bus, place), part=slot.name, time=instant, status=status)
        begin = self.system.grid.start + (stop.k - slot.period) * self.system.grid.step
        explain = getattr(slot.component, "failure", None)
        message = explain(status, begin).message if explain else f"the step from {begin:.9g} s ended so"
        return StepError(message, part=slot.name, time=instant, status=status)

    def _start(self, slot: Slot) -> None:
        begin = self.system.grid.start
        try:
            outputs = np.asarray(slot.component.start(begin, self.bus[list(slot.inputs)]), dtype=float)
        except Exception as error:
            raise _as_step_error(error, slot.name, begin) from error
        if outputs.shape != (len(slot.outputs),):
            message = f"start wants to return {len(slot.outputs)} outputs, got shape {outputs.shape}"
            raise StepError(message, part=slot.name, time=begin)
        self.bus[slot.outputs.start : slot.outputs.stop] = outputs
        for place, value in zip(slot.outputs, outputs, strict=True):
            if not math.isfinite(value):
                message = _not_finite(self.system, self.bus, place)
                raise StepError(message, part=slot.name, time=begin, status=DIVERGED)

    def _entry(self, index: int) -> _Part:
        slot = self.system.parts[index]
        gathered = np.zeros(max(len(slot.inputs), 1))
        inputs = np.array(slot.inputs, dtype=np.int64)
        self._arrays += [gathered, inputs]
        # Inputs that lie side by side on the bus are read there, unless the part would overwrite them as it steps.
        direct = _side_by_side(slot.inputs) and not set(slot.inputs) & set(slot.outputs)
        u = self.bus[slot.inputs[0] : slot.inputs[-1] + 1] if direct else gathered[: len(slot.inputs)]
        y = self.bus[slot.outputs.start : slot.outputs.stop]
        native = slot.component.native()
        if native is None:
            self._callbacks[index] = _Callback(slot.component, u, y)
            native = self._callbacks[index].native()
        gathers = 0 if direct else len(slot.inputs)
        return _Part(
            *native,
            address(u),
            address(gathered),
            address(inputs),
            gathers,
            address(y),
            len(y),
            slot.period,
            0,
            0,
            address(self._took[index]),
        )


def run(system: System, progress: Progress | None = None) -> Record:
    """The record of a system from its start to its stop; a failure ends it early and is its outcome.

    `progress(k, steps)` is called every PIECE_SECONDS or so. KeyboardInterrupt passes through, between pieces and out
    of Python parts. The system stays open; running it again starts all parts anew.
    """
    began = time.perf_counter()
    grid = system.grid
    try:
        started = StartedSystem(system)
    except StepError as failure:
        wall = {"total": time.perf_counter() - began}
        return _record(system, np.empty((0, len(system.recorded))), {}, failure, wall)
    values = np.empty((grid.steps + 1, len(system.recorded)))
    values[0] = started.row()
    instant, piece = 0, 64
    with _interrupts_kept() as interrupts:
        while instant < grid.steps and started.failure is None:
            tick = time.perf_counter()
            instant = started.advance(instant, min(instant + piece, grid.steps), values[instant + 1 :])
            elapsed = time.perf_counter() - tick
            piece = max(1, min(piece * 8, int(piece * PIECE_SECONDS / max(elapsed, 1e-9))))
            if interrupts:
                raise KeyboardInterrupt
            if progress is not None:
                progress(instant, grid.steps)
    wall = {**started.wall(instant), "total": time.perf_counter() - began}
    return _record(system, values[: instant + 1], started.warnings, started.failure, wall)


def _record(
    system: System, values: Vector, warnings: Mapping[str, int], failure: StepError | None, wall: Mapping[str, float]
) -> Record:
    grid = system.grid
    outcome, part, message = "ok", "", ""
    if failure is not None:
        outcome, part, message = STATUS_NAMES[failure.status], failure.part, failure.message
    elif warnings:
        counted = ", ".join(f"{name} {count}" for name, count in warnings.items())
        outcome, part, message = "warning", next(iter(warnings)), f"steps that ended with a warning: {counted}"
    log: list[Any] = []
    for slot in system.parts:
        log += [{"part": slot.name, **entry._asdict()} for entry in getattr(slot.component, "log", ())]
    if failure is not None and failure.__cause__ is not None:
        trace = "".join(traceback.format_exception(failure.__cause__))
        log.append(
            {"part": failure.part, "time": failure.time, "status": failure.status, "category": "trace", "text": trace}
        )
    return Record(
        tuple(system.bus[place] for place in system.recorded),
        grid.start + np.arange(len(values), dtype=np.float64) * grid.step,
        values,
        outcome=outcome,
        part=part,
        failed_at=math.nan if failure is None else failure.time,
        message=message,
        order=system.order,
        held=tuple(map(str, system.held)),
        starts={slot.name: _starts(slot, system) for slot in system.parts},
        log=tuple(log),
        wall=wall,
        fmus={slot.name: _provenance(slot.component) for slot in system.parts if hasattr(slot.component, "sha256")},
    )


def _starts(slot: Slot, system: System) -> Mapping[str, float]:
    """Start values as applied, in the units the FMU declares; a Python part's settings in SI."""
    applied = getattr(slot.component, "applied_starts", None)
    return dict(system.settings.get(slot.name, {}) if applied is None else applied)


def _provenance(component: Component) -> Mapping[str, str]:
    return {key: str(getattr(component, key, "")) for key in ("sha256", "tool", "fmi_version")}


def _as_step_error(error: Exception, part: str, instant: float) -> StepError:
    """What a part raised as a step error that names it; the error itself is its cause unless it is one already."""
    if isinstance(error, StepError):
        status = error.status if error.status > WARNING else ERROR
        return StepError(error.message, part=part, time=instant, status=status)
    failure = StepError(f"{type(error).__name__}: {error}", part=part, time=instant, status=ERROR)
    failure.__cause__ = error
    return failure


def _not_finite(system: System, bus: Vector, place: int) -> str:
    return f"{system.bus[place].name} is {bus[place]:g}"


def _side_by_side(places: Sequence[int]) -> bool:
    return bool(places) and list(places) == list(range(places[0], places[0] + len(places)))
