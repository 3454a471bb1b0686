"""The derivatives of an FMU at a point by Model Exchange, whose states may be set at any time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from ctypes import c_double, c_size_t, c_uint32, c_void_p
from dataclasses import replace

import numpy as np

from fmus.component import WARNING, ConfigurationError, StepError, Vector
from fmus.description import FmuDescription
from fmus.differences import differences
from fmus.fmu import FmuComponent, load_fmu
from fmus.modelstructure import read_structure
from fmus.rungs import Scalar, Source, chosen, is_real, plain_slopes, ranges, scalars_of
from fmus.statespace import Partials, scales
from fmus.units import parse_unit
from fmus.variable import Variable


class ExchangeFmu:
    """An FMU by Model Exchange: at each point its states are set, its derivatives and outputs got."""

    def __init__(self, source: Source) -> None:
        self._source = source
        self._component = self._made({})
        self.name = self._component.name
        description = self._component.description
        self._named = {name: s for s in scalars_of(description.variables) for name in [s.name]}
        self.structure = read_structure(description)
        self._component.start(0.0, self._all_inputs(None))
        self._states = self._state_scalars(description)
        self._inputs = scalars_of([v for v in description.variables if is_real(v, "input")])
        self._outputs = scalars_of([v for v in description.variables if is_real(v, "output")])
        self.states, self.inputs, self.outputs = (
            tuple(scalar.signal() for scalar in scalars) for scalars in (self._states, self._inputs, self._outputs)
        )
        self._version = int(description.fmi_version[0])
        self._description = description
        self._x = np.zeros(len(self.states))
        # Where it starts, which its initialisation may have computed.
        count = c_size_t(len(self._states))
        self._component.slave.call(0.0, "GetContinuousStates", c_void_p(self._x.ctypes.data), count)
        starts = [scalar.unit.to_si(value) for scalar, value in zip(self._states, self._x, strict=True)]
        self.states = tuple(replace(s, start=value) for s, value in zip(self.states, starts, strict=True))
        self._rates = np.zeros(len(self.states))

    def _made(self, states: Mapping[str, float]) -> FmuComponent:
        """A component in Model Exchange that passes its real outputs, and whose discrete inputs stay as they start."""
        s = self._source
        starts = {**s.starts, **states}
        component = load_fmu(s.path, starts=starts, validation=s.validation, kind="me")
        variables = component.description.variables
        component.select_outputs(n for v in variables if is_real(v, "output") for n in v.scalar_names())
        moving = {n for v in variables if is_real(v, "input") for n in v.scalar_names()}
        component.hold_inputs(signal.name for signal in component.inputs if signal.name not in moving)
        return component

    def _state_scalars(self, description: FmuDescription) -> list[Scalar]:
        names = self.structure.states
        if len(names) != description.states:
            names = self._referenced(description) if description.fmi_version.startswith("1") else ()
        if len(names) != description.states:
            names = tuple(f"x[{k + 1}]" for k in range(description.states))
        return [self._named.get(name) or Scalar(_unnamed(name), 0, name) for name in names]

    def _referenced(self, description: FmuDescription) -> tuple[str, ...]:
        """Names of the states of FMI 1, which tells their references."""
        references = (c_uint32 * description.states)()
        self._component.slave.call(0.0, "GetStateValueReferences", references, c_size_t(description.states))
        names = {v.reference: v.name for v in reversed(description.variables) if v.type == "Real"}
        return tuple(names.get(reference, f"x[{k + 1}]") for k, reference in enumerate(references))

    def enter(self, x: Vector, u: Vector) -> None:
        """A fresh instance that begins with these inputs and with those of the states that take a start value."""
        settable = {s.name: float(v) for s, v in zip(self._states, x, strict=True) if s.variable.settable}
        self._component.close()
        self._component = self._made(settable)
        self._component.start(0.0, self._all_inputs(u))

    def _all_inputs(self, u: Vector | None) -> Vector:
        """Values on the bus of the component's inputs, those of `u` in the places of the real ones."""
        signals = self._component.inputs
        values = [parse_unit(s.unit).to_si(float(np.asarray(s.start))) for s in signals]
        if u is not None:
            given = dict(zip((s.name for s in self.inputs), u, strict=True))
            values = [given.get(s.name, value) for s, value in zip(signals, values, strict=True)]
        return np.array(values, dtype=float)

    def values(self, x: Vector, u: Vector) -> tuple[Vector, Vector]:
        """x' and y, SI. Raises StepError: the FMU refused."""
        slave, count = self._component.slave, c_size_t(len(self._states))
        self._x[:] = [s.unit.from_si(v) for s, v in zip(self._states, x, strict=True)]
        slave.call(0.0, "SetContinuousStates", c_void_p(self._x.ctypes.data), count)
        inputs, outputs = self._all_inputs(u), np.zeros(len(self._outputs))
        self._checked(slave.adapter.write(slave.adapter.self, inputs.ctypes.data))
        # Outputs first: OpenModelica's FMUs compute no outputs any more once the derivatives were asked for.
        self._checked(slave.adapter.read(slave.adapter.self, outputs.ctypes.data))
        name = "GetContinuousStateDerivatives" if self._version == 3 else "GetDerivatives"
        slave.call(0.0, name, c_void_p(self._rates.ctypes.data), count)
        return self._rates * [s.unit.factor for s in self._states], outputs

    def _checked(self, status: int) -> None:
        if status > WARNING:
            raise self._component.failure(status, 0.0)

    def slopes(self, x: Vector, u: Vector) -> Vector:
        """A by plain central differences, shape (n, n)."""
        return plain_slopes(self, x, u)

    def partials(self, x: Vector, u: Vector) -> Partials:
        """By directional derivatives where the FMU gives them and they bear out, else by differences."""
        quotients, errors = differences(self._both, np.concatenate([x, u]), ranges(self.states, self.inputs))
        sizes = np.concatenate([scales(self.states), scales(self.inputs)])
        given, told = None, "it does not declare directional derivatives"
        if self._description.capabilities.get("providesDirectionalDerivative"):
            given, told = self._given(x, u)
        return chosen(self, quotients, errors, given, told, sizes)

    def _both(self, z: Vector) -> Vector:
        n = len(self.states)
        return np.concatenate(self.values(z[:n], z[n:]))

    def _given(self, x: Vector, u: Vector) -> tuple[Vector | None, str]:
        """The directional derivatives in SI, or why there are none."""
        self.values(x, u)
        derivatives = [self._named.get(name) for name in self.structure.derivatives]
        if len(derivatives) != len(self._states) or None in derivatives:
            return None, "its derivatives have no names to ask for them by"
        states = {s.name for s in self._states}
        rows = [(s, i) for i, s in enumerate([*derivatives, *self._outputs]) if s is not None and s.name not in states]
        unknowns = list(dict.fromkeys(s.variable for s, _ in rows))
        found = np.zeros((len(self._states) + len(self._outputs), len(self._states) + len(self._inputs)))
        known = [s.name for s in self._states]
        for i, output in enumerate(self._outputs, start=len(self._states)):
            if output.name in states:
                found[i, known.index(output.name)] = 1.0
        try:
            for j, scalar in enumerate([*self._states, *self._inputs]):
                column = self._column(unknowns, scalar)
                for s, i in rows:
                    over = (self._states[i] if i < len(self._states) else s).unit.factor
                    found[i, j] = column[s.name] * over / scalar.unit.factor
        except (StepError, ConfigurationError) as error:
            self.enter(x, u)
            return None, getattr(error, "message", str(error))
        return found, ""

    def _column(self, unknowns: Sequence[Variable], scalar: Scalar) -> dict[str, float]:
        """Derivatives of all scalars of the unknowns with respect to one scalar, in the FMU's own units."""
        sizes = sum(v.size for v in unknowns)
        seed, answer = (c_double * scalar.variable.size)(), (c_double * sizes)()
        seed[scalar.place] = 1.0
        refer = (c_uint32 * len(unknowns))(*(v.reference for v in unknowns))
        known = (c_uint32 * 1)(scalar.variable.reference)
        counts = (c_size_t(len(seed)), c_size_t(sizes)) if self._version == 3 else ()
        tail = (seed, counts[0], answer, counts[1]) if counts else (seed, answer)
        ends = (refer, c_size_t(len(unknowns)), known, c_size_t(1))
        self._component.slave.call(0.0, "GetDirectionalDerivative", *ends, *tail)
        return dict(zip((name for v in unknowns for name in v.scalar_names()), answer, strict=True))

    def close(self) -> None:
        """Free the instance."""
        self._component.close()


def _unnamed(name: str) -> Variable:
    return Variable(name, 0, "Real", "local", "continuous", "")
