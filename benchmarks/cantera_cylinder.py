"""The cylinder of `single_cylinder` as a reactor of Cantera, under the same laws.

What Cantera brings is its own: thermodynamics of each species (NASA polynomials of GRI-Mech 3.0), the balances of a
reactor, and CVODES with error control. The laws given to it are written again here, from the same sources.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import cantera as ct
import numpy as np
from numpy.typing import NDArray

AIR = {"O2": 0.2095, "N2": 0.7812, "AR": 0.0093}
HYDROGEN = 1.87  # of the fuel CH1.87
MOTORED = 1e12  # lambda without fuel
_DEGREE = np.pi / 180.0


class Trace(NamedTuple):
    """Crank angle [rad], pressure [Pa], temperature [K], mass [kg], work and heat to the walls [J], each (rows,)."""

    theta: NDArray[np.float64]
    p: NDArray[np.float64]
    T: NDArray[np.float64]
    mass: NDArray[np.float64]
    work: NDArray[np.float64]
    lost: NDArray[np.float64]


class Gases(NamedTuple):
    """Species of air and of what a stoichiometric fire leaves, and mass fractions of both."""

    phase: ct.Solution
    air: NDArray[np.float64]
    burnt: NDArray[np.float64]
    fuel_mass: float  # kg/kmol
    oxygen: float  # kg of O2 over kg of fuel


def gases() -> Gases:
    """The phase of the five species, without reactions."""
    ct.suppress_thermo_warnings()
    wanted = ("O2", "N2", "AR", "CO2", "H2O")
    species = [one for one in ct.Species.list_from_file("gri30.yaml") if one.name in wanted]
    phase = ct.Solution(thermo="ideal-gas", species=species)
    oxygen = 1.0 + 0.25 * HYDROGEN
    air = oxygen / AIR["O2"]
    left = {"CO2": 1.0, "H2O": 0.5 * HYDROGEN, "N2": air * AIR["N2"], "AR": air * AIR["AR"]}
    fractions = []
    for composition in (AIR, left):
        phase.TPX = 300.0, 1e5, composition
        fractions.append(phase.Y.copy())
    mass = phase.atomic_weight("C") + HYDROGEN * phase.atomic_weight("H")
    oxygen_mass = phase.molecular_weights[phase.species_index("O2")]
    return Gases(phase, fractions[0], fractions[1], mass, oxygen * oxygen_mass / mass)


def space(theta: float, p: Mapping[str, float]) -> tuple[float, float, float]:
    """Volume [m3], its slope [m3/rad] and the walls' area [m2] at an angle [rad] after top dead centre."""
    A, r = np.pi * p["bore"] ** 2 / 4.0, p["stroke"] / 2.0
    height = 2.0 * r / (p["r_c"] - 1.0)
    beta = np.arcsin(r / p["rod"] * np.sin(theta))
    s = r * (1.0 - np.cos(theta)) + p["rod"] * (1.0 - np.cos(beta))
    slope = r * np.sin(theta + beta) / np.cos(beta)
    return A * (height + s), A * slope, 2.0 * A + np.pi * p["bore"] * (height + s)


