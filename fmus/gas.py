"""Gas that flows through restrictions and fills volumes: both directions, with finite slopes where nothing flows.

Flows are in kg/s from side 1 to side 2 and negative the other way, where the gas upstream is that of side 2. Every
function takes floats and symbols alike.

Equations [R]: the control volumes and restrictions of the TCSISimTestbed (Ng, Frisk, Krysander, Eriksson, IEEE Control
Systems Magazine 40(2), 2020) and of Eriksson and Nielsen, Modeling and Control of Engines and Drivelines, 2014.
The flow backwards [I] follows the same equation with its own gas upstream.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np


class Gas(NamedTuple):
    """A perfect gas: gamma [1], the ratio of its specific heats, and R [J/kg/K]."""

    gamma: Any
    R: Any

    @property
    def cp(self) -> Any:
        """Specific heat at constant pressure, J/kg/K: gamma R/(gamma - 1)."""
        return self.gamma * self.R / (self.gamma - 1.0)


class Stream(NamedTuple):
    """A flow W [kg/s] into a volume, negative out of it, and the temperature T [K] of what flows."""

    W: Any
    T: Any


def signed_root(value: Any, linear: Any) -> Any:
    """sign(value) sqrt(|value|), and value/sqrt(linear) where |value| < linear: continuous, of finite slope."""
    size = np.abs(value)
    return np.where(size < linear, value / np.sqrt(linear), np.sign(value) * np.sqrt(np.maximum(size, linear)))


def turbulent_flow(p_1: Any, T_1: Any, p_2: Any, T_2: Any, H: Any, dp_lin: Any) -> Any:
    """Flow [kg/s] through an incompressible restriction: W = sqrt(p_u/(H T_u)) sqrt(dp), linear below dp_lin [Pa].

    p [Pa], T [K], u upstream, H [Pa2.s2/kg2/K].
    """
    forward = p_1 >= p_2
    p_u, T_u = np.where(forward, p_1, p_2), np.where(forward, T_1, T_2)
    return np.sqrt(p_u / (H * T_u)) * signed_root(p_1 - p_2, dp_lin)


def critical_ratio(gamma: Any) -> Any:
    """The pressure ratio below which an isentropic flow is choked: (2/(gamma + 1))^(gamma/(gamma - 1))."""
    return (2.0 / (gamma + 1.0)) ** (gamma / (gamma - 1.0))


def isentropic_flow(p_1: Any, T_1: Any, p_2: Any, T_2: Any, area: Any, gas: Gas, PI_lin: Any) -> Any:
    """Flow [kg/s] through an orifice of `area` [m2]: W = area p_u/sqrt(R T_u) Psi(PI), p [Pa], T [K], u upstream.

    Psi = sqrt(2 gamma/(gamma - 1) (PI^(2/gamma) - PI^((gamma + 1)/gamma))), with PI not below the critical ratio: a
    choked flow depends on nothing downstream. From PI_lin to 1 it is a straight line to zero.
    """
    gamma, R = gas
    forward = p_1 >= p_2
    p_u, T_u = np.where(forward, p_1, p_2), np.where(forward, T_1, T_2)
    PI = np.maximum(np.where(forward, p_2, p_1) / p_u, critical_ratio(gamma))

    def curve(ratio: Any) -> Any:
        return np.sqrt(2.0 * gamma / (gamma - 1.0) * (ratio ** (2.0 / gamma) - ratio ** ((gamma + 1.0) / gamma)))

    line = curve(PI_lin) * (1.0 - PI) / (1.0 - PI_lin)
    Psi = np.where(PI_lin < PI, line, curve(np.minimum(PI, PI_lin)))
    return np.where(forward, 1.0, -1.0) * area * p_u / np.sqrt(R * T_u) * Psi


def between(W: Any, ahead: Any, T_1: Any, T_2: Any, forward: Any = None, backward: Any = None) -> tuple[Stream, Stream]:
    """What a flow W [kg/s] from volume 1 to volume 2, if `ahead`, or the other way is to volume 1 and to volume 2.

    It leaves a volume at that volume's temperature T_1 or T_2 [K]. It enters the other one at the same, or, where it
    is heated or cooled on its way, at `forward` into volume 2 and at `backward` into volume 1. Where nothing flows
    `ahead` still says what would, so that derivatives with respect to an area of zero are right.
    """
    into_2 = T_1 if forward is None else forward
    into_1 = T_2 if backward is None else backward
    return Stream(-W, np.where(ahead, T_1, into_1)), Stream(W, np.where(ahead, into_2, T_2))


def filling(p: Any, T: Any, V: Any, gas: Gas, streams: Sequence[Stream]) -> tuple[Any, Any]:
    """(dp/dt [Pa/s], dT/dt [K/s]) of a volume V [m3] into which `streams` flow and that loses no heat.

    With m = p V/(R T): dp/dt = (gamma R/V) sum(W T), dT/dt = (gamma sum(W T) - T sum(W))/m. For one stream in and one
    out it is [R] dm/dt = W_in - W_out, dT/dt = (W_in cv (T_in - T) + R (T_in W_in - T W_out))/(m cv).
    """
    mass, energy = sum(W for W, _ in streams), sum(W * T for W, T in streams)
    return gas.gamma * gas.R / V * energy, gas.R * T / (p * V) * (gas.gamma * energy - T * mass)
