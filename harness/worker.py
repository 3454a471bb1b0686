"""Runs functions in a process of their own that may crash, hang or eat memory, and says how each call ended.

A worker leads a process group of its own and prints into a pipe. It is ended, with all the processes it started, when
its call takes too long or too much, and by the system when its parent is gone, however that came to be. This keeps
faults apart; it is no sandbox: the function may do to the machine whatever its user may.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import tempfile
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from multiprocessing import connection
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from fmus import whereabouts
from fmus.component import ConfigurationError
from fmus.whereabouts import Whereabouts
from harness import workplace
from harness.descriptor import Descriptor
from harness.noise import Noise
from harness.sheet import Sheet

# How often a parent looks after a worker [s].
LOOK = 0.03
# How long a worker may take to come up, and its remains to go [s].
COMING_UP, GOING = 120.0, 5.0
GIBIBYTE = 2.0**30
# The path of a socket has 108 bytes on Linux, and 104 on macOS; the server's own names take 34 of them.
LONGEST_SOCKET_FOLDER = 68
# Stages in which no code of an FMU runs: the limit for one step does not hold there.
OWN_STAGES = ("", "wiring", "writing")
# Processes are started and waited for one at a time: multiprocessing looks after those of all threads.
_PROCESSES = threading.Lock()


@dataclass(frozen=True)
class Limits:
    """What a call may take: wall time [s], wall time in one and the same step or stage [s], memory [bytes]."""

    seconds: float = 600.0
    step: float = 30.0
    memory: float = 4 * GIBIBYTE


@dataclass(frozen=True)
class Outcome:
    """How a call ended.

    `result`: it returned `value`. `error`: it raised `error`; `message` has the traceback. `crash`, `timeout`: its
    process died or was ended, for the reason in `message`. `place` is what was being done then, `told` what the
    function said by `workplace.tell` last, `output` what was printed, `seconds` how long it took, `first` whether it
    was the first call in its process.
    """

    kind: Literal["result", "error", "crash", "timeout"]
    value: Any = None
    error: BaseException | None = None
    message: str = ""
    place: Whereabouts | None = None
    told: Any = None
    output: str = ""
    seconds: float = 0.0
    first: bool = True

    @property
    def stage(self) -> str:
        """What was being done, like instantiate or step; empty where nothing was said."""
        return "" if self.place is None else self.place.stage.decode()

    @property
    def part(self) -> str:
        """The part it was being done to; empty where nothing was said."""
        return "" if self.place is None else self.place.name.decode(errors="replace")


class Caller(Protocol):
    """Who called: it hears of a call while that lasts."""

    def answer(self, told: Any, asked: Any) -> Any:
        """What to answer when the function asks by `workplace.ask`; `told` is its last word by `workplace.tell`.

        Raises OSError, which the function gets.
        """

    def look(self, told: Any, place: Whereabouts) -> None:
        """What is being done now; called every LOOK or so."""


class _Nobody:
    """A caller that knows no answers."""

    def answer(self, told: Any, asked: Any) -> Any:
        raise NotImplementedError(f"nobody answers {asked!r}")

    def look(self, told: Any, place: Whereabouts) -> None:
        pass


_NOBODY = _Nobody()


def isolated(function: Callable[..., Any], *args: Any, seconds: float = 60.0, memory: float = 4 * GIBIBYTE) -> Outcome:
    """How `function(*args)` ended in a process of its own, within so many seconds [s] and so much memory [bytes].

    Function, arguments and result are pickled. Nothing that the function does to its process comes through to the
    caller's; when this returns, the process and those it started are gone.
    """
    worker = Worker()
    try:
        return worker.call(function, *args, limits=Limits(seconds, seconds, memory))
    finally:
        worker.close()


class Worker:
    """A process that runs one call after another; a fresh one takes its place when it was lost or is `retire`d."""

    def __init__(self) -> None:
        self._process: Any = None
        self._calls = 0

    @property
    def calls(self) -> int:
        """How many calls the present process has had."""
        return self._calls

    def call(
        self,
        function: Callable[..., Any],
        *args: Any,
        limits: Limits,
        stopped: Callable[[], bool] = lambda: False,
        caller: Caller = _NOBODY,
    ) -> Outcome:
        """How a call ended; InterruptedError where `stopped` became true meanwhile, and the worker is gone."""
        if self._process is None or self._exit_code() is not None:
            self.close()
            self._start()
        self._noise.forget()
        self._sheet.clear()
        first, self._calls = self._calls == 0, self._calls + 1
        _cap_memory(self._process.pid, limits.memory)
        watch = _Watch(self._process.pid, self._sheet, limits)
        told: Any = None
        done: Outcome | None = None
        with suppress(OSError):  # it died just now; the look at it below says of what
            self._line.send(("call", function, args))
        while done is None:
            connection.wait([self._line, self._process.sentinel, self._noise.reader], LOOK)
            self._noise.read()
            dead = bool(connection.wait([self._process.sentinel], 0))
            kind: Any = ""
            try:
                if self._line.poll():
                    kind, *content = self._line.recv()
            except (EOFError, OSError):
                dead = dead or bool(connection.wait([self._process.sentinel], GOING))
            if kind == "told":
                (told,) = content
            elif kind == "asked":
                self._answer(caller, told, *content)
            elif kind:
                done = Outcome(kind, *content)
            elif dead:
                done = Outcome("crash", message=watch.cause(self._ended_with()))
            if done is None:
                done = watch.look()
            if done is None and stopped():
                self.close()
                raise InterruptedError
            if done is None:
                caller.look(told, self._sheet.whereabouts())
        lost = done.kind in ("crash", "timeout")
        full = memory_used(self._process.pid) > 0.5 * limits.memory
        if lost or full:  # what one call did not give back would be missing to the next
            self._end()
            self._noise.read()
        return replace(
            done,
            place=self._sheet.whereabouts() if lost else None,
            told=told,
            output=self._noise.text(),
            seconds=watch.elapsed,
            first=first,
        )

    def _answer(self, caller: Caller, told: Any, asked: Any) -> None:
        """Answer what the worker asked. A file that cannot be written is a matter of the call, and refused."""
        try:
            reply = ("answer", caller.answer(told, asked))
        except OSError as error:
            reply = ("refusal", error)
        with suppress(OSError):  # the worker may have died meanwhile
            self._line.send(reply)

    def rows(self, count: int, columns: int) -> NDArray[np.float64]:
        """The first rows in the memory that the last call wrote to, shape (count, columns)."""
        return self._sheet.rows(count, columns)

    def capacity(self, columns: int) -> int:
        """How many rows that memory has room for."""
        return self._sheet.capacity(columns)

    def close(self) -> None:
        """End the process and all it started; the next call gets a fresh one."""
        if self._process is None:
            return
        self._end()
        self._line.close()
        os.close(self._lifeline)
        self._noise.close()
        self._sheet.close()
        self._process = None

    def _start(self) -> None:
        if os.name != "posix":
            raise ConfigurationError("workers want Linux or macOS; on Windows, use the Windows Subsystem for Linux")
        self._noise, self._sheet, self._calls = Noise(), Sheet(), 0
        self._line, theirs = multiprocessing.Pipe()
        watched, self._lifeline = os.pipe()
        with _PROCESSES:
            process = _context().Process(
                target=workplace.serve,
                args=(theirs, Descriptor(watched), Descriptor(self._noise.writer), self._sheet),
                daemon=True,
            )
            process.start()
        self._process = process
        theirs.close()
        os.close(watched)
        if not self._line.poll(COMING_UP):
            self.close()
            raise RuntimeError(f"a worker process did not come up within {COMING_UP:g} s")
        try:
            self._line.recv()
        except (EOFError, OSError):
            connection.wait([process.sentinel], GOING)
            said, code = self._noise_now(), self._exit_code()
            self.close()
            raise RuntimeError(f"a worker process did not come up: {exit_text(code)} {said}") from None

    def _noise_now(self) -> str:
        self._noise.read()
        return self._noise.text()

    def _exit_code(self) -> int | None:
        """How the process ended, None while it runs. Unlike its sentinel, this may be asked for more than once."""
        with _PROCESSES:
            code: int | None = self._process.exitcode
            return code

    def _ended_with(self) -> int | None:
        """The exit code of a process that is going: its pipes may close an instant before the system knows the code."""
        until = time.monotonic() + GOING
        code = self._exit_code()
        while code is None and time.monotonic() < until:
            time.sleep(1e-3)
            code = self._exit_code()
        return code

    def _end(self) -> None:
        """Kill the process with all of its group, and wait until it is gone."""
        alive = self._exit_code() is None
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(self._process.pid, signal.SIGKILL)
        if alive:  # it may not lead a group yet
            with suppress(ProcessLookupError):
                os.kill(self._process.pid, signal.SIGKILL)
            connection.wait([self._process.sentinel], GOING)
        with _PROCESSES:
            self._process.join(GOING)


class _Watch:
    """Watches one call for what it may not do. Time that the parent itself was stopped for does not count."""

    def __init__(self, pid: int, sheet: Sheet, limits: Limits) -> None:
        self._pid, self._sheet, self._limits = pid, sheet, limits
        self._looked = time.monotonic()
        self._seen, self._still, self._used = b"", 0.0, 0.0
        self.elapsed = 0.0

    def look(self) -> Outcome | None:
        """The outcome of a call that broke a limit; None as long as it keeps to them."""
        now = time.monotonic()
        passed, self._looked = min(now - self._looked, 1.0), now
        self.elapsed += passed
        seen = bytes(self._sheet.head()[: whereabouts.SIZE])
        stage = Whereabouts.from_buffer_copy(seen).stage.decode()
        moved = seen != self._seen or stage in OWN_STAGES
        self._seen, self._still = seen, 0.0 if moved else self._still + passed
        self._used = memory_used(self._pid)
        limits = self._limits
        if self._used > limits.memory:
            return Outcome("crash", message=f"it took more memory than its limit of {gibibytes(limits.memory)}")
        if self._still > limits.step:
            return Outcome("timeout", message=f"nothing came back within its limit of {limits.step:g} s")
        if self.elapsed > limits.seconds:
            return Outcome("timeout", message=f"it took longer than its limit of {limits.seconds:g} s and was ended")
        return None

    def cause(self, code: int | None) -> str:
        """Why a process died that nobody ended."""
        used = ""
        if self._used > 0.8 * self._limits.memory:
            used = f"; it had {gibibytes(self._used)} of memory, its limit is {gibibytes(self._limits.memory)}"
        return f"its process ended with {exit_text(code)}{used}"


def memory_used(pid: int) -> float:
    """The memory [bytes] a process holds for itself alone; 0 where the system does not tell, or it is gone."""
    try:
        with open(f"/proc/{pid}/statm", "rb") as file:
            _, resident, shared, *_ = map(int, file.read().split())
    except (OSError, ValueError):
        return 0.0
    return float((resident - shared) * os.sysconf("SC_PAGE_SIZE"))


def _cap_memory(pid: int, limit: float) -> None:
    """Have the system refuse a process what is far beyond its limit, should it be faster than its parent looks."""
    with suppress(ImportError, AttributeError, OSError, ValueError):
        import resource

        with open(f"/proc/{pid}/statm", "rb") as file:
            data = int(file.read().split()[5]) * os.sysconf("SC_PAGE_SIZE")
        _, hard = resource.prlimit(pid, resource.RLIMIT_DATA)  # type: ignore[attr-defined, unused-ignore]
        resource.prlimit(pid, resource.RLIMIT_DATA, (int(data + 2 * limit), hard))


def gibibytes(amount: float) -> str:
    """An amount of memory [bytes] in words."""
    return f"{amount / GIBIBYTE:.3g} GiB" if amount >= 0.1 * GIBIBYTE else f"{amount / 2**20:.3g} MiB"


def exit_text(code: int | None) -> str:
    """In words how a process ended."""
    if code is not None and code < 0:
        known = {int(one): one.name for one in signal.Signals}
        return f"the signal {known.get(-code, -code)}"
    return f"exit code {code}"


def _context() -> Any:
    """Fresh processes that know nothing of the parent's threads; forked from a warm one where the platform can."""
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    # The server is reached by a socket in the folder for temporary files; the path of a socket has little room.
    too_long = len(os.fsencode(tempfile.gettempdir())) > LONGEST_SOCKET_FOLDER
    if "forkserver" not in multiprocessing.get_all_start_methods() or too_long:
        return multiprocessing.get_context("spawn")
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["harness.cases", "fmpy.model_description"])
    return context
