"""FMUs stepped side by side by FMPy: every input holds for a step what was there at its begin, whatever the order.

That is what SSP importers do that know no order. Times are k h, inputs and outputs in the FMUs' own units.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Wire = tuple[str, str, str, str]


class _Slave:
    """One FMU of FMI 2.0, its variables by name."""

    def __init__(self, name: str, path: Path, starts: Mapping[str, float]) -> None:
        from fmpy import extract, read_model_description
        from fmpy.fmi2 import FMU2Slave

        read = read_model_description(str(path), validate=False)
        self.types = {one.name: (one.type, one.valueReference) for one in read.modelVariables}
        self.fmu = FMU2Slave(
            guid=read.guid,
            unzipDirectory=extract(str(path)),
            modelIdentifier=read.coSimulation.modelIdentifier,
            instanceName=name,
        )
        self.fmu.instantiate()
        self.fmu.setupExperiment(startTime=0.0)
        for one, value in starts.items():
            self.put(one, value)
        self.fmu.enterInitializationMode()

    def put(self, name: str, value: float) -> None:
        kind, reference = self.types[name]
        setters: dict[str, Any] = {"Real": (self.fmu.setReal, float), "Boolean": (self.fmu.setBoolean, bool)}
        setter, convert = setters.get(kind, (self.fmu.setInteger, int))
        setter([reference], [convert(value)])

    def get(self, name: str) -> float:
        kind, reference = self.types[name]
        getters: dict[str, Any] = {"Real": self.fmu.getReal, "Boolean": self.fmu.getBoolean}
        return float(getters.get(kind, self.fmu.getInteger)([reference])[0])


def side_by_side(
    fmus: Mapping[str, Path],
    wires: Sequence[Wire],
    step: float,
    steps: int,
    starts: Mapping[str, Mapping[str, float]] | None = None,
    watched: Sequence[tuple[str, str]] = (),
) -> dict[str, NDArray[np.float64]]:
    """What each wired or watched output was at 0, h, 2 h, ... by `part.output`; wires are (part, output, part, input).

    At the initialisation a wired input is 0.
    """
    slaves = {name: _Slave(name, path, (starts or {}).get(name, {})) for name, path in fmus.items()}
    for _, _, part, name in wires:
        slaves[part].put(name, 0.0)
    for slave in slaves.values():
        slave.fmu.exitInitializationMode()
    outputs = sorted({(part, name) for part, name, _, _ in wires} | set(watched))
    rows = [[slaves[part].get(name) for part, name in outputs]]
    for k in range(steps):
        now = dict(zip(outputs, rows[-1], strict=True))
        for source, output, part, name in wires:
            slaves[part].put(name, now[source, output])
        for slave in slaves.values():
            slave.fmu.doStep(currentCommunicationPoint=k * step, communicationStepSize=step)
        rows.append([slaves[part].get(name) for part, name in outputs])
    for slave in slaves.values():
        slave.fmu.terminate()
        slave.fmu.freeInstance()
    return {f"{part}.{name}": np.array(rows)[:, j] for j, (part, name) in enumerate(outputs)}
