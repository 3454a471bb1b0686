"""A chain of sampled periodic-input observers as a Model: the frame that those of lags, rods and any system share.

At each sampling, delta being the crank angle since the last one and omega the mean of the speeds at its two ends, a
stage predicts and then corrects by y, so that its estimate is x(k|k):

    x- = X(c, alpha_k) + e^{A delta} (x - X(c, alpha_{k-1})),   X(c, alpha) = sum_k X_k c_k e^{i k w0 alpha}
    x+ = x- + K (y - C x-),   c_k+ = c_k + e^{-i k w0 alpha_k} K_k (y - C x-)

with X_k = (i k w0 - A)^-1 A0 and A, A0 per radian at omega. The prediction is exact for a speed that does not change
within the step. X_k comes from Faddeev and Leverrier's polynomials, right at any speed; the exponential, for n = 1,
from np.exp, else from Taylor's series to the order TERMS over so many equal parts that the rest is below 1e-13.
The next stage takes the w of a stage for its y. A stage costs a number of operations proportional to n^2 + n m h.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import matrix_balance

from fmus.component import Signal
from fmus.model import Model, ModelError, Values
from observers.constant_gain import weights
from observers.periodic import PeriodicSystem
from observers.periodic_response import Pair, product, resolver, turns_of
from observers.periodic_schedule import Schedule
from observers.periodic_told import endings, sum_of, told_signals, told_values

Array = NDArray[np.float64]

# Of Taylor's series of e^{A t}: with |A t| <= 0.5 the rest is below 0.5^13/13! = 2e-14.
TERMS, REACH = 12, 0.5
# Parts a step may be cut into; beyond, the system is faster than its sampling can follow.
MOST_PARTS = 256


class Stage(NamedTuple):
    """One observer of a chain.

    `speed(omega, u, p)` gives the sigma that the system's matrices go by; `parts` is how often a step is cut for the
    exponential. `begin` (n,), (m,) are the state and c_0 it begins with; None where it begins at rest at its first y.
    """

    system: PeriodicSystem
    schedule: Schedule
    parts: int
    speed: Callable[[Any, Values, Values], Any]
    begin: tuple[Array, Array] | None = None


class Reconstruction(NamedTuple):
    """What is known after a sampling: c_k of the last stage's w (h + 1 lists of m pairs), at alpha and omega.

    `turns` are (cos, sin) of k w0 alpha. All are moved by the delay.
    """

    coefficients: Sequence[Sequence[Pair]]
    turns: Sequence[Pair]
    omega: Any


class Extra(NamedTuple):
    """Further outputs of a model, and the parameters they want; `values(found, p)` gives them by name."""

    signals: tuple[Signal, ...] = ()
    parameters: tuple[Signal, ...] = ()
    values: Callable[[Reconstruction, Values], Mapping[str, Any]] = lambda found, p: {}


NOTHING = Extra()


class Frame(NamedTuple):
    """What a chain's model is called, what its signals are, and the speeds [rad/s] it was made for.

    `measured` are the inputs y, `reconstructed` the outputs w. `inputs` and `parameters` are what the stages' speeds
    take besides. `multiplier` and `variance_gain` are told as outputs; `delay` [s] is between w and the first stage.
    """

    name: str
    description: str
    measured: tuple[Signal, ...]
    reconstructed: tuple[Signal, ...]
    low: float
    high: float
    multiplier: float
    variance_gain: float
    delay: float = 0.0
    inputs: tuple[Signal, ...] = ()
    parameters: tuple[Signal, ...] = ()


def parts_of(system: PeriodicSystem, interval: float) -> int:
    """How many parts a step is cut into so that Taylor's series holds; `interval` in what A counts per.

    Raises ModelError: there would be too many.
    """
    if len(system.A) == 1:
        return 1
    balanced, _ = matrix_balance(system.A, permute=False)
    parts = max(1, math.ceil(float(np.linalg.norm(balanced, 1)) * interval / REACH))
    if parts > MOST_PARTS:
        raise ModelError(
            f"A has the norm {np.linalg.norm(balanced, 1):.4g}, times a step {parts * REACH:.4g}: "
            f"it wants {MOST_PARTS * REACH:g} at most; sample more often, or leave its fastest states out"
        )
    return parts


def chain_model(frame: Frame, stages: Sequence[Stage], extra: Extra = NOTHING) -> Model:
    """The chain as a sampled Model with a sample time of 0, which samples at each step of its part.

    The first of `stages` sees the measurement. Inputs: y, `angle` [deg, counted on], `omega` [rad/s]. Outputs: the
    reconstructed w, its coefficients `c_0`, `c_1_re`, `c_1_im`, ..., energies `E_k` = sqrt(|c_k|^2 + |c_-k|^2), states
    `x_j`, the first stage's `innovation`, and what was certified. With several inputs w each name ends in `_j`.
    """
    resolve = [resolver(stage.system) for stage in stages]
    last = stages[-1].system

    def sample(t: Any, x: Values, m: Values, u: Values, p: Values) -> dict[str, Any]:
        first = m.begun < 0.5
        now = u.angle * (math.pi / 180.0)
        before = np.where(first, u.angle, m.angle_before) * (math.pi / 180.0)
        delta = np.maximum(now - before, 0.0)
        mean = np.where(first, u.omega, 0.5 * (u.omega + m.omega_before))
        omega = np.minimum(np.maximum(mean, p.omega_low), p.omega_high)
        order = stages[0].system.order
        turned, turning = (turns_of(order * a, last.harmonics) for a in (before, now))
        updated: dict[str, Any] = {"angle_before": u.angle, "omega_before": u.omega, "begun": 1.0}
        y = [u[signal.name] for signal in frame.measured]
        coefficients: list[list[Pair]] = []
        states: list[Any] = []
        for j, stage in enumerate(stages, start=1):
            sigma = stage.speed(omega, u, p)
            held = _coefficients(m[f"coefficients_{j}"], stage.system)
            state = list(m[f"state_{j}"])
            if stage.begin is None:
                state, held = _at_rest(stage.system, first, state, held, y)
            share = weights([(sigma if stage.schedule.variable == "speed" else 1.0 / sigma, p[f"gain_nodes_{j}"])])
            gain = _mix(share, p[f"gain_table_{j}"])
            X = resolve[j - 1](sigma)
            expected, innovation = _predict(stage, X, state, held, turned, turning, delta, sigma, y)
            state = [one + sum(g * e for g, e in zip(row, innovation, strict=True))
                     for one, row in zip(expected, gain, strict=False)]  # fmt: skip
            coefficients = _corrected(stage.system, held, gain, turning, innovation)
            updated[f"state_{j}"] = _array(state)
            updated[f"coefficients_{j}"] = _array(_flat(coefficients))
            if j == 1:
                names = [f"innovation{end}" for end in endings(len(innovation))]
                updated |= dict(zip(names, innovation, strict=True))
            y = sum_of(coefficients, turning)
            states = [*state, *states]
        shift = turns_of(order * omega * p.delay, last.harmonics)
        moved = [[product(c, turn) for c in row] for row, turn in zip(coefficients, shift, strict=True)]
        updated |= {f"x_{i}": one for i, one in enumerate(states, start=1)}
        updated |= told_values(frame.reconstructed, moved, turning)
        return updated | dict(extra.values(Reconstruction(moved, turning, omega), p))

    begins = [signal.start for signal in frame.reconstructed]
    if stages[-1].begin is not None:
        begins = stages[-1].begin[1].tolist()
    starts = [value for stage in reversed(stages) for value in _begin(stage)[0]]
    state_unit = frame.reconstructed[0].unit if len(stages) > 1 or len(starts) == 1 else "1"
    innovations = [
        Signal(f"innovation{end}", signal.unit, 0.0, f"{signal.name}, measured less expected")
        for end, signal in zip(endings(len(frame.measured)), frame.measured, strict=True)
    ]
    return Model(
        name=frame.name,
        description=frame.description,
        role="observer",
        equations=lambda t, x, m, u, p: ({}, {}),
        inputs=(
            *frame.measured,
            Signal("angle", "deg", 0.0, "crank angle, counted on"),
            Signal("omega", "rad/s", math.sqrt(frame.low * frame.high), "speed of the crankshaft", frame.high),
            *frame.inputs,
        ),
        discrete=(
            *told_signals(frame.reconstructed, begins, last.harmonics),
            *(Signal(f"x_{i}", state_unit, v, f"state {i}, the last sensor's last") for i, v in enumerate(starts, 1)),
            *innovations,
            Signal("multiplier", "1", frame.multiplier, "largest Floquet multiplier over a period, of all speeds"),
            Signal("variance_gain", "1", frame.variance_gain, "largest variance of w by that of white noise on y"),
            *extra.signals,
            Signal("angle_before", "deg", 0.0, "angle at the last sampling", local=True),
            Signal("omega_before", "rad/s", 0.0, "speed at the last sampling", local=True),
            Signal("begun", "1", 0.0, "1 after the first sampling", local=True),
            *_memories(stages),
        ),
        parameters=(
            Signal("sample_time", "s", 0.0, "0: each step of the part"),
            Signal("delay", "s", frame.delay, "transport from w to what drives the system"),
            Signal("omega_low", "rad/s", frame.low, "lowest speed it was made for; slower counts as that"),
            Signal("omega_high", "rad/s", frame.high, "highest speed it was made for; faster counts as that"),
            *frame.parameters,
            *(
                Signal(f"gain_nodes_{j}", "1", s.schedule.nodes, f"nodes of stage {j}", shape=s.schedule.nodes.shape)
                for j, s in enumerate(stages, start=1)
            ),
            *(
                Signal(f"gain_table_{j}", "1", s.schedule.table, "K by node", shape=s.schedule.table.shape)
                for j, s in enumerate(stages, start=1)
            ),
            *extra.parameters,
        ),
        sample=sample,
        sample_time="sample_time",
    )


def _begin(stage: Stage) -> tuple[Array, Array]:
    n, m = stage.system.A0.shape
    return stage.begin or (np.zeros(n), np.zeros(m))


def _memories(stages: Sequence[Stage]) -> list[Signal]:
    signals = []
    for j, stage in enumerate(stages, start=1):
        state, mean = _begin(stage)
        held = np.concatenate([mean, np.zeros(2 * stage.system.harmonics * len(mean))])
        signals.append(Signal(f"state_{j}", "1", state, f"x of stage {j}", shape=state.shape, local=True))
        signals.append(Signal(f"coefficients_{j}", "1", held, f"c of stage {j}", shape=held.shape, local=True))
    return signals


def _coefficients(flat: Any, system: PeriodicSystem) -> list[list[Pair]]:
    m = system.A0.shape[1]
    rows: list[list[Pair]] = [[(flat[j], 0.0) for j in range(m)]]
    for k in range(1, system.harmonics + 1):
        begin = m * (2 * k - 1)
        rows.append([(flat[begin + j], flat[begin + m + j]) for j in range(m)])
    return rows


def _flat(coefficients: Sequence[Sequence[Pair]]) -> list[Any]:
    flat = [re for re, _ in coefficients[0]]
    for row in coefficients[1:]:
        flat += [re for re, _ in row] + [im for _, im in row]
    return flat


def _at_rest(
    system: PeriodicSystem, first: Any, state: Sequence[Any], held: list[list[Pair]], y: Sequence[Any]
) -> tuple[list[Any], list[list[Pair]]]:
    """At the first sampling the state and c_0 at which y would be at rest, as nearly as least squares can."""
    X = -np.linalg.solve(system.A, system.A0)
    mean = [sum(float(a) * v for a, v in zip(row, y, strict=True)) for row in np.linalg.pinv(system.C @ X)]
    there = [sum(float(a) * v for a, v in zip(row, mean, strict=True)) for row in X]
    begun = [np.where(first, value, one) for value, one in zip(there, state, strict=True)]
    return begun, [[(np.where(first, mean[j], re), 0.0) for j, (re, _) in enumerate(held[0])], *held[1:]]


def _mix(share: Sequence[Any], table: Any) -> list[list[Any]]:
    _, rows, columns = table.shape
    return [[sum(w * table[(k, i, j)] for k, w in enumerate(share)) for j in range(columns)] for i in range(rows)]


def _in_step(X: Sequence[Sequence[Sequence[Pair]]], held: list[list[Pair]], turns: Sequence[Pair]) -> list[Any]:
    """sum_k X_k c_k e^{i k w0 alpha}, (n,)."""
    total: list[Any] = [0.0] * len(X[0])
    for k, (one, row, turn) in enumerate(zip(X, held, turns, strict=True)):
        turned = [product(c, turn) for c in row]
        for i, responses_of_state in enumerate(one):
            for response, d in zip(responses_of_state, turned, strict=True):
                part = product(response, d)[0]
                total[i] = total[i] + (part if k == 0 else 2.0 * part)
    return total


def _predict(
    stage: Stage,
    X: Sequence[Sequence[Sequence[Pair]]],
    state: Sequence[Any],
    held: list[list[Pair]],
    turned: Sequence[Pair],
    turning: Sequence[Pair],
    delta: Any,
    sigma: Any,
    y: Sequence[Any],
) -> tuple[list[Any], list[Any]]:
    """x- (n,) and y - C x- (p,)."""
    system = stage.system
    alone = [one - there for one, there in zip(state, _in_step(X, held, turned), strict=True)]
    interval = delta / sigma if system.per == "s" else delta
    if len(alone) == 1:
        alone = [np.exp(float(system.A[0, 0]) * interval) * alone[0]]
    else:
        for _ in range(stage.parts):
            term = alone
            for order in range(1, TERMS + 1):
                moved = [sum(float(a) * v for a, v in zip(row, term, strict=True) if a != 0.0) for row in system.A]
                term = [v * (interval / (stage.parts * order)) for v in moved]
                alone = [a + v for a, v in zip(alone, term, strict=True)]
    expected = [a + b for a, b in zip(_in_step(X, held, turning), alone, strict=True)]
    innovation = [
        seen - sum(float(c) * v for c, v in zip(row, expected, strict=True) if c != 0.0)
        for seen, row in zip(y, system.C, strict=True)
    ]
    return expected, innovation


def _corrected(
    system: PeriodicSystem,
    held: list[list[Pair]],
    gain: Sequence[Sequence[Any]],
    turning: Sequence[Pair],
    innovation: Sequence[Any],
) -> list[list[Pair]]:
    """c_k + e^{-i k w0 alpha} K_k e."""
    n, m = system.A0.shape
    pushed = [sum(g * e for g, e in zip(row, innovation, strict=True)) for row in gain[n:]]
    found: list[list[Pair]] = [[(held[0][j][0] + pushed[j], 0.0) for j in range(m)]]
    for k in range(1, system.harmonics + 1):
        begin = m * (2 * k - 1)
        cosine, sine = turning[k]
        row = []
        for j, (re, im) in enumerate(held[k]):
            a, b = product((pushed[begin + j], pushed[begin + m + j]), (cosine, -sine))
            row.append((re + a, im + b))
        found.append(row)
    return found


def _array(values: Sequence[Any]) -> Any:
    scalars = [value.item() if isinstance(value, np.ndarray) else value for value in values]
    array = np.empty(len(scalars), dtype=object)
    array[:] = scalars
    return array.astype(float) if all(isinstance(value, (int, float)) for value in scalars) else array
