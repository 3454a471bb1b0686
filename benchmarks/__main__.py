"""`python -m benchmarks`: all measures in one run, as a table and in benchmarks/results.json."""

from __future__ import annotations

import json
import os
from pathlib import Path

from rich.console import Console
from rich.table import Table

from benchmarks.exported import beside_handwritten_c, beside_pythonfmu
from benchmarks.loop import beside_bare_c, beside_fmpy
from benchmarks.measure import Measure
from benchmarks.setup_time import beside_simulate_fmu

RESULTS = Path(__file__).parent / "results.json"
MEASURES = (beside_handwritten_c, beside_pythonfmu, beside_bare_c, beside_fmpy, beside_simulate_fmu)


def write_results(measures: list[Measure], path: Path) -> None:
    """One entry a measure: {name, ours, peer, peer_name, ratio, unit}; times in s, ratio = ours / peer.

    Times are those of one step, or of one set-up.
    """
    entries = [
        {"name": m.name, "ours": m.ours, "peer": m.peer, "peer_name": m.peer_name, "ratio": m.ratio, "unit": "s"}
        for m in measures
    ]
    temporary = path.with_suffix(".tmp")
    temporary.write_text(json.dumps(entries, indent=1) + "\n", encoding="utf-8")
    os.replace(temporary, path)


def table(measures: list[Measure]) -> Table:
    """The measures with their targets, in microseconds a step or a set-up."""
    shown = Table("measure", "peer", "ours", "peer's", "ratio", "target", "", title="microseconds a step, or a set-up")
    for m in measures:
        times = (f"{m.ours * 1e6:.4f}", f"{m.peer * 1e6:.4f}")
        met = "met" if m.ratio <= m.target else "missed"
        shown.add_row(m.name, m.peer_name, *times, f"{m.ratio:.4f}", f"<= {m.target:.4g}", met)
    return shown


def main() -> None:
    """Take all measures, print the table, write the results."""
    measures = [measure() for measure in MEASURES]
    Console(width=120).print(table(measures))
    write_results(measures, RESULTS)
    print(f"written: {RESULTS}")


if __name__ == "__main__":
    main()
