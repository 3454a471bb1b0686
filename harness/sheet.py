"""The memory a worker shares with its parent: where the worker is, and the rows it wrote last.

The parent reads both after the worker crashed or was ended. It is no file that anybody could see or would have to
clean up: it goes with the last of the two processes.
"""

from __future__ import annotations

import mmap
import os
import tempfile

import numpy as np
from numpy.typing import NDArray

from fmus import whereabouts
from fmus.whereabouts import Whereabouts
from harness.descriptor import Descriptor

# Rows begin here; what comes before holds the whereabouts.
HEAD = mmap.ALLOCATIONGRANULARITY


class Sheet:
    """Shared memory with a head and rows; pickled to a child process as it is started, it is the same memory there."""

    def __init__(self) -> None:
        self._attach(Descriptor(_anonymous_file()))
        os.ftruncate(self._file, HEAD)

    def _attach(self, descriptor: Descriptor) -> None:
        self._file = descriptor.number
        self._head: mmap.mmap | None = None

    def __getstate__(self) -> Descriptor:
        return Descriptor(self._file)

    def __setstate__(self, descriptor: Descriptor) -> None:
        self._attach(descriptor)

    def head(self) -> mmap.mmap:
        """The memory of the whereabouts."""
        if self._head is None:
            self._head = mmap.mmap(self._file, HEAD)
        return self._head

    def whereabouts(self) -> Whereabouts:
        """A copy of what stands there now."""
        return Whereabouts.from_buffer_copy(self.head()[: whereabouts.SIZE])

    def clear(self) -> None:
        """Forget where the worker was."""
        self.head()[: whereabouts.SIZE] = bytes(whereabouts.SIZE)

    def new_rows(self, count: int, columns: int) -> NDArray[np.float64]:
        """Memory for so many rows, shape (count, columns); the first of them are those that were there before."""
        os.ftruncate(self._file, HEAD + 8 * count * columns)
        return self.rows(count, columns)

    def capacity(self, columns: int) -> int:
        """How many rows there is memory for."""
        return max(os.fstat(self._file).st_size - HEAD, 0) // (8 * columns)

    def rows(self, count: int, columns: int) -> NDArray[np.float64]:
        """The first rows as they stand there now, shape (count, columns)."""
        if not count * columns:
            return np.empty((count, columns))
        memory = mmap.mmap(self._file, 8 * count * columns, offset=HEAD)
        return np.frombuffer(memory, dtype=np.float64).reshape(count, columns)

    def close(self) -> None:
        """Let go of the memory; arrays of rows stay valid."""
        os.close(self._file)


def _anonymous_file() -> int:
    if hasattr(os, "memfd_create"):
        return os.memfd_create("crankbench-rows")
    with tempfile.TemporaryFile() as file:
        return os.dup(file.fileno())
