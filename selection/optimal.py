"""The set of so many sensors with the least error, and the proof that there is none better: branch and bound.

The cost is J of `selection.riccati`. More sensors never raise it: no set of a branch is better than all that are left
in it together. Better bounds come from tangents of J, by `selection.tangents`; the first of all is taken
with all that are left, so that its bound is never below their cost.

Ties in cost are broken by the places of the sensors as the search meets them; the same system gives the same set.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from fmus.component import Vector
from selection.riccati import Costs
from selection.tangents import Branch, Tangents

# A branch is left where it could better the best set by less than this share: costs are good to about 1e-12.
WORTHWHILE = 1e-9
# Branches looked into, before the search ends without a proof: at a millisecond each about ten minutes.
MOST_BRANCHES = 500_000
Told = Callable[[float, float], None]


@dataclass(frozen=True)
class Terms:
    """Which sets are allowed: those of `must` in every one, those of `forbid` in none, prices (m,) within a budget."""

    prices: Vector
    must: frozenset[int] = frozenset()
    forbid: frozenset[int] = frozenset()
    budget: float = np.inf

    @property
    def free(self) -> tuple[int, ...]:
        """Sensors that may be in a set or not."""
        return tuple(i for i in range(len(self.prices)) if i not in self.must | self.forbid)

    def allow(self, members: Sequence[int]) -> bool:
        """Whether a set is one of them."""
        inside = self.must <= set(members) and not self.forbid & set(members)
        return inside and float(self.prices[list(members)].sum()) <= self._limit

    @property
    def _limit(self) -> float:
        # Sums of prices are rounded: a budget that is their sum in decimals is kept.
        return self.budget * (1.0 + 1e-12)

    def left(self, members: Sequence[int]) -> float:
        """The money that a set leaves."""
        return self._limit - float(self.prices[list(members)].sum())


class Proven(NamedTuple):
    """The best set of so many sensors, None where none is allowed or sees what it must; its cost, and no set's below.

    `bound` is what no set costs less than; `proven` that the search came to its end, and then the bound is the cost
    but for WORTHWHILE. `branches` were looked into.
    """

    sensors: tuple[int, ...] | None
    cost: float
    bound: float
    branches: int
    proven: bool


class Goal(Protocol):
    """What is to be least over the sets, and bounds on it from tangents."""

    def value(self, members: Sequence[int]) -> float:
        """What a set costs."""

    def bound(self, branch: Branch) -> float:
        """What no set of a branch costs less than."""

    def with_one_more(self, branch: Branch) -> Vector:
        """The bounds of sets with one more, shape (free,)."""


class Whole:
    """The cost of a set with all of its sensors at work."""

    def __init__(self, tangents: Tangents) -> None:
        self._tangents = tangents
        self.value = tangents.costs.cost
        self.bound = tangents.bound
        self.with_one_more = tangents.with_one_more


class AfterLoss:
    """The cost of a set after the loss of that one of its sensors without which it costs most."""

    def __init__(self, tangents: Tangents) -> None:
        self._tangents = tangents
        self.bound = tangents.bound_after_loss

    def value(self, members: Sequence[int]) -> float:
        """The cost after the worst loss."""
        return worst_loss(self._tangents.costs, members)[0]

    def with_one_more(self, branch: Branch) -> Vector:
        """The bounds of sets with one more."""
        free = branch.free
        made = (Branch((*branch.inside, j), (), 0, branch.money) for j in free)
        return np.array([self.bound(one) for one in made])


def worst_loss(costs: Costs, members: Sequence[int]) -> tuple[float, int]:
    """The cost of a set after its worst loss, and the sensor lost then, the first of several."""
    after = [(costs.cost([m for m in members if m != lost]), -lost) for lost in members]
    cost, lost = max(after)
    return cost, -lost


def best_set(
    goal: Goal,
    tangents: Tangents,
    terms: Terms,
    size: int,
    known: Sequence[Sequence[int]] = (),
    most_branches: int = MOST_BRANCHES,
    tell: Told = lambda bound, best: None,
) -> Proven:
    """The best set of exactly `size` sensors; `known` are sets to begin with. `tell` hears of bound and best cost.

    A search over more than `most_branches` ends early, with the best set so far and the bound that holds.
    """
    best: tuple[int, ...] | None = None
    cost = floor = np.inf
    for members in known:
        if len(set(members)) == size and terms.allow(members) and goal.value(members) < cost:
            best, cost = tuple(sorted(members)), goal.value(members)
    inside = tuple(sorted(terms.must))
    root = Branch(inside, terms.free, size - len(inside), terms.left(inside))
    waiting: list[tuple[float, int, Branch, Vector | None]] = []
    if _possible(root, terms.prices):
        waiting = [(goal.bound(root), 0, root, None)]
    looked = made = 0
    while waiting:
        bound, _, branch, begin = heapq.heappop(waiting)
        bound = max(bound, goal.bound(branch))
        if bound >= cost * (1.0 - WORTHWHILE):
            floor = min(floor, bound)
            continue
        if waiting and bound > waiting[0][0]:
            heapq.heappush(waiting, (bound, made := made + 1, branch, begin))
            continue
        if looked >= most_branches:
            return Proven(best, cost, min(cost, floor, bound), looked, False)
        looked += 1
        tell(min(floor, bound), cost)
        if branch.more == 0 or branch.more == len(branch.free):
            members = tuple(sorted((*branch.inside, *(branch.free if branch.more else ()))))
            if goal.value(members) < cost:
                best, cost = members, goal.value(members)
            continue
        if branch.more == 1:
            for least, members in _one_more(goal, branch, terms):
                if least >= cost * (1.0 - WORTHWHILE):
                    floor = min(floor, least)
                    break
                if goal.value(members) < cost:
                    best, cost = members, goal.value(members)
            continue
        bound, use = tangents.relaxed(branch, goal.bound, cost * (1.0 - WORTHWHILE), begin)
        if bound >= cost * (1.0 - WORTHWHILE):
            floor = min(floor, bound)
            continue
        for child in _parted(branch, use, terms):
            heapq.heappush(waiting, (max(bound, goal.bound(child)), made := made + 1, child, use))
    return Proven(best, cost, min(cost, floor) if best is not None else np.inf, looked, True)


def _one_more(goal: Goal, branch: Branch, terms: Terms) -> Iterator[tuple[float, tuple[int, ...]]]:
    """Bound and members of each set with one more that the money is enough for, the least bound first."""
    bounds = goal.with_one_more(branch)
    for place in np.argsort(bounds, kind="stable"):
        sensor = branch.free[place]
        if terms.prices[sensor] <= branch.money:
            yield float(bounds[place]), tuple(sorted((*branch.inside, sensor)))


def _parted(branch: Branch, use: Vector, terms: Terms) -> list[Branch]:
    """The branch with and without the sensor that the relaxed problem takes most of, as far as they hold a set."""
    free = list(branch.free)
    chosen = free[int(np.argmax(use[free]))]
    rest = tuple(j for j in branch.free if j != chosen)
    with_it = Branch((*branch.inside, chosen), rest, branch.more - 1, branch.money - float(terms.prices[chosen]))
    without = Branch(branch.inside, rest, branch.more, branch.money)
    return [child for child in (with_it, without) if _possible(child, terms.prices)]


def _possible(branch: Branch, prices: Vector) -> bool:
    """Whether there are as many sensors left, and money for the cheapest of them."""
    if branch.more < 0 or branch.more > len(branch.free) or branch.money < 0.0:
        return False
    return bool(np.sort(prices[list(branch.free)])[: branch.more].sum() <= branch.money)
