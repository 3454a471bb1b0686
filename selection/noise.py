"""The noise of a linear model, from recorded data of what it stands for: residuals, their moments, noise by rules.

Source: Zhang et al., H2 sensor selection and observer design, Front. Mech. Eng. 2021, Sections 3.2 and 3.3, Eq. 22 to
29. The formulas are lost; what stands here is rebuilt from the text, thresholds and the correction by kurtosis are
chosen [I]. docs/noise.md says where the text contradicts statistics, and in which unit its noise is.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fmus.component import Vector


class Linear(NamedTuple):
    """x' = rates + A (x - x0) + B (u - u0) + r: A (n, n), B (n, m), and the point; SI and seconds."""

    A: Vector
    B: Vector
    x0: Vector
    u0: Vector
    rates: Vector


class Residuals(NamedTuple):
    """Mean residual of each interval, (k, n) a second; the intervals [s], (k,); what quadrature leaves of it, rms (n,).

    Rounding and noise of the record come on top: a deviation s of a state's values makes sqrt(2) s/interval.
    """

    values: Vector
    intervals: Vector
    error: Vector


class Moments(NamedTuple):
    """Of each column: mean, standard deviation, skewness and excess kurtosis, each (n,); 1/k in all of them.

    Where nothing varies, skewness and kurtosis are 0.
    """

    mean: Vector
    deviation: Vector
    skewness: Vector
    kurtosis: Vector


@dataclass(frozen=True)
class Rule:
    """When Section 3.2 corrects: from which absolute skewness, and below which excess kurtosis. Both [I].

    0.5 is the usual bound of what counts as fairly symmetric. -1 is between a uniform distribution, -1.2, and a
    triangular one, -0.6.
    """

    skewness: float = 0.5
    kurtosis: float = -1.0


PAPERS = Rule()


class Corrected(NamedTuple):
    """Process noise by the rules of Section 3.2, (n,), before and after the correction by kurtosis; and what was done.

    `rules` are words: symmetric, less (the mean taken off), more (added), each with `, flat` where kurtosis counted.
    """

    by_skewness: Vector
    process: Vector
    rules: tuple[str, ...]


