"""A turbocharged SI engine with low-pressure EGR, resolved in crank angle: filling and emptying of fifteen volumes.

The reference for an observer whose own model is in mean values. It shares no equation and no parameter with
`turbo_si`, `turbo_si_egr`, `fmus.gas` or `fmus.turbocharger`: its equations are those of `fmus.working_cycle`.

    ambient -W_a- mix -W_mix (compressor)- comp -W_cac (charge cooler)- boost -throttle- im -mouths- run[1..4]
    run[i] -intake valves- cyl[i] -exhaust valves- em -turbine, wastegate- t -catalyst- tail -silencer- ambient
    tail -cooler- egr -W_egr (LP-EGR valve)- mix

    volumes      dm/dt, db/dt, dU/dt by what flows in and out; p = m R T/V, u(T, F) = U/m; b in cells (boost, egr)
    orifices     isentropic, both ways, smooth at rest: all but the compressor, whose gas has inertia:
                 dW_mix/dt = (p_held - p_comp)/L_c,  p_held(W_mix, omega_tc) from its characteristic
    coolers      gas comes out at T - eps (T - T_coolant)
    exhaust      em loses hA_em (T_em - T_em_wall), tail loses hA_tail (T_tail - T_a)
    shaft        dK/dt = turbine - compressor - f_tc omega_tc^2,  K = J_tc omega_tc^2/2
    crank        dtheta/dt = N;  cylinders fire 1-3-4-2 at theta = 0, 180, 360, 540 deg
    fuel         burns with the air trapped, 1/lambda of what would take it all: see working_cycle.cylinder

A name alone is the mean over the last 720 deg, made anew every 180 deg; with `_inst` it is the value at the instant.
Stored are masses, burnt masses and energies, so `mass_stored - mass_net`, `burnt_stored - burnt_net` and
`energy_stored - energy_net` keep their first values but for rounding.

Parameters: [R] read in a source, [C] computed, [I] chosen as usual for engines of the kind; docs/gas_exchange.md has
the reasons. States start in the steady cycle of the inputs' start values [C].
"""

from __future__ import annotations

from typing import Any

import numpy as np

from fmus.component import Signal
from fmus.model import Model, Values
from fmus.working_cycle import cylinder, turbocharger
from fmus.working_cycle.contents import Contents, Ledger, contents
from fmus.working_cycle.cylinder import CYCLE, constant
from fmus.working_cycle.mixture import gas
from fmus.working_cycle.orifice import butterfly, carried, cooled, orifice
from fmus.working_cycle.rest import MEANS
from fmus.working_cycle.rest import STATES as REST

N_CYL = 4
FIRING = (0.0, 3.0 * np.pi, np.pi, 2.0 * np.pi)  # rad, firing top dead centre of each cylinder: 1-3-4-2
RPM = 30.0 / np.pi
_SEGMENT = CYCLE / N_CYL
# Means are made anew so much before the segment's end, rad, that a clock which meets the end has the new ones.
_EARLY = 0.01 * np.pi / 180.0
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
_SUMMED = (*(signal.name for signal in AVERAGED), "power", "speed", "time")
_MORE = (
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
    *(_instant(signal) for signal in (*AVERAGED, *_MORE)),
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
        shape=(len(_SUMMED),),
        local=True,
    ),
)
DISCRETE = (
    Signal("next_segment", "rad", _SEGMENT - _EARLY, "crank angle at which the means are made anew", local=True),
    Signal("past", "1", 0.0, "sums at the last four", shape=(N_CYL, len(_SUMMED)), local=True),
    Signal(
        "mean", "1", [MEANS[name] for name in _SUMMED], "means over the last 720 deg", shape=(len(_SUMMED),), local=True
    ),
)


