"""A record on disk, of which only the column that is asked for comes into memory."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
from numpy.typing import NDArray

from fmus.component import Signal
from fmus.model import unknown
from harness.signalsfile import LEADING


class StoredRecord:
    """The signals of a `signals.parquet`; each `time`, `crank` and column is read anew when it is asked for."""

    def __init__(self, path: Path) -> None:
        self._path = path
        with pq.ParquetFile(path) as file:
            self._rows = file.metadata.num_rows
            schema = file.schema_arrow
        self._columns = set(schema.names)
        self.signals = tuple(_signal(schema.field(name)) for name in schema.names if name not in LEADING)

    @property
    def time(self) -> NDArray[np.float64]:
        """The instants [s], shape (n,)."""
        return self._read("time")

    @property
    def crank(self) -> NDArray[np.float64] | None:
        """The crank angles [deg], shape (n,); None on a time clock."""
        return self._read("crank") if "crank" in self._columns else None

    def __getitem__(self, name: str) -> NDArray[np.float64]:
        """One signal, shape (n,), in SI. Raises KeyError with the nearest recorded name."""
        self._known(name)
        return self._read(name)

    def pieces(self, names: Sequence[str]) -> Iterator[tuple[NDArray[np.float64], ...]]:
        """Some signals in SI, a row group at a time, each shape (rows,). Raises KeyError as `[]` does."""
        for name in names:
            self._known(name)
        return self._groups(names)

    def _known(self, name: str) -> None:
        if name not in self._columns or name in LEADING:
            raise KeyError(unknown(name, [signal.name for signal in self.signals], "recorded signal"))

    def _groups(self, names: Sequence[str]) -> Iterator[tuple[NDArray[np.float64], ...]]:
        with pq.ParquetFile(self._path) as file:
            for group in range(file.num_row_groups):  # batches of rows would be read with all of the column packed
                piece = file.read_row_group(group, columns=list(dict.fromkeys(names)), use_threads=False)
                yield tuple(piece.column(name).to_numpy() for name in names)

    def _read(self, name: str) -> NDArray[np.float64]:
        values, row = np.empty(self._rows), 0
        for (piece,) in self._groups([name]):
            values[row : row + len(piece)] = piece
            row += len(piece)
        return values


def _signal(field: Any) -> Signal:
    metadata = {key.decode(): text.decode() for key, text in (field.metadata or {}).items()}
    kind: Any = metadata.get("kind", "real")
    unit = metadata.get("display_unit", metadata.get("unit", "1"))
    return Signal(field.name, unit, description=metadata.get("description", ""), kind=kind)
