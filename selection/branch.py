"""A model's derivatives in exact arithmetic along the branch that it takes at a point."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from fmus.component import Vector
from fmus.linearmodel import LinearModel
from fmus.model import ModelError
from selection.tape import Arithmetic, Dual, decisions, differentiate, read_tape

TIME, STATES, DISCRETE, INPUTS, PARAMETERS = range(5)  # the arguments of a model's functions


class Derivatives(NamedTuple):
    """The values of x', and row by row the derivatives of x' and of the outputs with respect to states by place."""

    rates: list[Any]
    A: list[Mapping[int, Any]]
    C: list[Mapping[int, Any]]


class Branch:
    """The branch that a model takes at states x and inputs u, in SI: what its comparisons, extremes and roundings give.

    `arguments` are t, x, m, u, p there, in the units that the model declares; so are derivatives taken on it.

    Raises ModelError: an operation that is not known in exact arithmetic.
    """

    def __init__(self, system: LinearModel, x: Vector, u: Vector) -> None:
        self.system = system
        system.enter(x, u)
        states, inputs = system.native_point(x, u)
        self.arguments = (np.zeros(1), states, system.discrete, inputs, system.parameters)
        self._tape = read_tape(system.traced.equations)
        self._decided = decisions(self._tape, self.arguments)

    def differentiate(self, leaf: Callable[[int, int], Any], arithmetic: Arithmetic) -> Derivatives:
        """The derivatives where `leaf` gives the number for an element of an argument.

        Raises ModelError: one is not defined; it is named.
        """
        rates, declared = differentiate(self._tape, self._decided, leaf, STATES, arithmetic)
        system = self.system
        shown = [Dual(None, {place: arithmetic.number(1.0)}) for place in system.shown_states]
        outputs = [*shown, *(declared[place] for place in system.declared_outputs)]
        states = [self._defined(row, f"der({s.name})") for row, s in zip(rates, system.states, strict=True)]
        seen = [self._defined(row, s.name) for row, s in zip(outputs, system.outputs, strict=True)]
        return Derivatives([row.value for row in states], [row.slopes for row in states], [row.slopes for row in seen])

    def _defined(self, row: Dual | None, name: str) -> Dual:
        if row is None:
            raise ModelError(f"{self.system.model.name}: {name} is not defined on the branch taken at this point")
        return row
