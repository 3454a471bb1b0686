"""The derivatives of a Co-Simulation FMU at a point, in initialisation."""

from __future__ import annotations

import numpy as np

from fmus.component import ConfigurationError, Vector
from fmus.derivatives import Questioned
from fmus.differences import differences
from fmus.fmu import load_fmu
from fmus.modelstructure import ModelStructure
from fmus.rungs import DIFFERENCES, DIRECTIONAL, Source, chosen, is_real, plain_slopes, ranges, scalars_of
from fmus.statespace import Partials, scales
from fmus.units import parse_unit


class InitialFmu:
    """A Co-Simulation FMU in initialisation, where states that have a start value may be set and derivatives got."""

    def __init__(self, source: Source, structure: ModelStructure) -> None:
        self._component = load_fmu(source.path, starts=source.starts, validation=source.validation, kind="cs")
        self.structure = structure
        self.name = self._component.name
        self._description = self._component.description
        named = {s.name: s for s in scalars_of(self._description.variables)}
        self._states = [named[name] for name in structure.states]
        self._derivatives = [named[name] for name in structure.derivatives]
        self._inputs = scalars_of([v for v in self._description.variables if is_real(v, "input") and not v.shape])
        self._outputs = scalars_of([v for v in self._description.variables if is_real(v, "output") and not v.shape])
        self.states, self.inputs, self.outputs = (
            tuple(scalar.signal() for scalar in scalars) for scalars in (self._states, self._inputs, self._outputs)
        )
        self._asked: Questioned | None = None

    def enter(self, x: Vector, u: Vector) -> None:
        """A fresh instance in initialisation."""
        bus = [parse_unit(s.unit).to_si(float(np.asarray(s.start))) for s in self._component.inputs]
        self._asked = Questioned(self._component, 0.0, np.array(bus, dtype=float))

    def values(self, x: Vector, u: Vector) -> tuple[Vector, Vector]:
        """x' and y, SI. Raises StepError: the FMU refused."""
        asked = self._questioned(x, u)
        for scalar, value in zip([*self._states, *self._inputs], [*x, *u], strict=True):
            asked.set(scalar.variable, scalar.unit.from_si(value))
        got = asked.get([s.variable for s in [*self._derivatives, *self._outputs]])
        n = len(self._states)
        rates = got[:n] * [s.unit.factor for s in self._states]
        return rates, np.array([s.unit.to_si(v) for s, v in zip(self._outputs, got[n:], strict=True)], dtype=float)

    def slopes(self, x: Vector, u: Vector) -> Vector:
        """A by plain central differences, shape (n, n)."""
        return plain_slopes(self, x, u)

    def partials(self, x: Vector, u: Vector) -> Partials:
        """By directional derivatives where they bear out. Raises ConfigurationError: they do not."""
        quotients, errors = differences(self._both, np.concatenate([x, u]), ranges(self.states, self.inputs))
        asked, n = self._questioned(x, u), len(self._states)
        names = [s.name for s in self._states]
        own = {i: names.index(s.name) for i, s in enumerate(self._outputs) if s.name in names}
        unknowns = [*enumerate(self._derivatives), *((n + i, s) for i, s in enumerate(self._outputs) if i not in own)]
        given = np.zeros_like(quotients)
        for i, place in own.items():
            given[n + i, place] = 1.0
        # A derivative's unit is its state's, each second.
        over = [(self._states[i] if i < n else s).unit.factor for i, s in unknowns]
        for j, known in enumerate([*self._states, *self._inputs]):
            column = asked.directional([s.variable for _, s in unknowns], known.variable)
            given[[i for i, _ in unknowns], j] = column * over / known.unit.factor
        sizes = np.concatenate([scales(self.states), scales(self.inputs)])
        found = chosen(self, quotients, errors, given, "", sizes)
        if found.rung != DIRECTIONAL:
            raise ConfigurationError(
                f"{self._component.name}: it cannot be made linear. {DIRECTIONAL}: {found.evidence}. {DIFFERENCES}: of "
                "derivatives of Model Exchange, which it does not offer"
            )
        return found

    def _both(self, z: Vector) -> Vector:
        n = len(self.states)
        return np.concatenate(self.values(z[:n], z[n:]))

    def _questioned(self, x: Vector, u: Vector) -> Questioned:
        if self._asked is None:
            self.enter(x, u)
        assert self._asked is not None
        return self._asked

    def close(self) -> None:
        """Free the instance."""
        self._component.close()
