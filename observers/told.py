"""What a filter tells beside its estimate: standard deviations, innovations, covariances, each in its unit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fmus.component import Signal
from fmus.units import difference_unit, product_unit
from observers.given import Given

Array = NDArray[np.float64]
INNOVATION_COVARIANCE = "innovation_covariance"


def deviation_signals(given: Given, start: Array, prefix: str = "std_") -> list[Signal]:
    """`std_` + state for each state of the plant; `start` (n,) in the states' units."""
    starts = by_signal(start, given.plant_states)
    return [
        replace(
            signal,
            name=f"{prefix}{signal.name}",
            unit=difference_unit(signal.unit),
            start=starts[signal.name],
            minimum=0.0,
            maximum=np.inf,
            description=f"standard deviation of {signal.name}",
            local=False,
        )
        for signal in given.plant_states
    ]


def innovation_signals(given: Given, start: Array) -> list[Signal]:
    """`innovation_` + sensor, `nis`, and the elements of `innovation_covariance`, which is `start` (m, m) at first."""
    units = [difference_unit(signal.unit) for signal in given.measured]
    return [
        *(
            Signal(f"innovation_{name}", unit, 0.0, f"{name}, measured less expected")
            for name, unit in zip(given.sensors, units, strict=True)
        ),
        Signal("nis", "1", 0.0, "innovation squared, normalised by its covariance"),
        *matrix_signals(INNOVATION_COVARIANCE, units, start),
    ]


def matrix_signals(name: str, units: Sequence[str], start: Array) -> list[Signal]:
    """A scalar `name[i,j]` for each element, row-major, since each has a unit of its own."""
    return [
        Signal(f"{name}[{i + 1},{j + 1}]", product_unit(units[i], units[j]), float(start[i, j]))
        for i, j in np.ndindex(*start.shape)
    ]


def matrix_values(name: str, matrix: Any) -> dict[str, Any]:
    """The values of `matrix_signals` by name, of floats or symbols; `matrix` is a sequence of rows."""
    return {
        f"{name}[{i},{j}]": element for i, row in enumerate(matrix, start=1) for j, element in enumerate(row, start=1)
    }


def by_signal(flat: Any, signals: Sequence[Signal], prefix: str = "") -> dict[str, Any]:
    """Scalars, floats or symbols, in the signals' order and as arrays where these have a shape; by name."""
    found: dict[str, Any] = {}
    place = 0
    for signal in signals:
        scalars = np.empty(signal.size, dtype=object)
        scalars[:] = list(flat[place : place + signal.size])
        found[prefix + signal.name] = scalars.reshape(signal.shape) if signal.shape else scalars[0]
        place += signal.size
    return found


def scalars(values: Any, signals: Sequence[Signal]) -> list[Any]:
    """The scalars of signals, floats or symbols, from values by name, in the signals' order."""
    return [v for signal in signals for v in np.ravel(np.asarray(values[signal.name], dtype=object))]


def place_of(signals: Sequence[Signal], name: str) -> int:
    """Where the first scalar of a signal stands among those of all."""
    place = 0
    for signal in signals:
        if signal.name == name:
            return place
        place += signal.size
    raise KeyError(name)
