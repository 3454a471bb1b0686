"""The exhaust plant on a crank whose speed is held: an FMU stepped by crank angle, and harmonics of what it shows."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np

from fmus.export import cached_fmu
from fmus.fmu import load_fmu
from fmus.model import Model
from fmus.plants.exhaust_afr import MODEL, PARAMETERS

MASS, T_EXH = 6e-4, 800.0


class Course(NamedTuple):
    """Speed [rpm], step [deg], cycles, and where in a step the angle held is that of: 0 its beginning, 1 its end."""

    N: float
    step: float = 6.0
    cycles: int = 100
    held: float = 0.5

    @property
    def omega(self) -> float:
        """Speed [rad/s]."""
        return self.N * np.pi / 30.0

    @property
    def per_cycle(self) -> int:
        """Steps in a cycle."""
        return round(720.0 / self.step)


def parameters(**changed: float) -> SimpleNamespace:
    """The plant's parameters by name."""
    return SimpleNamespace(**{signal.name: float(signal.start) for signal in PARAMETERS} | changed)


def run(
    course: Course,
    afr: Sequence[float] | Callable[[int], Sequence[float]],
    m_exh: Sequence[float] | Callable[[int], Sequence[float]] = (MASS,) * 4,
    starts: Mapping[str, float] | None = None,
    model: Model = MODEL,
) -> dict[str, np.ndarray]:
    """Every output by name at each step; AFRs and masses are constant, or functions of the cycle from 0."""
    step, n = np.radians(course.step), course.per_cycle

    def inputs(k: int) -> np.ndarray:
        ratios, masses = (value(k // n) if callable(value) else value for value in (afr, m_exh))
        return np.array([(k + course.held) * step, course.omega, *ratios, *masses, T_EXH])

    component = load_fmu(cached_fmu(model), starts=dict(starts or {}))
    names, h = [signal.name for signal in component.outputs], step / course.omega
    try:
        rows = [component.start(0.0, inputs(0))]
        rows += [component.step(k * h, h, inputs(k)) for k in range(n * course.cycles)]
    finally:
        component.close()
    return dict(zip(names, np.array(rows).T, strict=True))


def harmonic(signal: np.ndarray, per_cycle: int, k: int) -> complex:
    """The coefficient of exp(i k theta/2) over the last cycle of a run that is whole cycles long."""
    theta = np.arange(1 - per_cycle, 1) * 4.0 * np.pi / per_cycle
    return complex(np.mean(signal[-per_cycle:] * np.exp(-0.5j * k * theta)))
