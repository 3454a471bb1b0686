"""What an engine ought to record that steps all FMUs first and passes their outputs on afterwards, by FMPy's calls."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks.setups import Setup


class Jacobi(NamedTuple):
    """Rows of the recorded outputs, in the FMUs' own units: as the steps left them, and got again after the passing.

    An output that depends directly on an input shows what was passed in the second, and only a step later in the first.
    """

    stepped: NDArray[np.float64]
    passed: NDArray[np.float64]


def jacobi(setup: Setup) -> Jacobi:
    """The rows of a set-up in that order: every wire holds its value for one step."""
    fmus = dict(zip(setup.fmus, (fmu.start(setup.before) for fmu in setup.direct()), strict=True))

    def variable(name: str) -> tuple[Callable[[], Any], Callable[[float], None]]:
        part, _, own = name.partition(".")
        slave, described = fmus[part].slave, fmus[part].variables[own]
        kind, references = described.type, [described.valueReference]
        if kind == "Real":
            return lambda: slave.getReal(references)[0], lambda value: slave.setReal(references, [value])
        if kind == "Boolean":
            return lambda: slave.getBoolean(references)[0], lambda value: slave.setBoolean(references, [bool(value)])
        return lambda: slave.getInteger(references)[0], lambda value: slave.setInteger(references, [int(value)])

    driven = [variable(name)[1] for name in setup.driven]
    wires = [(variable(source)[0], variable(sink)[1]) for source, sink in setup.wires]
    recorded = [variable(name)[0] for name in setup.recorded]
    rows = Jacobi(*(np.empty((setup.steps, len(recorded))) for _ in range(2)))
    for k, value in enumerate(setup.driving()):
        for drive in driven:
            drive(value)
        for fmu in fmus.values():
            fmu.slave.doStep(k * setup.step, setup.step)
        rows.stepped[k] = [get() for get in recorded]
        for value_of, put in [(get(), put) for get, put in wires]:
            put(value_of)
        rows.passed[k] = [get() for get in recorded]
    for fmu in fmus.values():
        fmu.close()
    return rows
