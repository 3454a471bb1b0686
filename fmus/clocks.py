"""FMI 3.0's clocks: which tick at known times, and Co-Simulation that hands over at events, where they tick."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence
from ctypes import addressof, c_bool, c_double, c_int64, c_size_t, c_uint32, c_void_p
from dataclasses import dataclass
from typing import Any

from fmus.adapter import Adapter, address, stepping_library
from fmus.component import Native, Vector


@dataclass(frozen=True)
class Clock:
    """A clock of an FMU; `interval` and `shift` [s] are None and 0 where the description does not give them."""

    name: str
    reference: int
    causality: str
    variability: str
    interval: float | None = None
    shift: float = 0.0

    @property
    def ticked(self) -> bool:
        """True for an input clock with a period, which is ticked from outside."""
        return self.causality == "input" and self.variability in ("constant", "fixed", "tunable")

    @property
    def refusal(self) -> str:
        """Why an FMU with it is not run; empty where it is. A triggered clock may stay still for ever."""
        if self.causality != "input" or self.variability == "triggered":
            return ""
        if not self.ticked:
            return f"its clock {self.name} wants ticks at times that change as it runs ({self.variability})"
        if self.interval is None or self.interval <= 0.0:
            return f"its clock {self.name} does not say in its description how often it ticks"
        return ""


class ClockTable(ctypes.Structure):
    """The struct Clocks of clocks.c."""

    _fields_ = (
        ("count", c_size_t),
        *((name, c_void_p) for name in ("references", "first", "interval", "ticks", "due", "on", "set_clock")),
        ("start", c_double),
    )

    def fill(self, clocks: Sequence[Clock], function: Callable[[str], int]) -> list[Any]:
        """Enter those that are ticked; what is returned is to be kept as long as the table."""
        ticked = [clock for clock in clocks if clock.ticked and clock.interval]
        n = len(ticked)
        kept: list[Any] = [
            (c_uint32 * n)(*(clock.reference for clock in ticked)),
            (c_double * n)(*(clock.shift for clock in ticked)),
            (c_double * n)(*(clock.interval or 0.0 for clock in ticked)),
            (c_int64 * n)(),
            (c_uint32 * n)(),
            (c_bool * n)(*[True] * n),
        ]
        self.count = n
        for name, array in zip(("references", "first", "interval", "ticks", "due", "on"), kept, strict=True):
            setattr(self, name, addressof(array))
        if n:
            self.set_clock = function("SetClock")
        return kept


class _EventMode(ctypes.Structure):
    _fields_ = (
        ("slave", c_void_p),
        ("clocks", ClockTable),
        *((name, c_void_p) for name in ("enter_event_mode", "update_states", "enter_step_mode", "last_inputs")),
        ("inputs", c_size_t),
        ("events", c_int64),
    )


class EventMode:
    """The C side of Co-Simulation that hands over at events: where its clocks stand.

    `function` gives the address of a function of the FMU's library by its name without the prefix.

    Raises ConfigurationError: the library lacks one.
    """

    def __init__(self, function: Callable[[str], int], adapter: Adapter, clocks: Sequence[Clock]) -> None:
        self._state = _EventMode(
            slave=adapter.self,
            enter_event_mode=function("EnterEventMode"),
            update_states=function("UpdateDiscreteStates"),
            enter_step_mode=function("EnterStepMode"),
        )
        self._kept = self._state.clocks.fill(clocks, function)
        library = stepping_library()
        self._start, self.step = library.event_mode_start, library.event_mode_step
        self._start.argtypes = (c_void_p, c_double, c_void_p, c_void_p)
        self.step.argtypes = (c_void_p, c_double, c_double, c_void_p, c_void_p)
        self.self = addressof(self._state)

    def start(self, t0: float, u: Vector, y: Vector) -> int:
        """From event mode after initialisation to step mode at t0 [s]: the status; outputs are put into y."""
        self._u = (c_double * max(len(u), 1))()
        self._state.last_inputs, self._state.inputs = addressof(self._u), len(u)
        return int(self._start(self.self, t0, u.ctypes.data, y.ctypes.data))

    def native(self) -> Native:
        """The step and what it works on."""
        return Native(address(self.step), self.self)

    @property
    def events(self) -> int:
        """How many events were handled since the start, the initial one included."""
        return int(self._state.events)

    def release(self) -> None:
        """Nothing: it holds nothing beside its tables."""
