"""A selection by error for a terminal: progress while it runs, the ranked table with the proofs, the table as CSV."""

from __future__ import annotations

import csv
import io
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, TextIO

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from harness.optimising import Optimised
from harness.selectiontext import process_told

# Seconds between lines in a pipe, and before the first: what is done sooner says nothing.
_QUIET = 5.0
# Columns of a table in a pipe, where there is no terminal to ask.
_WIDE = 160


@contextmanager
def stages_told(stream: TextIO) -> Iterator[Callable[[str, int, int], None]]:
    """What to call with what is done, how far, and of how much in all, while the block lasts."""
    if not stream.isatty():
        last = time.monotonic()

        def say(what: str, done: int, total: int) -> None:
            nonlocal last
            if time.monotonic() - last >= _QUIET:
                last = time.monotonic()
                print(f"{what}: {done} of {total}", file=stream, flush=True)

        yield say
        return
    columns = (TextColumn("{task.description}", markup=False), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=Console(file=stream), transient=True) as bar:
        task = bar.add_task("", total=None)

        def show(what: str, done: int, total: int) -> None:
            bar.update(task, description=what, completed=done, total=total)

        yield show


def print_optimised(selected: Optimised, most: int | None, stream: TextIO) -> None:
    """The best so many sets, or all, and what they stand on."""
    about, rows = selected.about, selected.sets(most)
    console = Console(file=stream) if stream.isatty() else Console(file=stream, width=_WIDE)
    units = {state["name"]: state["unit"] for state in about["states"]}
    errors = [f"{name} [{units[name]}]" if units[name] not in ("", "1") else name for name in about["estimate"]]
    swept = about["method"] == "h2"
    heads = ["", "sensors", "cost", "error", *errors, "trace(T)", "above the best", "after a loss"]
    table = Table(*heads, *(["alpha", "status"] if swept else []), box=None, header_style="bold", pad_edge=False)
    for number, row in enumerate(rows, start=1):
        deviations = row["errors"] or dict.fromkeys(about["estimate"])
        trace = row["trace_T"] if row["trace_T"] is not None else row["trace"]
        values = (row["cost"], row["error"], *deviations.values(), trace)
        cells = [str(number), " ".join(row["sensors"]), *map(_number, values), _percent(row["gap"])]
        cells.append(_number(row["error_after_loss"]))
        if swept:
            cells += [" ".join(f"{alpha:.3g}" for alpha in _ends(row["alphas"])), row["status"] or "-"]
        table.add_row(*cells)
    console.print(table, markup=False)
    for line in _lines(selected, len(rows)):
        console.print(line, markup=False, highlight=False, soft_wrap=True)


def _ends(values: list[float]) -> list[float]:
    return values if len(values) < 2 else [values[0], values[-1]]


def _lines(selected: Optimised, shown: int) -> Iterator[str]:
    about = selected.about
    yield (
        f"{shown} of {about['considered']} sets shown, by {', '.join(about['by'])}; error: expected root mean square "
        f"over the states' sizes, {_number(about['without_sensors'])} without sensors and "
        f"{_number(about['with_all_sensors'])} with all"
    )
    yield (
        f"noise of a sample over {about['period']:g} s, process noise {process_told(about['process'])}; "
        "above the best: trace over that of the best set of as many sensors"
    )
    for size in about["by_size"]:
        yield _size_told(size)
    yield from (f"failed: {point['why']}" for point in about["curve"] if point["status"] == "failed")
    yield from (f"{' '.join(row['sensors'])}: {row['why']}" for row in selected.rows[:shown] if row["why"])
    yield from (f"note: {note}" for note in about["notes"])


def _size_told(size: Mapping[str, Any]) -> str:
    """A line on the best set of a size: proof, greedy, safest."""
    head = f"{size['size']} sensor" + ("" if size["size"] == 1 else "s")
    if size["sensors"] is None:
        return f"{head}: no set is allowed and sees what does not die out"
    proof = size["proof"]
    proven = f"proven in {proof['branches']} branches"
    if not proof["proven"]:
        proven = f"not proven: {proof['branches']} branches leave {_percent(size['trace'] / proof['bound'] - 1.0)} open"
    told = [f"{head}: best {' '.join(size['sensors'])}, error {_number(size['error'])}, {proven}"]
    greedy, safest = size["greedy"], size["safest"]
    if greedy is not None:
        above = f"{_percent(greedy['gap'])} above" if greedy["gap"] else "the same"
        told.append(f"greedy {above}, at most {_percent(greedy['guaranteed_gap'])} without a search")
    if safest is not None:
        told.append(f"safest {' '.join(safest['sensors'])}, after a loss {_number(safest['error_after_loss'])}")
    return "; ".join(told)


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.4g}"


def _percent(value: float | None) -> str:
    return "-" if value is None else "0" if value == 0.0 else f"{100.0 * value:.3g} %"


_COLUMNS = ("cost", "error", "trace", "trace_T", "gap", "error_after_loss", "lost", "status")


def optimised_csv(selected: Optimised) -> str:
    """All sets as CSV, best first, SI units; sensors with blanks between, nothing where there is no number."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    wanted = selected.about["estimate"]
    writer.writerow(["sensors", *_COLUMNS, *(f"error_{name}" for name in wanted), "why"])
    for row in selected.sets():
        deviations = row["errors"] or {}
        cells = [*(row[column] for column in _COLUMNS), *(deviations.get(name) for name in wanted)]
        writer.writerow([" ".join(row["sensors"]), *cells, row["why"]])
    return buffer.getvalue()
