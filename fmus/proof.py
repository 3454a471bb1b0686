"""Whether an FMU can be taken back, and whether its derivatives serve: shown by trying, once a process for each FMU."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Hashable
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from fmus.component import WARNING, ConfigurationError, Reversal, StepError, Vector
from fmus.derivatives import DIFFERENCES, TOLERANCE, Questioned, compare, pairs
from fmus.description import FmuDescription
from fmus.interview import inputs_at, same, usual_steps
from fmus.units import parse_unit
from fmus.whereabouts import doing

if TYPE_CHECKING:
    from fmus.fmu import FmuComponent

# Steps up to the state that is kept, and from there on.
BEFORE, AFTER = 10, 10
# Newton's method with a derivative that is off by at most so much of the true one still gains with every round.
NEAR = 0.5

_Move = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p)
_Derive = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p)


class Derivatives(NamedTuple):
    """Of which outputs with respect to which inputs an FMU's directional derivatives serve, and the evidence.

    They serve where they are as near to differences in initialisation as `crankbench check` wants them, and near enough
    to what a step makes of a change. Both names are empty where that is not so of all of them.
    """

    evidence: str
    knowns: frozenset[str] = frozenset()
    unknowns: frozenset[str] = frozenset()


class Proof(NamedTuple):
    """Whether an FMU can be taken back, with the evidence; `started` is false where it did not even start."""

    holds: bool
    evidence: str
    derivatives: Derivatives = Derivatives("not asked: it cannot be taken back")
    started: bool = True


_FOUND: dict[Hashable, Proof] = {}


def takes_back(key: Hashable, description: FmuDescription, make: Callable[[], FmuComponent]) -> Proof:
    """What came of taking back another component of the same FMU, made by `make`: found once for each key.

    It is kept after some steps, goes on, is taken back, goes another way, is taken back again and must make the first
    steps again bit for bit. What crashes or hangs of that does so in this process.
    """
    if key not in _FOUND:
        _FOUND[key] = _proof(description, make)
    return _FOUND[key]


def _proof(description: FmuDescription, make: Callable[[], FmuComponent]) -> Proof:
    if description.fmi_version.startswith("1"):
        return Proof(False, "there is no such thing in FMI 1.0")
    flag = "canGetAndSetFMUState" if description.fmi_version.startswith("3") else "canGetAndSetFMUstate"
    if not description.capabilities.get("canGetAndSetFMUstate"):
        return Proof(False, f"it does not declare {flag}")
    component = make()
    t0, h, _ = usual_steps(description)
    try:
        with doing("prove", component.name):
            way = component.slave.past().reversal()
            try:
                component.start(t0, inputs_at(component, 0))
            except StepError as error:
                return Proof(False, f"it does not start: {error.message}", started=False)
            return _tried(component, way, t0, h)
    except (ConfigurationError, StepError) as error:
        return Proof(False, getattr(error, "message", str(error)))
    finally:
        component.close()


def _tried(component: FmuComponent, way: Reversal, t0: float, h: float) -> Proof:

    def onward(shift: int) -> Vector:
        rows = [component.step(t0 + k * h, h, inputs_at(component, k + shift)) for k in range(BEFORE, BEFORE + AFTER)]
        return np.array(rows)

    for k in range(BEFORE):
        component.step(t0 + k * h, h, inputs_at(component, k))
    move(component, way.keep, way, t0)
    went = onward(0)
    move(component, way.restore, way, t0)
    onward(1)
    move(component, way.restore, way, t0)
    again = onward(0)
    found = same(component, went, again, f"{AFTER} steps and the same after going back twice")
    if not found.passed:
        return Proof(False, found.evidence)
    return Proof(True, found.evidence, _derivatives(component, t0, h))


def move(component: FmuComponent, function: int, way: Reversal, time: float) -> None:
    """Call `keep` or `restore`. Raises StepError: a status above warning."""
    status = _Move(function)(way.self)
    if status > WARNING:
        raise component.failure(status, time)


def _derivatives(component: FmuComponent, t0: float, h: float) -> Derivatives:
    """Which derivatives serve, asked of a component that can be taken back and stands at its kept state."""
    if not component.description.capabilities.get("providesDirectionalDerivative"):
        return Derivatives("it does not declare directional derivatives")
    chosen = pairs(component.description)
    knowns = frozenset(v.name for v in chosen.knowns if v.causality == "input")
    unknowns = frozenset(v.name for v in chosen.unknowns if v.causality == "output")
    if not knowns or not unknowns:
        return Derivatives("it has no continuous output with a continuous input to derive it by")
    try:
        misfit = _uncovered(component, knowns, unknowns) or _misled(component, knowns, unknowns, t0, h)
        if misfit:
            return Derivatives(misfit)
        compared = compare(Questioned(component, t0, inputs_at(component, 0)), chosen)
    except (ConfigurationError, StepError) as error:
        return Derivatives(getattr(error, "message", str(error)))
    worst = max(compared, key=lambda one: one.off)
    told = f"{len(compared)} derivatives in initialisation agree with differences within {TOLERANCE:g}"
    if worst.off > 1.0:
        told = f"d {worst.unknown} / d {worst.known} is {worst.given:.6g}, by differences {worst.difference:.6g}"
        return Derivatives(told)
    return Derivatives(told, knowns, unknowns)


def _direct(component: FmuComponent) -> list[tuple[int, int]]:
    """Places of the outputs and inputs between which there is direct feed-through of reals, states left out."""
    states = {v.name for v in component.description.variables if v.causality == "output" and v.initial == "exact"}
    return [
        (j, i)
        for j, y in enumerate(component.outputs)
        for i, u in enumerate(component.inputs)
        if (y.name, u.name) in component.feedthrough and y.kind == u.kind == "real" and y.name not in states
    ]


def _uncovered(component: FmuComponent, knowns: frozenset[str], unknowns: frozenset[str]) -> str:
    """Which direct feed-through is not among the derivatives that are compared; empty where all is."""
    for j, i in _direct(component):
        y, u = component.outputs[j].name, component.inputs[i].name
        if y not in unknowns or u not in knowns:
            return f"d {y} / d {u} can be held against no difference: one of them is an array, or not continuous"
    return ""


def _misled(component: FmuComponent, knowns: frozenset[str], unknowns: frozenset[str], t0: float, h: float) -> str:
    """Which derivative is far from what a step makes of a change of its input; empty where none is.

    A sampled model passes on at some instants what is no derivative of its equations; between them, nothing.
    """
    way = component.slave.past().reversal(knowns, unknowns)
    t, u = t0 + BEFORE * h, inputs_at(component, BEFORE)

    def after(moved: Vector) -> Vector:
        move(component, way.restore, way, t)
        return component.step(t, h, moved)

    after(u)
    given = np.empty((len(component.outputs), len(u)))
    for i in range(len(u)):
        seed, column = np.eye(len(u))[i].copy(), np.empty(len(component.outputs))
        status = _Derive(way.derivative)(way.self, seed.ctypes.data, column.ctypes.data)
        if status > WARNING:
            raise component.failure(status, t)
        given[:, i] = column
    direct = _direct(component)
    for i in sorted({i for _, i in direct}):
        ends = _moved(component, u, i)
        if ends[0][i] == ends[1][i]:
            continue
        there, back = (after(end) for end in ends)
        quotient = (there - back) / (ends[0][i] - ends[1][i])
        for j in (j for j, other in direct if other == i):
            told = f"d {component.outputs[j].name} / d {component.inputs[i].name} is {given[j, i]:.6g}"
            if given[j, i] == 0.0 == quotient[j]:
                return f"{told} where it was tried, between an output and an input that are declared to depend directly"
            off = abs(quotient[j] - given[j, i])
            if off > NEAR * max(abs(quotient[j]), abs(given[j, i])) + TOLERANCE * _scale(component, j, i):
                return f"{told}, but a step of {h:g} s makes {quotient[j]:.6g} of a change"
    return ""


def _moved(component: FmuComponent, u: Vector, i: int) -> tuple[Vector, Vector]:
    """Inputs with the one at place i moved up and down inside its range."""
    signal, unit = component.inputs[i], parse_unit(component.inputs[i].unit)
    value = unit.from_si(float(u[i]))
    width = DIFFERENCES[0] * max(abs(value), abs(signal.nominal))
    up, down = u.copy(), u.copy()
    up[i] = unit.to_si(min(value + width, signal.maximum))
    down[i] = unit.to_si(max(value - width, signal.minimum))
    return up, down


def _scale(component: FmuComponent, j: int, i: int) -> float:
    """The nominal value of an output over that of an input, in SI units."""
    y, u = component.outputs[j], component.inputs[i]
    return abs(y.nominal * parse_unit(y.unit).factor / (u.nominal * parse_unit(u.unit).factor or 1.0))
