"""The engine of `turbo_si` with its speed as a state: J_e domega/dt = torque - T_load, N = (30/pi) omega in rpm.

Everything else is `fmus.plants.turbo_si`. J_e is chosen [I]: crankshaft, flywheel and clutch of a small engine. T_load
starts at the engine's torque in the equilibrium of set A.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from fmus.component import Signal
from fmus.model import Values
from fmus.plants import turbo_si

RPM = 30.0 / np.pi
_SPEED = next(signal for signal in turbo_si.INPUTS if signal.name == "N")
_TORQUE = next(signal for signal in turbo_si.OUTPUTS if signal.name == "torque")


def _equations(t: Any, x: Values, m: Values, u: Values, p: Values) -> tuple[dict[str, Any], dict[str, Any]]:
    inputs = {signal.name: x.N if signal is _SPEED else u[signal.name] for signal in turbo_si.INPUTS}
    derivatives, outputs = turbo_si.mean_values(x, inputs, p)
    return {**derivatives, "N": RPM * (outputs["torque"] - u.T_load) / p.J_e}, outputs


MODEL = replace(
    turbo_si.MODEL,
    name="turbo_si_speed",
    description="Turbocharged spark-ignited engine, mean values, with its speed as a state and a load torque",
    equations=_equations,
    states=(*turbo_si.STATES, _SPEED),
    inputs=(
        *(signal for signal in turbo_si.INPUTS if signal is not _SPEED),
        Signal("T_load", "N.m", _TORQUE.start, "load torque", nominal=_TORQUE.nominal),
    ),
    parameters=(*turbo_si.PARAMETERS, Signal("J_e", "kg.m2", 0.15, "engine, inertia [I]", 0.15, minimum=1e-9)),
)
