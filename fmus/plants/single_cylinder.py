"""One cylinder between an intake and an exhaust that stay as they are: what `gas_exchange` has four of.

It is there to be compared: with a reactor of Cantera under the same laws (docs/gas_exchange.md), and for its speed.

    dm/dt = W_in - W_ex + W_fuel,  db/dt likewise for burnt gas,  dU/dt = enthalpies + heat set free - p dV/dt - loss
    p = m R T/V,  u(T, F) = U/m;  the laws are those of working_cycle.cylinder and working_cycle.orifice

A very large lambda motors the cylinder. It starts at bottom dead centre before compression, filled as the intake is.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from fmus.component import Signal
from fmus.model import Model, Values
from fmus.working_cycle import cylinder
from fmus.working_cycle.contents import Ledger, contents
from fmus.working_cycle.cylinder import CYCLE
from fmus.working_cycle.mixture import energy, gas, gas_constant
from fmus.working_cycle.orifice import carried, orifice

_P_IN, _T_IN, _F_START = 1.0e5, 320.0, 0.03
_V_START = 4.96075e-4 * 9.6 / 8.6  # m3, the whole space of the parameters' start values
_M_START = _P_IN * _V_START / (float(gas_constant(_F_START)) * _T_IN)

INPUTS = (
    Signal("N", "rpm", 3200.0, "engine speed", nominal=1000.0, minimum=0.0),
    Signal("lambda", "1", 1.0, "air over what the fuel wants; very large: motored", minimum=0.5),
    Signal("p_in", "Pa", _P_IN, "pressure of the intake", nominal=1e5, minimum=1e3),
    Signal("T_in", "K", _T_IN, "temperature of the intake", nominal=300.0, minimum=200.0),
    Signal("F_in", "1", 0.0, "burnt fraction of the intake", minimum=0.0, maximum=1.0),
    Signal("p_ex", "Pa", 1.05e5, "pressure of the exhaust", nominal=1e5, minimum=1e3),
    Signal("T_ex", "K", 1000.0, "temperature of the exhaust", nominal=1000.0, minimum=200.0),
    Signal("F_ex", "1", 1.0, "burnt fraction of the exhaust", minimum=0.0, maximum=1.0),
)
STATES = (
    Signal("theta", "rad", -np.pi, "crank angle, fires at 0", nominal=1.0),
    Signal("m", "kg", _M_START, "mass", nominal=1e-3),
    Signal("U", "J", _M_START * float(energy(_T_IN, _F_START)), "internal energy", nominal=100.0),
    Signal("b", "kg", _M_START * _F_START, "burnt mass", nominal=1e-4),
    Signal("work", "J", 0.0, "work done on the piston", nominal=100.0),
    Signal("lost", "J", 0.0, "heat lost to the walls", nominal=100.0),
)
OUTPUTS = (
    Signal("omega_e", "rad/s", 0.0, "speed of the crankshaft", nominal=100.0),
    Signal("V", "m3", 0.0, "volume", nominal=1e-4),
    Signal("p", "Pa", 0.0, "pressure", nominal=1e5),
    Signal("T", "K", 0.0, "temperature", nominal=1000.0),
    Signal("F", "1", 0.0, "burnt fraction"),
    Signal("W_in", "kg/s", 0.0, "flow through the intake valves", nominal=0.01),
    Signal("W_ex", "kg/s", 0.0, "flow through the exhaust valves", nominal=0.01),
)


def _equations(t: Any, x: Values, m: Values, u: Values, p: Values) -> tuple[dict[str, Any], dict[str, Any]]:
    omega = np.pi / 30.0 * u.N
    phi = np.remainder(x.theta, CYCLE)
    volume = cylinder.space(phi, p).V
    inside = contents(x.m, x.U, [x.b], volume)
    now = cylinder.cylinder(phi, omega, inside.front, x.m, x.b, u["lambda"], p)
    intake, exhaust = gas(u.p_in, u.T_in, u.F_in), gas(u.p_ex, u.T_ex, u.F_ex)
    ledger = Ledger()
    W_in = orifice(intake, inside.front, now.intake, p.near)
    W_ex = orifice(inside.back, exhaust, now.exhaust, p.near)
    ledger.move("intake", "cylinder", carried(W_in, intake, inside.front))
    ledger.move("cylinder", "exhaust", carried(W_ex, inside.back, exhaust))
    ledger.make("cylinder", now.burning.fuel, now.burning.burnt, now.burning.heat)
    ledger.gain("cylinder", -now.work - now.loss)
    derivatives = {
        "theta": omega,
        "m": ledger.mass("cylinder"),
        "U": ledger.energy("cylinder"),
        "b": ledger.burnt("cylinder", inside.cells)[0],
        "work": now.work,
        "lost": now.loss,
    }
    outputs = {
        "omega_e": omega,
        "V": volume,
        "p": inside.front.p,
        "T": inside.front.T,
        "F": inside.F,
        "W_in": W_in,
        "W_ex": W_ex,
    }
    return derivatives, outputs


MODEL = Model(
    name="single_cylinder",
    description="One cylinder of an SI engine between an intake and an exhaust that stay as they are",
    equations=_equations,
    inputs=INPUTS,
    states=STATES,
    outputs=OUTPUTS,
    parameters=cylinder.PARAMETERS,
    solver_step=30e-6,
)
