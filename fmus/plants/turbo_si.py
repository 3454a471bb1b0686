"""A turbocharged spark-ignited engine in mean values: six volumes between restrictions, and the turbocharger's speed.

Source: Andersson, Frisk, Eriksson, Sensor selection for observer feedback in turbocharged spark ignited engines,
IFAC 2005, Section 2 (states, inputs, dependencies e1-e13, flows). It refers to a thesis that is not at hand for the
equations; these are those of the TCSISimTestbed, which has the same 13 states (Ng, Frisk, Krysander, Eriksson, IEEE
Control Systems Magazine 40(2), 2020), in `fmus.gas` and `fmus.turbocharger`.

    ambient -W_af- af -W_comp- comp -W_ic- ic -W_th- im -W_c- cylinders -W_exh- em -W_turbine, W_wg- t -W_es- ambient

    volumes         p = m R T/V, dm/dt and dT/dt from the flows and their temperatures
    W_af W_ic W_es  incompressible: sqrt(p_u/(H T_u)) sqrt(dp)
    W_th W_wg       isentropic; A_th = a_0 + a_1 alpha + a_2 alpha^2, A_wg = A_wg_max C_d u_wg
    W_comp          elliptic map, W_turbine from the pressure ratio, efficiencies by flow and by blade speed
    intercooler     gas leaves at T - eps_ic (T - T_cool)
    cylinders       W_c = C_c (r_c - (p_em/p_im)^(1/gamma_e))/(r_c - 1) p_im V_d n/(2 R_a T_i),  n = N/60 in 1/s,
                    T_i = T_im - C_2 (1/lambda - 1), W_fuel = W_c/(lambda AF_s), W_exh = W_c + W_fuel
    exhaust pipes   T_pipe = T_a + (T_e - T_a) exp(-h A/((W_exh/n_pipe) cp)), T_e = T_0 + K_T W_exh + K_s sqrt(W_exh),
                    A = pi D L, 1/h = 1/h_ext + 1/h_int, h_int = 0.26 Re^0.6 k_e/D_pipe
    shaft           J_tc domega_tc/dt = torque_turbine - torque_compressor - f_tc omega_tc
    engine torque   (work - (p_em - p_im) V_d - fmep V_d)/4pi, fmep = fmep_0 + fmep_1 N + fmep_2 N^2,
                    work = eta_otto (1 - r_c^(1 - gamma_e)) q_lhv cac_cycle/AF_s min(1/lambda, 1)
    air charge      cac_cycle = 2 W_c/n of all cylinders in two revolutions, cac_stroke = cac_cycle/n_cyl of one

Flows go both ways; backwards they carry what is downstream. With every flow forwards and the compressor's outlet
above its inlet, each equation depends on exactly what e1-e13 of the paper list; while the throttle is choked, p_ic and
T_ic do not depend on p_im. At lambda = 1 exactly, T_im drops out of dp_im/dt: W_c T_im no longer depends on it.

Parameters: [R] read in a source, [C] computed from measured points, [I] chosen. The default set A is the testbed's
generic 1.8 L engine. Its turbocharger turns too fast for its diameter; set `A_realistic` has another compressor map.
Set `B` is what was fitted to 344 measured points of a 2.3 L engine; what it does not name is A's, the compressor too.
States and outputs start in the equilibrium of set A at the inputs' start values [C].
"""

from __future__ import annotations

from typing import Any

import numpy as np

from fmus.component import Signal
from fmus.gas import Gas, Stream, between, filling, isentropic_flow, signed_root, turbulent_flow
from fmus.model import Model, Values
from fmus.turbocharger import compressor, turbine


def _pressure(name: str, start: float, place: str) -> Signal:
    return Signal(name, "Pa", start, f"pressure {place}", nominal=1e5, minimum=1e3)


def _temperature(name: str, start: float, place: str, nominal: float = 300.0) -> Signal:
    return Signal(name, "K", start, f"temperature {place}", nominal=nominal, minimum=100.0)


def _constant(name: str, unit: str, value: float, description: str, minimum: float = 0.0) -> Signal:
    return Signal(name, unit, value, description, nominal=abs(value) or 1.0, minimum=minimum)


