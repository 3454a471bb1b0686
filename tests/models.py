"""Small models whose solutions are known, for the tests of the exporter and of the step loop."""

from __future__ import annotations

import numpy as np

from fmus.component import Signal
from fmus.model import Model

# x' = -a x + sin(t) + u has the closed form of `lag_solution`.
LAG = Model(
    name="lag",
    description="x' = -a x + sin t + u",
    equations=lambda t, x, m, u, p: ({"x": -p.a * x.x + np.sin(t) + u.u}, {"y": 2.0 * x.x + 3.0 * u.u}),
    inputs=(Signal("u"),),
    states=(Signal("x", start=1.0),),
    outputs=(Signal("y"),),
    parameters=(Signal("a", "1/s", 2.0),),
)


def lag_solution(t: float, a: float = 2.0, x0: float = 1.0) -> float:
    """x(t) of LAG for u = 0."""
    forced = (a * np.sin(t) - np.cos(t)) / (a * a + 1.0)
    return float(forced + (x0 + 1.0 / (a * a + 1.0)) * np.exp(-a * t))


VAN_DER_POL = Model(
    name="van_der_pol",
    description="x'' = mu (1 - x^2) x' - x, stiff for a large mu",
    equations=lambda t, x, m, u, p: ({"x": x.v, "v": p.mu * (1.0 - x.x**2) * x.v - x.x}, {}),
    states=(Signal("x", "m", 2.0), Signal("v", "m/s", 0.0)),
    parameters=(Signal("mu", "1", 1.0),),
)

BALL = Model(
    name="ball",
    description="A bouncing ball: every impact reverses the velocity, times e",
    equations=lambda t, x, m, u, p: ({"height": x.v, "v": -p.g}, {}),
    states=(Signal("height", "m", 1.0), Signal("v", "m/s", 0.0)),
    discrete=(Signal("bounces", kind="integer"),),
    parameters=(Signal("g", "m/s2", 9.81), Signal("e", "1", 0.7)),
    indicator_names=("above_ground",),
    indicators=lambda t, x, m, u, p: {"above_ground": x.height},
    transition=lambda t, x, m, u, p, above: {
        "v": np.where(above.above_ground, x.v, -p.e * x.v),
        "height": np.where(above.above_ground, x.height, 0.0),
        "bounces": m.bounces + np.where(above.above_ground, 0.0, 1.0),
    },
)

RELAY = Model(
    name="relay",
    description="x' = -sign(x): slides along x = 0, where events never end",
    equations=lambda t, x, m, u, p: ({"x": -m.side}, {}),
    states=(Signal("x", start=0.5),),
    discrete=(Signal("side", start=1.0),),
    indicator_names=("positive",),
    indicators=lambda t, x, m, u, p: {"positive": x.x},
    transition=lambda t, x, m, u, p, above: {"side": np.where(above.positive, 1.0, -1.0)},
)

BLOW_UP = Model(
    name="blow_up",
    description="x' = x^2 reaches infinity at t = 1/x(0)",
    equations=lambda t, x, m, u, p: ({"x": x.x**2}, {}),
    states=(Signal("x", start=2.0),),
)

# A sampled model with arrays: x(k|k) = A x(k-1|k-1) + L y(k), with gains as parameters.
FILTER = Model(
    name="filter",
    description="A sampled linear filter of two states",
    role="observer",
    equations=lambda t, x, m, u, p: ({}, {"estimate": m.z}),
    inputs=(Signal("y", "rpm"),),
    outputs=(Signal("estimate", shape=(2,)),),
    discrete=(Signal("z", shape=(2,), start=(1.0, -1.0), local=True),),
    parameters=(
        Signal("A", shape=(2, 2), start=((0.9, 0.1), (0.0, 0.8))),
        Signal("L", shape=(2,), start=(0.5, 0.25)),
        Signal("period", "s", 0.01),
    ),
    sample=lambda t, x, m, u, p: {"z": p.A @ m.z + p.L * u.y},
    sample_time="period",
)

EVERY_KIND = Model(
    name="every-kind",
    description="Integers, booleans and reals in and out",
    equations=lambda t, x, m, u, p: (
        {},
        {"sum": u.count + u.gain * p.scale, "positive": u.gain > 0, "doubled": 2 * u.count},
    ),
    inputs=(Signal("count", kind="integer"), Signal("gain"), Signal("switch", kind="boolean")),
    outputs=(Signal("sum"), Signal("positive", kind="boolean"), Signal("doubled", kind="integer")),
    parameters=(Signal("scale", start=0.5),),
)
