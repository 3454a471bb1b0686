"""Faults of a sensor or a wire: when they act, and the signal that tells so. The arithmetic is in fault.c and sensor.c.

A fault acts on the samples of the times from <= t < to, as measured to a millionth of the sample time (on a crank clock
to a nanosecond), or on a crank clock on those of the crank angles from <= angle < to. A reading belongs to the instant
of its row; what a source gives in row k belongs to the instant k-1 from which it is held, so that a fault on a source's
wire acts from the row after, as a step of the source does. The fault signal of a sample is the code of the first fault
listed that acts on it, 0 where none does.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Sequence
from typing import Literal, NamedTuple

from fmus.component import Component, Signal
from fmus.units import parse_unit
from harness.clock import CrankGrid, Grid, Pace, degrees, is_angle
from harness.findings import Findings
from harness.scenario import FAULTS, Fault, Measure

FAULT_SIGNAL = "fault"
EVERY_SAMPLE = 2**63 - 1
# How near a time or an angle is to a sample to be at it, in samples.
EDGE = 1e-6
MOST_DELAYED_SAMPLES = 10_000_000
# The instant that a sample belongs to: the end of a step, or its beginning where it is held from there, as a source's.
Timed = Literal["end", "begin"]


class Window(NamedTuple):
    """When a fault acts: start <= t < until [s], and first <= sample < last."""

    start: float = -math.inf
    until: float = math.inf
    first: int = 0
    last: int = EVERY_SAMPLE

    def holds(self, time: float, edge: float, sample: int) -> bool:
        """Whether a sample that belongs to a time is inside; times nearer to an end than `edge` [s] are at it."""
        return self.start - edge <= time < self.until - edge and self.first <= sample < self.last


class ActingFault(NamedTuple):
    """A fault of one kind, one of FAULTS, in its window; the value in SI, of a delay in samples."""

    kind: str
    value: float
    window: Window
    code: int = 1
    meaning: str = ""


class Sampling(NamedTuple):
    """When a part takes its samples 0, 1, 2 ...: at the start, and at the instants of the clock it is stepped to."""

    grid: Grid
    pace: Pace

    def at(self, angle: float) -> int:
        """The first sample at or after an angle [deg] of a crank clock; one within a millionth of a step is at it."""
        grid, pace = self.grid, self.pace
        assert isinstance(grid, CrankGrid), "angles are of crank clocks"
        instant = math.ceil((angle - grid.origin) * grid.denominator / grid.numerator - EDGE)
        if instant <= 0:
            return 0
        if not pace.due:
            return 1 + (instant - 1) // pace.period
        cycles, rest = divmod(instant - 1, grid.cycle)  # the instants 1 ... instant - 1, of which 0 is no step
        return 1 + cycles * sum(pace.due) + sum(pace.due[1 : rest + 1])

    def shortest(self, speed: float) -> float:
        """The time between two samples [s]; on a crank clock at a speed [rad/s], the shortest there may be."""
        if not isinstance(self.grid, CrankGrid):
            return self.pace.step
        return (1 if self.pace.due else self.pace.period) * math.radians(self.grid.degrees) / speed

    def late(self, delay: Measure, found: Findings) -> float:
        """A delay in samples; 0 and a problem where it is none of so many samples."""
        if not isinstance(self.grid, CrankGrid):
            return found.value(delay, "s") / self.pace.step
        if not is_angle(delay):
            found.add(f"wants a crank angle, since samples of a crank clock are no fixed time apart, got {delay}")
        elif self.pace.due:
            found.add("wants a part that samples evenly, by `every` and not by `at`")
        else:
            return degrees(delay, found) / (self.pace.period * self.grid.degrees)
        return 0.0


class CWindow(ctypes.Structure):
    """`Window` of fault.c."""

    _fields_ = [
        *((name, ctypes.c_double) for name in ("start", "until")),
        *((name, ctypes.c_int64) for name in ("first", "last")),
    ]


class CFault(ctypes.Structure):
    """`Fault` of fault.c, its state included."""

    _fields_ = [
        *((name, ctypes.c_int64) for name in ("kind", "code")),
        ("value", ctypes.c_double),
        ("window", CWindow),
        ("acted", ctypes.c_int64),
        ("begin", ctypes.c_double),
        ("kept_acted", ctypes.c_int64),
    ]


def c_faults(faults: Sequence[ActingFault]) -> ctypes.Array[CFault]:
    """The faults for C, at least one place long, not acting yet."""
    table = (CFault(FAULTS.index(f.kind), f.code, f.value, CWindow(*f.window)) for f in faults)
    return (CFault * max(len(faults), 1))(*table)


def edge(period: float) -> float:
    """How near a time [s] is to an end of a window to be at it; `period` [s] is that of the samples, 0 if it varies."""
    return EDGE * (period or 1e-3)


def fault_signal(meanings: Sequence[tuple[int, str]]) -> Signal:
    """The signal that tells which fault acts; its description says what each code means, and reports read it there."""
    by_code: dict[int, list[str]] = {}
    for code, meaning in meanings:
        by_code.setdefault(code, []).append(meaning)
    told = [f"{code}: {' or '.join(means)}" for code, means in by_code.items()]
    return Signal(FAULT_SIGNAL, description="; ".join(["the fault that acts", *told]), kind="integer")


def tells_faults(component: Component, output: str) -> bool:
    """Whether an output is a fault signal: the truth about what is wrong, which metrics read and no part does."""
    return output == FAULT_SIGNAL and bool(getattr(component, "tells_faults", False))


def timed(component: Component) -> Timed:
    """The instant of a step that the outputs of a component belong to."""
    found: Timed = getattr(component, "timed", "end")
    return found


def read_window(start: Measure, until: Measure | None, sampling: Sampling, found: Findings) -> Window:
    """The window between two ends as written, each a time or a crank angle; what is wrong with them goes to `found`."""
    begin, first = _read_end(start, sampling, found.at("from"))
    window = Window(-math.inf if begin is None else begin, first=0 if first is None else first)
    if until is None:
        return window
    end, last = _read_end(until, sampling, found.at("to"))
    if is_angle(start) == is_angle(until) and _si(until) <= _si(start):
        found.at("to").add(f"wants {'an angle' if is_angle(start) else 'a time'} after {start}, got {until}")
    return window._replace(until=math.inf if end is None else end, last=EVERY_SAMPLE if last is None else last)


def read_faults(faults: Sequence[Fault], unit: str, sampling: Sampling, found: Findings) -> tuple[ActingFault, ...]:
    """The faults of a signal of this unit as written; what is wrong with them goes to `found`."""
    acting: list[ActingFault] = []
    for place, fault in enumerate(faults):
        one = _read_fault(fault, place, unit, sampling, found.at(place))
        if one.kind == "delay" and latest([*acting, one]) > MOST_DELAYED_SAMPLES:
            told = f"wants at most {MOST_DELAYED_SAMPLES} samples in all, got {fault.delay}"
            found.at(place, "delay").add(told)
        else:
            acting.append(one)
    return tuple(acting)


def latest(faults: Sequence[ActingFault]) -> float:
    """The most samples that faults delay a signal by."""
    return sum(fault.value for fault in faults if fault.kind == "delay")


def _read_fault(fault: Fault, place: int, unit: str, sampling: Sampling, found: Findings) -> ActingFault:
    kind = fault.kind
    given = getattr(fault, kind)
    window = read_window(fault.start, fault.until, sampling, found)
    here = found.at(kind)
    if kind in ("bias", "drift", "noise"):
        value = here.difference(given, unit)
    elif kind == "delay":
        value = sampling.late(given, here)
    else:
        value = float(given)
    if kind in ("noise", "delay") and value < 0.0:
        here.add(f"wants 0 or more, got {given}")
        value = 0.0
    if kind == "drop_out" and not 0.0 <= value <= 1.0:
        here.add(f"wants a probability between 0 and 1, got {given:g}")
    return ActingFault(kind, value, window, fault.code or place + 1, kind if given is True else f"{kind} {given}")


def _read_end(measure: Measure, sampling: Sampling, found: Findings) -> tuple[float | None, int | None]:
    """The time [s], or the sample, that an end of a window is at; None for the other."""
    if not is_angle(measure):
        return found.value(measure, "s"), None
    if not isinstance(sampling.grid, CrankGrid):
        found.add(f"wants a time, got {measure}: a crank angle is for a crank clock")
        return None, None
    return None, sampling.at(degrees(measure, found))


def _si(measure: Measure) -> float:
    return parse_unit(measure.unit).to_si(measure.value)
