"""What a figure is drawn over: time, crank angle, engine cycles or one cycle, and where cylinders fire along it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

from reports.declared import crank_clock, degrees, part_of
from reports.folder import Case, Run

CYCLE = 720.0  # deg, where nothing says otherwise
# More firings than this are not marked: the lines would hide what is drawn.
MOST_MARKS = 40


class Engine(NamedTuple):
    """The crank angle of a cycle, and of the firing top dead centre of each cylinder within it [deg]."""

    cycle: float
    firings: Mapping[int, float]


@dataclass(frozen=True)
class Axis:
    """The horizontal axis of a figure: marks are (where, name); `reach` and `ticks` where they are given."""

    label: str = "time [s]"
    unit: str = "s"
    marks: tuple[tuple[float, str], ...] = ()
    reach: tuple[float, float] | None = None
    ticks: tuple[float, ...] = ()


TIME = Axis()


def engine_of(run: Run, case: Case, angle: str, cycle: Any = None) -> Engine:
    """The engine as the crank clock declares it, or on a clock of time the crank part that gives the signal `angle`.

    `cycle`, as written, stands where neither says how long a cycle is.
    """
    part = part_of(run, case, angle.partition(".")[0])
    told = crank_clock(run, case) or (part if part.get("use") == "crank" else {})
    length = degrees(told.get("cycle")) or degrees(cycle) or CYCLE
    order = [int(cylinder) for cylinder in told.get("firing_order") or ()]
    given = [degrees(at) for at in told.get("tdc") or ()]
    at = given if len(given) == len(order) else [index * length / len(order) for index in range(len(order))]
    return Engine(length, {name: angle for name, angle in zip(order, at, strict=True) if angle is not None})


def axis_over(over: str, engine: Engine, first: float, last: float) -> Axis:
    """The axis over `time`, `crank`, `cycles` or a `cycle`; the rows are from one crank angle to the other [deg]."""
    if over == "crank":
        return Axis("crank angle [deg]", "deg", _firings(engine, first, last, 1.0))
    if over == "cycles":
        return Axis(f"engine cycles of {engine.cycle:g} deg", "cycles", _firings(engine, first, last, engine.cycle))
    if over == "cycle":
        marks = tuple(sorted((at, str(name)) for name, at in engine.firings.items()))
        ticks = tuple(engine.cycle * eighth / 8 for eighth in range(9))
        return Axis("crank angle in the cycle [deg]", "deg", marks, (0.0, engine.cycle), ticks)
    return TIME


def _firings(engine: Engine, first: float, last: float, unit: float) -> tuple[tuple[float, str], ...]:
    """Every firing between two crank angles [deg]; none where they are many."""
    if (last - first) / engine.cycle * len(engine.firings) > MOST_MARKS:
        return ()
    cycles = range(math.floor(first / engine.cycle), math.floor(last / engine.cycle) + 1)
    marks = [(cycle * engine.cycle + at, str(name)) for cycle in cycles for name, at in engine.firings.items()]
    return tuple(sorted((at / unit, name) for at, name in marks if first <= at <= last))
