"""Reads recorded signals, only the columns asked for, and thins them for drawing without losing events."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
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
    path = _path(run, case)
    if not path.is_file():
        raise RunFolderError(f"{path} is missing: case {case.label} ({case.outcome}) left no record")
    with _open(path) as file:
        known = file.schema_arrow.names
        for name in names or ():
            if name not in known:
                raise KeyError(unknown(name, known, "recorded signal"))
        return _columns(file, known if names is None else names)


def read_recorded(run: Run, case: Case, names: Collection[str]) -> Columns:
    """Those of the signals `names` that were recorded for a case; none where it left no record.

    Raises RunFolderError: the file is damaged.
    """
    path = _path(run, case)
    if not path.is_file():
        return Columns(np.empty(0), {})
    with _open(path) as file:
        return _columns(file, [name for name in file.schema_arrow.names if name in names])


def read_fault_signals(run: Run, case: Case) -> Columns:
    """The recorded signals that tell the truth about faults, which their descriptions say; none without a record.

    Raises RunFolderError: the file is damaged.
    """
    path = _path(run, case)
    if not path.is_file():
        return Columns(np.empty(0), {})
    with _open(path) as file:
        told = {field.name: (field.metadata or {}).get(b"description", b"").decode() for field in file.schema_arrow}
        return _columns(file, [name for name, text in told.items() if text.startswith(TELLS_FAULTS)])


def envelope(time: Vector, values: Vector, points: int) -> tuple[Vector, Vector]:
    """At most about `points` samples that keep every extreme: the least and the greatest of each of points/2 stretches.

    The first and the last sample are kept. Up to `points` samples come back as they are.
    """
    if len(time) <= points:
        return time, values
    stretches = max(points // 2, 1)
    edges = np.linspace(0, len(time), stretches + 1).astype(int)
    keep = {0, len(time) - 1}
    for start, stop in pairwise(edges):
        piece = values[start:stop]
        keep.update((start + int(np.argmin(piece)), start + int(np.argmax(piece))))
    chosen = np.array(sorted(keep))
    return time[chosen], values[chosen]


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
        return pq.ParquetFile(path, memory_map=True)
    except (OSError, pa.ArrowException) as error:
        raise RunFolderError(f"{path}: wants Parquet, got {error}") from error


def _columns(file: pq.ParquetFile, names: Sequence[str]) -> Columns:
    table = file.read(columns=list(dict.fromkeys(["time", *names])), use_threads=False)
    signals = {name: _column(table, name) for name in table.column_names if name != "time"}
    return Columns(table.column("time").to_numpy().astype(float), signals)


def _column(table: pa.Table, name: str) -> Column:
    raw = table.schema.field(name).metadata or {}
    metadata = {key.decode(): text.decode() for key, text in raw.items()}
    unit = metadata.get("unit", "1")
    return Column(
        name=name,
        values=table.column(name).to_numpy().astype(float),
        unit=unit,
        display_unit=metadata.get("display_unit", unit),
        kind=metadata.get("kind", "real"),
        description=metadata.get("description", ""),
    )
