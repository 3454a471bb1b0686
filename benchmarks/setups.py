"""The systems that all engines step: FMUs, wires, what is driven from outside and what is recorded."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.direct import DirectFmu
from benchmarks.reference import optimised
from fmus.export import cached_fmu
from fmus.plants import driveline
from fmus.units import parse_unit
from observers import luenberger

RPM = parse_unit("rpm").factor
Rows = NDArray[np.float64]
# What FMPy's calls do with the FMUs: given the source's values, the step and the rows to fill.
FmpyLoop = Callable[[Sequence[DirectFmu], Sequence[float], float, Rows], None]


@dataclass(frozen=True)
class Setup:
    """One system in the words of each engine; variables are named `part.variable`.

    The `driven` inputs are at `before` in the first half of the steps and at `after` from there on. `parts` is the same
    system as a scenario of ours, all of whose signals are recorded: a part named `source` drives it. `recorded` are
    those of the rows' columns that are outputs of FMUs: the part named and its outputs that come in that order.
    `bare` is its loop in bare.c, given the step functions of the parts `natives`; `through_fmpy` makes the same steps
    with FMPy's calls.
    """

    name: str
    step: float  # s
    steps: int
    fmus: Mapping[str, Path]
    wires: tuple[tuple[str, str], ...]
    driven: tuple[str, ...]
    before: float
    after: float
    recorded: tuple[str, ...]
    parts: Mapping[str, Any]
    bare: str
    natives: tuple[str, ...]
    through_fmpy: FmpyLoop

    @property
    def half(self) -> int:
        """How many steps are made with the driven inputs at `before`."""
        return self.steps // 2

    def driving(self) -> list[float]:
        """The value of the driven inputs in each step."""
        return [self.before] * self.half + [self.after] * (self.steps - self.half)

    def direct(self) -> list[DirectFmu]:
        """The FMUs for direct calls, with their inputs, wired ones first, and the outputs that are recorded."""
        inputs = [*(sink for _, sink in self.wires), *self.driven]
        return [
            DirectFmu(path, variables_of(part, inputs), variables_of(part, self.recorded))
            for part, path in self.fmus.items()
        ]


def variables_of(part: str, names: Sequence[str]) -> list[str]:
    """The variables of one part among names like `part.variable`, without the part."""
    return [variable for owner, _, variable in (name.partition(".") for name in names) if owner == part]


def _jump(step: float, steps: int, before: str, after: str, unit: str) -> dict[str, Any]:
    """A source that has `after` from the middle step on; it jumps half a step earlier, where there is no instant."""
    at = (steps // 2 - 0.5) * step
    return {"use": "source", "unit": unit, "step": {"at": f"{at!r} s", "from": before, "to": after}}


ESTIMATES = ("theta_e", "omega_c", "omega_p")


def plant_and_observer(solver_steps: int, steps: int) -> Setup:
    """The driveline and its Luenberger observer, which measures the speed and knows the torque, at 1 kHz.

    The plant makes `solver_steps` RK4 steps a communication step.
    """
    step = 1e-3
    plant = cached_fmu(replace(driveline.MODEL, solver_step=step / solver_steps))
    observer = cached_fmu(luenberger.make("fmus.plants.driveline", location=2, delay=10e-3, dwell=0.1, rate=5.0))
    return Setup(
        name=f"plant and observer, {solver_steps} solver step{'s' * (solver_steps > 1)}",
        step=step,
        steps=steps,
        fmus={"plant": plant, "observer": observer},
        wires=(("plant.y", "observer.y"),),
        driven=("plant.T_eng", "observer.T_eng"),
        before=0.0,
        after=-10.0,
        recorded=tuple(
            f"{part}.{name}"
            for part, names in (("plant", (*ESTIMATES, "y", "location")), ("observer", (*ESTIMATES, "location")))
            for name in names
        ),
        parts={
            "source": _jump(step, steps, "0 N.m", "-10 N.m", "N.m"),
            "plant": {"use": str(plant), "wires": {"T_eng": "source"}},
            "encoder": {"use": "sensor", "of": "plant.y"},
            "observer": {"use": str(observer), "role": "observer", "wires": {"y": "encoder", "T_eng": "source"}},
        },
        bare="run_driveline",
        natives=("source", "encoder"),
        through_fmpy=_driveline_through_fmpy,
    )


def _driveline_through_fmpy(fmus: Sequence[DirectFmu], driving: Sequence[float], step: float, rows: Rows) -> None:
    plant, observer = fmus
    for k, torque in enumerate(driving):
        t = k * step
        plant.slave.setReal(plant.reals_in, [torque])
        plant.slave.doStep(t, step)
        theta_e, omega_c, omega_p, y = plant.slave.getReal(plant.reals)
        (location,) = plant.slave.getInteger(plant.integers)
        y = RPM * y
        observer.slave.setReal(observer.reals_in, [y / RPM, torque])
        observer.slave.doStep(t, step)
        estimates = observer.slave.getReal(observer.reals)
        (found,) = observer.slave.getInteger(observer.integers)
        rows[k] = (k + 1) * step, torque, theta_e, omega_c, omega_p, y, location, y, *estimates, found


def oscillator(steps: int) -> Setup:
    """The Reference FMU of van der Pol's oscillator alone, at its own solver step of 10 ms: a loop and little else."""
    path = optimised("VanDerPol")
    return Setup(
        name="Van der Pol",
        step=1e-2,
        steps=steps,
        fmus={"oscillator": path},
        wires=(),
        driven=(),
        before=0.0,
        after=0.0,
        recorded=("oscillator.x0", "oscillator.x1"),
        parts={"oscillator": {"use": str(path)}},
        bare="run_oscillator",
        natives=(),
        through_fmpy=_oscillator_through_fmpy,
    )


