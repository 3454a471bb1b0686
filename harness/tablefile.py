"""Columns of numbers from files: CSV, Parquet and MDF4."""

from __future__ import annotations

import csv
import re
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from fmus.component import Kind
from fmus.model import unknown

Vector = NDArray[np.float64]
_HEADING = re.compile(r"(?P<name>.*\S)\s+\[(?P<unit>[^\[\]]*)\]$")


class TableError(ValueError):
    """A file or a column that cannot be read: what was wanted and what came."""


class Column(NamedTuple):
    """The numbers of a column as the file has them, shape (n,); NaN where it has none.

    `unit` is what the file says they are in, `shown` what they are best shown in; both empty where it says nothing.
    """

    values: Vector
    unit: str = ""
    shown: str = ""
    kind: Kind = "real"


class TableFile(Protocol):
    """An open file of named columns."""

    def column(self, name: str) -> Column:
        """A column by name. Raises TableError: there is none, or it holds no numbers."""

    def time(self, name: str | None, of: str) -> Column:
        """The times of a column: another one by name, the file's own choice where that is None. Raises TableError."""

    def row(self, index: int) -> str:
        """What the row of a value is called in the file, so that it can be found."""

    def close(self) -> None:
        """Release the file."""


def open_table(path: Path, wanted: Collection[str] = ()) -> TableFile:
    """The columns of a .csv, .parquet or .mf4 file; those `wanted` are read at one go where that saves time.

    Raises TableError: no such file, none of these, not readable, or a package that is not installed.
    """
    if not path.is_file():
        raise TableError(f"wants a file, but there is none at {path}")
    suffix = path.suffix.lower()
    try:
        if suffix == ".csv":
            return CsvFile(path, wanted)
        if suffix == ".parquet":
            return ParquetFile(path)
        if suffix == ".mf4":
            return Mdf4File(path)
    except OSError as error:
        raise TableError(f"{path} cannot be read: {error.strerror or error}") from error
    raise TableError(f"wants a file that ends in .csv, .parquet or .mf4, got {path.name}")


class CsvFile:
    """Comma-separated values in UTF-8: a line of names, then one line of numbers a row.

    A name may be followed by its unit, like `speed [rpm]`, with white space between: `x[1]` is a name.
    """

    def __init__(self, path: Path, wanted: Collection[str] = ()) -> None:
        import pyarrow as pa
        import pyarrow.csv as reader

        self._pa, self._reader, self._path, self._wanted = pa, reader, path, wanted
        self._columns: dict[str, Column] = {}
        try:
            with path.open(encoding="utf-8-sig", newline="") as file:
                heading = next(csv.reader(file), [])
        except (UnicodeDecodeError, csv.Error) as error:
            raise TableError(f"wants comma-separated values in UTF-8, but {path.name} is not: {error}") from error
        if len(heading) == 1 and re.search(r"[;\t]", heading[0]):
            raise TableError(f"wants commas between the columns of {path.name}, got '{heading[0][:60]}'")
        matches = [(_HEADING.match(cell.strip()), cell.strip()) for cell in heading]
        self._names = [match["name"] if match else cell for match, cell in matches]
        self._units = [match["unit"].strip() if match else "" for match, _ in matches]

    def column(self, name: str) -> Column:
        """The numbers of a column, and the unit from its heading."""
        if name in self._columns:
            return self._columns[name]
        place = _place(name, self._names)
        try:
            values = self._at_one_go.get(place) or self._read([place], self._pa.float64())[place]
        except self._pa.ArrowInvalid:
            raise TableError(self._complaint(name, place)) from None
        self._columns[name] = Column(_numbers(values), self._units[place])
        return self._columns[name]

    def time(self, name: str | None, of: str) -> Column:
        """The column `time`, or the one named."""
        return self.column(name or "time")

    def row(self, index: int) -> str:
        """The row, counted from 1 below the heading; empty lines are no rows."""
        return f"row {index + 1}"

    def close(self) -> None:
        """Nothing is held."""

    @cached_property
    def _at_one_go(self) -> Mapping[int, Any]:
        """The columns that are wanted, by place; none where one of them is no numbers."""
        places = [place for place, name in enumerate(self._names) if name in self._wanted]
        try:
            return self._read(places, self._pa.float64()) if places else {}
        except self._pa.ArrowInvalid:
            return {}

    def _read(self, places: Sequence[int], kind: Any, refused: Callable[[Any], str] | None = None) -> Mapping[int, Any]:
        names = [str(number) for number in range(len(self._names))]
        included = [names[place] for place in places]
        table = self._reader.read_csv(
            self._path,
            read_options=self._reader.ReadOptions(column_names=names, skip_rows=1, use_threads=refused is None),
            parse_options=self._reader.ParseOptions(invalid_row_handler=refused),
            convert_options=self._reader.ConvertOptions(
                include_columns=included,
                column_types=dict.fromkeys(included, kind),
                null_values=[""],
                strings_can_be_null=True,
            ),
        )
        return dict(zip(places, table.columns, strict=True))

    def _complaint(self, name: str, place: int) -> str:
        """Why a column could not be read: the first row of another length, or cell that is no number."""
        misfits: list[str] = []

        def misfit(row: Any) -> str:
            wanted = f"wants {row.expected_columns} columns in {self._path.name}"
            misfits.append(f"{wanted}, but {self.row(row.number - 2)} has {row.actual_columns}")
            return "skip"

        try:
            cells = self._read([place], self._pa.binary(), misfit)[place]
        except self._pa.ArrowInvalid as error:
            return f"{self._path.name}: {error}"
        if misfits:
            return misfits[0]
        for index, cell in enumerate(cells):
            text = (cell.as_py() or b"nan").decode(errors="replace")
            try:
                float(text.replace("_", "?"))
            except ValueError:
                hint = "; a unit goes into the heading, like 'speed [rpm]'" if index == 0 else ""
                return f"wants numbers, but {self.row(index)} of '{name}' is '{text[:40]}'{hint}"
        return f"{self._path.name}: column '{name}' cannot be read as numbers"