def _equations(t: Any, x: Values, m: Values, u: Values, p: Values) -> tuple[dict[str, Any], dict[str, Any]]:
    omega = u.N / RPM
    ambient = gas(u.p_a, u.T_a, 0.0)
    ambient = Contents(ambient, ambient, 0.0, (0.0,))
    inside = {place: contents(x[f"m_{place}"], x[f"U_{place}"], x[f"b_{place}"], p[f"V_{place}"]) for place in CELLS}
    for i in range(N_CYL):
        inside[f"run{i}"] = contents(x.m_run[i], x.U_run[i], [x.b_run[i]], p.V_run)
    inside["ambient"] = ambient
    ledger = Ledger()
    flows: dict[str, Any] = {}
    heat: list[Any] = []

    def through(source: str, target: str, area: Any) -> Any:
        a, b = inside[source].back, inside[target].front
        W = orifice(a, b, area, p.near)
        ledger.move(source, target, carried(W, a, b))
        return W

    def cooler(source: str, target: str, area: Any, effectiveness: Any, coolant: Any) -> Any:
        a, b = inside[source].back, inside[target].front
        stream = cooled(orifice(a, b, area, p.near), a, b, effectiveness, coolant)
        ledger.move(source, target, stream)
        heat.append(stream.leaves - stream.enters)
        return stream.W

    degree = np.pi / 180.0
    flows["W_a"] = through("ambient", "mix", p.A_filter)
    flows["W_cac"] = cooler("comp", "boost", p.A_cac, p.eps_cac, u.T_a)
    flows["W_throttle"] = through("boost", "im", p.C_th * butterfly(p.D_th, u.throttle * degree, p.A_th))
    flows["W_wg"] = through("em", "t", p.C_wg * 0.25 * np.pi * (1e-3 * u.wastegate) ** 2)
    through("t", "tail", p.A_cat)
    flows["W_tail"] = through("tail", "ambient", p.A_silencer)
    cooler("tail", "egr", p.A_cooler, p.eps_egr, p.T_cool)
    flows["W_egr"] = through("egr", "mix", p.C_egr * butterfly(p.D_egr, u.egr_valve * degree, p.A_egr))

    # Turbocharger.
    omega_tc = turbocharger.shaft_speed(x.K_tc, p.J_tc)
    compressor = turbocharger.compressor(x.W_c, inside["mix"].back, omega_tc, p)
    stream = carried(x.W_c, inside["mix"].back, inside["comp"].front)
    ledger.move("mix", "comp", stream._replace(enters=stream.enters + compressor.power))
    turbine = turbocharger.turbine(inside["em"].back, inside["t"].front, omega_tc, p)
    stream = carried(turbine.W, inside["em"].back, inside["t"].front)
    ledger.move("em", "t", stream._replace(enters=stream.enters - turbine.power))
    friction = p.f_tc * omega_tc**2
    flows |= {"W_mix": x.W_c, "W_turbine": turbine.W}

    # Cylinders.
    flows |= {"W_cyl": 0.0, "W_exh": 0.0}
    work, made_fuel, made_burnt, fired = 0.0, 0.0, 0.0, 0.0
    cylinders = []
    for i in range(N_CYL):
        run, cyl = f"run{i}", f"cyl{i}"
        through("im", run, p.A_run)
        phi = np.remainder(x.theta - FIRING[i], CYCLE)
        volume = cylinder.space(phi, p).V
        inside[cyl] = contents(x.m_cyl[i], x.U_cyl[i], [x.b_cyl[i]], volume)
        now = cylinder.cylinder(phi, omega, inside[cyl].front, x.m_cyl[i], x.b_cyl[i], u["lambda"], p)
        flows["W_cyl"] += through(run, cyl, now.intake)
        flows["W_exh"] += through(cyl, "em", now.exhaust)
        ledger.make(cyl, now.burning.fuel, now.burning.burnt, now.burning.heat)
        ledger.gain(cyl, -now.work - now.loss)
        heat.append(now.loss)
        work, fired = work + now.work, fired + now.burning.heat
        made_fuel, made_burnt = made_fuel + now.burning.fuel, made_burnt + now.burning.burnt
        cylinders.append(inside[cyl].front)

    # Walls.
    lost = {
        "em": p.hA_em * (inside["em"].back.T - p.T_em_wall),
        "tail": p.hA_tail * (inside["tail"].back.T - u.T_a),
    }
    for place, power in lost.items():
        ledger.gain(place, -power)
        heat.append(power)

    burnt_out = ledger.burnt("ambient", (0.0,))[0]
    derivatives: dict[str, Any] = {
        "theta": omega,
        "W_c": (compressor.p - inside["comp"].front.p) / p.L_c,
        "K_tc": turbine.power - compressor.power - friction,
        "mass_net": made_fuel - ledger.mass("ambient"),
        "burnt_net": made_burnt - burnt_out,
        "energy_net": fired - ledger.energy("ambient") - work - friction - sum(heat),
    }
    for place in CELLS:
        derivatives[f"m_{place}"] = ledger.mass(place)
        derivatives[f"U_{place}"] = ledger.energy(place)
        derivatives[f"b_{place}"] = ledger.burnt(place, inside[place].cells)
    for kind in ("run", "cyl"):
        places = [f"{kind}{i}" for i in range(N_CYL)]
        derivatives[f"m_{kind}"] = [ledger.mass(place) for place in places]
        derivatives[f"U_{kind}"] = [ledger.energy(place) for place in places]
        derivatives[f"b_{kind}"] = [ledger.burnt(place, inside[place].cells)[0] for place in places]

    values = {f"p_{place}": inside[place].back.p for place in CELLS}
    values |= {f"T_{place}": inside[place].back.T for place in CELLS}
    values |= {f"F_{place}": inside[place].back.F for place in CELLS}
    values |= {"omega_tc": omega_tc, "power": work, "speed": omega, "time": 1.0, **flows}
    derivatives["sums"] = [values[name] for name in _SUMMED]
    return derivatives, _outputs(x, m, p, values, cylinders)


