"""How the time of a run grows with the number of its parts, signals and steps, beside the bare C loop's."""

from __future__ import annotations

import ctypes
import time
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from benchmarks.comparison import BARE, check_equal
from benchmarks.direct import DirectFmu, Fmu
from benchmarks.inprocess import BareLoop, bare_library
from benchmarks.measure import Measure, in_turn
from benchmarks.ours import OurLoop
from benchmarks.setups import oscillator
from fmus.component import Signal
from fmus.export import cached_fmu
from fmus.model import Model

STEP = 1e-3  # s
SOURCE = {"use": "source", "unit": "1", "step": {"at": "0.0105 s", "from": "0", "to": "1"}}
PARTS = (1, 2, 4, 8, 16, 32, 64)
SIGNALS = (1, 3, 10, 32, 100, 316, 1000)
STEPS = (10_000, 100_000, 1_000_000, 10_000_000)


class Line(NamedTuple):
    """The line through points by least squares: y = at_zero + slope x; `r_squared` the share of the variance it has."""

    slope: float
    at_zero: float
    r_squared: float


class Growth(NamedTuple):
    """Seconds against a number of things: of one step, or of a whole run where the things are its steps."""

    things: str
    counts: tuple[int, ...]
    ours: tuple[float, ...]
    bare: tuple[float, ...]

    def measure(self) -> Measure:
        """The slopes: seconds that one thing more costs, a step."""
        slopes = (line(self.counts, self.ours).slope, line(self.counts, self.bare).slope)
        return Measure(f"growth with {self.things}, slope", *slopes, BARE)


def line(x: Sequence[float], y: Sequence[float]) -> Line:
    """The line through (x, y) by least squares."""
    slope, at_zero = (float(value) for value in np.polyfit(x, y, 1))
    left = np.asarray(y) - (at_zero + slope * np.asarray(x))
    return Line(slope, at_zero, float(1.0 - left.var() / np.var(y)))


def with_parts(counts: Sequence[int] = PARTS, steps: int = 2_000, rounds: int = 40) -> Growth:
    """The time of a step against the number of FMUs in a chain, each a first-order lag of the one before."""
    model = _lag(1)
    times = [_chain(model, count, steps, rounds) for count in counts]
    return Growth("parts", tuple(counts), *zip(*times, strict=True))


def with_signals(counts: Sequence[int] = SIGNALS, steps: int = 2_000, rounds: int = 40) -> Growth:
    """The time of a step against the number of outputs of one FMU, all recorded: a lag, and multiples of its state."""
    times = [_chain(_lag(count), 1, steps, rounds) for count in counts]
    return Growth("signals", tuple(counts), *zip(*times, strict=True))


def with_steps(counts: Sequence[int] = STEPS, rounds: int = 3) -> Growth:
    """The time of a run against the number of its steps: Van der Pol's oscillator, recorded into memory."""
    times = []
    for count in counts:
        setup = oscillator(count)
        with OurLoop(setup.parts, setup.step, setup.steps) as ours:
            bare = BareLoop(setup, ours)
            times.append(
                [least * count for least in in_turn((ours, bare), rounds * max(1, min(20, 1_000_000 // count)))]
            )
            check_equal(BARE, ours.rows, bare.rows)
            bare.close()
    return Growth("steps", tuple(counts), *zip(*times, strict=True))


def _lag(outputs: int) -> Model:
    """x' = (u - x) / T with the outputs x, 2 x, 3 x, ..."""
    multiples = np.arange(1.0, outputs + 1.0)
    return Model(
        name=f"lag_{outputs}",
        description="A first-order lag and multiples of its state",
        equations=lambda t, x, m, u, p: ({"x": (u.u - x.x) / p.T}, {"y": x.x * multiples}),
        inputs=(Signal("u", "1"),),
        states=(Signal("x", "1", local=True),),
        outputs=(Signal("y", "1", shape=(outputs,)),),
        parameters=(Signal("T", "s", 0.1),),
    )


def _chain(model: Model, count: int, steps: int, rounds: int) -> list[float]:
    """Seconds that a step takes, ours and the bare loop's. Raises RuntimeError: their rows are not equal."""
    path = cached_fmu(model)
    parts: dict[str, Any] = {"source": SOURCE}
    for number in range(count):
        before = f"part{number - 1}.y[1]" if number else "source"
        parts[f"part{number}"] = {"use": str(path), "wires": {"u": before}}
    size = model.outputs[0].size
    fmus = [DirectFmu(path, ("u",), [f"y[{i + 1}]" for i in range(size)]) for _ in range(count)]
    run = bare_library().run_chain
    with OurLoop(parts, STEP, steps) as ours:
        rows = np.zeros_like(ours.rows)

        def bare() -> float:
            tables = (Fmu * count)(*(fmu.start().for_c() for fmu in fmus))
            source = ours.natives(("source",))
            numbers = (ctypes.c_int64(steps), ctypes.c_double(STEP), ctypes.c_void_p(rows.ctypes.data))
            begin = time.process_time()
            status = run(tables, ctypes.c_int64(count), source, *numbers)
            elapsed = time.process_time() - begin
            if status:
                raise RuntimeError(f"the bare loop ended in the status {status}")
            return elapsed / steps

        least = in_turn((ours, bare), rounds)
        check_equal(BARE, ours.rows, rows)
    for fmu in fmus:
        fmu.close()
    return least
