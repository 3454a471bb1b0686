"""Finds a model's signals in a record: which column is which, in SI, and what follows where a state is not recorded."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow.parquet as pq
from numpy.typing import NDArray

from fmus.component import ConfigurationError, Problem, Signal, Vector
from fmus.model import unknown
from fmus.statespace import StateSpace
from fmus.units import UnitError, parse_unit
from harness.record import read_signals
from harness.signalsfile import LEADING
from selection.noise import follow

# Places of rows in a record.
Rows = NDArray[np.intp]


class Columns(NamedTuple):
    """By the model's names, the recorded signal that each is; what is recorded but was given to none is left out."""

    names: Mapping[str, str]


class Course(NamedTuple):
    """A record as a model has it: time (k,), crank [deg] or None, states (k, n), inputs (k, m), sensors (k, q), SI.

    Columns of states that are neither recorded nor follow from what is are NaN; `followed` names those that follow.
    """

    time: Vector
    crank: Vector | None
    x: Vector
    u: Vector
    y: Vector
    followed: tuple[str, ...]


def columns(space: StateSpace, path: Path, mapping: Mapping[str, str], part: str, more: Sequence[str] = ()) -> Columns:
    """The recorded signal of each state and input and of the outputs `more`, as far as there is one.

    A name goes by the mapping, else to `part.name`, else to `name` or `name.value`, as sources and sensors have it,
    else, where no part is named, to the only signal that ends in `.name`.

    Raises ConfigurationError, with all that is wrong: names that are not the model's or not recorded, a name that two
    parts have, units that do not fit.
    """
    recorded = _recorded(path)
    signals = {s.name: s for s in (*space.outputs, *space.states, *space.inputs)}
    wanted = dict.fromkeys([*(s.name for s in (*space.states, *space.inputs)), *more])
    problems = [Problem(f"--map {name}: {unknown(name, signals, 'signal')}") for name in mapping if name not in signals]
    found: dict[str, str] = {}
    for name in wanted:
        if name in mapping:
            if mapping[name] not in recorded:
                problems.append(Problem(f"--map {name}: {unknown(mapping[name], recorded, 'recorded signal')}"))
                continue
            found[name] = mapping[name]
        else:
            candidates = _candidates(name, recorded, part)
            if len(candidates) > 1:
                problems.append(
                    Problem(f"{name} is recorded as {' and '.join(candidates)}: say which by --part or --map")
                )
            elif candidates:
                found[name] = candidates[0]
        if name in found and not _fits(recorded[found[name]], signals[name].unit):
            problems.append(
                Problem(f"{name} wants {signals[name].unit}, {found[name]} is in {recorded[found[name]] or 'no unit'}")
            )
    if problems:
        raise ConfigurationError(problems)
    return Columns(found)


def _recorded(path: Path) -> dict[str, str]:
    """Recorded signals and their units."""
    schema = pq.read_schema(path)
    return {
        field.name: (field.metadata or {}).get(b"unit", b"").decode() for field in schema if field.name not in LEADING
    }


def _candidates(name: str, recorded: Iterable[str], part: str) -> list[str]:
    names = list(recorded)
    first = [f"{part}.{name}"] if part else []
    for one in (*first, name, f"{name}.value"):
        if one in names:
            return [one]
    return [] if part else [one for one in names if one.endswith(f".{name}")]


def _fits(unit: str, wanted: str) -> bool:
    try:
        return parse_unit(unit).same_dimension(parse_unit(wanted))
    except UnitError:
        return False


def read_course(
    path: Path,
    space: StateSpace,
    found: Columns,
    lags: Sequence[str],
    sensors: Sequence[str],
    window: tuple[float, float],
) -> Course:
    """The rows of a record within the window [s]; inputs that are not recorded stay at the point.

    A state of `lags` that is not recorded follows its own linear equation from the point, where all that it depends on
    is known: it is exact for an actuator, which depends on its command alone.
    """  # fmt: skip
    record = read_signals(path, sorted(set(found.names.values())))
    rows = (record.time >= window[0]) & (record.time <= window[1])
    time = record.time[rows]
    if len(time) < 3:
        raise ConfigurationError(f"{path}: wants three rows or more from {window[0]:g} s on, has {len(time)}")

    def table(signals: Sequence[Signal], otherwise: Vector) -> Vector:
        values = np.tile(otherwise, (len(time), 1))
        for i, signal in enumerate(signals):
            if signal.name in found.names:
                values[:, i] = record[found.names[signal.name]][rows]
        return values

    u = table(space.inputs, space.u0)
    x = table(space.states, np.full(len(space.states), np.nan))
    followed = []
    for i, signal in enumerate(space.states):
        if signal.name in lags and signal.name not in found.names and space.A[i, i] < 0.0:
            others = np.flatnonzero(space.A[i])
            others = others[others != i]
            if np.isnan(x[:, others]).any():
                continue
            drive = space.rates[i] + (x[:, others] - space.x0[others]) @ space.A[i, others]
            target = space.x0[i] - (drive + (u - space.u0) @ space.B[i]) / space.A[i, i]
            x[:, i] = follow(time, target, -1.0 / space.A[i, i], float(target[0]))
            followed.append(signal.name)
    y = np.full((len(time), len(sensors)), np.nan)
    for j, name in enumerate(sensors):
        if name in found.names:
            y[:, j] = record[found.names[name]][rows]
    return Course(time, None if record.crank is None else record.crank[rows], x, u, y, tuple(followed))
