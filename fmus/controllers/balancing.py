"""PI balancing of the fuel of four cylinders from their AFR deviations, once an engine cycle, total fuel unchanged.

Source: Chauvin, Petit, Rouchon, Corde, Periodic input observer design: application for imbalance diagnosis, SAE 2006,
Towards torque balancing and Figure 9, which say that it is a PI controller. Its law, gains and limits are not given;
those here are chosen [I].

The law. At the end of cycle n, with d_i the AFR deviations, `afr` what they are relative to, and

    e_i = (d_i - mean d)/afr                            above 0: lean, wants more fuel
    v_i = k_p e_i + I_i(n-1) + k_i e_i
    r_i = v_i min(1, limit/max_j |v_j|)                 enabled; 0 where not
    I_i(n) = r_i - k_p e_i                              = I_i(n-1) + k_i e_i + (r_i - v_i)
    m_f,i = m_f (1 + r_i)

e, I, v and r have zero sum, so the mean of the m_f,i is m_f: where one correction is at the limit all are scaled alike.
I by back-calculation, with a gain of one a cycle, is what the r that went out asks for: it does not wind up, since
|I_i| <= limit + k_p |e_i|, and leaves the limit in the cycle in which v does.

Off and on. While `enable` is off r is 0, from the next end of a cycle on: the natural imbalance returns, at once. The
same equation then makes I_i = -k_p e_i, which follows the deviations and forgets what was learnt. The first correction
after it is on again is k_i e_i(n) + k_p (e_i(n) - e_i(n-1)): it begins from 0, where it stood, without a bump.

Stability. A correction acts on the fuel of the next cycle and is seen `delay` cycles after it was made, 1 at least. In
the static model of a cycle the deviations are e_i(n) = -g (r_i(n - delay) + o_i), with o_i the injectors' relative
errors less their mean, and g the gain of the loop: the AFR that is over `afr`, 1 where the two are alike and the
estimate is right. Its poles are the roots of

    z^delay (z - 1) + g (k_p + k_i) z - g k_p = 0

all of which lie inside the unit circle for delay 1 where k_i > 0, g k_p > -1 and g (2 k_p + k_i) < 2; for k_p = 0 and
any delay d where 0 < g k_i < 2 cos(pi (d - 1)/(2 d - 1)): 2, 1, 0.618, ... (`loop_poles`, `largest_reset`). `make`
refuses gains that are unstable at g = 1 and at the largest gain `gain_margin` that is asked for.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from fmus.component import ConfigurationError, Problem, Signal
from fmus.crankcycle import passes
from fmus.model import Model, Values

CYLINDERS = 4


def make(
    k_p: float = 0.1,
    k_i: float = 0.1,
    afr: float = 20.0,
    limit: float = 0.3,
    delay: int = 2,
    gain_margin: float = 2.0,
    origin: Annotated[float, "rad"] = 0.0,
    sample_time: Annotated[float, "s"] = 0.0,
) -> Model:
    """The law above, from `deviation_1..4`, `m_f`, `enable`, `angle` to `m_f_1..4` [kg] and `correction_1..4`.

    `k_p` and `k_i` are relative fuel a relative AFR deviation, `k_i` in each cycle [I]; `afr` [I]; `limit` of a
    correction [I]. A cycle ends where `angle` [deg, counted on] passes `origin` + n 720 deg: the instant at which
    observers.diagnosis tells of it, which is stepped before.

    Raises ConfigurationError with all that is wrong with the arguments.
    """
    found = []
    for name, value in {"afr": afr, "gain_margin": gain_margin}.items():
        if not 0.0 < value < np.inf:
            found.append(f"{name} wants more than 0, got {value:g}")
    if not 0.0 < limit < 1.0:
        found.append(f"limit wants more than 0 and less than 1, where no fuel is left, got {limit:g}")
    if not 0.0 <= sample_time < np.inf:
        found.append(f"sample_time wants 0 s, each step, or more, got {sample_time:g} s")
    if delay < 1:
        found.append(f"delay wants 1 cycle or more, got {delay}")
    else:
        found += [
            f"k_p and k_i want a stable loop, got {k_p:g} and {k_i:g}, with a pole of size {size:.3g} at a gain of "
            f"{gain:g} and a delay of {delay}; with k_p = 0, k_i may be up to {largest_reset(delay) / gain:.3g}"
            for gain in sorted({1.0, gain_margin})
            if (size := float(np.max(np.abs(loop_poles(k_p, k_i, gain, delay))))) >= 1.0
        ]
    if found:
        raise ConfigurationError([Problem(message) for message in found])
    cylinders = range(1, CYLINDERS + 1)
    return Model(
        name="balancing",
        description="PI balancing of the fuel of four cylinders from their AFR deviations, once a cycle",
        role="controller",
        equations=lambda t, x, m, u, p: (
            {},
            {f"m_f_{i}": u.m_f * (1.0 + m[f"correction_{i}"]) for i in cylinders},
        ),
        inputs=(
            *(Signal(f"deviation_{i}", "1", 0.0, f"AFR of cylinder {i} less the mean of all") for i in cylinders),
            Signal("m_f", "kg", 2e-5, "fuel of a cylinder and cycle, before it is balanced", nominal=2e-5),
            Signal("enable", "1", 1.0, "on where above 0.5"),
            Signal("angle", "deg", 0.0, "crank angle, counted on", nominal=720.0),
        ),
        outputs=tuple(Signal(f"m_f_{i}", "kg", 2e-5, f"fuel of cylinder {i}", nominal=2e-5) for i in cylinders),
        discrete=(
            *(Signal(f"correction_{i}", "1", 0.0, f"relative correction of cylinder {i}") for i in cylinders),
            Signal("integral", "1", 0.0, "integrators", shape=(CYLINDERS,), local=True),
            Signal("last_angle", "deg", 0.0, "crank angle at the last sampling", local=True),
            Signal("begun", "1", 0.0, "1 once there was a sampling", local=True),
        ),
        parameters=(
            Signal("k_p", "1", k_p, "proportional gain, relative fuel a relative AFR deviation"),
            Signal("k_i", "1", k_i, "integral gain in each cycle"),
            Signal("afr", "1", afr, "what AFR deviations are relative to", minimum=1e-6),
            Signal("limit", "1", limit, "largest correction"),
            Signal("origin", "deg", float(np.degrees(origin)), "where cycles end"),
            Signal("sample_time", "s", sample_time, "time from sampling to sampling, 0 at each step"),
        ),
        sample=_sample,
        sample_time="sample_time",
    )


def balance(deviations: Sequence[Any], integrals: Sequence[Any], enable: Any, p: Any) -> tuple[list[Any], list[Any]]:
    """Corrections r and integrators I, (4,) each, after a cycle with these deviations: the law of this module."""
    mean = sum(deviations) / CYLINDERS
    e = [(value - mean) / p.afr for value in deviations]
    v = [(p.k_p + p.k_i) * error + integral for error, integral in zip(e, integrals, strict=True)]
    largest: Any = p.limit
    for value in v:
        largest = np.maximum(largest, np.abs(value))
    r = [np.where(enable > 0.5, value * (p.limit / largest), 0.0) for value in v]
    return r, [value - p.k_p * error for value, error in zip(r, e, strict=True)]


def _sample(t: Any, x: Values, m: Values, u: Values, p: Values) -> dict[str, Any]:
    ends = np.logical_and(m.begun > 0.5, passes(m.last_angle, u.angle, p.origin))
    deviations = [u[f"deviation_{i}"] for i in range(1, CYLINDERS + 1)]
    r, integrals = balance(deviations, list(m.integral), u.enable, p)
    return {
        **{f"correction_{i}": np.where(ends, value, m[f"correction_{i}"]) for i, value in enumerate(r, start=1)},
        "integral": [np.where(ends, new, old) for new, old in zip(integrals, m.integral, strict=True)],
        "last_angle": u.angle,
        "begun": 1.0,
    }


def loop_poles(k_p: float, k_i: float, gain: float = 1.0, delay: int = 1) -> NDArray[np.complex128]:
    """The poles of the loop a cycle, (delay + 1,): roots of z^delay (z - 1) + g (k_p + k_i) z - g k_p.

    Each acts on one of the three degrees of freedom of the deviations, all alike. Where it is stable e goes to 0
    whatever the injectors' errors: the product of the distances of the poles from 1 is g k_i, not 0.
    """
    polynomial = np.zeros(delay + 2)
    polynomial[:2] = 1.0, -1.0
    polynomial[-2:] += gain * (k_p + k_i), -gain * k_p
    return np.asarray(np.roots(polynomial), dtype=complex)


def largest_reset(delay: int) -> float:
    """What g k_i stays under in a stable loop without proportional part: 2 cos(pi (d - 1)/(2 d - 1))."""
    return float(2.0 * np.cos(np.pi * (delay - 1) / (2 * delay - 1)))
