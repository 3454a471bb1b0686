"""Runs a system: the laws of time and chance.

Time
    t_k = t_0 + k h, computed so from the integer k and never accumulated; parts get exactly that t.
Crank angle
    On a crank clock it is the angle that is counted: instant k is at a_k = a_0 + k step. The times follow from the
    speed that the plant shows: h_k = step / omega(t_{k-1}), and t_k = t_a + (k - a) h as long as the speed has been the
    same since instant a: at constant speed the instants are those of a clock in time. Where the plant shows its angle
    too, the clock steers to it: h_k = (step - missed) / omega, where `missed` is how far the plant is ahead of a_{k-1};
    what one step misses the next makes good. A speed below the slowest, or none, ends the run as an error.
Order
    In the step to instant k the parts are stepped in the system's order. Each gathers its inputs from the bus at its
    turn: a part stepped earlier shows its value at k, one stepped later its value at k-1; that wire is held, and the
    record lists it. The order follows direct feed-through, so only an input that no output depends on directly is held.
    A wire with a delay shows the value at k-1 always; so does every wire between plants and controllers that are
    coupled by Jacobi's method. An algebraic loop is refused, or solved: its parts are taken back and stepped again
    until each sees of the others the values at k.
Period
    A part with a period of n steps is stepped where n divides k, over (k-n, k], from t_{k-n} with the step n h: at the
    end of its period. Between, its outputs stand. Nothing shows the future. On a crank clock a part may be stepped at
    events of the cycle, from the last one to this; or keep steps in time of its own, of which those are made that end
    at t_k or before.
Rows
    Row k of the record holds the inputs that acted on (k-1, k] and the outputs at k: a source shows the value it had
    at t_{k-1} and held until t_k. A record of one instant in n has the rows that n divides. Row 0 holds the initialised
    outputs. Truth, measurement and estimate in one row
    belong to one instant. Initialisation follows the order too; a held input sees the declared start value.
Chance
    The random numbers of a part depend on (seed, part name) and what they are for, and on nothing else: a part more or
    less, or a sensor made worse, changes no number of another.
Truth
    An observer never reads a plant but through a sensor, and no part reads a fault signal; `wire` refuses it.
Repetition
    The same system gives the same bytes, however the run is cut into pieces.
Failure
    A status above warning, anything raised, or an output that is not finite ends the run as an outcome that names the
    part and the instant t_k it was stepped to; rows before k are kept. Warnings are counted.

The loop itself is loop.c; Python parts are called back from it.
"""

from __future__ import annotations

import math
import signal
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from types import FrameType
from typing import Any

import numpy as np

from fmus.component import STATUS_NAMES, Component, StepError, Vector
from fmus.whereabouts import doing, here
from harness.clock import CrankGrid
from harness.record import Record
from harness.rows import PIECE, InMemory, Rows
from harness.started import StartedSystem
from harness.system import Slot, System

Progress = Callable[[int, int], None]
# Between pieces of about this long the run answers to the keyboard and tells its progress.
PIECE_SECONDS = 0.05


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