def residuals(time: Vector, x: Vector, u: Vector, model: Linear, edges: NDArray[np.intp]) -> Residuals:
    """What a linear model leaves of recorded states x (k, n) and inputs u (k, m) at `time` (k,) [s] (Eq. 22).

    r = x' - (rates + A (x - x0) + B (u - u0)), its mean over each interval between the rows `edges`, ascending. That of
    x' is the difference at the ends, exactly: nothing is differentiated. That of the rest is by the trapezoidal rule,
    whose error is estimated from every other row (Richardson). Of two neighbouring rows it is the residual midway, with
    an error of h^2 x'''/24 in x' as central differences have it.

    Raises ValueError: fewer than three rows, times that do not ascend, edges beyond the rows.
    """
    if len(time) < 3 or not (np.diff(time) > 0.0).all():
        raise ValueError("residuals want three rows or more whose times ascend")
    if len(edges) < 2 or not (np.diff(edges) > 0).all() or edges[0] < 0 or edges[-1] >= len(time):
        raise ValueError(f"residuals want ascending rows below {len(time)} as edges")
    rest = model.rates + (x - model.x0) @ model.A.T + (u - model.u0) @ model.B.T
    whole = _integrated(time, rest)
    intervals = np.diff(time[edges])
    values = (np.diff(x[edges], axis=0) - np.diff(whole[edges], axis=0)) / intervals[:, None]
    coarse = _integrated(time[::2], rest[::2])
    # By the halves of twice the step: a third of the difference is the finer one's error.
    missed = np.diff((whole[::2] - coarse) / 3.0, axis=0)
    each = len(edges) - 1
    spans = max(len(missed) // each, 1)
    groups = missed[: len(missed) // spans * spans].reshape(-1, spans, x.shape[1]).sum(axis=1)
    lengths = np.diff(time[::2])[: len(groups) * spans].reshape(-1, spans).sum(axis=1)
    return Residuals(values, intervals, np.sqrt(np.mean((groups / lengths[:, None]) ** 2, axis=0)))


def _integrated(time: Vector, rates: Vector) -> Vector:
    """The integral of rates (k, n) from the first row on, by the trapezoidal rule."""
    pieces = 0.5 * np.diff(time)[:, None] * (rates[1:] + rates[:-1])
    return np.concatenate([np.zeros((1, rates.shape[1])), np.cumsum(pieces, axis=0)])


def moments(values: Vector) -> Moments:
    """The moments of each column of (k, n) (Eq. 23, 24, 27).

    mean m = sum r/k, s^2 = sum (r - m)^2/k, skewness sum ((r - m)/s)^3/k, excess kurtosis sum ((r - m)/s)^4/k - 3.
    """
    mean = values.mean(axis=0)
    apart = values - mean
    deviation = np.sqrt(np.mean(apart**2, axis=0))
    varies = deviation > 1e-12 * np.abs(values).max(axis=0, initial=0.0)
    z = apart / np.where(varies, deviation, 1.0)
    skewness, fourth = np.mean(z**3, axis=0), np.mean(z**4, axis=0)
    return Moments(mean, deviation, np.where(varies, skewness, 0.0), np.where(varies, fourth - 3.0, 0.0))


def corrected(found: Moments, rule: Rule = PAPERS) -> Corrected:
    """The diagonal of G by Section 3.2: the standard deviation, corrected by skewness and then by kurtosis.

    |S| < rule.skewness         G0 = s                  Eq. 25
    S and m of one sign         G0 = |s - |m||          Eq. 26; the text has s - |m|, whose sign G G' does not see
    else                        G0 = s + |m|            Eq. 26
    K < rule.kurtosis           G = G0 K/rule.kurtosis  Eq. 28, rebuilt [I]: the text has that it is corrected where K
                                                        is low and for outliers, so upwards; this is 1 at the threshold
                                                        and at most 2/|rule.kurtosis|, since K > -2
    """
    mean, deviation, skewness, kurtosis = found
    skewed = np.abs(skewness) >= rule.skewness
    alike = np.sign(skewness) == np.sign(mean)
    first = np.where(skewed, np.abs(deviation + np.where(alike, -1.0, 1.0) * np.abs(mean)), deviation)
    flat = kurtosis < rule.kurtosis
    process = np.where(flat, first * kurtosis / rule.kurtosis, first)
    words = np.where(~skewed, "symmetric", np.where(alike, "less", "more"))
    rules = tuple(f"{word}, flat" if low else str(word) for word, low in zip(words, flat, strict=True))
    return Corrected(first, process, rules)


def density(values: Vector, interval: float) -> Vector:
    """The root of the spectral density at frequency zero of each column of (k, n): x/s in, x/sqrt(s) out, (n,).

    G^2 = interval (c_0 + 2 sum_j (1 - j/(L + 1)) c_j), c_j the autocovariance: the white noise that moves the state by
    as much, over times in which the residual forgets. The kernel is Bartlett's, which keeps it above zero; its width L
    is Andrews' for a first-order process of the residual's own correlation a at one interval,
    L = 1.1447 (k alpha)^(1/3), alpha = 4 a^2/((1 - a)^2 (1 + a)^2) (Econometrica 59(3), 1991). The mean is left out.
    """
    k = len(values)
    apart = values - values.mean(axis=0)
    found = np.zeros(values.shape[1])
    for i, column in enumerate(apart.T):
        spectrum = np.fft.rfft(column, 2 * k)
        covariance = np.fft.irfft(np.abs(spectrum) ** 2)[:k] / k
        if covariance[0] <= 0.0:
            continue
        a = float(np.clip(covariance[1] / covariance[0], -0.999, 0.999)) if k > 1 else 0.0
        alpha = 4.0 * a**2 / ((1.0 - a) ** 2 * (1.0 + a) ** 2)
        width = min(int(1.1447 * (k * alpha) ** (1.0 / 3.0)), k - 1)
        weights = 1.0 - np.arange(1, width + 1) / (width + 1.0)
        found[i] = np.sqrt(interval * max(covariance[0] + 2.0 * weights @ covariance[1 : width + 1], 0.0))
    return found


def measurement(y: Vector, y0: Vector, accuracies: Vector) -> Vector:
    """The diagonal of H by Section 3.3 (Eq. 29): accuracy times the largest |y - y0| of the record, (q,).

    y (k, q), y0 (q,) at the point, accuracies (q,) as shares.
    """
    return np.asarray(accuracies * np.abs(y - y0).max(axis=0))


def follow(time: Vector, target: Vector, time_constant: float, start: float) -> Vector:
    """What follows `target` (k,) by tau x' = target - x from `start`, exact for a target straight between the rows."""
    x = np.empty(len(time))
    x[0] = start
    for i, h in enumerate(np.diff(time)):
        behind = time_constant * (target[i + 1] - target[i]) / h
        x[i + 1] = target[i + 1] - behind + (x[i] - target[i] + behind) * np.exp(-h / time_constant)
    return x
