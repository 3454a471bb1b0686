"""What happens in a cylinder: combustion by Wiebe's function, heat to the walls, valves that open and shut.

Every function takes floats and symbols alike. `phi` is a crank angle in rad from the cylinder's firing top dead centre.
"""

from __future__ import annotations

from typing import Any

import numpy as np


def wiebe(phi: Any, start: Any, duration: Any, a: Any, m: Any) -> tuple[Any, Any]:
    """(x_b, dx_b/dphi [1/rad]): the burnt fraction x_b = 1 - exp(-a s^(m+1)), s = (phi - start)/duration, 0 before.

    It is 1 - exp(-a) at the end of `duration` and goes on towards 1: all that can burn does. Angles in rad.
    Wiebe; Heywood, Internal Combustion Engine Fundamentals, 1988, Eq. 9.1.
    """
    since = (phi - start) / duration
    burns = since > 0.0
    # Of a power of zero the slope by its exponent is not finite.
    s = np.where(burns, since, 1.0)
    left = np.exp(-a * s ** (m + 1.0))
    return np.where(burns, 1.0 - left, 0.0), np.where(burns, a * (m + 1.0) * s**m * left / duration, 0.0)


def hohenberg(p: Any, T: Any, V: Any, speed: Any) -> Any:
    """Heat transfer to the walls [W/m2/K]: 130 V^-0.06 (1e-5 p)^0.8 T^-0.4 (v + 1.4)^0.8.

    p [Pa], T [K], V [m3] of the gas, v `speed` [m/s] the piston's mean one. Hohenberg, SAE 790825, 1979.
    """
    return 130.0 * V**-0.06 * (1e-5 * p) ** 0.8 * T**-0.4 * (speed + 1.4) ** 0.8


def valve_opening(phi: Any, opens: Any, shuts: Any) -> Any:
    """How far a valve is open, 0 to 1, between the angles at which it `opens` and `shuts` [rad]; once in two turns.

    ((cos((phi - c)/2) - cos(w/4))/(1 - cos(w/4)))^2 with c the middle and w the width; 0 where the bracket is below. It
    leaves its seat with a slope of zero. Chosen [I] for being periodic and smooth.
    """
    seat = np.cos(0.25 * (shuts - opens))
    lift = np.maximum(np.cos(0.5 * (phi - 0.5 * (opens + shuts))) - seat, 0.0)
    return (lift / (1.0 - seat)) ** 2
