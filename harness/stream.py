"""Rows on their way to signals.parquet while a run goes on: its worker fills rooms, their parent writes them.

Two rooms of shared memory, each of one row group: while the parent writes one, the worker fills the other, and it waits
where both are full. The parent outlives the worker, so the file is completed whatever becomes of that. A run whose rows
fit into the first room bothers nobody: its worker writes them.
"""

from __future__ import annotations

import math
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np

from fmus.component import Vector
from fmus.whereabouts import doing
from harness import workplace
from harness.clock import CrankGrid, Grid
from harness.record import Record
from harness.run import no_rows
from harness.signalsfile import GROUP, LEADING, GroupSize, SignalsFile, signals_file
from harness.system import System
from harness.worker import Worker

ROOMS = 2


@dataclass(frozen=True)
class Told:
    """What a worker tells of a case before it can be lost: its record but for the rows, and what instants it keeps.

    `room` is how many rows go into a room.
    """

    record: Record
    grid: Grid
    every: int
    room: int

    @classmethod
    def of(cls, system: System, group: GroupSize) -> Self:
        """What there is to tell of a system as it is now."""
        return cls(no_rows(system), system.grid, system.every, group.of(1 + len(system.recorded)))

    @property
    def columns(self) -> int:
        """How many numbers a row has."""
        return 1 + len(self.record.signals)


class Full(NamedTuple):
    """Asks for a room: so many rows are complete, of which the last room is full."""

    rows: int


class Ending(NamedTuple):
    """Asks for the file: so many rows are complete, and there will be no more."""

    rows: int


class Streamed:
    """The rows of a run in a worker, see `harness.rows.Rows`: kept where they fit into one room, else handed over."""

    def __init__(self, system: System, group: GroupSize = GROUP) -> None:
        self._system, self._group = system, group
        self._full, self._rows, self._unanswered = 0, 0, 0
        self._room = np.empty((0, 1 + len(system.recorded)))

    def room(self, most: int, columns: int) -> Vector:
        """The first room; later the other one, as soon as the parent has written what was in it."""
        size = self._group.of(columns)
        if not self._rows:
            workplace.tell(Told.of(self._system, self._group))
            self._room = workplace.sheet().new_rows(min(most, size), columns)
            return self._room
        self._ask(Full(self._rows))
        self._full += 1
        if self._unanswered == ROOMS:
            self._hear()
        begin = self._full % ROOMS * size
        self._room = workplace.sheet().new_rows(ROOMS * size, columns)[begin : begin + min(most, size)]
        return self._room

    def done(self, count: int) -> None:
        """Where there was but one room its rows stay where they are."""
        self._rows += count
        self._room = self._room[:count]

    def kept(self) -> Vector:
        """All rows where they fitted into one room, else none."""
        return self._room[:0] if self.handed_over else self._room

    @property
    def handed_over(self) -> bool:
        """True where the parent writes the rows."""
        return self._full > 0

    def complete(self) -> None:
        """Have the parent write what is left and complete the file. Raises what it could not by: OSError."""
        self._ask(Ending(self._rows))
        while self._unanswered:
            self._hear()

    def _ask(self, content: Full | Ending) -> None:
        workplace.ask(content)
        self._unanswered += 1

    def _hear(self) -> None:
        with doing("writing"):
            workplace.answer()
        self._unanswered -= 1


class Intake:
    """The parent's end: writes the rows of a worker's call into a file; what is not complete on leaving is removed.

    `written` counts the rows written so far, `last` is the time of the last [s], `complete` says whether the file is.
    """

    def __init__(self, path: Path, worker: Worker) -> None:
        self._path, self._worker = path, worker
        self._open = ExitStack()
        self.begin_anew()

    def begin_anew(self) -> None:
        """Forget what an earlier call wrote, for one more call."""
        self._remove()
        self.written, self.last, self.complete = 0, math.nan, False
        self._file: SignalsFile | None = None
        self._failure: OSError | None = None

    def answer(self, told: Told, asked: Full | Ending) -> None:
        """Write the rows that are complete, and the end of the file where there will be no more. Raises OSError."""
        if self._failure is not None:
            raise self._failure
        try:
            self._take(told, asked.rows)
            if isinstance(asked, Ending):
                self._open.close()
                self.complete = True
        except OSError as failure:
            self._failure = failure
            self._open.__exit__(type(failure), failure, failure.__traceback__)
            raise

    def believed(self, told: Told, rows: int) -> int:
        """So many rows, where a lost worker can have got there; else those that are written."""
        most = self.written if self.complete else self.written + self._worker.capacity(told.columns)
        return rows if self.written <= rows <= most else self.written

    def salvage(self, told: Told, rows: int) -> None:
        """Complete the file with so many rows of a worker that was lost. Raises OSError."""
        if not self.complete:
            self.answer(told, Ending(rows))

    def _take(self, told: Told, rows: int) -> None:
        if self._file is None:
            on_crank = isinstance(told.grid, CrankGrid)
            self._file = self._open.enter_context(
                signals_file(self._path, told.record.signals, LEADING if on_crank else LEADING[:1])
            )
        while self.written < rows:
            count = min(told.room, rows - self.written)
            begin = self.written // told.room % ROOMS * told.room
            room = self._worker.rows(begin + count, told.columns)[begin:]
            crank = None
            if isinstance(told.grid, CrankGrid):
                crank = told.grid.angles(np.arange(self.written, self.written + count) * told.every)
            self._file.add(room, crank)
            self.written += count
            self.last = float(room[-1, 0])

    def _remove(self) -> None:
        self._open.__exit__(InterruptedError, InterruptedError(), None)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._remove()
