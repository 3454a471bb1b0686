"""The trade of error against the number of sensors: the semidefinite program over alpha, and the sets it chooses."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from selection.estimation import Estimation, EstimationError
from selection.h2 import Program, Relaxed, SdpError, Solution, refit, reweighted, scaling
from selection.methods import Scaling

# alpha/(1 - alpha), what a sensor is worth in units of the trace with all sensors: where the sweep begins, how far it
# goes for the largest and the smallest number of sensors, and how close to each other two values are looked between.
_BEGIN, _LEAST, _MOST, _CLOSE = (1e-2, 1.0), 1e-6, 1e4, 1.05
# Values of alpha tried at most, a few to some tens of solutions each.
MOST_ALPHAS = 16


@dataclass(frozen=True)
class Tried:
    """One alpha: the reweighted problem at its end and the set chosen; where the solver failed None, and its words."""

    alpha: float
    relaxed: Relaxed | None
    sensors: tuple[int, ...] | None
    why: str = ""


class Chosen(NamedTuple):
    """A set that the program chose with these alphas, and the solution with alpha = 0 on its rows; None: `why`."""

    sensors: tuple[int, ...]
    alphas: tuple[float, ...]
    solution: Solution | None
    why: str


@dataclass(frozen=True)
class Tradeoff:
    """The alphas tried, in their order; the sets chosen, smallest first; sizes within the limits that none gave.

    `allowed` are the places of the sensors that the program has columns of, and norms in this order; `unit` is the
    trace with all of them.
    """

    allowed: tuple[int, ...]
    full: Solution
    unit: float
    tried: tuple[Tried, ...]
    chosen: tuple[Chosen, ...]
    missing: tuple[int, ...]


Told = Callable[[int], None]


def trade(
    system: Estimation,
    by: Scaling,
    sizes: Sequence[int],
    must: Sequence[int] = (),
    forbid: Sequence[int] = (),
    tell: Told = lambda solved: None,
) -> Tradeoff:
    """The sweep over alpha that looks for a set of each number of sensors in `sizes`; places are those of `system`.

    Forbidden sensors have no column, those of `must` no weight. `tell` hears how many alphas are done. An alpha at
    which the solver fails is kept with its words; nothing is taken from it. Raises SdpError: the solver fails with
    alpha = 0, or at every alpha; EstimationError: the scaling is singular.
    """
    allowed = [i for i in range(len(system.sensors)) if i not in forbid]
    narrowed = system.on(allowed)
    program = Program(narrowed, scaling(narrowed, by))
    full = program.solve(0.0, np.zeros(len(allowed)))
    inside = [allowed.index(i) for i in must]
    tried: dict[float, Tried] = {}
    for worth in _worths(tried, sizes):
        tried[worth] = _try(program, worth / (1.0 + worth), full, inside, allowed)
        tell(len(tried))
    if not any(one.relaxed for one in tried.values()):
        raise SdpError(next(iter(tried.values())).why)
    ordered = tuple(tried[worth] for worth in sorted(tried))
    chosen = tuple(_refitted(system, ordered, sizes))
    found = {len(one.sensors) for one in chosen}
    return Tradeoff(tuple(allowed), full, program.unit, ordered, chosen, tuple(k for k in sizes if k not in found))


def _try(program: Program, alpha: float, full: Solution, must: Sequence[int], allowed: Sequence[int]) -> Tried:
    try:
        relaxed = reweighted(program, alpha, full, must)
    except SdpError as error:
        return Tried(alpha, None, None, str(error))
    why = "" if relaxed.settled else f"the weights did not settle in {relaxed.rounds} rounds"
    return Tried(alpha, relaxed, tuple(allowed[j] for j in relaxed.chosen(must)), why)


def _worths(tried: dict[float, Tried], sizes: Sequence[int]) -> Iterator[float]:
    """What a sensor is to be worth next: until the largest and the smallest size are met, then between others."""
    low, high = _BEGIN
    yield low
    while low > _LEAST and _size(tried[low], 0) < max(sizes) and len(tried) < MOST_ALPHAS:
        low /= 10.0
        yield low
    yield high
    while high < _MOST and _size(tried[high], max(sizes) + 1) > min(sizes) and len(tried) < MOST_ALPHAS:
        high *= 10.0
        yield high
    while len(tried) < MOST_ALPHAS:
        between = _between(tried, sizes)
        if between is None:
            return
        yield between


def _between(tried: dict[float, Tried], sizes: Sequence[int]) -> float | None:
    """Half-way between two neighbours of which the one gives more sensors than a size not met yet, the other fewer."""
    known = {worth: len(sensors) for worth in sorted(tried) if (sensors := tried[worth].sensors) is not None}
    for size in sizes:
        for one, other in pairwise(known):
            if size not in known.values() and known[one] > size > known[other] and other > _CLOSE * one:
                between = math.sqrt(one * other)
                if between not in tried:
                    return between
    return None


def _size(tried: Tried, unknown: int) -> int:
    """How many sensors were chosen; `unknown` where the solver failed, so that the search goes on."""
    return unknown if tried.sensors is None else len(tried.sensors)


def _refitted(system: Estimation, tried: Sequence[Tried], sizes: Sequence[int]) -> Iterator[Chosen]:
    sets = dict.fromkeys(one.sensors for one in tried if one.sensors is not None and len(one.sensors) in sizes)
    for members in sorted(sets, key=lambda members: (len(members), members)):
        alphas = tuple(one.alpha for one in tried if one.sensors == members)
        try:
            yield Chosen(members, alphas, refit(system, members), "")
        except (SdpError, EstimationError) as error:
            yield Chosen(members, alphas, None, str(error))
