"""The one shape everything simulated has: declared signals, start, step, close; and its errors."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]
Kind = Literal["real", "integer", "boolean"]
Role = Literal["plant", "observer", "controller", "source", "sensor"]

# Status of one step, numbered as FMI numbers it; DIVERGED is ours (a non-finite output).
OK, WARNING, DISCARD, ERROR, FATAL, DIVERGED = 0, 1, 2, 3, 4, 5
STATUS_NAMES = ("ok", "warning", "discard", "error", "fatal", "diverged")


@dataclass(frozen=True)
class Signal:
    """One declared variable: name, unit, start value and the range it is meant to stay in.

    `shape` () is a scalar, (n,) or (n, m) an array, which FMI sees as the scalars
    `name[1]` ... or `name[1,1]` ... in row-major order. Values are in `unit`. A `local` state stays inside: it is no
    output of the FMU.
    """

    name: str
    unit: str = "1"
    start: Any = 0.0
    description: str = ""
    nominal: float = 1.0
    minimum: float = -math.inf
    maximum: float = math.inf
    kind: Kind = "real"
    shape: tuple[int, ...] = ()
    local: bool = False

    def __post_init__(self) -> None:
        start = np.asarray(self.start, dtype=float)
        if start.shape not in ((), self.shape):
            raise ValueError(f"{self.name}: start wants shape {self.shape}, got {start.shape}")

    @property
    def size(self) -> int:
        """Number of scalars."""
        return math.prod(self.shape)

    def scalar_names(self) -> list[str]:
        """Names of the scalars, row-major, indices from 1 as FMI's structured naming has them."""
        if not self.shape:
            return [self.name]
        return [f"{self.name}[{','.join(str(i + 1) for i in index)}]" for index in np.ndindex(*self.shape)]

    def scalar_starts(self) -> Vector:
        """Start values of the scalars, row-major, shape (size,)."""
        return np.broadcast_to(np.asarray(self.start, dtype=float), self.shape).astype(float).ravel()


class Native(NamedTuple):
    """A step that C may call without Python: `int step(void *self, double t, double h, const double *u, double *y)`.

    It advances from t to t + h. `u` and `y` hold the component's flat inputs and outputs in declared order, in SI
    units; the status is one of those above. `step` and `self` are addresses.
    """

    step: int
    self: int


class Reversal(NamedTuple):
    """How C takes a part back within an instant: three functions and what they work on, all addresses.

    `int keep(void *self)` remembers the state the part is in now, in place of what was remembered before.
    `int restore(void *self)` goes back to it, as often as wanted.
    `int derivative(void *self, const double *du, double *dy)` is the directional derivative of the outputs with respect
    to the inputs at the present point, both in SI units; 0 where there is none.
    The status is as that of steps.
    """

    keep: int
    restore: int
    derivative: int
    self: int


@runtime_checkable
class Component(Protocol):
    """Anything that can be stepped: a plant, sensor, source, observer, controller or vendor FMU.

    `inputs` and `outputs` are scalars in a fixed order, in SI units on every call.
    `feedthrough` holds the pairs (output name, input name) where the output at the end of a step
    depends algebraically on the input. `start` rebuilds all state. One that can be taken back is Reversible, too.
    """

    @property
    def role(self) -> Role:
        """What it is in the scenario."""

    @property
    def inputs(self) -> Sequence[Signal]:
        """Scalars in the order of u."""

    @property
    def outputs(self) -> Sequence[Signal]:
        """Scalars in the order of y."""

    @property
    def feedthrough(self) -> frozenset[tuple[str, str]]:
        """Pairs (output name, input name)."""

    def start(self, t0: float, u: Vector) -> Vector:
        """Initialise at time t0 [s] with inputs u and return the initial outputs."""

    def step(self, t: float, h: float, u: Vector) -> Vector:
        """Advance from t to t + h [s] with inputs u held and return the outputs at t + h. Raises StepError."""

    def native(self) -> Native | None:
        """The same step for C, valid after `start`; None where there is only Python."""

    def close(self) -> None:
        """Release what the component holds; further calls are errors."""


@runtime_checkable
class Reversible(Protocol):
    """What a Component may offer beside: to be taken back to a state it was in."""

    def reversal(self) -> Reversal | None:
        """How C takes it back, valid after `start`; None where it cannot be taken back."""


class Problem(NamedTuple):
    """One thing wrong with a configuration, and where."""

    message: str
    file: str = ""
    line: int = 0
    column: int = 0

    def __str__(self) -> str:
        place = ":".join(str(part) for part in (self.file, self.line, self.column) if part)
        return f"{place}: {self.message}" if place else self.message


class ConfigurationError(Exception):
    """What is wrong before a run: every problem found, not just the first."""

    def __init__(self, problems: Sequence[Problem] | Problem | str) -> None:
        if isinstance(problems, str):
            problems = [Problem(problems)]
        elif isinstance(problems, Problem):
            problems = [problems]
        self.problems = list(problems)
        super().__init__("\n".join(str(problem) for problem in self.problems))

    def __reduce__(self) -> tuple[type[ConfigurationError], tuple[list[Problem]]]:
        return type(self), (self.problems,)


class StepError(Exception):
    """What went wrong during a run: which part, when, and with what FMI status."""

    def __init__(self, message: str, *, part: str = "", time: float = math.nan, status: int = ERROR) -> None:
        self.message, self.part, self.time, self.status = message, part, time, status
        super().__init__(f"{part} at t = {time:.9g} s: {STATUS_NAMES[status]}: {message}" if part else message)
