"""A record on disk, of which only the column that is asked for comes into memory."""

from __future__ import annotations

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
        if name not in self._columns or name in LEADING:
            raise KeyError(unknown(name, [signal.name for signal in self.signals], "recorded signal"))
        return self._read(name)

    def _read(self, name: str) -> NDArray[np.float64]:
        values, row = np.empty(self._rows), 0
        with pq.ParquetFile(self._path) as file:
            for group in range(file.num_row_groups):  # batches of rows would be read with all of the column packed
                piece = file.read_row_group(group, columns=[name], use_threads=False)
                values[row : row + piece.num_rows] = piece.column(name).to_numpy()
                row += piece.num_rows
        return values


def _signal(field: Any) -> Signal:
    metadata = {key.decode(): text.decode() for key, text in (field.metadata or {}).items()}
    kind: Any = metadata.get("kind", "real")
    unit = metadata.get("display_unit", metadata.get("unit", "1"))
    return Signal(field.name, unit, description=metadata.get("description", ""), kind=kind)
