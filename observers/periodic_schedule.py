"""Gains of a sampled periodic-input observer over speed: at what nodes they are kept, and whether they converge.

Everything here counts in the speed sigma that a system's matrices go by: omega [rad/s], or omega tau [rad] of a lag
whose time constant was taken out of A.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from observers.periodic import PeriodicSystem, sampled_multipliers

Array = NDArray[np.float64]
GainLaw = Callable[[float], Array]

# How near, relative to the largest gain of its kind, a table between two nodes is to the law for the others to be left
# out: rounding.
STRAIGHT = 1e-12
# Speeds between two nodes at which convergence is certified, too.
BETWEEN = 4
# How near to what was demanded, relatively, the multipliers are between nodes, and how many nodes that may take.
NEAR, MOST_NODES = 0.005, 65


class Sampling(NamedTuple):
    """Every how much the observer samples: `step` in rad of crank angle or in s."""

    step: float
    per: Literal["rad", "s"]

    def angle(self, omega: float) -> float:
        """The step in crank angle [rad] at a speed [rad/s]."""
        return self.step if self.per == "rad" else self.step * omega


class Schedule(NamedTuple):
    """K over sigma: `table` (nodes, N, p), joined by lines over sigma (`speed`) or 1/sigma (`interval`).

    `nodes` ascend and are values of that variable; outside of them the nearest counts.
    """

    variable: Literal["speed", "interval"]
    nodes: Array
    table: Array

    def gain(self, sigma: float) -> Array:
        """K (N, p) at sigma."""
        value = sigma if self.variable == "speed" else 1.0 / sigma
        if len(self.nodes) == 1:
            return self.table[0]
        place = int(np.clip(np.searchsorted(self.nodes, value) - 1, 0, len(self.nodes) - 2))
        low, high = self.nodes[place], self.nodes[place + 1]
        share = np.clip((value - low) / (high - low), 0.0, 1.0)
        result: Array = (1.0 - share) * self.table[place] + share * self.table[place + 1]
        return result

    @property
    def speeds(self) -> Array:
        """The nodes as values of sigma, ascending."""
        return self.nodes if self.variable == "speed" else np.sort(1.0 / self.nodes)


def schedule(law: GainLaw, low: float, high: float, nodes: int) -> Schedule:
    """The law at `nodes` speeds in equal ratios from `low` to `high`; at the two ends alone where a line is exact.

    That is so over 1/sigma for the published gains of a lag, whose L is 3/(omega tau) and whose L_k are constants; over
    sigma for the designed ones, whose L_k grow with 1 + i k w0 omega tau.
    """
    if low == high:
        return Schedule("speed", np.array([low]), law(low)[None])
    speeds = np.geomspace(low, high, max(nodes, 3))
    table = np.array([law(sigma) for sigma in speeds])
    size = max(float(np.abs(table).max()), float(np.finfo(float).tiny))
    variables: tuple[Literal["speed", "interval"], ...] = ("speed", "interval")
    for variable in variables:
        values = speeds if variable == "speed" else 1.0 / speeds
        ends = [0, -1] if variable == "speed" else [-1, 0]
        short = Schedule(variable, values[ends], table[ends])
        if all(np.abs(short.gain(s) - K).max() <= STRAIGHT * size for s, K in zip(speeds, table, strict=True)):
            return short
    return Schedule("speed", speeds, table)


def refined(
    system: PeriodicSystem, scheduled: Schedule, law: GainLaw, step: Callable[[float], float], demanded: float
) -> Schedule:
    """The schedule with more nodes, where between two of them the largest multiplier is not `demanded`.

    Half-way between the nodes of such a gap one is put in, until the demand is kept to NEAR or there are MOST_NODES.
    """
    while len(scheduled.nodes) < MOST_NODES:
        nodes, middles = scheduled.nodes, []
        for low, high in itertools.pairwise(nodes):
            inner = [low + (high - low) * j / (BETWEEN + 1) for j in range(1, BETWEEN + 1)]
            speeds = inner if scheduled.variable == "speed" else [1.0 / value for value in inner]
            worst = max(abs(sampled_multipliers(system, scheduled.gain(s), s, step(s))[0]) for s in speeds)
            if worst > demanded * (1.0 + NEAR):
                middles.append(0.5 * (low + high))
        if not middles:
            break
        added = np.array([law(v if scheduled.variable == "speed" else 1.0 / v) for v in middles])
        order = np.argsort(np.concatenate([nodes, middles]))
        scheduled = Schedule(
            scheduled.variable, np.concatenate([nodes, middles])[order], np.concatenate([scheduled.table, added])[order]
        )
    return scheduled


class Certificate(NamedTuple):
    """Largest multiplier over a period, `largest` (q,), at each of the speeds sigma that were looked at (q,)."""

    speeds: Array
    largest: Array

    @property
    def worst(self) -> tuple[float, float]:
        """The largest of all, and its sigma."""
        place = int(np.argmax(self.largest))
        return float(self.largest[place]), float(self.speeds[place])


def certify(
    system: PeriodicSystem, scheduled: Schedule, low: float, high: float, nodes: int, step: Callable[[float], float]
) -> Certificate:
    """The multipliers of the sampled observer with the gains as they are read, at the nodes and between them.

    `step` gives the step in crank angle [rad] at sigma.
    """
    if low == high:
        speeds = np.array([low])
    else:
        grid = np.clip(np.union1d(np.geomspace(low, high, max(nodes, 3)), scheduled.speeds), low, high)
        shares = np.linspace(0.0, 1.0, BETWEEN + 2)[:-1]
        inner = grid[:-1, None] + np.diff(grid)[:, None] * shares
        speeds = np.append(inner.ravel(), grid[-1])
    largest = [abs(sampled_multipliers(system, scheduled.gain(s), s, step(s))[0]) for s in speeds]
    return Certificate(speeds, np.array(largest))
