"""The calls of FMI 3.0, in the order the standard allows."""

from __future__ import annotations

from collections.abc import Iterator
from ctypes import byref, c_bool, c_char_p, c_double, c_size_t, c_uint32, c_void_p
from typing import Any

from fmus.adapter import callback
from fmus.component import OK, WARNING
from fmus.description import FmuDescription
from fmus.fmi2 import STATUS_CATEGORIES
from fmus.library import Library

Call = tuple[str, tuple[Any, ...]]

_YES, _NO = c_bool(True), c_bool(False)


class Fmi3:
    """How an instance of FMI 3.0 is made, initialised and ended; each call by its name without the prefix."""

    free, terminate, reset = "FreeInstance", "Terminate", "Reset"

    def __init__(self, description: FmuDescription, library: Library, table: int) -> None:
        self._description, self._library, self._table = description, library, table

    def instantiate(self, name: str) -> int | None:
        """A new instance's address; None where the FMU refuses."""
        d = self._description
        resources = d.folder / "resources"
        path = str(resources) + ("\\" if resources.drive else "/")
        arguments: tuple[Any, ...] = (c_char_p(name.encode()), c_char_p(d.token.encode()), c_char_p(path.encode()))
        arguments += (_NO, _NO)  # not visible, no messages yet
        if d.kind == "cs":
            function = self._library.function("InstantiateCoSimulation")
            arguments += (c_bool(d.event_mode), c_bool(d.event_mode), (c_uint32 * 0)(), c_size_t(0))
        else:
            function = self._library.function("InstantiateModelExchange")
        function.restype = c_void_p
        callbacks = (c_void_p(self._table), c_void_p(callback("fmi3_log")))
        made: int | None = function(*arguments, *callbacks, *((c_void_p(None),) if d.kind == "cs" else ()))
        return made

    def dismiss(self) -> None:
        """Nothing: messages say whom they are for."""

    def messages_on(self) -> Call | None:
        """The call that switches on messages about statuses; None where the FMU declares none."""
        wanted = [name.encode() for name in STATUS_CATEGORIES if name in self._description.log_categories]
        if not wanted:
            return None
        return "SetDebugLogging", (_YES, c_size_t(len(wanted)), (c_char_p * len(wanted))(*wanted))

    def before_starts(self, t0: float, tolerance: float | None) -> Iterator[Call]:
        """The calls on a new instance before its start values are set: none."""
        return iter(())

    def before_inputs(self, t0: float, tolerance: float | None) -> Iterator[Call]:
        """The calls between start values and inputs; a tolerance of None is left to the FMU."""
        controlled = c_bool(tolerance is not None), c_double(tolerance or 0.0)
        yield "EnterInitializationMode", (*controlled, c_double(t0), _NO, c_double(0.0))

    def after_inputs(self, t0: float) -> Iterator[Call]:
        """The calls that end the initialisation."""
        yield "ExitInitializationMode", ()

    def sizes(self, instance: int) -> tuple[int, int]:
        """The numbers of continuous states and event indicators, which structural parameters may have changed."""
        states, indicators = c_size_t(self._description.states), c_size_t(self._description.indicators)
        for name, size in (("GetNumberOfContinuousStates", states), ("GetNumberOfEventIndicators", indicators)):
            before = size.value
            if not OK <= self._library.function(name)(c_void_p(instance), byref(size)) <= WARNING:
                size.value = before
        return states.value, indicators.value
