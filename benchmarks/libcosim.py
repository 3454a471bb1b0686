"""libcosim as a peer: `python -m benchmarks.libcosim` steps a set-up in its C++ loop, and records time series."""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.serving import Recorded, Signal, Simulate, Stopwatch, Task, serve, signals

NANOSECONDS = 1_000_000_000


def load(recording: str) -> Simulate:
    """What simulates. Raises ImportError or OSError: libcosimpy, or a library that it wants, is missing."""
    from libcosimpy import CosimEnums, CosimExecution, CosimLogging, CosimManipulator, CosimObserver, CosimSlave

    CosimLogging.log_output_level(CosimLogging.CosimLogLevel.FATAL)
    kinds = {"real": CosimEnums.CosimVariableType.REAL, "integer": CosimEnums.CosimVariableType.INTEGER}

    def simulate(task: Task) -> tuple[float, Recorded]:
        step = round(task["step"] * NANOSECONDS)
        execution = CosimExecution.CosimExecution.from_step_size(step)
        # libcosimpy 0.0.6 keeps this function under one name and looks for it under another.
        execution._CosimExecution__connect_integer_variables = execution._CosimExecution__connect_int_variables
        slaves = {part: CosimSlave.CosimLocalSlave(path, part) for part, path in task["fmus"].items()}
        index = {part: execution.add_local_slave(slave) for part, slave in slaves.items()}
        for source, sink in ((Signal(*source), Signal(*sink)) for source, sink in task["wires"]):
            connect = {
                "real": execution.connect_real_variables,
                "integer": execution.connect_integer_variables,
                "boolean": execution.connect_boolean_variables,
            }[source.kind]
            connect(index[source.part], source.reference, index[sink.part], sink.reference)
        # Its time series hold reals and integers only.
        series = [(i, s) for i, s in enumerate(signals(task["recorded"])) if s.kind in kinds]
        if recording == "everything":
            observer = CosimObserver.CosimObserver.create_time_series(task["steps"] + 1)
            execution.add_observer(observer)
            for _, signal in series:
                observer.start_time_series(index[signal.part], signal.reference, kinds[signal.kind])
        _initially(execution, index, task)
        override = CosimManipulator.CosimManipulator.create_override()
        if task["driven"]:
            execution.add_manipulator(override)
        watch = Stopwatch()
        execution.simulate_until(task["half"] * step)
        _from_now_on(override, index, task)
        execution.simulate_until(task["steps"] * step)
        seconds = watch.seconds()
        rows = np.empty((0, len(series)))
        if recording == "everything":
            rows = np.column_stack([_samples(observer, index, signal, task["steps"]) for _, signal in series])
        return seconds / task["steps"], Recorded([i for i, _ in series], rows)

    return simulate


def _initially(execution: Any, index: dict[str, int], task: Task) -> None:
    for signal in signals(task["driven"]):
        where = (index[signal.part], signal.reference)
        if signal.kind == "real":
            execution.real_initial_value(*where, task["before"])
        elif signal.kind == "integer":
            execution.integer_initial_value(*where, int(task["before"]))
        else:
            execution.boolean_initial_value(*where, bool(task["before"]))


def _from_now_on(override: Any, index: dict[str, int], task: Task) -> None:
    for signal in signals(task["driven"]):
        where = (index[signal.part], [signal.reference])
        if signal.kind == "real":
            override.slave_real_values(*where, [task["after"]])
        elif signal.kind == "integer":
            override.slave_integer_values(*where, [int(task["after"])])
        else:
            override.slave_boolean_values(*where, [bool(task["after"])])


def _samples(observer: Any, index: dict[str, int], signal: Signal, steps: int) -> list[float]:
    read = observer.time_series_real_samples if signal.kind == "real" else observer.time_series_integer_samples
    _, _, values = read(index[signal.part], signal.reference, 1, steps)
    return [float(value) for value in values]


if __name__ == "__main__":
    serve(load)
