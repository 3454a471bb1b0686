"""A file descriptor that a child process is given as it starts."""

from __future__ import annotations

from multiprocessing import reduction
from typing import Any


class Descriptor:
    """The number of an open file; pickled while a process is started, it is the same file's number there."""

    def __init__(self, number: int) -> None:
        self.number = number

    def __getstate__(self) -> Any:
        return reduction.DupFd(self.number)

    def __setstate__(self, duplicate: Any) -> None:
        self.number = duplicate.detach()
