"""A peer in a process of its own, as seen from outside: it is told a set-up, timed and asked for its rows."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Self

import numpy as np

from benchmarks.serving import Recorded, Signal, Task
from benchmarks.setups import Setup
from fmus.description import describe


class Unavailable(Exception):
    """Why an engine cannot be measured here."""


class PeerProcess:
    """A module that answers by `serve`, run in a process of its own; each call returns the seconds that a step took.

    It records all that it can where `recording` is `everything`. `cores` are those it may use, all where empty.

    Raises Unavailable: it cannot run here.
    """

    def __init__(self, module: str, setup: Setup, recording: str, cores: Sequence[int] = ()) -> None:
        self._module = module
        self._errors = tempfile.TemporaryFile("w+")  # noqa: SIM115 - closed by close
        command = [sys.executable, "-m", module, recording, ",".join(map(str, cores))]
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._errors, text=True
        )
        answer = self._ask(json.dumps(task_of(setup)))
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
            raise RuntimeError(f"{self._module} ended with {code}:\n{self._errors.read()[-2000:]}")
        return json.loads(answer)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def task_of(setup: Setup) -> Task:
    """What a process is told of a set-up."""
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
