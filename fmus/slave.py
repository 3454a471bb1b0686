"""One instance of an FMU, by Co-Simulation or Model Exchange: its calls in the order the standard allows."""

from __future__ import annotations

import ctypes
import math
import os
from collections.abc import Iterable
from ctypes import c_size_t, c_uint32, c_void_p
from typing import Any

import numpy as np

from fmus.adapter import PASSAGES, Adapter
from fmus.clocks import EventMode
from fmus.component import DISCARD, ERROR, FATAL, OK, WARNING, ConfigurationError, Native, Problem, StepError, Vector
from fmus.description import FmuDescription
from fmus.exchange import Exchange, Stepping
from fmus.fmi1 import Fmi1
from fmus.fmi2 import Fmi2
from fmus.fmi3 import Fmi3
from fmus.library import Library
from fmus.reversal import Past
from fmus.sources import built_library
from fmus.variable import Variable
from fmus.whereabouts import doing

Start = tuple[Variable, tuple[float | str, ...]]

_STAGES = (
    "setting the inputs",
    "doing the step",
    "getting the outputs",
    "keeping its state",
    "going back to the state kept",
    "getting its directional derivatives",
)
_VERSIONS: dict[int, type[Fmi1] | type[Fmi2] | type[Fmi3]] = {1: Fmi1, 2: Fmi2, 3: Fmi3}
# Libraries in which an instance reported fatal: the standards forbid any further call on any instance of them.
_CORRUPT: set[str] = set()


