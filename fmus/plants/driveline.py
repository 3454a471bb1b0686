"""A driveline whose elasticity jumps at two torsion angles: three locations, continuous torque, no resets.

Source: Balluchi, Benvenuti, Di Benedetto, Sangiovanni-Vincentelli, A hybrid observer for the driveline
dynamics, ECC 2001, Eq. 1-2 and Figures 1-2.

    theta_e' = tau omega_c - omega_p
    J_e omega_c' = T_eng - B_e omega_c - tau T_sm
    J_v omega_p' = T_sm
    T_sm = f(theta_e) + b_sm (tau omega_c - omega_p)
    y = (30/pi) omega_c                                      (rpm)

Conventions. Every signal is a deviation from the equilibrium (theta_e0, omega_c0, omega_p0) at 2000 rpm in
second gear, whose torques cancel: states and input 0 are at rest there. The absolute torsion is
theta_e + theta_e0. The paper's f is the profile g(theta) = k theta + (k_1 - k) (theta beyond +-theta_1)
minus g(theta_e0); for theta_e0 > theta_1 that is the published three-piece f term by term, and it
needs no case distinction for an equilibrium in another location.

    location 1: theta_e + theta_e0 < -theta_1    slope k_1
    location 2: between                          slope k
    location 3: theta_e + theta_e0 > theta_1     slope k_1

Parameters: [R] read in the paper, [I] chosen, since the paper's table of values is lost.
Default set: theta_e0, theta_1 [R]; tau, J_e, J_v, B_e, b_sm, k, k_1 [I], such that a step of -10 N.m reaches
both published thresholds and settles in the middle location, as Figure 6 does.
Set `wide_gap`, neighbours of Althoff and Krogh's powertrain benchmark: theta_1 (half-gap 0.03 rad), tau (ratio
12), k_1, J_e, J_v [R there]; k, b_sm, B_e, theta_e0 [I]. Their gap is free play (k = 0), in which the torsion
could not be observed from the engine speed; k = 1000 N.m/rad keeps the benchmark's size without that.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any

import numpy as np

from fmus.component import Signal
from fmus.hybrid import Automaton, Location, Transition
from fmus.model import Model, Values

STATES = (
    Signal("theta_e", "rad", 0.0, "driveline torsion, deviation", nominal=0.01),
    Signal("omega_c", "rad/s", 0.0, "crankshaft speed, deviation", nominal=1.0),
    Signal("omega_p", "rad/s", 0.0, "wheel speed, deviation", nominal=0.1),
)
INPUTS = (Signal("T_eng", "N.m", 0.0, "engine torque, deviation", nominal=10.0),)
MEASURED = (Signal("y", "rpm", 0.0, "crankshaft speed, deviation", nominal=10.0),)
PARAMETERS = (
    Signal("tau", "1", 0.125, "transmission ratio, wheel over crankshaft speed", minimum=1e-6),
    Signal("J_e", "kg.m2", 0.15, "primary driveline inertia", minimum=1e-9),
    Signal("J_v", "kg.m2", 80.0, "secondary driveline inertia", minimum=1e-9),
    Signal("B_e", "N.m.s/rad", 0.05, "primary driveline viscous coefficient", minimum=0.0),
    Signal("b_sm", "N.m.s/rad", 40.0, "driveline viscous coefficient", minimum=0.0),
    Signal("k", "N.m/rad", 1500.0, "elasticity between the two angles", minimum=0.0),
    Signal("k_1", "N.m/rad", 5000.0, "elasticity beyond the two angles", minimum=0.0),
    Signal("theta_e0", "rad", 0.025, "torsion at the equilibrium, absolute"),
    Signal("theta_1", "rad", 0.015, "angle at which the elasticity jumps", minimum=0.0),
)
PARAMETER_SETS = {
    "wide_gap": {
        "tau": 1.0 / 12.0,
        "J_e": 0.3,
        "J_v": 140.0,
        "B_e": 0.05,
        "b_sm": 60.0,
        "k": 1000.0,
        "k_1": 1.0e4,
        "theta_e0": 0.035,
        "theta_1": 0.03,
    }
}
RPM = 30.0 / np.pi


def elastic_torque(theta_e: Any, location: Any, p: Any) -> Any:
    """Elastic torque f of a location's own branch, N.m, at the torsion deviation theta_e [rad].

    `location` 1, 2, 3; `p` has k, k_1, theta_e0, theta_1. Paper, Section 2, f(x1).
    """
    theta = theta_e + p.theta_e0
    beyond = (p.k_1 - p.k) * p.theta_1
    low, middle, high = p.k_1 * theta + beyond, p.k * theta, p.k_1 * theta - beyond
    return np.where(location < 1.5, low, np.where(location < 2.5, middle, high)) - _torque_at_equilibrium(p)


def _torque_at_equilibrium(p: Any) -> Any:
    beyond = (p.k_1 - p.k) * (np.maximum(p.theta_e0 - p.theta_1, 0.0) + np.minimum(p.theta_e0 + p.theta_1, 0.0))
    return p.k * p.theta_e0 + beyond


def _equations(t: Any, x: Values, m: Values, u: Values, p: Values) -> tuple[dict[str, Any], dict[str, Any]]:
    slip = p.tau * x.omega_c - x.omega_p
    torque = elastic_torque(x.theta_e, m.location, p) + p.b_sm * slip
    derivatives = {
        "theta_e": slip,
        "omega_c": (u.T_eng - p.B_e * x.omega_c - p.tau * torque) / p.J_e,
        "omega_p": torque / p.J_v,
    }
    return derivatives, {"y": RPM * x.omega_c}


def _indicators(t: Any, x: Values, m: Values, u: Values, p: Values) -> dict[str, Any]:
    theta = x.theta_e + p.theta_e0
    return {"lower": theta + p.theta_1, "upper": theta - p.theta_1}


def _transition(t: Any, x: Values, m: Values, u: Values, p: Values, above: Values) -> dict[str, Any]:
    return {"location": 1.0 + above.lower + above.upper}


MODEL = Model(
    name="driveline",
    description="Driveline with a jump of elasticity at two torsion angles (ECC 2001), deviations from equilibrium",
    equations=_equations,
    inputs=INPUTS,
    states=STATES,
    outputs=MEASURED,
    parameters=PARAMETERS,
    discrete=(
        Signal("location", "1", 3, "1 below both angles, 2 between, 3 above", minimum=1, maximum=3, kind="integer"),
    ),
    indicator_names=("lower", "upper"),
    indicators=_indicators,
    transition=_transition,
    parameter_sets=PARAMETER_SETS,
)


def automaton(parameters: Mapping[str, float]) -> Automaton:
    """The hybrid automaton of Figure 1: x = (theta_e, omega_c, omega_p), u = T_eng, y in rpm.

    `parameters` holds every parameter by name, SI. E_i = (f_i(0) of the location's branch) (0, -tau/J_e, 1/J_v).
    Raises ModelError: through Automaton, where shapes contradict.
    """
    p = SimpleNamespace(**parameters)
    tau, J_e, J_v = parameters["tau"], parameters["J_e"], parameters["J_v"]
    theta_1, theta_e0 = parameters["theta_1"], parameters["theta_e0"]
    free = np.array([[0.0, tau, -1.0], [0.0, -parameters["B_e"] / J_e, 0.0], [0.0, 0.0, 0.0]])
    carried = np.array([0.0, -tau / J_e, 1.0 / J_v])
    slopes = (parameters["k_1"], parameters["k"], parameters["k_1"])
    locations = []
    for number, slope in enumerate(slopes, start=1):
        row = np.array([slope, parameters["b_sm"] * tau, -parameters["b_sm"]])
        locations.append(
            Location(
                A=free + np.outer(carried, row),
                B=np.array([[0.0], [1.0 / J_e], [0.0]]),
                C=np.array([[0.0, RPM, 0.0]]),
                E=carried * float(elastic_torque(0.0, number, p)),
            )
        )
    torsion = np.array([1.0, 0.0, 0.0])
    transitions = (
        Transition(1, 2, torsion, theta_e0 + theta_1),
        Transition(2, 1, -torsion, -theta_e0 - theta_1),
        Transition(2, 3, torsion, theta_e0 - theta_1),
        Transition(3, 2, -torsion, theta_1 - theta_e0),
    )
    return Automaton(STATES, INPUTS, MEASURED, tuple(locations), transitions)
