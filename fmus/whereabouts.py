"""What this process is doing, and to which part: kept where another process reads it when this one dies or hangs.

A crash is a matter of the whole process, and so is this: there is one, whatever runs in it.
"""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from contextlib import contextmanager
from mmap import mmap


class Whereabouts(ctypes.Structure):
    """What is being done (`stage`) to the part `name`. Rows of the record before `instant` are complete.

    While the loop in C steps, it writes the instant stepped to and where the entry of the part lies in its table, which
    begins at `table` and has entries of `size` bytes.
    """

    _fields_ = (
        ("instant", ctypes.c_int64),
        ("entry", ctypes.c_uint64),
        ("table", ctypes.c_uint64),
        ("size", ctypes.c_uint64),
        ("stage", ctypes.c_char * 48),
        ("name", ctypes.c_char * 192),
    )

    @property
    def number(self) -> int:
        """Which part of the order the loop is at, or was at last."""
        return (self.entry - self.table) // self.size if self.size else 0


SIZE = ctypes.sizeof(Whereabouts)
_here = Whereabouts()


def here() -> Whereabouts:
    """The one of this process."""
    return _here


def keep_in(memory: mmap) -> None:
    """From now on keep it at the beginning of this memory, of at least SIZE bytes, which must stay mapped."""
    global _here
    _here = Whereabouts.from_buffer(memory)


@contextmanager
def doing(stage: str, part: str = "") -> Iterator[None]:
    """Say what is being done to a part while the block lasts."""
    place = _here
    before = place.stage, place.name
    place.name, place.stage = part.encode()[:191], stage.encode()
    try:
        yield
    finally:
        place.name, place.stage = before[1], before[0]