STATES = (
    _pressure("p_af", 100550.6884, "after the air filter"),
    _temperature("T_af", 298.0, "after the air filter"),
    _pressure("p_comp", 117032.5268, "after the compressor"),
    _temperature("T_comp", 314.5451595, "after the compressor"),
    _pressure("p_ic", 116519.5538, "after the intercooler"),
    _temperature("T_ic", 301.3090319, "after the intercooler"),
    _pressure("p_im", 70065.8998, "in the intake manifold"),
    _temperature("T_im", 301.3090319, "in the intake manifold"),
    _pressure("p_em", 113958.5675, "in the exhaust manifold"),
    _temperature("T_em", 933.2461311, "in the exhaust manifold", nominal=1000.0),
    _pressure("p_t", 102754.32, "after the turbine"),
    _temperature("T_t", 918.2962408, "after the turbine", nominal=1000.0),
    Signal("omega_tc", "rad/s", 8617.961339, "speed of the turbocharger", nominal=5000.0, minimum=0.0),
)
INPUTS = (
    Signal("N", "rpm", 2000.0, "engine speed", nominal=1000.0, minimum=0.0),
    Signal("alpha", "1", 0.15, "throttle opening", nominal=0.1, minimum=0.0, maximum=1.0),
    Signal("lambda", "1", 1.0, "air over fuel, 1 where neither is left over", minimum=0.5, maximum=2.0),
    Signal("u_wg", "1", 0.0, "wastegate opening", nominal=0.1, minimum=0.0, maximum=1.0),
    Signal("p_a", "Pa", 101300.0, "ambient pressure", nominal=1e5, minimum=1e3),
    Signal("T_a", "K", 298.0, "ambient temperature", nominal=300.0, minimum=100.0),
)
OUTPUTS = (
    Signal("W_af", "kg/s", 0.02184384, "flow through the air filter", nominal=0.01),
    Signal("W_comp", "kg/s", 0.02184384, "flow through the compressor", nominal=0.01),
    Signal("W_ic", "kg/s", 0.02184384, "flow through the intercooler", nominal=0.01),
    Signal("W_th", "kg/s", 0.02184384, "flow through the throttle", nominal=0.01),
    Signal("W_c", "kg/s", 0.02184384, "flow of air into the cylinders", nominal=0.01),
    Signal("W_fuel", "kg/s", 0.001446612, "flow of fuel", nominal=0.001),
    Signal("W_exh", "kg/s", 0.02329046, "flow out of the cylinders", nominal=0.01),
    Signal("W_turbine", "kg/s", 0.02329046, "flow through the turbine", nominal=0.01),
    Signal("W_wg", "kg/s", 0.0, "flow through the wastegate", nominal=0.01),
    Signal("W_es", "kg/s", 0.02329046, "flow through the exhaust system", nominal=0.01),
    Signal("cac_cycle", "kg", 0.001310631, "air charge of all cylinders in a cycle", nominal=1e-3),
    Signal("cac_stroke", "kg", 0.0003276577, "air charge of one cylinder in its intake stroke", nominal=1e-3),
    Signal("T_pipe", "K", 933.2461, "temperature at which the gas enters the exhaust manifold", nominal=1000.0),
    Signal("torque", "N.m", 92.20397, "engine torque", nominal=100.0),
    Signal("torque_turbine", "N.m", 0.05077285, "torque of the turbine on its shaft", nominal=0.1),
    Signal("torque_compressor", "N.m", 0.04215489, "torque that the compressor takes", nominal=0.1),
)
# Where a sensor can stand: the set Y of the paper, Section 2.2.
SENSORS = (*(signal.name for signal in STATES), "W_af", "W_comp", "W_ic", "W_th")
PARAMETERS = (
    _constant("gamma_a", "1", 1.4, "air, ratio of the specific heats [R]", 1.0),
    _constant("R_a", "J/kg/K", 287.2, "air, gas constant [R]"),
    _constant("gamma_e", "1", 1.3, "exhaust, ratio of the specific heats [R]", 1.0),
    _constant("R_e", "J/kg/K", 290.0, "exhaust, gas constant [R]"),
    _constant("q_lhv", "J/kg", 44e6, "fuel, heating value [R]"),
    _constant("AF_s", "1", 15.1, "fuel, stoichiometric mass of air over that of fuel [R]"),
    _constant("PI_lin", "1", 0.99, "throttle, wastegate [R] and turbine [I], ratio from which the flow is linear"),
    # Restrictions without moving parts.
    _constant("H_af", "Pa2.s2/kg2/K", 2e8, "air filter, resistance [R]"),
    _constant("dp_lin_af", "Pa", 2000.0, "air filter, drop below which the flow is linear [R]"),
    _constant("H_ic", "Pa2.s2/kg2/K", 4e8, "intercooler, resistance [R]"),
    _constant("dp_lin_ic", "Pa", 500.0, "intercooler, drop below which the flow is linear [R]"),
    _constant("eps_ic", "1", 0.8, "intercooler, effectiveness [R]"),
    _constant(
        "T_cool", "K", 298.0, "intercooler, coolant: a constant as e5 and e6 have it, at the ambient's value [R]"
    ),
    _constant("H_es", "Pa2.s2/kg2/K", 3e8, "exhaust system, resistance [R]"),
    _constant("dp_lin_es", "Pa", 300.0, "exhaust system, drop below which the flow is linear [R]"),
    # Throttle and wastegate.
    _constant("a_0", "m2", 1.1647e-5, "throttle, area when closed [R]"),
    _constant("a_1", "m2", 3.0718e-5, "throttle, area per opening [R]", -np.inf),
    _constant("a_2", "m2", 2.9e-3, "throttle, area per opening squared [R]", -np.inf),
    _constant("A_wg_max", "m2", 3.5e-4, "wastegate, area when open [R]"),
    _constant("C_d", "1", 0.9, "wastegate, discharge coefficient [R]"),
    # Volumes.
    _constant("V_af", "m3", 10e-3, "volume after the air filter [R]"),
    _constant("V_comp", "m3", 5e-3, "volume after the compressor [R]"),
    _constant("V_ic", "m3", 5e-3, "volume after the intercooler [R]"),
    _constant("V_im", "m3", 1.8e-3, "volume of the intake manifold [R]"),
    _constant("V_em", "m3", 2.5e-3, "volume of the exhaust manifold [R]"),
    _constant("V_t", "m3", 20e-3, "volume after the turbine [R]"),
    # Engine.
    _constant("V_d", "m3", 1.8e-3, "engine, displacement [R]"),
    _constant("r_c", "1", 9.5, "engine, compression ratio [R]", 1.0),
    _constant("n_cyl", "1", 4.0, "engine, number of cylinders [R]", 1.0),
    _constant("C_c", "1", 0.95, "engine, volumetric efficiency [R]"),
    _constant("C_2", "K", 110.0, "engine, charge cooling by the fuel [R]"),
    _constant("eta_otto", "1", 0.803, "engine, gross efficiency over the ideal Otto cycle's [C], set B's"),
    _constant("fmep_0", "Pa", 1.70e5, "engine, friction mean pressure [C], set B's"),
    _constant("fmep_1", "Pa/rpm", -24.3, "engine, friction mean pressure per speed [C], set B's", -np.inf),
    _constant("fmep_2", "Pa/rpm2", 6.9e-3, "engine, friction mean pressure per speed squared [C], set B's", -np.inf),
    # Exhaust pipes.
    _constant("T_0", "K", 1100.0, "gas out of the cylinders, temperature without flow [R]"),
    _constant("K_T", "K.s/kg", 3000.0, "gas out of the cylinders, temperature per flow [R]", -np.inf),
    _constant(
        "K_s", "1", 0.0, "gas out of the cylinders, temperature per root of flow, K.(s/kg)^0.5 [C], set B", -np.inf
    ),
    _constant("n_pipe", "1", 4.0, "exhaust pipes, number [R]", 1.0),
    _constant("D_pipe", "m", 0.04, "exhaust pipes, diameter [R]"),
    _constant("L_pipe", "m", 0.45, "exhaust pipes, length [R]"),
    _constant("h_ext", "W/m2/K", 95.0, "exhaust pipes, heat transfer outside [R]"),
    _constant("mu_e", "Pa.s", 4e-5, "exhaust, viscosity [R]"),
    _constant("k_e", "W/m/K", 0.07, "exhaust, heat conductivity [R]"),
    # Turbocharger.
    _constant("J_tc", "kg.m2", 3e-5, "turbocharger, inertia [R]"),
    _constant("f_tc", "N.m.s/rad", 1e-6, "turbocharger, friction [R]"),
    _constant("omega_min", "rad/s", 100.0, "turbocharger, speed below which maps and torques are those at it [I]"),
    _constant("D_c", "m", 0.06, "compressor, diameter [R]"),
    _constant("Psi_max", "1", 2.3, "compressor, head coefficient without flow [R]"),
    _constant("Phi_max", "1", 0.12, "compressor, flow coefficient without head [R]"),
    _constant("Phi_0", "1", 0.06, "compressor, flow coefficient of the best efficiency [R]"),
    _constant("eta_c_max", "1", 0.8, "compressor, best efficiency [R]"),
    _constant("eta_c_min", "1", 0.3, "compressor, lowest efficiency [R]"),
    _constant("v_lin", "m/s", 5.0, "compressor, flow velocity below which the flow is linear [I]"),
    _constant("D_t", "m", 0.05, "turbine, diameter [R]"),
    _constant("k_1", "1", 0.017, "turbine, flow coefficient, kg.K^0.5/(s.kPa) [R]"),
    _constant("k_2", "1", 1.4, "turbine, exponent of the flow [R]"),
    _constant("B_0", "1", 0.7, "turbine, blade speed ratio of the best efficiency [R]"),
    _constant("eta_t_max", "1", 0.75, "turbine, best efficiency [R]"),
    _constant("eta_t_min", "1", 0.3, "turbine, lowest efficiency [R]"),
)
PARAMETER_SETS = {
    # [I] Psi_max: a head of half the tip speed squared (pi^2/2), the usual best of a centrifugal wheel. Phi_max: at
    # 5500 rpm, throttle open and PI = 1.7 the tip then has 480 m/s, just within what cast wheels bear.
    "A_realistic": {"Psi_max": 5.0, "Phi_max": 0.2, "Phi_0": 0.1},
    # [C]. The exhaust temperature is that measured in the manifold, so the pipes lose no more heat (h_ext) [I].
    "B": {
        "V_d": 2.3e-3, "C_c": 0.841, "C_2": 119.0,
        "a_0": 7.8e-6, "a_1": 8.94e-5, "a_2": 2.753e-3,
        "H_af": 1.72e8, "H_es": 3.2e8,
        "T_0": 774.0, "K_T": 0.0, "K_s": 1401.0, "h_ext": 0.0,
        "eta_t_max": 0.807, "B_0": 0.695, "k_2": 1.45, "J_tc": 2.55e-5,
    },
}  # fmt: skip
# [I] kg/s, below the first the root in the exhaust temperature is linear, below the second the pipes cool as at it.
ROOT_LINEAR, LEAST_IN_PIPES = 1e-4, 1e-5


