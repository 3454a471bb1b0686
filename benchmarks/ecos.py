"""ecos as a peer: `python -m benchmarks.ecos` steps a set-up in its own C++ loop, and writes CSV where it records."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.serving import Recorded, Signal, Simulate, Stopwatch, Task, serve, signals


def load(recording: str) -> Simulate:
    """What simulates. Raises ImportError or OSError: ecospy, or a library of the system that it wants, is missing."""
    import ecospy

    ecospy.EcosLib.set_log_level("warn")
    return lambda task: _simulate(ecospy, task, recording)


def _simulate(ecospy: Any, task: Task, recording: str) -> tuple[float, Recorded]:
    recorded = signals(task["recorded"])
    with ecospy.EcosSimulationStructure() as structure, tempfile.TemporaryDirectory() as folder:
        for part, path in task["fmus"].items():
            structure.add_model(part, path)
        for source, sink in task["wires"]:
            connect = {
                "real": structure.make_real_connection,
                "integer": structure.make_int_connection,
                "boolean": structure.make_bool_connection,
            }[source[2]]
            connect(_name(Signal(*source)), _name(Signal(*sink)))
        with ecospy.EcosSimulation(structure=structure, step_size=task["step"]) as simulation:
            table = Path(folder) / "rows.csv"
            if recording == "everything":
                simulation.add_csv_writer(str(table), identifiers=[_name(signal) for signal in recorded])
            simulation.init(0)
            _drive(simulation, task, task["before"])
            watch = Stopwatch()
            simulation.step(task["half"])
            _drive(simulation, task, task["after"])
            simulation.step(task["steps"] - task["half"])
            seconds = watch.seconds()
            last = [_value(simulation, signal) for signal in recorded]
            simulation.terminate()
        rows = _read(table, recorded) if recording == "everything" else np.array([last])
    return seconds / task["steps"], Recorded(list(range(len(recorded))), rows)


def _name(signal: Signal) -> str:
    return f"{signal.part}::{signal.variable}"


def _drive(simulation: Any, task: Task, value: float) -> None:
    for signal in signals(task["driven"]):
        if signal.kind == "real":
            simulation.set_real(_name(signal), value)
        elif signal.kind == "integer":
            simulation.set_integer(_name(signal), int(value))
        else:
            simulation.set_bool(_name(signal), bool(value))


def _value(simulation: Any, signal: Signal) -> float:
    get = {"real": simulation.get_real, "integer": simulation.get_integer, "boolean": simulation.get_bool}[signal.kind]
    return float(get(_name(signal)))


def _read(table: Path, recorded: list[Signal]) -> np.ndarray:
    """The rows after the first, which is the initialised one, in the order that the signals are recorded in."""
    lines = table.read_text().splitlines()
    columns = [title.partition("[")[0] for title in lines[0].split(", ")]
    values = np.array([[float(text) for text in line.split(", ")] for line in lines[2:]])
    return values[:, [columns.index(_name(signal)) for signal in recorded]]


if __name__ == "__main__":
    serve(load)
