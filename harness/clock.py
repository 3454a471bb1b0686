"""The instants of a run, evenly spaced in time or in crank angle, and at which of them a part is stepped."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fmus.units import parse_unit
from harness.findings import Findings
from harness.quantity import Measure
from harness.scenario import At, Clock, CrankClock, TimeClock

MOST_STEPS = 100_000_000
# A step this near to a whole number of others, relative to it, is that many.
WHOLE = 1e-6


class TimeGrid(NamedTuple):
    """Instants t_k = start + k step [s], k = 0 ... steps."""

    start: float
    step: float
    steps: int

    @property
    def endless(self) -> bool:
        """Whether a run may end before `steps`."""
        return False


@dataclass(frozen=True)
class CrankGrid:
    """Instants at the crank angles origin + k numerator / denominator [deg], k = 0 ... steps at the most.

    It starts at `start` [s] and ends, before `steps` where that comes first, at the first instant from `stop` [s] on.
    A cycle is `cycle` steps; `tdc` are the firing top dead centres within it of each cylinder 1 ... n [deg], empty
    where no firing order is given. `slowest` [rad/s] is the least speed. `steer` says what is done about an angle that
    is missed: `next` corrects it in the next step, `exact` repeats the step.
    """

    start: float
    steps: int
    stop: float
    numerator: float
    denominator: int
    origin: float
    cycle: int
    tdc: tuple[float, ...]
    slowest: float
    steer: str = "next"

    @property
    def endless(self) -> bool:
        """Whether a run may end before `steps`."""
        return math.isfinite(self.stop)

    @property
    def degrees(self) -> float:
        """A step [deg]."""
        return self.numerator / self.denominator

    def angles(self, instants: NDArray[np.int64]) -> NDArray[np.float64]:
        """The crank angles of some instants [deg]."""
        return self.origin + instants.astype(np.float64) * self.numerator / self.denominator


Grid = TimeGrid | CrankGrid


class Pace(NamedTuple):
    """When a part is stepped: every `period` instants, or at those that `due` marks in a cycle, or on its own grid.

    `own` [s] is the step of a grid in time that a part keeps to on a crank clock; 0 where it follows the clock.
    `step` [s] is what it steps by, 0 where that changes from step to step.
    """

    period: int = 1
    due: bytes = b""
    own: float = 0.0
    step: float = 0.0


def read_clock(clock: Clock, found: Findings) -> Grid:
    """The instants a scenario asks for; what is wrong with them goes to `found`, which speaks of the clock."""
    if clock.time is not None:
        return _time_grid(clock.time, found.at("time"))
    assert clock.crank is not None, "the schema wants one of them"
    return _crank_grid(clock.crank, found.at("crank"))


def _time_grid(clock: TimeClock, found: Findings) -> TimeGrid:
    step, start, stop = (found.at(key).value(getattr(clock, key), "s") for key in ("step", "start", "stop"))
    if not step > 0.0:
        found.at("step").add(f"wants a positive step, got {clock.step}")
        return TimeGrid(start, 1.0, 0)
    if not stop > start:
        found.at("stop").add(f"wants a time after the start, {clock.start}, got {clock.stop}")
        return TimeGrid(start, step, 0)
    return TimeGrid(start, step, _steps((stop - start) / step, clock.step, clock.stop, found))


def _steps(ratio: float, step: object, stop: object, found: Findings) -> int:
    if ratio > MOST_STEPS:
        found.at("step").add(f"wants at most {MOST_STEPS} steps, got {ratio:.9g} of {step}; take a longer step")
        return 0
    steps = math.floor(ratio + WHOLE)
    if steps == 0 and not found.problems:
        found.at("step").add(f"wants at least one step up to {stop}, got {step}")
    return steps


def degrees(measure: Measure, found: Findings) -> float:
    """A crank angle [deg], exactly as written where it is in degrees or turns; 0 and a problem where it is none."""
    radians = found.value(measure, "deg")
    if measure.unit == "deg":
        return measure.value
    return measure.value * 360.0 if measure.unit == "rev" else math.degrees(radians)


def is_angle(measure: Measure) -> bool:
    """Whether a measure is an angle by its unit."""
    return bool(measure.unit) and parse_unit(measure.unit).same_dimension(parse_unit("deg"))


def _crank_grid(clock: CrankClock, found: Findings) -> CrankGrid:
    cycle, origin = degrees(clock.cycle, found.at("cycle")), degrees(clock.origin, found.at("origin"))
    start, slowest = found.at("start").value(clock.start, "s"), found.at("slowest").value(clock.slowest, "rpm")
    if not cycle > 0.0:
        found.at("cycle").add(f"wants a crank angle above 0 deg, got {clock.cycle}")
        cycle = 720.0
    if not slowest > 0.0:
        found.at("slowest").add(f"wants a speed above 0 rpm, got {clock.slowest}")
    if clock.per_cycle is not None:
        numerator, denominator, steps_a_cycle = cycle, clock.per_cycle, clock.per_cycle
    else:
        assert clock.step is not None, "the schema wants one of them"
        numerator, denominator = degrees(clock.step, found.at("step")), 1
        if not numerator > 0.0:
            found.at("step").add(f"wants a crank angle above 0 deg, got {clock.step}")
            numerator = cycle
        ratio = cycle / numerator
        steps_a_cycle = max(1, round(ratio))
        if abs(ratio - steps_a_cycle) > WHOLE:
            near = " or ".join(
                f"{cycle / count:.9g} deg" for count in sorted({math.ceil(ratio), math.floor(ratio) or 1})
            )
            found.at("step").add(f"wants to divide the cycle of {cycle:g} deg, got {clock.step}; near are {near}")
    stop, most = math.inf, MOST_STEPS
    given = clock.step or f"a cycle in {clock.per_cycle} steps"
    if is_angle(clock.stop):
        last = degrees(clock.stop, found.at("stop"))
        if not last > origin:
            found.at("stop").add(f"wants an angle after the origin, {clock.origin}, got {clock.stop}")
        else:
            most = _steps((last - origin) * denominator / numerator, given, clock.stop, found)
    else:
        stop = found.at("stop").value(clock.stop, "s")
        if not stop > start and not found.problems:
            found.at("stop").add(f"wants a time after the start, {clock.start}, or a crank angle, got {clock.stop}")
    tdc = read_tdc(clock.firing_order, clock.tdc, cycle, found)
    return CrankGrid(start, most, stop, numerator, denominator, origin, steps_a_cycle, tdc, slowest, clock.steer)


def read_tdc(order: Sequence[int], given: Sequence[Measure], cycle: float, found: Findings) -> tuple[float, ...]:
    """The firing top dead centre of each cylinder 1 ... n within a cycle [deg]; none without a firing order."""
    if sorted(order) != list(range(1, len(order) + 1)):
        found.at("firing_order").add(f"wants each cylinder 1 ... {len(order)} once, got {order}")
        return ()
    if given and len(given) != len(order):
        found.at("tdc").add(f"wants one angle a cylinder of the firing order, {len(order)}, got {len(given)}")
        return ()
    if given:
        centres = [degrees(one, found.at("tdc", index)) for index, one in enumerate(given)]
        for index, centre in enumerate(centres):
            if not 0.0 <= centre < cycle or centre <= max(centres[:index], default=-1.0):
                found.at("tdc", index).add(
                    f"wants angles from 0 deg to the cycle's {cycle:g} deg, ascending as they fire"
                )
                return ()
    else:
        centres = [cycle * index / len(order) for index in range(len(order))]
    by_cylinder = dict(zip(order, centres, strict=True))
    return tuple(by_cylinder[cylinder] for cylinder in sorted(by_cylinder))


def read_pace(every: Measure | None, at: At, grid: Grid, found: Findings) -> Pace:
    """When a part is stepped, by its `every` and `at`; problems go to `found`, which speaks of the part."""
    if every is not None and at is not None:
        found.at("at").add("wants to stand without `every`: a part is stepped either by events or by a period")
        return Pace()
    if isinstance(grid, TimeGrid):
        if at is not None:
            found.at("at").add("wants a crank clock: the clock of this campaign is in time")
        return _multiple(every, grid, found.at("every"))
    if at is not None:
        return Pace(due=_due(at, grid, found.at("at")))
    if every is None:
        return Pace()
    if is_angle(every):
        period = _whole(degrees(every, found.at("every")) / grid.degrees)
        if period is None:
            step = f"{grid.degrees:.9g} deg"
            found.at("every").add(f"wants a multiple of the clock's step, {step}, got {every}")
        return Pace(period or 1)
    own = found.at("every").value(every, "s")
    if not own > 0.0 and not found.problems:
        found.at("every").add(f"wants a crank angle, or a time above 0 s, got {every}")
    return Pace(own=own, step=own)


def _whole(ratio: float) -> int | None:
    count = round(min(ratio, float(MOST_STEPS)))
    return count if count >= 1 and abs(ratio - count) <= WHOLE * count else None


def _multiple(every: Measure | None, grid: TimeGrid, found: Findings) -> Pace:
    if every is None:
        return Pace(step=grid.step)
    ratio = found.value(every, "s") / grid.step
    period = _whole(ratio)
    if period is None:
        ratio = min(ratio, float(MOST_STEPS))
        near = sorted({max(1, math.floor(ratio)), max(1, math.ceil(ratio))})
        nearest = " or ".join(f"{count * grid.step:.9g} s" for count in near)
        found.add(f"wants a multiple of the clock's step, {grid.step:.9g} s, got {every}; near are {nearest}")
        return Pace(step=grid.step)
    return Pace(period, step=period * grid.step)


def _due(at: At, grid: CrankGrid, found: Findings) -> bytes:
    """Which instants k of a cycle, by k modulo the cycle, lie at the events."""
    if at == "tdc":
        if not grid.tdc:
            found.add("wants the clock to have a firing_order: where top dead centres are follows from it")
        angles = list(grid.tdc)
    elif at == "cycle" or at is None:
        angles = [0.0]
    else:
        angles = [degrees(one, found.at(index)) for index, one in enumerate(at)]
    marks = bytearray(grid.cycle)
    for angle in angles:
        instant = (angle - grid.origin) / grid.degrees
        nearest = round(instant)
        if abs(instant - nearest) > WHOLE * max(1.0, abs(instant)):
            where = f"{grid.origin:g} deg + a multiple of the clock's step, {grid.degrees:.9g} deg"
            found.add(f"wants events at instants of the clock, at {where}, got {angle:g} deg")
            break
        marks[nearest % grid.cycle] = 1
    if not angles and at != "tdc":
        found.add("wants at least one angle")
    return bytes(marks)
