"""Writes signals.parquet, row group by row group, while its rows come in."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from fmus.component import Signal
from fmus.units import UnitError, parse_unit
from fmus.whole import whole_file

# Columns of a record that are no signals: its instants [s], and on a crank clock its crank angles [deg].
LEADING = ("time", "crank")


class GroupSize(NamedTuple):
    """How large a row group is: about so many bytes before compression, but no fewer than so many rows."""

    bytes: int = 8 * 2**20
    rows: int = 16_384

    def of(self, columns: int) -> int:
        """Rows of every group but the last, by the number of columns, time included, and by nothing else."""
        return max(self.bytes // (8 * columns), self.rows)


# With groups of fewer rows what the file says of each column of each would be much, and is in memory until its end.
GROUP = GroupSize()


class SignalsFile:
    """A signals.parquet that takes rows; it is complete when the block of `signals_file` ends."""

    def __init__(self, writer: pq.ParquetWriter) -> None:
        self._writer = writer

    def add(self, rows: NDArray[np.float64], crank: NDArray[np.float64] | None = None) -> None:
        """One row group: rows of time and the signals, shape (n, 1 + signals), and their crank angles [deg], (n,)."""
        if not len(rows):
            return
        time, *signals = rows.T
        columns = [time, *([] if crank is None else [crank]), *signals]
        table = pa.Table.from_arrays([_column(values) for values in columns], schema=self._writer.schema)
        self._writer.write_table(table, row_group_size=len(rows))


@contextmanager
def signals_file(path: Path, signals: Sequence[Signal], leading: Sequence[str]) -> Iterator[SignalsFile]:
    """A file of the `leading` columns and a column a signal; nobody sees it before the block ended well.

    Each column's metadata: `unit` (SI, what the values are in), `display_unit` (as declared), `kind`, `description`.
    The same rows in the same groups give the same bytes. Raises OSError, which names the file.
    """
    known = {"time": _field("time", "s", "s", "real", ""), "crank": _field("crank", "deg", "deg", "real", CRANK_MEANS)}
    fields = [known[name] for name in leading]
    for signal in signals:
        fields.append(_field(signal.name, si_unit(signal.unit), signal.unit, signal.kind, signal.description))
    options = {"compression": "zstd", "use_dictionary": False, "use_byte_stream_split": True}
    with whole_file(path) as file:
        writer = pq.ParquetWriter(file, pa.schema(fields), **options)
        try:
            yield SignalsFile(writer)
            writer.close()
        except BaseException:
            with suppress(OSError, pa.ArrowException):  # it would be closed when it is collected, with the file gone
                writer.close()
            raise


CRANK_MEANS = "nominal crank angle"


def si_unit(unit: str) -> str:
    """The name of the SI unit of `unit`'s dimension; `unit` itself where nobody knows it."""
    try:
        return parse_unit(unit).si_name()
    except UnitError:
        return unit


def _column(values: NDArray[np.float64]) -> pa.Array:
    """The values as a column; `pa.array` would give the same, but import pandas for it, for half a second a process."""
    return pa.Array.from_buffers(pa.float64(), len(values), [None, pa.py_buffer(np.ascontiguousarray(values))], 0)


def _field(name: str, unit: str, display_unit: str, kind: str, description: str) -> pa.Field:
    metadata = {"unit": unit, "display_unit": display_unit, "kind": kind, "description": description}
    return pa.field(name, pa.float64(), nullable=False, metadata=metadata)
