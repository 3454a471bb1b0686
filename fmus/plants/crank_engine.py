"""A four-cylinder engine resolved in crank angle on a dynamometer: what each cylinder's pressure does to the crank.

Source: Chauvin, Petit, Rouchon, Corde, Periodic input observer design, application for imbalance diagnosis, SAE 2006,
which shows a test bench and has no equations of its engine. These are textbook ones; `fmus.crank_mechanism`,
`fmus.cylinder` and `fmus.gas` have them and their sources.

    crank      J(theta) omega' = torque_gas - torque_friction - torque_load - J'(theta) omega^2/2, theta' = omega
    gas        torque_gas = sum (p_i - p_case) A dx_i/dtheta
    friction   torque_friction = (fmep_0 + fmep_1 N + fmep_2 N^2) V_d/4pi, against the motion
    dynamometer torque_load = hold + dyno_p (omega - speed_demand), hold' = dyno_i (omega - speed_demand)
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
back from the exhaust port is what left last. What flows back into the intake is replaced by air.

Parameters: [R] read in a source, [C] computed, [I] chosen. The default is a 2.2 L HCCI Diesel engine [geometry R, the
paper's engine]; set `si` a 1.8 L spark-ignited one with direct injection; set `imbalanced` the first with injectors and
ports that differ a little. The engine starts in the periodic state of the default set, inputs as they start [C].
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from fmus.component import Signal
from fmus.crank_mechanism import PistonMotion, crank_inertia, piston_motion
from fmus.cylinder import hohenberg, valve_opening, wiebe
from fmus.gas import Gas, Stream, between, isentropic_flow
from fmus.model import Model, Values

CYLINDERS = (1, 2, 3, 4)
FIRING_ORDER = (1, 3, 4, 2)
CYCLE = 4.0 * np.pi  # rad
DEG = np.pi / 180.0
RPM = 30.0 / np.pi
# Firing top dead centre of each cylinder, theta in rad.
FIRING = {cylinder: k * np.pi for k, cylinder in enumerate(FIRING_ORDER)}
# What a cylinder waits for next: m.stage_i.
INJECTION, OPENING, EXCHANGE = 0, 1, 2


def _constant(name: str, unit: str, value: float, description: str, minimum: float = 0.0) -> Signal:
    return Signal(name, unit, value, description, nominal=abs(value) or 1.0, minimum=minimum)


def _angle(name: str, value: float, description: str, minimum: float, maximum: float) -> Signal:
    return Signal(name, "deg", value, description, nominal=10.0, minimum=minimum, maximum=maximum)


PARAMETERS = (
    _constant("bore", "m", 0.087, "cylinder, bore [R]", 1e-3),
    _constant("stroke", "m", 0.092, "cylinder, stroke [R]", 1e-3),
    _constant("rod_ratio", "1", 0.31, "crank radius over length of the connecting rod [R]", 1e-3),
    _constant("compression", "1", 18.0, "cylinder, compression ratio [R]", 1.5),
    _constant("J_0", "kg.m2", 0.2, "crankshaft, flywheel and dynamometer, inertia [R]", 1e-9),
    _constant("m_rec", "kg", 1.0, "reciprocating mass of each cylinder [R]"),
    _constant("gamma", "1", 1.33, "gas, ratio of specific heats [I], between air's and hot burnt gas's", 1.01),
    _constant("R", "J/kg/K", 287.2, "gas, constant [R], air's", 1.0),
    _constant("q_lhv", "J/kg", 42.5e6, "fuel, lower heating value [R], Diesel"),
    _constant("AF_s", "1", 14.5, "fuel, stoichiometric air-fuel ratio by mass [R], Diesel", 1.0),
    _constant("p_im", "Pa", 1.3e5, "intake ports, pressure [I]", 1e3),
    _constant("T_im", "K", 330.0, "intake ports, temperature [I]", 100.0),
    _constant("p_em", "Pa", 1.4e5, "exhaust ports, pressure [I]", 1e3),
    _constant("p_case", "Pa", 101300.0, "crankcase, pressure [I]"),
    _constant("T_wall", "K", 450.0, "cylinder walls, temperature [I]", 100.0),
    _constant("wall", "1", 1.0, "factor on Hohenberg's heat transfer [I]; 0 for walls that take no heat"),
    _angle("inject", -60.0, "fuel enters [I], before combustion starts and after IVC", -179.0, 0.0),
    _angle("burn_start", -5.0, "combustion starts [I]", -90.0, 90.0),
    _angle("burn_duration", 20.0, "combustion, duration of Wiebe's function [I]", 1.0, 180.0),
    _constant("wiebe_a", "1", 5.0, "combustion, efficiency parameter of Wiebe's function [I]"),
    _constant("wiebe_m", "1", 2.0, "combustion, form factor of Wiebe's function [I]"),
    _angle("EVO", 135.0, "exhaust valves open [I]", 60.0, 200.0),
    _angle("EVC", 370.0, "exhaust valves shut [I]", 300.0, 420.0),
    _angle("IVO", 355.0, "intake valves open [I]", 300.0, 420.0),
    _angle("IVC", 580.0, "intake valves shut [I]", 500.0, 640.0),
    _constant("A_int", "m2", 6e-4, "intake valves of a cylinder, effective area when open [I]"),
    _constant("A_exh", "m2", 5e-4, "exhaust valves of a cylinder, effective area when open [I]"),
    Signal("PI_lin", "1", 0.98, "valves, pressure ratio above which the flow is linear [I]", 0.1, 0.5, 0.9999),
    _constant("fmep_0", "Pa", 1.70e5, "friction mean pressure [C], a 2.3 L engine's"),
    _constant("fmep_1", "Pa/rpm", -24.3, "friction mean pressure per speed [C], a 2.3 L engine's", -np.inf),
    _constant("fmep_2", "Pa/rpm2", 6.9e-3, "friction mean pressure per speed squared [C], a 2.3 L engine's", -np.inf),
    _constant("dyno_p", "N.m.s/rad", 2.0, "dynamometer, torque per speed above what is demanded [I]"),
    _constant("dyno_i", "N.m/rad", 5.0, "dynamometer, torque per angle ahead of what is demanded [I]"),
    _constant("afr_most", "1", 1000.0, "air-fuel ratio shown where there is less fuel than that [I]", 1.0),
    *(_constant(f"injector_{i}", "1", 0.0, f"cylinder {i}, relative error of its injector [I]", -1.0) for i in CYLINDERS),
    *(
        _constant(f"fill_{i}", "1", 0.0, f"cylinder {i}, relative error of its intake port's pressure [I]", -0.9)
        for i in CYLINDERS
    ),
)
PARAMETER_SETS = {
    # 1.8 L as set A of turbo_si: 9.5 and fuel [R]; bore and stroke of a common engine of that size [R].
    "si": {
        "bore": 0.081, "stroke": 0.0864, "rod_ratio": 0.30, "compression": 9.5, "J_0": 0.15, "m_rec": 0.6,
        "q_lhv": 44e6, "AF_s": 15.1, "p_im": 0.9e5, "T_im": 310.0, "p_em": 1.05e5,
        "inject": -90.0, "burn_start": -20.0, "burn_duration": 50.0,
        "EVO": 140.0, "EVC": 370.0, "IVO": 350.0, "IVC": 590.0, "A_int": 7e-4, "A_exh": 6e-4,
    },
    "imbalanced": {
        "injector_1": 0.03, "injector_2": -0.04, "injector_3": 0.02, "injector_4": -0.01,
        "fill_1": 0.005, "fill_2": 0.01, "fill_3": -0.01, "fill_4": -0.005,
    },
}  # fmt: skip

# The periodic state of the default set at theta = 0, by cylinder.
STARTS = {
    "U": (1000.0, 200.0, 300.0, 20.0),
    "m": (7e-4, 4e-4, 7e-4, 5e-5),
    "fuel": (2e-5, 1e-5, 1e-6, 1e-6),
    "burnt": (2e-6, 1e-5, 1e-6, 1e-6),
    "work": (0.0, 0.0, 0.0, 0.0),
    "gone": (0.0, 0.0, 0.0, 0.0),
    "gone_heat": (0.0, 0.0, 0.0, 0.0),
    "burn": (2e-5, 2e-5, 2e-5, 2e-5),
    "share": (0.03, 0.03, 0.03, 0.03),
    "m_open": (7e-4, 7e-4, 7e-4, 7e-4),
    "T_port": (700.0, 700.0, 700.0, 700.0),
    "imep": (8e5, 8e5, 8e5, 8e5),
    "m_exh": (7e-4, 7e-4, 7e-4, 7e-4),
}
STATES = (
    Signal("theta", "rad", 0.0, "crank angle from the first cylinder's firing top dead centre, counted on"),
    Signal("omega_e", "rad/s", 157.0, "speed of the crankshaft", nominal=100.0),
    Signal("hold", "N.m", 100.0, "dynamometer, torque at the speed demanded", nominal=100.0),
    *(
        Signal(f"{name}_{i}", unit, STARTS[name][i - 1], f"cylinder {i}, {what}", nominal, minimum, local=local)
        for name, unit, what, nominal, minimum, local in (
            ("U", "J", "internal energy", 100.0, 0.0, False),
            ("m", "kg", "mass of the gas", 1e-4, 0.0, False),
            ("fuel", "kg", "fuel in the gas, burnt or not", 1e-5, 0.0, False),
            ("burnt", "kg", "fuel in the gas that is burnt", 1e-5, 0.0, False),
            ("work", "J", "work on the piston since the cycle began", 100.0, -np.inf, True),
            ("gone", "kg", "mass that left by the exhaust valves since they opened", 1e-4, -np.inf, True),
            ("gone_heat", "J", "enthalpy that left with it", 100.0, -np.inf, True),
        )
        for i in CYLINDERS
    ),
)
DISCRETE = (
    *(
        Signal(f"{name}_{i}", unit, STARTS[name][i - 1], f"cylinder {i}, {what}", nominal, local=local)
        for name, unit, what, nominal, local in (
            ("imep", "Pa", "indicated mean effective pressure of its last complete cycle", 1e5, False),
            ("m_exh", "kg", "mass it exhausts in the cycle", 1e-4, False),
            ("burn", "kg", "fuel that burns in the cycle", 1e-5, False),
            ("share", "1", "fuel in the mass it last exhausted", 0.01, True),
            ("m_open", "kg", "mass when its exhaust valves last opened", 1e-4, True),
            ("T_port", "K", "temperature of what it last exhausted", 1000.0, True),
        )
        for i in CYLINDERS
    ),
    *(
        Signal(f"stage_{i}", "1", start, f"cylinder {i} waits for 0 fuel, 1 EVO, 2 its end", 1.0, 0, 2, "integer",
               local=True)
        for i, start in zip(CYLINDERS, (OPENING, EXCHANGE, INJECTION, INJECTION), strict=True)
    ),
    *(
        Signal(f"cycle_{i}", "1", start, f"cylinder {i}, cycles completed", kind="integer", local=True)
        for i, start in zip(CYLINDERS, (0, -1, 0, 0), strict=True)
    ),
)  # fmt: skip
INPUTS = (
    *(Signal(f"m_f_{i}", "kg", 2e-5, f"cylinder {i}, fuel commanded for a cycle", 1e-5, 0.0) for i in CYLINDERS),
    *(Signal(f"offset_{i}", "1", 0.0, f"cylinder {i}, relative injection error", 0.1, -1.0) for i in CYLINDERS),
    Signal("speed_demand", "rad/s", 50.0 * np.pi, "speed that the dynamometer holds", nominal=100.0, minimum=0.0),
)
OUTPUTS = (
    *(Signal(f"afr_{i}", "1", 30.0, f"cylinder {i}, air-fuel ratio of what it last exhausted") for i in CYLINDERS),
    Signal("T_exh", "K", 700.0, "temperature of what the cylinders last exhausted, mixed", nominal=1000.0),
    *(
        Signal(f"{name}_{i}", unit, 0.0, f"cylinder {i}, {what}", nominal)
        for name, unit, what, nominal in (
            ("p", "Pa", "pressure", 1e5),
            ("T", "K", "temperature of the gas", 1000.0),
            ("W_int", "kg/s", "flow in from the intake", 0.01),
            ("W_exh", "kg/s", "flow out to the exhaust", 0.01),
            ("H_int", "W", "enthalpy in with the flow from the intake", 1e4),
            ("H_exh", "W", "enthalpy out with the flow to the exhaust", 1e4),
            ("Q_burn", "W", "heat released", 1e5),
            ("Q_wall", "W", "heat to the walls", 1e4),
        )
        for i in CYLINDERS
    ),
    Signal("torque_gas", "N.m", 0.0, "torque of the gas on the crank", nominal=100.0),
    Signal("torque_friction", "N.m", 0.0, "torque of friction, against the motion", nominal=10.0),
    Signal("torque_load", "N.m", 0.0, "torque of the dynamometer, against the motion", nominal=100.0),
)


class Cylinder(NamedTuple):
    """A cylinder at an instant: piston, volume [m3], p [Pa], T [K], heat [W] and what flows in through its valves.

    `burning` is dburnt/dt [kg/s]; a flow out of the cylinder is negative.
    """

    piston: PistonMotion
    V: Any
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
    burnt_slope = wiebe(
        phi - CYCLE * m[f"cycle_{i}"], p.burn_start * DEG, p.burn_duration * DEG, p.wiebe_a, p.wiebe_m
    )[1]
    walls = np.pi * p.bore * V / piston_area(p) + 2.0 * piston_area(p)
    Q_wall = p.wall * hohenberg(pressure, T, V, p.stroke * speed / np.pi) * walls * (T - p.T_wall)

    p_port = p.p_im * (1.0 + p[f"fill_{i}"])
    area = p.A_int * valve_opening(phi, p.IVO * DEG, p.IVC * DEG)
    W = isentropic_flow(p_port, p.T_im, pressure, T, area, gas, p.PI_lin)
    intake = between(W, p_port >= pressure, p.T_im, T)[1]
    area, T_port = p.A_exh * valve_opening(phi, p.EVO * DEG, p.EVC * DEG), m[f"T_port_{i}"]
    W = isentropic_flow(pressure, T, p.p_em, T_port, area, gas, p.PI_lin)
    exhaust = between(W, pressure >= p.p_em, T, T_port)[0]
    return Cylinder(piston, V, pressure, T, m[f"burn_{i}"] * burnt_slope * x.omega_e, Q_wall, intake, exhaust)


def _equations(t: Any, x: Values, m: Values, u: Values, p: Values) -> tuple[dict[str, Any], dict[str, Any]]:
    cylinders = {i: _cylinder(i, x, m, p) for i in CYLINDERS}
    dx: dict[str, Any] = {"theta": x.omega_e}
    y: dict[str, Any] = {}
    cp = Gas(p.gamma, p.R).cp
    for i, one in cylinders.items():
        power = one.p * piston_area(p) * one.piston.slope * x.omega_e
        flows = (one.intake, one.exhaust)
        H_int, H_exh = (cp * flow.W * flow.T for flow in flows)
        Q_burn = p.q_lhv * one.burning
        dx[f"U_{i}"] = Q_burn - one.Q_wall - power + H_int + H_exh
        dx[f"m_{i}"] = one.intake.W + one.exhaust.W
        share = m[f"share_{i}"]
        # What comes back from the exhaust has burnt as far as its air went.
        behind = {"fuel": share, "burnt": np.minimum(share, (1.0 - share) / p.AF_s)}
        for what, grows in (("fuel", 0.0), ("burnt", one.burning)):
            inside = x[f"{what}_{i}"] / x[f"m_{i}"]
            taken = np.minimum(one.intake.W, 0.0) * inside
            dx[f"{what}_{i}"] = grows + taken + one.exhaust.W * np.where(one.exhaust.W < 0.0, inside, behind[what])
        dx |= {f"work_{i}": power, f"gone_{i}": -one.exhaust.W, f"gone_heat_{i}": -H_exh}
        y |= {f"p_{i}": one.p, f"T_{i}": one.T, f"Q_burn_{i}": Q_burn, f"Q_wall_{i}": one.Q_wall}
        y |= {f"W_int_{i}": one.intake.W, f"W_exh_{i}": -one.exhaust.W, f"H_int_{i}": H_int, f"H_exh_{i}": -H_exh}
        y[f"afr_{i}"] = (1.0 - share) / np.maximum(share, (1.0 - share) / p.afr_most)
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
