"""Engines and parts for tests on a crank clock."""

from __future__ import annotations

import math
from typing import Annotated

import numpy as np
from loop_parts import Clockwork

from fmus.component import Role, Signal, Vector
from fmus.model import Model

SPEED = 1000.0 * (2.0 * math.pi / 60.0)  # rad/s

# theta' = omega, omega' = rate: at rate 0 the speed stays the same to the last bit.
ENGINE = Model(
    name="turning",
    description="A crankshaft that speeds up evenly",
    equations=lambda t, x, m, u, p: ({"omega": p.rate, "theta": x.omega}, {"ratio": x.omega / 100.0}),
    states=(Signal("omega", "rad/s", SPEED), Signal("theta", "rad")),
    outputs=(Signal("ratio"),),
    parameters=(Signal("rate", "rad/s2", 0.0),),
)

# J omega' = torque - b omega - a omega^2: nonlinear, so that the way matters.
LOADED = Model(
    name="loaded",
    description="A crankshaft with a load that grows with its speed",
    equations=lambda t, x, m, u, p: (
        {"omega": (u.torque - 0.02 * x.omega - 5e-4 * x.omega * x.omega) / 0.15, "theta": x.omega},
        {},
    ),
    inputs=(Signal("torque", "N.m"),),
    states=(Signal("omega", "rad/s", 60.0), Signal("theta", "rad")),
    solver_step=1e-4,
)

DRIVEN = Model(
    name="driven",
    description="A crankshaft whose speed is a number that it is given",
    equations=lambda t, x, m, u, p: ({"theta": 50.0 + u.pull}, {"omega": 50.0 + u.pull}),
    inputs=(Signal("pull"),),
    states=(Signal("theta", "rad"),),
    outputs=(Signal("omega", "rad/s", 50.0),),
)

OSCILLATOR = Model(
    name="oscillator",
    description="A rod that swings",
    equations=lambda t, x, m, u, p: ({"x": x.v, "v": u.force - 0.1 * x.v - 400.0 * x.x}, {}),
    inputs=(Signal("force", "N.m"),),
    states=(Signal("x"), Signal("v")),
)

LATEST = Model(
    name="latest",
    description="Keeps its input as it is at each sample",
    role="observer",
    equations=lambda t, x, m, u, p: ({}, {"y": m.kept}),
    inputs=(Signal("u", "rad/s"),),
    outputs=(Signal("y", "rad/s"),),
    discrete=(Signal("kept", "rad/s"),),
    parameters=(Signal("period", "s", 1e-3),),
    sample=lambda t, x, m, u, p: {"kept": u.u},
    sample_time="period",
)


class _BrokenSpeed(Clockwork):
    role: Role = "plant"
    outputs = (Signal("omega", "rad/s", 100.0),)

    def start(self, t0: float, u: Vector) -> Vector:
        return np.array([100.0])

    def step(self, t: float, h: float, u: Vector) -> Vector:
        return np.array([100.0 if t + h < self.at else math.nan])


def broken_speed(at: Annotated[float, "s"]) -> _BrokenSpeed:
    """A speed of 100 rad/s that is no number any more from a time on."""
    return _BrokenSpeed(at, "nan")
