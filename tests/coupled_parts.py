"""Parts for tests of coupling: halves of an oscillator, and parts with direct feed-through that make loops."""

from __future__ import annotations

import numpy as np

from fmus.component import Signal, Vector
from fmus.model import Model

# Two masses on springs, cut at the spring between them: one half gives its position, the other the force.
MASS = Model(
    name="mass",
    description="A mass on a spring to the ground, pushed by a force: x'' = F - x",
    equations=lambda t, x, m, u, p: ({"x": x.v, "v": u.force - x.x}, {}),
    inputs=(Signal("force", "N"),),
    states=(Signal("x", "m", 1.0), Signal("v", "m/s")),
    solver_method="rk4",
    solver_step=1e-3,
)
SPRING = Model(
    name="spring",
    description="The other mass with the spring between: z'' = k (x - z) - z, F = k (z - x)",
    equations=lambda t, x, m, u, p: (
        {"z": x.w, "w": p.k * (u.x - x.z) - x.z},
        {"force": p.k * (x.z - u.x)},
    ),
    inputs=(Signal("x", "m"),),
    states=(Signal("z", "m"), Signal("w", "m/s")),
    outputs=(Signal("force", "N"),),
    parameters=(Signal("k", "N/m", 0.5),),
    solver_step=1e-3,
)

LINE = Model(
    name="line",
    description="y = gain u + offset + drift t",
    equations=lambda t, x, m, u, p: ({}, {"y": p.gain * u.u + p.offset + p.drift * t}),
    inputs=(Signal("u"),),
    outputs=(Signal("y"),),
    parameters=(Signal("gain", start=1.0), Signal("offset"), Signal("drift", "1/s")),
)
COSINE = Model(
    name="cosine",
    description="y = cos u",
    equations=lambda t, x, m, u, p: ({}, {"y": np.cos(u.u)}),
    inputs=(Signal("u"),),
    outputs=(Signal("y"),),
)
FILTER = Model(
    name="filter",
    description="x' = (u - x) / T, y = x + direct u: a loop with a state",
    equations=lambda t, x, m, u, p: ({"x": (u.u - x.x) / p.T}, {"y": x.x + p.direct * u.u}),
    inputs=(Signal("u"),),
    states=(Signal("x"),),
    outputs=(Signal("y"),),
    parameters=(Signal("T", "s", 0.1), Signal("direct", start=0.5)),
)


class Adder:
    """y = u + 1 in Python: it can be taken back where `forgetful` is not asked for."""

    role = "plant"
    inputs = (Signal("u"),)
    outputs = (Signal("y"),)
    feedthrough = frozenset({("y", "u")})

    def start(self, t0: float, u: Vector) -> Vector:
        """y."""
        return np.array([u[0] + 1.0])

    def step(self, t: float, h: float, u: Vector) -> Vector:
        """y."""
        return np.array([u[0] + 1.0])

    def native(self) -> None:
        """Only Python."""

    def close(self) -> None:
        """Nothing is held."""


def forgetful() -> Adder:
    """One that cannot be taken back."""
    return Adder()


SQUARE = Model(
    name="square",
    description="y = u^2",
    equations=lambda t, x, m, u, p: ({}, {"y": u.u * u.u}),
    inputs=(Signal("u"),),
    outputs=(Signal("y"),),
)