def mean_values(x: Values, u: Any, p: Values) -> tuple[dict[str, Any], dict[str, Any]]:
    """Derivatives of the 13 states and the outputs by name; `u` has the inputs, read by name in brackets."""
    air, exhaust = Gas(p.gamma_a, p.R_a), Gas(p.gamma_e, p.R_e)
    N, alpha, richness, u_wg, p_a, T_a = (u[signal.name] for signal in INPUTS)
    N = np.maximum(N, 0.0)
    y: dict[str, Any] = {}

    y["W_af"] = turbulent_flow(p_a, T_a, x.p_af, x.T_af, p.H_af, p.dp_lin_af)
    _, into_af = between(y["W_af"], p_a >= x.p_af, T_a, x.T_af)
    wheel = compressor(x.p_af, x.T_af, x.p_comp, x.T_comp, x.omega_tc, air, p)
    y["W_comp"], y["torque_compressor"] = wheel.W, wheel.torque
    from_af, into_comp = between(wheel.W, wheel.W >= 0.0, x.T_af, x.T_comp, forward=wheel.T_out)

    y["W_ic"] = turbulent_flow(x.p_comp, x.T_comp, x.p_ic, x.T_ic, p.H_ic, p.dp_lin_ic)
    cooled, cooled_back = (T - p.eps_ic * (T - p.T_cool) for T in (x.T_comp, x.T_ic))
    from_comp, into_ic = between(y["W_ic"], x.p_comp >= x.p_ic, x.T_comp, x.T_ic, forward=cooled, backward=cooled_back)
    area = p.a_0 + p.a_1 * alpha + p.a_2 * alpha**2
    y["W_th"] = isentropic_flow(x.p_ic, x.T_ic, x.p_im, x.T_im, area, air, p.PI_lin)
    from_ic, into_im = between(y["W_th"], x.p_ic >= x.p_im, x.T_ic, x.T_im)

    y |= _cylinders(x, N / 60.0, richness, p)
    y["T_pipe"] = _behind_pipes(y["W_exh"], T_a, exhaust, p)
    from_im, into_em = Stream(-y["W_c"], x.T_im), Stream(y["W_exh"], y["T_pipe"])

    wheel = turbine(x.p_em, x.T_em, x.p_t, x.T_t, x.omega_tc, exhaust, p)
    y["W_turbine"], y["torque_turbine"] = wheel.W, wheel.torque
    through_turbine = between(wheel.W, x.p_em >= x.p_t, x.T_em, x.T_t, forward=wheel.T_out)
    y["W_wg"] = isentropic_flow(x.p_em, x.T_em, x.p_t, x.T_t, p.A_wg_max * p.C_d * u_wg, exhaust, p.PI_lin)
    beside = between(y["W_wg"], x.p_em >= x.p_t, x.T_em, x.T_t)
    y["W_es"] = turbulent_flow(x.p_t, x.T_t, p_a, T_a, p.H_es, p.dp_lin_es)
    from_t, _ = between(y["W_es"], x.p_t >= p_a, x.T_t, T_a)

    y["torque"] = _torque(x, N, richness, y["cac_cycle"], p)
    dx: dict[str, Any] = {}
    for place, gas, streams in (
        ("af", air, (into_af, from_af)),
        ("comp", air, (into_comp, from_comp)),
        ("ic", air, (into_ic, from_ic)),
        ("im", air, (into_im, from_im)),
        ("em", exhaust, (into_em, through_turbine[0], beside[0])),
        ("t", exhaust, (through_turbine[1], beside[1], from_t)),
    ):
        filled = filling(x[f"p_{place}"], x[f"T_{place}"], p[f"V_{place}"], gas, streams)
        dx[f"p_{place}"], dx[f"T_{place}"] = filled
    dx["omega_tc"] = (y["torque_turbine"] - y["torque_compressor"] - p.f_tc * x.omega_tc) / p.J_tc
    return dx, y


