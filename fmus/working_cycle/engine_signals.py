"""The signals of the plant `gas_exchange`: what it takes, gives, stores and is set by."""

from __future__ import annotations

import numpy as np

from fmus.component import Signal
from fmus.working_cycle import cylinder, turbocharger
from fmus.working_cycle.cylinder import CYCLE, constant
from fmus.working_cycle.rest import MEANS
from fmus.working_cycle.rest import STATES as REST

N_CYL = 4
FIRING = (0.0, 3.0 * np.pi, np.pi, 2.0 * np.pi)  # rad, firing top dead centre of each cylinder: 1-3-4-2
SEGMENT = CYCLE / N_CYL
# Means are made anew so much before the segment's end, rad, that a clock which meets the end has the new ones.
EARLY = 0.01 * np.pi / 180.0
# Volumes, their cells of burnt gas, and the volume parameter of each.
CELLS = {"mix": 1, "comp": 1, "boost": 5, "im": 1, "em": 1, "t": 1, "tail": 1, "egr": 5}

INPUTS = (
    Signal("N", "rpm", 3200.0, "engine speed", nominal=1000.0, minimum=0.0),
    Signal("throttle", "deg", 60.0, "throttle, opening", nominal=10.0, minimum=0.0, maximum=90.0),
    Signal("wastegate", "mm", 11.6, "wastegate, diameter of its opening", nominal=10.0, minimum=0.0, maximum=40.0),
    Signal("egr_valve", "deg", 10.0, "LP-EGR valve, opening", nominal=10.0, minimum=0.0, maximum=90.0),
    Signal("lambda", "1", 1.0, "air over what the fuel wants", minimum=0.5, maximum=2.0),
    Signal("p_a", "Pa", 101325.0, "ambient pressure", nominal=1e5, minimum=1e4),
    Signal("T_a", "K", 298.0, "ambient temperature", nominal=300.0, minimum=200.0),
)
PARAMETERS = (
    *cylinder.PARAMETERS,
    *turbocharger.PARAMETERS,
    constant("V_mix", "m3", 1.0e-3, "volume, compressor inlet from the EGR joint [I]"),
    constant("V_comp", "m3", 2.0e-3, "volume, compressor outlet and hot side of the charge cooler [I]"),
    constant("V_boost", "m3", 4.0e-3, "volume, charge cooler and pipe to the throttle [I]"),
    constant("V_im", "m3", 2.5e-3, "volume, intake plenum [I]"),
    constant("V_run", "m3", 0.4e-3, "volume, intake runner and port of one cylinder [I]"),
    constant("V_em", "m3", 1.0e-3, "volume, exhaust ports and manifold [I]"),
    constant("V_t", "m3", 2.0e-3, "volume, turbine outlet to the catalyst [I]"),
    constant("V_tail", "m3", 6.0e-3, "volume, behind the catalyst, from which the EGR is taken [I]"),
    constant("V_egr", "m3", 1.0e-3, "volume, EGR cooler and pipe [I]"),
    constant("A_filter", "m2", 1.0e-3, "air filter and duct, effective area: 1.5 kPa at 60 g/s [I]"),
    constant("A_cac", "m2", 9.0e-4, "charge cooler, effective area: 2 kPa at 60 g/s [I]"),
    constant("A_run", "m2", 1.2e-3, "mouth of an intake runner, effective area [I]"),
    constant("A_cat", "m2", 1.2e-3, "catalyst, effective area: 3 kPa at 60 g/s [I]"),
    constant("A_silencer", "m2", 8.8e-4, "silencer, effective area: 5 kPa at 60 g/s [I]"),
    constant("A_cooler", "m2", 3.0e-4, "EGR cooler, effective area: 0.5 kPa at 8 g/s [I]"),
    constant("D_th", "m", 57e-3, "throttle, diameter [I]"),
    constant("A_th", "m2", 4e-6, "throttle, leak when shut [I]"),
    constant("C_th", "1", 0.8, "throttle, discharge coefficient [I]"),
    constant("D_egr", "m", 45e-3, "LP-EGR valve, diameter [I]"),
    constant("A_egr", "m2", 1e-6, "LP-EGR valve, leak when shut [I]"),
    constant("C_egr", "1", 0.75, "LP-EGR valve, discharge coefficient [I]"),
    constant("C_wg", "1", 0.7, "wastegate, discharge coefficient [I]"),
    constant("eps_cac", "1", 0.8, "charge cooler, effectiveness; cooled by the ambient [I]"),
    constant("eps_egr", "1", 0.9, "EGR cooler, effectiveness [I]"),
    constant("T_cool", "K", 363.0, "EGR cooler, coolant [I]"),
    constant("hA_em", "W/K", 8.0, "exhaust ports and manifold, conductance to the wall [I]"),
    constant("T_em_wall", "K", 700.0, "exhaust ports and manifold, wall [I]"),
    constant("hA_tail", "W/K", 2.0, "exhaust pipe, conductance to the ambient [I]"),
)
_PLACES = {
    "mix": "at the compressor's inlet",
    "boost": "before the throttle",
    "im": "in the intake manifold",
    "em": "in the exhaust manifold",
    "t": "behind the turbine",
    "egr": "behind the EGR cooler",
}
# What has a mean: the volumes and flows that a control model has.
AVERAGED = (
    *(Signal(f"p_{place}", "Pa", 0.0, f"pressure {_PLACES[place]}", nominal=1e5) for place in ("boost", "im", "em")),
    *(
        Signal(f"T_{place}", "K", 0.0, f"temperature {_PLACES[place]}", nominal=300.0)
        for place in ("boost", "im", "em")
    ),
    Signal("omega_tc", "rad/s", 0.0, "speed of the turbocharger", nominal=5000.0),
    *(Signal(f"F_{place}", "1", 0.0, f"burnt fraction {about}", nominal=0.01) for place, about in _PLACES.items()),
    Signal("W_a", "kg/s", 0.0, "flow of fresh air, before the EGR joint (MAFa)", nominal=0.01),
    Signal("W_mix", "kg/s", 0.0, "flow into the compressor (MAF)", nominal=0.01),
    Signal("W_cac", "kg/s", 0.0, "flow out of the charge cooler (MAFh)", nominal=0.01),
    Signal("W_egr", "kg/s", 0.0, "flow through the LP-EGR valve (EGR-DP)", nominal=0.001),
    Signal("W_cyl", "kg/s", 0.0, "flow into the cylinders", nominal=0.01),
)
SUMMED = (*(signal.name for signal in AVERAGED), "power", "speed", "time")
MORE = (
    *(
        Signal(f"p_{place}", "Pa", 0.0, f"pressure, {place}", nominal=1e5)
        for place in ("mix", "comp", "t", "tail", "egr")
    ),
    Signal("T_tail", "K", 0.0, "temperature behind the catalyst", nominal=1000.0),
    Signal("F_tail", "1", 0.0, "burnt fraction behind the catalyst"),
    Signal("W_throttle", "kg/s", 0.0, "flow through the throttle", nominal=0.01),
    Signal("W_exh", "kg/s", 0.0, "flow out of the cylinders", nominal=0.01),
    Signal("W_turbine", "kg/s", 0.0, "flow through the turbine", nominal=0.01),
    Signal("W_wg", "kg/s", 0.0, "flow through the wastegate", nominal=0.01),
    Signal("W_tail", "kg/s", 0.0, "flow out of the tail pipe", nominal=0.01),
)


