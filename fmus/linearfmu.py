"""The derivatives of an FMU at a point, by the best way that it offers and that bears proof."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from ctypes import c_double, c_size_t, c_uint32, c_void_p
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fmus.component import WARNING, ConfigurationError, Signal, StepError, Vector
from fmus.derivatives import TOLERANCE, Questioned
from fmus.description import FmuDescription, Validation, describe
from fmus.differences import Range, differences
from fmus.fmu import FmuComponent, load_fmu
from fmus.modelstructure import ModelStructure, read_structure
from fmus.statespace import Partials, scales
from fmus.units import Unit, parse_unit
from fmus.variable import Variable

DIRECTIONAL, DIFFERENCES = "directional", "differences"


@dataclass(frozen=True)
class Source:
    """The FMU to make linear: its file, its start values in SI or text, and how it is read."""

    path: Path
    starts: Mapping[str, float | str]
    validation: Validation = "warn"

    def starts_of(self, signals: Sequence[Signal]) -> dict[str, float]:
        """The start values given for these signals, in SI."""
        names = {signal.name for signal in signals}
        return {k: float(v) for k, v in self.starts.items() if k in names and not isinstance(v, str)}


def linear_fmu(source: Source) -> ExchangeFmu | InitialFmu:
    """The FMU as it can be made linear; by Model Exchange where it offers that, else in initialisation.

    Raises ConfigurationError: it gives no derivatives of states in either way; each rung and why it does not hold.
    """
    description = describe(source.path, source.validation)
    structure = read_structure(description)
    if not structure.states and not description.states:
        raise ConfigurationError(f"{source.path}: it cannot be made linear: it has no continuous states")
    if "me" in description.kinds:
        return ExchangeFmu(source)
    lacking = _lacking_in_initialisation(description, structure)
    if lacking:
        raise ConfigurationError(
            f"{source.path}: it cannot be made linear. {DIRECTIONAL}: {lacking}. {DIFFERENCES}: of derivatives of "
            f"Model Exchange, which it does not offer; it offers {', '.join(description.kinds)}"
        )
    return InitialFmu(source, structure)


def _lacking_in_initialisation(description: FmuDescription, structure: ModelStructure) -> str:
    """Why derivatives cannot be asked for in the initialisation of Co-Simulation; empty where they can."""
    if not description.capabilities.get("providesDirectionalDerivative"):
        return "it does not declare directional derivatives"
    if not structure.states:
        return "it lists no derivatives of states"
    known = {v.name: v for v in description.variables}
    for state, derivative in zip(structure.states, structure.derivatives, strict=True):
        if derivative not in known or state not in known or known[state].initial != "exact":
            return f"its state '{state}' cannot be set at the start"
    return ""


class _Scalar:
    """One real scalar of an FMU: its variable, its place in it, and how it goes into SI."""

    def __init__(self, variable: Variable, place: int, name: str) -> None:
        self.variable, self.place, self.name = variable, place, name
        self.unit = variable.quantity or Unit()

    def signal(self) -> Signal:
        """As a signal in SI, without a unit where none is known."""
        v, unit = self.variable, self.unit
        starts = [s for s in v.start if not isinstance(s, str)]
        return Signal(
            self.name,
            "" if v.quantity is None else v.quantity.si_name(),
            unit.to_si(starts[self.place]) if len(starts) > self.place else 0.0,
            v.description,
            nominal=abs(unit.factor * v.nominal) or 1.0,
            minimum=unit.to_si(v.minimum),
            maximum=unit.to_si(v.maximum),
        )


def _scalars(variables: Sequence[Variable]) -> list[_Scalar]:
    return [_Scalar(v, place, name) for v in variables for place, name in enumerate(v.scalar_names())]


def _real(variable: Variable, causality: str) -> bool:
    continuous = variable.variability in ("continuous", "") and variable.type in ("Real", "Float64")
    return variable.causality == causality and continuous and variable.on_bus


class ExchangeFmu:
    """An FMU by Model Exchange: at each point its states are set, its derivatives and outputs got."""

    def __init__(self, source: Source) -> None:
        self._source = source
        self._component = self._made({})
        self.name = self._component.name
        description = self._component.description
        self._named = {name: s for s in _scalars(description.variables) for name in [s.name]}
        self.structure = read_structure(description)
        self._component.start(0.0, self._all_inputs(None))
        self._states = self._state_scalars(description)
        self._inputs = _scalars([v for v in description.variables if _real(v, "input")])
        self._outputs = _scalars([v for v in description.variables if _real(v, "output")])
        self.states, self.inputs, self.outputs = (
            tuple(scalar.signal() for scalar in scalars) for scalars in (self._states, self._inputs, self._outputs)
        )
        self._version = int(description.fmi_version[0])
        self._description = description
        self._u: Vector = np.array([float(np.asarray(s.start)) for s in self.inputs])
        self._x = np.zeros(len(self.states))
        self._rates = np.zeros(len(self.states))

    def _made(self, states: Mapping[str, float]) -> FmuComponent:
        """A component in Model Exchange that passes its real outputs, and whose discrete inputs stay as they start."""
        s = self._source
        starts = {**s.starts, **states}
        component = load_fmu(s.path, starts=starts, validation=s.validation, kind="me")
        variables = component.description.variables
        component.select_outputs(n for v in variables if _real(v, "output") for n in v.scalar_names())
        moving = {n for v in variables if _real(v, "input") for n in v.scalar_names()}
        component.hold_inputs(signal.name for signal in component.inputs if signal.name not in moving)
        return component

    def _state_scalars(self, description: FmuDescription) -> list[_Scalar]:
        names = self.structure.states
        if len(names) != description.states:
            names = self._referenced(description) if description.fmi_version.startswith("1") else ()
        if len(names) != description.states:
            names = tuple(f"x[{k + 1}]" for k in range(description.states))
        return [self._named.get(name) or _Scalar(_unnamed(name), 0, name) for name in names]

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
        return _slopes(self, x, u)

    def partials(self, x: Vector, u: Vector) -> Partials:
        """By directional derivatives where the FMU gives them and they bear out, else by differences."""
        quotients, errors = differences(self._both, np.concatenate([x, u]), _ranges(self.states, self.inputs))
        sizes = np.concatenate([scales(self.states), scales(self.inputs)])
        given, told = None, "it does not declare directional derivatives"
        if self._description.capabilities.get("providesDirectionalDerivative"):
            given, told = self._given(x, u)
        return _chosen(self, quotients, errors, given, told, sizes)

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

    def _column(self, unknowns: Sequence[Variable], scalar: _Scalar) -> dict[str, float]:
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


class InitialFmu:
    """A Co-Simulation FMU in initialisation, where states that have a start value may be set and derivatives got."""

    def __init__(self, source: Source, structure: ModelStructure) -> None:
        self._component = load_fmu(source.path, starts=source.starts, validation=source.validation, kind="cs")
        self.structure = structure
        self.name = self._component.name
        self._description = self._component.description
        named = {s.name: s for s in _scalars(self._description.variables)}
        self._states = [named[name] for name in structure.states]
        self._derivatives = [named[name] for name in structure.derivatives]
        self._inputs = _scalars([v for v in self._description.variables if _real(v, "input") and not v.shape])
        self._outputs = _scalars([v for v in self._description.variables if _real(v, "output") and not v.shape])
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
        return _slopes(self, x, u)

    def partials(self, x: Vector, u: Vector) -> Partials:
        """By directional derivatives where they bear out. Raises ConfigurationError: they do not."""
        quotients, errors = differences(self._both, np.concatenate([x, u]), _ranges(self.states, self.inputs))
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
        found = _chosen(self, quotients, errors, given, "", sizes)
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


def _unnamed(name: str) -> Variable:
    return Variable(name, 0, "Real", "local", "continuous", "")


def _slopes(system: ExchangeFmu | InitialFmu, x: Vector, u: Vector) -> Vector:
    """Central differences whose width balances rounding and curvature, a cube root of the precision of the size."""
    widths = np.cbrt(np.finfo(float).eps) * np.maximum(np.abs(x), scales(system.states))
    steps = np.diag(widths)
    ends = [(system.values(x + step, u)[0], system.values(x - step, u)[0]) for step in steps]
    return np.array([(up - down) / (2.0 * width) for (up, down), width in zip(ends, widths, strict=True)]).T


def _ranges(states: Sequence[Signal], inputs: Sequence[Signal]) -> list[Range]:
    """Inputs are kept inside their range; the states of an FMU take what they are given."""
    sizes = zip((*states, *inputs), scales((*states, *inputs)), strict=True)
    return [
        Range(float(size), *((signal.minimum, signal.maximum) if i >= len(states) else (-np.inf, np.inf)))
        for i, (signal, size) in enumerate(sizes)
    ]


def _chosen(
    system: ExchangeFmu | InitialFmu, quotients: Vector, errors: Vector, given: Vector | None, told: str, sizes: Vector
) -> Partials:
    """The directional derivatives where they agree with the quotients within TOLERANCE, else the quotients.

    Differences and errors of an entry count relative to what all entries of its row make of changes of these sizes.
    """
    n = len(system.states)

    def parts(found: Vector) -> tuple[Vector, Vector, Vector, Vector]:
        return found[:n, :n], found[:n, n:], found[n:, :n], found[n:, n:]

    reach = np.abs(quotients) @ sizes
    per_row = np.divide(1.0, reach, out=np.ones_like(reach), where=reach > 0.0)[:, None]
    if given is not None:
        off = np.abs(given - quotients) * sizes * per_row
        off = np.where(np.isfinite(off), off, np.inf)
        if off.max(initial=0.0) <= TOLERANCE:
            told = f"{given.size} directional derivatives agree with differences within {off.max(initial=0.0):.1e}"
            return Partials(*parts(given), DIRECTIONAL, max(float(off.max()), float(np.finfo(float).eps)), told)
        i, j = np.unravel_index(int(off.argmax()), off.shape)
        row = [*(f"der({s.name})" for s in system.states), *(s.name for s in system.outputs)][i]
        column = (*system.states, *system.inputs)[j].name
        told = f"its directional derivative d {row} / d {column} is {given[i, j]:.6g}, by differences "
        told += f"{quotients[i, j]:.6g}"
    error = float((errors * sizes * per_row).max(initial=np.finfo(float).eps))
    return Partials(*parts(quotients), DIFFERENCES, error, told)
