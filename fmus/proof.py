"""Whether an FMU can be taken back, and whether its derivatives serve: shown by trying, once a process for each FMU."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Hashable
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from fmus.component import WARNING, ConfigurationError, Reversal, StepError, Vector
from fmus.derivatives import TOLERANCE, Compared, Questioned, compare, pairs
from fmus.description import FmuDescription
from fmus.interview import inputs_at, same, usual_steps
from fmus.whereabouts import doing

if TYPE_CHECKING:
    from fmus.fmu import FmuComponent

# Steps up to the state that is kept, and from there on.
BEFORE, AFTER = 10, 10

_Move = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p)
_Derive = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p)


class Proof(NamedTuple):
    """Whether an FMU can be taken back, with the evidence, and which of its derivatives serve, with theirs.

    `started` is false where the other component did not even start. `knowns` and `unknowns` are names of inputs and
    outputs; they are empty where there is no derivative that serves.
    """

    holds: bool
    evidence: str
    knowns: frozenset[str] = frozenset()
    unknowns: frozenset[str] = frozenset()
    derivatives: str = ""
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
    found = same(component, went, again, f"{AFTER} steps and the same after going back")
    return Proof(bool(found.passed), found.evidence, *_derivatives(component, found.passed is True, t0))


def move(component: FmuComponent, function: int, way: Reversal, time: float) -> None:
    """Call `keep` or `restore`. Raises StepError: a status above warning."""
    status = _Move(function)(way.self)
    if status > WARNING:
        raise component.failure(status, time)


def _derivatives(component: FmuComponent, wanted: bool, t0: float) -> tuple[frozenset[str], frozenset[str], str]:
    """Inputs and outputs whose derivatives serve, and the evidence."""
    nothing = frozenset[str](), frozenset[str]()
    if not wanted:
        return *nothing, ""
    if not component.description.capabilities.get("providesDirectionalDerivative"):
        return *nothing, "it does not declare directional derivatives"
    chosen = pairs(component.description)
    knowns = frozenset(v.name for v in chosen.knowns if v.causality == "input")
    unknowns = frozenset(v.name for v in chosen.unknowns if v.causality == "output")
    if not knowns or not unknowns:
        return *nothing, "it has no continuous output with a continuous input to derive it by"
    try:
        compared = compare(Questioned(component, t0, inputs_at(component, 0)), chosen)
    except StepError as error:
        return *nothing, error.message
    worst: Compared = max(compared, key=lambda one: one.off)
    if worst.off > 1.0:
        told = f"d {worst.unknown} / d {worst.known} is {worst.given:.6g}, by differences {worst.difference:.6g}"
        return *nothing, told
    return knowns, unknowns, f"{len(compared)} derivatives agree with differences within {TOLERANCE:g}"
