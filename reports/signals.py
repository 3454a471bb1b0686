"""Reads recorded signals: only the columns asked for, whole or in pieces."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from fmus.model import unknown
from fmus.units import UnitError, parse_unit
from reports.folder import Case, Run, RunFolderError

Vector = NDArray[np.float64]
# How the description of a fault signal begins; then come, each after '; ', its codes and what they mean.
TELLS_FAULTS = "the fault that acts"


@dataclass(frozen=True)
class Column:
    """One recorded signal: values of shape (n,) in the SI unit `unit`, and the unit it was declared in."""

    name: str
    values: Vector
    unit: str = "1"
    display_unit: str = "1"
    kind: str = "real"
    description: str = ""

    @property
    def discrete(self) -> bool:
        """True for integers and booleans: drawn as steps."""
        return self.kind in ("integer", "boolean")

    def shown_in(self, unit: str = "") -> str:
        """The unit to show: `unit` where it has the signal's dimension, else the declared one."""
        return unit if unit and same_dimension(unit, self.unit) else self.display_unit

    def shown(self, unit: str = "") -> Vector:
        """The values in the unit of `shown_in(unit)`, shape (n,)."""
        return from_si(self.values, self.shown_in(unit))


@dataclass(frozen=True)
class Columns:
    """Signals of one case over `time` [s], shape (n,)."""

    time: Vector
    signals: Mapping[str, Column]


def read_columns(run: Run, case: Case, names: Sequence[str] | None = None) -> Columns:
    """The signals `names` of a case, all where None.

    Raises RunFolderError: the case left no record, or the file is damaged. Raises KeyError with the nearest name: a
    signal was not recorded.
    """
    with open_with(run, case, names or ()) as file:
        return _columns(file.read(columns=_wanted(file.schema_arrow.names if names is None else names)))


@dataclass(frozen=True)
class Recorded:
    """What a case left of some signals: how many rows, and the signals without their values."""

    rows: int
    signals: Mapping[str, Column]
    path: Path

    def pieces(self) -> Iterator[Columns]:
        """The signals, row group by row group."""
        if self.signals:
            with _open(self.path) as file:
                yield from groups(file, self.signals)


def find_recorded(run: Run, case: Case, names: Collection[str]) -> Recorded:
    """Those of the signals `names` that were recorded for a case; none where it left no record.

    Raises RunFolderError: the file is damaged.
    """
    path = _path(run, case)
    if not path.is_file():
        return Recorded(0, {}, path)
    with _open(path) as file:
        signals = {name: column for name, column in without_values(file).items() if name in names}
        return Recorded(file.metadata.num_rows, signals, path)


@dataclass(frozen=True)
class Steps:
    """A signal that keeps to a value for a while: `column.values`, shape (m,), each from `edges[i]` to `edges[i + 1]`.

    These are the times [s] of the first rows of each stretch, and of the last row of all, shape (m + 1,).
    """

    edges: Vector
    column: Column


def read_fault_signals(run: Run, case: Case) -> Mapping[str, Steps]:
    """The recorded signals that tell the truth about faults, which their descriptions say; none without a record.

    Raises RunFolderError: the file is damaged.
    """
    path = _path(run, case)
    if not path.is_file():
        return {}
    with _open(path) as file:
        told = without_values(file)
        signals = {name: one for name, one in told.items() if one.description.startswith(TELLS_FAULTS)}
        edges: dict[str, list[Vector]] = {name: [np.empty(0)] for name in signals}
        values: dict[str, list[Vector]] = {name: [np.empty(0)] for name in signals}
        before, last = dict.fromkeys(signals, np.nan), np.empty(0)
        for columns in groups(file, signals) if signals else ():
            for name, column in columns.signals.items():
                begins = np.diff(column.values, prepend=before[name]) != 0.0  # so does the first, by NaN
                edges[name].append(columns.time[begins])
                values[name].append(column.values[begins])
                before[name] = column.values[-1]
            last = columns.time[-1:]
    return {
        name: Steps(np.concatenate([*edges[name], last]), replace(column, values=np.concatenate(values[name])))
        for name, column in signals.items()
    }


def from_si(values: Vector, unit: str) -> Vector:
    """SI values in `unit`; as they are where nobody knows the unit."""
    try:
        known = parse_unit(unit)
    except UnitError:
        return values
    return (values - known.offset) / known.factor


def same_dimension(first: str, second: str) -> bool:
    """True when both units are known and can be converted into one another."""
    try:
        return parse_unit(first).same_dimension(parse_unit(second))
    except UnitError:
        return False


def _path(run: Run, case: Case) -> Path:
    return run.path / "cases" / case.key / "signals.parquet"


def _open(path: Path) -> pq.ParquetFile:
    try:
        return pq.ParquetFile(path)
    except (OSError, pa.ArrowException) as error:
        raise RunFolderError(f"{path}: wants Parquet, got {error}") from error


def open_with(run: Run, case: Case, names: Collection[str]) -> pq.ParquetFile:
    """The record of a case in which all these signals are.

    Raises RunFolderError: the case left no record, or the file is damaged. Raises KeyError with the nearest name: a
    signal was not recorded.
    """
    path = _path(run, case)
    if not path.is_file():
        raise RunFolderError(f"{path} is missing: case {case.label} ({case.outcome}) left no record")
    file = _open(path)
    known = file.schema_arrow.names
    for name in names:
        if name not in known:
            file.close()
            raise KeyError(unknown(name, known, "recorded signal"))
    return file


def without_values(file: pq.ParquetFile) -> Mapping[str, Column]:
    """All signals of a record, without their values."""
    return _columns(file.schema_arrow.empty_table()).signals


def _wanted(names: Collection[str]) -> list[str]:
    return list(dict.fromkeys(["time", *names]))


def groups(file: pq.ParquetFile, names: Collection[str]) -> Iterator[Columns]:
    """The signals row group by row group; `iter_batches` would hold all of the file's columns as they are packed."""
    for group in range(file.num_row_groups):
        if file.metadata.row_group(group).num_rows:
            yield _columns(file.read_row_group(group, columns=_wanted(names), use_threads=False))


def _columns(table: pa.Table) -> Columns:
    signals = {name: _column(table, name) for name in table.schema.names if name != "time"}
    return Columns(_values(table, "time"), signals)


def _values(table: pa.Table, name: str) -> Vector:
    values: Vector = table.column(name).to_numpy().astype(float, copy=False)
    return values


def _column(table: pa.Table, name: str) -> Column:
    raw = table.schema.field(name).metadata or {}
    metadata = {key.decode(): text.decode() for key, text in raw.items()}
    unit = metadata.get("unit", "1")
    return Column(
        name=name,
        values=_values(table, name),
        unit=unit,
        display_unit=metadata.get("display_unit", unit),
        kind=metadata.get("kind", "real"),
        description=metadata.get("description", ""),
    )
