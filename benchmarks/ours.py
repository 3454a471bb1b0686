"""The platform's step loop under the clock: a scenario wired once, started anew and timed at each call."""

from __future__ import annotations

import ctypes
import time
from collections.abc import Mapping, Sequence
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from harness.run import StartedSystem
from harness.scenario import Scenario
from harness.wiring import System, wire


class Native(ctypes.Structure):
    """A step function for C and what it works on, as bare.c takes them."""

    _fields_ = [(name, ctypes.c_void_p) for name in ("step", "self")]


class OurLoop:
    """Parts wired by the platform; each call returns the seconds that one step took.

    All signals are recorded, but where `record` names some. `rows` are those of the last call, one for each step: time
    and signals in SI. They are allocated once.
    """

    def __init__(self, parts: Mapping[str, Any], step: float, steps: int, record: Sequence[str] = ()) -> None:
        clock = {"time": {"step": f"{step!r} s", "stop": f"{steps * step!r} s"}}
        kept = {"record": list(record)} if record else {}
        self.system: System = wire(Scenario.model_validate({"clock": clock, "parts": parts, **kept}))
        self.signals = [self.system.bus[place].name for place in self.system.recorded]
        self.rows = np.zeros((steps, 1 + len(self.signals)))

    def __call__(self) -> float:
        """From the first instant to the last, parts started and rows allocated before."""
        return seconds_a_step(StartedSystem(self.system), self.rows)

    def natives(self, names: Sequence[str]) -> Any:
        """The step functions of these parts, started anew, as an array for bare.c."""
        StartedSystem(self.system)
        steps_of = {slot.name: slot.component.native() for slot in self.system.parts}
        return (Native * len(names))(*(Native(*(steps_of[name] or ())) for name in names))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.system.close()


def seconds_a_step(started: StartedSystem, rows: NDArray[np.float64]) -> float:
    """The seconds of processor time that a step took, of as many from the start as there are rows, which are filled.

    Raises RuntimeError: the loop ended before.
    """
    begin = time.process_time()
    reached = started.advance(0, len(rows), rows)
    elapsed = time.process_time() - begin
    if reached != len(rows):
        raise RuntimeError(f"the loop ended at instant {reached}: {started.failure}")
    return elapsed / len(rows)
