"""What becomes of a value on its way along a connection: units, linear transformations, tables."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

from fmus.units import Unit, UnitError
from harness.ssp.structure import Linear, NamedUnit, Table

_NO_UNIT = Unit()
_ROUNDING = 1e-12  # what the arithmetic of a conversion and its inverse leaves


@dataclass(frozen=True)
class Passage:
    """A value s = factor S + offset, both in SI, of the value S at the beginning; `unit` is what its number is in."""

    unit: Unit | None
    factor: float = 1.0
    offset: float = 0.0

    def read_as(self, unit: Unit | None) -> Passage:
        """The number unchanged, in another unit."""
        old, new = self.unit or _NO_UNIT, unit or _NO_UNIT
        if old == new:
            return replace(self, unit=unit)
        share = new.factor / old.factor
        return Passage(unit, share * self.factor, share * (self.offset - old.offset) + new.offset)

    def converted(self, unit: Unit) -> Passage:
        """The same value in another unit. Raises UnitError: of another dimension."""
        require_alike(self.unit or _NO_UNIT, unit)
        return replace(self, unit=unit)

    def transformed(self, linear: Linear) -> Passage:
        """The number times a factor, and an offset on it."""
        if linear == Linear(1.0, 0.0):
            return self
        unit, factor = self.unit or _NO_UNIT, linear.factor
        moved = factor * (self.offset - unit.offset) + unit.factor * linear.offset + unit.offset
        return Passage(self.unit, factor * self.factor, moved)

    @property
    def nothing(self) -> bool:
        """Whether the value is the one of the beginning, up to the rounding of a conversion."""
        scale = max(1.0, abs((self.unit or _NO_UNIT).offset))
        return math.isclose(self.factor, 1.0, rel_tol=_ROUNDING) and abs(self.offset) <= _ROUNDING * scale


def require_alike(got: Unit, wanted: Unit) -> None:
    """Nothing where two units are of one dimension. Raises UnitError naming both."""
    if not got.same_dimension(wanted):
        raise UnitError(f"wants {wanted.si_name()}, got {got.si_name()}")


def convert_number(number: float, unit: Unit | None, wanted: Unit | None) -> float:
    """A number in another unit; as it is where one of the two is not known. Raises UnitError."""
    if unit is None or wanted is None or unit == wanted:
        return number
    require_alike(unit, wanted)
    return wanted.from_si(unit.to_si(number))


def meaning(unit: NamedUnit | None) -> Unit | None:
    """What a unit means, where that is known."""
    return None if unit is None else unit.meaning


def table_of_numbers(table: Table, source: Mapping[str, int], target: Mapping[str, int]) -> dict[float, float]:
    """A table with the items of enumerations as their numbers.

    Raises ValueError: an item that the enumeration lacks, or one value mapped twice.
    """
    found: dict[float, float] = {}
    for entry in table.entries:
        numbers = []
        for name, items in zip(entry, (source, target), strict=True):
            if isinstance(name, str) and name not in items:
                raise ValueError(f"the item '{name}' is none of {', '.join(items) or 'an enumeration that is known'}")
            numbers.append(float(items[name]) if isinstance(name, str) else name)
        if numbers[0] in found:
            raise ValueError(f"the value {entry[0]} is mapped twice")
        found[numbers[0]] = numbers[1]
    return found
