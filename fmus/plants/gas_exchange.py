"""A turbocharged SI engine with low-pressure EGR, resolved in crank angle: filling and emptying of sixteen volumes.

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

from typing import Any, NamedTuple

import numpy as np

from fmus.model import Model, Values
from fmus.working_cycle import cylinder, turbocharger
from fmus.working_cycle.contents import Contents, contents
from fmus.working_cycle.cylinder import CYCLE
from fmus.working_cycle.engine_signals import (
    AVERAGED,
    CELLS,
    DISCRETE,
    EARLY,
    FIRING,
    INPUTS,
    MORE,
    N_CYL,
    OUTPUTS,
    PARAMETERS,
    SEGMENT,
    STATES,
    SUMMED,
)
from fmus.working_cycle.mixture import Gas, gas
from fmus.working_cycle.network import Network
from fmus.working_cycle.orifice import butterfly

_DEGREE = np.pi / 180.0
_RPM = 30.0 / np.pi


class _Shaft(NamedTuple):
    """The turbocharger at an instant: speed [rad/s], dW_mix/dt [kg/s2], power to the shaft and its friction [W]."""

    omega: Any
    growth: Any
    power: Any
    friction: Any
    W_turbine: Any


class _Fires(NamedTuple):
    """The cylinders at an instant, summed: flows in and out, fuel and burnt gas made [kg/s], work and heat [W]."""

    W_in: Any
    W_out: Any
    fuel: Any
    burnt: Any
    work: Any
    heat: Any
    gases: tuple[Gas, ...]


def _places(x: Values, u: Values, p: Values) -> dict[str, Contents]:
    """All volumes but the cylinders, and the ambient, by name."""
    outside = gas(u.p_a, u.T_a, 0.0)
    places = {"ambient": Contents(outside, outside, 0.0, (0.0,))}
    for place in CELLS:
        places[place] = contents(x[f"m_{place}"], x[f"U_{place}"], x[f"b_{place}"], p[f"V_{place}"])
    for i in range(N_CYL):
        places[f"run{i}"] = contents(x.m_run[i], x.U_run[i], [x.b_run[i]], p.V_run)
    return places


def _ducts(network: Network, u: Values, p: Values) -> dict[str, Any]:
    """Flows [kg/s] through what has no moving gas of its own, by name; heat to the walls of the exhaust."""
    throttle = p.C_th * butterfly(p.D_th, u.throttle * _DEGREE, p.A_th)
    egr_valve = p.C_egr * butterfly(p.D_egr, u.egr_valve * _DEGREE, p.A_egr)
    wastegate = p.C_wg * 0.25 * np.pi * (1e-3 * u.wastegate) ** 2
    network.passes("t", "tail", p.A_cat)
    network.cools("tail", "egr", p.A_cooler, p.eps_egr, p.T_cool)
    network.loses("em", p.hA_em * (network.places["em"].back.T - p.T_em_wall))
    network.loses("tail", p.hA_tail * (network.places["tail"].back.T - u.T_a))
    return {
        "W_a": network.passes("ambient", "mix", p.A_filter),
        "W_cac": network.cools("comp", "boost", p.A_cac, p.eps_cac, u.T_a),
        "W_throttle": network.passes("boost", "im", throttle),
        "W_wg": network.passes("em", "t", wastegate),
        "W_tail": network.passes("tail", "ambient", p.A_silencer),
        "W_egr": network.passes("egr", "mix", egr_valve),
    }


def _turbocharger(network: Network, x: Values, p: Values) -> _Shaft:
    places = network.places
    omega = turbocharger.shaft_speed(x.K_tc, p.J_tc)
    compressor = turbocharger.compressor(x.W_c, places["mix"].back, omega, p)
    turbine = turbocharger.turbine(places["em"].back, places["t"].front, omega, p)
    network.drives("mix", "comp", x.W_c, compressor.power)
    network.drives("em", "t", turbine.W, -turbine.power)
    friction = p.f_tc * omega**2
    growth = (compressor.p - places["comp"].front.p) / p.L_c
    return _Shaft(omega, growth, turbine.power - compressor.power - friction, friction, turbine.W)


def _cylinders(network: Network, omega: Any, x: Values, u: Values, p: Values) -> _Fires:
    W_in, W_out, fuel, burnt, work, heat = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    gases = []
    for i in range(N_CYL):
        run, cyl = f"run{i}", f"cyl{i}"
        phi = np.remainder(x.theta - FIRING[i], CYCLE)
        inside = contents(x.m_cyl[i], x.U_cyl[i], [x.b_cyl[i]], cylinder.space(phi, p).V)
        network.places[cyl] = inside
        now = cylinder.cylinder(phi, omega, inside.front, x.m_cyl[i], x.b_cyl[i], u["lambda"], p)
        network.passes("im", run, p.A_run)
        W_in = W_in + network.passes(run, cyl, now.intake)
        W_out = W_out + network.passes(cyl, "em", now.exhaust)
        network.ledger.make(cyl, now.burning.fuel, now.burning.burnt, now.burning.heat)
        network.ledger.gain(cyl, -now.work)
        network.loses(cyl, now.loss)
        fuel, burnt, heat = fuel + now.burning.fuel, burnt + now.burning.burnt, heat + now.burning.heat
        work = work + now.work
        gases.append(inside.front)
    return _Fires(W_in, W_out, fuel, burnt, work, heat, tuple(gases))


def _equations(t: Any, x: Values, m: Values, u: Values, p: Values) -> tuple[dict[str, Any], dict[str, Any]]:
    omega = u.N / _RPM
    network = Network(_places(x, u, p), p.near)
    flows = _ducts(network, u, p)
    shaft = _turbocharger(network, x, p)
    fires = _cylinders(network, omega, x, u, p)
    flows |= {"W_mix": x.W_c, "W_turbine": shaft.W_turbine, "W_cyl": fires.W_in, "W_exh": fires.W_out}

    places, ledger = network.places, network.ledger
    values = {f"p_{place}": places[place].back.p for place in CELLS}
    values |= {f"T_{place}": places[place].back.T for place in CELLS}
    values |= {f"F_{place}": places[place].back.F for place in CELLS}
    values |= {"omega_tc": shaft.omega, "power": fires.work, "speed": omega, "time": 1.0, **flows}
    derivatives: dict[str, Any] = {
        "theta": omega,
        "W_c": shaft.growth,
        "K_tc": shaft.power,
        "mass_net": fires.fuel - ledger.mass("ambient"),
        "burnt_net": fires.burnt - ledger.burnt("ambient", (0.0,))[0],
        "energy_net": fires.heat - ledger.energy("ambient") - fires.work - shaft.friction - network.heat,
        "sums": [values[name] for name in SUMMED],
    }
    for place in CELLS:
        derivatives[f"m_{place}"] = ledger.mass(place)
        derivatives[f"U_{place}"] = ledger.energy(place)
        derivatives[f"b_{place}"] = ledger.burnt(place, places[place].cells)
    for kind in ("run", "cyl"):
        each = [f"{kind}{i}" for i in range(N_CYL)]
        derivatives[f"m_{kind}"] = [ledger.mass(place) for place in each]
        derivatives[f"U_{kind}"] = [ledger.energy(place) for place in each]
        derivatives[f"b_{kind}"] = [ledger.burnt(place, places[place].cells)[0] for place in each]
    return derivatives, _outputs(x, m, p, values, fires.gases)


def _outputs(x: Values, m: Values, p: Values, values: dict[str, Any], cylinders: tuple[Gas, ...]) -> dict[str, Any]:
    mean = dict(zip(SUMMED, m.mean, strict=True))
    displaced = N_CYL * 0.25 * np.pi * p.bore**2 * p.stroke

    def total(letter: str) -> Any:
        each = [x[f"{letter}_{place}"] for place in (*CELLS, "run", "cyl")]
        return sum(one.sum() if isinstance(one, np.ndarray) else one for one in each)

    return {
        **{signal.name: mean[signal.name] for signal in AVERAGED},
        "egr_ratio": mean["W_egr"] / mean["W_mix"],
        "IMEP": mean["power"] * CYCLE / (mean["speed"] * displaced),
        "omega_e": values["speed"],
        **{f"{signal.name}_inst": values[signal.name] for signal in (*AVERAGED, *MORE)},
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
    following = (np.floor((x.theta + 2.0 * EARLY) / SEGMENT) + 1.0) * SEGMENT - EARLY
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
