"""The calls of FMI 1.0, in the order the standard allows."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from ctypes import c_char_p, c_double, c_void_p
from typing import Any

from fmus.adapter import callback, stepping_library
from fmus.description import FmuDescription
from fmus.library import Library

Call = tuple[str, tuple[Any, ...]]

_MIME = b"application/x-fmu-sharedlibrary"
_YES, _NO = ctypes.c_char(b"\1"), ctypes.c_char(b"\0")


class _Callbacks(ctypes.Structure):
    _fields_ = tuple((name, c_void_p) for name in ("logger", "allocate", "free", "step_finished"))


class Fmi1:
    """How an instance of FMI 1.0 is made, initialised and ended; each call by its name without the prefix."""

    def __init__(self, description: FmuDescription, library: Library, table: int) -> None:
        self._description, self._library, self._table = description, library, table
        self._cosimulation = description.kind == "cs"
        self._callbacks = _Callbacks(callback("fmi1_log"), callback("fmi2_allocate"), callback("fmi2_free"), None)
        self.free = "FreeSlaveInstance" if self._cosimulation else "FreeModelInstance"
        self.terminate = "TerminateSlave" if self._cosimulation else "Terminate"
        self.reset = "ResetSlave" if self._cosimulation else ""

    def instantiate(self, name: str) -> int | None:
        """A new instance's address; None where the FMU refuses. All its messages are on until it is initialised."""
        listen = stepping_library().fmi1_listen
        listen.argtypes = (c_void_p,)
        if not listen(self._table):
            return None
        called, token = c_char_p(name.encode()), c_char_p(self._description.token.encode())
        if self._cosimulation:
            function = self._library.function("InstantiateSlave")
            function.argtypes = None
            place = c_char_p(self._description.folder.as_uri().encode())
            arguments: tuple[Any, ...] = (place, c_char_p(_MIME), c_double(0.0), _NO, _NO, self._callbacks, _YES)
        else:
            function = self._library.function("InstantiateModel")
            arguments = (self._callbacks, _YES)
        function.restype = c_void_p
        made: int | None = function(called, token, *arguments)
        return made

    def dismiss(self) -> None:
        """Hear no more messages."""
        dismiss = stepping_library().fmi1_dismiss
        dismiss.argtypes, dismiss.restype = (c_void_p,), None
        dismiss(self._table)

    def messages_on(self) -> Call | None:
        """The call that switches on the messages wanted; they are on from the beginning."""
        return None

    def before_starts(self, t0: float, tolerance: float | None) -> Iterator[Call]:
        """The calls on a new instance before its start values are set."""
        if not self._cosimulation:
            yield "SetTime", (c_double(t0),)

    def before_inputs(self, t0: float, tolerance: float | None) -> Iterator[Call]:
        """The calls between start values and inputs: none, both are set before the initialisation."""
        return iter(())

    def after_inputs(self, t0: float) -> Iterator[Call]:
        """The calls that end the initialisation; a model is initialised where it is stepped, with its first event."""
        if self._cosimulation:
            yield "InitializeSlave", (c_double(t0), _NO, c_double(0.0))
            yield "SetDebugLogging", (_NO,)

    def sizes(self, instance: int) -> tuple[int, int]:
        """The numbers of continuous states and event indicators."""
        return self._description.states, self._description.indicators
