"""Is a cylinder out of balance, and which? A chi-square test of four deviations with zero sum, and what it names."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import chi2

from fmus.crankcycle import CYCLE
from observers.given import Complaints
from observers.path_inversion import CYLINDERS, Pattern, Phasor

DEGREES_OF_FREEDOM = CYLINDERS - 1


class Variances(NamedTuple):
    """Of a pattern without a fault: E|D_1|^2, halved between its two parts, and E D_2^2; independent of each other."""

    one: Any
    two: Any


class Held(NamedTuple):
    """What a decision remembers: what it last said, what it would have said since, and for how many cycles in a row."""

    verdict: Any
    candidate: Any
    count: Any


def check_decision(
    firing_order: Sequence[int], false_alarm_rate: float, persistence: int, sample_time: float, found: Complaints
) -> None:
    """What is wrong with the arguments that every decision by cycles has; it goes to `found`."""
    if sorted(map(str, firing_order)) != [str(i) for i in range(1, CYLINDERS + 1)]:
        found.add(f"firing_order wants cylinders 1 to 4 once each, like [1, 3, 4, 2], got {list(firing_order)}")
    if not 0.0 < false_alarm_rate < 1.0:
        found.add(f"false_alarm_rate wants more than 0 and less than 1 per cycle, got {false_alarm_rate:g}")
    if persistence < 1:
        found.add(f"persistence wants 1 cycle or more, got {persistence}")
    if not 0.0 <= sample_time < np.inf:
        found.add(f"sample_time wants 0 s, each step, or more, got {sample_time:g} s")


def threshold_of(false_alarm_rate: float) -> float:
    """The value that a chi-square of three degrees of freedom exceeds with this probability, that is, per cycle."""
    return float(chi2.isf(false_alarm_rate, DEGREES_OF_FREEDOM))


def variances_of_path(phasors: Sequence[Phasor], noise: Any, share: Any, scatter: Any) -> Variances:
    """The variances of `observers.path_inversion.locate`, of white noise on w and of cylinders that scatter.

        E|D_1|^2 = s^2/(|g_1|^2 + |g_3|^2) + 4 f^2,   E D_2^2 = s^2/(2 |g_2|^2) + 4 f^2

    with s^2 = `noise`^2 `share` the variance of each c_k, f = `scatter` the standard deviation of each cylinder's AFR.
    """
    coefficient = noise**2 * share
    floor = CYLINDERS * scatter**2
    g1, g2, g3 = phasors
    return Variances(coefficient / (g1.size**2 + g3.size**2) + floor, coefficient / (2.0 * g2.size**2) + floor)


def variances_of_means(length: Any, noise: Any, step: Any, scatter: Any) -> Variances:
    """The variances of means over windows of `length` [deg] that begin 180 deg apart, below 360 deg.

    White noise of samples every `step` [deg] gives each mean the variance r_0 and neighbours the covariance r_1, where
    windows overlap: r_0 = s^2 step (length - step/2)/length^2, r_1 = s^2 step max(0, length - 180 deg)/length^2 by the
    trapezoidal rule. E|D_1|^2 = 4 (r_0 + f^2), E D_2^2 = 4 (r_0 - 2 r_1 + f^2).
    """
    density = noise**2 * step / length**2
    own, neighbours = density * (length - step / 2.0), density * np.maximum(length - 180.0, 0.0)
    return Variances(CYLINDERS * (own + scatter**2), CYLINDERS * (own - 2.0 * neighbours + scatter**2))


def variances_of_harmonic_means(length: Any, coefficients: Sequence[Any], scatter: Any) -> Variances:
    """The variances of such means where w is three harmonics, as behind an observer, of E|c_k|^2 = `coefficients` (3,).

    With h_k = sin(x_k)/x_k, x_k = k pi length/720 deg, D_1 = 4 (h_1 c_1 + h_3 c_3*) and D_2 = 8 h_2 Re c_2, but for
    their phases: E|D_1|^2 = 16 (h_1^2 E|c_1|^2 + h_3^2 E|c_3|^2) + 4 f^2, E D_2^2 = 32 h_2^2 E|c_2|^2 + 4 f^2.
    """
    floor = CYLINDERS * scatter**2
    squares = []
    for k, coefficient in enumerate(coefficients, start=1):
        x = k * np.pi * length / CYCLE
        squares.append((np.sin(x) / x) ** 2 * coefficient)
    one, two, three = squares
    return Variances(16.0 * (one + three) + floor, 32.0 * two + floor)


def statistic_of(pattern: Pattern, variances: Variances) -> Any:
    """2 |D_1|^2/E|D_1|^2 + D_2^2/E D_2^2: chi-square of three degrees of freedom where nothing is out of balance."""
    square = pattern.one_real**2 + pattern.one_imaginary**2
    return 2.0 * square / variances.one + pattern.two**2 / variances.two


def largest(deviations: Sequence[Any]) -> tuple[Any, Any]:
    """The number, 1 to 4, of the deviation (4,) that is largest in size, the first of equals; and that deviation."""
    number: Any = 1.0
    deviation = deviations[0]
    for other, value in enumerate(deviations[1:], start=2):
        more = np.abs(value) > np.abs(deviation)
        number, deviation = np.where(more, float(other), number), np.where(more, value, deviation)
    return number, deviation


def pair_of(pattern: Pattern, variances: Variances) -> Any:
    """The sign of D_2 where two opposite cylinders explain the pattern better than any one cylinder does, else 0.

    Opposite cylinders fire 360 deg apart. One cylinder at place j that is off by a gives D_1 = a (-i)^j,
    D_2 = a (-1)^j, and takes (Re(D_1 i^j) w_1 + (-1)^j D_2 w_2)^2/(w_1 + w_2) off the statistic with the best a, where
    w_1 = 2/E|D_1|^2, w_2 = 1/E D_2^2; two opposite ones give D_2 alone and take D_2^2 w_2 off.
    """
    weight_one, weight_two = 2.0 / variances.one, 1.0 / variances.two
    real, imaginary, two = pattern
    single: Any = 0.0
    for turned, sign in ((real, 1.0), (-imaginary, -1.0), (-real, 1.0), (imaginary, -1.0)):
        fit = (turned * weight_one + sign * two * weight_two) ** 2 / (weight_one + weight_two)
        single = np.maximum(single, fit)
    return np.where(two**2 * weight_two > single, np.sign(two), 0.0)


def fuel_error(deviation: Any, mean: Any) -> Any:
    """Relative error of a cylinder's fuel against the other three, from its AFR deviation and the mean of all four.

    (mean - deviation/3)/(mean + deviation) - 1, for the others have -deviation/3 each on average: exact for the error
    of one injector at the same air.
    """
    own = np.maximum(mean + deviation, 1e-3 * np.abs(mean) + 1e-12)
    return (mean - deviation / (CYLINDERS - 1)) / own - 1.0


def persist(held: Held, said: Any, persistence: Any) -> Held:
    """What is held after one more cycle: the verdict moves when `persistence` cycles in a row said the same."""
    count = np.where(said == held.candidate, np.minimum(held.count + 1.0, persistence), 1.0)
    return Held(np.where(count >= persistence, said, held.verdict), said, count)
