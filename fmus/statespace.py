"""A system made linear at a point, and the equilibria where that is meant to be done; all in SI units."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Protocol

import numpy as np

from fmus.component import Signal, Vector
from fmus.jacobians import Point
from fmus.steady import SteadyError, steady_state
from fmus.units import parse_unit

# Rates this small, by `imbalance`, are rest: a tenth of a millionth of what the states' sizes could set in motion is
# above what rounding leaves, and moves no entry of A by more than that share of itself.
AT_REST = 1e-7
# How often the discrete states may turn out to be others where a system rests.
_MOST_MODES = 20


class Differentiable(Protocol):
    """What can be made linear: scalars in a fixed order; values and derivatives at states x and inputs u, all in SI."""

    @property
    def name(self) -> str:
        """What it is called."""

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

    def partials(self, x: Vector, u: Vector) -> Partials:
        """The partial derivatives, as good as they can be had."""

    def enter(self, x: Vector, u: Vector) -> None:
        """Begin at this point: what is discrete takes the values that belong to it, and keeps them until told again."""


@dataclass(frozen=True)
class Partials:
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
    found = system.partials(x, u)
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
    """States at which nothing moves with inputs u, shape (n,): those that the system goes to from x by itself.

    See `fmus.steady`. Discrete values are those that belong to where it ends. Where it is at rest already, it stays,
    though that may be no stable equilibrium.

    Raises SteadyError: it does not come to rest, or not to one point; the state in the way is named.
    """
    for _ in range(_MOST_MODES):
        system.enter(x, u)
        rates, _ = system.values(x, u)
        if imbalance(system.slopes(x, u), rates, scales(system.states)).max(initial=0.0) <= AT_REST:
            return x
        x = steady_state(_Evaluated(system), Point(x, np.empty(0), u, np.empty(0))).point.x
    raise SteadyError(f"{system.name} has other discrete states where it rests, with which it moves again")


class _Declared(NamedTuple):
    name: str
    states: tuple[Signal, ...]
    outputs: tuple[Signal, ...]


class _Slopes(NamedTuple):
    A: Vector


class _Evaluated:
    """A system as the search for a steady state asks for it, in SI."""

    def __init__(self, system: Differentiable) -> None:
        self._system = system
        self.model = _Declared(system.name, *(tuple(map(_in_si, s)) for s in (system.states, system.outputs)))

    def values(self, at: Point) -> tuple[Vector, Vector]:
        """x' and y."""
        return self._system.values(at.x, at.u)

    def at(self, at: Point) -> _Slopes:
        """A."""
        return _Slopes(self._system.slopes(at.x, at.u))


def _in_si(signal: Signal) -> Signal:
    unit = parse_unit(signal.unit)
    nominal = abs(unit.factor * signal.nominal) or 1.0
    low, high = unit.to_si(signal.minimum), unit.to_si(signal.maximum)
    return replace(signal, unit=si_unit(signal), nominal=nominal, minimum=low, maximum=high)


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
