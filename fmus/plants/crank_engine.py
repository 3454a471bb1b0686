"""A four-cylinder engine resolved in crank angle on a dynamometer: what each cylinder's pressure does to the crank.

Source: Chauvin, Petit, Rouchon, Corde, Periodic input observer design, application for imbalance diagnosis, SAE 2006,
which shows a test bench and has no equations of its engine. These are textbook ones; `fmus.crank_mechanism`,
`fmus.cylinder` and `fmus.gas` have them and their sources.

    crank      J(theta) omega' = torque_gas - torque_friction - torque_load - J'(theta) omega^2/2, theta' = omega
    gas        torque_gas = sum (p_i - p_case) A dx_i/dtheta
    friction   torque_friction = (fmep_0 + fmep_1 N + fmep_2 N^2) V_d/4pi, against the motion
    brake      torque_load = hold + dyno_p (omega - speed_demand), hold' = dyno_i (omega - speed_demand)
    cylinder i U' = -p V' + Q_burn - Q_wall + sum W cp T, m' = sum W, p = (gamma - 1) U/V, T = p V/(m R)
    burning    Q_burn = q_lhv burn_i dx_b/dphi omega, x_b Wiebe's
    walls      Q_wall = wall h A (T - T_wall), h Hohenberg's, A of piston, head and the liner that is bare
    valves     isentropic flows from the port at p_im (1 + fill_i), T_im and to the port at p_em, and back

A cycle has 720 deg. phi is the crank angle from the cylinder's firing top dead centre, theta that from the first
cylinder's, counted on; the firing order is 1-3-4-2. Three times a cycle something happens in a cylinder at once:

    phi = inject   m_f_i (1 + offset_i + injector_i) is read and enters; burn_i = what of all fuel there finds air
    phi = EVO      the charge is looked at: afr_i of it, m_exh_i that will leave
    phi = 360 deg  the cycle ends: imep_i = integral p dV/(A stroke) over its 720 deg

Fuel enters with no energy but its heating value: U stays, the gas cools. Fuel, burnt or not, is followed through
residual gas: fuel_i of the mass m_i, burnt_i of that; air is m_i - fuel_i, of which each kg of fuel burnt takes AF_s.
m_exh_i is the mass at EVO less the mass that stayed behind in the cycle before; over cycles nothing is lost. What flows
back from the exhaust port is what left last. The fuel in what flows back into the intake is mixed with m_port of air
and returns with it, at T_im.

Parameters and signals are in `fmus.plants.crank_engine_signals`. The default is the paper's 2.2 L HCCI Diesel engine;
set `si` a 1.8 L spark-ignited one with direct injection; set `imbalanced` the first with injectors and ports that
differ a little. The engine starts in the periodic state of the default set at 1500 rpm and 8 bar [C].
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from fmus.crank_mechanism import PistonMotion, crank_inertia, piston_motion
from fmus.cylinder import hohenberg, valve_opening, wiebe
from fmus.gas import Gas, Stream, between, isentropic_flow
from fmus.model import Model, Values
from fmus.plants.crank_engine_signals import (
    CYLINDERS,
    DISCRETE,
    FIRING_ORDER,
    INJECTION,
    INPUTS,
    OUTPUTS,
    PARAMETER_SETS,
    PARAMETERS,
    STATES,
)

CYCLE = 4.0 * np.pi  # rad
DEG = np.pi / 180.0
RPM = 30.0 / np.pi
TINY = 1e-12  # of a share of fuel: none
# Firing top dead centre of each cylinder, theta in rad.
FIRING = {cylinder: k * np.pi for k, cylinder in enumerate(FIRING_ORDER)}


class Cylinder(NamedTuple):
    """A cylinder at an instant: piston, p [Pa], T [K], heat to the walls [W] and what flows in through its valves.

    `burning` is dburnt/dt [kg/s]; a flow out of the cylinder is negative.
    """

    piston: PistonMotion
    p: Any
    T: Any
    burning: Any
    Q_wall: Any
    intake: Stream
    exhaust: Stream


def piston_area(p: Any) -> Any:
    """Area of a piston [m2]."""
    return 0.25 * np.pi * p.bore**2


def displacement(p: Any) -> Any:
    """Volume that a piston sweeps [m3]."""
    return piston_area(p) * p.stroke


def _piston(i: int, theta: Any, p: Any) -> PistonMotion:
    return piston_motion(theta - FIRING[i], 0.5 * p.stroke, p.rod_ratio)


def cylinder_volume(i: int, theta: Any, p: Any) -> Any:
    """Volume [m3] of cylinder i at the crank angle theta [rad]: V_d/(compression - 1) + A x."""
    return displacement(p) / (p.compression - 1.0) + piston_area(p) * _piston(i, theta, p).travel


def _cylinder(i: int, x: Values, m: Values, p: Values) -> Cylinder:
    gas = Gas(p.gamma, p.R)
    phi = x.theta - FIRING[i]
    piston, V = _piston(i, x.theta, p), cylinder_volume(i, x.theta, p)
    pressure = (p.gamma - 1.0) * x[f"U_{i}"] / V
    T = pressure * V / (x[f"m_{i}"] * p.R)

    speed = np.abs(x.omega_e)
    angle = phi - CYCLE * m[f"cycle_{i}"]
    _, burnt_slope = wiebe(angle, p.burn_start * DEG, p.burn_duration * DEG, p.wiebe_a, p.wiebe_m)
    walls = np.pi * p.bore * V / piston_area(p) + 2.0 * piston_area(p)
    Q_wall = p.wall * hohenberg(pressure, T, V, p.stroke * speed / np.pi) * walls * (T - p.T_wall)

    p_port = p.p_im * (1.0 + p[f"fill_{i}"])
    area = p.A_int * valve_opening(phi, p.IVO * DEG, p.IVC * DEG)
    W = isentropic_flow(p_port, p.T_im, pressure, T, area, gas, p.PI_lin)
    intake = between(W, p_port >= pressure, p.T_im, T)[1]
    area, T_port = p.A_exh * valve_opening(phi, p.EVO * DEG, p.EVC * DEG), m[f"T_port_{i}"]
    W = isentropic_flow(pressure, T, p.p_em, T_port, area, gas, p.PI_lin)
    exhaust = between(W, pressure >= p.p_em, T, T_port)[0]
    return Cylinder(piston, pressure, T, m[f"burn_{i}"] * burnt_slope * x.omega_e, Q_wall, intake, exhaust)


def _equations(t: Any, x: Values, m: Values, u: Values, p: Values) -> tuple[dict[str, Any], dict[str, Any]]:
    cylinders = {i: _cylinder(i, x, m, p) for i in CYLINDERS}
    dx: dict[str, Any] = {"theta": x.omega_e}
    y: dict[str, Any] = {}
    cp = Gas(p.gamma, p.R).cp
    for i, one in cylinders.items():
        power = one.p * piston_area(p) * one.piston.slope * x.omega_e
        H_int, H_exh = (cp * flow.W * flow.T for flow in (one.intake, one.exhaust))
        Q_burn = p.q_lhv * one.burning
        dx[f"U_{i}"] = Q_burn - one.Q_wall - power + H_int + H_exh
        dx[f"m_{i}"] = one.intake.W + one.exhaust.W
        fuel, burnt = _carried(i, one, x, m, p)
        dx |= {f"fuel_{i}": sum(fuel), f"burnt_{i}": one.burning + sum(burnt), f"port_{i}": -fuel[0]}
        dx |= {f"work_{i}": power, f"gone_{i}": -one.exhaust.W, f"gone_heat_{i}": -H_exh}
        y |= {f"p_{i}": one.p, f"T_{i}": one.T, f"Q_burn_{i}": Q_burn, f"Q_wall_{i}": one.Q_wall}
        y |= {f"W_int_{i}": one.intake.W, f"W_exh_{i}": -one.exhaust.W, f"H_int_{i}": H_int, f"H_exh_{i}": -H_exh}
        air = 1.0 - m[f"share_{i}"]
        y[f"afr_{i}"] = air / np.maximum(m[f"share_{i}"], air / p.afr_most)
    mixed = sum(m[f"m_exh_{i}"] for i in CYLINDERS)
    y["T_exh"] = sum(m[f"m_exh_{i}"] * m[f"T_port_{i}"] for i in CYLINDERS) / mixed

    J, slope = crank_inertia(p.J_0, p.m_rec, [one.piston for one in cylinders.values()])
    y["torque_gas"] = piston_area(p) * sum((one.p - p.p_case) * one.piston.slope for one in cylinders.values())
    y["torque_friction"] = _friction(x.omega_e, p)
    ahead = x.omega_e - u.speed_demand
    y["torque_load"] = x.hold + p.dyno_p * ahead
    torque = y["torque_gas"] - y["torque_friction"] - y["torque_load"]
    dx["omega_e"] = (torque - 0.5 * slope * x.omega_e**2) / J
    dx["hold"] = p.dyno_i * ahead
    return dx, y


def _carried(i: int, one: Cylinder, x: Values, m: Values, p: Values) -> tuple[list[Any], list[Any]]:
    """Fuel, and fuel that is burnt, that the intake and the exhaust carry into cylinder i [kg/s]."""
    share = m[f"share_{i}"]
    # Of what comes back so much is burnt as its air went for.
    burnt = np.minimum(1.0, (1.0 - share) / np.maximum(p.AF_s * share, TINY))
    outside = (x[f"port_{i}"] / p.m_port, share)
    fuel, fuel_burnt = [], []
    for flow, behind in zip((one.intake, one.exhaust), outside, strict=True):
        out = flow.W < 0.0
        fuel.append(flow.W * np.where(out, x[f"fuel_{i}"] / x[f"m_{i}"], behind))
        fuel_burnt.append(flow.W * np.where(out, x[f"burnt_{i}"] / x[f"m_{i}"], burnt * behind))
    return fuel, fuel_burnt


def _friction(omega: Any, p: Values) -> Any:
    """Torque of friction [N.m] at omega [rad/s]; within 1 rad/s of rest [I] it turns round with the motion."""
    N = RPM * np.abs(omega)
    mean = p.fmep_0 + p.fmep_1 * N + p.fmep_2 * N**2
    return mean * len(CYLINDERS) * displacement(p) / CYCLE * omega / np.sqrt(omega**2 + 1.0)


def _indicators(t: Any, x: Values, m: Values, u: Values, p: Values) -> dict[str, Any]:
    """How far each cylinder is past the next of its three angles [rad]."""
    found = {}
    for i in CYLINDERS:
        stage = m[f"stage_{i}"]
        angle = np.where(stage < 0.5, p.inject * DEG, np.where(stage < 1.5, p.EVO * DEG, 0.5 * CYCLE))
        found[f"due_{i}"] = x.theta - FIRING[i] - CYCLE * m[f"cycle_{i}"] - angle
    return found


def _transition(t: Any, x: Values, m: Values, u: Values, p: Values, above: Values) -> dict[str, Any]:
    cp = Gas(p.gamma, p.R).cp
    after: dict[str, Any] = {}
    for i in CYLINDERS:
        stage, due = m[f"stage_{i}"], above[f"due_{i}"] > 0.5
        injects = np.logical_and(due, stage < 0.5)
        opens = np.logical_and(due, np.logical_and(stage > 0.5, stage < 1.5))
        ends = np.logical_and(due, stage > 1.5)
        after[f"stage_{i}"] = np.where(ends, INJECTION, np.where(due, stage + 1.0, stage))
        after[f"cycle_{i}"] = m[f"cycle_{i}"] + np.where(ends, 1.0, 0.0)

        mass, fuel, burnt, gone = (x[f"{name}_{i}"] for name in ("m", "fuel", "burnt", "gone"))
        injected = u[f"m_f_{i}"] * np.maximum(1.0 + u[f"offset_{i}"] + p[f"injector_{i}"], 0.0)
        with_air = np.minimum(fuel + injected, (mass - fuel) / p.AF_s)
        after[f"m_{i}"] = np.where(injects, mass + injected, mass)
        after[f"fuel_{i}"] = np.where(injects, fuel + injected, fuel)
        after[f"burn_{i}"] = np.where(injects, np.maximum(with_air - burnt, 0.0), m[f"burn_{i}"])
        # The exhaust valves have shut since: what left is known.
        left = np.logical_and(injects, gone > 0.0)
        mean = x[f"gone_heat_{i}"] / (cp * np.where(gone > 0.0, gone, 1.0))
        after[f"T_port_{i}"] = np.where(left, mean, m[f"T_port_{i}"])

        stayed = m[f"m_open_{i}"] - gone
        after[f"m_exh_{i}"] = np.where(opens, mass - stayed, m[f"m_exh_{i}"])
        after[f"m_open_{i}"] = np.where(opens, mass, m[f"m_open_{i}"])
        after[f"share_{i}"] = np.where(opens, fuel / mass, m[f"share_{i}"])
        after |= {f"{name}_{i}": np.where(opens, 0.0, x[f"{name}_{i}"]) for name in ("gone", "gone_heat")}

        after[f"imep_{i}"] = np.where(ends, x[f"work_{i}"] / displacement(p), m[f"imep_{i}"])
        after[f"work_{i}"] = np.where(ends, 0.0, x[f"work_{i}"])
    return after


MODEL = Model(
    name="crank_engine",
    description="Four-cylinder engine resolved in crank angle, on a dynamometer (SAE 2006)",
    equations=_equations,
    inputs=INPUTS,
    states=STATES,
    outputs=OUTPUTS,
    parameters=PARAMETERS,
    discrete=DISCRETE,
    indicator_names=tuple(f"due_{i}" for i in CYLINDERS),
    indicators=_indicators,
    transition=_transition,
    parameter_sets=PARAMETER_SETS,
    solver_step=5e-5,
)
