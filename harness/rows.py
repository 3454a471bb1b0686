"""Where the rows of a run are written: memory that is asked for piece by piece."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from fmus.component import Vector

# A run that may end early is given room for so many rows at a time.
PIECE = 65_536


class Rows(Protocol):
    """Takes the rows of a run, each of time and the recorded signals."""

    def room(self, most: int, columns: int) -> Vector:
        """Memory for the rows that follow, at least one and at most `most`, shape (rows, columns), C order."""

    def done(self, count: int) -> None:
        """The first `count` rows of the last room are complete, and no more will be written to it."""

    def kept(self) -> Vector:
        """The rows that are still in memory when all are done, shape (rows, columns)."""


class InMemory:
    """Keeps all rows; `pieces` says whether room is given by pieces, for runs whose length is not known."""

    def __init__(self, piece: int | None = None) -> None:
        self._piece = piece
        self._rooms: list[Vector] = []

    def room(self, most: int, columns: int) -> Vector:
        """New memory."""
        self._rooms.append(np.empty((min(most, self._piece or most), columns)))
        return self._rooms[-1]

    def done(self, count: int) -> None:
        """Rows beyond are cut off."""
        self._rooms[-1] = self._rooms[-1][:count]

    def kept(self) -> Vector:
        """All rows."""
        return self._rooms[0] if len(self._rooms) == 1 else np.concatenate(self._rooms)
