"""Compressor, turbine and shaft of a turbocharger: characteristics in coefficients of head, flow and blade speed."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from fmus.component import Signal
from fmus.model import Values
from fmus.working_cycle.cylinder import constant
from fmus.working_cycle.mixture import Gas
from fmus.working_cycle.orifice import orifice

PARAMETERS: tuple[Signal, ...] = (
    constant("D_c", "m", 51e-3, "compressor, outer diameter, a wheel of the K03 and IS20 class [I]"),
    constant("psi_0", "1", 0.58, "compressor, head over tip speed squared without flow, Dixon and Hall ch. 7 [I]"),
    constant(
        "lambda_0", "1", 0.85, "compressor, work over tip speed squared without flow: slip, Dixon and Hall ch. 7 [I]"
    ),
    constant("lambda_1", "1", 0.25, "compressor, fall of the work to choking: blades swept back [I]"),
    constant("phi_c", "1", 0.38, "compressor, flow coefficient at which it chokes at low speed [I]"),
    constant("M_c", "1", 0.6, "compressor, tip Mach number from which the inducer chokes: 0.19 kg/s [I]"),
    constant("L_c", "1/m", 250.0, "compressor, length over area of the gas in it [I]"),
    constant("A_t", "m2", 5.5e-4, "turbine, effective area of each of two nozzles in series [I]"),
    constant("D_t", "m", 45e-3, "turbine, diameter [I]"),
    constant("eta_t", "1", 0.68, "turbine, best efficiency, Watson and Janota ch. 4 [I]"),
    constant("BSR_t", "1", 0.65, "turbine, blade speed ratio of the best efficiency, Watson and Janota ch. 4 [R]"),
    constant("J_tc", "kg.m2", 2.5e-5, "shaft, inertia [I]"),
    constant("f_tc", "N.m.s", 1e-6, "shaft, friction [I]"),
)
_AT_REST = 20.0  # m/s, tip speed below which the characteristics are those of a wheel that turns so fast


class Compressor(NamedTuple):
    """Pressure it would hold behind it [Pa], power it takes [W]."""

    p: Any
    power: Any


def shaft_speed(kinetic: Any, inertia: Any) -> Any:
    """omega [rad/s] of the kinetic energy J omega^2/2 [J], 1 mrad/s at rest, so that the root has a slope."""
    return np.sqrt(np.maximum(2.0 * kinetic / inertia, 1e-6))


def compressor(W: Any, inlet: Gas, omega: Any, p: Values) -> Compressor:
    """The compressor with W [kg/s] of the inlet's gas through it, at omega [rad/s].

    x = W/(rho A U phi),  phi = phi_c/sqrt(1 + (M/M_c)^2),  A = pi D^2/4,  U = omega D/2,  M = U/sqrt(gamma R T)
    head  = psi_0 U^2 (1 - x |x|^3): falls with the flow, and rises where it is driven back
    power = W U^2 (lambda_0 - lambda_1 x) forwards, none backwards
    p     = p_inlet (1 + head/(cp T))^(gamma/(gamma - 1))
    """
    U = np.sqrt((0.5 * p.D_c * omega) ** 2 + _AT_REST**2)
    phi = p.phi_c / np.sqrt(1.0 + U * U / (inlet.gamma * inlet.R * inlet.T * p.M_c**2))
    x = W * inlet.R * inlet.T / (inlet.p * 0.25 * np.pi * p.D_c**2 * U * phi)
    head = p.psi_0 * U * U * (1.0 - x * np.abs(x) ** 3)
    cp_T = inlet.gamma / (inlet.gamma - 1.0) * inlet.R * inlet.T
    held = inlet.p * np.maximum(1.0 + head / cp_T, 0.1) ** (inlet.gamma / (inlet.gamma - 1.0))
    power = np.maximum(W, 0.0) * U * U * (p.lambda_0 - p.lambda_1 * np.clip(x, 0.0, 1.0))
    return Compressor(held, power)


class Turbine(NamedTuple):
    """Flow [kg/s] and power it gives to the shaft [W]."""

    W: Any
    power: Any


def turbine(inlet: Gas, outlet: Gas, omega: Any, p: Values) -> Turbine:
    """The turbine between two gases at omega [rad/s]: two nozzles in series, and a parabola over the blade speed ratio.

    power = W eta_t (U C/B - U^2/(2 B^2)),  C = sqrt(2 cp T (1 - P^((gamma-1)/gamma))),  U = omega D/2
    which is eta W C^2/2 with eta = eta_t (1 - (U/C - B)^2/B^2); below U/(2 B) the wheel drives the gas.
    """
    W = orifice(inlet, outlet, p.A_t, p.near, stages=2)
    cp_T = inlet.gamma / (inlet.gamma - 1.0) * inlet.R * inlet.T
    ratio = np.minimum(outlet.p / inlet.p, 1.0)
    C = np.sqrt(2.0 * cp_T * (1.0 - ratio ** ((inlet.gamma - 1.0) / inlet.gamma)) + 1.0)
    U = 0.5 * p.D_t * omega / p.BSR_t
    return Turbine(W, np.maximum(W, 0.0) * p.eta_t * U * (C - 0.5 * U))
