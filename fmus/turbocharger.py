"""A turbocharger's compressor and turbine: flow, torque and the temperature of the gas that leaves.

Flows are in kg/s from side 1 to side 2 and negative the other way. All take floats and symbols alike.

Equations [R]: TCSISimTestbed (Ng, Frisk, Krysander, Eriksson, IEEE Control Systems Magazine 40(2), 2020). What holds
outside of their range is chosen here, [I] below. Work done on or by the gas is torque times speed at every speed.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from fmus.gas import Gas, signed_root

_NEWTON_STEPS = 10


class Wheel(NamedTuple):
    """Flow W [kg/s], temperature T_out [K] at which a forward flow leaves, torque [N.m] on the gas or from it."""

    W: Any
    T_out: Any
    torque: Any


def compressor(p_1: Any, T_1: Any, p_2: Any, T_2: Any, omega: Any, gas: Gas, p: Any) -> Wheel:
    """The compressor at omega [rad/s] between side 1 and side 2, p [Pa], T [K]; its torque brakes the shaft.

    N = omega/2pi, PI = p_2/p_1, Psi = cp T_1 (PI^((gamma-1)/gamma) - 1)/(N D)^2,
    Phi = Phi_max sqrt(1 - (Psi/Psi_max)^2), W = Phi p_1 N D^3/(R T_1),
    eta = eta_max Phi (2 Phi_0 - Phi)/Phi_0^2, not below eta_min, T_out = T_1 (1 + (PI^((gamma-1)/gamma) - 1)/eta).

    `p` has D_c, Psi_max, Phi_max, Phi_0, eta_c_max, eta_c_min, v_lin, omega_min. With U = N D, the head h = Psi U^2 and
    the flow velocity v = U Phi/Phi_max the map is v^2 = U^2 - h^2/(Psi_max U)^2. [I] Beyond its two ends the flow goes
    on as through an orifice, v^2 straight in h, joined with the same slope: backwards for h > Psi_max U^2, there v|v| =
    2 (U^2 - h/Psi_max), and faster than Phi_max for h < 0. There no work is done. The root is linear below v_lin [m/s];
    below omega_min [rad/s] map and torque are those of omega_min.
    """
    U = p.D_c / (2.0 * np.pi) * np.maximum(omega, p.omega_min)
    head = gas.cp * T_1 * ((p_2 / p_1) ** ((gas.gamma - 1.0) / gas.gamma) - 1.0)
    most = p.Psi_max * U**2
    worked, driven = np.clip(head, 0.0, most), np.maximum(-head, 0.0)
    within = U**2 - (worked / (p.Psi_max * U)) ** 2
    backwards = 2.0 * np.minimum(U**2 - head / p.Psi_max, 0.0)
    faster = driven**2 / (p.Psi_max * (driven + most))
    v = signed_root(within + backwards + faster, p.v_lin**2)
    W = p.Phi_max * p.D_c**2 * v * np.where(v >= 0.0, p_1 / (gas.R * T_1), p_2 / (gas.R * T_2))
    Phi = p.Phi_max * v / U
    eta = np.maximum(p.eta_c_max * Phi * (2.0 * p.Phi_0 - Phi) / p.Phi_0**2, p.eta_c_min)
    torque_per_flow = worked / eta / np.maximum(omega, p.omega_min)
    return Wheel(W, T_1 + torque_per_flow * omega / gas.cp, np.maximum(W, 0.0) * torque_per_flow)


def turbine(p_1: Any, T_1: Any, p_2: Any, T_2: Any, omega: Any, gas: Gas, p: Any) -> Wheel:
    """The turbine at omega [rad/s] between side 1 and side 2, p [Pa], T [K]; its torque drives the shaft.

    PI = p_2/p_1, W = k_1 p_1 [kPa]/sqrt(T_1) sqrt(1 - PI^k_2),
    BSR = (D/2) omega/sqrt(2 cp T_1 (1 - PI^((gamma-1)/gamma))),
    eta = eta_max (1 - ((BSR - B_0)/B_0)^2), not below eta_min,
    T_out = T_1 (1 - eta (1 - PI^((gamma-1)/gamma))).

    `p` has k_1, k_2, D_t, B_0, eta_t_max, eta_t_min, PI_lin, omega_min. [I] The root is linear from PI_lin to 1; a flow
    backwards follows the same equation and does no work; below omega_min [rad/s] the torque is that of omega_min.
    """
    W = turbine_flow(p_1, T_1, p_2, T_2, p)
    drop = gas.cp * T_1 * (1.0 - np.minimum(p_2 / p_1, 1.0) ** ((gas.gamma - 1.0) / gas.gamma))
    # Of a gas slower than 1 m/s the efficiency is at its floor in any case.
    BSR = 0.5 * p.D_t * omega / np.sqrt(np.maximum(2.0 * drop, 1.0))
    eta = np.maximum(p.eta_t_max * (1.0 - ((BSR - p.B_0) / p.B_0) ** 2), p.eta_t_min)
    torque_per_flow = eta * drop / np.maximum(omega, p.omega_min)
    return Wheel(W, T_1 - torque_per_flow * omega / gas.cp, np.maximum(W, 0.0) * torque_per_flow)


def turbine_flow(p_1: Any, T_1: Any, p_2: Any, T_2: Any, p: Any) -> Any:
    """The turbine's flow W [kg/s] alone, as in `turbine`; `p` has k_1, k_2, PI_lin."""
    forward = p_1 >= p_2
    p_u, T_u = np.where(forward, p_1, p_2), np.where(forward, T_1, T_2)
    PI = np.where(forward, p_2, p_1) / p_u
    flow = p.k_1 * 1e-3 * p_u / np.sqrt(T_u) * signed_root(1.0 - PI**p.k_2, 1.0 - p.PI_lin**p.k_2)
    return np.where(forward, flow, -flow)


def turbine_pressure(W: Any, T_1: Any, p_2: Any, p: Any) -> Any:
    """The pressure p_1 [Pa] at which `turbine_flow` is W [kg/s], not below zero: its inverse, for 1 <= k_2 <= 2.

    With q = W sqrt(T_1)/(1e-3 k_1) and s = 1 - (p_2/p_1)^k_2, q = p_1 sqrt(s), and where the root is a line,
    q = p_1 s/sqrt(s_lin). The first, squared, is convex in p_1 and begun above its root, the second concave and begun
    below: Newton's method goes to both without overshooting, in ten steps to rounding.
    """
    k, width = p.k_2, 1.0 - p.PI_lin**p.k_2
    q = W * np.sqrt(T_1) / (1e-3 * p.k_1 * p_2)
    root, line = 0.5 + np.sqrt(0.25 + q**2), 1.0
    for _ in range(_NEWTON_STEPS):
        root = root - (root**2 - root ** (2.0 - k) - q**2) / (2.0 * root - (2.0 - k) * root ** (1.0 - k))
        line = line - (line - line ** (1.0 - k) - np.sqrt(width) * q) / (1.0 - (1.0 - k) * line ** (-k))
    return p_2 * np.where(q < np.sqrt(width) / p.PI_lin, line, root)