class ParquetFile:
    """Parquet: `unit`, `display_unit` and `kind` come from a column's metadata, as records have them."""

    def __init__(self, path: Path) -> None:
        import pyarrow as pa
        import pyarrow.parquet as reader

        self._pa, self._columns = pa, dict[str, Column]()
        try:
            self._file = reader.ParquetFile(path)
        except pa.ArrowInvalid as error:
            raise TableError(f"{path.name} is no Parquet file: {error}") from error
        self._names = list(self._file.schema_arrow.names)

    def column(self, name: str) -> Column:
        """The numbers of a column and what its metadata says of them."""
        if name in self._columns:
            return self._columns[name]
        field = self._file.schema_arrow.field(_place(name, self._names))
        types = self._pa.types
        whole = types.is_boolean(field.type) or types.is_integer(field.type)
        if not whole and not types.is_floating(field.type):
            raise TableError(f"wants numbers, but '{name}' holds values of the type {field.type}")
        told = {key.decode(): text.decode() for key, text in (field.metadata or {}).items()}
        declared: Kind = "boolean" if types.is_boolean(field.type) else "integer" if whole else "real"
        kind: Any = told.get("kind", declared)
        shown = told.get("display_unit", "")
        unit = "" if told.get("display_unit") == "" else told.get("unit", "")
        self._columns[name] = Column(_numbers(self._file.read([name]).column(0)), unit, shown, kind)
        return self._columns[name]

    def time(self, name: str | None, of: str) -> Column:
        """The column `time`, or the one named."""
        return self.column(name or "time")

    def row(self, index: int) -> str:
        """The row, counted from 1."""
        return f"row {index + 1}"

    def close(self) -> None:
        """Close the file."""
        self._file.close()


