"""A peer in a process of its own, from inside: a set-up comes in as JSON, times and rows go out.

It imports nothing of the platform, so that a peer is up in no time.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypedDict

import numpy as np
from numpy.typing import NDArray


class Signal(NamedTuple):
    """A variable of an FMU: `real`, `integer` or `boolean`, and its value reference."""

    part: str
    variable: str
    kind: str
    reference: int


class Task(TypedDict):
    """A set-up as it is told to the process."""

    step: float
    steps: int
    half: int
    fmus: dict[str, str]
    wires: list[tuple[Signal, Signal]]
    driven: list[Signal]
    before: float
    after: float
    recorded: list[Signal]


class Recorded(NamedTuple):
    """The last rows of a run, of those signals whose places among the recorded ones are given."""

    places: list[int]
    rows: NDArray[np.float64]


Simulate = Callable[[Task], tuple[float, Recorded]]


def serve(load: Callable[[str], Simulate]) -> None:
    """Answer on standard output, which the engine's own messages are kept from, until standard input ends.

    `load(recording)` gives what simulates a task, times its steps, and tells what is known of them.
    """
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    recording, cores = sys.argv[1:]
    if cores:
        os.sched_setaffinity(0, [int(core) for core in cores.split(",")])

    def answer(**content: Any) -> None:
        answers.write(json.dumps(content) + "\n")
        answers.flush()

    task: Task = json.loads(sys.stdin.readline())
    try:
        simulate = load(recording)
    except (ImportError, OSError) as error:
        answer(unavailable=str(error))
        return
    answer()
    for line in sys.stdin:
        asked, _, path = line.strip().partition(" ")
        seconds, recorded = simulate(task)
        if asked == "rows":
            np.save(path, recorded.rows)
        answer(seconds=seconds, places=recorded.places)


class Stopwatch:
    """Runs from when it is made."""

    def __init__(self) -> None:
        self._wall, self._processor = time.perf_counter(), time.process_time()

    def seconds(self) -> float:
        """The lesser of wall time and processor time: neither what else runs nor threads side by side count twice."""
        wall, processor = time.perf_counter(), time.process_time()
        return min(wall - self._wall, processor - self._processor)


def signals(listed: Sequence[Sequence[Any]]) -> list[Signal]:
    """Signals of a task as they came through the pipe."""
    return [Signal(*entry) for entry in listed]
