"""A system: parts in their places on a flat bus of doubles, ready to run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Self

from fmus.component import Component, Signal
from fmus.whereabouts import doing
from harness.clock import Grid, Pace
from harness.order import Wire
from harness.scenario import Coupling


@dataclass(frozen=True)
class Slot:
    """A part in its place: where on the bus its inputs come from and its outputs go to, and when it is stepped."""

    name: str
    component: Component
    inputs: tuple[int, ...]
    outputs: range
    pace: Pace


@dataclass(frozen=True)
class Group:
    """Parts side by side in the order that are stepped together and can be taken back.

    `kind` says what for: an algebraic loop is solved by `fixed-point` or `newton`, plants take `smaller steps`, a crank
    clock has the parts up to the plant `steered` exactly. `first` is the place in the order of the first of `count`
    parts. `torn` are pairs of places on the bus, of what a loop's parts read and of what they make of it, `wires` are
    one cycle of the loop.
    """

    kind: str
    first: int
    count: int
    torn: tuple[tuple[int, int], ...] = ()
    wires: tuple[Wire, ...] = ()


@dataclass(frozen=True)
class System:
    """Parts wired on a flat bus of doubles, ready to run.

    `parts` in the order they are stepped, `bus` the signals named `part.output` in the order the parts were declared,
    `recorded` the places on the bus that a record keeps, of one instant in `every`. `held` are the wires whose part
    sees the value at k-1. `speed` and `angle` are the places on the bus that a crank clock reads. `settings` are the
    values the parts were given, in SI. `groups` are stepped together, as `coupling` says; `steered` are the parts that
    a crank clock steers exactly. `notes` say, of a part each, how it is stepped otherwise than its FMU wants.
    """

    grid: Grid
    parts: tuple[Slot, ...]
    bus: tuple[Signal, ...]
    wires: tuple[Wire, ...]
    held: tuple[Wire, ...]
    recorded: tuple[int, ...]
    every: int = 1
    speed: int | None = None
    angle: int | None = None
    settings: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    notes: tuple[tuple[str, str], ...] = ()
    groups: tuple[Group, ...] = ()
    steered: Group | None = None
    coupling: Coupling = field(default_factory=lambda: Coupling.model_validate({}))

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
