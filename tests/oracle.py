"""The step loop, its sensors, sources and replays in plain Python: what the C must match bit for bit."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from fmus.component import Component, Vector
from fmus.fmu import FmuComponent
from fmus.units import parse_unit
from harness.clock import CrankGrid, TimeGrid
from harness.coupling import solve_start
from harness.faults import Timed
from harness.points import Points
from harness.replay import ReplayComponent
from harness.sensor import Errors, SensorComponent, lag_weights, split_delay, stream
from harness.source import SourceComponent, Wave
from harness.swap import SwapComponent
from harness.system import Group, Slot, System

DEGREE = math.pi / 180.0


def run_plainly(system: System) -> Vector:
    """All rows of a system's record, time first, shape (rows, 1 + columns), SI."""
    return PlainRun(system).rows()


class PlainRun:
    """A run step by step: the laws of time as the loop has them, with the parts' twins."""

    def __init__(self, system: System) -> None:
        self.system, self.grid = system, system.grid
        self.parts = [twin(slot.component, most_samples(system)) for slot in system.parts]
        self.bus = [parse_unit(signal.unit).to_si(float(signal.start)) for signal in system.bus]
        self.groups = {group.first: group for group in system.groups}
        self.levels = dict.fromkeys(self.groups, 0)
        self.nominals = [abs(signal.nominal * parse_unit(signal.unit).factor) or 1.0 for signal in system.bus]

    def rows(self) -> Vector:
        """Start, then instant after instant."""
        system, grid = self.system, self.grid
        index = 0
        while index < len(self.parts):
            self._start(index)
            group = self.groups.get(index)
            if group is not None and group.torn:
                self._start_loop(group)
                index += group.count
            else:
                index += 1
        self.pasts = [past_of(system.parts[i], part) for i, part in enumerate(self.parts)]
        rows = [[grid.start, *(self.bus[place] for place in system.recorded)]]
        self.stepped = {slot.name: (0, grid.start) for slot in system.parts}
        self.own_steps = {slot.name: 0 for slot in system.parts}
        self.since, self.anchored, self.now = 0, grid.start, grid.start
        self.h = grid.step if isinstance(grid, TimeGrid) else 0.0
        for k in range(1, grid.steps + 1):
            begin = 0
            if isinstance(grid, TimeGrid):
                self.following = grid.start + k * self.h
            else:
                self._turn(k)
                if system.steered is not None:
                    begin = self._steer(k, system.steered.count)
            self._instant(k, begin)
            self.now = self.following
            if k % system.every == 0:
                rows.append([self.following, *(self.bus[place] for place in system.recorded)])
            if isinstance(grid, CrankGrid) and self.following >= grid.stop - 1e-9:
                break
        return np.array(rows).reshape(-1, 1 + len(system.recorded))

    # The clock

    def _missed(self, k: int) -> float:
        grid = self.grid
        nominal = grid.origin + k * grid.numerator / grid.denominator
        return math.remainder(self.bus[self.system.angle] - nominal * DEGREE, 360.0 * DEGREE)

    def _turn(self, k: int) -> None:
        step, speed = self.grid.numerator / self.grid.denominator * DEGREE, self.bus[self.system.speed]
        missed = 0.0 if self.system.angle is None else self._missed(k - 1)
        self._stride(k, (step - missed) / speed if self.system.angle is not None else step / speed)

    def _stride(self, k: int, h: float) -> None:
        if h != self.h:
            self.since, self.anchored, self.h = k - 1, self.now, h
        self.following = self.anchored + (k - self.since) * self.h

    def _steer(self, k: int, count: int) -> int:
        saved = self._keep(0, count)
        while True:
            self._sweep(0, count, self.now, self.h)
            missed, speed = self._missed(k), self.bus[self.system.speed]
            if abs(missed) <= 1e-10 + 4.0 * 2.220446049250313e-16 * abs(self.bus[self.system.angle]):
                return count
            self._restore(0, count, saved)
            self._stride(k, self.h - missed / speed)

    # Parts

    def _inputs(self, index: int) -> Vector:
        return np.array([self.bus[place] for place in self.system.parts[index].inputs])

    def _put(self, index: int, outputs: Any) -> None:
        for place, value in zip(self.system.parts[index].outputs, outputs, strict=True):
            self.bus[place] = float(value)

    def _start(self, index: int) -> None:
        self._put(index, self.parts[index].start(self.grid.start, self._inputs(index)))

    def _instant(self, k: int, begin: int) -> None:
        index = begin
        while index < len(self.parts):
            span = self._span(self.system.parts[index], k)
            group = self.groups.get(index)
            if group is not None:
                if span is not None:
                    solve = self._smaller_steps if group.kind == "smaller steps" else self._solve
                    solve(group, *span)
                index += group.count
                continue
            if span is not None:
                u = self._inputs(index)
                for one in self._own(self.system.parts[index], *span):
                    self._put(index, self.parts[index].step(*one, u))
            index += 1

    def _span(self, slot: Slot, k: int) -> tuple[float, float] | None:
        """Begin and length of the step to instant k; None where the part is not stepped to it."""
        pace, (last, last_time) = slot.pace, self.stepped[slot.name]
        if not (pace.due[k % self.grid.cycle] if pace.due else k % pace.period == 0):
            return None
        self.stepped[slot.name] = (k, self.following)
        if isinstance(self.grid, TimeGrid):
            return self.grid.start + last * self.h, (k - last) * self.h
        return last_time, (k - last) * self.h if last >= self.since else self.following - last_time

    def _own(self, slot: Slot, begin: float, length: float) -> list[tuple[float, float]]:
        """The steps of a part that keeps a grid of its own; the one step of any other."""
        own = slot.pace.own
        if not own:
            return [(begin, length)]
        spans, made = [], self.own_steps[slot.name]
        while self.grid.start + (made + 1) * own <= begin + length + 1e-6 * own:
            spans.append((self.grid.start + made * own, own))
            made += 1
        self.own_steps[slot.name] = made
        return spans

    # Parts that are stepped together

    def _keep(self, first: int, count: int) -> list[float]:
        for past in self.pasts[first : first + count]:
            past.keep()
        return list(self.bus)

    def _restore(self, first: int, count: int, saved: list[float]) -> None:
        for index in range(first, first + count):
            self.pasts[index].restore()
            for place in self.system.parts[index].outputs:
                self.bus[place] = saved[place]

    def _sweep(self, first: int, count: int, t: float, h: float) -> None:
        for index in range(first, first + count):
            self._put(index, self.parts[index].step(t, h, self._inputs(index)))

    def _start_loop(self, group: Group) -> None:
        given, made = ([pair[side] for pair in group.torn] for side in (0, 1))

        def make(guess: Vector) -> Vector:
            for place, value in zip(given, guess, strict=True):
                self.bus[place] = float(value)
            for index in range(group.first + 1, group.first + group.count):
                self._start(index)
            return np.array([self.bus[place] for place in made])

        nominals = np.array([self.nominals[place] for place in made])
        solve_start(make, np.array([self.bus[place] for place in given]), nominals, self.system.coupling)

    def _solve(self, group: Group, t: float, h: float) -> None:
        settings, first, count = self.system.coupling, group.first, group.count
        given, made = ([pair[side] for pair in group.torn] for side in (0, 1))
        n = len(given)
        nominals = [self.nominals[place] for place in made]
        saved = self._keep(first, count)
        self._sweep(first, 1, t, h)
        guess = [self.bus[place] for place in given]

        def evaluate() -> list[float]:
            self._restore(first, count, saved)
            for place, value in zip(given, guess, strict=True):
                self.bus[place] = value
            self._sweep(first + 1, count - 1, t, h)
            return [self.bus[place] for place in made]

        while True:
            found = evaluate()
            residual = [one - other for one, other in zip(found, guess, strict=True)]
            sizes = [max(abs(a), abs(b), c) for a, b, c in zip(found, guess, nominals, strict=True)]
            if max(abs(r) / size for r, size in zip(residual, sizes, strict=True)) <= settings.tolerance:
                return
            share = settings.relaxation
            if settings.solve == "newton":
                matrix = self._jacobian(group, guess, found, evaluate, nominals)
                residual = [r / nominal for r, nominal in zip(residual, nominals, strict=True)]
                eliminate(matrix, residual)
                residual = [r * nominal for r, nominal in zip(residual, nominals, strict=True)]
                share = 1.0
            for i in range(n):
                guess[i] += share * residual[i]

    def _jacobian(
        self, group: Group, guess: list[float], found: list[float], evaluate: Any, nominals: list[float]
    ) -> list[list[float]]:
        """1 - dG/dz in units of the nominal values, by the derivatives of the parts where all have them."""
        n = len(guess)
        matrix = [[0.0] * n for _ in range(n)]
        members = range(group.first + 1, group.first + group.count)
        given = all(self.pasts[index].derivative is not None for index in members)
        for column in range(n):
            width = 1.0
            if given:
                slopes = [0.0] * len(self.bus)
                slopes[group.torn[column][0]] = 1.0
                for index in members:
                    slot = self.system.parts[index]
                    changed = self.pasts[index].derivative([slopes[place] for place in slot.inputs])
                    for place, value in zip(slot.outputs, changed, strict=True):
                        slopes[place] = value
                changes = [slopes[made] for _, made in group.torn]
            else:
                kept = guess[column]
                guess[column] += 1e-7 * max(abs(kept), nominals[column])
                width = guess[column] - kept
                changes = [one - other for one, other in zip(evaluate(), found, strict=True)]
                guess[column] = kept
            for i in range(n):
                matrix[i][column] = (i == column) - changes[i] / width * nominals[column] / nominals[i]
        return matrix

    def _smaller_steps(self, group: Group, t: float, h: float) -> None:
        first, count, wanted = group.first, group.count, self.system.coupling.error
        places = [place for index in range(first, first + count) for place in self.system.parts[index].outputs]
        whole, done = 1 << 20, 0
        while done < whole:
            share = whole >> self.levels[first]
            begin, length = t + h * done / whole, h * share / whole
            middle = begin + 0.5 * length
            saved = self._keep(first, count)
            self._sweep(first, count, begin, length)
            other = [self.bus[place] for place in places]
            self._restore(first, count, saved)
            self._sweep(first, count, begin, middle - begin)
            self._sweep(first, count, middle, begin + length - middle)
            missed = max(
                abs(self.bus[place] - one) / max(abs(self.bus[place]), self.nominals[place])
                for place, one in zip(places, other, strict=True)
            )
            if missed <= wanted:
                done += share
                if self.levels[first] and missed < 0.1 * wanted and done % (2 * share) == 0:
                    self.levels[first] -= 1
            else:
                self.levels[first] += 1
                self._restore(first, count, saved)


