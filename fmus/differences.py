"""Derivatives by difference quotients, extrapolated to no width, with what they are worth."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from fmus.component import Vector

# The first width, of a variable's value or its nominal value; each next is so many times smaller, this many in all.
FIRST, RATIO, WIDTHS = 0.01, 2.0, 9


class Range(NamedTuple):
    """Where a variable may be moved: its size for widths, its least and its largest value."""

    size: float
    least: float
    most: float


def differences(function: Callable[[Vector], Vector], z: Vector, ranges: Sequence[Range]) -> tuple[Vector, Vector]:
    """d function / d z at z and an estimate of its error, both of shape (values, len(z)).

    Central quotients, or one-sided ones where the range leaves no room, of decreasing width, extrapolated; of each
    entry the extrapolation that agrees best with those it is made from, and how well that is (Ridders, Advances in
    Engineering Software 4(2), 1982).
    """
    here = function(z)
    found, errors = np.zeros((len(here), len(z))), np.zeros((len(here), len(z)))
    for j, span in enumerate(ranges):
        found[:, j], errors[:, j] = _column(function, z, here, j, span)
    function(z)
    return found, errors


def _column(
    function: Callable[[Vector], Vector], z: Vector, here: Vector, j: int, span: Range
) -> tuple[Vector, Vector]:
    first = FIRST * max(abs(z[j]), span.size)
    above, below = span.most - z[j], z[j] - span.least
    side = 0 if min(above, below) >= first / RATIO**2 else (1 if above >= below else -1)
    first = min(first, {0: min(above, below), 1: above, -1: below}[side])
    if first <= 0.0:
        return np.zeros_like(here), np.full_like(here, np.inf)

    def quotient(width: float) -> Vector:
        up, down = z.copy(), z.copy()
        up[j], down[j] = z[j] + width * (side >= 0), z[j] - width * (side <= 0)
        ends = function(up) if side >= 0 else here, function(down) if side <= 0 else here
        return (ends[0] - ends[1]) / (up[j] - down[j])

    order = 2 if side == 0 else 1
    best, error = np.zeros_like(here), np.full_like(here, np.inf)
    before: list[Vector] = []
    for k in range(WIDTHS):
        row = [quotient(first / RATIO**k)]
        for i, older in enumerate(before):
            # A central quotient's error is a series of even powers of the width, a one-sided one's of all powers.
            gain = RATIO ** ((i + 1) * order) - 1.0
            finer = row[i] + (row[i] - older) / gain
            off = np.maximum(np.abs(finer - row[i]), np.abs(finer - older))
            better = off < error
            best, error = np.where(better, finer, best), np.where(better, off, error)
            row.append(finer)
        before = row
    return best, error
