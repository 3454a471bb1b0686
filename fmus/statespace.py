"""A system made linear at a point, and the equilibria where that is meant to be done; all in SI units."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from fmus.component import Signal, Vector
from fmus.units import parse_unit

# Rates this small, by `imbalance`, are rest: a tenth of a millionth of what the states' sizes could set in motion is
# above what rounding leaves, and moves no entry of A by more than that share of itself.
AT_REST = 1e-7
# What a step towards an equilibrium may change of a state, of its value or its nominal value.
LONGEST = 0.3
MOST_STEPS = 1000


class SettlingError(ValueError):
    """No equilibrium was found; the message says which state moves on."""


class Differentiable(Protocol):
    """What can be made linear: scalars in a fixed order; values and derivatives at states x and inputs u, all in SI."""

    @property
    def states(self) -> Sequence[Signal]:
        """Continuous states in the order of x."""

    @property
    def inputs(self) -> Sequence[Signal]:
        """Real inputs in the order of u."""

    @property
    def outputs(self) -> Sequence[Signal]:
        """Real outputs in the order of y."""

    def values(self, x: Vector, u: Vector) -> tuple[Vector, Vector]:
        """x' and y."""

    def slopes(self, x: Vector, u: Vector) -> Vector:
        """A as fast as it can be had, for finding equilibria."""

    def jacobians(self, x: Vector, u: Vector) -> Jacobians:
        """The partial derivatives, as good as they can be had."""

    def enter(self, x: Vector, u: Vector) -> None:
        """Begin at this point: what is discrete takes the values that belong to it, and keeps them until told again."""


@dataclass(frozen=True)
class Jacobians:
    """A = dx'/dx (n, n), B = dx'/du (n, m), C = dy/dx (q, n), D = dy/du (q, m), and where they come from.

    `rung` names what gave them, `error` bounds the relative error of an entry as far as is known, `evidence` says how.
    """

    A: Vector
    B: Vector
    C: Vector
    D: Vector
    rung: str
    error: float
    evidence: str = ""


@dataclass(frozen=True)
class StateSpace:
    """x' = A (x - x0) + B (u - u0) + rates, y = C (x - x0) + D (u - u0) + y0, in SI units and seconds.

    A (n, n), B (n, m), C (q, n), D (q, m); x0, u0, y0 and `rates` are values at the point, `rates` zero at an
    equilibrium. The signals name the scalars and their units.
    """

    A: Vector
    B: Vector
    C: Vector
    D: Vector
    states: tuple[Signal, ...]
    inputs: tuple[Signal, ...]
    outputs: tuple[Signal, ...]
    x0: Vector
    u0: Vector
    y0: Vector
    rates: Vector
    rung: str
    error: float
    evidence: str = ""

    def point(self) -> dict[str, float]:
        """Values of states and inputs by name, SI."""
        names = [signal.name for signal in (*self.states, *self.inputs)]
        return dict(zip(names, map(float, (*self.x0, *self.u0)), strict=True))

    def output_row(self, name: str) -> Vector:
        """The gradient of an output or a state with respect to the states, shape (n,). Raises KeyError."""
        for i, signal in enumerate(self.outputs):
            if signal.name == name:
                return self.C[i]
        for i, signal in enumerate(self.states):
            if signal.name == name:
                return np.eye(len(self.states))[i]
        raise KeyError(name)

    def to_json(self) -> dict[str, Any]:
        """As `crankbench linearise --json` prints it."""
        return {
            "rung": self.rung,
            "states": [signal.name for signal in self.states],
            "inputs": [signal.name for signal in self.inputs],
            "outputs": [signal.name for signal in self.outputs],
            "units": {s.name: si_unit(s) for s in (*self.states, *self.inputs, *self.outputs)},
            "A": self.A,
            "B": self.B,
            "C": self.C,
            "D": self.D,
            "point": self.point(),
            "error": self.error,
            "evidence": self.evidence,
            "rates": dict(zip((s.name for s in self.states), self.rates, strict=True)),
            "imbalance": float(imbalance(self.A, self.rates, scales(self.states)).max(initial=0.0)),
        }


def si_unit(signal: Signal) -> str:
    """The name of the SI unit of a signal; empty where it declares none."""
    return parse_unit(signal.unit).si_name() if signal.unit else ""


def scales(signals: Sequence[Signal]) -> Vector:
    """The nominal values in SI units, as differences, shape (n,)."""
    return np.array([abs(s.nominal * parse_unit(s.unit).factor) for s in signals], dtype=float)


