"""The state of an FMU's instance: kept, taken back to, written to bytes and read from them."""

from __future__ import annotations

import ctypes
from ctypes import byref, c_double, c_int, c_size_t, c_void_p

import numpy as np

from fmus.component import OK, StepError, Vector
from fmus.fmu import FmuComponent


class Bookmark:
    """One kept state of a started component, and the steps that may be taken back.

    Every method raises StepError where the FMU refuses; `forget` frees the kept state and may be called again.
    """

    def __init__(self, component: FmuComponent) -> None:
        self.component = component
        self._slave = component.slave
        self._version = int(component.fmi_version[0])
        self._state = c_void_p()
        self._word = "State" if self._version == 3 else "state"
        self._byte = ctypes.c_uint8 if self._version == 3 else ctypes.c_char
        self._u, self._y = np.zeros(len(component.inputs)), np.zeros(len(component.outputs))
        self._time = 0.0

    def step(self, t: float, h: float, u: Vector) -> Vector:
        """As the component's step, except that the FMU is told that it may be taken back.

        A Model Exchange instance makes a step of the explicit Euler method, its events not looked after: enough to see
        whether it goes the same way twice. Its inputs stay as they were at the start, since discrete ones may be set
        in events only; its states follow the outputs.
        """
        self._u[:], self._time = u, t
        if self.component.description.kind == "me":
            return self._integrate(t, h)
        adapter = self._slave.adapter
        self._checked(adapter.write(adapter.self, self._u.ctypes.data))
        if self._version == 3:
            event, terminate, early = ctypes.c_bool(), ctypes.c_bool(), ctypes.c_bool()
            reached = c_double()
            told = (ctypes.c_bool(False), byref(event), byref(terminate), byref(early), byref(reached))
            self._slave.call(t, "DoStep", c_double(t), c_double(h), *told)
        else:
            self._slave.call(t, "DoStep", c_double(t), c_double(h), c_int(0))
        self._checked(adapter.read(adapter.self, self._y.ctypes.data))
        return self._y.copy()

    def _integrate(self, t: float, h: float) -> Vector:
        count = self.component.description.states
        states, slopes = np.zeros(count), np.zeros(count)
        size = c_size_t(count)
        derivatives = "GetContinuousStateDerivatives" if self._version == 3 else "GetDerivatives"
        if count:
            self._call("GetContinuousStates", c_void_p(states.ctypes.data), size)
            self._call(derivatives, c_void_p(slopes.ctypes.data), size)
        states += h * slopes
        self._call("SetTime", c_double(t + h))
        if count:
            self._call("SetContinuousStates", c_void_p(states.ctypes.data), size)
        no = ctypes.c_bool(False) if self._version == 3 else c_int(0)
        event, terminate = type(no)(), type(no)()
        self._call("CompletedIntegratorStep", no, byref(event), byref(terminate))
        adapter = self._slave.adapter
        self._checked(adapter.read(adapter.self, self._y.ctypes.data))
        return np.concatenate([self._y, states])

    def keep(self) -> None:
        """Keep the state of this instant, in place of the one kept before."""
        self._call(f"GetFMU{self._word}", byref(self._state))

    def restore(self) -> None:
        """Take the instance back to the kept state."""
        self._call(f"SetFMU{self._word}", self._state)

    def forget(self) -> None:
        """Free the kept state."""
        if self._state:
            self._call(f"FreeFMU{self._word}", byref(self._state))
            self._state = c_void_p()

    def serialised(self) -> bytes:
        """The kept state as bytes."""
        size = c_size_t()
        self._call(f"SerializedFMU{self._word}Size", self._state, byref(size))
        buffer = (self._byte * size.value)()
        self._call(f"SerializeFMU{self._word}", self._state, buffer, size)
        return bytes(buffer)

    def read(self, written: bytes) -> None:
        """Keep the state that these bytes hold; the instance stays where it is until `restore`."""
        buffer = (self._byte * len(written)).from_buffer_copy(written)
        name = "DeserializeFMUState" if self._version == 3 else "DeSerializeFMUstate"
        self._call(name, buffer, c_size_t(len(written)), byref(self._state))

    def _call(self, function: str, *arguments: object) -> None:
        self._slave.call(self._time, function, *arguments)

    def _checked(self, status: int) -> None:
        if status > OK + 1:
            raise StepError(f"passing values ended in the status {status}", part=self.component.name, time=self._time)
