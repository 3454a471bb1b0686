"""The speed next to the cylinders from that at the end of a transmission rod (Figures 10 and 11).

The paper couples x1, the speed at the end, to x2, next to the cylinders, by

    (x1'' - x2'') + 2 xi wr (x1' - x2') + wr^2 (x1 - x2) = 0,

in which x1 - x2 dies out whatever x2 does: in what repeats x1 is x2, and there is nothing to invert. Accordingly its
matrix from the coefficients of w0 to those of x2 gives those of x1 (`printed_cylinder`). A rod driven at its end does
x1'' = -2 xi wr (x1' - x2') - wr^2 (x1 - x2). Then w0 = 2 xi wr x2' + wr^2 x2 drives the same observer, and the
coefficients of x2 are those of w0 over wr^2 + i 2 xi wr k w0. This is what runs here; w counts as w0/wr^2 [rad/s], so
that A0 = [0; wr^2], and a speed that does not change is its own w.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fmus.component import Signal
from fmus.model import Model, Values
from observers.given import Complaints, read_quantity
from observers.periodic import Gains, PeriodicSystem, partial_measurement_gains
from observers.periodic_input import system_model
from observers.periodic_model import Extra, Reconstruction
from observers.periodic_response import product
from observers.periodic_schedule import GainLaw
from observers.periodic_settings import (
    DESIGN,
    READINGS,
    Setting,
    per_radian,
    read_choice,
    read_gains,
    read_number,
    read_setting,
)

Array = NDArray[np.float64]

EPSILON = 0.1  # epsilon beta^2 [R]; what it counts per, the text leaves open
DAMPING = 0.15  # [R]
KINDS = {
    "published": ("per", "sign", "input"),
    "partial": ("epsilon", "per", "sign", "input"),
    "design": DESIGN,
}


def make(
    gains: dict[str, Any],
    frequency: str | None = None,
    order: float | None = None,
    damping: float = DAMPING,
    period: str = "180 deg",
    harmonics: int = 2,
    step: str = "6 deg",
    speed: Any = "[600, 6000] rpm",
    nodes: int = 9,
    delay: str = "0 s",
    start: Any = None,
    allow_unstable: bool = False,
) -> Model:
    """The observer of a rod of n = 2 by its end's speed y [rad/s]; `omega_cylinder` is the other end's.

    The rod's natural frequency is fixed in time, `frequency` (125 Hz where neither is given [I]), or, as the paper
    prints it, in crank angle, `order`, oscillations per revolution. `gains` is one of
    - `published: {per, sign, input}`, Eq. 9 with L = [2 xi wr, 2 wr^2] and epsilon beta^2 = 0.1: `per` what L_k count
      per (s, sample, rad), `sign` as printed (minus) or as it descends (plus), `input` A0 = [0; 1] (one) or [0; wr^2]
      (square) in the variable that L_k count per;
    - `partial`, the same with another `epsilon`;
    - `design: {multiplier, variance_gain, prefer}`.

    Raises ConfigurationError with all that is wrong, as observers.periodic_input.make.
    """
    found = Complaints()
    setting = read_setting(period, harmonics, step, speed, nodes, found)
    if frequency is not None and order is not None:
        found.add("wants frequency or order, got both")
    xi = read_number(damping, "damping", found, 0.0)
    if order is not None:
        wr, per = read_number(order, "order", found, 0.0), "rad"
    else:
        cycles = found.collect(read_quantity, "125 Hz" if frequency is None else frequency, "Hz", "frequency")
        wr, per = 2.0 * np.pi * (cycles or 1.0), "s"
        if cycles is not None and not cycles > 0.0:
            found.add(f"frequency wants a value above 0, got {frequency}")
    kind, raw = read_gains(gains, KINDS, found)
    found.end()
    system = rod_system(wr, xi, setting, per)
    law = None if kind == "design" else _law(system, setting, wr, xi, kind, raw, found)
    found.end()
    return system_model(
        "rod_inversion", "Periodic-input observer of the speed next to the cylinders",
        system, setting, gains, delay, start, {"y": "rad/s", "w": "rad/s"}, allow_unstable,
        law=law, extra=_cylinder(system, wr, xi),
    )  # fmt: skip


def rod_system(wr: float, xi: float, setting: Setting, per: str) -> PeriodicSystem:
    """x = (x1, x1'), A = [[0, 1], [-wr^2, -2 xi wr]], A0 = [0; wr^2], C = [1, 0]; wr `per` s or rad."""
    return PeriodicSystem(
        np.array([[0.0, 1.0], [-(wr**2), -2.0 * xi * wr]]),
        np.array([[0.0], [wr**2]]),
        np.array([[1.0, 0.0]]),
        setting.period,
        setting.harmonics,
        "s" if per == "s" else "rad",
    )


def cylinder_factor(wr: float, xi: float, frequency: Any) -> tuple[Any, Any]:
    """x2's coefficient over w's, 1/(1 + i 2 xi frequency/wr), as a pair; `frequency` k w0 in what wr counts per."""
    slope = (2.0 * xi / wr) * frequency
    size = 1.0 + slope * slope
    return 1.0 / size, -slope / size


def printed_cylinder(coefficient: complex, wr: float, xi: float, frequency: float) -> complex:
    """What the paper's matrix [[wr^2 - f^2, 2 xi wr f], [-2 xi wr f, wr^2 - f^2]]^-1 makes of w0's coefficient.

    `coefficient` of w0 = wr^2 w, f = k w0. Read on the coefficients of cosine and sine, (Re, -Im), the matrix is the
    rod's own response: what comes out is x1, which was measured.
    """
    matrix = np.array([
        [wr**2 - frequency**2, 2.0 * xi * wr * frequency],
        [-2.0 * xi * wr * frequency, wr**2 - frequency**2],
    ])  # fmt: skip
    cosine, sine = np.linalg.solve(matrix, [coefficient.real, -coefficient.imag])
    return complex(cosine, -sine)


def _law(
    system: PeriodicSystem,
    setting: Setting,
    wr: float,
    xi: float,
    kind: str,
    raw: Mapping[str, Any],
    found: Complaints,
) -> GainLaw | None:
    before = len(found.messages)
    epsilon = EPSILON
    if kind == "partial":
        epsilon = read_number(raw.get("epsilon", EPSILON), "gains: partial: epsilon", found, 0.0)
    word = read_choice(raw.get("per", "rad"), f"gains: {kind}: per", ("rad", "sample", "s"), found)
    sign = read_choice(raw.get("sign", "plus"), f"gains: {kind}: sign", ("plus", "minus"), found)
    scaled = read_choice(raw.get("input", "square"), f"gains: {kind}: input", ("square", "one"), found)
    if len(found.messages) > before:
        return None
    reading = next(one for one in READINGS if one == word)
    orders = [k * system.order for k in range(system.harmonics + 1)]

    def law(omega: float) -> Array:
        step, over = setting.sampling.angle(omega), omega if system.per == "s" else 1.0
        A, A0 = system.rates(omega)
        L = np.array([[2.0 * xi * wr], [2.0 * wr**2]]) / over
        L_k = partial_measurement_gains(A, A0, system.C, L, orders, epsilon, "plus" if sign == "plus" else "minus")
        unit = per_radian(reading, omega, step)
        # A0 = [0; 1] has an input wr^2 times as large, and a response wr^2 times as small: L_k of w are 1/wr^4 of it.
        there = (wr / over) / unit
        return Gains(L, L_k / there**4 if scaled == "one" else L_k).times(step, unit * step).stacked()

    return law


def _cylinder(system: PeriodicSystem, wr: float, xi: float) -> Extra:
    signals = [
        Signal("omega_cylinder", "rad/s", 0.0, "speed next to the cylinders"),
        Signal("cylinder_0", "rad/s", 0.0, "its mean"),
    ]
    for k in range(1, system.harmonics + 1):
        signals.append(Signal(f"cylinder_{k}_re", "rad/s", 0.0, f"real part of its coefficient at {k} per period"))
        signals.append(Signal(f"cylinder_{k}_im", "rad/s", 0.0, f"imaginary part of its coefficient at {k} per period"))
        signals.append(Signal(f"cylinder_E_{k}", "rad/s", 0.0, "its energy: sqrt(|c_k|^2 + |c_-k|^2)"))

    def values(found: Reconstruction, p: Values) -> dict[str, Any]:
        result: dict[str, Any] = {"cylinder_0": found.coefficients[0][0][0]}
        total = result["cylinder_0"]
        for k in range(1, system.harmonics + 1):
            frequency = k * system.order * (found.omega if system.per == "s" else 1.0)
            re, im = product(found.coefficients[k][0], cylinder_factor(wr, xi, frequency))
            result |= {f"cylinder_{k}_re": re, f"cylinder_{k}_im": im}
            result[f"cylinder_E_{k}"] = np.sqrt(2.0 * (re * re + im * im))
            total = total + 2.0 * product((re, im), found.turns[k])[0]
        return result | {"omega_cylinder": total}

    return Extra(tuple(signals), (), values)
