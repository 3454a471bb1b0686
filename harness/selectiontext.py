"""A selection for a terminal: progress while it runs, the ranked table, and the table as CSV."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, TextIO

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from harness.selecting import Selected

# Lines in a pipe come at these shares of what is to be done, and only of work that takes long.
_TENTHS, _LONG = 10, 5000
# Columns of a table in a pipe, where there is no terminal to ask.
_WIDE = 160


@contextmanager
def sets_told(stream: TextIO) -> Iterator[Callable[[str, int, int], None]]:
    """What to call with what is done, of how many sets, of how many in all, while the block lasts."""
    if not stream.isatty():
        last: dict[str, int] = {}

        def say(what: str, done: int, total: int) -> None:
            tenth = done * _TENTHS // max(total, 1)
            if total >= _LONG and tenth > last.get(what, 0):
                last[what] = tenth
                print(f"{what}: {done} of {total} sets", file=stream, flush=True)

        yield say
        return
    columns = (TextColumn("{task.description}", markup=False), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=Console(file=stream), transient=True) as bar:
        tasks: dict[str, Any] = {}

        def show(what: str, done: int, total: int) -> None:
            if what not in tasks:
                tasks[what] = bar.add_task(what, total=total)
            bar.update(tasks[what], completed=done)

        yield show


def print_selected(selected: Selected, most: int | None, stream: TextIO) -> None:
    """The best so many sets, or all, and what they stand on."""
    about, rows = selected.about, selected.sets(most)
    console = Console(file=stream) if stream.isatty() else Console(file=stream, width=_WIDE)
    table = Table(*_heads(about), box=None, header_style="bold", pad_edge=False)
    for number, row in enumerate(rows, start=1):
        table.add_row(str(number), " ".join(row["sensors"]), *(_cell(row, column) for column in _columns(about)))
    console.print(table, markup=False)
    lines = [
        f"{len(rows)} of {about['considered']} sets shown, by {', '.join(about['by'])}; index by the method "
        f"{about['method']}: {_pairs_of_words(about['evidence'])}"
    ]
    if about["measures"]:
        lines.append(
            f"error: root mean square of the estimate's errors over the states' sizes; a sample each "
            f"{about['period']:g} s, process noise {process_told(about['process'])}"
        )
    for line in (*lines, *(f"note: {note}" for note in about["notes"])):
        console.print(line, markup=False, highlight=False, soft_wrap=True)


def process_told(asked: float | Mapping[str, str]) -> str:
    """What disturbs the states, in words."""
    return "of its own of each state" if isinstance(asked, Mapping) else f"{asked:g} of a size in a second"


_WORDS = {
    "index": "index",
    "whole": "whole state",
    "cost": "cost",
    "error": "error",
    "gramian_least": "least eigenvalue",
    "gramian_log_det": "log det",
    "gramian_trace_inverse": "trace of inverse",
    "hidden": "never sees",
}


def _columns(about: Mapping[str, Any]) -> list[str]:
    columns = ["index", "whole", "cost"]
    columns += ["error"] if "kalman" in about["measures"] else []
    columns += ["gramian_least", "gramian_log_det", "gramian_trace_inverse"] if "gramian" in about["measures"] else []
    return [*columns, "hidden"] if any("never" in counts for counts in about["counts"].values()) else columns


def _heads(about: Mapping[str, Any]) -> list[str]:
    return ["", "sensors", *(_WORDS[column] for column in _columns(about))]


def _cell(row: Mapping[str, Any], column: str) -> str:
    value = row[column]
    if column == "hidden":
        return " ".join(value)
    return "-" if value is None else f"{value:.4g}" if isinstance(value, float) else str(value)


def _pairs_of_words(content: Mapping[str, Any]) -> str:
    return ", ".join(f"{name.replace('_', ' ')} {_short(value)}" for name, value in content.items())


def _short(value: Any) -> str:
    return f"{value:.2g}" if isinstance(value, float) else str(value)


def csv_text(selected: Selected) -> str:
    """All sets as CSV, best first, SI units; sensors with blanks between, nothing where there is no number."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    columns = [name for name in _WORDS if name != "hidden"]
    errors = [f"error_{name}" for name in selected.wanted]
    writer.writerow(["sensors", *columns, *errors, "hidden", "why"])
    for row in selected.sets():
        deviations = row["errors"] or {}
        cells = [row[column] for column in columns] + [deviations.get(name) for name in selected.wanted]
        writer.writerow([" ".join(row["sensors"]), *cells, " ".join(row["hidden"]), row["why"]])
    return buffer.getvalue()
