"""A hybrid plant as an observer's designer knows it: affine dynamics per location, and a graph with guards."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fmus.component import Signal
from fmus.model import ModelError

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Location:
    """One location's dynamics: x' = A x + B u + E, y = C x.

    A (n, n), B (n, m), C (p, n), E (n,), in the units of the automaton's signals.
    """

    A: Array
    B: Array
    C: Array
    E: Array


@dataclass(frozen=True, eq=False)
class Transition:
    """An edge of the graph: from `source` to `target` (numbered from 1) once `normal` . x + `offset` >= 0.

    `normal` (n,), `offset` in whatever unit normal . x has.
    """

    source: int
    target: int
    normal: Array
    offset: float


@dataclass(frozen=True, eq=False)
class Automaton:
    """A hybrid plant without resets: x is continuous across every transition.

    Locations are numbered from 1 in the order given. `states[i].nominal` is the scale in which a norm
    of x means something.

    Raises ModelError: shapes that contradict the signals, or an edge to a location that is not there.
    """

    states: tuple[Signal, ...]
    inputs: tuple[Signal, ...]
    outputs: tuple[Signal, ...]
    locations: tuple[Location, ...]
    transitions: tuple[Transition, ...]

    def __post_init__(self) -> None:
        n, m, p = len(self.states), len(self.inputs), len(self.outputs)
        wanted = {"A": (n, n), "B": (n, m), "C": (p, n), "E": (n,)}
        for number, location in enumerate(self.locations, start=1):
            for name, shape in wanted.items():
                got = np.shape(getattr(location, name))
                if got != shape:
                    raise ModelError(f"location {number}: {name} wants shape {shape}, got {got}")
        for edge in self.transitions:
            for end in (edge.source, edge.target):
                if not 1 <= end <= len(self.locations):
                    raise ModelError(f"a transition wants locations 1 to {len(self.locations)}, got {end}")
            if np.shape(edge.normal) != (n,):
                raise ModelError(
                    f"the guard {edge.source}->{edge.target} wants shape {(n,)}, got {np.shape(edge.normal)}"
                )

    @property
    def scales(self) -> Array:
        """Scale of each state, shape (n,), in the state's unit."""
        return np.array([signal.nominal for signal in self.states])

    def stacked(self, name: str) -> Array:
        """The matrices called A, B, C or E of all locations, location first."""
        return np.stack([np.asarray(getattr(location, name), dtype=float) for location in self.locations])