class Slave:
    """The library of an FMU and at most one instance made by it; `start` makes a fresh one.

    An FMU without a library for this platform, but with sources, is built. `stepping` is how Model Exchange is stepped,
    by `exchange`, which is None in Co-Simulation.

    Raises ConfigurationError: the library cannot be built or loaded, or lacks a function of the standard.
    """

    def __init__(self, description: FmuDescription, name: str, stepping: Stepping | None = None) -> None:
        self.name = name
        self._description = description
        self._version = int(description.fmi_version[0])
        self._prefix = f"{description.model_identifier}_fmi" if self._version == 1 else f"fmi{self._version}"
        self._stepping = stepping or Stepping()
        self.exchange: Exchange | None = None
        self._event_mode: EventMode | None = None
        self._past: Past | None = None
        self._threads = _threads()
        try:
            self._path = description.library or built_library(description)
            with doing("load", name):
                self._library: Library | None = Library(self._path, self._prefix, description.folder)
            self.adapter = Adapter(self._version, self._library.address, description.kind)
            if description.kind == "me":
                self.exchange = self._make_exchange(self._library)
            elif description.event_mode:
                self._event_mode = EventMode(self._library.address, self.adapter, description.clocks)
        except ConfigurationError as error:
            raise ConfigurationError([Problem(f"{name}: {problem}") for problem in error.problems]) from error
        self._calls = _VERSIONS[self._version](description, self._library, self.adapter.self)
        self._inputs: Vector = np.empty(0)
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
        if self._library is None:
            raise self._error("is closed", t0, ERROR)
        if str(self._path) in _CORRUPT:
            raise self._error("an instance of this FMU reported fatal: nothing of it may be called again", t0, FATAL)
        if not self._instantiate():
            raise self._error(self._refusal(), t0, ERROR)
        with doing("initialise", self.name):
            self._switch_messages_on(t0)
            self._enter_initialisation(t0, starts, u)

    def prove(self) -> None:
        """Make an instance and free it: what no instance comes of cannot be run, whatever it is given.

        Raises ConfigurationError: the library gave none, as where the description is not its own.
        """
        self.free()
        self.adapter.renew(0.0)
        if not self._instantiate():
            raise ConfigurationError(f"{self.name}: {self._refusal()}")
        self.free()

    def _instantiate(self) -> bool:
        with doing("instantiate", self.name):
            instance = self._calls.instantiate(self.name)
        self.adapter.table.instance = instance or None
        self.adapter.table.failed = OK if instance else ERROR
        return bool(instance)

    def _refusal(self) -> str:
        words = self._last_words()
        token = "instantiationToken" if self._version == 3 else "guid"
        hint = "" if token.lower() in words.lower() else f"; the {token} in its description may be another than its own"
        return f"{self._shown}Instantiate gave nothing: {words}{hint}"

    def restart(self, t0: float, starts: Iterable[Start], u: Vector, y: Vector) -> None:
        """As `start`, but of the instance there is, by its reset. Raises StepError."""
        if not self._calls.reset:
            raise self._error("has no reset in this kind of FMU", t0, ERROR)
        self.call(t0, self._calls.reset)
        self._running = False
        self._enter_initialisation(t0, starts, u)
        self.exit_initialisation(t0, y)

    def exit_initialisation(self, t0: float, y: Vector) -> None:
        """End the initialisation; the initial outputs are put into y."""
        with doing("initialise", self.name):
            self._exit_initialisation(t0, y)

    def _exit_initialisation(self, t0: float, y: Vector) -> None:
        adapter = self.adapter
        for function, arguments in self._calls.after_inputs(t0):
            self.call(t0, function, *arguments)
        self._running = True
        if self.exchange is not None:
            states, indicators = self._calls.sizes(adapter.table.instance)
            status = self.exchange.start(t0, states, indicators, self._inputs, y)
        elif self._event_mode is not None:
            status = self._event_mode.start(t0, self._inputs, y)
        else:
            self._check(t0, _STAGES[2], adapter.read(adapter.self, y.ctypes.data))
            return
        if status > WARNING:
            raise self.failure(status, t0)

    def call(self, time: float, function: str, *arguments: Any) -> None:
        """Call a function of the standard on the instance, by its name without the prefix, like `Reset`.

        Raises StepError: it ended in a status above warning.
        """
        status = self._status(function, self.adapter.table.instance, *arguments)
        self._check(time, f"{self._shown}{function}", status)

    def native(self) -> Native:
        """The step for C; without a running instance it returns the status ERROR."""
        return self._stepped.native()

    def step(self, t: float, h: float, u: int, y: int) -> int:
        """The status of the step that `native` names, with inputs and outputs at these addresses."""
        stepped = self._stepped
        return int(stepped.step(stepped.self, t, h, u, y))

    def past(self) -> Past:
        """What takes the instance back; from now on each instance is told that it may be.

        Raises ConfigurationError: the library lacks a function for it.
        """
        if self._library is None:
            raise ConfigurationError(f"{self.name}: is closed")
        if self._past is None:
            self._past = Past(self._version, self._library.address, self.adapter, self.exchange or self._event_mode)
        return self._past

    @property
    def running(self) -> bool:
        """Whether there is an instance that is past its initialisation and not ended."""
        return self._running

    @property
    def _stepped(self) -> Adapter | Exchange | EventMode:
        return self.exchange or self._event_mode or self.adapter

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
        if self._past is not None:
            self._past.forget()
        if self.exchange is not None:
            self.exchange.release()
        instance, table.instance = table.instance, None
        if not instance:
            return
        if table.failed == OK and self._running:
            with doing("terminate", self.name):
                table.failed = self._status(self._calls.terminate, instance)
        if table.failed == FATAL:
            _CORRUPT.add(str(self._path))
        else:
            with doing("free", self.name):
                self._free_instance(instance)
        table.failed = ERROR
        self._running = False
        self._calls.dismiss()

    def unload(self) -> None:
        """Free the instance and let go of the library.

        A corrupt one stays loaded, since letting go runs its code; so does one whose threads may still run in it.
        """
        self.free()
        if self._library is not None and str(self._path) not in _CORRUPT and _threads() <= self._threads:
            with doing("unload", self.name):
                self._library.release()
        self._library = None

    def _make_exchange(self, library: Library) -> Exchange:
        needed = self._version == 1 or bool(self._description.capabilities.get("needsCompletedIntegratorStep", True))
        clocks = self._description.clocks
        return Exchange(self._version, library.address, self.adapter, self._stepping, clocks, needed)

    def _enter_initialisation(self, t0: float, starts: Iterable[Start], u: Vector) -> None:
        adapter = self.adapter
        self._inputs = u
        tolerance = None if self.exchange is None else self._stepping.tolerance
        starts = list(starts)
        sizes = [start for start in starts if start[0].structural]
        if sizes:
            self.call(t0, "EnterConfigurationMode")
            self._set(t0, sizes)
            self.call(t0, "ExitConfigurationMode")
        for function, arguments in self._calls.before_starts(t0, tolerance):
            self.call(t0, function, *arguments)
        self._set(t0, [start for start in starts if not start[0].structural])
        for function, arguments in self._calls.before_inputs(t0, tolerance):
            self.call(t0, function, *arguments)
        self._check(t0, _STAGES[0], adapter.write(adapter.self, u.ctypes.data))

    def _switch_messages_on(self, t0: float) -> None:
        """Switch on messages about statuses where the FMU declares such; a refusal short of an error is no matter."""
        wanted = self._calls.messages_on()
        if wanted is not None:
            status = self._status(wanted[0], self.adapter.table.instance, *wanted[1])
            self._check(t0, "switching its messages on", status if status >= ERROR else OK)

    def _set(self, t0: float, starts: Iterable[Start]) -> None:
        groups: dict[Any, list[Start]] = {}
        for start in starts:
            groups.setdefault(PASSAGES[self._version][start[0].type], []).append(start)
        for passage, group in groups.items():
            values = [_c_value(value, passage.c_type) for _, several in group for value in several]
            references = (c_uint32 * len(group))(*(variable.reference for variable, _ in group))
            counts = (c_size_t(len(values)),) if self._version == 3 else ()
            array = (passage.c_type * len(values))(*values)
            self.call(t0, f"Set{passage.function}", references, c_size_t(len(group)), array, *counts)

    @property
    def _shown(self) -> str:
        return f"fmi{self._version}" if self._version > 1 else "fmi"

    def _status(self, function: str, instance: int, *arguments: Any) -> int:
        """The status a call ended in; what the standard does not know, and pending, count as errors."""
        if self._library is None:
            return ERROR
        status = int(self._library.function(function)(c_void_p(instance), *arguments))
        return status if OK <= status <= FATAL else ERROR

    def _free_instance(self, instance: int) -> None:
        assert self._library is not None
        function = self._library.function(self._calls.free)
        function.restype = None
        function(c_void_p(instance))

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


def _c_value(value: float | str, c_type: Any) -> Any:
    if isinstance(value, str):
        return value.encode()
    if c_type in (ctypes.c_double, ctypes.c_float):
        return value
    return bool(value) if c_type is ctypes.c_bool else round(value)


def _threads() -> int:
    """How many threads this process has; 0 where the system does not tell."""
    try:
        return len(os.listdir("/proc/self/task"))
    except OSError:
        return 0
