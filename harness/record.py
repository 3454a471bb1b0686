"""What a run leaves: the signals of every instant, how it ended, and the files that keep them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
from numpy.typing import NDArray

from fmus.component import Signal
from fmus.model import unknown
from harness.signalsfile import GROUP, LEADING, GroupSize, signals_file

OUTCOMES = ("ok", "warning", "discard", "error", "fatal", "crash", "timeout", "diverged", "unsupported")
# Outcomes that leave a complete record.
COMPLETE = ("ok", "warning")


@dataclass(frozen=True)
class Record:
    """One run: row k holds the instant `time[k]`, column j the signal `signals[j]` in SI.

    `signals` are named `part.signal`; their `unit` is the declared one, for display. `time` has shape (n,) [s],
    `values` (n, number of signals), and on a crank clock `crank` (n,) [deg]. Where the outcome is neither ok nor
    warning, `part`, `failed_at` [s] and `message` say what ended the run, and the rows up to there are kept.
    `tolerated` are the cautions of the parts' FMUs.
    """

    signals: tuple[Signal, ...]
    time: NDArray[np.float64]
    values: NDArray[np.float64]
    outcome: str = "ok"
    part: str = ""
    failed_at: float = math.nan
    message: str = ""
    order: tuple[str, ...] = ()
    held: tuple[str, ...] = ()
    starts: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    log: tuple[Any, ...] = ()
    wall: Mapping[str, float] = field(default_factory=dict)
    fmus: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    tolerated: tuple[Mapping[str, str], ...] = ()
    crank: NDArray[np.float64] | None = None

    def __post_init__(self) -> None:
        if self.outcome not in OUTCOMES:
            raise ValueError(f"outcome wants one of {', '.join(OUTCOMES)}, got '{self.outcome}'")
        if self.values.shape != (len(self.time), len(self.signals)):
            raise ValueError(f"values wants shape {(len(self.time), len(self.signals))}, got {self.values.shape}")

    @property
    def names(self) -> list[str]:
        """Names of the signals, in column order."""
        return [signal.name for signal in self.signals]

    def __getitem__(self, name: str) -> NDArray[np.float64]:
        """The column of one signal, shape (n,), in SI. Raises KeyError with the nearest recorded name."""
        for column, signal in enumerate(self.signals):
            if signal.name == name:
                return self.values[:, column]
        raise KeyError(unknown(name, self.names, "recorded signal"))

    def pieces(self, names: Sequence[str]) -> Iterator[tuple[NDArray[np.float64], ...]]:
        """Some signals in SI, in one piece, each shape (n,). Raises KeyError as `[]` does."""
        yield tuple(self[name] for name in names)


def write_signals(record: Record, path: Path, group: GroupSize = GROUP) -> None:
    """Write `time`, on a crank clock `crank`, and a column a signal as Parquet; the same record gives the same bytes.

    Raises OSError, which names the file.
    """
    rows = group.of(1 + len(record.signals))
    with signals_file(path, record.signals, LEADING[: 1 if record.crank is None else 2]) as file:
        for begin in range(0, len(record.time), rows):
            piece = slice(begin, begin + rows)
            crank = None if record.crank is None else record.crank[piece]
            file.add(np.column_stack((record.time[piece], record.values[piece])), crank)


def read_signals(path: Path, names: Sequence[str] | None = None) -> Record:
    """The signals of a Parquet file as a Record without provenance; only the columns `names` where given."""
    leading = [name for name in LEADING if name in pq.read_schema(path).names]
    table = pq.read_table(path, columns=None if names is None else [*leading, *names])
    time = table.column("time").to_numpy().astype(float)
    crank = table.column("crank").to_numpy().astype(float) if "crank" in leading else None
    columns = [column for column in table.column_names if column not in LEADING]
    values = np.empty((len(time), len(columns)))
    signals = []
    for index, name in enumerate(columns):
        values[:, index] = table.column(name).to_numpy()
        metadata = {key.decode(): text.decode() for key, text in (table.schema.field(name).metadata or {}).items()}
        kind: Any = metadata.get("kind", "real")
        unit = metadata.get("display_unit", metadata.get("unit", "1"))
        signals.append(Signal(name, unit, description=metadata.get("description", ""), kind=kind))
    return Record(tuple(signals), time, values, crank=crank)
