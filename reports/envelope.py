"""Thins signals for drawing without losing events, from pieces of a record as they are read."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]


class Envelope:
    """At most about `points` of `count` samples, with every extreme: the least and the greatest of each stretch.

    There are points/2 stretches. The first and the last sample are kept. Up to `points` samples are all kept.
    """

    def __init__(self, count: int, points: int) -> None:
        stretches = max(points // 2, 1)
        self._edges = np.linspace(0, count, stretches + 1).astype(int) if count > points else np.array([0, count])
        self._thin = count > points
        self._count, self._stretch = count, 0
        self._time, self._values = np.empty(0), np.empty(0)  # of the stretch that is not complete yet
        self._kept: list[tuple[Vector, Vector]] = []

    def add(self, time: Vector, values: Vector) -> None:
        """Take the samples that follow, both of shape (n,)."""
        time, values = np.concatenate((self._time, time)), np.concatenate((self._values, values))
        start = self._edges[self._stretch]
        complete = int(np.searchsorted(self._edges, start + len(time), side="right")) - 1
        for stretch in range(self._stretch, complete):
            first, stop = self._edges[stretch] - start, self._edges[stretch + 1] - start
            chosen = self._chosen(stretch, values[first:stop]) + first
            self._kept.append((time[chosen], values[chosen]))
        self._stretch = complete
        self._time, self._values = time[self._edges[complete] - start :], values[self._edges[complete] - start :]

    def samples(self) -> tuple[Vector, Vector]:
        """Time and values of what was kept of complete stretches, both of shape (m,)."""
        if not self._kept:
            return np.empty(0), np.empty(0)
        time, values = zip(*self._kept, strict=True)
        return np.concatenate(time), np.concatenate(values)

    def _chosen(self, stretch: int, values: Vector) -> NDArray[np.int64]:
        if not self._thin:
            return np.arange(len(values))
        keep = {int(np.argmin(values)), int(np.argmax(values))}
        keep |= {0} if stretch == 0 else set()
        keep |= {len(values) - 1} if self._edges[stretch + 1] == self._count else set()
        return np.array(sorted(keep))


def envelope(time: Vector, values: Vector, points: int) -> tuple[Vector, Vector]:
    """At most about `points` samples that keep every extreme, see `Envelope`; both of shape (n,)."""
    kept = Envelope(len(time), points)
    kept.add(time, values)
    return kept.samples()
