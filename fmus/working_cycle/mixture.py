"""Air and burnt gas as one mixture: gas constant, energy and specific heats over temperature and burnt fraction.

    R = R_air + F (R_burnt - R_air),  likewise u, h, cv;  gamma = 1 + R/cv
    cv = sum k_i (T/1000 K)^i,  u = integral of cv,  h = u + R T,  h = 0 at 298.15 K for air and for burnt gas

F is the mass of burnt gas over that of all gas. Burnt gas is what complete combustion of a fuel CH1.87 leaves of just
enough air: CO2, H2O, N2, Ar, frozen (no dissociation). The coefficients are fitted [C] to the NASA polynomials of
GRI-Mech 3.0 (Smith et al., 1999) from 250 to 3200 K: cv within 0.7 %, h within 1 K times cp.
As both enthalpies are zero at 298.15 K, what combustion sets free is the fuel's heating value there.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

T_REFERENCE = 298.15  # K, where h is zero
R_AIR = 287.105  # J/kg/K [C] from 20.95 % O2, 78.12 % N2, 0.93 % Ar
R_BURNT = 286.632  # J/kg/K [C]
AF_STOICHIOMETRIC = (
    14.6  # kg of air over kg of CH1.87 [C], as Heywood, Internal Combustion Engine Fundamentals, Table D.4
)
# J/kg/K, of (T/1000 K)^0 to ^5
_AIR = (709.67764334, -119.62045085, 565.8196058, -416.45391853, 124.5575166, -13.4904546)
_BURNT = (708.16677003, 116.53138376, 374.74577312, -312.41131212, 94.68263938, -10.19291284)
# The first guess of a temperature: cv = b - d/(T + T_0)^2, as near as such a form comes (5 K).
_T_0 = 2311.52817  # K
_B = (1113.300697, 1338.461165)  # J/kg/K, air and burnt gas
_D = (2836.586180e6, 3980.914054e6)  # J.K/kg


class Gas(NamedTuple):
    """Gas at a place: pressure [Pa], temperature [K], burnt fraction [1], R [J/kg/K], gamma [1], enthalpy [J/kg]."""

    p: Any
    T: Any
    F: Any
    R: Any
    gamma: Any
    h: Any


def _mixed(air: float, burnt: float, F: Any) -> Any:
    return air + F * (burnt - air)


def gas_constant(F: Any) -> Any:
    """R [J/kg/K] at the burnt fraction F."""
    return _mixed(R_AIR, R_BURNT, F)


def _integral(coefficients: tuple[float, ...], T: float) -> float:
    return sum(k * 1e3 * (T / 1e3) ** (i + 1) / (i + 1) for i, k in enumerate(coefficients))


def _zero(coefficients: tuple[float, ...], R: float) -> float:
    """What makes h = u + R T zero at the reference."""
    return -_integral(coefficients, T_REFERENCE) - R * T_REFERENCE


def _zero_of_guess(b: float, d: float, R: float) -> float:
    return -b * T_REFERENCE - d / (T_REFERENCE + _T_0) - R * T_REFERENCE


_U_0 = (_zero(_AIR, R_AIR), _zero(_BURNT, R_BURNT))
_GUESS_0 = (_zero_of_guess(_B[0], _D[0], R_AIR), _zero_of_guess(_B[1], _D[1], R_BURNT))


def specific_heat(T: Any, F: Any) -> Any:
    """cv [J/kg/K] at T [K] and the burnt fraction F."""
    x, value = 1e-3 * T, 0.0
    for air, burnt in zip(reversed(_AIR), reversed(_BURNT), strict=True):
        value = value * x + _mixed(air, burnt, F)
    return value


def energy(T: Any, F: Any) -> Any:
    """u [J/kg] at T [K] and the burnt fraction F."""
    x, value = 1e-3 * T, 0.0
    for i in reversed(range(len(_AIR))):
        value = value * x + _mixed(_AIR[i], _BURNT[i], F) * (1e3 / (i + 1))
    return value * x + _mixed(*_U_0, F)


def enthalpy(T: Any, F: Any) -> Any:
    """h [J/kg] at T [K] and the burnt fraction F."""
    return energy(T, F) + gas_constant(F) * T


def temperature(u: Any, F: Any) -> Any:
    """T [K] at which `energy` is u [J/kg]: the closed form of the guess, and one step of Newton's method.

    With cv = b - d/(T + T_0)^2, b T + d/(T + T_0) = g is quadratic in T. The step leaves 0.01 K of the guess's 5 K.
    """
    b, d = _mixed(*_B, F), _mixed(*_D, F)
    g = u - _mixed(*_GUESS_0, F)
    T = (g - b * _T_0 + np.sqrt(np.maximum((g + b * _T_0) ** 2 - 4.0 * b * d, 0.0))) / (2.0 * b)
    return T + (u - energy(T, F)) / specific_heat(T, F)


def gas(p: Any, T: Any, F: Any) -> Gas:
    """Gas at p [Pa], T [K] and the burnt fraction F."""
    R = gas_constant(F)
    return Gas(p, T, F, R, 1.0 + R / specific_heat(T, F), enthalpy(T, F))
