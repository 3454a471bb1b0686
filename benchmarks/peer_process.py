"""An engine in a process of its own: what it is told and what it answers, for both sides."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Self, TypedDict

import numpy as np
from numpy.typing import NDArray

from benchmarks.setups import Setup
from fmus.description import describe


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


class Unavailable(Exception):
    """Why an engine cannot be measured here."""


Simulate = Callable[[Task], tuple[float, Recorded]]


class PeerProcess:
    """A module that answers by `serve`, run in a process of its own; each call returns the seconds that a step took.

    It records all that it can where `recording` is `everything`. `cores` are those it may use, all where empty.

    Raises Unavailable: it cannot run here.
    """

    def __init__(self, module: str, setup: Setup, recording: str, cores: Sequence[int] = ()) -> None:
        self._errors = tempfile.TemporaryFile("w+")
        command = [sys.executable, "-m", module, recording, ",".join(map(str, cores))]
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._errors, text=True
        )
        answer = self._ask(json.dumps(_task(setup)))
        if "unavailable" in answer:
            self.close()
            raise Unavailable(answer["unavailable"])

    def __call__(self) -> float:
        """The steps alone, from the first instant to the last; the simulation was made and initialised before."""
        return float(self._ask("time")["seconds"])

    def recorded(self) -> Recorded:
        """What is known of one more run, in the FMUs' own units."""
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "rows.npy"
            answer = self._ask(f"rows {path}")
            return Recorded(answer["places"], np.load(path))

    def close(self) -> None:
        """End the process."""
        self._process.communicate()
        self._errors.close()

    def _ask(self, text: str) -> Any:
        assert self._process.stdin is not None and self._process.stdout is not None
        try:
            self._process.stdin.write(text + "\n")
            self._process.stdin.flush()
            answer = self._process.stdout.readline()
        except BrokenPipeError:
            answer = ""
        if not answer:
            code = self._process.wait()
            self._errors.seek(0)
            raise RuntimeError(f"{self._process.args} ended with {code}:\n{self._errors.read()[-2000:]}")
        return json.loads(answer)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


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


def signals(listed: Sequence[Sequence[Any]]) -> list[Signal]:
    """Signals of a task as they came through the pipe."""
    return [Signal(*entry) for entry in listed]


def _task(setup: Setup) -> Task:
    descriptions = {part: describe(path) for part, path in setup.fmus.items()}

    def signal(name: str) -> Signal:
        part, _, variable = name.partition(".")
        found = next(entry for entry in descriptions[part].variables if entry.name == variable)
        return Signal(part, variable, found.kind, found.reference)

    return Task(
        step=setup.step,
        steps=setup.steps,
        half=setup.half,
        fmus={part: str(path) for part, path in setup.fmus.items()},
        wires=[(signal(source), signal(sink)) for source, sink in setup.wires],
        driven=[signal(name) for name in setup.driven],
        before=setup.before,
        after=setup.after,
        recorded=[signal(name) for name in setup.recorded],
    )