def eliminate(matrix: list[list[float]], b: list[float]) -> None:
    """Solve in place by elimination with pivoting by rows relative to their largest entry, or one."""
    n = len(b)
    for c in range(n):
        sizes = [abs(matrix[i][c]) / max(1.0, *(abs(v) for v in matrix[i][c:])) for i in range(c, n)]
        best = c + sizes.index(max(sizes))
        matrix[c], matrix[best], b[c], b[best] = matrix[best], matrix[c], b[best], b[c]
        for i in range(c + 1, n):
            factor = matrix[i][c] / matrix[c][c]
            matrix[i] = [*matrix[i][:c], *(v - factor * p for v, p in zip(matrix[i][c:], matrix[c][c:], strict=True))]
            b[i] -= factor * b[c]
    for i in reversed(range(n)):
        for j in range(i + 1, n):
            b[i] -= matrix[i][j] * b[j]
        b[i] /= matrix[i][i]


class Past(NamedTuple):
    """How the oracle takes a part back; `derivative` is None where C has none."""

    keep: Callable[[], Any]
    restore: Callable[[], Any]
    derivative: Callable[[list[float]], list[float]] | None = None


_Move = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p)
_Derive = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p)


def past_of(slot: Slot, part: Any) -> Past:
    """The way back of a twin by its own methods, of an FMU by the functions that C calls, of others none."""
    if not isinstance(part, FmuComponent):
        nothing = lambda: None  # noqa: E731
        return Past(getattr(part, "keep", nothing), getattr(part, "restore", nothing))
    way = part.reversal()
    if way is None:
        return Past(lambda: None, lambda: None)

    def derivative(du: list[float]) -> list[float]:
        given, found = np.array(du), np.zeros(len(slot.outputs))
        _Derive(way.derivative)(way.self, given.ctypes.data, found.ctypes.data)
        return list(found)

    moves = [partial(_Move(function), way.self) for function in (way.keep, way.restore)]
    return Past(*moves, derivative if way.derivative else None)


