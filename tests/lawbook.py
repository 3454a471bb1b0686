"""The laws of a Component, which every FMU and every part written in Python keeps.

Declaration   Signals are scalars with different names, units that are known (or none) and finite starts, those of
              inputs inside their range; feedthrough names declared outputs and inputs.
Values        `start` and `step` give as many finite doubles as outputs are declared, in an array of the caller's own,
              and leave u as it is.
Start         rebuilds all state: after any run, a start gives the same run again bit for bit.
Apart         Two components made alike do not know of each other, stepped in turns.
Native        The step that C calls gives the outputs of the step that Python calls bit for bit, with status ok.
Reversal      Taken back to a state that was kept, it makes the same steps again bit for bit, as often as wanted and
              whatever it did between; and keeping changes nothing, but for solvers, which start anew.
Feedthrough   An input acts at once only on outputs that declare it: of an output that does not, what a change of the
              input over the last step does vanishes as that step becomes short.
Chance        No global random state is read or moved.
Close         may be called again; a step afterwards is an error.
"""

from __future__ import annotations

import ctypes
import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import pytest

from fmus.component import OK, Component, Signal, StepError, Vector
from fmus.fmu import FmuComponent
from fmus.units import parse_unit
from harness.reversal import WayBack, reversal_of

ROLES = ("plant", "observer", "controller", "source", "sensor")
KINDS = ("real", "integer", "boolean")
# Of an output's change over a whole step, what may be left over a step this much shorter; a change that comes by
# integration shrinks at least in proportion, and one at once not at all.
SHORTER, LEFT = 64.0, 0.25
ROUNDING = 1e-14  # of an output's value

Step = ctypes.CFUNCTYPE(
    ctypes.c_int, ctypes.c_void_p, ctypes.c_double, ctypes.c_double, ctypes.c_void_p, ctypes.c_void_p
)
Move = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p)


@dataclass(frozen=True)
class Course:
    """How a component is stepped: from t0 [s], `steps` steps of h [s], inputs swinging by a share of their size."""

    h: float = 1e-3
    steps: int = 40
    t0: float = 0.0
    swing: float = 0.05


def check_component(make: Callable[[], Component], course: Course = Course()) -> None:
    """Hold a component against every law; `make` gives another one alike at each call. Raises AssertionError."""
    component, other = make(), make()
    try:
        _declares(component)
        state = random.getstate(), np.random.get_state()[1].tobytes()
        first = _values(component, course)
        _starts_anew(component, course, first)
        _stand_apart(component, other, course, first)
        _is_native(component, course, first)
        _goes_back(component, course, first)
        _is_honest(component, course)
        assert state == (random.getstate(), np.random.get_state()[1].tobytes()), "it moves the global random state"
    finally:
        other.close()
        _closes(component, course)


def inputs_at(component: Component, course: Course, k: int) -> Vector:
    """Inputs of step k in SI: starts, with a swing inside their range; switches and bounded counters jump."""
    return np.array([_input(signal, k, i, course) for i, signal in enumerate(component.inputs)], dtype=float)


