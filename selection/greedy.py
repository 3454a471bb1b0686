"""Good sets of sensors without a search: the best sensor to add, again and again, and then the best exchanges."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from selection.optimal import WORTHWHILE, Terms
from selection.tangents import Branch, Tangents


class Grown(NamedTuple):
    """A set that grew by the best sensor each time, its cost, and what no set of so many sensors costs less than."""

    sensors: tuple[int, ...]
    cost: float
    guarantee: float


def grown_sets(tangents: Tangents, terms: Terms, most: int) -> list[Grown]:
    """The greedy set of each number of sensors up to `most`, from those of `must` on, while the budget lasts.

    Adding the sensor that lowers the cost most is not optimal, nor, since the cost is no supermodular function, within
    a share known beforehand. But J is convex: tangents bound the cost of every set of that many sensors from below, and
    so how far off the greedy one can be, with no search.
    """
    members = tuple(sorted(terms.must))
    found: list[Grown] = []
    while len(members) <= most:
        tangents.touch(np.isin(np.arange(len(terms.prices)), members).astype(float))
        if members:
            guarantee, _ = tangents.relaxed(_all_of(terms, len(members)), tangents.bound)
            cost = tangents.costs.cost(members)
            found.append(Grown(members, cost, min(guarantee, cost)))
        added = _best(tangents, terms, members, [j for j in terms.free if j not in members])
        if added is None:
            break
        members = added
    return [one for one in found if terms.allow(one.sensors)]


def exchanged(tangents: Tangents, terms: Terms, members: Sequence[int]) -> tuple[int, ...]:
    """The set after exchanges of one sensor for another, the best of them each time, until none is better."""
    costs, best = tangents.costs, tuple(sorted(members))
    while True:
        cost = costs.cost(best)
        found = best
        for leaving in (m for m in best if m not in terms.must):
            kept = tuple(m for m in best if m != leaving)
            tried = _best(tangents, terms, kept, [j for j in terms.free if j not in best], costs.cost(found))
            if tried is not None and costs.cost(tried) < costs.cost(found) * (1.0 - WORTHWHILE):
                found = tried
        if not costs.cost(found) < cost:
            return best
        best = found


def _best(
    tangents: Tangents, terms: Terms, members: tuple[int, ...], free: Sequence[int], below: float = np.inf
) -> tuple[int, ...] | None:
    """The best set with one more within the budget, of equals the first sensor; None where none is below `below`.

    Sets whose tangents say that they are no better than one already met are not solved for.
    """
    found, cost = None, below
    for least, added in _in_order(tangents, terms, members, free):
        if (found is not None and least > cost * (1.0 + WORTHWHILE)) or least >= below:
            break
        tried = tuple(sorted((*members, added)))
        value = tangents.costs.cost(tried)
        if (found is None and value <= cost) or value < cost * (1.0 - WORTHWHILE):
            found, cost = tried, value
    return found


def _in_order(
    tangents: Tangents, terms: Terms, members: tuple[int, ...], free: Sequence[int]
) -> Iterator[tuple[float, int]]:
    money = terms.left(members)
    affordable = tuple(j for j in free if terms.prices[j] <= money)
    bounds = tangents.with_one_more(Branch(members, affordable, 1, money))
    for place in np.argsort(bounds, kind="stable"):
        yield float(bounds[place]), affordable[place]


def _all_of(terms: Terms, size: int) -> Branch:
    inside = tuple(sorted(terms.must))
    return Branch(inside, terms.free, size - len(inside), terms.left(inside))
