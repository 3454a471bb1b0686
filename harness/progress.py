"""Tells of cases as they run and end: a bar on a terminal, plain lines in a pipe."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Protocol, TextIO

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from harness.cases import Ended, Underway
from harness.clock import TimeGrid
from harness.record import COMPLETE

# A pipe hears of the cases that run when it heard of nothing else for so long, a terminal so often [s].
QUIET, REFRESH = 10.0, 0.2
# So many running cases are named.
NAMED = 3


class Teller(Protocol):
    """Tells somebody of cases."""

    def ended(self, ended: Ended) -> None:
        """One came to its end."""

    def underway(self, underway: Underway) -> None:
        """One is being run; heard of from several threads."""


@contextmanager
def progress(stream: TextIO) -> Iterator[Teller]:
    """Who tells the stream of the cases while the block lasts."""
    if not stream.isatty():
        yield Lines(stream)
        return
    console = Console(file=stream)
    count, text = (TextColumn(f"{{task.{name}}}", markup=False) for name in ("fields[count]", "description"))
    columns = (BarColumn(), count, TimeElapsedColumn(), text)
    with Progress(*columns, console=console, transient=True) as bar:
        yield Bar(console, bar, bar.add_task("wiring", total=None, count=""))


class Lines:
    """A line a case that ends; where that takes long, one that says how far those are that run."""

    def __init__(self, stream: TextIO, now: Callable[[], float] = time.monotonic) -> None:
        self._stream, self._now = stream, now
        self._running: dict[str, Underway] = {}
        self._said, self._one_at_a_time = now(), threading.Lock()

    def ended(self, ended: Ended) -> None:
        """See Teller."""
        with self._one_at_a_time:
            self._running.pop(ended.case.key, None)
            self._say(line(ended))

    def underway(self, underway: Underway) -> None:
        """See Teller."""
        with self._one_at_a_time:
            self._running[underway.case.key] = underway
            if self._now() - self._said >= QUIET:
                self._say(f"running: {all_reached(list(self._running.values()))}")

    def _say(self, text: str) -> None:
        print(text, file=self._stream, flush=True)
        self._said = self._now()


class Bar:
    """A bar that grows with the cases that end and with what the others have done; failures stay above it."""

    def __init__(self, console: Console, bar: Progress, task: TaskID) -> None:
        self._console, self._bar, self._task = console, bar, task
        self._running: dict[str, Underway] = {}
        self._done, self._drawn, self._one_at_a_time = 0, 0.0, threading.Lock()

    def ended(self, ended: Ended) -> None:
        """See Teller."""
        with self._one_at_a_time:
            self._running.pop(ended.case.key, None)
            self._done = ended.done
            self._draw(ended.total, ended.case.label)
        if ended.outcome not in COMPLETE:
            self._console.print(line(ended), markup=False, highlight=False, soft_wrap=True)

    def underway(self, underway: Underway) -> None:
        """See Teller."""
        with self._one_at_a_time:
            self._running[underway.case.key] = underway
            if time.monotonic() - self._drawn >= REFRESH:
                self._draw(underway.total, all_reached(list(self._running.values())))

    def _draw(self, total: int, text: str) -> None:
        share = sum(underway.share or 0.0 for underway in self._running.values())
        count = f"{self._done:>{len(str(total))}}/{total}"
        self._bar.update(self._task, total=total, completed=self._done + share, description=text, count=count)
        self._drawn = time.monotonic()


def line(ended: Ended) -> str:
    """One case in words: `[3/20] mismatch: seed = 3  ok`."""
    count = f"[{ended.done:>{len(str(ended.total))}}/{ended.total}]"
    outcome = f"{ended.outcome}, kept" if ended.reused else ended.outcome
    reason = f": {ended.message}" if ended.outcome not in COMPLETE and ended.message else ""
    return f"{count} {ended.case.label}  {outcome}{reason}"


def all_reached(running: list[Underway]) -> str:
    """How far cases are, in words: `seed = 3 at 4.1 s of 10 s (41 %); seed = 4 at 0 s of 10 s (0 %); 2 more`."""
    named = [f"{underway.case.label} at {reached(underway)}" for underway in running[:NAMED]]
    more = len(running) - NAMED
    return "; ".join(named + [f"{more} more"] * (more > 0))


def reached(underway: Underway) -> str:
    """How far a case is, in words: `4.1 s of 10 s (41 %)`; of a crank clock that stops at a time, the angle alone."""
    grid, done = underway.grid, max(underway.instant - 1, 0)
    if isinstance(grid, TimeGrid):
        at, of = (f"{grid.start + instant * grid.step:.6g} s" for instant in (done, grid.steps))
    else:
        at, of = (f"{grid.origin + instant * grid.degrees:.9g} deg" for instant in (done, grid.steps))
    return at if underway.share is None else f"{at} of {of} ({100 * underway.share:.0f} %)"