class Mdf4File:
    """ASAM MDF 4 by asammdf: each group of channels has its own times, those of its master channel."""

    def __init__(self, path: Path) -> None:
        self._channels: dict[tuple[int, int], _Channel] = {}
        try:
            import asammdf
        except ModuleNotFoundError as error:
            raise TableError(f"{path.name} wants the package asammdf: pip install 'crankbench[mdf]'") from error
        try:
            self._file: Any = asammdf.MDF(path)
        except OSError:
            raise
        except Exception as error:  # a damaged file makes it raise whatever comes first
            raise TableError(f"{path.name} is no MDF4 file, or a damaged one: {error}") from error

    def column(self, name: str) -> Column:
        """The physical values of a channel; the raw numbers of one whose values are words."""
        return self._channel(*self._place(name)).column

    def time(self, name: str | None, of: str) -> Column:
        """The times of a channel's valid samples, or another channel of its group."""
        group, index = self._place(of)
        if name is None:
            return self._channel(group, index).time
        places = [place for place in self._file.channels_db.get(name, ()) if place[0] == group]
        if not places:
            inside = [channel.name for channel in self._file.groups[group].channels]
            raise TableError(unknown(name, inside, f"channel beside '{of}'"))
        return self._channel(*places[0]).column

    def row(self, index: int) -> str:
        """The sample, counted from 1."""
        return f"sample {index + 1}"

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _place(self, name: str) -> tuple[int, int]:
        places = self._file.channels_db.get(name, ())
        if not places:
            raise TableError(unknown(name, self._file.channels_db, "channel"))
        if len(places) > 1:
            groups = ", ".join(str(group) for group, _ in places)
            raise TableError(f"wants one channel '{name}', but the groups {groups} have one each")
        return places[0]

    def _channel(self, group: int, index: int) -> _Channel:
        if (group, index) in self._channels:
            return self._channels[group, index]
        name = self._file.groups[group].channels[index].name
        try:
            signal = self._file.get(group=group, index=index)
            if signal.samples.dtype.kind not in _NUMBERS:
                signal = self._file.get(group=group, index=index, raw=True)
        except Exception as error:  # as above
            raise TableError(f"channel '{name}' cannot be read: {error}") from error
        sort = signal.samples.dtype.kind
        if sort not in _NUMBERS or signal.samples.ndim != 1:
            raise TableError(f"wants numbers, but channel '{name}' holds values of the type {signal.samples.dtype}")
        kind: Kind = "real" if sort == "f" else "boolean" if sort == "b" else "integer"
        master = next((c for c in self._file.groups[group].channels if c.channel_type in _MASTERS), None)
        unit = _SYNC_UNITS.get(master.sync_type, master.unit) if master is not None else ""
        values = Column(signal.samples.astype(float), signal.unit.strip(), kind=kind)
        self._channels[group, index] = _Channel(values, Column(signal.timestamps.astype(float), unit))
        return self._channels[group, index]


class _Channel(NamedTuple):
    column: Column
    time: Column


# Kinds of NumPy's types that are numbers.
_NUMBERS = "biuf"
# Types of a channel that is the master of its group, real or computed; and the units of masters in time and angle.
_MASTERS = (2, 3)
_SYNC_UNITS = {1: "s", 2: "rad"}


def _place(name: str, names: Sequence[str]) -> int:
    """Where a column of this name is. Raises TableError: nowhere, or more than once."""
    if name not in names:
        raise TableError(unknown(name, names, "column"))
    if Counter(names)[name] > 1:
        raise TableError(f"wants one column '{name}', but there are {Counter(names)[name]}")
    return names.index(name)


def _numbers(column: Any) -> Vector:
    """The numbers of an Arrow column, NaN where there is none.

    Its own `to_numpy` would give the same, but import pandas for it, for half a second a process.
    """
    import pyarrow as pa

    pieces = [np.zeros(0)]
    for chunk in column.chunks:
        real = chunk.cast(pa.float64(), safe=False)
        valid, data = real.buffers()
        inside = slice(real.offset, real.offset + len(real))
        numbers = np.zeros(0) if data is None else np.frombuffer(data, dtype=float)[inside]
        if real.null_count:
            bits = np.unpackbits(np.frombuffer(valid, dtype=np.uint8), bitorder="little")[inside]
            numbers = np.where(bits, numbers, np.nan)
        pieces.append(numbers)
    return np.concatenate(pieces)
