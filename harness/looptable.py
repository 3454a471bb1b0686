"""What the step loop in C works on: the structures of parts.c and clock.c, and a Python part as one of its steps."""

from __future__ import annotations

import ctypes

from fmus.component import OK, Component, Native, Vector
from harness.native import native_step

_Call = ctypes.CFUNCTYPE(None, ctypes.c_double, ctypes.c_double)


class CPythonPart(ctypes.Structure):
    """A part written in Python, as parts.c has it."""

    _fields_ = [("call", _Call), ("status", ctypes.c_int64)]


class CPart(ctypes.Structure):
    """One part, as parts.c has it."""

    _fields_ = [
        *((name, ctypes.c_void_p) for name in ("step", "self", "u", "gathered", "inputs")),
        ("gathers", ctypes.c_int64),
        ("y", ctypes.c_void_p),
        *((name, ctypes.c_int64) for name in ("outputs", "always")),
        ("group", ctypes.c_void_p),
        ("period", ctypes.c_int64),
        ("due", ctypes.c_char_p),
        ("stepped", ctypes.c_int64),
        ("reached", ctypes.c_double),
        *((name, ctypes.c_int64) for name in ("warnings", "timed")),
        ("took", ctypes.c_void_p),
    ]


class CClock(ctypes.Structure):
    """The clock, as clock.c has it."""

    _fields_ = [
        *((name, ctypes.c_double) for name in ("t0", "h")),
        *((name, ctypes.c_void_p) for name in ("speed", "angle")),
        *((name, ctypes.c_double) for name in ("numerator", "denominator", "origin", "slowest", "stop")),
        ("cycle", ctypes.c_int64),
        *((name, ctypes.c_double) for name in ("t", "next", "anchored")),
        ("anchor", ctypes.c_int64),
    ]


class CFixedGrid(ctypes.Structure):
    """A part on a grid of its own, as parts.c has it."""

    _fields_ = [
        *((name, ctypes.c_void_p) for name in ("step", "self")),
        *((name, ctypes.c_double) for name in ("t0", "h")),
        ("count", ctypes.c_int64),
    ]


class CLoop(ctypes.Structure):
    """The whole, as parts.c has it."""

    _fields_ = [
        ("clock", ctypes.POINTER(CClock)),
        ("parts", ctypes.POINTER(CPart)),
        ("count", ctypes.c_int64),
        ("bus", ctypes.c_void_p),
        ("size", ctypes.c_int64),
        ("recorded", ctypes.c_void_p),
        ("columns", ctypes.c_int64),
        ("every", ctypes.c_int64),
        *((name, ctypes.c_void_p) for name in ("here", "steering")),
    ]


class CStop(ctypes.Structure):
    """What stopped the loop, and where, as parts.c has it."""

    _fields_ = [(name, ctypes.c_int64) for name in ("part", "output", "k")]


class Callback:
    """A part written in Python as a step that C calls; what it raises is kept, since C cannot pass it on."""

    def __init__(self, component: Component, u: Vector, y: Vector) -> None:
        self.component, self.u, self.y = component, u, y
        self.raised: BaseException | None = None
        self.state = CPythonPart(_Call(self._step), OK)

    def native(self) -> Native:
        """The step for C."""
        return native_step("crankbench_python_step", self.state)

    def _step(self, t: float, h: float) -> None:
        try:
            outputs = self.component.step(t, h, self.u.copy())
            if len(outputs) != len(self.y):
                raise ValueError(f"step wants to return {len(self.y)} outputs, got {len(outputs)}")
            self.y[:] = outputs
            self.state.status = OK
        except BaseException as error:
            self.raised = error
