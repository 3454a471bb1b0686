"""Small parts to run in the loop, in Python and in C: what the tests of the loop wire together."""

from __future__ import annotations

import ctypes
from functools import cache
from typing import Annotated, Any

import numpy as np

from fmus.component import Native, Role, Signal, StepError, Vector
from fmus.model import Model
from fmus.toolchain import compile_shared

_SOURCE = """
typedef struct { long long inputs, outputs; const double *a, *b, *d; double *x; } Linear;

__attribute__((visibility("default")))
int linear_step(void *self, double t, double h, const double *u, double *y)
{
    Linear *s = (Linear *)self;
    for (long long j = 0; j < s->outputs; j++) {
        double next = s->a[j] * s->x[j] + 0.01 * t + 0.1 * h, direct = 0.0;
        for (long long i = 0; i < s->inputs; i++) {
            next += s->b[j * s->inputs + i] * u[i];
            direct += s->d[j * s->inputs + i] * u[i];
        }
        s->x[j] = next;
        y[j] = next + direct;
    }
    return 0;
}

__attribute__((visibility("default")))
int status_step(void *self, double t, double h, const double *u, double *y)
{
    const double *s = (const double *)self; /* the time from which it answers with a status, and the status */
    y[0] = t + h;
    return t + h >= s[0] ? (int)s[1] : 0;
}
"""


class _Linear(ctypes.Structure):
    _fields_ = [
        *((name, ctypes.c_int64) for name in ("inputs", "outputs")),
        *((name, ctypes.c_void_p) for name in ("a", "b", "d", "x")),
    ]


@cache
def small_library() -> ctypes.CDLL:
    """The parts in C."""
    return ctypes.CDLL(str(compile_shared(_SOURCE)))


def _address(function: str) -> int:
    return ctypes.cast(getattr(small_library(), function), ctypes.c_void_p).value or 0


class Linear:
    """x+ = a x + B u + 0.01 t + 0.1 h, y = x+ + D u, with coefficients drawn from a seed; D is sparse."""

    def __init__(self, inputs: int, outputs: int, seed: int, direct: float, language: str, role: Role) -> None:
        chance = np.random.default_rng(seed)
        self.role, self.language = role, language
        self.inputs = tuple(Signal(f"u{i}") for i in range(inputs))
        self.outputs = tuple(Signal(f"y{j}", start=0.5 * j) for j in range(outputs))
        self.a, self.b = chance.uniform(-0.5, 0.5, outputs), chance.uniform(-0.3, 0.3, (outputs, inputs))
        self.d = chance.uniform(-0.3, 0.3, (outputs, inputs)) * (chance.random((outputs, inputs)) < direct)
        self.x = np.zeros(outputs)
        self.feedthrough = frozenset((f"y{j}", f"u{i}") for j, i in zip(*np.nonzero(self.d), strict=True))
        self.closed = 0

    def start(self, t0: float, u: Vector) -> Vector:
        """y = x + D u with x from zero."""
        self.x[:] = 0.0
        return self._advanced(t0, 0.0, u)

    def step(self, t: float, h: float, u: Vector) -> Vector:
        """The same sums as in C, in the same order."""
        return self._advanced(t, h, u)

    def _advanced(self, t: float, h: float, u: Vector) -> Vector:
        y = np.zeros(len(self.outputs))
        for j in range(len(self.outputs)):
            following = float(self.a[j]) * float(self.x[j]) + 0.01 * t + 0.1 * h
            direct = 0.0
            for i in range(len(self.inputs)):
                following += float(self.b[j, i]) * float(u[i])
                direct += float(self.d[j, i]) * float(u[i])
            self.x[j] = following
            y[j] = following + direct
        return y

    def native(self) -> Native | None:
        """The step in C where that is the language."""
        if self.language == "python":
            return None
        arrays = [array.ctypes.data for array in (self.a, self.b, self.d, self.x)]
        self.state = _Linear(len(self.inputs), len(self.outputs), *arrays)
        return Native(_address("linear_step"), ctypes.addressof(self.state))

    def keep(self) -> None:
        """Remember x."""
        self.kept = self.x.copy()

    def restore(self) -> None:
        """Go back to it."""
        self.x[:] = self.kept

    def close(self) -> None:
        """Counted."""
        self.closed += 1


def linear(
    inputs: int = 1,
    outputs: int = 1,
    seed: int = 0,
    direct: float = 0.0,
    language: str = "native",
    role: str = "controller",
) -> Any:
    """A Linear part."""
    chosen: Any = role
    return Linear(inputs, outputs, seed, direct, language, chosen)


class Clockwork:
    """y = (t + h, calls so far, h): what a part is told; from `at` on it misbehaves as `what` says."""

    role: Role = "controller"
    feedthrough: frozenset[tuple[str, str]] = frozenset()
    inputs: tuple[Signal, ...] = ()
    outputs = (Signal("t", "s"), Signal("calls"), Signal("h", "s"))

    def __init__(self, at: float, what: str) -> None:
        self.at, self.what = at, what

    def start(self, t0: float, u: Vector) -> Vector:
        """No call so far."""
        self.calls = 0
        return np.array([t0, 0.0, 0.0])

    def step(self, t: float, h: float, u: Vector) -> Vector:
        """What it was told, or mischief."""
        self.calls += 1
        if t + h < self.at:
            return np.array([t, float(self.calls), h])
        if self.what == "raise":
            raise ZeroDivisionError("a bug")
        if self.what == "interrupt":
            raise KeyboardInterrupt
        if self.what in ("discard", "error", "fatal"):
            raise StepError("told so", status=("discard", "error", "fatal").index(self.what) + 2)
        if self.what == "short":
            return np.array([t])
        return np.array([t, float(self.what), h])

    def native(self) -> None:
        """Only Python."""

    def close(self) -> None:
        """Nothing is held."""


