"""Flow through orifices, both ways and smooth at rest, and what it carries."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from fmus.working_cycle.mixture import Gas, enthalpy


class Stream(NamedTuple):
    """What flows between two places: mass and burnt gas [kg/s], enthalpy where it leaves and where it enters [W]."""

    W: Any
    burnt: Any
    leaves: Any
    enters: Any


def orifice(a: Gas, b: Gas, area: Any, near: Any, stages: int = 1) -> Any:
    """W [kg/s] from a to b through an effective area [m2]; `near` is the relative pressure drop of smoothing [1].

    W = A p/sqrt(R T) s/(s^2 + s_0^2)^(1/4),  s = 2 gamma/(gamma - 1) q (q - P),  q = P^(1/gamma),  s_0 = 2 `near`
    P = p_downstream/p_upstream, not below the critical ratio; p, R, T, gamma are those upstream.

    sqrt(s) is the isentropic flow function (Heywood, Internal Combustion Engine Fundamentals, Appendix C). Its slope
    at P = 1 has no bound; with s_0 the flow is linear there, and at a drop of 5 `near` 1 % less than without.
    Of `stages` nozzles in series each bears the same part of the ratio: P is its root.
    """
    forward = a.p >= b.p
    p, R_T = np.where(forward, a.p, b.p), np.where(forward, a.R * a.T, b.R * b.T)
    gamma = np.where(forward, a.gamma, b.gamma)
    ratio = np.where(forward, b.p, a.p) / p
    if stages == 2:
        ratio = np.sqrt(ratio)
    ratio = np.maximum(ratio, _critical(gamma))
    q = ratio ** (1.0 / gamma)
    s = 2.0 * gamma / (gamma - 1.0) * q * (q - ratio)
    s_0 = 2.0 * near
    W = area * p / np.sqrt(R_T) * s / np.sqrt(np.sqrt(s * s + s_0 * s_0))
    return np.where(forward, W, -W)


def _critical(gamma: Any) -> Any:
    """(2/(gamma + 1))^(gamma/(gamma - 1)) within 1e-6 for gamma from 1.2 to 1.42: where s is largest, so flat."""
    x = gamma - 1.3
    return 0.54572762 + x * (-0.18071816 + x * (0.06501096 - 0.02407217 * x))


def carried(W: Any, a: Gas, b: Gas) -> Stream:
    """The stream of W [kg/s] from a to b, with the composition and enthalpy of where it comes from."""
    forward = W >= 0.0
    burnt, power = W * np.where(forward, a.F, b.F), W * np.where(forward, a.h, b.h)
    return Stream(W, burnt, power, power)


def cooled(W: Any, a: Gas, b: Gas, effectiveness: Any, coolant: Any) -> Stream:
    """The stream of W [kg/s] from a to b through a cooler: gas comes out at T - effectiveness (T - coolant)."""
    forward = W >= 0.0
    T, F = np.where(forward, a.T, b.T), np.where(forward, a.F, b.F)
    before = W * np.where(forward, a.h, b.h)
    after = W * enthalpy(T - effectiveness * (T - coolant), F)
    return Stream(W, W * F, np.where(forward, before, after), np.where(forward, after, before))


def butterfly(diameter: Any, angle: Any, leak: Any) -> Any:
    """Area [m2] of a butterfly valve that is `angle` [rad] open, `leak` [m2] when shut: pi D^2/4 (1 - cos) + leak."""
    return 0.25 * np.pi * diameter**2 * (1.0 - np.cos(angle)) + leak
