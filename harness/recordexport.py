"""Writes kept records as CSV or MDF4 for other tools, a row group at a time."""

from __future__ import annotations

import contextlib
import csv
import io
import os
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from fmus.component import ConfigurationError
from fmus.units import Unit, UnitError, parse_unit
from fmus.whole import whole_file

Format = Literal["csv", "mdf4"]
Units = Literal["declared", "si"]
SUFFIXES: dict[Format, str] = {"csv": ".csv", "mdf4": ".mf4"}
TYPES = {"real": np.float64, "integer": np.int64, "boolean": np.uint8}


@dataclass(frozen=True)
class Channel:
    """A column as it is exported: its unit, the type of its values, and what the values are converted by, if at all."""

    name: str
    unit: str
    kind: str
    description: str
    scale: Unit | None

    @property
    def heading(self) -> str:
        """Name and unit, as a column of a CSV file is headed."""
        return self.name if self.unit == "1" else f"{self.name} [{self.unit}]"

    def values(self, stored: NDArray[np.float64]) -> NDArray[Any]:
        """The values in the unit, shape (n,)."""
        if self.kind != "real":
            return stored.astype(TYPES[self.kind])
        return stored if self.scale is None else (stored - self.scale.offset) / self.scale.factor


def export(target: Path, form: Format, out: Path | None, units: Units) -> Iterator[Path]:
    """The files as they are written: of a record, of the one in a case's folder, or of all of a run folder.

    A file stands beside its record, or in the folder `out`, named by its case; `out` may name the file where there is
    but one record.

    Raises ConfigurationError: no record there, no such place to write to, or a package that is missing.
    """
    records = find_records(target)
    suffix = SUFFIXES[form]
    if out is not None and out.suffix == suffix and len(records) > 1:
        raise ConfigurationError(f"--out wants a folder for {len(records)} records, got {out}")
    if out is not None and out.suffix != suffix and out.exists() and not out.is_dir():
        raise ConfigurationError(f"--out wants a folder or a file that ends in {suffix}, got the file {out}")
    write = {"csv": write_csv, "mdf4": write_mdf4}[form]
    for record in records:
        if out is None:
            path = record.with_suffix(suffix)
        else:
            path = out if out.suffix == suffix else out / f"{record.absolute().parent.name}{suffix}"
        write(record, path, units)
        yield path


def find_records(target: Path) -> list[Path]:
    """The records of a run folder, of a case's folder, or the one record. Raises ConfigurationError: there is none."""
    if target.is_file():
        return [target]
    if not target.is_dir():
        raise ConfigurationError(f"export wants a run folder, a case's folder or a signals.parquet, got {target}")
    found = [path for path in [target / "signals.parquet"] if path.is_file()]
    found = found or sorted(target.glob("cases/*/signals.parquet"))
    if not found:
        raise ConfigurationError(f"{target} holds no record: no signals.parquet, and none in cases/")
    return found


def write_csv(record: Path, path: Path, units: Units) -> None:
    """Write a line of headings like `plant.speed [rpm]` and a line a row; numbers read back are the same.

    Raises ConfigurationError: it is no record.
    """
    from pyarrow.csv import CSVWriter, WriteOptions

    with _opened(record) as file, whole_file(path) as out:
        channels = _channels(file, units)
        heading = io.StringIO()
        csv.writer(heading, lineterminator="\n").writerow(channel.heading for channel in channels)
        out.write(heading.getvalue().encode())
        types = {"real": pa.float64(), "integer": pa.int64(), "boolean": pa.uint8()}
        schema = pa.schema([(channel.name, types[channel.kind]) for channel in channels])
        with CSVWriter(out, schema, write_options=WriteOptions(include_header=False)) as writer:
            for columns in _groups(file, channels):
                writer.write_table(pa.Table.from_arrays([pa.array(values) for values in columns], schema=schema))


def write_mdf4(record: Path, path: Path, units: Units) -> None:
    """Write one group of channels over their common time, by asammdf; it begins when the record was written.

    Raises ConfigurationError: it is no record, or asammdf is not installed.
    """
    try:
        from asammdf import MDF, Signal
    except ImportError as error:
        raise ConfigurationError(f"mdf4 wants the package asammdf: pip install 'crankbench[mdf]' ({error})") from error
    path.parent.mkdir(parents=True, exist_ok=True)
    with (
        _opened(record) as file,
        tempfile.TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent) as folder,
        contextlib.redirect_stdout(io.StringIO()),  # asammdf prints how fast it was, where it was slow
        MDF(version="4.10", temporary_folder=folder) as mdf,
    ):
        channels = _channels(file, units)
        mdf.header.start_time = datetime.fromtimestamp(record.stat().st_mtime, UTC)
        time, *columns = [channel.values(np.empty(0)) for channel in channels]
        signals = [
            Signal(values, time, unit=channel.unit, name=channel.name, comment=channel.description)
            for channel, values in zip(channels[1:], columns, strict=True)
        ]
        mdf.append(signals, common_timebase=True)
        for group in _groups(file, channels):
            mdf.extend(0, [(values, None) for values in group])
        saved = mdf.save(Path(folder, "saved.mf4"), compression=2)
        with open(saved, "rb") as written:
            os.fsync(written.fileno())
        saved.replace(path)


@contextlib.contextmanager
def _opened(record: Path) -> Iterator[pq.ParquetFile]:
    try:
        file = pq.ParquetFile(record)
    except (OSError, pa.ArrowException) as error:
        raise ConfigurationError(f"{record} wants to be a record in Parquet: {error}") from error
    with file:
        if file.schema_arrow.names[:1] != ["time"]:
            raise ConfigurationError(f"{record} is no record: its first column is not time")
        yield file


def _channels(file: pq.ParquetFile, units: Units) -> list[Channel]:
    """The columns of a record, time first."""
    channels = []
    for field in file.schema_arrow:
        told = {key.decode(): text.decode() for key, text in (field.metadata or {}).items()}
        unit, shown = told.get("unit", "1"), told.get("display_unit", told.get("unit", "1"))
        kind = told.get("kind", "real")
        kind = kind if kind in TYPES else "real"
        scale = _scale(unit, shown) if units == "declared" and kind == "real" else None
        name, description = str(field.name), told.get("description", "")
        channels.append(Channel(name, unit if scale is None else shown, kind, description, scale))
    return channels


def _scale(unit: str, shown: str) -> Unit | None:
    """What SI values are converted by; None where they stay as they are."""
    try:
        return None if unit == shown else parse_unit(shown)
    except UnitError:
        return None


def _groups(file: pq.ParquetFile, channels: list[Channel]) -> Iterator[list[NDArray[Any]]]:
    """The values of all channels, row group by row group."""
    for number in range(file.num_row_groups):
        table = file.read_row_group(number, use_threads=False)
        yield [channel.values(table.column(channel.name).to_numpy()) for channel in channels]