def clockwork(at: Annotated[float, "s"] = 1e300, what: str = "nan") -> Clockwork:
    """A Clockwork that misbehaves from a time on."""
    return Clockwork(at, what)


class StatusPart:
    """y = t + h, in C, answering with a status from a time on."""

    role: Role = "plant"
    feedthrough: frozenset[tuple[str, str]] = frozenset()
    inputs: tuple[Signal, ...] = ()
    outputs = (Signal("y", "s"),)

    def __init__(self, at: float, status: int) -> None:
        self.state = np.array([at, float(status)])

    def start(self, t0: float, u: Vector) -> Vector:
        """y = t0."""
        return np.array([t0])

    def step(self, t: float, h: float, u: Vector) -> Vector:
        """y = t + h."""
        return np.array([t + h])

    def native(self) -> Native:
        """The step that answers with the status."""
        return Native(_address("status_step"), self.state.ctypes.data)

    def close(self) -> None:
        """Nothing is held."""


def status(at: Annotated[float, "s"], status: int) -> StatusPart:
    """A part that answers with `status` from `at` on."""
    return StatusPart(at, status)


class Truth(Clockwork):
    """A plant to put sensors on: y is t + h in rad/s, kind is an integer."""

    role: Role = "plant"
    outputs = (Signal("y", "rpm"), Signal("torque", "N.m"), Signal("location", kind="integer"))

    def step(self, t: float, h: float, u: Vector) -> Vector:
        """A slope, a wave and a jump."""
        now = t + h
        return np.array([now, np.sin(7.0 * now), float(now > 0.5)])


def truth() -> Truth:
    """A Truth that never fails."""
    return Truth(1e300, "nan")


class Estimator(Clockwork):
    """An observer of y and location with a gain."""

    role: Role = "observer"
    inputs = (Signal("y", "rpm"), Signal("location", kind="integer"))
    outputs = (Signal("y_hat", "rpm"),)
    feedthrough = frozenset({("y_hat", "y")})

    def __init__(self, gain: float) -> None:
        self.gain = gain

    def start(self, t0: float, u: Vector) -> Vector:
        """Its input times the gain."""
        return self.gain * u[:1]

    def step(self, t: float, h: float, u: Vector) -> Vector:
        """Its input times the gain."""
        return self.gain * u[:1]


def estimator(
    *, gain: Annotated[float, "1/s"], delays: Annotated[list[float], "s"] = (), order: int = 1, label: str = ""
) -> Estimator:
    """An Estimator. Raises ValueError: the gain is not positive."""
    if gain <= 0.0:
        raise ValueError(f"gain wants a positive number, got {gain}")
    part = Estimator(gain)
    part.arguments = {"gain": gain, "delays": delays, "order": order, "label": label}
    return part


def sampled(design: Annotated[float, "s"] = 0.0, sample_time: Annotated[float, "s"] = 1.0) -> Model:
    """A model that holds its input, sampled every `design` [s], or every `sample_time` where that is 0."""
    return Model(
        name="sampled",
        description="Holds its input.",
        role="controller",
        inputs=(Signal("u"),),
        outputs=(Signal("y"),),
        discrete=(Signal("m"),),
        parameters=(Signal("period", "s", start=design or sample_time),),
        equations=lambda t, x, m, u, p: ({}, {"y": m.m}),
        sample=lambda t, x, m, u, p: {"m": u.u},
        sample_time="period",
    )


def arrays(seed: int = 0) -> Linear:
    """A Linear part whose two inputs and two outputs are the arrays u and y."""
    part = Linear(2, 2, seed, 0.0, "native", "controller")
    part.inputs = (Signal("u[1]"), Signal("u[2]"))
    part.outputs = (Signal("y[1]"), Signal("y[2]"))
    return part


class Vote(Clockwork):
    """An observer of three redundant readings: which of them stands apart from the middle one by more than a bound."""

    role: Role = "observer"
    inputs = (Signal("a", "rpm"), Signal("b", "rpm"), Signal("c", "rpm"))
    outputs = (Signal("culprit", kind="integer"),)
    feedthrough = frozenset({("culprit", "a"), ("culprit", "b"), ("culprit", "c")})

    def __init__(self, bound: float) -> None:
        self.bound = bound

    def start(self, t0: float, u: Vector) -> Vector:
        """1, 2 or 3, or 0 where all agree."""
        apart = np.abs(u - np.median(u))
        return np.array([float(np.argmax(apart) + 1 if apart.max() > self.bound else 0)])

    def step(self, t: float, h: float, u: Vector) -> Vector:
        """The same."""
        return self.start(t, u)


def vote(bound: Annotated[float, "rpm"]) -> Vote:
    """A Vote with a bound."""
    return Vote(bound)
