"""Runs of the exported crank-resolved plants by inputs in declared units, for their tests."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache

import numpy as np

from fmus.export import cached_fmu
from fmus.fmu import FmuComponent, load_fmu
from fmus.model import Model
from fmus.plants import gas_exchange
from fmus.units import parse_unit


def inputs(model: Model, values: Mapping[str, float]) -> np.ndarray:
    """Inputs in SI, those not named at their start values."""
    given = {signal.name: values.get(signal.name, float(signal.start)) for signal in model.inputs}
    return np.array([parse_unit(signal.unit).to_si(given[signal.name]) for signal in model.inputs])


class Run:
    """An exported plant that is stepped, its outputs by name in SI."""

    def __init__(self, model: Model, values: Mapping[str, float], fmi: int = 2, **starts: float) -> None:
        self.model = model
        self.component: FmuComponent = load_fmu(cached_fmu(model, fmi), starts=starts)
        self.names = [signal.name for signal in self.component.outputs]
        self.time, self.rows = 0.0, [self.component.start(0.0, inputs(model, values))]

    def on(self, values: Mapping[str, float], h: float, steps: int) -> Run:
        """Make steps of h [s] under held inputs; the rows are those of this stretch, the last one before it first."""
        u = inputs(self.model, values)
        self.rows = self.rows[-1:]
        for _ in range(steps):
            self.rows.append(self.component.step(self.time, h, u))
            self.time += h
        return self

    def __getitem__(self, name: str) -> np.ndarray:
        return np.array(self.rows)[:, self.names.index(name)]

    def close(self) -> None:
        self.component.close()


@cache
def settled(**values: float) -> dict[str, float]:
    """Outputs of `gas_exchange` after 2.5 s of held inputs, six of its time constants, at the end of a cycle."""
    cycle = 120.0 / values.get("N", 3200.0)
    run = Run(gas_exchange.MODEL, values).on(values, cycle, round(2.5 / cycle))
    last = dict(zip(run.names, run.rows[-1].tolist(), strict=True))
    run.close()
    return last
