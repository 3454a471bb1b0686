"""A signal over the last whole engine cycle: Fourier coefficients and means over windows, summed sample by sample."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from fmus.component import Signal
from fmus.crankcycle import CYCLE, ROUNDING, Piece, pass_step

HARMONICS = 3
UNSEEN = -CYCLE  # what is seen of a cycle that cannot become whole any more, deg


class Sums(NamedTuple):
    """Of the cycle that runs: what has been summed since its begin, in deg times the unit of what is summed.

    `seen` is the crank angle that was [deg]; `cosine` (4,) and `sine` (4,) are of the harmonics 0 to 3, `windows` (4,);
    `slowness` is the integral of 1/omega; `power` the sum of the squared weights of the samples [deg2], and `previous`
    the length of the piece before [deg].
    """

    seen: Any
    cosine: Any
    sine: Any
    windows: Any
    slowness: Any
    power: Any
    previous: Any


class Sample(NamedTuple):
    """A signal w and the speed [rad/s] at a crank angle [deg, counted on]."""

    angle: Any
    w: Any
    omega: Any


class Windows(NamedTuple):
    """Windows of the cycle, one a cylinder, that begin at `begins` [deg, 0 to 720] and are `length` [deg] long."""

    begins: Sequence[Any]
    length: Any


class Spectrum(NamedTuple):
    """Of a whole cycle: c_k, k = 0..3, as real and imaginary parts, means over the windows, and how it was sampled.

    `omega` [rad/s] is the mean speed, `share` the sum of the squared weights of the samples, 1/n of n at equal angles:
    white noise of the variance s^2 on w gives c_k the variance E|c_k|^2 = s^2 `share`.
    """

    real: Sequence[Any]
    imaginary: Sequence[Any]
    means: Sequence[Any]
    omega: Any
    share: Any


def add_step(
    sums: Sums, old: Sample, new: Sample, windows: Windows, origin: Any, longest: Any
) -> tuple[Sums, Any, Spectrum]:
    """The sums after a step from one sample to the next; whether a whole cycle ended in it, and that cycle's spectrum.

        c_k = (1/720 deg) int w(a) e^{-i k 2 pi a/720 deg} da,   a from `origin` on

    by the trapezoidal rule on the samples, with w linear between two where a cycle ends: of samples at equal angles
    that divide the cycle it is their discrete Fourier transform, with half the weight on each of the two ends. Means
    are of w as it is, linear between samples. A window that reaches over the end of the cycle goes on at its begin.

    A cycle counts as whole where all of it was seen. Steps longer than `longest` [deg] or backwards see nothing.
    """
    moved = np.logical_and(new.angle > old.angle, new.angle - old.angle <= longest)
    end = np.where(moved, new.angle, old.angle)
    before, ends, after = pass_step(old.angle, end, old.w, new.w, origin)
    slow = pass_step(old.angle, end, 1.0 / np.maximum(old.omega, 1e-3), 1.0 / np.maximum(new.omega, 1e-3), origin)
    full = _add(sums, before, slow.before, windows)
    nothing = np.zeros(HARMONICS + 1)
    none = Sums(0.0, nothing, nothing, np.zeros(len(windows.begins)), 0.0, 0.0, 0.0)
    fresh = _add(none, after, slow.after, windows)
    kept = Sums(*(np.where(ends, begun, going) for begun, going in zip(fresh, full, strict=True)))
    # A cycle of which a step saw nothing cannot become whole, even where the step went over its end.
    jumped = np.abs(new.angle - old.angle) > longest
    kept = kept._replace(seen=np.where(jumped, UNSEEN, kept.seen))
    whole = np.logical_and(ends, np.abs(full.seen - CYCLE) <= 10.0 * ROUNDING)
    return kept, whole, _spectrum(full, windows)


def _add(sums: Sums, piece: Piece, slow: Piece, windows: Windows) -> Sums:
    length = piece.length
    orders = [2.0 * np.pi * k / CYCLE for k in range(HARMONICS + 1)]
    begin, end = piece.at_begin * length / 2.0, piece.at_end * length / 2.0
    cosine = [begin * np.cos(w * piece.begin) + end * np.cos(w * piece.end) for w in orders]
    sine = [begin * np.sin(w * piece.begin) + end * np.sin(w * piece.end) for w in orders]
    inside = [
        piece.within(at, at + windows.length).integral()
        + piece.within(at - CYCLE, at - CYCLE + windows.length).integral()
        for at in windows.begins
    ]
    return Sums(
        seen=sums.seen + length,
        cosine=sums.cosine + np.array(cosine, dtype=object),
        sine=sums.sine + np.array(sine, dtype=object),
        windows=sums.windows + np.array(inside, dtype=object),
        slowness=sums.slowness + slow.integral(),
        # A sample between steps of d and e has the weight (d + e)/2.
        power=sums.power + length * (length + sums.previous) / 2.0,
        previous=np.where(length > ROUNDING, length, sums.previous),
    )


def _spectrum(sums: Sums, windows: Windows) -> Spectrum:
    return Spectrum(
        real=[c / CYCLE for c in sums.cosine],
        imaginary=[-s / CYCLE for s in sums.sine],
        means=[total / windows.length for total in sums.windows],
        omega=CYCLE / np.maximum(sums.slowness, 1e-9),
        share=np.maximum(sums.power, ROUNDING) / CYCLE**2,
    )


def sums_signals(windows: int) -> tuple[Signal, ...]:
    """The sums as local discrete states, `sum_` and their name."""
    shapes = {"cosine": (HARMONICS + 1,), "sine": (HARMONICS + 1,), "windows": (windows,)}
    starts = {"seen": UNSEEN}
    return tuple(
        Signal(f"sum_{name}", "1", starts.get(name, 0.0), shape=shapes.get(name, ()), local=True)
        for name in Sums._fields
    )
