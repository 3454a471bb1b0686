"""The C of the step loop and of the parts that belong to it: compiled into one library, opened once a process."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fmus.component import Native, Reversal
from fmus.toolchain import compile_shared

_FILES = (
    "parts.c",
    "clock.c",
    "coupling.c",
    "loop.c",
    "crank.c",
    "fault.c",
    "sensor.c",
    "swap.c",
    "points.c",
    "source.c",
    "replay.c",
    "reversal.c",
)


@cache
def library() -> ctypes.CDLL:
    """The compiled library; its calls release the GIL. Raises ConfigurationError: there is no compiler."""
    folder = Path(__file__).parent
    return ctypes.CDLL(str(compile_shared("\n".join((folder / name).read_text("utf-8") for name in _FILES))))


def settle() -> None:
    """Set rounding and the like to what a process begins with: a library may change them when it is loaded or run."""
    library().crankbench_settle()


def native_step(function: str, state: ctypes.Structure | ctypes.c_int64) -> Native:
    """A function of the library and the structure it works on, as a step that C may call."""
    return Native(_function(function), ctypes.addressof(state))


def native_reversal(keep: str, restore: str, state: ctypes.Structure | ctypes.c_int64) -> Reversal:
    """Two functions of the library and the structure they work on, as what takes a part back; no derivative."""
    return Reversal(_function(keep), _function(restore), 0, ctypes.addressof(state))


def _function(name: str) -> int:
    return ctypes.cast(getattr(library(), name), ctypes.c_void_p).value or 0


def address(array: NDArray[np.float64] | NDArray[np.int64] | None) -> int | None:
    """Where the numbers of an array lie; None, C's NULL, for no array. The caller keeps the array alive."""
    return None if array is None else array.ctypes.data


def call(
    function: str,
    state: ctypes.Structure,
    *times: float,
    u: Sequence[float] | NDArray[np.float64] = (),
    outputs: int = 1,
) -> tuple[int, NDArray[np.float64]]:
    """Status and the outputs, shape (outputs,), of a step or start function of the library, called from Python."""
    inputs = (ctypes.c_double * max(len(u), 1))(*u)
    given = np.zeros(outputs)
    arguments = [ctypes.c_double(time) for time in times]
    status = getattr(library(), function)(ctypes.byref(state), *arguments, inputs, ctypes.c_void_p(given.ctypes.data))
    return status, given