class CylinderReactor(ct.ExtensibleReactor):
    """A reactor of Cantera to whose balances the laws of the cylinder are added.

    The states of ct.Reactor are mass, volume, internal energy with that of formation, and mass fractions.
    """

    def obey(self, known: Gases, parameters: Mapping[str, float], inputs: Mapping[str, float]) -> None:
        """Take the laws' parameters and inputs, those of `single_cylinder`; Cantera's constructor takes none."""
        self.known, self.p, self.u = known, parameters, inputs
        self.omega = inputs["N"] * np.pi / 30.0
        phase = known.phase
        names = phase.species_names
        self.oxygen = names.index("O2")
        grams = phase.molecular_weights / known.fuel_mass
        self.products = {"CO2": grams[names.index("CO2")], "H2O": 0.5 * HYDROGEN * grams[names.index("H2O")]}
        phase.TPY = 298.15, 1e5, known.air
        h = phase.partial_molar_enthalpies
        formed = h[names.index("CO2")] + 0.5 * HYDROGEN * h[names.index("H2O")]
        # The fuel's enthalpy at 298.15 K is such that burning it gives what is given off.
        self.fuel_enthalpy = formed / known.fuel_mass + parameters["eta_b"] * parameters["q_lhv"]
        self.outside = [self._outside(*(inputs[f"{name}_{end}"] for name in "pTF")) for end in ("in", "ex")]

    def _outside(self, p: float, T: float, F: float) -> tuple[float, float, float, float, NDArray[np.float64], float]:
        phase = self.known.phase
        Y = (1.0 - F) * self.known.air + F * self.known.burnt
        phase.TPY = T, p, Y
        R = ct.gas_constant / phase.mean_molecular_weight
        return p, T, R, phase.cp / phase.cv, Y, phase.enthalpy_mass

    def after_eval(self, t: float, LHS: Any, RHS: Any) -> None:
        """Add piston, valves, fire and walls."""
        p, phase = self.p, self.known.phase
        theta = -np.pi + self.omega * t
        _, slope, area = space(theta, p)
        pressure, T, mass, Y = phase.P, phase.T, self.mass, phase.Y
        gamma, R, h = phase.cp / phase.cv, ct.gas_constant / phase.mean_molecular_weight, phase.enthalpy_mass
        speed = p["stroke"] * self.omega / np.pi
        loss = 130.0 * (self.volume**-0.06) * (1e-5 * pressure) ** 0.8 * T**-0.4 * (speed + 1.4) ** 0.8
        loss *= area * (T - p["T_wall"])
        power = -pressure * slope * self.omega - loss
        source = np.zeros(phase.n_species)
        phi = theta % (4.0 * np.pi)
        for outside, letter in zip(self.outside, "ie", strict=True):
            kind = f"{letter}v"
            share = (phi / _DEGREE - p[f"{kind}o"]) / (p[f"{kind}c"] - p[f"{kind}o"])
            if not 0.0 < share < 1.0:
                continue
            lift = p[f"L_{kind}"] * np.sin(np.pi * share) ** 2
            curtain, port = np.pi * p[f"D_{kind}"] * lift, np.pi * p[f"D_{kind}"] ** 2 / 4.0
            effective = 2.0 * p[f"C_{kind}"] * curtain * port / np.hypot(curtain, port)
            if outside[0] >= pressure:
                W = effective * _discharge(*outside[:4], pressure)
                source += W * outside[4]
                power += W * outside[5]
            else:
                W = effective * _discharge(pressure, T, R, gamma, outside[0])
                source -= W * Y
                power -= W * h
        fuel = self._fuel(theta, mass * Y[self.oxygen] / self.known.air[self.oxygen])
        source[self.oxygen] -= fuel * self.known.oxygen
        for name, made in self.products.items():
            source[phase.species_index(name)] += fuel * made
        power += fuel * self.fuel_enthalpy
        gained = float(source.sum())
        RHS[0] += gained
        RHS[1] += slope * self.omega
        RHS[2] += power
        LHS[3:] = mass
        RHS[3:] += source - Y * gained

    def _fuel(self, theta: float, air: float) -> float:
        p, richness = self.p, self.u["lambda"]
        y = ((theta + 2.0 * np.pi) % (4.0 * np.pi) - 2.0 * np.pi - p["burn_0"] * _DEGREE) / (p["burn_d"] * _DEGREE)
        if richness >= MOTORED or not 0.0 < y < 1.0:
            return 0.0
        # At lambda 1 and above: the burning air over what is left of it, after Wiebe.
        left = np.exp(-p["burn_a"] * y ** (p["burn_m"] + 1.0))
        rate = p["burn_a"] * (p["burn_m"] + 1.0) * y ** p["burn_m"] * left / (p["burn_d"] * _DEGREE)
        air_per_fuel = self.known.oxygen / self.known.air[self.oxygen]
        return float(self.omega * air * rate / (richness - 1.0 + left) / air_per_fuel)


def _discharge(p: float, T: float, R: float, gamma: float, behind: float) -> float:
    """The isentropic flow through 1 m2 [kg/s], not smoothed."""
    ratio = max(behind / p, (2.0 / (gamma + 1.0)) ** (gamma / (gamma - 1.0)))
    drop = ratio ** (2.0 / gamma) - ratio ** ((gamma + 1.0) / gamma)
    return float(p / np.sqrt(R * T) * np.sqrt(2.0 * gamma / (gamma - 1.0) * max(drop, 0.0)))


def trace(
    parameters: Mapping[str, float],
    inputs: Mapping[str, float],
    start: Mapping[str, float],
    degrees: NDArray[np.float64],
) -> Trace:
    """The cylinder under the laws of `single_cylinder` from `start` (p, T, F) at -180 deg, at angles [deg]."""
    known = gases()
    reactor = CylinderReactor(known.phase, clone=False)
    reactor.obey(known, parameters, inputs)
    phase = known.phase
    phase.TPY = start["T"], start["p"], (1.0 - start["F"]) * known.air + start["F"] * known.burnt
    reactor.syncState()
    reactor.volume = space(-np.pi, parameters)[0]
    network = ct.ReactorNet([reactor])
    network.rtol, network.atol = 1e-8, 1e-14
    network.max_time_step = 0.5 * _DEGREE / reactor.omega
    rows = []
    for degree in degrees:
        instant = (degree + 180.0) * _DEGREE / reactor.omega
        if instant > network.time:
            network.advance(instant)
        rows.append((degree * _DEGREE, phase.P, phase.T, reactor.mass))
    theta, p, T, mass = np.array(rows).T
    volumes = np.array([space(angle, parameters) for angle in theta])
    speed = parameters["stroke"] * reactor.omega / np.pi
    h = 130.0 * volumes[:, 0] ** -0.06 * (1e-5 * p) ** 0.8 * T**-0.4 * (speed + 1.4) ** 0.8
    loss = h * volumes[:, 2] * (T - parameters["T_wall"]) / reactor.omega
    return Trace(theta, p, T, mass, _grown(theta, p * volumes[:, 1]), _grown(theta, loss))


def _grown(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.concatenate([[0.0], np.cumsum(0.5 * np.diff(x) * (y[1:] + y[:-1]))])