def _oscillator_through_fmpy(fmus: Sequence[DirectFmu], driving: Sequence[float], step: float, rows: Rows) -> None:
    (fmu,) = fmus
    for k in range(len(driving)):
        fmu.slave.doStep(k * step, step)
        rows[k] = (k + 1) * step, *fmu.slave.getReal(fmu.reals)


CHANNELS = ("Float64_continuous", "Float64_discrete", "Int32", "Boolean")


def feedthroughs(steps: int) -> Setup:
    """Two Reference FMUs named Feedthrough: the two reals, the integer and the boolean of one enter the other."""
    step = 0.1
    path = optimised("Feedthrough")
    return Setup(
        name="two Feedthrough",
        step=step,
        steps=steps,
        fmus={"first": path, "second": path},
        wires=tuple((f"first.{name}_output", f"second.{name}_input") for name in CHANNELS),
        driven=tuple(f"first.{name}_input" for name in CHANNELS),
        before=1.0,
        after=2.0,
        recorded=tuple(f"{part}.{name}_output" for part in ("first", "second") for name in CHANNELS),
        parts={
            "source": _jump(step, steps, "1", "2", "1"),
            "first": {"use": str(path), "wires": {f"{name}_input": "source" for name in CHANNELS}},
            "second": {"use": str(path), "wires": {f"{name}_input": f"first.{name}_output" for name in CHANNELS}},
        },
        bare="run_feedthroughs",
        natives=("source",),
        through_fmpy=_feedthroughs_through_fmpy,
    )


def _feedthroughs_through_fmpy(fmus: Sequence[DirectFmu], driving: Sequence[float], step: float, rows: Rows) -> None:
    first, second = fmus
    for k, value in enumerate(driving):
        t = k * step
        first.slave.setReal(first.reals_in, [value, value])
        first.slave.setInteger(first.integers_in, [int(value)])
        first.slave.setBoolean(first.booleans_in, [value != 0.0])
        first.slave.doStep(t, step)
        reals, integers = first.slave.getReal(first.reals), first.slave.getInteger(first.integers)
        booleans = first.slave.getBoolean(first.booleans)
        second.slave.setReal(second.reals_in, reals)
        second.slave.setInteger(second.integers_in, integers)
        second.slave.setBoolean(second.booleans_in, booleans)
        second.slave.doStep(t, step)
        rows[k] = (
            (k + 1) * step,
            value,
            *reals,
            *integers,
            *booleans,
            *second.slave.getReal(second.reals),
            *second.slave.getInteger(second.integers),
            *second.slave.getBoolean(second.booleans),
        )
