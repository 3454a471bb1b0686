"""A case of the campaign imbalance, from the fuel to the verdicts, beside the time that the engine itself takes."""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks.measure import Measure
from benchmarks.ours import seconds_a_step
from harness.campaign import find_campaign
from harness.places import read_yaml_file
from harness.run import StartedSystem
from harness.scenario import Scenario
from harness.wiring import wire

DEGREES = 6.0
SPEEDS = (800, 1500, 3000, 6000)  # rpm
CYCLES = 100
CYLINDER = 3
ENGINE = "the engine itself"
# A case is wanted to take at most so much of the time that the engine takes.
WANTED = 1.0


class RealTime(NamedTuple):
    """Measures of a step of 6 deg, our time beside the engine's, by speed [rpm].

    `shares` are those of groups of parts in the time of all parts, at the highest speed.
    """

    speeds: tuple[int, ...]
    measures: list[Measure]
    shares: Mapping[str, float]


def beside_the_engine(speeds: Sequence[int] = SPEEDS, cycles: int = CYCLES, rounds: int = 10) -> RealTime:
    """All parts of the campaign's file, everything recorded into memory, cylinder 3 with a quarter more fuel.

    Raises RuntimeError: a case does not keep its speed, or its observer is no nearer to the truth than the sensor.
    """
    measures, shares = [], {}
    for speed in speeds:
        with wire(Scenario.model_validate(_scenario(speed, cycles))) as system:
            names = [system.bus[place].name for place in system.recorded]
            rows = np.zeros((cycles * round(720.0 / DEGREES), 1 + len(names)))
            times = []
            for _ in range(rounds):
                started = StartedSystem(system)
                times.append(seconds_a_step(started, rows))
            _check(speed, rows, names)
            shares = _shares(started.wall(len(rows)))
        engine = math.radians(DEGREES) / _rad_per_s(speed)
        measures.append(Measure(f"imbalance at {speed} rpm, a step of 6 deg", min(times), engine, ENGINE, WANTED))
    return RealTime(tuple(speeds), measures, shares)


def _rad_per_s(speed: float) -> float:
    return speed * math.pi / 30.0


def _scenario(speed: int, cycles: int) -> dict[str, Any]:
    document = read_yaml_file(find_campaign("imbalance"))[0]
    parts = copy.deepcopy(document["parts"])
    parts["speed"]["constant"] = parts["engine"]["with"]["omega_e"] = f"{speed} rpm"
    parts["fault"]["with"] = {"begin": "0 deg", "cylinder": CYLINDER, "amount": 0.25}
    crank = {**document["clock"]["crank"], "step": f"{DEGREES} deg", "stop": f"{2 * cycles} rev"}
    return {"clock": {"crank": crank}, "seed": document["seed"], "parts": parts}


def _shares(wall: Mapping[str, float]) -> dict[str, float]:
    """The shares of the engine, the exhaust and all other parts in their time."""
    groups = {"engine": wall["engine"], "exhaust": wall["exhaust"]}
    groups["observers, diagnoses and the rest"] = sum(wall.values()) - sum(groups.values())
    return {name: seconds / sum(groups.values()) for name, seconds in groups.items()}


def _check(speed: int, rows: NDArray[np.float64], names: Sequence[str]) -> None:
    took = rows[-1, 0] - rows[0, 0]
    wanted = (len(rows) - 1) * math.radians(DEGREES) / _rad_per_s(speed)
    if not abs(took / wanted - 1.0) < 0.02:
        raise RuntimeError(f"{len(rows) - 1} steps at {speed} rpm want {wanted:.4g} s of the engine, got {took:.4g} s")
    last = {name: rows[-120:, 1 + place] for place, name in enumerate(names)}
    truth = last["exhaust.afr_turbine"]
    rebuilt, shown = (float(np.std(last[name] - truth)) for name in ("designed.w", "uego.value"))
    if not rebuilt < 0.2 * shown:
        told = f"at {speed} rpm w wants to be five times as near to the truth as the sensor, {shown:.3g} off"
        raise RuntimeError(f"{told}; got {rebuilt:.3g}")
