"""All sets of sensors within limits, what each is worth, best first."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

from fmus.component import Vector
from selection.measures import Error, Information, Plant, gramian_factors, information, kalman_error
from selection.methods import ByIndex
from selection.observability import Measured, Options, Seen, observe

# More sets than this are not gone through: at a millisecond each that would be half an hour.
MOST_SETS = 2_000_000
Told = Callable[[str, int, int], None]


@dataclass(frozen=True)
class Limits:
    """At most so many sensors, those of `must` in every set, those of `forbid` in none; places of sensors."""

    most: int
    must: frozenset[int] = frozenset()
    forbid: frozenset[int] = frozenset()


@dataclass(frozen=True)
class Ranked:
    """A set of sensors by their places, and what it is worth; None where there is no such number.

    `index` and `whole` are observability indices of the wanted and of all states; `hidden` names the states that take
    part in what the set never sees, where the wanted states are not all seen. `why` says why a measure is missing.
    """

    sensors: tuple[int, ...]
    cost: float
    index: int | None
    whole: int | None
    information: Information
    error: Error
    hidden: tuple[str, ...]
    why: str


# What sets can be ranked by: the least is best.
KEYS: dict[str, Callable[[Ranked], float]] = {
    "index": lambda r: _number(r.index),
    "whole": lambda r: _number(r.whole),
    "cost": lambda r: r.cost,
    "error": lambda r: _number(r.error.rms),
    "gramian_least": lambda r: -_number(r.information.least, -math.inf),
    "gramian_log_det": lambda r: -_number(r.information.log_det, -math.inf),
    "gramian_trace_inverse": lambda r: _number(r.information.trace_inverse),
}


def _number(value: float | None, missing: float = math.inf) -> float:
    return missing if value is None else float(value)


def count_sets(sensors: int, limits: Limits) -> int:
    """How many sets there are within the limits."""
    free = sensors - len(limits.must | limits.forbid)
    most = min(limits.most - len(limits.must), free)
    return sum(math.comb(free, k) for k in range(0 if limits.must else 1, most + 1))


def sets_within(sensors: int, limits: Limits) -> list[tuple[int, ...]]:
    """Every set within the limits, the smaller ones first, sensors in their order. The empty set is none."""
    free = [i for i in range(sensors) if i not in limits.must | limits.forbid]
    most = min(limits.most - len(limits.must), len(free))
    sizes = range(0 if limits.must else 1, most + 1)
    return [tuple(sorted((*limits.must, *added))) for k in sizes for added in combinations(free, k)]


def rank(rows: Iterable[Ranked], by: Sequence[str]) -> list[Ranked]:
    """The rows by the keys in turn, then by sensors in their order."""
    keys = [KEYS[name] for name in by]
    return sorted(rows, key=lambda row: (*(key(row) for key in keys), len(row.sensors), row.sensors))


@dataclass(frozen=True)
class Asked:
    """What is to be ranked: the wanted states by place, the sets, by which method, and which measures beside it.

    `plant` is what the measures are taken of; None where they are not wanted. `costs` are those of the sensors.
    """

    wanted: tuple[int, ...]
    sets: Sequence[tuple[int, ...]]
    method: ByIndex
    options: Options
    costs: Sequence[float]
    plant: Plant | None = None
    measures: frozenset[str] = frozenset()


def evaluate(
    measured: Measured, asked: Asked, tell: Told = lambda what, done, total: None
) -> tuple[list[Ranked], Seen]:
    """What each set is worth, in the order of the sets, and what the method stands on.

    `tell` hears what is being done, of how many sets it is done, and of how many in all. Raises as `observe`.
    """
    total, done = len(asked.sets), 0

    def more(count: int) -> None:
        nonlocal done
        done += count
        tell(f"{asked.method} index", done, total)

    seen = observe(measured, asked.wanted, asked.sets, asked.method, asked.options, more)
    factors, missing = _factors(asked)
    names = [signal.name for signal in measured.space.states]
    rows = []
    for i, members in enumerate(asked.sets):
        known = _information(factors, missing, members, asked.wanted)
        error = Error(None)
        if asked.plant is not None and "kalman" in asked.measures:
            error = kalman_error(asked.plant, members, asked.wanted)
        index, whole = int(seen.index[i]) or None, int(seen.whole[i]) or None
        hidden = () if index else tuple(names[j] for j in seen.hidden(i))
        cost = math.fsum(asked.costs[m] for m in members)
        why = "; ".join(reason for reason in (known.why, error.why) if reason)
        rows.append(Ranked(members, cost, index, whole, known, error, hidden, why))
        if asked.plant is not None and (i % 64 == 63 or i == total - 1):
            tell(" and ".join(sorted(asked.measures)), i + 1, total)
    return rows, seen


def _factors(asked: Asked) -> tuple[Vector | None, str]:
    """The Gramian's factor of each sensor, or why there is none."""
    if asked.plant is None or "gramian" not in asked.measures:
        return None, ""
    try:
        return gramian_factors(asked.plant), ""
    except ValueError as error:
        return None, str(error)


def _information(
    factors: Vector | None, missing: str, members: tuple[int, ...], wanted: tuple[int, ...]
) -> Information:
    if factors is None:
        return Information(None, None, None, missing)
    return information(factors[list(members)], wanted)


def as_json(row: Ranked, sensors: Sequence[str], wanted: Sequence[str], sizes: Sequence[float]) -> dict[str, Any]:
    """A set as `crankbench select --json` prints it; `errors` are standard deviations in SI."""
    deviations = row.error.deviations
    errors = None
    if deviations is not None:
        errors = {name: float(d * size) for name, d, size in zip(wanted, deviations, sizes, strict=True)}
    return {
        "sensors": [sensors[m] for m in row.sensors],
        "index": row.index,
        "cost": row.cost,
        "error": row.error.rms,
        "whole": row.whole,
        "errors": errors,
        "gramian_least": row.information.least,
        "gramian_log_det": row.information.log_det,
        "gramian_trace_inverse": row.information.trace_inverse,
        "hidden": list(row.hidden),
        "why": row.why,
    }
