"""The observer of the loop's measure: as light as an observer can be, so that the loop itself weighs most."""

from __future__ import annotations

from typing import Any

from fmus.component import Signal
from fmus.model import Model, Values
from fmus.plants.driveline import INPUTS, MEASURED, PARAMETERS, RPM, STATES

ESTIMATES = STATES
PERIOD = Signal("sample_time", "s", 1e-3, "period")


def _equations(t: Any, x: Values, m: Values, u: Values, p: Values) -> tuple[dict[str, Any], dict[str, Any]]:
    return {}, {}


def _sample(t: Any, x: Values, m: Values, u: Values, p: Values) -> dict[str, Any]:
    """m+ = m + h (A_2 m + B u + E_2 + L (y - C m)), the middle location's model, forward Euler; L by hand."""
    beyond = p.theta_e0 - p.theta_1
    torque = p.k * m.theta_e - (p.k_1 - p.k) * beyond + p.b_sm * (p.tau * m.omega_c - m.omega_p)
    wrong = u.y / RPM - m.omega_c
    return {
        "theta_e": m.theta_e + p.sample_time * (p.tau * m.omega_c - m.omega_p - 0.05 * wrong),
        "omega_c": m.omega_c + p.sample_time * ((u.T_eng - p.B_e * m.omega_c - p.tau * torque) / p.J_e + 20.0 * wrong),
        "omega_p": m.omega_p + p.sample_time * (torque / p.J_v + 0.5 * wrong),
    }


MODEL = Model(
    name="light_luenberger",
    description="One Luenberger observer of the driveline's middle location",
    equations=_equations,
    role="observer",
    inputs=INPUTS + MEASURED,
    parameters=(*PARAMETERS, PERIOD),
    discrete=ESTIMATES,
    sample=_sample,
    sample_time="sample_time",
)