def _cylinders(x: Values, n: Any, richness: Any, p: Values) -> dict[str, Any]:
    """Air charge [kg] and flows [kg/s] at n [1/s]; none backwards, where the exhaust alone would fill the cylinders."""
    T_i = x.T_im - p.C_2 * (1.0 / richness - 1.0)
    filled = np.maximum(p.r_c - (x.p_em / x.p_im) ** (1.0 / p.gamma_e), 0.0) / (p.r_c - 1.0)
    cycle = p.C_c * filled * x.p_im * p.V_d / (p.R_a * T_i)
    W_c = 0.5 * n * cycle
    W_fuel = W_c / (richness * p.AF_s)
    return {"W_c": W_c, "W_fuel": W_fuel, "W_exh": W_c + W_fuel, "cac_cycle": cycle, "cac_stroke": cycle / p.n_cyl}


def _behind_pipes(W: Any, T_a: Any, gas: Gas, p: Values) -> Any:
    """Temperature [K] of the gas behind the exhaust pipes, which lose heat to the ambient."""
    T_e = p.T_0 + p.K_T * W + p.K_s * signed_root(W, ROOT_LINEAR)
    each = np.maximum(W, LEAST_IN_PIPES) / p.n_pipe
    Re = 4.0 * each / (np.pi * p.D_pipe * p.mu_e)
    h_int = 0.26 * Re**0.6 * p.k_e / p.D_pipe
    h = p.h_ext * h_int / (p.h_ext + h_int)
    return T_a + (T_e - T_a) * np.exp(-h * np.pi * p.D_pipe * p.L_pipe / (each * gas.cp))


