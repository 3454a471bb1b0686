"""Lower bounds on the costs of all sets within a branch, from tangents that lie below the cost of every set.

Each tangent of J (see `selection.riccati`) gives for a branch an offset less a sum of slopes, and of the sets of the
branch those with the largest slopes have the least of it. The best bound is had where the relaxed problem, in which
there may be parts of sensors, has its least. Ever nearer to that leads the multiplicative rule of the optimal design of
experiments (Titterington, Biometrika 1978; with the square root as Torsney, 1983, has it for such costs),

    d_j <- min(1, s d_j sqrt(g_j)) with sum d = the number of sensors wanted.

A bound holds wherever its tangent touches, whether the rule has converged or not.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from fmus.component import Vector
from selection.riccati import Costs, Tangent

# Tangents kept: the first, which are those of the whole problem, and the latest.
_FIRST, _LATEST = 64, 448
# Tangents taken at a branch at most, and the share of the distance to what is asked for that one more has to bring.
_TOUCHES, _BROUGHT = 8, 0.1


@dataclass(frozen=True)
class Branch:
    """The sets that hold all of `inside`, and `more` of the sensors `free`; what those cost is at most `money`."""

    inside: tuple[int, ...]
    free: tuple[int, ...]
    more: int
    money: float


class Tangents:
    """Tangents met so far, and what they say of a branch. `cautious` counts a set without its best sensor."""

    def __init__(self, costs: Costs, prices: Vector) -> None:
        self.costs = costs
        self.prices = prices
        m = len(prices)
        self._offsets = np.zeros(0)
        self._slopes = np.zeros((0, m))

    def touch(self, use: Vector) -> Tangent | None:
        """The tangent where so much of each sensor is there, kept from now on; None where that sees too little."""
        tangent = self.costs.tangent(use)
        if tangent is not None:
            offsets, slopes = self._offsets, self._slopes
            if len(offsets) >= _FIRST + _LATEST:
                offsets, slopes = np.delete(offsets, _FIRST), np.delete(slopes, _FIRST, axis=0)
            self._offsets = np.append(offsets, tangent.offset)
            self._slopes = np.concatenate([slopes, tangent.slopes[None]])
        return tangent

    def bound(self, branch: Branch) -> float:
        """What no set of the branch costs less than."""
        if not len(self._offsets):
            return 0.0
        inside = self._slopes[:, list(branch.inside)].sum(axis=1)
        return float((self._offsets - inside - self._gains(branch)).max(initial=0.0))

    def relaxed(
        self,
        branch: Branch,
        bound_of: Callable[[Branch], float],
        enough: float = np.inf,
        begin: Vector | None = None,
    ) -> tuple[float, Vector]:
        """The bound of a branch after tangents of its own, and how much of each sensor to begin with inside it (m,).

        The first is taken with the parts of sensors that `begin` (m,) has, which is where it ended in a branch around
        this one; without it with all that is left, so that the bound is not below what all cost together. It ends early
        where the bound is `enough`. Infinite where all that is left does not see what must be seen.
        """
        free = list(branch.free)
        use = np.zeros(len(self.prices))
        use[list(branch.inside)] = 1.0
        use[free] = 1.0 if begin is None else _shared(begin[free], branch.more)
        bound = bound_of(branch)
        for touches in range(1, _TOUCHES + 1):
            tangent = self.touch(use)
            if tangent is None:
                return np.inf, use
            before, bound = bound, max(bound, bound_of(branch))
            if not free:
                break
            use[free] = _shared(use[free] * np.sqrt(tangent.slopes[free]), branch.more)
            little = bound - before <= _BROUGHT * (min(enough, tangent.cost) - bound)
            if bound >= enough or (little and (begin is not None or touches > 2)):
                break
        return bound, use

    def bound_after_loss(self, branch: Branch) -> float:
        """What no set of the branch costs less than when its most valuable sensor is lost.

        By each tangent a set without one sensor loses that sensor's slope; its worst loss is at least the largest.
        """
        if not len(self._offsets):
            return 0.0
        free = self._slopes[:, list(branch.free)]
        best = -np.partition(-free, branch.more - 1, axis=1)[:, : branch.more] if branch.more else free[:, :0]
        whole = np.concatenate([self._slopes[:, list(branch.inside)], best], axis=1)
        kept = whole.sum(axis=1) - whole.max(axis=1, initial=0.0)
        return float((self._offsets - kept).max(initial=0.0))

    def with_one_more(self, branch: Branch) -> Vector:
        """The bound of `inside` with each of `free`, shape (free,)."""
        if not len(self._offsets):
            return np.zeros(len(branch.free))
        inside = self._offsets - self._slopes[:, list(branch.inside)].sum(axis=1)
        found = (inside[:, None] - self._slopes[:, list(branch.free)]).max(axis=0)
        return np.asarray(np.maximum(found, 0.0))

    def _gains(self, branch: Branch) -> Vector:
        """By each tangent, the most that `more` of the free sensors bring, as far as the money goes; (tangents,)."""
        free = self._slopes[:, list(branch.free)]
        if not branch.more:
            return np.zeros(len(free))
        gains = -np.partition(-free, branch.more - 1, axis=1)[:, : branch.more].sum(axis=1)
        prices = self.prices[list(branch.free)]
        if np.sort(prices)[-branch.more :].sum() <= branch.money:
            return np.asarray(gains)
        # The knapsack with parts of sensors: by value for money, and of the last what the money is enough for.
        order = np.argsort(-free / np.maximum(prices, np.finfo(float).tiny), axis=1, kind="stable")
        sorted_prices = prices[order]
        spent = np.cumsum(sorted_prices, axis=1) - sorted_prices
        with np.errstate(invalid="ignore", divide="ignore"):
            share = np.where(sorted_prices > 0.0, (branch.money - spent) / sorted_prices, 1.0)
        bought = np.take_along_axis(free, order, axis=1) * np.clip(share, 0.0, 1.0)
        return np.minimum(gains, bought.sum(axis=1))


def _shared(weights: Vector, total: int) -> Vector:
    """s times the weights, one where that is above one, so that they add up to `total`; evenly where all are zero."""
    n = len(weights)
    if not weights.max(initial=0.0) > 0.0:
        return np.full(n, total / n)
    # A share far below the others' keeps a sensor in sight: where it is zero it never comes back.
    weights = np.maximum(weights, 1e-9 * weights.max())
    order = np.argsort(-weights, kind="stable")
    rest = weights[order][::-1].cumsum()[::-1]
    for whole in range(total):
        scale = (total - whole) / rest[whole]
        if scale * weights[order[whole]] <= 1.0:
            return np.asarray(np.minimum(1.0, scale * weights))
    return np.isin(np.arange(n), order[:total]).astype(float)
