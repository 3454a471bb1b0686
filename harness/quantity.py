"""Numbers as a campaign file has them, with their units; and the mappings they stand in, which know all their keys."""

from __future__ import annotations

import math
from typing import Annotated, Any, NamedTuple

from pydantic import BaseModel, BeforeValidator, ConfigDict, PlainSerializer, WithJsonSchema

from fmus.units import UnitError, parse_quantity, parse_unit


class Measure(NamedTuple):
    """A number and the unit it was written in; the unit is empty where none stands."""

    value: float
    unit: str

    def si(self, wanted: str) -> float:
        """The value in SI.

        Raises UnitError: not of the dimension of `wanted`, or a bare number where `wanted` has one.
        """
        target = parse_unit(wanted)
        if not self.unit and any(target.exponents):
            raise UnitError(f"wants {wanted}, got the bare number {self.value:g}: write '{self.value:g} {wanted}'")
        source = parse_unit(self.unit)
        if not source.same_dimension(target):
            asked = wanted or "a bare number, since no unit is declared (an FMU's is bound under its `units`)"
            raise UnitError(f"wants {asked}, got {self.value:g} {self.unit}".rstrip())
        return source.to_si(self.value)

    def __str__(self) -> str:
        return f"{self.value!r} {self.unit}".rstrip()


def read_measure(raw: Any) -> Measure:
    """A Measure from `1500 N.m/rad`, 3 or 0.5."""
    if isinstance(raw, Measure):
        return raw
    if isinstance(raw, bool) or not isinstance(raw, (int, float, str)):
        raise ValueError(f"wants a number with a unit, like '1 ms', got {raw!r}")
    measure = Measure(*parse_quantity(raw)) if isinstance(raw, str) else Measure(float(raw), "")
    if not math.isfinite(measure.value):
        raise ValueError(f"wants a finite number, got {raw!r}")
    return measure


Quantity = Annotated[
    Measure,
    BeforeValidator(read_measure),
    PlainSerializer(str),
    WithJsonSchema({"type": ["string", "number"], "description": "number with a unit, like '1500 N.m/rad'"}),
]


class Strict(BaseModel):
    """Unknown keys are errors; values are frozen."""

    model_config = ConfigDict(extra="forbid", frozen=True, populate_by_name=True)
