"""Reads recorded signals along time or crank angle, whole or cycle by cycle, thinned for drawing."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
import pyarrow.parquet as pq
from numpy.typing import NDArray

from reports.envelope import Envelope
from reports.folder import Case, Run, RunFolderError
from reports.signals import Column, Vector, groups, open_with, without_values

CRANK = "crank"  # the column of the crank angles [deg] of a crank clock
# A row this near to the end of a cycle is at it [deg].
ROUNDING = 1e-6


WHOLE = (-math.inf, math.inf)


class Ends(NamedTuple):
    """The rows that count: between two times [s] and two crank angles [deg], ends included."""

    time: tuple[float, float] = WHOLE
    crank: tuple[float, float] = WHOLE

    @property
    def by_crank(self) -> bool:
        """True where the crank angle of the rows is needed."""
        return self.crank != WHOLE


EVERYWHERE = Ends()


class Cycles(NamedTuple):
    """Whole cycles of so many degrees, to be laid over each other: the `last` of them."""

    length: float
    last: int


class Rows(NamedTuple):
    """Rows that follow each other: their times [s], crank angles [deg] (NaN where nobody asks) and signals in SI."""

    time: Vector
    crank: Vector
    signals: Mapping[str, Vector]


@dataclass(frozen=True)
class Thinned:
    """Signals of one case along time or crank angle, each at places of its own, and the `rows` that they stand for.

    `pieces` are the cycles that are laid over each other, the oldest first, of all the `whole` ones there are; else one
    of all rows. `time` [s] and `crank` [deg] are the first and the last of the rows; `passed` is where along the rows
    are at some times.
    """

    rows: int
    time: tuple[float, float]
    crank: tuple[float, float]
    pieces: tuple[Mapping[str, tuple[Vector, Column]], ...]
    passed: tuple[Vector, Vector]
    whole: int = 0


def read_along(
    run: Run,
    case: Case,
    names: Sequence[str],
    along: Literal["time", "crank"],
    ends: Ends = EVERYWHERE,
    points: int = 6000,
    angle: str = "",
    cycles: Cycles | None = None,
) -> Thinned:
    """The signals `names` of a case between two ends, thinned to at most about `points`.

    They lie along time [s] or along crank angle [deg]: the clock's where `angle` is empty, else that of the signal it
    names, unwound where it jumps back at the end of a turn or a cycle, in which case it moves less than 180 deg a row.
    Of `cycles`, which are along crank angle, each is drawn from 0 deg on.

    Raises RunFolderError: the case left no record, the file is damaged, or has no crank angle. Raises KeyError with the
    nearest name: a signal was not recorded.
    """
    source = angle if along == "crank" or ends.by_crank else None
    with open_with(run, case, [*names, *([source] if source else [])]) as file:
        if source == "" and CRANK not in file.schema_arrow.names:
            raise RunFolderError(f"the record of {case.label} has no crank angle: `angle` wants the signal with it")
        first, last, rows = (math.nan, math.nan), (math.nan, math.nan), 0
        for piece in rows_between(file, (), ends, source):
            if len(piece.time):
                first = first if rows else (float(piece.time[0]), float(piece.crank[0]))
                last, rows = (float(piece.time[-1]), float(piece.crank[-1])), rows + len(piece.time)
        whole = _whole(cycles.length, first[1], last[1]) if cycles else []
        spans = whole[-cycles.last :] if cycles else [WHOLE]
        counts = _counts(rows_between(file, (), ends, source), spans) if cycles else [rows]
        kept = [{name: Envelope(count, points // len(spans)) for name in names} for count in counts]
        passed = Envelope(rows, points)
        for piece in rows_between(file, names, ends, source):
            place = piece.time if along == "time" else piece.crank
            passed.add(piece.time, place)
            for index, drawn in _within(piece.crank, spans):
                zero = spans[index][0] if cycles else 0.0
                for name, envelope in kept[index].items():
                    envelope.add(place[drawn] - zero, piece.signals[name][drawn])
        empty = without_values(file)
    pieces = tuple(
        {name: _column(envelope.samples(), empty[name]) for name, envelope in envelopes.items()} for envelopes in kept
    )
    return Thinned(sum(counts), (first[0], last[0]), (first[1], last[1]), pieces, passed.samples(), len(whole))


def rows_between(file: pq.ParquetFile, names: Sequence[str], ends: Ends, angle: str | None) -> Iterator[Rows]:
    """The rows between two ends, row group by row group; `angle` as in `read_along`, None where nobody asks."""
    wanted = list(dict.fromkeys([*names, *([] if angle is None else [angle or CRANK])]))
    turned = _Turned(angle, bool(angle) and _jumps_back(file, str(angle)))
    for columns in groups(file, wanted):
        signals = {name: column.values for name, column in columns.signals.items()}
        crank = turned.crank(signals, len(columns.time))
        inside = (columns.time >= ends.time[0]) & (columns.time <= ends.time[1])
        if ends.by_crank:
            inside &= (crank >= ends.crank[0] - ROUNDING) & (crank <= ends.crank[1] + ROUNDING)
        yield Rows(columns.time[inside], crank[inside], {name: signals[name][inside] for name in names})


class _Turned:
    """The crank angle of rows that are read one after the other."""

    def __init__(self, angle: str | None, jumps_back: bool) -> None:
        self._angle, self._jumps_back = angle, jumps_back
        self._before = np.empty(0)

    def crank(self, signals: Mapping[str, Vector], rows: int) -> Vector:
        if self._angle is None:
            return np.full(rows, np.nan)
        if not self._angle:
            return signals[CRANK]
        crank = np.degrees(signals[self._angle])
        if self._jumps_back:
            crank = np.unwrap(np.concatenate((self._before, crank)), period=360.0)[len(self._before) :]
            self._before = crank[-1:]
        return crank


def _jumps_back(file: pq.ParquetFile, angle: str) -> bool:
    last = np.empty(0)
    for columns in groups(file, [angle]):
        values = np.concatenate((last, columns.signals[angle].values))
        if np.any(np.diff(values) < 0):
            return True
        last = values[-1:]
    return False


def _whole(length: float, first: float, last: float) -> list[tuple[float, float]]:
    """The crank angles [deg] that the whole cycles between two angles begin and end at; none between NaN."""
    if math.isnan(first):
        return []
    cycles = range(math.ceil((first - ROUNDING) / length), math.floor((last + ROUNDING) / length))
    return [(number * length, (number + 1) * length) for number in cycles]


def _counts(pieces: Iterator[Rows], spans: Sequence[tuple[float, float]]) -> list[int]:
    """How many rows each span has, its ends included."""
    counts = [0] * len(spans)
    for piece in pieces:
        for index, drawn in _within(piece.crank, spans):
            counts[index] += int(np.count_nonzero(drawn))
    return counts


def _within(crank: Vector, spans: Sequence[tuple[float, float]]) -> Iterator[tuple[int, NDArray[np.bool_]]]:
    """Which rows lie in a span, its ends included, for each that has any; all do where nobody knows the angle: NaN."""
    least, greatest = (float(of(crank)) if len(crank) else math.nan for of in (np.min, np.max))
    for index, (begin, end) in enumerate(spans):
        if not (greatest < begin - ROUNDING or least > end + ROUNDING):
            yield index, ~((crank < begin - ROUNDING) | (crank > end + ROUNDING))


def _column(samples: tuple[Vector, Vector], empty: Column) -> tuple[Vector, Column]:
    return samples[0], replace(empty, values=samples[1])
