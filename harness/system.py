"""A system: parts in their places on a flat bus of doubles, ready to run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from fmus.component import Component, Signal
from fmus.whereabouts import doing
from harness.order import Wire


class TimeGrid(NamedTuple):
    """Instants t_k = start + k step [s], k = 0 ... steps."""

    start: float
    step: float
    steps: int

    def instants(self, count: int) -> NDArray[np.float64]:
        """The first `count` instants [s]."""
        return self.start + np.arange(count, dtype=np.float64) * self.step


@dataclass(frozen=True)
class Slot:
    """A part in its place: where on the bus its inputs come from and its outputs go to, and its period in steps."""

    name: str
    component: Component
    inputs: tuple[int, ...]
    outputs: range
    period: int


@dataclass(frozen=True)
class System:
    """Parts wired on a flat bus of doubles, ready to run.

    `parts` in the order they are stepped, `bus` the signals named `part.output` in the order the parts were declared,
    `recorded` the places on the bus that a record keeps. `held` are the wires whose part sees the value at k-1.
    `settings` are the values the parts were given, in SI.
    """

    grid: TimeGrid
    parts: tuple[Slot, ...]
    bus: tuple[Signal, ...]
    wires: tuple[Wire, ...]
    held: tuple[Wire, ...]
    recorded: tuple[int, ...]
    settings: Mapping[str, Mapping[str, float]] = field(default_factory=dict)

    @property
    def order(self) -> tuple[str, ...]:
        """Names of the parts in the order they are stepped."""
        return tuple(part.name for part in self.parts)

    @property
    def components(self) -> dict[str, Component]:
        """The components by part name."""
        return {part.name: part.component for part in self.parts}

    def close(self) -> None:
        """Release what the components hold."""
        for part in self.parts:
            with doing("close", part.name):
                part.component.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
