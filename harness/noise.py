"""Takes what a worker and its FMUs print, so that it reaches no terminal: the first and the last of it are kept."""

from __future__ import annotations

import os
from contextlib import suppress

# How much is kept of the beginning, and as much of the end [bytes].
KEPT = 32 * 1024
_AT_ONCE = 1 << 18


class Noise:
    """The reading end of a pipe that stands for a worker's standard output and error."""

    def __init__(self) -> None:
        self.reader, self.writer = os.pipe()
        os.set_blocking(self.reader, False)
        with suppress(ImportError, AttributeError, OSError):  # Linux only: who prints much waits less
            import fcntl

            fcntl.fcntl(self.writer, fcntl.F_SETPIPE_SZ, _AT_ONCE)
        self.forget()

    def forget(self) -> None:
        """Begin anew."""
        self._first, self._last, self._count = b"", b"", 0

    def read(self) -> None:
        """Take what is in the pipe now, up to a quarter of a megabyte."""
        try:
            piece = os.read(self.reader, _AT_ONCE)
        except BlockingIOError:
            return
        self._count += len(piece)
        room = KEPT - len(self._first)
        self._first += piece[:room]
        self._last = (self._last + piece[room:])[-KEPT:]

    def text(self) -> str:
        """What was printed; where it was too much, the middle is replaced by how much that was."""
        dropped = self._count - len(self._first) - len(self._last)
        gap = f"\n[... {dropped} bytes ...]\n".encode() if dropped else b""
        return (self._first + gap + self._last).decode(errors="replace")

    def close(self) -> None:
        """Close both ends that are still open."""
        for end in (self.reader, self.writer):
            os.close(end)
