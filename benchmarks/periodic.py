"""A periodic-input observer as an exported FMU in the step loop, beside Eq. 4 in plain NumPy, over h and n."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks.growth import Line, line
from benchmarks.measure import Measure, side_by_side
from benchmarks.ours import OurLoop
from fmus.model import Model
from fmus.tracing import trace
from observers import lag_inversion, periodic_input
from observers.periodic import PeriodicSystem, gains_of, responses, transition
from observers.periodic_design import design

Array = NDArray[np.float64]

DEGREES = 6.0
STEP = math.radians(DEGREES)
PERIOD = 4.0 * math.pi
OMEGA = 157.0  # rad/s
MULTIPLIER = 0.5
PEER = "Eq. 4 in NumPy"
# At least so many times slower is the observer in NumPy wanted to be.
WANTED = 20.0
HARMONICS, STATES, STAGES = (1, 3, 7, 15, 31), (1, 2, 3, 4, 6), (1, 2, 4, 8, 16)
# The FMU counts its angles modulo 360 deg and gets X_k by polynomials: the rows are alike to that.
SAME = 1e-7


class Costs(NamedTuple):
    """Measures of one step against the number of harmonics of one lag, of states, and of lags in a cascade.

    `operations` are those of the traced sampling, by the same numbers.
    """

    harmonics: list[Measure]
    states: list[Measure]
    stages: list[Measure]
    operations: tuple[tuple[int, ...], tuple[int, ...], tuple[int, ...]]

    @property
    def measures(self) -> list[Measure]:
        """All of them."""
        return [*self.harmonics, *self.states, *self.stages]

    def lines(self) -> tuple[Line, Line, Line]:
        """The lines through the operations over harmonics, states and stages."""
        counts = (HARMONICS, STATES, STAGES)
        found = [line(x, y) for x, y in zip(counts, self.operations, strict=True)]
        return found[0], found[1], found[2]


class NumpyObserver:
    """Eq. 4 sampled, at a constant speed, as one writes it in NumPy: everything that stays is computed beforehand.

    x- = X d_k + e^{A delta} (x - X d_{k-1}), then x and c_k corrected; `step` returns w.
    """

    def __init__(self, system: PeriodicSystem, gain: Array, omega: float) -> None:
        n = len(system.A)
        gains = gains_of(gain, system)
        self.orders = 1j * system.order * np.arange(system.harmonics + 1)
        self.weights = np.where(np.arange(system.harmonics + 1) == 0, 1.0, 2.0)
        self.X = responses(system, omega)[:, :, 0].T * self.weights
        self.alone = transition(system, omega, STEP)[:n, :n]
        self.C, self.K, self.K_k = system.C[0], gains.state[:, 0], gains.harmonics[:, 0, 0]
        self.x, self.c = np.zeros(n), np.zeros(system.harmonics + 1, dtype=complex)
        self.turn = np.exp(self.orders * -STEP)

    def step(self, y: float, alpha: float) -> float:
        """One sampling at the crank angle `alpha` [rad]."""
        before = (self.X @ (self.c * self.turn)).real
        self.turn = np.exp(self.orders * alpha)
        self.x = (self.X @ (self.c * self.turn)).real + self.alone @ (self.x - before)
        e = y - self.C @ self.x
        self.x = self.x + self.K * e
        self.c = self.c + self.turn.conj() * self.K_k * e
        return float(self.weights @ (self.c * self.turn).real)


def beside_numpy(rounds: int = 20) -> Costs:
    """One step of each, in the platform's loop and in a loop in Python, over h, n and the lags of a cascade.

    Raises RuntimeError: the two do not tell the same w.
    """
    over_h = [_one(f"h = {h}", _chain(1, h), rounds) for h in HARMONICS]
    over_n = [_one(f"n = {n}", _chain(n, 3), rounds) for n in STATES]
    over_stages = [_cascade(count, rounds) for count in STAGES]
    operations = (
        tuple(_operations(_observer(_chain(1, h))) for h in HARMONICS),
        tuple(_operations(_observer(_chain(n, 3))) for n in STATES),
        tuple(_operations(_lags(count)) for count in STAGES),
    )
    return Costs(over_h, over_n, over_stages, operations)


def _chain(n: int, harmonics: int) -> PeriodicSystem:
    """n lags in a row, of time constants from 10 ms on."""
    taus = 0.010 + 0.002 * np.arange(n)
    A = np.diag(-1.0 / taus) + np.diag(1.0 / taus[1:], -1)
    return PeriodicSystem(A, np.eye(n, 1) / taus[0], np.eye(1, n, n - 1), PERIOD, harmonics)


def _setting(system: PeriodicSystem) -> dict[str, object]:
    matrices = {"A": system.A.tolist(), "A0": system.A0.tolist(), "C": system.C.tolist()}
    return {**matrices, "harmonics": system.harmonics, "speed": f"[{OMEGA}, {OMEGA}] rad/s",
            "gains": {"design": {"multiplier": MULTIPLIER}}}  # fmt: skip


def _observer(system: PeriodicSystem) -> Model:
    return periodic_input.make(**_setting(system))  # type: ignore[arg-type]


def _lags(count: int) -> Model:
    taus = [f"{10 + 2 * j} ms" for j in range(count)]
    return lag_inversion.make(taus, {"published": {"per": "sample"}}, speed=f"[{OMEGA}, {OMEGA}] rad/s")


def _operations(model: Model) -> int:
    return int(trace(model).sample.n_instructions())


def _loop(use: str, settings: dict[str, object], steps: int) -> OurLoop:
    """The observer on sources: a sine for y, the angle a ramp."""
    h, end = STEP / OMEGA, steps * STEP / OMEGA
    turned = f"{steps * DEGREES!r} deg"
    sine = {"mean": "1", "amplitude": "1", "frequency": f"{OMEGA / PERIOD!r} Hz"}
    ramp = {"at": "0 s", "until": f"{end!r} s", "from": "0 deg", "to": turned}
    parts = {
        "y": {"use": "source", "unit": "1", "sine": sine},
        "angle": {"use": "source", "unit": "deg", "ramp": ramp},
        "omega": {"use": "source", "unit": "rad/s", "constant": f"{OMEGA} rad/s"},
        "observer": {"use": use, "with": settings, "wires": {"y": "y", "angle": "angle", "omega": "omega"}},
    }
    return OurLoop(parts, h, steps, record=["y", "angle", "observer.w"])


def _one(name: str, system: PeriodicSystem, rounds: int, steps: int = 5_000) -> Measure:
    gain = design(system, OMEGA, STEP, MULTIPLIER)
    with _loop("observers.periodic_input", _setting(system) | {"start": 0}, steps) as ours:
        ours()
        seen, angles = ours.rows[:, 1].copy(), ours.rows[:, 2].copy()
        found: list[float] = []

        def peer() -> float:
            observer = NumpyObserver(system, gain, OMEGA)
            found.clear()
            begin = time.process_time()
            found.extend(observer.step(y, alpha) for y, alpha in zip(seen.tolist(), angles.tolist(), strict=True))
            return (time.process_time() - begin) / steps

        times = side_by_side(ours, peer, rounds)
        _check(name, ours.rows[:, 3], found)
    return Measure(f"periodic-input observer, {name}", *times, PEER, 1.0 / WANTED)


def _cascade(count: int, rounds: int, steps: int = 5_000) -> Measure:
    model = _lags(count)
    tables = {signal.name: np.asarray(signal.start) for signal in model.parameters}
    gains = [tables[f"gain_table_{j}"][0] for j in range(1, count + 1)]
    one = PeriodicSystem(-np.eye(1), np.eye(1), np.eye(1), PERIOD, 3)
    sigmas = [OMEGA * (0.010 + 0.002 * j) for j in reversed(range(count))]
    settings: dict[str, object] = {
        "time_constants": [f"{10 + 2 * j} ms" for j in range(count)], "gains": {"published": {"per": "sample"}},
        "speed": f"[{OMEGA}, {OMEGA}] rad/s", "start": 0,
    }  # fmt: skip
    with _loop("observers.lag_inversion", settings, steps) as ours:
        ours()
        seen, angles = ours.rows[:, 1].copy(), ours.rows[:, 2].copy()
        found: list[float] = []

        def peer() -> float:
            stages = [NumpyObserver(one, K, sigma) for K, sigma in zip(gains, sigmas, strict=True)]
            found.clear()
            begin = time.process_time()
            for y, alpha in zip(seen.tolist(), angles.tolist(), strict=True):
                for stage in stages:
                    y = stage.step(y, alpha)
                found.append(y)
            return (time.process_time() - begin) / steps

        times = side_by_side(ours, peer, rounds)
        called = "1 lag" if count == 1 else f"{count} lags in a row"
        _check(called, ours.rows[:, 3], found)
    return Measure(f"periodic-input observers, {called}", *times, PEER, 1.0 / WANTED)


def _check(name: str, ours: Array, peer: Sequence[float]) -> None:
    away = float(np.abs(ours - np.array(peer)).max() / np.abs(ours).max())
    if not away < SAME:
        raise RuntimeError(f"{name}: the w of {PEER} is {away:.3g} of its size away from ours")