def most_samples(system: System) -> int:
    """How many samples a sensor can take at the most."""
    grid = system.grid
    return grid.steps + 1 if isinstance(grid, TimeGrid) else min(grid.steps, 100_000) + 1


def twin(component: Component, samples: int) -> Component | SensorTwin | SwapTwin | SourceTwin | ReplayTwin:
    """The plain-Python twin of a sensor, swap, source or replay good for so many samples; any other is its own."""
    if isinstance(component, SensorComponent):
        return SensorTwin(component.errors, component.period, component.seed, component.part, samples, component.timed)
    if isinstance(component, SwapComponent):
        return SwapTwin(component)
    if isinstance(component, ReplayComponent):
        return ReplayTwin(component)
    return SourceTwin(component) if isinstance(component, SourceComponent) else component


class SensorTwin:
    """A sensor that draws all its random numbers at once and keeps the whole history of what it delays."""

    def __init__(self, errors: Errors, period: float, seed: int, part: str, samples: int, timed: Timed = "end") -> None:
        self.errors, self.period, self.timed = errors, period, timed
        self.normals = stream(seed, part, "noise").standard_normal(samples)
        self.uniforms = stream(seed, part, "drop_out").random(samples)

    def keep(self) -> None:
        """Remember how long its history is, and since when its faults act."""
        self.kept = len(self.signal)
        self.kept_acted = [list(times) for times in self.acted]

    def restore(self) -> None:
        """Forget what came after."""
        for history in (self.lagged, self.signal, self.readings, self.times, self.waited):
            del history[self.kept :]
        self.acted = [list(times) for times in self.kept_acted]

    def start(self, t0: float, u: Sequence[float]) -> list[float]:
        """The initialised reading, and the fault that acts."""
        self.lagged: list[float] = [float(u[0])]
        self.signal: list[float] = [float(u[0])]
        self.times, self.waited = [t0], [float(u[0])]
        self.acted: list[list[float]] = [[] for _ in self.errors.faults]  # the times of the samples in a row
        self._look(t0, 0)
        self.readings = [self._disturbed(self._late(0), t0, 0)]
        return self._told()

    def step(self, t: float, h: float, u: Sequence[float]) -> list[float]:
        """The reading at t + h, and the fault that acts."""
        errors = self.errors
        self.signal.append(float(u[0]))
        if errors.lag:
            decay, older, newer = lag_weights(errors.lag, self.period or h)
            self.lagged.append(decay * self.lagged[-1] + older * self.signal[-2] + newer * self.signal[-1])
        else:
            self.lagged.append(self.signal[-1])
        k = len(self.signal) - 1
        now, sample = (t, k - 1) if self.timed == "begin" else (t + h, k)
        self._look(now, sample)
        self.times.append(now)
        self.waited.append(self._awaited(now) if errors.delay and not self.period else self.lagged[-1])
        reading = self._disturbed(self._late(k), now, k)
        kept, stuck = 1.0 - errors.drop_out, False
        for fault, times in zip(errors.faults, self.acted, strict=True):
            if times and fault.kind == "drop_out":
                kept *= 1.0 - fault.value
            stuck = stuck or bool(times and fault.kind == "stuck")
        self.readings.append(self.readings[-1] if stuck or self.uniforms[k] < 1.0 - kept else reading)
        return self._told()

    def _look(self, now: float, sample: int) -> None:
        for fault, times in zip(self.errors.faults, self.acted, strict=True):
            if fault.window.holds(now, 1e-6 * (self.period or 1e-3), sample):
                times.append(now)
            else:
                times.clear()

    def _told(self) -> list[float]:
        codes = [float(fault.code) for fault, times in zip(self.errors.faults, self.acted, strict=True) if times]
        return [self.readings[-1], *([[*codes, 0.0][0]] if self.errors.faults else [])]

    def _late(self, k: int) -> float:
        delay = self.errors.delay / self.period if self.errors.delay and self.period else 0.0
        for fault, times in zip(self.errors.faults, self.acted, strict=True):
            if fault.kind == "delay" and times:
                delay += min(fault.value, float(len(times)))
        whole, fraction = split_delay(delay, 1.0)
        late, later = self.waited[max(k - whole, 0)], self.waited[max(k - whole - 1, 0)]
        return late if fraction == 0.0 else late + fraction * (later - late)

    def _awaited(self, now: float) -> float:
        """The lagged signal a delay ago, linear between the samples' own times."""
        then = now - self.errors.delay
        place = max((i for i, time in enumerate(self.times) if time <= then), default=0)
        early, early_time = self.lagged[place], self.times[place]
        if place == len(self.times) - 1 or early_time >= then:
            return early
        share = (then - early_time) / (self.times[place + 1] - early_time)
        return early + share * (self.lagged[place + 1] - early)

    def _disturbed(self, value: float, now: float, k: int) -> float:
        errors = self.errors
        value = value * errors.gain + errors.bias
        variance = errors.noise * errors.noise
        for fault, times in zip(errors.faults, self.acted, strict=True):
            if not times:
                continue
            if fault.kind == "bias":
                value += fault.value
            elif fault.kind == "gain":
                value *= fault.value
            elif fault.kind == "drift":
                start = fault.window.start
                value += fault.value * (now - (start if math.isfinite(start) else times[0]))
            elif fault.kind == "noise":
                variance += fault.value * fault.value
        if variance > 0.0:
            value += math.sqrt(variance) * float(self.normals[k])
        if errors.resolution > 0.0:
            value = errors.resolution * float(np.rint(value / errors.resolution))
        return min(max(value, errors.lowest), errors.highest)


