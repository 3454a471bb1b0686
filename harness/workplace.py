"""The inside of a worker process: it serves calls, and what it finds and prints goes to its parent only.

A call is ("call", function, arguments); the worker sends ("told", content) and ("asked", content) meanwhile, each of
these answered by ("answer", value) or ("refusal", error), and at last ("result", value) or ("error", ...).
"""

from __future__ import annotations

import ctypes
import faulthandler
import locale
import os
import signal
import sys
import threading
import traceback
from collections.abc import Callable
from contextlib import suppress
from multiprocessing.connection import Connection
from typing import Any

from fmus import whereabouts
from harness.descriptor import Descriptor
from harness.sheet import Sheet

_line: Connection | None = None
_sheet: Sheet | None = None


def tell(content: Any) -> None:
    """Let the parent know something that it keeps should this process be lost; the last word counts."""
    if _line is not None:
        _line.send(("told", content))


def ask(content: Any) -> None:
    """Ask the parent for something; the answer is to be taken later, by `answer`, and answers come in that order."""
    assert _line is not None, "only a worker has somebody to ask"
    _line.send(("asked", content))


def answer() -> Any:
    """What the parent answers, to the first question that it has not answered yet. Raises what it refuses with."""
    assert _line is not None, "only a worker has somebody to ask"
    kind, content = _line.recv()
    if kind == "refusal":
        raise content
    return content


def sheet() -> Sheet:
    """The memory that this process shares with its parent; one of its own where it is nobody's worker."""
    global _sheet
    if _sheet is None:
        _sheet = Sheet()
    return _sheet


def serve(line: Connection, lifeline: Descriptor, output: Descriptor, shared: Sheet) -> None:
    """Answer calls (function, arguments) until the parent is gone."""
    global _line, _sheet
    os.setsid()
    _die_with(lifeline.number)
    _keep_quiet(output.number)
    _line, _sheet = line, shared
    whereabouts.keep_in(shared.head())
    line.send(("ready",))
    while True:
        try:
            kind, *content = line.recv()
        except (EOFError, OSError):
            return
        if kind != "call":  # the answer to what a call that failed had asked
            continue
        function, arguments = content
        answer = _answer(function, arguments)
        _flush()
        try:
            line.send(answer)
        except (BrokenPipeError, ConnectionResetError):
            return
        except Exception as error:  # what cannot be pickled is told in words
            line.send(("error", None, RuntimeError(f"{type(error).__name__}: {error}"), traceback.format_exc()))


def _answer(function: Callable[..., Any], arguments: tuple[Any, ...]) -> tuple[Any, ...]:
    try:
        return ("result", function(*arguments))
    except Exception as error:
        return ("error", None, error, traceback.format_exc())


def _die_with(lifeline: int) -> None:
    """Have this process and all of its group killed as soon as the other end of the pipe `lifeline` is closed.

    On Linux the system does it, whatever this process does then; elsewhere a thread.
    """
    import fcntl

    if hasattr(fcntl, "F_SETSIG"):
        fcntl.fcntl(lifeline, fcntl.F_SETOWN, -os.getpgrp())
        fcntl.fcntl(lifeline, fcntl.F_SETSIG, signal.SIGKILL)
        fcntl.fcntl(lifeline, fcntl.F_SETFL, fcntl.fcntl(lifeline, fcntl.F_GETFL) | os.O_ASYNC)
        return

    def watch() -> None:
        os.read(lifeline, 1)
        os.killpg(0, signal.SIGKILL)

    threading.Thread(target=watch, daemon=True).start()


def _keep_quiet(output: int) -> None:
    """Let standard output and error go to the pipe, line by line; input is empty; a crash leaves no core file."""
    import resource

    nothing = os.open(os.devnull, os.O_RDONLY)
    os.dup2(nothing, 0)
    os.dup2(output, 1)
    os.dup2(output, 2)
    os.close(nothing)
    os.close(output)
    for stream in (sys.stdout, sys.stderr):
        stream.reconfigure(line_buffering=True)  # type: ignore[union-attr]
    with suppress(ValueError, AttributeError):  # where the C library has another name for it, blocks have to do
        library = ctypes.CDLL(None)
        library.setvbuf(ctypes.c_void_p.in_dll(library, "stdout"), None, 1, 0)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    faulthandler.enable(all_threads=False)


def _flush() -> None:
    """Let what was printed so far go out, from C's buffers too."""
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError):
            stream.flush()
    with suppress(AttributeError):
        ctypes.CDLL(None).fflush(None)


def condition() -> tuple[object, ...]:
    """What a part may have changed of this process that outlives it: folder, locale, threads and signal handlers.

    And where modules come from: FMUs with Python inside bring their own, which the next one would be given.
    """
    return (os.getcwd(), locale.setlocale(locale.LC_ALL), *sys.path, *_status())


def _status() -> list[str]:
    """The lines of the system's report on this process that speak of threads, signals and the mask of new files."""
    try:
        with open("/proc/self/status", encoding="ascii", errors="replace") as file:
            lines = file.readlines()
    except OSError:  # only Linux has it
        return [str(threading.active_count())]
    return [line for line in lines if line.startswith(("Threads", "SigBlk", "SigIgn", "SigCgt", "Umask"))]
