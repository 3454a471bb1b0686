"""What a connection of an SSP does to a value, as parts of a campaign: a linear transformation, a table of values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np

from fmus.component import Kind, Native, Role, Signal, StepError, Vector
from fmus.model import Model


def linear(factor: float = 1.0, offset: float = 0.0, from_unit: str = "1", to_unit: str = "1") -> Model:
    """The model of y = factor u + offset, u in `from_unit`, y in `to_unit`: for signals of two dimensions.

    Where the dimension stays, a sensor with gain and bias does the same.
    """
    return Model(
        name="linear",
        description=f"y = {factor!r} u + {offset!r}, u in {from_unit}, y in {to_unit}",
        equations=lambda t, x, m, u, p: ({}, {"y": p.factor * u.u + p.offset}),
        inputs=(Signal("u", from_unit),),
        outputs=(Signal("y", to_unit),),
        parameters=(Signal("factor", start=factor), Signal("offset", start=offset)),
    )


def table(entries: dict[str, Any], kind: Literal["integer", "boolean"] = "integer") -> TableComponent:
    """The part that gives for a value what stands beside it in `entries`, like {0: 2, 1: 0}.

    Raises ValueError: an entry is no number, or there is none.
    """
    return TableComponent({float(key): float(value) for key, value in entries.items()}, kind)


class TableComponent:
    """y = entries[u] of whole numbers; a value that has no entry ends the run, with the value named."""

    role: Role = "plant"
    feedthrough = frozenset({("y", "u")})

    def __init__(self, entries: Mapping[float, float], kind: Kind) -> None:
        if not entries:
            raise ValueError("wants at least one entry, got none")
        self.entries = dict(entries)
        first = next(iter(entries))
        self.inputs: Sequence[Signal] = (Signal("u", start=first, kind=kind),)
        self.outputs: Sequence[Signal] = (Signal("y", start=entries[first], kind=kind),)

    def start(self, t0: float, u: Vector) -> Vector:
        """The value beside u, shape (1,). Raises StepError: there is none."""
        value = float(u[0])
        if value not in self.entries:
            known = ", ".join(f"{entry:g}" for entry in self.entries)
            raise StepError(f"has no entry for {value:g}; there are {known}", time=t0)
        return np.array([self.entries[value]])

    def step(self, t: float, h: float, u: Vector) -> Vector:
        """The value beside u, shape (1,). Raises StepError: there is none."""
        return self.start(t + h, u)

    def native(self) -> Native | None:
        """None: it is Python."""
        return None

    def keep(self) -> None:
        """Nothing is remembered: it has no state."""

    def restore(self) -> None:
        """It has no state to go back to."""

    def close(self) -> None:
        """Nothing is held."""
