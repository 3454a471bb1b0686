"""The calls of FMI 2.0, in the order the standard allows."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from ctypes import byref, c_char_p, c_double, c_int, c_size_t, c_void_p
from typing import Any

from fmus.adapter import callback
from fmus.description import FmuDescription
from fmus.library import Library

Call = tuple[str, tuple[Any, ...]]

# The categories that the standards name for messages about a status; others an FMU may declare stay off.
STATUS_CATEGORIES = ("logStatusWarning", "logStatusDiscard", "logStatusError", "logStatusFatal", "logStatusPending")
_MODEL, _SLAVE = 0, 1


class _Callbacks(ctypes.Structure):
    _fields_ = tuple((name, c_void_p) for name in ("logger", "allocate", "free", "step_finished", "environment"))


class Fmi2:
    """How an instance of FMI 2.0 is made, initialised and ended; each call by its name without the prefix."""

    free, terminate, reset = "FreeInstance", "Terminate", "Reset"

    def __init__(self, description: FmuDescription, library: Library, table: int) -> None:
        self._description, self._library = description, library
        self._callbacks = _Callbacks(
            callback("fmi2_log"), callback("fmi2_allocate"), callback("fmi2_free"), None, table
        )

    def instantiate(self, name: str) -> int | None:
        """A new instance's address; None where the FMU refuses."""
        function = self._library.function("Instantiate")
        function.restype = c_void_p
        d = self._description
        made: int | None = function(
            c_char_p(name.encode()),
            c_int(_SLAVE if d.kind == "cs" else _MODEL),
            c_char_p(d.token.encode()),
            c_char_p((d.folder / "resources").as_uri().encode()),
            byref(self._callbacks),
            c_int(0),
            c_int(0),
        )
        return made

    def dismiss(self) -> None:
        """Nothing: messages say whom they are for."""

    def messages_on(self) -> Call | None:
        """The call that switches on messages about statuses; None where the FMU declares none."""
        wanted = [name.encode() for name in STATUS_CATEGORIES if name in self._description.log_categories]
        if not wanted:
            return None
        return "SetDebugLogging", (c_int(1), c_size_t(len(wanted)), (c_char_p * len(wanted))(*wanted))

    def before_starts(self, t0: float, tolerance: float | None) -> Iterator[Call]:
        """The calls on a new instance before its start values are set; a tolerance of None is left to the FMU."""
        controlled = c_int(tolerance is not None), c_double(tolerance or 0.0)
        yield "SetupExperiment", (*controlled, c_double(t0), c_int(0), c_double(0.0))

    def before_inputs(self, t0: float, tolerance: float | None) -> Iterator[Call]:
        """The calls between start values and inputs."""
        yield "EnterInitializationMode", ()

    def after_inputs(self, t0: float) -> Iterator[Call]:
        """The calls that end the initialisation."""
        yield "ExitInitializationMode", ()

    def sizes(self, instance: int) -> tuple[int, int]:
        """The numbers of continuous states and event indicators."""
        return self._description.states, self._description.indicators
