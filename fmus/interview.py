"""How an FMU is questioned: which steps it is asked to make with which inputs, and what an answer is."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np

from fmus.component import Component, Vector
from fmus.description import FmuDescription, FmuKind, Validation, describe
from fmus.units import parse_unit

STEPS = 50
EXCITATION = 0.01  # of an input's start value, or of its nominal value where that is larger


@dataclass(frozen=True)
class Subject:
    """The FMU in question: where it is, and how it is stepped: from t0 [s], `steps` steps of h [s]."""

    path: Path
    t0: float
    h: float
    steps: int = STEPS
    validation: Validation = "warn"
    kind: FmuKind | None = None


class Answer(NamedTuple):
    """What a probe found: passed, failed or not applicable (None), and the evidence; `kept` is for a later probe."""

    passed: bool | None
    evidence: str
    kept: bytes = b""


def subject(path: Path, validation: Validation = "warn", kind: FmuKind | None = None) -> Subject:
    """The FMU with the step of its default experiment: its step size, else a 500th of its length, else 1 ms.

    It is run in the `kind` asked for, else in the one it is run in anyway.
    """
    return Subject(path, *usual_steps(describe(path, validation)), validation, kind)


def usual_steps(description: FmuDescription) -> tuple[float, float, int]:
    """Where its default experiment begins [s], the step [s] that `subject` says, and how many are made."""
    found = ElementTree.parse(description.folder / "modelDescription.xml").getroot().find("DefaultExperiment")
    asked = {} if found is None else {name: float(found.get(name) or 0.0) for name in ("startTime", "stopTime")}
    t0 = asked.get("startTime", 0.0)
    fixed = description.capabilities.get("fixedInternalStepSize")
    span = asked.get("stopTime", 0.0) - t0
    sizes = [0.0 if found is None else float(found.get("stepSize") or 0.0), float(fixed or 0.0), span / 500.0, 1e-3]
    h = next(size for size in sizes if size > 0.0)
    # The second half of a default experiment is left alone: there are FMUs that end before its end.
    steps = STEPS if span <= 0.0 else max(4, min(STEPS, int(span / (2.0 * h))))
    return t0, h, steps


def inputs_at(component: Component, k: int) -> Vector:
    """Inputs at step k: start values, the real ones with a small oscillation inside their range."""
    u = np.array([float(np.asarray(signal.start)) for signal in component.inputs])
    for i, signal in enumerate(component.inputs):
        if signal.kind == "real":
            swing = EXCITATION * max(abs(u[i]), abs(signal.nominal)) * np.sin(0.7 * k + i)
            u[i] = min(max(u[i] + swing, min(u[i], signal.minimum)), max(u[i], signal.maximum))
    return _si(component, u)


def _si(component: Component, u: Vector) -> Vector:
    return np.array([parse_unit(s.unit).to_si(v) for s, v in zip(component.inputs, u, strict=True)], dtype=float)


def course(component: Component, asked: Subject) -> Vector:
    """The outputs at the start and after each step, shape (steps + 1, outputs)."""
    return go_on(component, asked, component.start(asked.t0, inputs_at(component, 0)))


def go_on(component: Component, asked: Subject, first: Vector) -> Vector:
    """As `course`, of a component started already, whose first outputs are these."""
    steps = (component.step(asked.t0 + k * asked.h, asked.h, inputs_at(component, k)) for k in range(asked.steps))
    return np.array([first, *steps])


def same(component: Component, first: Vector, second: Vector, what: str) -> Answer:
    """Whether two trajectories have the same bytes; where not, the first difference and the largest."""
    if first.tobytes() == second.tobytes():
        return Answer(True, f"{what} agree bit for bit")
    different = np.argwhere(first.view(np.uint64) != second.view(np.uint64))
    k, column = different[0]
    largest = np.nanmax(np.abs(first - second) / spans(component, first))
    name = component.outputs[column].name if column < len(component.outputs) else "a state"
    told = f"{what} differ: {name} {first[k, column]:.17g} and {second[k, column]:.17g}"
    return Answer(False, f"{told}, at most {largest:.1e} of what the outputs span")


def spans(component: Component, rows: Vector) -> Vector:
    """What each output spans over a run, or a billionth of its nominal value where that is larger."""
    nominal = np.array([abs(signal.nominal * parse_unit(signal.unit).factor) for signal in component.outputs])
    spanned = np.ptp(np.nan_to_num(rows), axis=0)
    spanned[: len(nominal)] = np.maximum(spanned[: len(nominal)], 1e-9 * nominal)
    return spanned + 1e-300
