"""A turbocharged spark-ignited engine with low-pressure EGR in mean values, its actuators and its air-path sensors.

Source: Zhang, Shaver, Lana, Gosala, Le, Langenderfer, H2 sensor selection and observer design, Front. Mech. Eng. 2021,
10.3389/fmech.2021.611992, Section 3.1: 20 states, 8 inputs and the engine's speed as a disturbance, lags (Eq. 17),
flows through orifices (Eq. 18), charge flow by speed-density. Its tables and governing equations are lost; the layout
and the equations are those of a model of this kind. Restrictions, volumes and turbocharger are those of `turbo_si`.

    ambient -W_a- mix -W_mix- compressor, cooler -W_cac- boost -W_th- im -W_cyl- cylinders -W_exh- em
    em -W_turbine, W_wg- t - tail pipe,  t -W_egr- EGR cooler, LP-EGR valve - mix

    volumes         boost, im, em: p = m R T/V, dm/dt and dT/dt from the flows and their temperatures
    mix, t          hold no mass that matters: p_mix = p_a - k_af W_cyl^2, p_t = p_a + k_es W_exh^2,
                    T_mix = T_a + (W_egr/W_cyl) (T_egr - T_a), T_t by the energy that the turbine leaves,
                    T_egr = T_t - eps_egr (T_t - T_egr_cool), W_a = W_mix - W_egr
    burnt fraction  dF_i/dt = (R T_i/(p_i V_i)) sum W_in (F_in - F_i) of mix, boost, im, em, t and egr
    orifices        isentropic; butterflies A = (pi D^2/4) (1 - cos theta) + A_leak, wastegate A = pi d^2/4
    cylinders       W_cyl = (n_firing/n_cyl) C_c v p_im V_d N/(120 R_a T_im), N in rpm,
                    v = v_IVC - v_r (p_em/p_im)^(1/gamma_e), v_r at theta_r = (EVC + min(IVO, EVC))/2,
                    W_fuel = W_cyl (1 - F_im)/(lambda AF_s), W_exh = W_cyl + W_fuel,
                    F_exh = (W_cyl F_im + (1 + AF_s) W_fuel)/W_exh, at most 1,
                    T_exh = (T_0 + K_s sqrt(W_exh)) (v_EVO_0/v_EVO)^((gamma_e - 1)/gamma_e)
    cooler          gas enters the boost volume at T - eps_cac (T - T_cac_cool); W_cac = W_mix - s_cac (W_mix - W_th)
    shaft           J_tc domega_tc/dt = torque_turbine - torque_compressor - f_tc omega_tc
    actuators       d position/dt = (command - position)/tau
    sensors         dEGR_DP/dt = (W_egr - EGR_DP)/tau, likewise MAFa of W_a, MAFh of W_cac, MAF of W_mix

Valve angles are in degrees after the top dead centre of the gas exchange, v_ANGLE is a cylinder's volume over its
displacement there. Of the valves' timing the first order is here: what is trapped is the volume at IVC, less what the
exhaust in the volume at theta_r, the middle of the overlap or EVC where there is none, takes of it when it has expanded
to the pressure of the intake. With both at the dead centres that is the law of `turbo_si`. EVO acts on the temperature
of the exhaust alone. Ram effects and exhaust that flows through during the overlap are left out. Cylinders that do not
fire keep their valves shut.

The pressures of mix and t follow the flow through the cylinders, which at rest is that of the air filter and the tail
pipe but for the EGR, and so does T_mix: so there is no algebraic loop, and EGR never flows backwards; other flows may.
In the intake burnt gas counts as air. At lambda = 1 all that leaves the cylinders is burnt, F_exh = 1.

The turbocharger is matched to a 2 L engine [I]. With the compressor of `turbo_si` the engine would be at the end of its
map at 3200 rpm: wheels swallow up to 4 Q/(pi D^2 U) = 0.12 at a tip speed U = pi N D, which is Phi_max = 0.3. With the
turbine of set A (k_1 0.017) the wastegate's 11.6 mm would let it charge beyond 2.5 bar; with k_1 = 0.028 it is 1.4 bar
and a flow of 69 g/s, a load at which EGR is of use.

Parameters: [R] read in a source, [C] computed, [I] chosen; those of `turbo_si` have its tags (set A [R], set B [C]).
States and outputs start in the equilibrium at the inputs' start values [C], where the paper makes its model linear.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from fmus.component import Signal
from fmus.gas import Gas, Stream, between, filling, isentropic_flow, signed_root
from fmus.model import Model, Values
from fmus.plants.turbo_si_egr_reference import FITTED
from fmus.turbocharger import compressor, turbine


def _pressure(name: str, start: float, place: str) -> Signal:
    return Signal(name, "Pa", start, f"pressure {place}", nominal=1e5, minimum=1e3)


def _temperature(name: str, start: float, place: str, nominal: float = 300.0) -> Signal:
    return Signal(name, "K", start, f"temperature {place}", nominal=nominal, minimum=100.0)


def _burnt(name: str, start: float, place: str, nominal: float) -> Signal:
    return Signal(name, "1", start, f"mass fraction of burnt gas {place}", nominal=nominal, minimum=-0.1, maximum=1.1)


def _flow(name: str, start: float, description: str, nominal: float = 0.05) -> Signal:
    return Signal(name, "kg/s", start, description, nominal=nominal)


def _constant(name: str, unit: str, value: float, description: str, minimum: float = 0.0) -> Signal:
    return Signal(name, unit, value, description, nominal=abs(value) or 1.0, minimum=minimum)


STATES = (
    _pressure("p_boost", 138266.6748, "before the throttle"),
    _pressure("p_im", 136619.6121, "in the intake manifold"),
    _pressure("p_em", 135458.0077, "in the exhaust manifold"),
    _temperature("T_boost", 307.1027536, "before the throttle"),
    _temperature("T_im", 307.1027536, "in the intake manifold"),
    _temperature("T_em", 1152.828877, "in the exhaust manifold", nominal=1000.0),
    Signal("omega_tc", "rad/s", 9109.808037, "speed of the turbocharger", nominal=5000.0, minimum=0.0),
    _burnt("F_mix", 0.02629891604, "at the compressor's inlet, where air and EGR mix", 0.05),
    _burnt("F_boost", 0.02629891604, "before the throttle", 0.05),
    _burnt("F_im", 0.02629891604, "in the intake manifold", 0.05),
    _burnt("F_em", 1.0, "in the exhaust manifold", 1.0),
    _burnt("F_t", 1.0, "after the turbine", 1.0),
    _burnt("F_egr", 1.0, "in the EGR cooler", 1.0),
    Signal("throttle_position", "deg", 60.0, "where the throttle is", nominal=30.0, minimum=0.0, maximum=90.0),
    Signal("egr_position", "deg", 10.0, "where the LP-EGR valve is", nominal=10.0, minimum=0.0, maximum=90.0),
    Signal("wastegate_position", "mm", 11.6, "where the wastegate is", nominal=10.0, minimum=0.0, maximum=40.0),
    _flow("EGR_DP", 0.001806378644, "sensor of the EGR flow, by the pressure over its valve", 0.002),
    _flow("MAFa", 0.06688005092, "sensor of the air flow before the EGR joins"),
    _flow("MAFh", 0.06868642957, "sensor of the flow behind the charge-air cooler"),
    _flow("MAF", 0.06868642957, "sensor of the flow into the compressor"),
)
INPUTS = (
    Signal("throttle", "deg", 60.0, "throttle, wanted", nominal=30.0, minimum=0.0, maximum=90.0),
    Signal("wastegate", "mm", 11.6, "wastegate's open diameter, wanted", nominal=10.0, minimum=0.0, maximum=40.0),
    Signal("egr_valve", "deg", 10.0, "LP-EGR valve, wanted", nominal=10.0, minimum=0.0, maximum=90.0),
    Signal("n_firing", "1", 4.0, "cylinders that fire", nominal=4.0, minimum=0.0),
    Signal("IVO", "deg", -5.0, "intake valves open, after the gas exchange's top dead centre", nominal=10.0),
    Signal("IVC", "deg", 220.0, "intake valves shut", nominal=10.0),
    Signal("EVO", "deg", -225.0, "exhaust valves open", nominal=10.0),
    Signal("EVC", "deg", 15.0, "exhaust valves shut", nominal=10.0),
    Signal("N", "rpm", 3200.0, "engine speed, which disturbs", nominal=1000.0, minimum=0.0),
)  # fmt: skip
OUTPUTS = (
    _flow("W_a", 0.06688005, "flow of fresh air"),
    _flow("W_egr", 0.001806379, "flow through the LP-EGR valve", 0.002),
    _flow("W_mix", 0.06868643, "flow into the compressor"),
    _flow("W_cac", 0.06868643, "flow behind the charge-air cooler"),
    _flow("W_th", 0.06868643, "flow through the throttle"),
    _flow("W_cyl", 0.06868643, "flow into the cylinders, the virtual sensor by speed-density"),
    _flow("W_fuel", 0.004429142, "flow of fuel", 0.005),
    _flow("W_exh", 0.07311557, "flow out of the cylinders"),
    _flow("W_turbine", 0.0604693, "flow through the turbine"),
    _flow("W_wg", 0.01264628, "flow through the wastegate"),
    _pressure("p_mix", 100120.5, "at the compressor's inlet"),
    _pressure("p_t", 106645.9, "after the turbine"),
    _temperature("T_mix", 301.7016, "at the compressor's inlet"),
    _temperature("T_t", 1120.506, "after the turbine", nominal=1000.0),
    _temperature("T_egr", 438.7506, "behind the EGR cooler"),
    Signal("egr_rate", "1", 0.02629892, "EGR's share of the flow into the cylinders, at rest", nominal=0.05),
    Signal("torque_turbine", "N.m", 0.326006, "torque of the turbine on its shaft", nominal=0.1),
    Signal("torque_compressor", "N.m", 0.3168962, "torque that the compressor takes", nominal=0.1),
)
# The candidates of the paper, Section 3 and Table 1, and how exact they are: its Table 1 is lost; hot-film air mass
# meters of the time give 3 % of the reading, a pressure drop 5 % of the flow [I].
SENSORS = ("EGR_DP", "MAFa", "MAFh", "MAF")
ACCURACIES = {"EGR_DP": 0.05, "MAFa": 0.03, "MAFh": 0.03, "MAF": 0.03}
# States x14 to x20, which follow by a lag what is commanded or measured; the paper gives them no process noise.
LAGS = ("throttle_position", "egr_position", "wastegate_position", *SENSORS)
PARAMETERS = (
    _constant("gamma_a", "1", 1.4, "air, ratio of the specific heats [R]", 1.0),
    _constant("R_a", "J/kg/K", 287.2, "air, gas constant [R]"),
    _constant("gamma_e", "1", 1.3, "exhaust, ratio of the specific heats [R]", 1.0),
    _constant("R_e", "J/kg/K", 290.0, "exhaust, gas constant [R]"),
    _constant("AF_s", "1", 15.1, "fuel, stoichiometric mass of air over that of fuel [R]"),
    _constant("lambda", "1", 1.0, "air over fuel: held stoichiometric for the catalyst [I]"),
    _constant("PI_lin", "1", 0.99, "orifices [R] and turbine [I], pressure ratio from which the flow is linear"),
    _constant("p_a", "Pa", 101300.0, "ambient pressure [R]"),
    _constant("T_a", "K", 298.0, "ambient temperature [R]"),
    _constant("W_least", "kg/s", 1e-4, "flow below which shares of it are those at it [I]"),
    # Restrictions and coolers.
    _constant("k_af", "Pa.s2/kg2", 2.5e5, "air filter, drop over flow squared: 5 kPa at 0.14 kg/s [I]"),
    _constant("k_es", "Pa.s2/kg2", 1e6, "exhaust system, drop over flow squared: 20 kPa at 0.14 kg/s [I]"),
    _constant("eps_cac", "1", 0.8, "charge-air cooler, effectiveness [R]"),
    _constant("T_cac_cool", "K", 298.0, "charge-air cooler, coolant: the ambient air [I]"),
    _constant("s_cac", "1", 0.4, "charge-air cooler, share of the boost volume before it [I]"),
    _constant("eps_egr", "1", 0.9, "EGR cooler, effectiveness [I]"),
    _constant("T_egr_cool", "K", 363.0, "EGR cooler, coolant: the engine's [I]"),
    # Orifices.
    _constant("D_th", "m", 0.055, "throttle, bore [I]"),
    _constant("C_th", "1", 0.8, "throttle, discharge coefficient [I]"),
    _constant("A_th_leak", "m2", 1.1647e-5, "throttle, area when closed [R]"),
    _constant("D_egr", "m", 0.045, "LP-EGR valve, bore: 40 to 50 mm are usual [I]"),
    _constant("C_egr", "1", 0.7, "LP-EGR valve, discharge coefficient [I]"),
    _constant("A_egr_leak", "m2", 1e-6, "LP-EGR valve, area when closed [I]"),
    _constant("C_wg", "1", 0.9, "wastegate, discharge coefficient [R]"),
    # Volumes.
    _constant("V_mix", "m3", 1.5e-3, "volume from where EGR joins to the compressor [I]"),
    _constant("V_boost", "m3", 10e-3, "volume from compressor to throttle, cooler included [R]"),
    _constant("V_im", "m3", 1.8e-3, "volume of the intake manifold [R]"),
    _constant("V_em", "m3", 2.5e-3, "volume of the exhaust manifold [R]"),
    _constant("V_t", "m3", 5e-3, "volume from turbine to where EGR leaves, catalyst included [I]"),
    _constant("V_egr", "m3", 1.5e-3, "volume of the EGR cooler and its pipes [I]"),
    # Engine.
    _constant("V_d", "m3", 2e-3, "engine, displacement: a 2 L class [I]"),
    _constant("n_cyl", "1", 4.0, "engine, number of cylinders [I]", 1.0),
    _constant("r_c", "1", 9.5, "engine, compression ratio [R]", 1.0),
    _constant("rod_ratio", "1", 0.31, "engine, crank radius over rod's length [R]"),
    _constant("C_c", "1", 0.91, "engine, filling: set B's 0.841 over V(IVC)/V(bottom dead centre) [C]"),
    _constant("EVO_0", "deg", -225.0, "engine, EVO at which the exhaust's temperature holds [I]", -np.inf),
    _constant("T_0", "K", 774.0, "exhaust, temperature without flow [C], set B's"),
    _constant("K_s", "1", 1401.0, "exhaust, temperature per root of flow, K.(s/kg)^0.5 [C], set B's", -np.inf),
    # Turbocharger.
    _constant("J_tc", "kg.m2", 2.55e-5, "turbocharger, inertia [C], set B's"),
    _constant("f_tc", "N.m.s/rad", 1e-6, "turbocharger, friction [R]"),
    _constant("omega_min", "rad/s", 100.0, "turbocharger, speed below which maps and torques are those at it [I]"),
    _constant("D_c", "m", 0.06, "compressor, diameter [R]"),
    _constant("Psi_max", "1", 5.0, "compressor, head coefficient without flow [I], set A_realistic's"),
    _constant("Phi_max", "1", 0.3, "compressor, flow coefficient without head [I], see above"),
    _constant("Phi_0", "1", 0.15, "compressor, flow coefficient of the best efficiency [I]: half of Phi_max"),
    _constant("eta_c_max", "1", 0.75, "compressor, best efficiency [I]: usual of such wheels"),
    _constant("eta_c_min", "1", 0.3, "compressor, lowest efficiency [R]"),
    _constant("v_lin", "m/s", 5.0, "compressor, flow velocity below which the flow is linear [I]"),
    _constant("D_t", "m", 0.05, "turbine, diameter [R]"),
    _constant("k_1", "1", 0.028, "turbine, flow coefficient, kg.K^0.5/(s.kPa) [I], see above"),
    _constant("k_2", "1", 1.45, "turbine, exponent of the flow [C], set B's"),
    _constant("B_0", "1", 0.695, "turbine, blade speed ratio of the best efficiency [C], set B's"),
    _constant("eta_t_max", "1", 0.65, "turbine, best efficiency in pulsating flow [I]"),
    _constant("eta_t_min", "1", 0.3, "turbine, lowest efficiency [R]"),
    # Actuators and sensors.
    _constant("tau_throttle", "s", 0.05, "throttle, lag [I]", 1e-6),
    _constant("tau_egr_valve", "s", 0.05, "LP-EGR valve, lag [I]", 1e-6),
    _constant("tau_wastegate", "s", 0.1, "wastegate, lag [I]", 1e-6),
    _constant("tau_EGR_DP", "s", 0.01, "sensor EGR_DP, lag [I]", 1e-6),
    _constant("tau_MAFa", "s", 0.015, "sensor MAFa, lag [I]", 1e-6),
    _constant("tau_MAFh", "s", 0.03, "sensor MAFh, lag: the text has MAF faster than it [I]", 1e-6),
    _constant("tau_MAF", "s", 0.015, "sensor MAF, lag [I]", 1e-6),
)
_ROOT_LINEAR = 1e-4  # kg/s, below it the root in the exhaust's temperature is linear [I]
_DEGREE = np.pi / 180.0
# What each actuator follows, and what each sensor measures.
_COMMANDS = {"throttle": "throttle_position", "egr_valve": "egr_position", "wastegate": "wastegate_position"}
_MEASURED = {"EGR_DP": "W_egr", "MAFa": "W_a", "MAFh": "W_cac", "MAF": "W_mix"}


def cylinder_volume(angle: Any, r_c: Any, rod_ratio: Any) -> Any:
    """A cylinder's volume over its displacement at `angle` [deg] after a top dead centre.

    v = 1/(r_c - 1) + (1 - cos a + (1 - sqrt(1 - r^2 sin^2 a))/r)/2, r the crank's radius over the rod's length.
    """
    a = angle * _DEGREE
    stroke = 1.0 - np.cos(a) + (1.0 - np.sqrt(1.0 - (rod_ratio * np.sin(a)) ** 2)) / rod_ratio
    return 1.0 / (r_c - 1.0) + 0.5 * stroke


def _equations(t: Any, x: Values, m: Values, u: Values, p: Values) -> tuple[dict[str, Any], dict[str, Any]]:
    air, exhaust = Gas(p.gamma_a, p.R_a), Gas(p.gamma_e, p.R_e)
    y, F_exh, T_exh = _cylinders(x, u, p)
    y["p_mix"] = p.p_a - p.k_af * y["W_cyl"] ** 2
    y["p_t"] = p.p_a + p.k_es * y["W_exh"] ** 2

    out = turbine(x.p_em, x.T_em, y["p_t"], x.T_em, x.omega_tc, exhaust, p)
    y["W_turbine"], y["torque_turbine"] = out.W, out.torque
    area = 0.25 * np.pi * (1e-3 * x.wastegate_position) ** 2
    y["W_wg"] = isentropic_flow(x.p_em, x.T_em, y["p_t"], x.T_em, p.C_wg * area, exhaust, p.PI_lin)
    spent = out.torque * x.omega_tc / (exhaust.cp * np.maximum(out.W + y["W_wg"], p.W_least))
    y["T_t"] = x.T_em - spent
    y["T_egr"] = y["T_t"] - p.eps_egr * (y["T_t"] - p.T_egr_cool)
    area = p.C_egr * _butterfly(x.egr_position, p.D_egr) + p.A_egr_leak
    y["W_egr"] = isentropic_flow(y["p_t"], y["T_egr"], y["p_mix"], p.T_a, area, exhaust, p.PI_lin)
    y["egr_rate"] = y["W_egr"] / np.maximum(y["W_cyl"], p.W_least)
    y["T_mix"] = p.T_a + np.clip(y["egr_rate"], 0.0, 1.0) * (y["T_egr"] - p.T_a)

    wheel = compressor(y["p_mix"], y["T_mix"], x.p_boost, x.T_boost, x.omega_tc, air, p)
    y["W_mix"], y["torque_compressor"] = wheel.W, wheel.torque
    y["W_a"] = wheel.W - y["W_egr"]
    cooled = wheel.T_out - p.eps_cac * (wheel.T_out - p.T_cac_cool)
    _, into_boost = between(wheel.W, wheel.W >= 0.0, y["T_mix"], x.T_boost, forward=cooled)
    area = p.C_th * _butterfly(x.throttle_position, p.D_th) + p.A_th_leak
    y["W_th"] = isentropic_flow(x.p_boost, x.T_boost, x.p_im, x.T_im, area, air, p.PI_lin)
    from_boost, into_im = between(y["W_th"], x.p_boost >= x.p_im, x.T_boost, x.T_im)
    y["W_cac"] = wheel.W - p.s_cac * (wheel.W - y["W_th"])

    dx: dict[str, Any] = {}
    leaves = Stream(-(out.W + y["W_wg"]), x.T_em)
    for place, gas, streams in (
        ("boost", air, (into_boost, from_boost)),
        ("im", air, (into_im, Stream(-y["W_cyl"], x.T_im))),
        ("em", exhaust, (Stream(y["W_exh"], T_exh), leaves)),
    ):
        filled = filling(x[f"p_{place}"], x[f"T_{place}"], p[f"V_{place}"], gas, streams)
        dx[f"p_{place}"], dx[f"T_{place}"] = filled
    dx["omega_tc"] = (y["torque_turbine"] - y["torque_compressor"] - p.f_tc * x.omega_tc) / p.J_tc
    dx |= _composition(x, y, F_exh, air, exhaust, p)
    for command, position in _COMMANDS.items():
        dx[position] = (u[command] - x[position]) / p[f"tau_{command}"]
    for sensor, flow in _MEASURED.items():
        dx[sensor] = (y[flow] - x[sensor]) / p[f"tau_{sensor}"]
    return dx, y


def _butterfly(angle: Any, diameter: Any) -> Any:
    """The area [m2] that a butterfly at `angle` [deg] opens in its bore [m]."""
    return 0.25 * np.pi * diameter**2 * (1.0 - np.cos(angle * _DEGREE))


def _cylinders(x: Values, u: Values, p: Values) -> tuple[dict[str, Any], Any, Any]:
    """Flows in and out of the cylinders [kg/s], the burnt fraction and the temperature [K] of what leaves them.

    None flows backwards, where the exhaust alone would fill the cylinders.
    """
    overlap_end = 0.5 * (u.EVC + np.minimum(u.IVO, u.EVC))
    taken = cylinder_volume(overlap_end, p.r_c, p.rod_ratio) * (x.p_em / x.p_im) ** (1.0 / p.gamma_e)
    filled = np.maximum(cylinder_volume(u.IVC, p.r_c, p.rod_ratio) - taken, 0.0)
    n = np.maximum(u.N, 0.0) / 120.0 * np.maximum(u.n_firing, 0.0) / p.n_cyl
    W_cyl = n * p.C_c * filled * x.p_im * p.V_d / (p.R_a * x.T_im)
    fuel = np.maximum(1.0 - x.F_im, 0.0) / (p["lambda"] * p.AF_s)
    W_fuel = W_cyl * fuel
    W_exh = W_cyl + W_fuel
    F_exh = np.minimum((x.F_im + (1.0 + p.AF_s) * fuel) / (1.0 + fuel), 1.0)
    expanded = cylinder_volume(p.EVO_0, p.r_c, p.rod_ratio) / cylinder_volume(u.EVO, p.r_c, p.rod_ratio)
    T_exh = (p.T_0 + p.K_s * signed_root(W_exh, _ROOT_LINEAR)) * expanded ** ((p.gamma_e - 1.0) / p.gamma_e)
    return {"W_cyl": W_cyl, "W_fuel": W_fuel, "W_exh": W_exh}, F_exh, T_exh


def _composition(x: Values, y: dict[str, Any], F_exh: Any, air: Gas, exhaust: Gas, p: Values) -> dict[str, Any]:
    """The derivatives of the burnt fractions, 1/s; a flow brings what is where it comes from."""
    turned = y["W_turbine"] + y["W_wg"]
    leaves = turned - y["W_egr"]

    def change(place: str, p_i: Any, T_i: Any, gas: Gas, *inflows: tuple[Any, Any]) -> Any:
        brought = sum(np.maximum(W, 0.0) * (F - x[f"F_{place}"]) for W, F in inflows)
        return gas.R * T_i / (p_i * p[f"V_{place}"]) * brought

    return {
        "F_mix": change(
            "mix", y["p_mix"], y["T_mix"], air, (y["W_a"], 0.0), (y["W_egr"], x.F_egr), (-y["W_mix"], x.F_boost)
        ),
        "F_boost": change("boost", x.p_boost, x.T_boost, air, (y["W_mix"], x.F_mix), (-y["W_th"], x.F_im)),
        "F_im": change("im", x.p_im, x.T_im, air, (y["W_th"], x.F_boost)),
        "F_em": change(
            "em", x.p_em, x.T_em, exhaust, (y["W_exh"], F_exh), (-y["W_turbine"], x.F_t), (-y["W_wg"], x.F_t)
        ),
        "F_t": change(
            "t", y["p_t"], y["T_t"], exhaust,
            (y["W_turbine"], x.F_em), (y["W_wg"], x.F_em), (-leaves, 0.0),
        ),
        "F_egr": change("egr", y["p_t"], y["T_egr"], exhaust, (y["W_egr"], x.F_t)),
    }  # fmt: skip


MODEL = Model(
    name="turbo_si_egr",
    description="Turbocharged spark-ignited engine with low-pressure EGR, mean values, 20 states",
    equations=_equations,
    inputs=INPUTS,
    states=STATES,
    outputs=OUTPUTS,
    parameters=PARAMETERS,
    # Fitted to steady points of the reference that observers with this model are tried on: docs/turbo_si_egr.md.
    parameter_sets={"reference": FITTED},
    # The throttle and the compressor have kinks, which steps of a fixed length would not see, as in turbo_si.
    solver_method="rodas4",
    solver_step=1e-3,
    solver_tolerance=1e-6,
)
