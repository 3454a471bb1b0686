"""Parts that are stepped together and taken back: what coupling.c is given of them, and how loops are initialised."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from fmus.component import StepError, Vector
from fmus.units import parse_unit
from harness.native import address
from harness.order import cycle_text
from harness.reversal import Raised, reversal_of
from harness.scenario import Coupling
from harness.system import Group, System

KINDS = ("fixed-point", "newton", "smaller steps", "steered")
# So often a step is repeated at the most to end at a crank angle: each repetition squares what it misses.
STEERED_ROUNDS = 20
# See coupling.c.
SINGULAR = 1e-7


class _Past(ctypes.Structure):
    _fields_ = [(name, ctypes.c_void_p) for name in ("keep", "restore", "derivative", "self")]


class CGroup(ctypes.Structure):
    """What coupling.c knows of a group."""

    _fields_ = [
        ("kind", ctypes.c_int64),
        *((name, ctypes.c_void_p) for name in ("first", "end", "pasts", "saved", "other", "scales")),
        *((name, ctypes.c_double) for name in ("tolerance", "relaxation")),
        *((name, ctypes.c_int64) for name in ("iterations", "torn")),
        *((name, ctypes.c_void_p) for name in ("given", "made", "nominals", "work", "slopes")),
        *((name, ctypes.c_int64) for name in ("derivatives", "level", "steps", "rejected", "rounds")),
        ("missed", ctypes.c_double),
        ("place", ctypes.c_int64),
    ]


class Unsolved(Exception):
    """A loop that is not solved: `place` is the torn signal furthest from being so, `missed` how far, relative."""

    def __init__(self, place: int, missed: float) -> None:
        self.place, self.missed = place, missed
        super().__init__()


def scales(system: System) -> Vector:
    """The nominal value of every signal of the bus, in SI, shape (places,)."""
    return np.array([abs(signal.nominal * parse_unit(signal.unit).factor) or 1.0 for signal in system.bus])


def made_group(
    group: Group, system: System, table: Any, bus: Vector, callbacks: Mapping[int, Raised], kept: list[Any]
) -> CGroup:
    """A group for C; what it points to is put to `kept`. Raises StepError: a part that cannot be taken back."""
    settings = system.coupling
    slots = system.parts[group.first : group.first + group.count]
    pasts = (_Past * group.count)()
    derivatives = group.kind == "newton"
    for offset, slot in enumerate(slots):
        if offset == 0 and group.torn:
            continue  # the head, whose values C puts back
        way = reversal_of(slot.component, callbacks.get(group.first + offset))
        if way.reversal is None:
            raise StepError(f"cannot be taken back: {way.reason}", part=slot.name, time=system.grid.start)
        pasts[offset] = _Past(*(number or None for number in way.reversal))
        derivatives = derivatives and bool(way.reversal.derivative)
        kept.append(way.held)
    places = [place for slot in slots for place in slot.outputs]
    nominal = scales(system)
    given = np.array([pair[0] for pair in group.torn], dtype=np.int64)
    made = np.array([pair[1] for pair in group.torn], dtype=np.int64)
    n = len(group.torn)
    saved, other, work, slopes = np.zeros(len(places)), np.zeros(len(places)), np.zeros(n * (n + 4)), np.zeros(len(bus))
    nominals_of_outputs, nominals = nominal[places], nominal[made]
    kept += [pasts, saved, other, work, slopes, nominals_of_outputs, given, made, nominals]
    size = ctypes.sizeof(table._type_)
    begin = ctypes.addressof(table) + group.first * size
    return CGroup(
        kind=KINDS.index(group.kind),
        first=begin,
        end=begin + group.count * size,
        pasts=ctypes.addressof(pasts),
        saved=address(saved),
        other=address(other),
        scales=address(nominals_of_outputs),
        tolerance=settings.error if group.kind == "smaller steps" else settings.tolerance,
        relaxation=settings.relaxation,
        iterations=STEERED_ROUNDS if group.kind == "steered" else settings.iterations,
        torn=n,
        given=address(given),
        made=address(made),
        nominals=address(nominals),
        work=address(work),
        slopes=address(slopes),
        derivatives=derivatives,
    )


def solve_start(make: Callable[[Vector], Vector], guess: Vector, nominals: Vector, settings: Coupling) -> None:
    """Find z with make(z) = z, relative to the larger of value and nominal value, from a guess; `make` was called last
    with what is found. All shape (n,).

    z+ = z + relaxation (make(z) - z), or Newton's method by differences, (1 - d make/dz) (z+ - z) = make(z) - z, in
    units of the nominal values.

    Raises Unsolved: not within so many iterations, or a singular value of that matrix is below SINGULAR.
    """
    z = guess.copy()
    worst, missed = 0, np.inf
    for _ in range(settings.iterations):
        made = make(z)
        residual = made - z
        relative = np.abs(residual) / np.maximum(np.maximum(np.abs(made), np.abs(z)), nominals)
        worst, missed = int(np.argmax(relative)), float(np.max(relative))
        if missed <= settings.tolerance:
            return
        if settings.solve == "newton":
            matrix = np.eye(len(z))
            for column in range(len(z)):
                moved = z.copy()
                moved[column] += 1e-7 * max(abs(z[column]), nominals[column])
                matrix[:, column] -= (make(moved) - made) / (moved[column] - z[column])
            scaled = matrix * nominals / nominals[:, np.newaxis]
            if np.linalg.svd(scaled, compute_uv=False)[-1] < SINGULAR:
                break
            z = z + nominals * np.linalg.solve(scaled, residual / nominals)
        else:
            z = z + settings.relaxation * residual
    raise Unsolved(worst, missed)


def loop_message(group: Group, signal: str, missed: float, settings: Coupling) -> str:
    """What is said of an algebraic loop that was not solved."""
    told = f"algebraic loop not solved: {cycle_text(group.wires)}; by {settings.solve}, {signal} is still {missed:.2g} "
    return told + f"(relative) from what the loop makes of it, wanted {settings.tolerance:g}; is there a solution?"


def unsolved(group: Group, found: CGroup, system: System) -> str:
    """Why the loop in C gave a group up."""
    signal = system.bus[found.place].name
    if group.kind == "steered":
        return (
            f"no step ends at the clock's crank angle: {found.missed:.3g} rad are missed after {STEERED_ROUNDS} tries"
        )
    if group.kind == "smaller steps":
        error = f"{signal} is off by {found.missed:.3g}, wanted {system.coupling.error:g}"
        return f"no step is small enough for the plants that feed each other: {error} (relative)"
    return loop_message(group, signal, found.missed, system.coupling)


def told(group: Group, found: CGroup, parts: Sequence[str]) -> dict[str, Any] | None:
    """What became of a group, as an entry of the record's log; None where it was never stepped."""
    if not found.steps:
        return None
    names = ", ".join(name for name in parts if not name.startswith("("))
    texts = {
        "smaller steps": f"{found.steps} steps, {found.rejected} rejected",
        "steered": f"{found.rounds} rounds in {found.steps} steps",
    }
    text = texts.get(group.kind, f"{group.kind}: {found.rounds} rounds in {found.steps} steps")
    if group.kind == "newton":
        text += ", by directional derivatives" if found.derivatives else ", by differences"
    return {"part": names, "category": "coupling", "text": text}
