"""Four injectors that are off, and a manifold in which the exhaust mixes: a small plant to close a loop on."""

from __future__ import annotations

from typing import Any

import numpy as np

from fmus.component import Signal
from fmus.model import Model, Values

ORDER = (1, 3, 4, 2)


def _equations(t: Any, x: Values, m: Values, u: Values, p: Values) -> tuple[dict[str, Any], dict[str, Any]]:
    afr = {i: p.m_air / (u[f"m_f_{i}"] * (1.0 + p[f"offset_{i}"])) for i in ORDER}
    # From 135 deg after its firing top dead centre on each cylinder exhausts for 180 deg.
    turned = x.theta - np.radians(135.0)
    place = np.floor((turned - 4.0 * np.pi * np.floor(turned / (4.0 * np.pi))) / np.pi)
    now = afr[ORDER[3]]
    for j in (2, 1, 0):
        now = np.where(place < j + 0.5, afr[ORDER[j]], now)
    return {"theta": p.omega, "mixed": (now - x.mixed) / p.tau}, {
        "angle": x.theta,
        "afr": x.mixed,
    }


MODEL = Model(
    name="imbalanced_exhaust",
    description="Four cylinders whose exhaust mixes in a manifold",
    equations=_equations,
    inputs=tuple(Signal(f"m_f_{i}", "kg", 2e-5, nominal=2e-5) for i in (1, 2, 3, 4)),
    states=(Signal("theta", "rad"), Signal("mixed", "1", 20.0)),
    outputs=(Signal("angle", "rad"), Signal("afr")),
    parameters=(
        Signal("omega", "rad/s", 50.0 * np.pi),
        Signal("m_air", "kg", 4e-4),
        Signal("tau", "s", 0.03),
        *(Signal(f"offset_{i}") for i in (1, 2, 3, 4)),
    ),
    solver_step=1e-4,
)
