"""One FMI 2.0 or 3.0 Co-Simulation instance: its calls in the order the standard allows."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Iterable
from ctypes import c_uint32
from typing import Any

from fmus.adapter import PASSAGES, Adapter, address, callback
from fmus.component import DISCARD, ERROR, FATAL, OK, WARNING, ConfigurationError, StepError, Vector
from fmus.description import FmuDescription
from fmus.variable import Variable
from fmus.whereabouts import doing

Start = tuple[Variable, tuple[float | str, ...]]

_STAGES = ("setting the inputs", "doing the step", "getting the outputs")
# The categories that the standards name for messages about a status; others an FMU may declare stay off.
_STATUS_CATEGORIES = ("logStatusWarning", "logStatusDiscard", "logStatusError", "logStatusFatal", "logStatusPending")
# Libraries in which an instance reported fatal: the standards forbid any further call on any instance of them.
_CORRUPT: set[str] = set()


class Slave:
    """The library of an FMU and at most one instance made by it; `start` makes a fresh one.

    Raises ConfigurationError: the library cannot be loaded or lacks a function of the standard.
    """

    def __init__(self, description: FmuDescription, name: str) -> None:
        self.name = name
        self._description = description
        self._version = int(description.fmi_version[0])
        with doing("load", name):
            self._fmu = self._load()
        self.adapter = Adapter(self._version, self._function)
        self._callbacks = self._make_callbacks()
        self._running = False

    def start(self, t0: float, starts: Iterable[Start], u: Vector, y: Vector) -> None:
        """A fresh instance with these start values, initialised at t0 [s] with inputs u; its outputs are put into y.

        `starts` are in the variables' own units; u and y are in SI units, in the order the adapter was given.

        Raises StepError: a call ended in a status above warning.
        """
        self.begin(t0, starts, u)
        self.exit_initialisation(t0, y)

    def begin(self, t0: float, starts: Iterable[Start], u: Vector) -> None:
        """A fresh instance in initialisation, with its start values and inputs set. Raises StepError."""
        self.free()
        adapter = self.adapter
        adapter.renew(t0)
        if self._fmu is None:
            raise self._error("is closed", t0, ERROR)
        if self._library in _CORRUPT:
            raise self._error("an instance of this FMU reported fatal: nothing of it may be called again", t0, FATAL)
        with doing("instantiate", self.name):
            self._instantiate(t0)
        adapter.table.failed = OK
        with doing("initialise", self.name):
            self._switch_messages_on(t0)
            self._enter_initialisation(t0, starts, u)

    def restart(self, t0: float, starts: Iterable[Start], u: Vector, y: Vector) -> None:
        """As `start`, but of the instance there is, by its reset. Raises StepError."""
        self.call(t0, "Reset")
        self._running = False
        self._enter_initialisation(t0, starts, u)
        self.exit_initialisation(t0, y)

    def _enter_initialisation(self, t0: float, starts: Iterable[Start], u: Vector) -> None:
        adapter = self.adapter
        if self._version == 2:
            self._call(t0, "SetupExperiment", 0, 0.0, t0, 0, 0.0)
            self._set(t0, starts)
            self._call(t0, "EnterInitializationMode")
        else:
            self._set(t0, starts)
            self._call(t0, "EnterInitializationMode", False, 0.0, t0, False, 0.0)
        self._check(t0, _STAGES[0], adapter.write(adapter.self, u.ctypes.data))

    def exit_initialisation(self, t0: float, y: Vector) -> None:
        """End the initialisation; the initial outputs are put into y."""
        adapter = self.adapter
        with doing("initialise", self.name):
            self._call(t0, "ExitInitializationMode")
            self._running = True
            self._check(t0, _STAGES[2], adapter.read(adapter.self, y.ctypes.data))

    def call(self, time: float, function: str, *arguments: Any) -> None:
        """Call a function of the standard on the instance, by its name without the prefix, like `Reset`.

        Raises StepError: it ended in a status above warning.
        """
        self._call(time, function, *arguments)

    def failure(self, status: int, time: float) -> StepError:
        """The error for a step from `time` [s] that ended in `status`, with the FMU's last message on it."""
        table = self.adapter.table
        if not table.instance:
            return self._error("there is no instance to step: it wants a start first", time, status)
        what = _STAGES[table.stage]
        if table.terminated:
            what += f", the FMU asked to end at t = {table.last_successful_time:.9g} s"
        elif status == DISCARD and not math.isnan(table.last_successful_time):
            what += f", done up to t = {table.last_successful_time:.9g} s"
        return self._error(f"{what}: {self._last_words()}", time, status)

    def free(self) -> None:
        """End the instance as far as its status allows: after an error only free it, after a fatal not even that."""
        table = self.adapter.table
        instance, table.instance = table.instance, None
        if not instance:
            return
        if table.failed == OK and self._running:
            with doing("terminate", self.name):
                table.failed = self._status("Terminate", instance)
        if table.failed == FATAL:
            _CORRUPT.add(self._library)
        else:
            with doing("free", self.name):
                self._status("FreeInstance", instance)
        table.failed = ERROR
        self._running = False

    def unload(self) -> None:
        """Free the instance and let go of the library; a corrupt one stays loaded, since letting go runs its code."""
        self.free()
        if self._fmu is not None and self._library not in _CORRUPT:
            with doing("unload", self.name):
                self._fmu.freeLibrary()
        self._fmu = None

    @property
    def _library(self) -> str:
        return str(self._description.library)

    def _load(self) -> Any:
        from fmpy.fmi2 import FMU2Slave
        from fmpy.fmi3 import FMU3Slave

        d = self._description
        arguments = {"guid": d.token, "modelIdentifier": d.model_identifier, "unzipDirectory": str(d.folder)}
        try:
            if self._version == 2:
                return FMU2Slave(instanceName=self.name, libraryPath=self._library, **arguments)
            return FMU3Slave(instanceName=self.name, **arguments)
        except AttributeError as error:
            raise ConfigurationError(f"{self.name}: its library lacks a function of the standard: {error}") from error
        except Exception as error:  # FMPy raises a plain Exception where the system cannot load the library
            raise ConfigurationError(f"{self.name}: {error}") from error

    def _make_callbacks(self) -> Any:
        if self._version == 3:
            from fmpy.fmi3 import fmi3IntermediateUpdateCallback, fmi3LogMessageCallback

            return fmi3LogMessageCallback(callback("fmi3_log")), fmi3IntermediateUpdateCallback()
        from fmpy import fmi2

        return fmi2.fmi2CallbackFunctions(
            logger=fmi2.fmi2CallbackLoggerTYPE(callback("fmi2_log")),
            allocateMemory=fmi2.fmi2CallbackAllocateMemoryTYPE(callback("fmi2_allocate")),
            freeMemory=fmi2.fmi2CallbackFreeMemoryTYPE(callback("fmi2_free")),
            componentEnvironment=self.adapter.self,
        )

    def _instantiate(self, t0: float) -> None:
        name, token = self.name.encode(), self._description.token.encode()
        resources = self._description.folder / "resources"
        if self._version == 2:
            uri = resources.as_uri().encode()
            instance = self._fmu.fmi2Instantiate(name, 1, token, uri, ctypes.byref(self._callbacks), 0, 0)
        else:
            folder = (str(resources) + ("\\" if resources.drive else "/")).encode()
            log, intermediate_update = self._callbacks
            instance = self._fmu.fmi3InstantiateCoSimulation(
                *(name, token, folder, False, False, False, False, (c_uint32 * 0)(), 0),
                *(self.adapter.self, log, intermediate_update),
            )
        if not instance:
            raise self._error(f"fmi{self._version}Instantiate gave nothing: {self._last_words()}", t0, ERROR)
        self.adapter.table.instance = instance

    def _switch_messages_on(self, t0: float) -> None:
        """Switch on messages about statuses where the FMU declares such; a refusal short of an error is no matter."""
        wanted = [name.encode() for name in _STATUS_CATEGORIES if name in self._description.log_categories]
        if wanted:
            categories = (ctypes.c_char_p * len(wanted))(*wanted)
            status = self._status("SetDebugLogging", self.adapter.table.instance, 1, len(wanted), categories)
            self._check(t0, "switching its messages on", status if status >= ERROR else OK)

    def _set(self, t0: float, starts: Iterable[Start]) -> None:
        groups: dict[Any, list[Start]] = {}
        for start in starts:
            groups.setdefault(PASSAGES[self._version][start[0].type], []).append(start)
        for passage, group in groups.items():
            values = [_c_value(value, passage.c_type) for _, several in group for value in several]
            references = (c_uint32 * len(group))(*(variable.reference for variable, _ in group))
            counts = (len(values),) if self._version == 3 else ()
            array = (passage.c_type * len(values))(*values)
            self._call(t0, f"Set{passage.function}", references, len(group), array, *counts)

    def _call(self, time: float, function: str, *arguments: Any) -> None:
        status = self._status(function, self.adapter.table.instance, *arguments)
        self._check(time, f"fmi{self._version}{function}", status)

    def _status(self, function: str, *arguments: Any) -> int:
        """The status a call ended in; what the standard does not know, and pending, count as errors."""
        from fmpy.fmi1 import FMICallException

        try:
            status = int(getattr(self._fmu, f"fmi{self._version}{function}")(*arguments) or OK)
        except FMICallException as error:
            status = int(error.status)
        return status if OK <= status <= FATAL else ERROR

    def _check(self, time: float, what: str, status: int) -> None:
        if status >= ERROR:
            self.adapter.table.failed = status
        if status > WARNING:
            raise self._error(f"{what}: {self._last_words()}", time, status)

    def _error(self, message: str, time: float, status: int) -> StepError:
        return StepError(message, part=self.name, time=time, status=status)

    def _last_words(self) -> str:
        messages = self.adapter.log()
        told = [message for message in messages if message.status > OK] or messages
        return told[-1].text if told else "the FMU gave no message"

    def _function(self, name: str) -> int:
        return address(getattr(self._fmu.dll, f"fmi{self._version}{name}"))


def _c_value(value: float | str, c_type: Any) -> Any:
    if isinstance(value, str):
        return value.encode()
    if c_type in (ctypes.c_double, ctypes.c_float):
        return value
    return bool(value) if c_type is ctypes.c_bool else round(value)
