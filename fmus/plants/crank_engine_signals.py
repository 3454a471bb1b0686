"""What `crank_engine` declares: parameters with their sources, states with their start values, inputs and outputs.

Parameters: [R] read in a source, [C] computed, [I] chosen. Geometry, inertia and masses of the default are those of the
paper's engine; fuels are Heywood's, Internal Combustion Engine Fundamentals, 1988, Table D.4, and in set `si` those of
the TCSISimTestbed, whose 1.8 L engine it takes after.
"""

from __future__ import annotations

import numpy as np

from fmus.component import Signal

CYLINDERS = (1, 2, 3, 4)
FIRING_ORDER = (1, 3, 4, 2)
# What a cylinder waits for next: stage_i.
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
    _angle("IVO", 370.0, "intake valves open [I], not before EVC, so that nothing burnt flows back", 300.0, 420.0),
    _angle("IVC", 580.0, "intake valves shut [I]", 500.0, 640.0),
    _constant("A_int", "m2", 6e-4, "intake valves of a cylinder, effective area when open [I]"),
    _constant("A_exh", "m2", 5e-4, "exhaust valves of a cylinder, effective area when open [I]"),
    _constant("m_port", "kg", 5e-5, "intake port of a cylinder, gas that what flows back is mixed with [I]", 1e-9),
    Signal("PI_lin", "1", 0.98, "valves, pressure ratio above which the flow is linear [I]", 0.1, 0.5, 0.9999),
    _constant("fmep_0", "Pa", 1.70e5, "friction mean pressure [C], a 2.3 L engine's"),
    _constant("fmep_1", "Pa/rpm", -24.3, "friction mean pressure per speed [C], a 2.3 L engine's", -np.inf),
    _constant("fmep_2", "Pa/rpm2", 6.9e-3, "friction mean pressure per speed squared [C], a 2.3 L engine's", -np.inf),
    _constant("dyno_p", "N.m.s/rad", 2.0, "dynamometer, torque per speed above what is demanded [I]"),
    _constant("dyno_i", "N.m/rad", 5.0, "dynamometer, torque per angle ahead of what is demanded [I]"),
    _constant("afr_most", "1", 1000.0, "air-fuel ratio shown where there is less fuel than that [I]", 1.0),
    *(
        _constant(f"injector_{i}", "1", 0.0, f"cylinder {i}, relative error of its injector [I]", -1.0)
        for i in CYLINDERS
    ),
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
        "EVO": 140.0, "EVC": 370.0, "IVO": 375.0, "IVC": 590.0, "A_int": 7e-4, "A_exh": 6e-4,
    },
    "imbalanced": {
        "injector_1": 0.03, "injector_2": -0.04, "injector_3": 0.02, "injector_4": -0.01,
        "fill_1": 0.005, "fill_2": 0.01, "fill_3": -0.01, "fill_4": -0.005,
    },
}  # fmt: skip

# The periodic state of the default set at 8 bar and theta = 0, by cylinder [C].
STARTS = {
    "U": (626.1751812, 377.6842254, 227.6919689, 15.28704202),
    "m": (0.0007464438627, 0.0006238961032, 0.0007357643041, 2.926874532e-05),
    "fuel": (2.200912005e-05, 1.839576278e-05, 8.597458656e-07, 8.629976901e-07),
    "burnt": (2.437449214e-06, 1.839574668e-05, 8.597451244e-07, 8.629969346e-07),
    "port": (1.262582631e-08, 1.262582637e-08, 9.120961236e-15, 1.26258265e-08),
    "work": (-295.9884705, 517.8542091, 61.14542785, 0.0),
    "gone": (0.0007177136111, 0.0001225477596, 0.000717713611, 0.0007171751176),
    "gone_heat": (536.683023, 102.5922354, 536.6830232, 536.3134661),
    "imep": (799983.5935, 799983.5933, 799983.5934, 799983.5936),
    "m_exh": (0.0007177136113, 0.0007177136109, 0.0007177136111, 0.000717713611),
    "burn": (2.116200073e-05, 2.116200073e-05, 2.116200073e-05, 2.116200073e-05),
    "share": (0.02948529828, 0.02948529842, 0.02948529829, 0.02948529842),
    "m_open": (0.0007464438631, 0.0007464438628, 0.000746443863, 0.0007464438629),
    "T_port": (646.01788, 646.0178796, 646.0178791, 646.0178793),
    "afr": (32.91520718, 32.91520702, 32.91520718, 32.91520702),
    "p": (6423067.669, 215230.0906, 129754.3286, 156808.6827),
    "T": (963.8916162, 695.5783843, 355.5809638, 600.1348649),
    "W_int": (0.0, 0.0, 0.001702508896, 0.0),
    "W_exh": (0.0, 0.05624302293, 0.0, 0.001863182475),
    "H_int": (0.0, 0.0, 650.3175382, 0.0),
    "H_exh": (0.0, 45283.17495, 0.0, 1294.274471),
    "Q_burn": (334278.191, 0.0, 0.0, 0.0),
    "Q_wall": (12097.35533, 1054.454529, -353.7002809, 219.1362813),
}
STATES = (
    Signal("theta", "rad", 0.0, "crank angle from the first cylinder's firing top dead centre, counted on"),
    Signal("omega_e", "rad/s", 149.63312, "speed of the crankshaft", nominal=100.0),
    Signal("hold", "N.m", 113.124798, "dynamometer, torque at the speed demanded", nominal=100.0),
    *(
        Signal(f"{name}_{i}", unit, STARTS[name][i - 1], f"cylinder {i}, {what}", nominal, minimum, local=local)
        for name, unit, what, nominal, minimum, local in (
            ("U", "J", "internal energy", 100.0, 0.0, False),
            ("m", "kg", "mass of the gas", 1e-4, 0.0, False),
            ("fuel", "kg", "fuel in the gas, burnt or not", 1e-5, 0.0, False),
            ("burnt", "kg", "fuel in the gas that is burnt", 1e-5, 0.0, False),
            ("port", "kg", "fuel that flowed back into its intake port", 1e-6, 0.0, True),
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
    *(Signal(f"m_f_{i}", "kg", 2.1162e-5, f"cylinder {i}, fuel commanded for a cycle", 1e-5, 0.0) for i in CYLINDERS),
    *(Signal(f"offset_{i}", "1", 0.0, f"cylinder {i}, relative injection error", 0.1, -1.0) for i in CYLINDERS),
    Signal("speed_demand", "rad/s", 50.0 * np.pi, "speed that the dynamometer holds", nominal=100.0, minimum=0.0),
)
OUTPUTS = (
    *(
        Signal(f"afr_{i}", "1", STARTS["afr"][i - 1], f"cylinder {i}, air-fuel ratio of what it last exhausted")
        for i in CYLINDERS
    ),
    Signal("T_exh", "K", 646.01788, "temperature of what the cylinders last exhausted, mixed", nominal=1000.0),
    *(
        Signal(f"{name}_{i}", unit, STARTS[name][i - 1], f"cylinder {i}, {what}", nominal)
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
    Signal("torque_friction", "N.m", 26.002078, "torque of friction, against the motion", nominal=10.0),
    Signal("torque_load", "N.m", 98.231772, "torque of the dynamometer, against the motion", nominal=100.0),
)