def linearised(system: Differentiable, x: Vector, u: Vector) -> StateSpace:
    """The system made linear at states x and inputs u."""
    system.enter(x, u)
    rates, y0 = system.values(x, u)
    found = system.jacobians(x, u)
    signals = tuple(system.states), tuple(system.inputs), tuple(system.outputs)
    matrices = found.A, found.B, found.C, found.D
    return StateSpace(*matrices, *signals, x, u, y0, rates, found.rung, found.error, found.evidence)


def imbalance(A: Vector, rates: Vector, scale: Vector) -> Vector:
    """How far each state is from rest: |x_i'| over sum_j |A_ij| s_j with sizes s, shape (n,); 0 at rest.

    Infinite where a state moves that depends on none.
    """
    reach = np.abs(A) @ scale
    moving = np.abs(rates)
    return np.divide(moving, reach, out=np.where(moving > 0.0, np.inf, 0.0), where=reach > 0.0)


def settle(system: Differentiable, x: Vector, u: Vector) -> Vector:
    """States at which nothing moves with inputs u, found from x; shape (n,).

    Implicit Euler steps that grow as the rates shrink, which follow a stable system to rest and end as Newton's method
    (pseudo-transient continuation: Kelley and Keyes, SIAM J. Numer. Anal. 35(2), 1998). Discrete values are those that
    belong to where it ends.

    Raises SettlingError: there is no such point near, or it is not reached.
    """
    for _ in range(20):
        system.enter(x, u)
        x = _settled(system, x, u)
        system.enter(x, u)
        rates, _ = system.values(x, u)
        if _worst(system.slopes(x, u), rates, scales(system.states)) <= AT_REST:
            return x
    raise SettlingError("no equilibrium: at rest the discrete states are others, with which it moves again")


def _worst(A: Vector, rates: Vector, scale: Vector) -> float:
    return float(imbalance(A, rates, scale).max(initial=0.0))


def _settled(system: Differentiable, x: Vector, u: Vector) -> Vector:
    scale = scales(system.states)
    rates, _ = system.values(x, u)
    A = system.slopes(x, u)
    # The first step lasts as long as the fastest state needs for a hundredth of its way.
    h = 1e-2 / max(float(np.abs(rates / scale).max(initial=0.0)), float(np.abs(A).max(initial=0.0)), 1e-12)
    best, best_x, idle = _worst(A, rates, scale), x, 0
    for _ in range(MOST_STEPS):
        if best == 0.0 or (best <= AT_REST and idle >= 3):
            return best_x
        try:
            step = np.linalg.solve(np.eye(len(x)) / h - A, rates)
        except np.linalg.LinAlgError:
            h *= 0.5
            continue
        if not np.all(np.abs(step) <= LONGEST * np.maximum(np.abs(x), scale)):
            h *= 0.25
            if h < 1e-12 / max(float(np.abs(A).max(initial=0.0)), 1e-12):
                break
            continue
        moved, _ = system.values(x + step, u)
        size = float(np.linalg.norm(rates / scale)), float(np.linalg.norm(moved / scale))
        if not np.isfinite(size[1]):
            h *= 0.25
            continue
        x, rates = x + step, moved
        A = system.slopes(x, u)
        h = min(h * (1.2 * min(max(size[0] / size[1], 0.5), 4.0) if size[1] > 0.0 else 4.0), 1e12)
        reached = _worst(A, rates, scale)
        idle = 0 if reached < 0.5 * best else idle + (best <= AT_REST)
        if reached < best:
            best, best_x = reached, x
    if best <= AT_REST:
        return best_x
    rates, _ = system.values(best_x, u)
    raise SettlingError(f"no equilibrium found: {unrest(system.states, system.slopes(best_x, u), rates)}")


def unrest(states: Sequence[Signal], A: Vector, rates: Vector) -> str:
    """Which state is furthest from rest, and how fast it moves, in words."""
    worst = int(imbalance(A, rates, scales(states)).argmax())
    return f"{states[worst].name} changes by {rates[worst]:.4g} {si_unit(states[worst])} each second".replace("  ", " ")


def state_names(states: Sequence[Signal]) -> list[str]:
    """The names in order."""
    return [signal.name for signal in states]


def at(signals: Sequence[Signal], given: Mapping[str, float]) -> Vector:
    """Start values in SI with those given, in SI by name, in their place; shape (n,)."""
    start = [parse_unit(s.unit).to_si(float(np.asarray(s.start))) for s in signals]
    return np.array([given.get(s.name, value) for s, value in zip(signals, start, strict=True)], dtype=float)