def run(system: System, progress: Progress | None = None, rows: Rows | None = None) -> Record:
    """The record of a system from its start to its stop; a failure ends it early and is its outcome.

    `progress(k, steps)` is called every PIECE_SECONDS or so. KeyboardInterrupt passes through, between pieces and out
    of Python parts. The system stays open; running it again starts all parts anew. `rows` gives the
    memory that rows are written to, asked for once all parts are initialised; what it keeps is in the record.
    """
    began = time.perf_counter()
    grid = system.grid
    try:
        started = StartedSystem(system)
    except StepError as failure:
        wall = {"total": time.perf_counter() - began}
        return _record(system, np.empty((0, 1 + len(system.recorded))), {}, failure, wall)
    rows = rows or InMemory(PIECE if grid.endless else None)
    every, columns = system.every, 1 + len(system.recorded)
    room = rows.room(grid.steps // every + 1, columns)
    room[0] = started.row()
    instant, used, piece = 0, 1, 64
    here().instant = 1
    with _interrupts_kept() as interrupts, doing("step"):
        while instant < grid.steps and started.failure is None and not started.ended:
            if used == len(room):
                rows.done(used)
                room, used = rows.room(grid.steps // every - instant // every, columns), 0
            last = (instant // every + len(room) - used + 1) * every - 1
            tick = time.perf_counter()
            reached = started.advance(instant, min(instant + piece, grid.steps, last), room[used:])
            elapsed = time.perf_counter() - tick
            used += reached // every - instant // every
            instant = reached
            piece = max(1, min(piece * 8, int(piece * PIECE_SECONDS / max(elapsed, 1e-9))))
            if interrupts:
                raise KeyboardInterrupt
            if progress is not None:
                progress(instant, grid.steps)
        rows.done(used)
        if interrupts:
            raise KeyboardInterrupt
    wall = {**started.wall(instant), "total": time.perf_counter() - began}
    return _record(system, rows.kept(), started.warnings, started.failure, wall, started.notes)


def no_rows(system: System) -> Record:
    """The record of a system without its rows: its signals, order and parts, and their start values as applied."""
    return Record(
        tuple(system.bus[place] for place in system.recorded),
        np.empty(0),
        np.empty((0, len(system.recorded))),
        crank=crank_angles(system, 0),
        order=system.order,
        held=tuple(map(str, system.held)),
        starts={slot.name: _starts(slot, system) for slot in system.parts},
        fmus={slot.name: _provenance(slot.component) for slot in system.parts if hasattr(slot.component, "sha256")},
        tolerated=tuple(
            {"part": slot.name, "category": "tolerated", "text": caution}
            for slot in system.parts
            for caution in getattr(getattr(slot.component, "description", None), "cautions", ())
        )
        + tuple({"part": name, "category": "clock", "text": text} for name, text in system.notes),
    )


def crank_angles(system: System, count: int) -> Vector | None:
    """The crank angles [deg] of the first `count` rows of a record; None on a clock in time."""
    grid = system.grid
    return grid.angles(np.arange(count) * system.every) if isinstance(grid, CrankGrid) else None


def _record(
    system: System,
    rows: Vector,
    warnings: Mapping[str, int],
    failure: StepError | None,
    wall: Mapping[str, float],
    notes: Sequence[Mapping[str, Any]] = (),
) -> Record:
    outcome, part, message = "ok", "", ""
    if failure is not None:
        outcome, part, message = STATUS_NAMES[failure.status], failure.part, failure.message
    elif warnings:
        counted = ", ".join(f"{name} {count}" for name, count in warnings.items())
        outcome, part, message = "warning", next(iter(warnings)), f"steps that ended with a warning: {counted}"
    log: list[Any] = list(notes)
    for slot in system.parts:
        log += [{"part": slot.name, **entry._asdict()} for entry in getattr(slot.component, "log", ())]
    if failure is not None and failure.__cause__ is not None:
        trace = "".join(traceback.format_exception(failure.__cause__))
        log.append(
            {"part": failure.part, "time": failure.time, "status": failure.status, "category": "trace", "text": trace}
        )
    return replace(
        no_rows(system),
        time=rows[:, 0],
        crank=crank_angles(system, len(rows)),
        values=rows[:, 1:],
        outcome=outcome,
        part=part,
        failed_at=math.nan if failure is None else failure.time,
        message=message,
        log=tuple(log),
        wall=wall,
    )


def _starts(slot: Slot, system: System) -> Mapping[str, float]:
    """Start values as applied, in the units the FMU declares; a Python part's settings in SI."""
    applied = getattr(slot.component, "applied_starts", None)
    return dict(system.settings.get(slot.name, {}) if applied is None else applied)


def _provenance(component: Component) -> Mapping[str, str]:
    return {key: str(getattr(component, key, "")) for key in ("sha256", "tool", "fmi_version")}
