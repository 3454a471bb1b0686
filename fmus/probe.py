"""Questions put to an FMU: what it does when it is reset, taken back, stepped unevenly, whatever its flags say.

Each probe works on a component of its own and may crash or hang with it: run it where that does no harm.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import numpy as np

from fmus.component import StepError, Vector
from fmus.derivatives import TOLERANCE, TRANSPOSED, Questioned, compare, pairs
from fmus.description import describe
from fmus.fmu import FmuComponent, load_fmu
from fmus.interview import Answer, Subject, course, go_on, inputs_at, same, spans
from fmus.state import Bookmark

NO_PAIRS = "there is no continuous output or state derivative with a continuous input or state to derive it by"
NOT_IN_FMI1 = "there is no such thing in FMI 1.0"
# Of what the outputs span: half steps that lead as far away, and one by one to the same places, have no length of
# their own. A trajectory that an FMU makes from the same inputs by the same steps is the same to rounding.
HALVES_MATTER, SAME = 0.05, 1e-9


def load(asked: Subject) -> Answer:
    """Does it load, and does it start?"""
    with loaded(asked) as component:
        component.start(asked.t0, inputs_at(component, 0))
        inputs, outputs = len(component.inputs), len(component.outputs)
        return Answer(
            True, f"FMI {component.fmi_version}, started at {asked.t0:g} s with {inputs} inputs, {outputs} outputs"
        )


def pace(asked: Subject) -> Answer:
    """How long do loading, starting and a step take? `kept` is the median step in seconds, as text."""
    began = time.perf_counter()
    with loaded(asked) as component:
        ready = time.perf_counter()
        component.start(asked.t0, inputs_at(component, 0))
        started = time.perf_counter()
        took: list[float] = []
        k = 0
        while k < asked.steps and (k < 3 or sum(took) < 1.0):
            u = inputs_at(component, k)
            tick = time.perf_counter()
            component.step(asked.t0 + k * asked.h, asked.h, u)
            took.append(time.perf_counter() - tick)
            k += 1
    step = float(np.median(took))
    told = f"loaded in {_short(ready - began)}, started in {_short(started - ready)}, "
    told += f"median of {len(took)} steps of {asked.h:g} s {_short(step)} (called from Python)"
    return Answer(True, told, repr(step).encode())


def finite(asked: Subject) -> Answer:
    """Are all outputs finite, from the initialisation on?"""
    with loaded(asked) as component:
        rows = course(component, asked)
        names = [signal.name for signal in component.outputs]
    bad = np.argwhere(~np.isfinite(rows))
    if len(bad):
        k, column = bad[0]
        at = f"at t = {asked.t0 + k * asked.h:g} s" if k else "after initialisation"
        return Answer(False, f"{names[column]} is {rows[k, column]} {at}")
    return Answer(True, f"{len(names)} outputs over {len(rows)} instants")


def trajectory(asked: Subject) -> Answer:
    """Do two runs in one process give the same bytes? `kept` are the bytes."""
    with loaded(asked) as component:
        first, second = course(component, asked), course(component, asked)
        verdict = same(component, first, second, f"two runs of {asked.steps} steps")
    return verdict._replace(kept=first.tobytes())


def instantiate_twice(asked: Subject) -> Answer:
    """Do two instances live in one process without touching each other?"""
    with loaded(asked, "alone") as component:
        only_once = component.description.capabilities.get("canBeInstantiatedOnlyOncePerProcess")
        alone = course(component, asked)
    with loaded(asked, "one") as one, loaded(asked, "two") as two:
        try:
            rows = [one.start(asked.t0, inputs_at(one, 0))]
            two.start(asked.t0, inputs_at(two, 0))
            for k in range(asked.steps):
                u = inputs_at(one, k)
                two.step(asked.t0 + k * asked.h, asked.h, u)
                rows.append(one.step(asked.t0 + k * asked.h, asked.h, u))
        except StepError as error:
            if only_once:
                return Answer(None, f"says it can stand only once in a process, and does: {error.message}")
            return Answer(False, f"the second instance: {error.message}")
        found = same(one, alone, np.array(rows), "an instance stepped beside another and one alone")
    if only_once and not found.passed:
        return Answer(None, f"says it can stand only once in a process, and does: {found.evidence}")
    return found


def reset(asked: Subject) -> Answer:
    """Does a reset instance repeat the run bit for bit?"""
    with loaded(asked) as component:
        if component.fmi_version.startswith("1") and component.description.kind == "me":
            return Answer(None, "there is none for Model Exchange in FMI 1.0")
        fresh = course(component, asked)
        again = go_on(component, asked, component.restart(asked.t0, inputs_at(component, 0)))
        return same(component, fresh, again, f"{asked.steps} steps after a reset and of a fresh instance")


def rollback(asked: Subject) -> Answer:
    """Taken back to a kept state twice, does it make the same steps again?"""
    with loaded(asked) as component:
        if component.fmi_version.startswith("1"):
            return Answer(None, NOT_IN_FMI1)
        mark = _bookmarked(component, asked)
        went = _onward(mark, asked)
        for _ in range(2):  # an FMU may go on in the state that it gave away
            mark.restore()
            again = _onward(mark, asked)
        mark.forget()
        return same(component, went, again, f"{len(went)} steps and the same after going back twice")


def serialise(asked: Subject) -> Answer:
    """Does a state written to bytes and read back repeat the steps? `kept` are the bytes and the steps."""
    with loaded(asked) as component:
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
        return same(component, went, again, told)._replace(kept=kept)


def serialise_elsewhere(asked: Subject, kept: bytes) -> Answer:
    """Do the bytes of a state from another process repeat its steps here?"""
    size = int.from_bytes(kept[:8], "little")
    written, steps = kept[8 : 8 + size], np.frombuffer(kept[8 + size :])
    with loaded(asked) as component:
        component.start(asked.t0, inputs_at(component, 0))
        mark = Bookmark(component)
        mark.read(written)
        mark.restore()
        again = _onward(mark, asked)
        mark.forget()
        told = f"{len(again)} steps and the same from {size} bytes in a new process"
        return same(component, steps.reshape(again.shape), again, told)


def variable_step(asked: Subject) -> Answer:
    """Are steps of other lengths taken, and do they lead to the same place?"""
    n = asked.steps - asked.steps % 2
    with loaded(asked) as component:
        fixed = component.description.capabilities.get("canHandleVariableCommunicationStepSize") is False
        head = "says every step must have the same length; " if fixed else ""
        whole = _held(component, asked, [asked.h] * n)
        try:
            halves = _held(component, asked, [asked.h / 2.0] * (2 * n))
            uneven = _held(component, asked, [asked.h * share for share in (0.3, 0.8, 0.4, 0.5) * (n // 2)])
        except StepError as error:
            return Answer(None if fixed else False, f"{head}at t = {error.time:g} s: {error.message}")
        scale = spans(component, whole)
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
    u = inputs_at(component, 1)
    rows = [component.start(asked.t0, u)]
    t = asked.t0
    for h in lengths:
        rows.append(component.step(t, h, u))
        t += h
    return np.array(rows)


def directional_derivative(asked: Subject) -> Answer:
    """Do its directional derivatives equal differences of its values, in initialisation?"""
    with loaded(asked) as component:
        if component.fmi_version.startswith("1"):
            return Answer(None, NOT_IN_FMI1)
        chosen = pairs(component.description)
        if not chosen.unknowns or not chosen.knowns:
            return Answer(None, NO_PAIRS)
        compared = compare(Questioned(component, asked.t0, inputs_at(component, 0)), chosen)
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
    with loaded(asked) as component:
        unknowns, knowns = pairs(component.description)
        if not unknowns or not knowns:
            return Answer(None, NO_PAIRS)
        questioned = Questioned(component, asked.t0, inputs_at(component, 0))
        forward = np.column_stack([questioned.directional(unknowns, known) for known in knowns])
        backward = np.vstack([questioned.adjoint(unknown, knowns) for unknown in unknowns])
    off = float(np.abs(forward - backward).max() / max(float(np.abs(forward).max()), 1e-300))
    told = (
        f"{forward.size} derivatives, adjoint and directional {off:.1e} apart (tolerance {TRANSPOSED:g} of the largest)"
    )
    return Answer(off <= TRANSPOSED, told)


@contextmanager
def loaded(asked: Subject, name: str = "probed") -> Iterator[FmuComponent]:
    """The FMU as a component while the block lasts."""
    component = load_fmu(asked.path, name=name, validation=asked.validation, kind=asked.kind)
    try:
        yield component
    finally:
        component.close()


def _bookmarked(component: FmuComponent, asked: Subject) -> Bookmark:
    """A component in the middle of its run, with a kept state."""
    component.start(asked.t0, inputs_at(component, 0))
    mark = Bookmark(component)
    for k in range(_middle(asked)):
        mark.step(asked.t0 + k * asked.h, asked.h, inputs_at(component, k))
    mark.keep()
    return mark


def _onward(mark: Bookmark, asked: Subject) -> Vector:
    """The outputs after each step from the middle of the run on."""
    middle = _middle(asked)
    inputs = ((k, inputs_at(mark.component, k)) for k in range(middle, asked.steps))
    return np.array([mark.step(asked.t0 + k * asked.h, asked.h, u) for k, u in inputs])


def _middle(asked: Subject) -> int:
    return asked.steps // 2


def _short(seconds: float) -> str:
    for unit, size in (("s", 1.0), ("ms", 1e-3), ("us", 1e-6)):
        if seconds >= size:
            return f"{seconds / size:.3g} {unit}"
    return f"{seconds / 1e-6:.2g} us"
