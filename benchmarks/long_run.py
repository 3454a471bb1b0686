"""A campaign of ten million steps from end to end: its peak of memory, its time and the size of its record."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

import pyarrow.parquet as pq

from benchmarks.measure import Measure

STEP = 1e-3  # s
STEPS = 10_000_000
LIMIT = 500e6  # bytes that one process may take at its peak
# The torque swings through the gap of the driveline every two seconds, so that all locations come and no signal rests.
CAMPAIGN = """\
campaign: long
clock: {{time: {{step: 1 ms, stop: {stop!r} s}}}}
limits: {{case: 2 h}}
parts:
  torque: {{use: source, unit: N.m, sine: {{amplitude: 12 N.m, frequency: 0.5 Hz, mean: -6 N.m}}}}
  plant: {{use: fmus.plants.driveline, wires: {{T_eng: torque}}}}
  encoder: {{use: sensor, of: plant.y, noise: {{std: 0.05 rpm}}}}
  observer:
    use: observers.luenberger
    with: {{plant: fmus.plants.driveline, location: 2, delay: 10 ms, dwell: 100 ms, rate: 5 1/s}}
    wires: {{T_eng: torque, y: encoder}}
metrics:
  torsion: {{rmse: [plant.theta_e, observer.theta_e], after: 0.5 s, unit: mrad}}
"""


class LongRun(NamedTuple):
    """Steps and seconds of the whole command, bytes of memory at its peak, bytes and columns of signals.parquet."""

    steps: int
    seconds: float
    largest: int
    together: int
    record: int
    columns: int

    def measure(self) -> Measure:
        """The peak of the largest process beside what it may be."""
        return Measure(f"{self.steps} steps, peak memory", self.largest, LIMIT, "limit", 1.0, "B")


def measures_memory() -> bool:
    """Whether this system tells the peak of a process at its end, as POSIX systems do."""
    return hasattr(os, "wait4")


def long_run(steps: int = STEPS) -> LongRun:
    """`crankbench run` of one case with everything recorded, by a process that looks on.

    Raises RuntimeError: the command failed, or its case did not run to its end.
    """
    with tempfile.TemporaryDirectory() as folder:
        campaign, out = Path(folder) / "long.yaml", Path(folder) / "out"
        campaign.write_text(CAMPAIGN.format(stop=steps * STEP), encoding="utf-8")
        command = [sys.executable, "-m", "harness", "run", str(campaign), "--out", str(out), "--jobs", "1"]
        looked_on = [sys.executable, "-m", "benchmarks.peak", *command]
        ended = subprocess.run(looked_on, capture_output=True, text=True, check=False)
        if ended.returncode:
            raise RuntimeError(f"benchmarks.peak ended with {ended.returncode}:\n{ended.stderr[-2000:]}")
        seen = json.loads(ended.stdout.splitlines()[-1])
        if seen["code"]:
            raise RuntimeError(f"crankbench run ended with {seen['code']}:\n{ended.stderr[-2000:]}")
        (table,) = out.glob("cases/*/signals.parquet")
        return LongRun(
            steps, seen["seconds"], seen["largest"], seen["together"], table.stat().st_size, _complete(table, steps)
        )


def _complete(table: Path, steps: int) -> int:
    """The number of columns. Raises RuntimeError: there are not as many rows as instants."""
    metadata = pq.read_metadata(table)
    if metadata.num_rows != steps + 1:
        raise RuntimeError(f"{table.name} wants {steps + 1} rows, got {metadata.num_rows}")
    return int(metadata.num_columns)
