"""An observer for tests that tells whether what it sees is beyond a threshold."""

import numpy as np

from fmus.component import Signal
from fmus.model import Model

BEYOND = Model(
    name="beyond",
    description="1 where the magnitude of its input is above a threshold, else 0",
    role="observer",
    equations=lambda t, x, m, u, p: ({}, {"hit": np.where(np.abs(u.u) > p.threshold, p.told, 0.0)}),
    inputs=(Signal("u", "rpm"),),
    outputs=(Signal("hit"),),
    parameters=(Signal("threshold", "rpm", 1.0), Signal("told", "1", 1.0)),
)
