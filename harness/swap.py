"""Swapped wires: two signals that change places for what reads them while a window is open."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import replace

from fmus.component import Native, Reversal, Role, Signal, StepError, Vector
from fmus.units import parse_unit
from harness.faults import CWindow, Sampling, Timed, Window, edge, fault_signal, read_window, timed
from harness.findings import Findings
from harness.native import call, native_reversal, native_step
from harness.onwire import Given
from harness.scenario import SwapPart


class _Swap(ctypes.Structure):
    _fields_ = [
        ("window", CWindow),
        ("edge", ctypes.c_double),
        *((name, ctypes.c_int64) for name in ("early", "code", "sample", "kept_sample")),
    ]


class SwapComponent:
    """Passes two signals on as `first` and `second`, crossed while the window is open; `fault` is the code then."""

    tells_faults = True

    def __init__(self, pair: Sequence[Given], window: Window, period: float, code: int = 1) -> None:
        first, second = pair
        roles = {one.source.role for one in pair}
        self.window, self.period, self.code = window, period, code
        # What the truth may pass through is the truth.
        self.role: Role = "plant" if "plant" in roles else first.source.role if len(roles) == 1 else "controller"
        self.timed: Timed = "begin" if all(timed(one.source) == "begin" for one in pair) else "end"
        kind = first.signal.kind if first.signal.kind == second.signal.kind else "real"
        names = zip(("first", "second"), pair, strict=True)
        self.inputs: Sequence[Signal] = tuple(replace(one.signal, name=name) for name, one in names)
        passed = (replace(signal, kind=kind) for signal in self.inputs)
        self.outputs: Sequence[Signal] = (
            *passed,
            fault_signal([(code, f"{first.name} and {second.name} swapped")]),
        )
        ends = ("first", "second")
        self.feedthrough = frozenset((output, given) for output in ends for given in ends)
        self._state: _Swap | None = None

    def start(self, t0: float, u: Vector) -> Vector:
        """What the readers of the two signals u are given at t0 [s], and whether they are swapped, shape (3,)."""
        early = self.timed == "begin"
        self._state = _Swap(CWindow(*self.window), edge(self.period), early, self.code)
        return call("crankbench_swap_start", self._state, t0, u=u, outputs=3)[1]

    def step(self, t: float, h: float, u: Vector) -> Vector:
        """The same at t + h [s]."""
        return call("crankbench_swap_step", self._started(), t, h, u=u, outputs=3)[1]

    def native(self) -> Native:
        """The step in C."""
        return native_step("crankbench_swap_step", self._started())

    def reversal(self) -> Reversal:
        """Keeping and going back in C."""
        return native_reversal("crankbench_swap_keep", "crankbench_swap_restore", self._started())

    def close(self) -> None:
        """Forget the state: it wants a start before the next step."""
        self._state = None

    def _started(self) -> _Swap:
        if self._state is None:
            raise StepError("the swap wants a start before it is stepped")
        return self._state


def build_swap(spec: SwapPart, pair: Sequence[Given], sampling: Sampling, found: Findings) -> SwapComponent:
    """The swap a scenario describes; what is wrong with it goes to `found`."""
    window = read_window(spec.start, spec.until, sampling, found)
    first, second = pair
    if not parse_unit(first.signal.unit).same_dimension(parse_unit(second.signal.unit)):
        units = " and ".join(f"{one.signal.unit or 'no unit'} from {one.name}" for one in pair)
        found.at("between").add(f"wants two signals of one dimension, got {units}")
    if first.name == second.name:
        found.at("between").add(f"wants two signals, got {first.name} twice")
    for one in pair:
        if isinstance(one.source, SwapComponent):
            told = f"wants the signals themselves, got {one.name} of a swap; a signal may be in several swaps"
            found.at("between").add(told)
    return SwapComponent(pair, window, sampling.pace.step, spec.code)
