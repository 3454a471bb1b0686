"""What the ways to an FMU's derivatives share: its scalars in SI, and the choice of what bears proof."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fmus.component import Signal, Vector
from fmus.derivatives import TOLERANCE
from fmus.description import Validation
from fmus.differences import Range
from fmus.statespace import Differentiable, Partials, scales
from fmus.units import Unit
from fmus.variable import Variable

DIRECTIONAL, DIFFERENCES = "directional", "differences"


@dataclass(frozen=True)
class Source:
    """The FMU to make linear: its file, its start values in SI or text, and how it is read."""

    path: Path
    starts: Mapping[str, float | str]
    validation: Validation = "warn"

    def starts_of(self, signals: Sequence[Signal]) -> dict[str, float]:
        """The start values given for these signals, in SI."""
        names = {signal.name for signal in signals}
        return {k: float(v) for k, v in self.starts.items() if k in names and not isinstance(v, str)}


class Scalar:
    """One real scalar of an FMU: its variable, its place in it, and how it goes into SI."""

    def __init__(self, variable: Variable, place: int, name: str) -> None:
        self.variable, self.place, self.name = variable, place, name
        self.unit = variable.quantity or Unit()

    def signal(self) -> Signal:
        """As a signal in SI, without a unit where none is known."""
        v, unit = self.variable, self.unit
        starts = [s for s in v.start if not isinstance(s, str)]
        return Signal(
            self.name,
            "" if v.quantity is None else v.quantity.si_name(),
            unit.to_si(starts[self.place]) if len(starts) > self.place else 0.0,
            v.description,
            nominal=abs(unit.factor * v.nominal) or 1.0,
            minimum=unit.to_si(v.minimum),
            maximum=unit.to_si(v.maximum),
        )


def scalars_of(variables: Sequence[Variable]) -> list[Scalar]:
    """The scalars of variables, in order."""
    return [Scalar(v, place, name) for v in variables for place, name in enumerate(v.scalar_names())]


def is_real(variable: Variable, causality: str) -> bool:
    """Whether it is a continuous real variable of this causality that may be read and set at any time."""
    continuous = variable.variability in ("continuous", "") and variable.type in ("Real", "Float64")
    return variable.causality == causality and continuous and variable.on_bus


def plain_slopes(system: Differentiable, x: Vector, u: Vector) -> Vector:
    """Central differences whose width balances rounding and curvature, a cube root of the precision of the size."""
    widths = np.cbrt(np.finfo(float).eps) * np.maximum(np.abs(x), scales(system.states))
    steps = np.diag(widths)
    ends = [(system.values(x + step, u)[0], system.values(x - step, u)[0]) for step in steps]
    return np.array([(up - down) / (2.0 * width) for (up, down), width in zip(ends, widths, strict=True)]).T


def ranges(states: Sequence[Signal], inputs: Sequence[Signal]) -> list[Range]:
    """Inputs are kept inside their range; the states of an FMU take what they are given."""
    sizes = zip((*states, *inputs), scales((*states, *inputs)), strict=True)
    return [
        Range(float(size), *((signal.minimum, signal.maximum) if i >= len(states) else (-np.inf, np.inf)))
        for i, (signal, size) in enumerate(sizes)
    ]


def chosen(
    system: Differentiable, quotients: Vector, errors: Vector, given: Vector | None, told: str, sizes: Vector
) -> Partials:
    """The directional derivatives where they agree with the quotients within TOLERANCE, else the quotients.

    Differences and errors of an entry count relative to what all entries of its row make of changes of these sizes.
    """
    n = len(system.states)

    def parts(found: Vector) -> tuple[Vector, Vector, Vector, Vector]:
        return found[:n, :n], found[:n, n:], found[n:, :n], found[n:, n:]

    reach = np.abs(quotients) @ sizes
    per_row = np.divide(1.0, reach, out=np.ones_like(reach), where=reach > 0.0)[:, None]
    if given is not None:
        off = np.abs(given - quotients) * sizes * per_row
        off = np.where(np.isfinite(off), off, np.inf)
        if off.max(initial=0.0) <= TOLERANCE:
            told = f"{given.size} directional derivatives agree with differences within {off.max(initial=0.0):.1e}"
            return Partials(*parts(given), DIRECTIONAL, max(float(off.max()), float(np.finfo(float).eps)), told)
        i, j = np.unravel_index(int(off.argmax()), off.shape)
        row = [*(f"der({s.name})" for s in system.states), *(s.name for s in system.outputs)][i]
        column = (*system.states, *system.inputs)[j].name
        told = f"its directional derivative d {row} / d {column} is {given[i, j]:.6g}, by differences "
        told += f"{quotients[i, j]:.6g}"
    error = float((errors * sizes * per_row).max(initial=np.finfo(float).eps))
    return Partials(*parts(quotients), DIFFERENCES, error, told)
