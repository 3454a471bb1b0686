"""The best set of each number of sensors: found greedily, bettered by exchanges, proven, and chosen against a loss."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from selection.estimation import Estimation, EstimationError
from selection.greedy import Grown, exchanged, grown_sets
from selection.optimal import MOST_BRANCHES, WORTHWHILE, AfterLoss, Proven, Terms, Whole, best_set, worst_loss
from selection.riccati import AGREED, Costs, Filter, best_filter
from selection.tangents import Tangents


@dataclass(frozen=True)
class Best:
    """What there is of so many sensors.

    `optimum` is the set of the least cost and `filter` its best filter by scipy's solver; `safest` that of the least
    cost after the loss of any one sensor, None of a single sensor; `grown` the greedy set, None where the greedy way
    does not lead to one that is allowed. `after_loss` is the optimum's own cost after its worst loss, and the sensor.
    """

    size: int
    optimum: Proven
    filter: Filter | None
    safest: Proven | None
    grown: Grown | None
    after_loss: tuple[float, int] | None


Told = Callable[[str, int, int], None]


def best_sets(
    system: Estimation,
    costs: Costs,
    terms: Terms,
    sizes: Sequence[int],
    most_branches: int = MOST_BRANCHES,
    tell: Told = lambda what, done, total: None,
) -> list[Best]:
    """The best set of each of `sizes`, for all of which the same tangents serve.

    `system` is what `costs` are of, unscaled. Raises EstimationError: scipy's solver does not find the cost found.
    """
    tangents = Tangents(costs, terms.prices)
    grown = {len(one.sensors): one for one in grown_sets(tangents, terms, max(sizes))}
    found = []
    for number, size in enumerate(sizes):

        def hear(bound: float, best: float, number: int = number, size: int = size) -> None:
            tell(f"best set of {size}, bound {bound:.4g} below {best:.4g}", number, len(sizes))

        begin = [exchanged(tangents, terms, grown[size].sensors)] if size in grown else []
        optimum = best_set(Whole(tangents), tangents, terms, size, begin, most_branches, hear)
        safest = None
        if size > 1:
            known = [*begin, *([optimum.sensors] if optimum.sensors else [])]
            safest = best_set(AfterLoss(tangents), tangents, terms, size, known, most_branches, hear)
        found.append(_best(system, costs, size, optimum, safest, grown.get(size)))
        tell(f"best set of {size}", number + 1, len(sizes))
    return found


def _best(
    system: Estimation, costs: Costs, size: int, optimum: Proven, safest: Proven | None, grown: Grown | None
) -> Best:
    if optimum.sensors is None:
        return Best(size, optimum, None, safest, grown, None)
    certified = best_filter(system, optimum.sensors)
    if not abs(certified.trace - optimum.cost) <= AGREED * certified.trace:
        told = f"the cost of {', '.join(system.sensors[m] for m in optimum.sensors)} is {optimum.cost:.9g}"
        raise EstimationError([f"{told}, by scipy's solver {certified.trace:.9g}"])
    return Best(size, optimum, certified, safest, grown, worst_loss(costs, optimum.sensors))


def gap(cost: float, optimum: Proven) -> float:
    """How far a cost is above that of the best set of so many sensors, relative; below WORTHWHILE it is none."""
    share = cost / optimum.cost - 1.0
    return share if share > WORTHWHILE else 0.0
