"""The crank mechanism: how far a piston is down at a crank angle, and the inertia that the crank feels.

Every function takes floats and symbols alike. Crank angles are in rad from the piston's top dead centre.

Equations [R]: Heywood, Internal Combustion Engine Fundamentals, 1988, Eq. 2.4 to 2.6 (piston travel); Rizzoni, Estimate
of indicated torque from crankshaft speed fluctuations, IEEE Transactions on Vehicular Technology 38, 1989 (inertia).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np


class PistonMotion(NamedTuple):
    """A piston's travel x [m] down from top dead centre, and dx/dalpha and d2x/dalpha2 [m/rad, m/rad2]."""

    travel: Any
    slope: Any
    curvature: Any


def piston_motion(alpha: Any, radius: Any, ratio: Any) -> PistonMotion:
    """The motion at alpha [rad] of a piston on a crank of `radius` r [m], `ratio` r/l of it to the connecting rod.

    With k = r/l and w = sqrt(1 - k^2 sin^2 alpha):
    x = r (1 - cos alpha + (1 - w)/k), dx/dalpha = r sin alpha (1 + k cos alpha/w),
    d2x/dalpha2 = r (cos alpha + k (cos^2 alpha - sin^2 alpha)/w + k^3 sin^2 alpha cos^2 alpha/w^3). k is above 0 and
    below 1.
    """
    s, c = np.sin(alpha), np.cos(alpha)
    w = np.sqrt(1.0 - (ratio * s) ** 2)
    # (1 - w)/k without the difference of two near numbers: k sin^2/(1 + w).
    travel = radius * (1.0 - c + ratio * s**2 / (1.0 + w))
    curvature = radius * (c + ratio * (c**2 - s**2) / w + ratio**3 * (s * c) ** 2 / w**3)
    return PistonMotion(travel, radius * s * (1.0 + ratio * c / w), curvature)


def crank_inertia(rotating: Any, reciprocating: Any, pistons: Sequence[PistonMotion]) -> tuple[Any, Any]:
    """(J [kg.m2], dJ/dalpha [kg.m2/rad]): J = J_0 + m sum (dx/dalpha)^2, dJ/dalpha = 2 m sum dx/dalpha d2x/dalpha2.

    J_0 `rotating` [kg.m2], m `reciprocating` [kg] with each piston. Kinetic energy is J omega^2/2, so without torques
    J omega' + dJ/dalpha omega^2/2 = 0.
    """
    J = rotating + reciprocating * sum(piston.slope**2 for piston in pistons)
    return J, 2.0 * reciprocating * sum(piston.slope * piston.curvature for piston in pistons)
