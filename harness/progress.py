"""Tells of cases as they end: a bar on a terminal, plain lines in a pipe."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TextIO

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from harness.cases import Ended
from harness.record import COMPLETE


@contextmanager
def progress(stream: TextIO) -> Iterator[Callable[[Ended], None]]:
    """What to call as each case ends, while the block lasts."""
    if not stream.isatty():
        yield lambda ended: print(line(ended), file=stream, flush=True)
        return
    console = Console(file=stream)
    columns = (BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TextColumn("{task.description}", markup=False))
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task("wiring", total=None)

        def show(ended: Ended) -> None:
            bar.update(task, total=ended.total, completed=ended.done, description=ended.case.label)
            if ended.outcome not in COMPLETE:
                console.print(line(ended), markup=False, highlight=False, soft_wrap=True)

        yield show


def line(ended: Ended) -> str:
    """One case in words: `[3/20] mismatch: seed = 3  ok`."""
    count = f"[{ended.done:>{len(str(ended.total))}}/{ended.total}]"
    outcome = f"{ended.outcome}, kept" if ended.reused else ended.outcome
    reason = f": {ended.message}" if ended.outcome not in COMPLETE and ended.message else ""
    return f"{count} {ended.case.label}  {outcome}{reason}"
