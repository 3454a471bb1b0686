"""What can be measured, by name, each in a process of its own."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor

from benchmarks import growth
from benchmarks.comparison import Comparison, beside_all, beside_bare_c
from benchmarks.exported import beside_handwritten_c, beside_pythonfmu
from benchmarks.growth import Growth, with_parts, with_signals, with_steps
from benchmarks.long_run import STEPS as LONG
from benchmarks.long_run import LongRun, long_run, measures_memory
from benchmarks.loop import beside_fmpy
from benchmarks.measure import Measure
from benchmarks.optimal import SearchGrowth, beside_every_set, growing
from benchmarks.periodic import Costs, beside_numpy
from benchmarks.real_time import RealTime, beside_the_engine
from benchmarks.selection import beside_dense_svd, on_networks
from benchmarks.setup_time import beside_simulate_fmu
from benchmarks.setups import feedthroughs, oscillator, plant_and_observer
from benchmarks.working_cycle import cylinder_beside_cantera, engine_beside_itself

Taken = list[Measure] | Comparison | Costs | Growth | SearchGrowth | LongRun | RealTime


def sections(scale: int) -> dict[str, Callable[[], Taken]]:
    """The measures that this system allows, in their order; the `scale`-th part of rounds and of the longest runs."""

    def rounds(full: int) -> int:
        return max(1, full // scale)

    known: dict[str, Callable[[], Taken]] = {
        "export": lambda: [beside_handwritten_c(rounds=rounds(100)), beside_pythonfmu(rounds=rounds(20))],
        "set-up": lambda: [beside_simulate_fmu(rounds=rounds(30))],
        "light": lambda: [
            beside_bare_c(plant_and_observer(1, 20_000), 1.15, rounds(100)),
            beside_fmpy(rounds=rounds(5)),
        ],
        "plant-and-observer": lambda: beside_all(plant_and_observer(8, 10_000), 1.05, rounds(20)),
        "van-der-pol": lambda: beside_all(oscillator(10_000), 2.5, rounds(20)),
        "two-feedthrough": lambda: beside_all(feedthroughs(10_000), 2.5, rounds(20)),
        "parts": lambda: with_parts(rounds=rounds(40)),
        "signals": lambda: with_signals(rounds=rounds(40)),
        "steps": lambda: with_steps(growth.STEPS if scale == 1 else growth.STEPS[:-1], rounds(3)),
        "working-cycle": lambda: [cylinder_beside_cantera(rounds=rounds(5)), engine_beside_itself(rounds=rounds(3))],
        "best-sets": lambda: beside_every_set(rounds(3)),
        "best-sets-growth": growing,
        "selection": lambda: [*beside_dense_svd(rounds(10)), *on_networks()],
        "periodic": lambda: beside_numpy(rounds(20)),
        "imbalance": lambda: beside_the_engine(rounds=rounds(10)),
    }
    if measures_memory():
        known["long-run"] = lambda: long_run(LONG // scale)
    return known


def take(name: str, scale: int) -> Taken:
    """One section, here and now. Raises RuntimeError: the results of a peer are not ours."""
    return sections(scale)[name]()


def take_apart(name: str, scale: int) -> Taken:
    """One section in a fresh process: what was measured before, and left in memory, moves a loop by some per cent.

    NumPy and SciPy work with one thread there: processor time counts those that wait for each other, too.
    """
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        return pool.submit(take, name, scale).result()


def measures_of(taken: Taken) -> list[Measure]:
    """The measures in what a section gave."""
    if isinstance(taken, (Comparison, Costs, RealTime)):
        return taken.measures
    if isinstance(taken, SearchGrowth):
        return taken.measures()
    return taken if isinstance(taken, list) else [taken.measure()]
