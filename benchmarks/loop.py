"""A whole run beside a Python loop that makes the same calls through FMPy."""

from __future__ import annotations

import time

from benchmarks.comparison import FMPY_CALLS, check_equal
from benchmarks.inprocess import FmpyCalls
from benchmarks.measure import Measure, side_by_side
from benchmarks.ours import OurLoop
from benchmarks.setups import plant_and_observer
from harness.run import run


def beside_fmpy(steps: int = 10_000, rounds: int = 5) -> Measure:
    """A whole run, start and allocation included, beside FMPy's calls, which have neither in their time.

    Raises RuntimeError: the rows of the two are not equal bit for bit.
    """
    setup = plant_and_observer(1, steps)
    with OurLoop(setup.parts, setup.step, steps) as loop:
        peer = FmpyCalls(setup, loop.rows.shape[1])

        def ours() -> float:
            begin = time.process_time()
            record = run(loop.system)
            elapsed = time.process_time() - begin
            if record.outcome != "ok":
                raise RuntimeError(f"{record.outcome}: {record.message}")
            loop.rows[:, 0], loop.rows[:, 1:] = record.time[1:], record.values[1:]
            return elapsed / steps

        times = side_by_side(ours, peer, rounds)
    check_equal(FMPY_CALLS, loop.rows, peer.rows)
    peer.close()
    return Measure(f"{setup.name}, whole run", *times, FMPY_CALLS, 1 / 10)