class SwapTwin:
    """Two signals, crossed where the window says so."""

    def __init__(self, swap: SwapComponent) -> None:
        self.swap = swap

    def keep(self) -> None:
        """Remember the sample."""
        self.kept = self.k

    def restore(self) -> None:
        """Go back to it."""
        self.k = self.kept

    def start(self, t0: float, u: Sequence[float]) -> list[float]:
        """Both at t0, and the code."""
        self.k = 0
        return self._crossed(t0, 0, u)

    def step(self, t: float, h: float, u: Sequence[float]) -> list[float]:
        """Both at t + h, and the code."""
        self.k += 1
        early = self.swap.timed == "begin"
        return self._crossed(t if early else t + h, self.k - 1 if early else self.k, u)

    def _crossed(self, now: float, sample: int, u: Sequence[float]) -> list[float]:
        if self.swap.window.holds(now, 1e-6 * (self.swap.period or 1e-3), sample):
            return [float(u[1]), float(u[0]), float(self.swap.code)]
        return [float(u[0]), float(u[1]), 0.0]


class SourceTwin:
    """A source looked up point by point, or its wave."""

    def __init__(self, source: SourceComponent) -> None:
        self.given = source.given

    def start(self, t0: float, u: Sequence[float]) -> list[float]:
        """The value at t0."""
        self.t0 = t0
        return self.step(t0, 0.0, u)

    def step(self, t: float, h: float, u: Sequence[float]) -> list[float]:
        """The value at t."""
        return [points_at(self.given, t) if isinstance(self.given, Points) else self._wave(self.given, t)]

    def _wave(self, wave: Wave, t: float) -> float:
        x = t - (self.t0 if wave.begin is None else wave.begin)
        if wave.shape == "sine":
            return wave.mean + wave.amplitude * math.sin(wave.omega * x + wave.phase)
        x = min(max(x, 0.0), wave.duration)
        if wave.shape == "linear chirp":
            angle = (wave.omega + wave.rate * x) * x + wave.phase
        else:
            angle = wave.omega * (math.expm1(wave.rate * x) / wave.rate) + wave.phase
        return wave.mean + wave.amplitude * math.sin(angle)


