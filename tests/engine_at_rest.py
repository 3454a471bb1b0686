"""The turbocharged engine in equilibrium, from idle to full load, for the tests of its equations and of its FMU."""

from __future__ import annotations

from functools import cache

import numpy as np

from fmus.jacobians import jacobians, point
from fmus.plants.turbo_si import INPUTS, MODEL, OUTPUTS, PARAMETER_SETS, PARAMETERS, STATES
from fmus.steady import Steady, steady_state

ENGINE = jacobians(MODEL)
STATE_NAMES = [signal.name for signal in STATES]
INPUT_NAMES = [signal.name for signal in INPUTS]
OUTPUT_NAMES = [signal.name for signal in OUTPUTS]
NOMINAL = np.array([signal.nominal for signal in STATES])
SETS = [None, *PARAMETER_SETS]
# From idle to full load, throttle choked and open, wastegate shut and open.
OPERATION = [
    {"N": 800.0, "alpha": 0.0},
    {"N": 2000.0, "alpha": 0.15, "lambda": 0.95},
    {"N": 3000.0, "alpha": 0.3, "lambda": 1.1, "u_wg": 0.2},
    {"N": 5500.0, "alpha": 1.0, "lambda": 0.85, "u_wg": 0.3},
    {"N": 1500.0, "alpha": 1.0, "u_wg": 1.0, "p_a": 8e4, "T_a": 270.0},
]


def settled(values: dict[str, float], parameter_set: str | None = None) -> Steady:
    """The equilibrium at the inputs and parameters given, found once."""
    return _settled(tuple(sorted(values.items())), parameter_set)


@cache
def _settled(values: tuple[tuple[str, float], ...], parameter_set: str | None) -> Steady:
    return steady_state(ENGINE, point(MODEL, dict(values), parameter_set))


def parameters(parameter_set: str | None = None) -> dict[str, float]:
    """Every parameter of a set by name."""
    return dict(zip([signal.name for signal in PARAMETERS], point(MODEL, None, parameter_set).p, strict=True))