def _torque(x: Values, N: Any, richness: Any, cycle: Any, p: Values) -> Any:
    """Engine torque [N.m]; of too much fuel [I] only as much burns as there is air for."""
    burnt = cycle / p.AF_s * np.minimum(1.0 / richness, 1.0)
    work = p.eta_otto * (1.0 - p.r_c ** (1.0 - p.gamma_e)) * p.q_lhv * burnt
    friction = p.fmep_0 + p.fmep_1 * N + p.fmep_2 * N**2
    return (work - (x.p_em - x.p_im + friction) * p.V_d) / (4.0 * np.pi)


def _equations(t: Any, x: Values, m: Values, u: Values, p: Values) -> tuple[dict[str, Any], dict[str, Any]]:
    return mean_values(x, u, p)


MODEL = Model(
    name="turbo_si",
    description="Turbocharged spark-ignited engine, mean values, 13 states (IFAC 2005)",
    equations=_equations,
    inputs=INPUTS,
    states=STATES,
    outputs=OUTPUTS,
    parameters=PARAMETERS,
    parameter_sets=PARAMETER_SETS,
    # Time constants from 70 us with the throttle open to 30 s; a throttle that chokes or not is a kink, which steps of
    # a fixed length would not see: docs/turbo_si.md.
    solver_method="rodas4",
    solver_step=1e-3,
    solver_tolerance=1e-6,
)
