"""Gains of a sampled periodic-input observer for a demanded convergence per period and noise, by a Riccati equation.

Anderson and Moore's prescribed degree of stability on the reference model (Eq. 3): the filter of z+ = (Phi/rho) z
without process noise leaves every mode within rho alone and turns a mode at lambda, |lambda| > rho, into
rho^2/conj(lambda). The periodic modes lie on the unit circle and end at rho^2, all of them alike: with
rho^2 = mu^(step/T0) their multiplier over a period is mu. Nothing else is as cheap for the sum of squares of what the
noise leaves, each sample weighted by rho^-2j.

A plant's own mode that decays more slowly than that is hurried along first, by the same equation on such modes alone,
so that none ends beyond mu. The periodic modes are then moved for the plant so hurried; the two gains add up. Where a
plant has no such mode its own gain is nought: its error is X d~ and what decays by itself.

Without process noise the Riccati equation is a linear one for its inverse Y on the modes that move:
Y = Lambda^-T (Y + C' R^-1 C) Lambda^-1, and K = (Y + C' R^-1 C)^-1 C' R^-1.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import schur, solve_sylvester

from fmus.model import ModelError
from observers.periodic import PeriodicSystem, in_step, summed, transition

Array = NDArray[np.float64]

# The slowest and the fastest multipliers that are sought: 0.1 % and all but a millionth of the error gone in a period.
SLOWEST, FASTEST = 0.999, 1e-6
# How near to the demand, relatively, the multiplier is sought.
SOUGHT = 1e-4
# How little beyond the demand, relatively and a step, a mode of the plant still counts as fast enough.
AS_SLOW = 1e-9


class Demand(NamedTuple):
    """What gains are to do: the largest `multiplier` over a period, the `variance_gain` from y to w, or both.

    Where both are given and both can be kept, `prefer` says which is made the best of: `noise` takes the multiplier
    as it is demanded, `convergence` the fastest one that keeps the variance gain.
    """

    multiplier: float | None = None
    variance_gain: float | None = None
    prefer: Literal["noise", "convergence"] = "noise"


def design(system: PeriodicSystem, omega: float, step: float, multiplier: float, noise: Array | None = None) -> Array:
    """K (n + m (2h + 1), p) per sample, with which the largest multiplier over a period is `multiplier`.

    `noise` (p,) are the standard deviations of the outputs' noise, equal ones where None: they matter with two outputs
    or more.

    Raises ModelError: a harmonic is not seen, or a mode of the plant that is too slow is not.
    """
    n = len(system.A)
    modulus = multiplier ** (step / system.period)
    deviation = np.ones(len(system.C)) if noise is None else noise
    scaled = system.C / deviation[:, None]
    Phi = transition(system, omega, step)
    alone, turned = Phi[:n, :n], Phi[n:, n:]
    V, slow = _slow_part(alone, modulus * (1.0 + AS_SLOW))
    together = in_step(system, omega)
    hurried = np.zeros((n, len(scaled)))
    if V.shape[1]:
        least = float(np.abs(np.linalg.eigvals(slow)).min())
        own = moving_gain(slow, scaled @ V, float(np.sqrt(modulus * least)), omega)
        hurried = np.asarray(V @ slow @ own, dtype=np.float64)
        # x = X d goes with the periodic modes: of the plant as it now is, another X.
        together = np.asarray(solve_sylvester(alone - hurried @ scaled, -turned, -Phi[:n, n:]), dtype=np.float64)
    on_modes = moving_gain(turned, scaled @ together, float(np.sqrt(modulus)), omega)
    quick = Phi.copy()
    quick[:n, :n] -= hurried @ scaled
    predictor = quick @ np.vstack([together @ on_modes, on_modes])
    predictor[:n] += hurried
    return np.asarray(np.linalg.solve(Phi, predictor) / deviation, dtype=np.float64)


def moving_gain(Lambda: Array, seen: Array, rho: float, omega: float) -> Array:
    """K (q, p) that turns each mode lambda of z+ = Lambda z, y = `seen` z, into rho^2/conj(lambda); all are beyond rho.

    Raises ModelError: y does not see one of them.
    """
    back = np.asarray(np.linalg.inv(Lambda / rho), dtype=np.float64)
    information = seen.T @ seen
    whole = summed(back.T, information)
    if not np.linalg.cond(whole) < 1.0 / np.finfo(float).eps:
        raise ModelError(f"no gains: at {omega:.6g} rad/s a mode that has to be moved is not seen by y")
    return np.asarray(np.linalg.solve(whole, seen.T), dtype=np.float64)


def _slow_part(alone: Array, modulus: float) -> tuple[Array, Array]:
    """V (n, q) and T (q, q) of Phi V = V T, the modes of Phi beyond `modulus`."""

    def slow(real: float, imaginary: float = 0.0) -> bool:
        return bool(np.hypot(real, imaginary) > modulus)

    T, right, q = schur(alone, sort=slow)
    return right[:, :q], T[:q, :q]


def meet(demand: Demand, variance: Callable[[float], float]) -> float:
    """The multiplier to design for; `variance` gives the variance gain of a multiplier, at the worst speed.

    Raises ModelError: the demand is none, is out of range, or cannot be met; then it says what can.
    """
    mu, bound = demand.multiplier, demand.variance_gain
    if mu is None and bound is None:
        raise ModelError("design wants a multiplier, a variance_gain, or both")
    if mu is not None and not FASTEST <= mu <= SLOWEST:
        raise ModelError(f"design wants a multiplier from {FASTEST:g} to {SLOWEST:g} a period, got {mu:g}")
    if bound is not None and not bound > 0.0:
        raise ModelError(f"design wants a variance_gain above 0, got {bound:g}")
    if bound is None:
        assert mu is not None, "one of the two is given"
        return mu
    if mu is not None and variance(mu) > bound:
        fastest = _fastest(bound, variance)
        can = f"with {fastest:.4g} or more" if fastest is not None else f"with none up to {SLOWEST:g}"
        raise ModelError(
            f"design: a multiplier of {mu:g} has the variance gain {variance(mu):.4g}, above {bound:g}; "
            f"{bound:g} is kept {can}"
        )
    if mu is not None and demand.prefer == "noise":
        return mu
    found = _fastest(bound, variance)
    if found is None:
        least = variance(SLOWEST)
        raise ModelError(
            f"design: no multiplier up to {SLOWEST:g} keeps a variance_gain of {bound:g}; the least is {least:.4g}"
        )
    return found


def _fastest(bound: float, variance: Callable[[float], float]) -> float | None:
    """The least multiplier that keeps the bound, by bisection; None where the slowest does not."""
    if variance(SLOWEST) > bound:
        return None
    low, high = FASTEST, SLOWEST
    if variance(low) <= bound:
        return low
    while high / low > 1.0 + SOUGHT:
        middle = float(np.sqrt(low * high))
        low, high = (low, middle) if variance(middle) <= bound else (middle, high)
    return high
