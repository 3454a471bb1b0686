"""One injector, or two opposite ones, that suddenly give too much or too little: relative errors and what is true.

    offset_i = amount  from `begin` on, for i = `cylinder` and, where `opposite` is 1, the one that fires 360 deg later
    code     = i where it has too much, -i where too little, 0 before

The codes are those of `observers.diagnosis`. Firing order 1-3-4-2: 1 and 4 are opposite, and 2 and 3.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from fmus.component import Signal
from fmus.model import Model, Values

CYLINDERS = (1, 2, 3, 4)


def _equations(t: Any, x: Values, m: Values, u: Values, p: Values) -> tuple[dict[str, Any], dict[str, Any]]:
    amount = np.where(u.angle >= p.begin, p.amount, 0.0)
    offsets = {}
    for i in CYLINDERS:
        named = np.abs(p.cylinder - i) < 0.5
        # Opposite cylinders' numbers add up to five.
        other = np.logical_and(p.opposite > 0.5, np.abs(p.cylinder + i - 5.0) < 0.5)
        offsets[f"offset_{i}"] = np.where(np.logical_or(named, other), amount, 0.0)
    return {}, {**offsets, "code": np.sign(amount) * p.cylinder}


MODEL = Model(
    name="injection_fault",
    description="Relative error of one injector or of two opposite ones, from a crank angle on",
    equations=_equations,
    inputs=(Signal("angle", "deg", 0.0, "crank angle, counted on", nominal=720.0),),
    outputs=(
        *(Signal(f"offset_{i}", "1", 0.0, f"cylinder {i}, relative injection error", 0.1) for i in CYLINDERS),
        Signal("code", "1", 0, "i: cylinder i has too much fuel, -i: too little, 0: none", kind="integer"),
    ),
    parameters=(
        Signal("cylinder", "1", 1, "whose injector it is", minimum=1, maximum=4, kind="integer"),
        Signal("amount", "1", 0.25, "relative error", minimum=-1.0),
        Signal(
            "opposite", "1", 0, "1: the cylinder that fires 360 deg later has the same error", 1, 0, 1, kind="integer"
        ),
        Signal("begin", "deg", 0.0, "the crank angle it begins at", nominal=720.0),
    ),
)
