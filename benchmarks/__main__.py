"""`python -m benchmarks`: all measures in one run, as a table, in benchmarks/results.json and in docs/speed.md."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from benchmarks.comparison import Comparison
from benchmarks.growth import Growth
from benchmarks.long_run import LongRun
from benchmarks.measure import Measure
from benchmarks.optimal import SearchGrowth, draw_growth
from benchmarks.page import write_page
from benchmarks.periodic import Costs
from benchmarks.real_time import RealTime
from benchmarks.sections import Taken, measures_of, sections, take_apart

RESULTS = Path(__file__).parent / "results.json"
PAGE = Path(__file__).parents[1] / "docs" / "speed.md"
SEARCHES = PAGE.parent / "selection" / "growth.svg"


def write_results(measures: Sequence[Measure], path: Path) -> None:
    """One entry a measure: {name, ours, peer, peer_name, ratio, unit}; ratio = ours / peer.

    Times in s are those of one step, or of one set-up.
    """
    entries = [
        {"name": m.name, "ours": m.ours, "peer": m.peer, "peer_name": m.peer_name, "ratio": m.ratio, "unit": m.unit}
        for m in measures
    ]
    temporary = path.with_suffix(".tmp")
    temporary.write_text(json.dumps(entries, indent=1) + "\n", encoding="utf-8")
    os.replace(temporary, path)


def table(measures: Sequence[Measure]) -> Table:
    """The measures with their targets; times in microseconds, sizes in megabytes."""
    shown = Table("measure", "peer", "ours", "peer's", "ratio", "target", "", title="microseconds a step, or a set-up")
    for m in measures:
        scale, unit = (1e-6, " MB") if m.unit == "B" else (1e6, "")
        met = "" if m.target is None else "met" if m.ratio <= m.target else "missed"
        wanted = "" if m.target is None else f"<= {m.target:.4g}"
        values = (f"{m.ours * scale:.4f}{unit}", f"{m.peer * scale:.4f}{unit}", f"{m.ratio:.4f}", wanted, met)
        shown.add_row(m.name, m.peer_name, *values)
    return shown


def main(
    only: Annotated[list[str] | None, typer.Option(help="measure this alone; may be given several times")] = None,
    quick: Annotated[bool, typer.Option("--quick", help="a tenth of the rounds and of the longest runs")] = False,
) -> None:
    """Measure, print the table and write benchmarks/results.json; a full run writes docs/speed.md too."""
    scale = 10 if quick else 1
    known = sections(scale)
    for name in only or []:
        if name not in known:
            raise typer.BadParameter(f"no measure is named '{name}'; there are {', '.join(known)}")
    taken: dict[str, Taken] = {}
    failures: dict[str, RuntimeError] = {}
    for name in only or known:
        print(f"measuring {name}", flush=True)
        try:
            taken[name] = take_apart(name, scale)
        except RuntimeError as failure:  # the others are measured all the same
            failures[name] = failure
    measures = [measure for one in taken.values() for measure in measures_of(one)]
    Console(width=140).print(table(measures))
    comparisons = [one for one in taken.values() if isinstance(one, Comparison)]
    for compared in comparisons:
        for engine, reason in compared.absent.items():
            print(f"{compared.measures[0].name}: {engine} was not measured: {reason}")
    write_results(measures, RESULTS)
    print(f"written: {RESULTS}")
    for name, told in failures.items():
        print(f"{name} failed: {told}", file=sys.stderr)
    if failures:
        raise typer.Exit(1)
    if not only and not quick:
        growths = [one for one in taken.values() if isinstance(one, Growth)]
        long = next((one for one in taken.values() if isinstance(one, LongRun)), None)
        costs = next((one for one in taken.values() if isinstance(one, Costs)), None)
        kept = next((one for one in taken.values() if isinstance(one, RealTime)), None)
        write_page(PAGE, comparisons, growths, long, costs, kept)
        print(f"written: {PAGE}")
        for grown in (one for one in taken.values() if isinstance(one, SearchGrowth)):
            draw_growth(grown, SEARCHES)
            print(f"written: {SEARCHES}")


if __name__ == "__main__":
    typer.run(main)
