"""A cylinder: slider-crank, valves, burning after Wiebe, wall loss after Hohenberg.

Angles count from firing top dead centre.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from fmus.component import Signal
from fmus.model import Values
from fmus.working_cycle.mixture import AF_STOICHIOMETRIC, Gas

CYCLE = 4.0 * np.pi  # rad
_DEGREE = np.pi / 180.0


def constant(name: str, unit: str, value: float, description: str, minimum: float = 0.0) -> Signal:
    """A parameter with its source in the description."""
    return Signal(name, unit, value, description, nominal=abs(value) or 1.0, minimum=minimum)


PARAMETERS = (
    # Geometry of a 2.0 L engine with four cylinders, that of Volkswagen's EA888.
    constant("bore", "m", 82.5e-3, "cylinder, bore [R]"),
    constant("stroke", "m", 92.8e-3, "cylinder, stroke [R]"),
    constant("rod", "m", 144e-3, "connecting rod, length [R]"),
    constant("r_c", "1", 9.6, "cylinder, compression ratio [R]", 1.0),
    # Valves: two of each kind.
    constant("D_iv", "m", 34e-3, "intake valve, diameter [R]"),
    constant("D_ev", "m", 28e-3, "exhaust valve, diameter [R]"),
    constant("L_iv", "m", 10e-3, "intake valve, lift [R]"),
    constant("L_ev", "m", 10e-3, "exhaust valve, lift [R]"),
    constant("C_iv", "1", 0.65, "intake valve, discharge coefficient, Heywood 6.3.2 [R]"),
    constant("C_ev", "1", 0.65, "exhaust valve, discharge coefficient, Heywood 6.3.2 [R]"),
    constant("ivo", "deg", 350.0, "intake valve opens, after firing top dead centre, Heywood 6.3.1 [R]", -720.0),
    constant("ivc", "deg", 590.0, "intake valve closes [R]", -720.0),
    constant("evo", "deg", 130.0, "exhaust valve opens [R]", -720.0),
    constant("evc", "deg", 370.0, "exhaust valve closes [R]", -720.0),
    constant("near", "1", 0.005, "orifices, relative pressure drop below which the flow becomes linear [I]"),
    # Burning.
    constant("q_lhv", "J/kg", 44e6, "fuel, heating value, Heywood Table D.4 [R]"),
    constant("eta_b", "1", 0.96, "burning, completeness at lambda 1, Heywood 3.5.4 [R]"),
    constant("burn_0", "deg", -20.0, "burning, start, for half burnt at 8 deg after top dead centre [I]", -180.0),
    constant("burn_d", "deg", 60.0, "burning, 0 to 99.9 %: 27 deg from 10 to 90 %, Heywood 9.2.2 [R]"),
    constant("burn_a", "1", 6.908, "burning, Wiebe's a: 99.9 % burnt at the end [I]"),
    constant("burn_m", "1", 2.0, "burning, Wiebe's m, Heywood 9.2.2 [R]"),
    # Wall loss.
    constant("T_wall", "K", 450.0, "cylinder, mean temperature of the walls, Heywood 12.7 [R]"),
    constant("h_1", "1", 130.0, "wall loss, Hohenberg's C_1, in his units [R]"),
    constant("h_2", "m/s", 1.4, "wall loss, Hohenberg's C_2 [R]"),
)


class Space(NamedTuple):
    """The space above the piston: volume [m3], dV/dphi [m3/rad], wall area [m2]."""

    V: Any
    slope: Any
    area: Any


def space(phi: Any, p: Values) -> Space:
    """The space at the crank angle phi [rad] after firing top dead centre.

    V = V_c + A s,  s = r + l - r cos(phi) - sqrt(l^2 - r^2 sin^2(phi)),  V_c = 2 r A/(r_c - 1)
    area = 2 A + pi B (s + V_c/A): crown, head and liner  (Heywood 2.2)
    """
    r, A = 0.5 * p.stroke, 0.25 * np.pi * p.bore**2
    clearance = 2.0 * r / (p.r_c - 1.0)
    sine, cosine = np.sin(phi), np.cos(phi)
    reach = np.sqrt(p.rod**2 - r * r * sine * sine)
    s = r + p.rod - r * cosine - reach
    slope = r * sine * (1.0 + r * cosine / reach)
    return Space(A * (clearance + s), A * slope, 2.0 * A + np.pi * p.bore * (s + clearance))


def valve_area(phi: Any, opens: Any, closes: Any, lift: Any, diameter: Any, discharge: Any) -> Any:
    """Effective area [m2] of two valves: lift L sin^2 over the opening; curtain pi D L and port pi D^2/4 in series.

    A = 2 C pi D L/sqrt(1 + (4 L/D)^2); phi [rad] within the cycle, `opens` and `closes` [deg].
    """
    share = np.clip((phi - opens * _DEGREE) / ((closes - opens) * _DEGREE), 0.0, 1.0)
    L = lift * np.sin(np.pi * share) ** 2
    return 2.0 * discharge * np.pi * diameter * L / np.sqrt(1.0 + (4.0 * L / diameter) ** 2)


class Burning(NamedTuple):
    """Rates of burning: fuel and burnt gas that come into being [kg/s], and heat set free [W]."""

    fuel: Any
    burnt: Any
    heat: Any


def burning(phi: Any, omega: Any, air: Any, richness: Any, p: Values) -> Burning:
    """What burns of `air` [kg], the unburnt mass in the cylinder, at phi [rad] in (-2 pi, 2 pi]; `richness` is lambda.

    x = 1 - exp(-a y^(m+1)), y = (phi - phi_0)/d  is the burnt share of what is going to burn (Heywood eq. 9.30).
    With b = max(lambda, 1) of the air that was there, m_0 (1 - x/b) is left, so what burns is
    dair/dt = -m_0/b omega dx/dphi = -omega air (1 - x) k/(b - x),  k = a (m+1) y^m/d: no m_0 to be remembered.
    Fuel comes into being as it burns: air over AF_s, and 1/lambda of that where lambda < 1.
    All of it and the air become burnt gas; only what has air gives heat, eta_b q_lhv.
    """
    share = (phi - p.burn_0 * _DEGREE) / (p.burn_d * _DEGREE)
    y = np.clip(share, 1e-6, 1.0)  # a power of zero has no derivative with respect to its exponent
    left = np.exp(-p.burn_a * y ** (p.burn_m + 1.0))
    burns = np.logical_and(share > 0.0, share < 1.0)
    hazard = np.where(burns, p.burn_a * (p.burn_m + 1.0) * y**p.burn_m / (p.burn_d * _DEGREE), 0.0)
    rate = omega * air * hazard * left / (np.maximum(richness, 1.0) - 1.0 + left)
    fuel = rate / (AF_STOICHIOMETRIC * np.minimum(richness, 1.0))
    return Burning(fuel, rate + fuel, p.eta_b * p.q_lhv * rate / AF_STOICHIOMETRIC)


def wall_loss(gas: Gas, inside: Space, omega: Any, p: Values) -> Any:
    """Heat to the walls [W] after Hohenberg: h = 130 V^-0.06 (p/bar)^0.8 T^-0.4 (c_m + 1.4)^0.8 in W/m2/K.

    c_m [m/s] is the mean piston speed. Source: Hohenberg, SAE 790825, 1979.
    """
    c_m = p.stroke * omega / np.pi
    grown = -0.06 * np.log(inside.V) + 0.8 * np.log(1e-5 * gas.p * (c_m + p.h_2)) - 0.4 * np.log(gas.T)
    return p.h_1 * np.exp(grown) * inside.area * (gas.T - p.T_wall)


class Cylinder(NamedTuple):
    """What a cylinder does at an instant: valve areas [m2], burning, power to the piston and heat to the walls [W]."""

    intake: Any
    exhaust: Any
    burning: Burning
    work: Any
    loss: Any


def cylinder(phi: Any, omega: Any, gas: Gas, mass: Any, burnt: Any, richness: Any, p: Values) -> Cylinder:
    """A cylinder at phi [rad] in [0, 4 pi) after its firing top dead centre, with `mass` and `burnt` [kg] in it."""
    inside = space(phi, p)
    centred = np.where(phi > 2.0 * np.pi, phi - CYCLE, phi)
    return Cylinder(
        valve_area(phi, p.ivo, p.ivc, p.L_iv, p.D_iv, p.C_iv),
        valve_area(phi, p.evo, p.evc, p.L_ev, p.D_ev, p.C_ev),
        burning(centred, omega, mass - burnt, richness, p),
        gas.p * inside.slope * omega,
        wall_loss(gas, inside, omega, p),
    )
