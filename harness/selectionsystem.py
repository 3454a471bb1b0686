"""The system that sensors are selected for: at rest where it must be, scaled, and as a selection's JSON tells of it."""

from __future__ import annotations

import math
import platform
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from typing import Any

import numpy as np

from fmus.component import ConfigurationError, Vector
from fmus.statespace import AT_REST, StateSpace, imbalance, scales, si_unit, unrest
from harness.operating import Operation
from harness.runfolder import VERSIONED, commit
from harness.wishes import Choice, Wishes
from selection.measures import Noise, Plant, plant
from selection.methods import BY_ERROR

# Methods about an equilibrium; the others ask for the branch only that a model takes at the point.
AT_EQUILIBRIA = ("numerical", "exact", *BY_ERROR)


def refuse_unrest(space: StateSpace, wishes: Wishes) -> None:
    """Raises ConfigurationError: the method is about an equilibrium and the point is none."""
    if wishes.method in AT_EQUILIBRIA and is_moving(space):
        raise ConfigurationError(f"the point is no equilibrium: {moving(space)}; --settle finds one from there")


def is_moving(space: StateSpace) -> bool:
    """Whether the point is no equilibrium."""
    return bool(_imbalance(space).max(initial=0.0) > AT_REST)


def moving(space: StateSpace) -> str:
    """What moves at the point, in words."""
    return unrest(space.states, space.A, space.rates)


def _imbalance(space: StateSpace) -> Vector:
    return imbalance(space.A, space.rates, scales(space.states))


def plant_of(space: StateSpace, choice: Choice) -> Plant:
    """The plant with the sensors chosen. Raises ConfigurationError: a nominal value is no size; its state is named."""
    sizes = scales(space.states)
    bad = [s for s, size in zip(space.states, sizes, strict=True) if not 0.0 < size < np.inf]
    if bad:
        told = ", ".join(f"{state.name} has the nominal value {state.nominal:g}" for state in bad)
        raise ConfigurationError(f"the scaling is singular: {told}")
    rows = {s.name: row for s, row in zip(space.outputs, space.C, strict=True)}
    rows |= {s.name: row for s, row in zip(space.states, np.eye(len(sizes)), strict=True) if s.name not in rows}
    gradients = np.array([rows[signal.name] for signal in choice.signals])
    return plant(space.A, gradients, np.array(choice.lags), sizes, Noise(choice.noise, choice.period, choice.process))


def sensor_told(choice: Choice, place: int) -> dict[str, Any]:
    """What a sensor is: name, SI unit, time constant [s], noise and cost."""
    signal = choice.signals[place]
    return {
        "name": signal.name,
        "unit": si_unit(signal),
        "lag": choice.lags[place],
        "noise": float(choice.noise[place]),
        "cost": choice.costs[place],
    }


def system_told(operation: Operation, space: StateSpace, choice: Choice, wishes: Wishes) -> dict[str, Any]:
    """What was asked and what the system is, as every selection's JSON has it."""
    names = [signal.name for signal in choice.signals]
    sizes = scales(space.states)
    # Where each state has its own, all are told, in SI.
    uniform = math.nan if isinstance(wishes.process, Mapping) else wishes.process
    disturbed = np.flatnonzero(choice.process != uniform)
    return {
        "target": operation.target,
        "estimate": [space.states[j].name for j in choice.wanted],
        "method": wishes.method,
        "states": [
            {"name": signal.name, "unit": si_unit(signal), "size": float(size)}
            for signal, size in zip(space.states, sizes, strict=True)
        ],
        "must": [names[m] for m in sorted(choice.limits.must)],
        "forbid": [names[m] for m in sorted(choice.limits.forbid)],
        "most": choice.limits.most,
        "budget": wishes.budget if np.isfinite(wishes.budget) else None,
        "period": choice.period,
        "process": wishes.process,
        "disturbances": {space.states[j].name: float(choice.process[j] * sizes[j]) for j in disturbed},
        "point": space.point(),
        "imbalance": float(_imbalance(space).max(initial=0.0)),
        "rung": space.rung,
        "error": space.error,
        "versions": {"python": platform.python_version(), **{name: version(name) for name in _packages(wishes)}},
        "commit": commit(),
    }


def _packages(wishes: Wishes) -> tuple[str, ...]:
    return (*VERSIONED, "cvxpy", "clarabel") if wishes.method == "h2" else VERSIONED


def within_budget(sets: Sequence[tuple[int, ...]], choice: Choice, wishes: Wishes) -> list[tuple[int, ...]]:
    """The sets that the budget is enough for. Raises ConfigurationError: there is none."""
    if not np.isfinite(wishes.budget):
        return list(sets)
    prices = np.array(choice.costs)
    kept = [members for members in sets if float(prices[list(members)].sum()) <= wishes.budget * (1.0 + 1e-12)]
    if not kept:
        least = min(float(prices[list(members)].sum()) for members in sets)
        raise ConfigurationError(f"--budget {wishes.budget:g}: no set costs as little; the cheapest costs {least:g}")
    return kept
