"""Frequency responses and turning phases in real pairs, for numbers and symbols: what has no complex numbers in C."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import matrix_balance

from fmus.model import ModelError
from observers.periodic import PeriodicSystem, responses

Array = NDArray[np.float64]
Pair = tuple[Any, Any]  # real and imaginary part, numbers or symbols

# How near the polynomials' X_k has to be to that of a linear solver, relatively.
RESOLVED = 1e-9


def turns_of(angle: Any, harmonics: int) -> list[Pair]:
    """(cos, sin) of k times `angle` for k = 0 ... `harmonics`, by one sine and one cosine."""
    whole = 2.0 * math.pi
    angle = angle - whole * np.floor(angle / whole)
    one = (np.cos(angle), np.sin(angle))
    turns: list[Pair] = [(1.0, 0.0)]
    for _ in range(harmonics):
        turns.append(product(turns[-1], one))
    return turns


def product(a: Pair, b: Pair) -> Pair:
    """a b."""
    return a[0] * b[0] - a[1] * b[1], a[0] * b[1] + a[1] * b[0]


def resolver(system: PeriodicSystem) -> Callable[[Any], list[list[list[Pair]]]]:
    """X_k (h + 1, n, m) as pairs, at sigma, for numbers and symbols."""
    if system.per == "rad":
        X = responses(system, 1.0)
        constant = [[[(float(v.real), float(v.imag)) for v in row] for row in one] for one in X]
        return lambda sigma: constant
    numerators, denominator, scale = _polynomials(system)

    def at(sigma: Any) -> list[list[list[Pair]]]:
        found = []
        for k in range(system.harmonics + 1):
            q = (k * system.order / scale) * sigma
            below = _polynomial(denominator, q)
            size = below[0] * below[0] + below[1] * below[1]
            inverse = (below[0] / size, -below[1] / size)
            found.append(
                [
                    [product(_polynomial(numerators[:, i, j], q), inverse) for j in range(numerators.shape[2])]
                    for i in range(numerators.shape[1])
                ]
            )
        return found

    return at


def _polynomials(system: PeriodicSystem) -> tuple[Array, Array, float]:
    """Numerators (n, n, m) and denominator (n + 1,) of (s - A)^-1 A0 in s/scale, highest power first."""
    n = len(system.A)
    balanced, change = matrix_balance(system.A, permute=False)
    scale = max(float(np.abs(np.linalg.eigvals(balanced)).max()), float(np.finfo(float).tiny))
    small = balanced / scale
    B, matrices, denominator = np.eye(n), [], [1.0]
    for j in range(1, n + 1):
        matrices.append(change @ B @ np.linalg.solve(change, system.A0) / scale)
        moved = small @ B
        denominator.append(-float(np.trace(moved)) / j)
        B = moved + denominator[-1] * np.eye(n)
    return np.array(matrices), np.array(denominator), scale


def _polynomial(factors: Any, q: Any) -> Pair:
    """sum_j factors[j] (i q)^(d - j) of d + 1 factors, as a pair."""
    parts: list[Any] = [0.0, 0.0]
    degree, power = len(factors) - 1, 1.0
    for exponent in range(degree + 1):
        signed = float(factors[degree - exponent]) * (-1.0 if exponent % 4 in (2, 3) else 1.0)
        parts[exponent % 2] = parts[exponent % 2] + signed * power
        power = power * q
    return parts[0], parts[1]


def check_resolved(system: PeriodicSystem, speeds: Sequence[float]) -> None:
    """Nothing where the polynomials give X_k at the speeds. Raises ModelError: A is too large or too badly scaled."""
    at = resolver(system)
    for sigma in speeds:
        wanted = responses(system, sigma)
        found = np.array([[[complex(*v) for v in row] for row in one] for one in at(sigma)])
        away = float(np.abs(found - wanted).max() / np.abs(wanted).max())
        if away > RESOLVED:
            raise ModelError(
                f"A of {len(system.A)} states is too badly conditioned: its response is {away:.2g} away at "
                f"{sigma:.6g} rad/s, and {RESOLVED:g} is wanted; scale its states, or leave some out"
            )
