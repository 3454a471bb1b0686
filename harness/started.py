"""A system after initialisation: the table of parts that loop.c steps, and what became of them."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fmus.component import DIVERGED, ERROR, FATAL, OK, WARNING, StepError, Vector
from fmus.units import parse_unit
from fmus.whereabouts import doing, here
from harness.clock import CrankGrid, TimeGrid
from harness.coupling import Unsolved, loop_message, made_group, scales, solve_start, told, unsolved
from harness.looptable import Callback, CClock, CFixedGrid, CLoop, CPart, CStop
from harness.native import address, library, native_step, settle
from harness.system import Group, Slot, System

# Ends of the loop that no part is to blame for: see parts.c.
STALLED, ASTRAY, ENDED, UNSOLVED = 6, 7, 8, 9
# How many timed steps of a part loop.c keeps.
KEPT_TIMES = 256


class StartedSystem:
    """A system after initialisation: `bus` has the outputs of row 0, `advance` goes on from there.

    `failure` is what ended it early, None as long as nothing did; `ended` whether the clock reached its stop.
    """

    def __init__(self, system: System) -> None:
        """Initialise all parts in order. Raises StepError."""
        self.system = system
        self.failure: StepError | None = None
        self.ended = False
        self.bus = np.array([parse_unit(s.unit).to_si(float(np.asarray(s.start))) for s in system.bus], dtype=float)
        settle()
        self._start_all()
        self._callbacks: dict[int, Callback] = {}
        self._grids: dict[int, CFixedGrid] = {}
        self._took = np.zeros((len(system.parts), KEPT_TIMES))
        self._arrays: list[NDArray[Any]] = []
        self._parts = (CPart * max(len(system.parts), 1))(*(self._entry(i) for i in range(len(system.parts))))
        self._recorded = np.array(system.recorded, dtype=np.int64)
        self._held: list[Any] = []
        groups = [*system.groups, *((system.steered,) if system.steered else ())]
        self._groups = [
            (group, made_group(group, system, self._parts, self.bus, self._callbacks, self._held)) for group in groups
        ]
        for group, made in self._groups:
            if group.kind != "steered":
                self._parts[group.first].group = ctypes.addressof(made)
                self._parts[group.first].always = 0
        first_places = system.recorded == tuple(range(len(system.recorded)))
        place = here()
        place.entry = place.table = ctypes.addressof(self._parts)
        place.size = ctypes.sizeof(CPart)
        self._clock = self._made_clock()
        self._loop = CLoop(
            ctypes.pointer(self._clock),
            self._parts,
            len(system.parts),
            address(self.bus),
            len(self.bus),
            None if first_places else address(self._recorded),
            len(system.recorded),
            system.every,
            ctypes.addressof(place),
            next((ctypes.addressof(made) for group, made in self._groups if group.kind == "steered"), None),
        )
        settle()

    def _made_clock(self) -> CClock:
        grid = self.system.grid
        if isinstance(grid, TimeGrid):
            return CClock(grid.start, grid.step, denominator=1.0, cycle=1)
        assert self.system.speed is not None, "a crank clock has a speed"
        angle = None if self.system.angle is None else address(self.bus[self.system.angle :])
        return CClock(
            t0=grid.start,
            speed=address(self.bus[self.system.speed :]),
            angle=angle,
            numerator=grid.numerator,
            denominator=float(grid.denominator),
            origin=grid.origin,
            slowest=grid.slowest,
            stop=grid.stop - 1e-9,
            cycle=grid.cycle,
            next=grid.start,
            anchored=grid.start,
        )

    def row(self) -> Vector:
        """Time and the recorded signals as they stand on the bus, shape (1 + columns,), SI."""
        return np.concatenate(([self.system.grid.start], self.bus[self._recorded]))

    @property
    def notes(self) -> list[dict[str, Any]]:
        """How parts that are stepped together were, as entries of the log."""
        order = self.system.order
        entries = [told(one, made, order[one.first : one.first + one.count]) for one, made in self._groups]
        return [entry for entry in entries if entry is not None]

    @property
    def warnings(self) -> dict[str, int]:
        """How many steps of each part ended with a warning; parts without one are left out."""
        counts = zip(self.system.order, (part.warnings for part in self._parts), strict=False)
        return {name: count for name, count in counts if count}

    def wall(self, instant: int) -> dict[str, float]:
        """The time [s] each part took up to an instant: its steps times the median of those timed, one in 251.

        Parts never timed are left out.
        """
        entries = zip(self.system.parts, self._parts, self._took, strict=False)
        return {s.name: float(np.median(t[: p.timed])) * (instant // s.pace.period) for s, p, t in entries if p.timed}

    def advance(self, begin: int, end: int, rows: Vector) -> int:
        """Step from instant `begin` to `end`, write the rows there are between, and return the instant reached.

        `rows` has shape (rows, 1 + columns), C order: time and signals, for each instant that `every` divides. Where
        the instant returned is not `end`, `failure` says why, or the clock has `ended`. What a Python part raised that
        is no Exception, like KeyboardInterrupt, passes through.
        """
        stop = CStop()
        status = library().crankbench_advance(
            ctypes.byref(self._loop),
            ctypes.c_int64(begin),
            ctypes.c_int64(end),
            ctypes.c_void_p(rows.ctypes.data),
            ctypes.byref(stop),
        )
        if status == OK:
            return end
        if status == ENDED:
            self.ended = True
            return stop.k
        self.failure = self._failure(status, stop)
        return stop.k - 1

    def _failure(self, status: int, stop: CStop) -> StepError:
        if status in (STALLED, ASTRAY):
            return self._clock_failure(status, stop.k)
        slot = self.system.parts[stop.part]
        begin, instant = self._span(slot, self._parts[stop.part], stop.k)
        if status == UNSOLVED:
            return self._unsolved(stop.part, instant)
        callback = self._callbacks.get(stop.part)
        if callback is not None and status == FATAL:
            raised = callback.raised
            if isinstance(raised, Exception):
                return _as_step_error(raised, slot.name, instant)
            raise raised or KeyboardInterrupt  # what breaks in at the edge of a callback is a signal
        if status == DIVERGED:
            place = slot.outputs[stop.output]
            return StepError(_not_finite(self.system, self.bus, place), part=slot.name, time=instant, status=status)
        explain = getattr(slot.component, "failure", None)
        message = explain(status, begin).message if explain else f"the step from {begin:.9g} s ended so"
        return StepError(message, part=slot.name, time=instant, status=status)

    def _unsolved(self, part: int, instant: float) -> StepError:
        """The error of parts stepped together and given up: `part` is a group's first, or the last that is steered."""
        for group, made in self._groups:
            first = group.first + (group.count - 1 if group.kind == "steered" else 0)
            if first == part:
                named = self.system.parts[part + (1 if group.torn else 0)].name
                return StepError(unsolved(group, made, self.system), part=named, time=instant)
        raise AssertionError("only groups are given up")

    def _span(self, slot: Slot, part: CPart, k: int) -> tuple[float, float]:
        """The times [s] that a part's step to instant k led from and to."""
        grid = self.system.grid
        if isinstance(grid, TimeGrid):
            return grid.start + (k - slot.pace.period) * grid.step, grid.start + k * grid.step
        return self._clock.t, self._clock.next

    def _clock_failure(self, status: int, k: int) -> StepError:
        """The error of a crank clock that can make no step from instant k - 1."""
        grid, system = self.system.grid, self.system
        assert isinstance(grid, CrankGrid) and system.speed is not None, "only a crank clock can fail"
        place = system.speed if status == STALLED or system.angle is None else system.angle
        value, name = self.bus[place], system.bus[place].name
        if status == STALLED:
            slowest = f"{grid.slowest:.6g} rad/s, its `slowest` of {parse_unit('rpm').from_si(grid.slowest):.6g} rpm"
            message = f"{name} is {value:.6g} rad/s: the crank clock wants at least {slowest}"
        else:
            nominal = float(grid.angles(np.array([k - 1]))[0])
            missed = math.remainder(math.degrees(value) - nominal, 360.0)
            message = f"{name} is {math.degrees(value):.6g} deg where the crank clock is at {nominal:.6g} deg"
            message += f", {missed:.3g} deg off: more than half a step; the clock's `origin` is {grid.origin:g} deg"
        return StepError(message, part=name.partition(".")[0], time=self._clock.next)

    def _start_all(self) -> None:
        """Initialise the parts in order, those of an algebraic loop until it is solved."""
        parts, first_of = self.system.parts, {group.first: group for group in self.system.groups if group.torn}
        place = 0
        while place < len(parts):
            with doing("start", parts[place].name):
                self._start(parts[place])
            if place in first_of:
                self._start_loop(first_of[place])
                place += first_of[place].count
            else:
                place += 1

    def _start_loop(self, group: Group) -> None:
        """Initialise the parts of a loop behind its head so that they make of its torn signals what they are given."""
        system = self.system
        given, made = ([pair[side] for pair in group.torn] for side in (0, 1))
        members = system.parts[group.first + 1 : group.first + group.count]

        def make(guess: Vector) -> Vector:
            self.bus[given] = guess
            for slot in members:
                with doing("start", slot.name):
                    self._start(slot)
            return self.bus[made]

        try:
            solve_start(make, self.bus[given], scales(system)[made], system.coupling)
        except Unsolved as error:
            message = loop_message(group, system.bus[made[error.place]].name, error.missed, system.coupling)
            raise StepError(message, part=members[0].name, time=system.grid.start) from None

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

    def _entry(self, index: int) -> CPart:
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
            self._callbacks[index] = Callback(slot.component, u, y)
            native = self._callbacks[index].native()
        reading = getattr(native, "reading", None)
        grouped = any(one.first <= index < one.first + one.count for one in self.system.groups)
        if reading and not direct and not grouped:
            native, u, direct = reading(slot.inputs), self.bus, True
        step, itself = native
        if slot.pace.own:
            self._grids[index] = CFixedGrid(step, itself, self.system.grid.start, slot.pace.own)
            step, itself = native_step("crankbench_grid_step", self._grids[index])
        return CPart(
            step=step,
            self=itself,
            u=address(u),
            gathered=address(gathered),
            inputs=address(inputs),
            gathers=0 if direct else len(slot.inputs),
            y=address(y),
            outputs=len(y),
            always=slot.pace.period == 1 and not slot.pace.due,
            period=slot.pace.period,
            due=slot.pace.due or None,
            reached=self.system.grid.start,
            took=address(self._took[index]),
        )


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
