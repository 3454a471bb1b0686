"""Columns of a file as points in SI, every problem at its key of the campaign file."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import closing, contextmanager
from typing import NamedTuple

import numpy as np

from fmus.component import Kind
from fmus.units import BASE, Unit, UnitError, parse_unit
from harness.findings import Findings
from harness.tablefile import TableError, TableFile, Vector, open_table

_RAD = BASE.index("rad")


class Asked(NamedTuple):
    """A column that a campaign names: where the name stands, and what is said of it beside `unit`."""

    column: str
    unit: str | None
    here: Findings
    key: str
    kind: Kind | None = None


class Axis(NamedTuple):
    """What a recording is over: time in s or the crank angle in deg, named by the keys `key` and `key_unit`.

    `column` is its column, None where that is left to the file; `given` the unit that the campaign gives.
    """

    key: str
    unit: str
    column: str | None
    given: str | None


class Recorded(NamedTuple):
    """A column in SI over an axis that ascends, finite, both of shape (n,), n > 0; `unit` is for display."""

    times: Vector
    values: Vector
    unit: str
    kind: Kind


class Recording:
    """An open file of columns over an axis, as a part of a campaign file names it."""

    def __init__(self, table: TableFile, axis: Axis, found: Findings) -> None:
        self._table, self._axis, self._found = table, axis, found

    def read(self, asked: Asked) -> Recorded | None:
        """A column with its times; None where something is wrong with either, which is told."""
        here = asked.here.at(asked.key)
        try:
            column = self._table.column(asked.column)
        except TableError as error:
            here.add(str(error))
            return None
        unit = _settled(column.unit, asked.unit, asked.column, here, asked.here.at("unit"))
        kind = asked.kind or column.kind
        misfit = self._misfit(column.values, kind)
        if misfit:
            here.add(f"{misfit} of '{asked.column}'")
        times = self._times(asked.column)
        if unit is None or misfit or times is None:
            return None
        if len(times) != len(column.values):
            here.add(f"wants a time for each of {len(column.values)} values of '{asked.column}', got {len(times)}")
            return None
        shown = column.shown if asked.unit is None and _same_dimension(column.shown, unit) else unit
        return Recorded(times, converted(column.values, unit), shown, kind)

    def _misfit(self, values: Vector, kind: Kind) -> str:
        """What is wrong with the first value that does not fit; empty where all do."""
        if not len(values):
            return "wants at least one row"
        fits, wanted = np.isfinite(values), "a finite number"
        if kind == "integer":
            fits, wanted = fits & (values == np.round(values)), "a whole number"
        elif kind == "boolean":
            fits, wanted = (values == 0.0) | (values == 1.0), "0 or 1"
        if fits.all():
            return ""
        first = int(np.argmin(fits))
        return f"wants {wanted}, got {_told(values[first])} in {self._table.row(first)}"

    def _times(self, of: str) -> Vector | None:
        """Where on the axis the rows of a column are; None where something is wrong with that, which is told."""
        key, wanted, name, given = self._axis
        here = self._found.at(key)
        try:
            column = self._table.time(name, of)
        except TableError as error:
            here.add(str(error))
            return None
        unit = _settled(column.unit, given, name or key, here, self._found.at(f"{key}_unit"))
        if unit is None:
            return None
        if not _same_dimension(unit, wanted):
            here.add(f"wants {wanted}, got {unit}")
            return None
        times, finite = column.values, np.isfinite(column.values)
        if not finite.all():
            first = int(np.argmin(finite))
            here.add(f"wants a finite number, got {_told(times[first])} in {self._table.row(first)}")
            return None
        late = times[1:] > times[:-1]
        if not late.all():
            first = int(np.argmin(late))
            before = f"wants more than the {times[first]:.9g} {unit} of {self._table.row(first)}"
            here.add(f"{before}, got {times[first + 1]:.9g} {unit} in {self._table.row(first + 1)}")
            return None
        return converted(times, unit, wanted)


@contextmanager
def open_recording(file: str, columns: Collection[str], axis: Axis, found: Findings) -> Iterator[Recording | None]:
    """The recording that a part names, its path from the folder of the campaign file; None where it cannot be opened.

    `columns` are those that will be read. What is wrong goes to `found`, each once.
    """
    try:
        table = open_table(found.folder / file, {*columns, axis.column or "time"})
    except TableError as error:
        found.at("file").add(str(error))
        yield None
        return
    before = len(found.problems)
    with closing(table):
        yield Recording(table, axis, found)
    found.problems[before:] = dict.fromkeys(found.problems[before:])


def converted(values: Vector, unit: str, wanted: str = "") -> Vector:
    """The values given in a unit in the one wanted, in SI where that is empty; the very same bits in the same unit."""
    given = parse_unit(unit)
    target = parse_unit(wanted) if wanted else Unit(given.exponents)
    if (given.factor, given.offset) == (target.factor, target.offset):
        return np.ascontiguousarray(values)
    in_si = given.factor * values + given.offset
    return np.ascontiguousarray((in_si - target.offset) / target.factor)


def settle_unit(said: str, given: str | None, name: str) -> str:
    """What a column is in, where its file says `said` and the campaign `given`; either may say nothing.

    The campaign may give a unit that the file leaves out or that nobody knows, and may tell angles from numbers: a
    file's 1/min may count turns, the campaign's rpm does.

    Raises UnitError: none is given, an unknown one, or they contradict each other.
    """
    if given is None:
        if not said:
            raise UnitError(f"wants a unit: the file does not say what '{name}' is in")
        try:
            parse_unit(said)
        except UnitError:
            raise UnitError(f"the file says that '{name}' is in '{said}', an unknown unit") from None
        return said
    campaign = parse_unit(given)
    try:
        file = parse_unit(said) if said else campaign
    except UnitError:
        return given
    if _contradict(file, campaign):
        raise UnitError(f"the file says that '{name}' is in {said}, the campaign that it is in {given}")
    return given


def _contradict(one: Unit, other: Unit) -> bool:
    without_rad = [tuple(np.delete(unit.exponents, _RAD)) for unit in (one, other)]
    if without_rad[0] != without_rad[1]:
        return True
    if one.exponents != other.exponents:
        return False
    # Factors are products of a few numbers, and so differ by a few roundings where they are the same.
    return not np.allclose([one.factor, one.offset], [other.factor, other.offset], rtol=1e-12, atol=0.0)


def _settled(said: str, given: str | None, name: str, here: Findings, at_unit: Findings) -> str | None:
    """`settle_unit`, with what is wrong told: at the unit where the campaign gives one, else at the column."""
    try:
        return settle_unit(said, given, name)
    except UnitError as error:
        if given is None:
            here.add(f"{error}; write `{at_unit.path[-1]}: ...`")
        else:
            at_unit.add(str(error))
        return None


def _same_dimension(one: str, other: str) -> bool:
    try:
        return bool(one) and parse_unit(one).same_dimension(parse_unit(other))
    except UnitError:
        return False


def _told(value: float) -> str:
    return "none" if np.isnan(value) else f"{value:.9g}"