def _input(signal: Signal, k: int, i: int, course: Course) -> float:
    start = float(np.asarray(signal.start))
    if signal.kind == "real":
        value = start + course.swing * max(abs(start), abs(signal.nominal)) * np.sin(0.7 * k + i + 0.3)
        value = min(max(value, signal.minimum), signal.maximum)
    elif signal.kind == "boolean":
        value = float((k // 5 + i) % 2)
    elif signal.maximum - signal.minimum < np.inf:
        value = min(max(start + k // 7 % 2, signal.minimum), signal.maximum)
    else:  # it may be an enumeration, whose values nobody told
        value = start
    return parse_unit(signal.unit).to_si(float(value))


def _declares(component: Component) -> None:
    assert isinstance(component, Component)
    assert component.role in ROLES
    for signals in (component.inputs, component.outputs):
        names = [signal.name for signal in signals]
        assert all(names) and len(set(names)) == len(names), f"names that are not different: {names}"
        for signal in signals:
            assert signal.shape == (), f"{signal.name} is no scalar"
            assert signal.kind in KINDS
            parse_unit(signal.unit)
            start = float(np.asarray(signal.start))
            assert np.isfinite(start), f"{signal.name} starts at {start}"
    for signal in component.inputs:
        assert signal.minimum <= float(np.asarray(signal.start)) <= signal.maximum, f"{signal.name} starts out of range"
    known = {(y.name, u.name) for y in component.outputs for u in component.inputs}
    assert component.feedthrough <= known, f"feedthrough of nothing: {component.feedthrough - known}"


def _values(component: Component, course: Course) -> Vector:
    """The run, each value seen to be the caller's own."""
    rows: list[Vector] = []
    kept: list[bytes] = []
    for k in range(course.steps + 1):
        u = inputs_at(component, course, max(k - 1, 0))
        before = u.tobytes()
        t = course.t0 + max(k - 1, 0) * course.h
        y = component.start(t, u) if k == 0 else component.step(t, course.h, u)
        assert u.tobytes() == before, "it changes its inputs"
        assert isinstance(y, np.ndarray) and y.dtype == np.float64
        assert y.shape == (len(component.outputs),)
        assert np.isfinite(y).all(), f"not finite at step {k}: {y}"
        rows.append(y)
        kept.append(y.tobytes())
    assert [row.tobytes() for row in rows] == kept, "a step changes what an earlier one returned"
    return np.array(rows)


def _run(component: Component, course: Course) -> Vector:
    rows = [component.start(course.t0, inputs_at(component, course, 0))]
    for k in range(course.steps):
        rows.append(component.step(course.t0 + k * course.h, course.h, inputs_at(component, course, k)))
    return np.array(rows)


def _starts_anew(component: Component, course: Course, first: Vector) -> None:
    _run(component, Course(course.h, max(course.steps // 2, 1), course.t0, 3.0 * course.swing))
    again = _run(component, course)
    assert first.tobytes() == again.tobytes(), _difference(
        component, first, again, "a start does not rebuild all state"
    )


def _stand_apart(one: Component, other: Component, course: Course, first: Vector) -> None:
    another = Course(course.h, course.steps, course.t0, -course.swing)
    rows = [one.start(course.t0, inputs_at(one, course, 0))]
    other.start(course.t0, inputs_at(other, another, 0))
    for k in range(course.steps):
        t = course.t0 + k * course.h
        rows.append(one.step(t, course.h, inputs_at(one, course, k)))
        other.step(t, course.h, inputs_at(other, another, k))
    beside = np.array(rows)
    assert first.tobytes() == beside.tobytes(), _difference(one, first, beside, "another component disturbs it")


def _is_native(component: Component, course: Course, first: Vector) -> None:
    rows = [component.start(course.t0, inputs_at(component, course, 0))]
    native = component.native()
    if native is None:
        return
    step, y = Step(native.step), rows[0].copy()
    for k in range(course.steps):
        u = inputs_at(component, course, k)
        status = step(native.self, course.t0 + k * course.h, course.h, u.ctypes.data, y.ctypes.data)
        assert status == OK, f"the native step ends in {status}"
        rows.append(y.copy())
    called = np.array(rows)
    assert first.tobytes() == called.tobytes(), _difference(component, first, called, "the native step is another")


def _goes_back(component: Component, course: Course, first: Vector) -> None:
    component.start(course.t0, inputs_at(component, course, 0))
    way = reversal_of(component)
    if way.reversal is None:
        assert way.reason
        return
    assert way.reason == ""
    middle = course.steps // 2
    another = Course(course.h, course.steps, course.t0, -course.swing)
    before = _onward(component, course, 0, middle)
    move(way, "keep")
    went = _onward(component, course, middle, course.steps)
    for steps in (1, course.steps - middle):
        move(way, "restore")
        _onward(component, another, middle, middle + steps)
    move(way, "restore")
    again = _onward(component, course, middle, course.steps)
    assert went.tobytes() == again.tobytes(), _difference(component, went, again, "taken back it goes another way")
    if not (isinstance(component, FmuComponent) and component.slave.exchange):
        kept = np.vstack([before, went])
        assert first[1:].tobytes() == kept.tobytes(), _difference(component, first[1:], kept, "keeping changes it")


def move(way: WayBack, name: str) -> None:
    """Call `keep` or `restore` by its address."""
    assert way.reversal is not None
    status = Move(getattr(way.reversal, name))(way.reversal.self)
    assert status == OK, f"{name} ends in {status}"


def _onward(component: Component, course: Course, begin: int, end: int) -> Vector:
    """Outputs of the steps from instant `begin` to `end`, made as the loop makes them."""
    native, y, rows = component.native(), np.zeros(len(component.outputs)), []
    for k in range(begin, end):
        u, t = inputs_at(component, course, k), course.t0 + k * course.h
        if native is None:
            y = component.step(t, course.h, u)
        else:
            assert Step(native.step)(native.self, t, course.h, u.ctypes.data, y.ctypes.data) == OK
        rows.append(y.copy())
    return np.array(rows)


def _is_honest(component: Component, course: Course) -> None:
    for i, source in enumerate(component.inputs):
        undeclared = [j for j, y in enumerate(component.outputs) if (y.name, source.name) not in component.feedthrough]
        if undeclared:
            whole = _change(component, course, i, course.h)[undeclared]
            short = _change(component, course, i, course.h / SHORTER)[undeclared]
            names = [component.outputs[j].name for j in undeclared]
            acts = [name for name, s, w in zip(names, short, whole, strict=True) if s > LEFT * w]
            assert not acts, f"{source.name} acts at once on {acts}, which do not declare it"


def _change(component: Component, course: Course, i: int, h: float) -> Vector:
    """What a change of input i over a last step of h [s] does to the outputs, shape (outputs,)."""
    ends = []
    for moved in (False, True):
        component.start(course.t0, inputs_at(component, course, 0))
        for k in range(course.steps):
            component.step(course.t0 + k * course.h, course.h, inputs_at(component, course, k))
        u = inputs_at(component, course, course.steps)
        if moved:
            u[i] = _other_value(component.inputs[i], u[i], course)
        ends.append(component.step(course.t0 + course.steps * course.h, h, u))
    change: Vector = np.abs(ends[1] - ends[0])
    # What differs by rounding alone is not changed.
    return np.where(change > ROUNDING * np.abs(ends).max(axis=0), change, 0.0)


def _other_value(signal: Signal, value: float, course: Course) -> float:
    unit = parse_unit(signal.unit)
    if signal.kind == "boolean":
        return 1.0 - value
    size = course.swing * max(abs(float(np.asarray(signal.start))), abs(signal.nominal))
    moved = unit.from_si(value) + (1.0 if signal.kind == "integer" else size)
    return unit.to_si(moved if moved <= signal.maximum else moved - 2.0 * (moved - unit.from_si(value)))


def _closes(component: Component, course: Course) -> None:
    component.start(course.t0, inputs_at(component, course, 0))
    component.close()
    component.close()
    with pytest.raises(StepError):
        component.step(course.t0, course.h, inputs_at(component, course, 0))


def _difference(component: Component, first: Vector, second: Vector, law: str) -> str:
    k, j = np.argwhere(first != second)[0]
    names: Sequence[Signal] = component.outputs
    return f"{law}: {names[j].name} at row {k} is {first[k, j]!r} and {second[k, j]!r}"