class ReplayTwin:
    """A replay looked up point by point."""

    def __init__(self, replay: ReplayComponent) -> None:
        self.points, self.clock = replay.points, replay.clock

    def start(self, t0: float, u: Sequence[float]) -> list[float]:
        """What was recorded at t0, or at the origin."""
        self.k = 0
        return self._values(t0)

    def step(self, t: float, h: float, u: Sequence[float]) -> list[float]:
        """What was recorded at t + h, or at the next crank angle."""
        self.k += 1
        return self._values(t + h)

    def keep(self) -> None:
        """Remember which instant it is at."""
        self.kept = self.k

    def restore(self) -> None:
        """Go back there."""
        self.k = self.kept

    def _values(self, t: float) -> list[float]:
        clock = self.clock
        at = t if clock is None else clock.origin + self.k * clock.numerator / clock.denominator
        return [points_at(points, at) for points in self.points]


def points_at(points: Points, t: float) -> float:
    """The value of points at a time. Raises LookupError: they do not reach so far."""
    times, values, edge = points.times.tolist(), points.values.tolist(), points.edge
    if points.ends == "error" and not times[0] - edge <= t <= times[-1] + edge:
        raise LookupError(t)
    if points.ends == "repeat":
        span = times[-1] - times[0]
        since = math.fmod(t - times[0], span)
        since = since + span if since < 0.0 else since
        t = times[0] + (0.0 if since + edge >= span else since)
    past = [index for index, time in enumerate(times) if time <= t + edge]
    before = past[-1] if past else 0
    if points.between == "hold" or before == len(times) - 1 or t <= times[before] + edge:
        return float(values[before])
    share = (t - times[before]) / (times[before + 1] - times[before])
    return float(values[before] + share * (values[before + 1] - values[before]))