def _outputs(x: Values, m: Values, p: Values, values: dict[str, Any], cylinders: list[Any]) -> dict[str, Any]:
    mean = dict(zip(_SUMMED, m.mean, strict=True))
    displaced = N_CYL * 0.25 * np.pi * p.bore**2 * p.stroke

    def total(letter: str) -> Any:
        each = [x[f"{letter}_{place}"] for place in (*CELLS, "run", "cyl")]
        return sum(one.sum() if isinstance(one, np.ndarray) else one for one in each)

    return {
        **{signal.name: mean[signal.name] for signal in AVERAGED},
        "egr_ratio": mean["W_egr"] / mean["W_mix"],
        "IMEP": mean["power"] * CYCLE / (mean["speed"] * displaced),
        "omega_e": values["speed"],
        **{f"{signal.name}_inst": values[signal.name] for signal in (*AVERAGED, *_MORE)},
        "p_cyl": [one.p for one in cylinders],
        "T_cyl": [one.T for one in cylinders],
        "F_cyl": [one.F for one in cylinders],
        "mass_stored": total("m"),
        "burnt_stored": total("b"),
        "energy_stored": total("U") + x.K_tc,
    }


def _indicators(t: Any, x: Values, m: Values, u: Values, p: Values) -> dict[str, Any]:
    return {"segment": x.theta - m.next_segment}


def _transition(t: Any, x: Values, m: Values, u: Values, p: Values, above: Values) -> dict[str, Any]:
    passed = above.segment
    elapsed = x.sums[-1] - m.past[-1, -1]
    mean = (x.sums - m.past[-1]) / np.where(elapsed > 0.0, elapsed, 1.0)
    following = (np.floor((x.theta + 2.0 * _EARLY) / _SEGMENT) + 1.0) * _SEGMENT - _EARLY
    return {
        "next_segment": np.where(passed, following, m.next_segment),
        "past": np.where(passed, np.array([x.sums, *m.past[:-1]]), m.past),
        # At the start, where nothing was summed yet, the means stay as they were given.
        "mean": np.where(np.logical_and(passed, elapsed > 0.0), mean, m.mean),
    }


MODEL = Model(
    name="gas_exchange",
    description="Turbocharged SI engine with low-pressure EGR, resolved in crank angle by filling and emptying",
    equations=_equations,
    inputs=INPUTS,
    states=STATES,
    outputs=OUTPUTS,
    parameters=PARAMETERS,
    discrete=DISCRETE,
    indicator_names=("segment",),
    indicators=_indicators,
    transition=_transition,
    solver_step=30e-6,
)
