"""Measure of the set-up of an FMU that was unpacked before: until it could make its first step, beside FMPy's."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
from fmpy import simulate_fmu

from benchmarks.exported import STEP
from benchmarks.measure import Measure, side_by_side
from fmus import description
from fmus.export import cached_fmu
from fmus.fmu import load_fmu
from fmus.plants.driveline import MODEL


def beside_simulate_fmu(rounds: int = 30) -> Measure:
    """From the path of the driveline's FMU to an initialised instance, as the first in its process.

    What this process remembers of the FMU is forgotten before each round; what is on disk is not. The peer is FMPy's
    `simulate_fmu` with its own settings, given the same file, up to the end of its first step, of which the FMU's own
    share is some microseconds.
    """
    path = cached_fmu(MODEL)
    least = side_by_side(lambda: _ours(path), lambda: _peer(path), rounds)
    return Measure("set-up of an unpacked FMU", *least, "simulate_fmu", 0.5)


def _ours(path: Path) -> float:
    description.forget()
    begin = time.perf_counter()
    component = load_fmu(path)
    component.start(0.0, np.array([float(signal.start) for signal in component.inputs]))
    took = time.perf_counter() - begin
    component.close()
    return took


def _peer(path: Path) -> float:
    ends: list[float] = []

    def stop(*_: Any) -> bool:
        ends.append(time.perf_counter())
        return False

    begin = time.perf_counter()
    simulate_fmu(str(path), stop_time=2 * STEP, step_size=STEP, output_interval=STEP, step_finished=stop)
    return ends[0] - begin