def _instant(signal: Signal) -> Signal:
    return Signal(f"{signal.name}_inst", signal.unit, 0.0, f"{signal.description}, instantaneous", signal.nominal)


OUTPUTS = (
    *AVERAGED,
    Signal("egr_ratio", "1", 0.0, "W_egr over W_mix", nominal=0.01),
    Signal("IMEP", "Pa", 0.0, "net indicated mean effective pressure", nominal=1e5),
    Signal("omega_e", "rad/s", 0.0, "speed of the crankshaft", nominal=100.0),
    *(_instant(signal) for signal in (*AVERAGED, *MORE)),
    Signal("p_cyl", "Pa", 0.0, "pressure in each cylinder", nominal=1e5, shape=(N_CYL,)),
    Signal("T_cyl", "K", 0.0, "temperature in each cylinder", nominal=1000.0, shape=(N_CYL,)),
    Signal("F_cyl", "1", 0.0, "burnt fraction in each cylinder", shape=(N_CYL,)),
    Signal("mass_stored", "kg", 0.0, "mass of all gas in the engine", nominal=0.01),
    Signal("burnt_stored", "kg", 0.0, "mass of all burnt gas in the engine", nominal=0.001),
    Signal("energy_stored", "J", 0.0, "energy of all gas and of the turbocharger", nominal=1e3),
)


def _state(name: str, unit: str, description: str, nominal: float, shape: tuple[int, ...] = ()) -> Signal:
    return Signal(name, unit, REST[name], description, nominal, shape=shape, local=True)


def _volume(place: str, cells: int) -> tuple[Signal, ...]:
    return (
        _state(f"m_{place}", "kg", f"mass, {place}", 1e-3),
        _state(f"U_{place}", "J", f"internal energy, {place}", 100.0),
        _state(f"b_{place}", "kg", f"burnt mass by cell, {place}", 1e-4, (cells,)),
    )


STATES = (
    Signal("theta", "rad", 0.0, "crank angle, cylinder 1 fires at 0", nominal=1.0),
    *(signal for place, cells in CELLS.items() for signal in _volume(place, cells)),
    *(
        _state(f"{letter}_{place}", unit, f"{what} of each, {place}", nominal, (N_CYL,))
        for place in ("run", "cyl")
        for letter, unit, what, nominal in (
            ("m", "kg", "mass", 1e-3),
            ("U", "J", "internal energy", 100.0),
            ("b", "kg", "burnt mass", 1e-4),
        )
    ),
    _state("W_c", "kg/s", "flow through the compressor", 0.01),
    _state("K_tc", "J", "kinetic energy of the turbocharger", 100.0),
    Signal("mass_net", "kg", 0.0, "mass that came in less what went out", nominal=0.01),
    Signal("burnt_net", "kg", 0.0, "burnt mass that came in or into being less what went out", nominal=0.01),
    Signal("energy_net", "J", 0.0, "energy that came in or was set free less what went out", nominal=1e3),
    Signal(
        "sums",
        "1",
        0.0,
        "integrals over time of what has a mean, of power, speed and 1",
        shape=(len(SUMMED),),
        local=True,
    ),
)
DISCRETE = (
    Signal("next_segment", "rad", SEGMENT - EARLY, "crank angle at which the means are made anew", local=True),
    Signal("past", "1", 0.0, "sums at the last four", shape=(N_CYL, len(SUMMED)), local=True),
    Signal(
        "mean", "1", [MEANS[name] for name in SUMMED], "means over the last 720 deg", shape=(len(SUMMED),), local=True
    ),
)
