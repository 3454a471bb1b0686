"""Seconds for a working cycle: our cylinder beside one of Cantera's parts, our engine beside the engine's own time."""

from __future__ import annotations

import time

import numpy as np
from numpy.typing import NDArray

from benchmarks.cantera_reactor import network, pressures, seconds_per_cycle
from benchmarks.measure import Measure, side_by_side
from fmus.component import Vector
from fmus.export import cached_fmu
from fmus.fmu import FmuComponent, load_fmu
from fmus.model import Model
from fmus.plants import gas_exchange, single_cylinder
from fmus.units import parse_unit

SPEED = 3200.0  # rpm
CYCLE = 120.0 / SPEED  # s
# Both are as fast as they are with their pressure this near, relative to its peak, to what tight settings give.
NEAR = 1e-3
CANTERA = (1e-5, 4.0)  # relative tolerance, longest step [deg]: the fastest within NEAR of those tried
TIGHT = (1e-8, 0.5)
STEP, TIGHT_STEP = 60e-6, 5e-6  # s, of RK4
TARGET = 0.5  # of the engine's own time


def cylinder_beside_cantera(cycles: int = 20, rounds: int = 5) -> Measure:
    """One cylinder with RK4 at 60 us beside Cantera's at 1e-5 and 4 deg, both within 1e-3 of their tight results.

    Raises RuntimeError: one of them is not.
    """
    p = {signal.name: float(signal.start) for signal in single_cylinder.MODEL.parameters}
    _check("Cantera", *(pressures(network(p, SPEED, *how, cycles=3), 3) for how in (CANTERA, TIGHT)))
    _check("ours", *(_pressures(step, 3) for step in (STEP, TIGHT_STEP)))

    def peer() -> float:
        return seconds_per_cycle(network(p, SPEED, *CANTERA, cycles=cycles), cycles)

    times = side_by_side(lambda: _seconds(single_cylinder.MODEL, STEP, cycles), peer, rounds)
    return Measure("working cycle of one cylinder", *times, "Cantera, its own walls and valves", 1.0)


def engine_beside_itself(cycles: int = 80, rounds: int = 3) -> Measure:
    """`gas_exchange` as it is exported beside the time that the engine itself takes at 3200 rpm."""
    step = gas_exchange.MODEL.solver_step
    times = [_seconds(gas_exchange.MODEL, step, cycles) for _ in range(rounds)]
    return Measure("working cycle of the whole engine", min(times), CYCLE, "the engine itself at 3200 rpm", TARGET)


def _started(model: Model, step: float) -> tuple[FmuComponent, Vector]:
    component = load_fmu(cached_fmu(model), starts={"solver.step": step})
    u = np.array([parse_unit(signal.unit).to_si(float(signal.start)) for signal in model.inputs])
    component.start(0.0, u)
    return component, u


def _seconds(model: Model, step: float, cycles: int) -> float:
    """Processor time for a cycle, with one communication step each."""
    component, u = _started(model, step)
    begin = time.process_time()
    for k in range(cycles):
        component.step(k * CYCLE, CYCLE, u)
    elapsed = time.process_time() - begin
    component.close()
    return elapsed / cycles


def _pressures(step: float, cycles: int, rows: int = 180) -> NDArray[np.float64]:
    component, u = _started(single_cylinder.MODEL, step)
    place, h = [signal.name for signal in component.outputs].index("p"), CYCLE / rows
    found = [component.step(k * h, h, u)[place] for k in range(cycles * rows)]
    component.close()
    return np.array(found)


def _check(whose: str, fast: NDArray[np.float64], tight: NDArray[np.float64]) -> None:
    """Raises RuntimeError: the fast settings are too far from the tight ones for their time to count."""
    apart = float(np.abs(fast - tight).max() / tight.max())
    if not apart < NEAR:
        raise RuntimeError(f"the pressure of {whose} is {apart:.3g} of its peak off, wanted less than {NEAR:g}")
