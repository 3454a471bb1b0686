"""Periodic-input observers run as FMUs on signals that are known in closed form."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from filtered import Filter

from fmus.model import Model
from observers.periodic import PeriodicSystem, responses

RPM = np.pi / 30.0
STEP = np.radians(6.0)
T720, T180 = 4.0 * np.pi, np.pi


def lag(tau: float, harmonics: int = 3, period: float = T720) -> PeriodicSystem:
    return PeriodicSystem(np.array([[-1.0 / tau]]), np.array([[1.0 / tau]]), np.eye(1), period, harmonics)


def two_lags(first: float, second: float, harmonics: int = 3, period: float = T720) -> PeriodicSystem:
    A = np.array([[-1.0 / first, 0.0], [1.0 / second, -1.0 / second]])
    return PeriodicSystem(A, np.array([[1.0 / first], [0.0]]), np.array([[0.0, 1.0]]), period, harmonics)


def rod(wr: float = 2.0 * np.pi * 125.0, harmonics: int = 2, period: float = T180, per: str = "s") -> PeriodicSystem:
    A = np.array([[0.0, 1.0], [-(wr**2), -0.3 * wr]])
    return PeriodicSystem(A, np.array([[0.0], [wr**2]]), np.array([[1.0, 0.0]]), period, harmonics, per)


def at_rest(system: PeriodicSystem, c: np.ndarray, omega: float) -> Callable[[float], float]:
    """y of the crank angle [rad] when the system goes in step with w = sum c_k e^{i k w0 alpha}, c (h + 1,)."""
    G = (system.C @ responses(system, omega))[:, 0, 0] * c
    orders = system.order * np.arange(len(c))

    def y(alpha: float) -> float:
        turned = G * np.exp(1j * orders * alpha)
        return float(turned[0].real + 2.0 * turned[1:].real.sum())

    return y


def told(row: dict[str, float], harmonics: int) -> np.ndarray:
    """The coefficients c_0 ... c_h in the outputs."""
    return np.array([row["c_0"], *(row[f"c_{k}_re"] + 1j * row[f"c_{k}_im"] for k in range(1, harmonics + 1))])


def periods(
    model: Model, y: Callable[[float], float], omega: float, period: float, count: int, harmonics: int
) -> np.ndarray:
    """The coefficients after each of `count` periods in steps of 6 deg at a constant speed, (count, h + 1)."""
    samples = round(period / STEP)
    estimator = Filter(model, STEP / omega)
    found = []
    for k in range(count * samples):
        row = estimator(y=y(k * STEP), angle=6.0 * k, omega=omega)
        if (k + 1) % samples == 0:
            found.append(told(row, harmonics))
    estimator.component.close()
    return np.array(found)
