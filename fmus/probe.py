"""Questions put to an FMU: what it does when it is reset, taken back, stepped unevenly, whatever its flags say.

Each probe works on a component of its own and may crash or hang with it: run it where that does no harm.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np

from fmus.component import StepError, Vector
from fmus.derivatives import TOLERANCE, TRANSPOSED, Questioned, compare, pairs
from fmus.description import FmuKind, Validation, describe
from fmus.fmu import FmuComponent, load_fmu
from fmus.state import Bookmark
from fmus.units import parse_unit

STEPS = 50
EXCITATION = 0.01  # of an input's start value, or of its nominal value where that is larger
NO_PAIRS = "there is no continuous output or state derivative with a continuous input or state to derive it by"
NOT_IN_FMI1 = "there is no such thing in FMI 1.0"
# Of what the outputs span: half steps that lead as far away, and one by one to the same places, have no length of
# their own. A trajectory that an FMU makes from the same inputs by the same steps is the same to rounding.
HALVES_MATTER, SAME = 0.05, 1e-9


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
    description = describe(path, validation)
    found = ElementTree.parse(description.folder / "modelDescription.xml").getroot().find("DefaultExperiment")
    asked = {} if found is None else {name: float(found.get(name) or 0.0) for name in ("startTime", "stopTime")}
    t0 = asked.get("startTime", 0.0)
    fixed = description.capabilities.get("fixedInternalStepSize")
    span = asked.get("stopTime", 0.0) - t0
    sizes = [0.0 if found is None else float(found.get("stepSize") or 0.0), float(fixed or 0.0), span / 500.0, 1e-3]
    h = next(size for size in sizes if size > 0.0)
    # The second half of a default experiment is left alone: there are FMUs that end before its end.
    steps = STEPS if span <= 0.0 else max(4, min(STEPS, int(span / (2.0 * h))))
    return Subject(path, t0, h, steps, validation, kind)


@contextmanager
def _loaded(asked: Subject, name: str = "probed") -> Iterator[FmuComponent]:
    component = load_fmu(asked.path, name=name, validation=asked.validation, kind=asked.kind)
    try:
        yield component
    finally:
        component.close()


def _inputs(component: FmuComponent, k: int) -> Vector:
    """Inputs at step k: start values, the real ones with a small oscillation inside their range."""
    u = np.array([float(np.asarray(signal.start)) for signal in component.inputs])
    for i, signal in enumerate(component.inputs):
        if signal.kind == "real":
            swing = EXCITATION * max(abs(u[i]), abs(signal.nominal)) * np.sin(0.7 * k + i)
            u[i] = min(max(u[i] + swing, min(u[i], signal.minimum)), max(u[i], signal.maximum))
    return _si(component, u)


def _si(component: FmuComponent, u: Vector) -> Vector:
    return np.array([parse_unit(s.unit).to_si(v) for s, v in zip(component.inputs, u, strict=True)], dtype=float)


def _run(component: FmuComponent, asked: Subject) -> Vector:
    """The outputs at the start and after each step, shape (steps + 1, outputs)."""
    return _go_on(component, asked, component.start(asked.t0, _inputs(component, 0)))


def _go_on(component: FmuComponent, asked: Subject, first: Vector) -> Vector:
    """As `_run`, of a component started already, whose first outputs are these."""
    steps = (component.step(asked.t0 + k * asked.h, asked.h, _inputs(component, k)) for k in range(asked.steps))
    return np.array([first, *steps])


def load(asked: Subject) -> Answer:
    """Does it load, and does it start?"""
    with _loaded(asked) as component:
        component.start(asked.t0, _inputs(component, 0))
        inputs, outputs = len(component.inputs), len(component.outputs)
        return Answer(
            True, f"FMI {component.fmi_version}, started at {asked.t0:g} s with {inputs} inputs, {outputs} outputs"
        )


def pace(asked: Subject) -> Answer:
    """How long do loading, starting and a step take? `kept` is the median step in seconds, as text."""
    began = time.perf_counter()
    with _loaded(asked) as component:
        loaded = time.perf_counter()
        component.start(asked.t0, _inputs(component, 0))
        started = time.perf_counter()
        took: list[float] = []
        k = 0
        while k < asked.steps and (k < 3 or sum(took) < 1.0):
            u = _inputs(component, k)
            tick = time.perf_counter()
            component.step(asked.t0 + k * asked.h, asked.h, u)
            took.append(time.perf_counter() - tick)
            k += 1
    step = float(np.median(took))
    told = f"loaded in {_short(loaded - began)}, started in {_short(started - loaded)}, "
    told += f"median of {len(took)} steps of {asked.h:g} s {_short(step)} (called from Python)"
    return Answer(True, told, repr(step).encode())


def finite(asked: Subject) -> Answer:
    """Are all outputs finite, from the initialisation on?"""
    with _loaded(asked) as component:
        rows = _run(component, asked)
        names = [signal.name for signal in component.outputs]
    bad = np.argwhere(~np.isfinite(rows))
    if len(bad):
        k, column = bad[0]
        at = f"at t = {asked.t0 + k * asked.h:g} s" if k else "after initialisation"
        return Answer(False, f"{names[column]} is {rows[k, column]} {at}")
    return Answer(True, f"{len(names)} outputs over {len(rows)} instants")


def trajectory(asked: Subject) -> Answer:
    """Do two runs in one process give the same bytes? `kept` are the bytes."""
    with _loaded(asked) as component:
        first, second = _run(component, asked), _run(component, asked)
        verdict = _same(component, first, second, asked, f"two runs of {asked.steps} steps")
    return verdict._replace(kept=first.tobytes())


def instantiate_twice(asked: Subject) -> Answer:
    """Do two instances live in one process without touching each other?"""
    with _loaded(asked, "alone") as component:
        only_once = component.description.capabilities.get("canBeInstantiatedOnlyOncePerProcess")
        alone = _run(component, asked)
    with _loaded(asked, "one") as one, _loaded(asked, "two") as two:
        try:
            rows = [one.start(asked.t0, _inputs(one, 0))]
            two.start(asked.t0, _inputs(two, 0))
            for k in range(asked.steps):
                u = _inputs(one, k)
                two.step(asked.t0 + k * asked.h, asked.h, u)
                rows.append(one.step(asked.t0 + k * asked.h, asked.h, u))
        except StepError as error:
            if only_once:
                return Answer(None, f"says it can stand only once in a process, and does: {error.message}")
            return Answer(False, f"the second instance: {error.message}")
        found = _same(one, alone, np.array(rows), asked, "an instance stepped beside another and one alone")
    if only_once and not found.passed:
        return Answer(None, f"says it can stand only once in a process, and does: {found.evidence}")
    return found


def reset(asked: Subject) -> Answer:
    """Does a reset instance repeat the run bit for bit?"""
    with _loaded(asked) as component:
        if component.fmi_version.startswith("1") and component.description.kind == "me":
            return Answer(None, "there is none for Model Exchange in FMI 1.0")
        fresh = _run(component, asked)
        again = _go_on(component, asked, component.restart(asked.t0, _inputs(component, 0)))
        return _same(component, fresh, again, asked, f"{asked.steps} steps after a reset and of a fresh instance")


def rollback(asked: Subject) -> Answer:
    """Taken back to a kept state, does it make the same steps again?"""
    with _loaded(asked) as component:
        if component.fmi_version.startswith("1"):
            return Answer(None, NOT_IN_FMI1)
        mark = _bookmarked(component, asked)
        went = _onward(mark, asked)
        mark.restore()
        again = _onward(mark, asked)
        mark.forget()
        return _same(component, went, again, asked, f"{len(went)} steps and the same after going back")


def serialise(asked: Subject) -> Answer:
    """Does a state written to bytes and read back repeat the steps? `kept` are the bytes and the steps."""
    with _loaded(asked) as component:
        if component.fmi_version.startswith("1"):
            return Answer(None, NOT_IN_FMI1)
        mark = _bookmarked(component, asked)
        written = mark.serialised()
        went = _onward(mark, asked)
        mark.forget()
        mark.read(written)
        mark.restore()
        again = _onward(mark, asked)
        mark.forget()
        told = f"{len(went)} steps and the same after reading back {len(written)} bytes"
        kept = len(written).to_bytes(8, "little") + written + went.tobytes()
        return _same(component, went, again, asked, told)._replace(kept=kept)


def serialise_elsewhere(asked: Subject, kept: bytes) -> Answer:
    """Do the bytes of a state from another process repeat its steps here?"""
    size = int.from_bytes(kept[:8], "little")
    written, steps = kept[8 : 8 + size], np.frombuffer(kept[8 + size :])
    with _loaded(asked) as component:
        component.start(asked.t0, _inputs(component, 0))
        mark = Bookmark(component)
        mark.read(written)
        mark.restore()
        again = _onward(mark, asked)
        mark.forget()
        told = f"{len(again)} steps and the same from {size} bytes in a new process"
        return _same(component, steps.reshape(again.shape), again, asked, told)


def variable_step(asked: Subject) -> Answer:
    """Are steps of other lengths taken, and do they lead to the same place?"""
    n = asked.steps - asked.steps % 2
    with _loaded(asked) as component:
        fixed = component.description.capabilities.get("canHandleVariableCommunicationStepSize") is False
        head = "says every step must have the same length; " if fixed else ""
        whole = _held(component, asked, [asked.h] * n)
        try:
            halves = _held(component, asked, [asked.h / 2.0] * (2 * n))
            uneven = _held(component, asked, [asked.h * share for share in (0.3, 0.8, 0.4, 0.5) * (n // 2)])
        except StepError as error:
            return Answer(None if fixed else False, f"{head}at t = {error.time:g} s: {error.message}")
        scale = _scale(component, whole)
    if not np.isfinite(whole).all():
        return Answer(None, "outputs are not finite with steps of one length either")
    if not np.isfinite(halves).all() or not np.isfinite(uneven).all():
        return Answer(None if fixed else False, f"{head}half steps or uneven ones lead to outputs that are not finite")
    off = float((np.abs(halves[::2] - whole) / scale).max(initial=0.0))
    as_whole = float((np.abs(halves[: n + 1] - whole) / scale).max(initial=0.0))
    if off > HALVES_MATTER and as_whole < SAME:
        return Answer(None if fixed else False, f"{head}a half step does what a whole one does: its length is ignored")
    told = f"{2 * n} half steps lead within {off:.1e} of {n} whole ones, and {len(uneven) - 1} uneven steps are taken"
    return Answer(True, f"{head}{told} (relative to what the outputs span)")


def _held(component: FmuComponent, asked: Subject, lengths: Sequence[float]) -> Vector:
    """Outputs at the start and after steps of these lengths [s], inputs held."""
    u = _inputs(component, 1)
    rows = [component.start(asked.t0, u)]
    t = asked.t0
    for h in lengths:
        rows.append(component.step(t, h, u))
        t += h
    return np.array(rows)


def directional_derivative(asked: Subject) -> Answer:
    """Do its directional derivatives equal differences of its values, in initialisation?"""
    with _loaded(asked) as component:
        if component.fmi_version.startswith("1"):
            return Answer(None, NOT_IN_FMI1)
        chosen = pairs(component.description)
        if not chosen.unknowns or not chosen.knowns:
            return Answer(None, NO_PAIRS)
        compared = compare(Questioned(component, asked.t0, _inputs(component, 0)), chosen)
    worst = max(compared, key=lambda one: one.off)
    told = f"{len(compared)} derivatives in initialisation against differences, "
    told += f"the worst {worst.off * TOLERANCE:.1e} apart, scaled by nominal values (tolerance {TOLERANCE:g})"
    if worst.off <= 1.0:
        return Answer(True, told)
    name = f"d {worst.unknown} / d {worst.known}"
    return Answer(False, f"{name} is {worst.given:.6g}, by differences {worst.difference:.6g}; {told}")


def adjoint_derivative(asked: Subject) -> Answer:
    """Are its adjoint derivatives its directional ones, transposed?"""
    if not describe(asked.path, asked.validation).fmi_version.startswith("3"):
        return Answer(None, "there are none before FMI 3.0")
    with _loaded(asked) as component:
        unknowns, knowns = pairs(component.description)
        if not unknowns or not knowns:
            return Answer(None, NO_PAIRS)
        questioned = Questioned(component, asked.t0, _inputs(component, 0))
        forward = np.column_stack([questioned.directional(unknowns, known) for known in knowns])
        backward = np.vstack([questioned.adjoint(unknown, knowns) for unknown in unknowns])
    off = float(np.abs(forward - backward).max() / max(float(np.abs(forward).max()), 1e-300))
    told = (
        f"{forward.size} derivatives, adjoint and directional {off:.1e} apart (tolerance {TRANSPOSED:g} of the largest)"
    )
    return Answer(off <= TRANSPOSED, told)


def _bookmarked(component: FmuComponent, asked: Subject) -> Bookmark:
    """A component in the middle of its run, with a kept state."""
    component.start(asked.t0, _inputs(component, 0))
    mark = Bookmark(component)
    for k in range(_middle(asked)):
        mark.step(asked.t0 + k * asked.h, asked.h, _inputs(component, k))
    mark.keep()
    return mark


def _onward(mark: Bookmark, asked: Subject) -> Vector:
    """The outputs after each step from the middle of the run on."""
    middle = _middle(asked)
    inputs = ((k, _inputs(mark.component, k)) for k in range(middle, asked.steps))
    return np.array([mark.step(asked.t0 + k * asked.h, asked.h, u) for k, u in inputs])


def _middle(asked: Subject) -> int:
    return asked.steps // 2


def _same(component: FmuComponent, first: Vector, second: Vector, asked: Subject, what: str) -> Answer:
    """Whether two trajectories have the same bytes; where not, the first difference and the largest."""
    if first.tobytes() == second.tobytes():
        return Answer(True, f"{what} agree bit for bit")
    different = np.argwhere(first.view(np.uint64) != second.view(np.uint64))
    k, column = different[0]
    largest = np.nanmax(np.abs(first - second) / _scale(component, first))
    name = component.outputs[column].name if column < len(component.outputs) else "a state"
    told = f"{what} differ: {name} {first[k, column]:.17g} and {second[k, column]:.17g}"
    return Answer(False, f"{told}, at most {largest:.1e} of what the outputs span")


def _scale(component: FmuComponent, rows: Vector) -> Vector:
    """What each output spans over a run, or a billionth of its nominal value where that is larger."""
    nominal = np.array([abs(signal.nominal * parse_unit(signal.unit).factor) for signal in component.outputs])
    spans = np.ptp(np.nan_to_num(rows), axis=0)
    spans[: len(nominal)] = np.maximum(spans[: len(nominal)], 1e-9 * nominal)
    return spans + 1e-300


def _short(seconds: float) -> str:
    for unit, size in (("s", 1.0), ("ms", 1e-3), ("us", 1e-6)):
        if seconds >= size:
            return f"{seconds / size:.3g} {unit}"
    return f"{seconds / 1e-6:.2g} us"
