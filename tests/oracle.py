"""The step loop, its sensors and its sources in plain Python: what the C must match bit for bit."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from fmus.component import Component, Vector
from fmus.units import parse_unit
from harness.clock import CrankGrid, TimeGrid
from harness.sensor import Errors, SensorComponent, lag_weights, split_delay, stream
from harness.source import SourceComponent
from harness.system import System


def run_plainly(system: System) -> Vector:
    """All rows of a system's record, time first, shape (rows, 1 + columns), SI."""
    grid = system.grid
    parts = [(slot, twin(slot.component, most_samples(system))) for slot in system.parts]
    bus = [parse_unit(signal.unit).to_si(float(signal.start)) for signal in system.bus]
    for slot, part in parts:
        outputs = part.start(grid.start, np.array([bus[place] for place in slot.inputs]))
        for place, value in zip(slot.outputs, outputs, strict=True):
            bus[place] = float(value)
    rows = [[grid.start, *(bus[place] for place in system.recorded)]]
    stepped = {slot.name: (0, grid.start) for slot, _ in parts}
    own_steps = {slot.name: 0 for slot, _ in parts}
    since, anchored, now, h = 0, grid.start, grid.start, grid.step if isinstance(grid, TimeGrid) else 0.0
    for k in range(1, grid.steps + 1):
        if isinstance(grid, TimeGrid):
            following = grid.start + k * h
        else:
            step, speed = grid.numerator / grid.denominator * (math.pi / 180.0), bus[system.speed]
            wanted = step / speed
            if system.angle is not None:
                nominal = grid.origin + (k - 1) * grid.numerator / grid.denominator
                missed = math.remainder(bus[system.angle] - nominal * (math.pi / 180.0), 360.0 * (math.pi / 180.0))
                wanted = (step - missed) / speed
            if wanted != h:
                since, anchored, h = k - 1, now, wanted
            following = anchored + (k - since) * h
        for slot, part in parts:
            last, last_time = stepped[slot.name]
            pace = slot.pace
            if not (pace.due[k % grid.cycle] if pace.due else k % pace.period == 0):
                continue
            stepped[slot.name] = (k, following)
            if isinstance(grid, TimeGrid):
                begin, length = grid.start + last * h, (k - last) * h
            else:
                begin, length = last_time, (k - last) * h if last >= since else following - last_time
            spans = [(begin, length)]
            if pace.own:
                spans = []
                made = own_steps[slot.name]
                while grid.start + (made + 1) * pace.own <= begin + length + 1e-6 * pace.own:
                    spans.append((grid.start + made * pace.own, pace.own))
                    made += 1
                own_steps[slot.name] = made
            u = np.array([bus[place] for place in slot.inputs])
            for span in spans:
                outputs = part.step(*span, u)
                for place, value in zip(slot.outputs, outputs, strict=True):
                    bus[place] = float(value)
        now = following
        if k % system.every == 0:
            rows.append([following, *(bus[place] for place in system.recorded)])
        if isinstance(grid, CrankGrid) and following >= grid.stop - 1e-9:
            break
    return np.array(rows).reshape(-1, 1 + len(system.recorded))


def most_samples(system: System) -> int:
    """How many samples a sensor can take at the most."""
    grid = system.grid
    return grid.steps + 1 if isinstance(grid, TimeGrid) else min(grid.steps, 100_000) + 1


def twin(component: Component, samples: int) -> Component | SensorTwin | SourceTwin:
    """The plain-Python twin of a sensor or source good for so many samples; any other component is its own."""
    if isinstance(component, SensorComponent):
        return SensorTwin(component.errors, component.period, component.seed, component.part, samples)
    return SourceTwin(component) if isinstance(component, SourceComponent) else component


class SensorTwin:
    """A sensor that draws all its random numbers at once and keeps the whole history of what it delays."""

    def __init__(self, errors: Errors, period: float, seed: int, part: str, samples: int) -> None:
        self.errors, self.period = errors, period
        self.normals = stream(seed, part, "noise").standard_normal(samples)
        self.uniforms = stream(seed, part, "drop_out").random(samples)

    def start(self, t0: float, u: Sequence[float]) -> list[float]:
        """The initialised reading."""
        self.lagged: list[float] = [float(u[0])]
        self.signal: list[float] = [float(u[0])]
        self.readings = [self._disturbed(float(u[0]), t0, 0)]
        return self.readings[-1:]

    def step(self, t: float, h: float, u: Sequence[float]) -> list[float]:
        """The reading at t + h."""
        errors, now = self.errors, t + h
        self.signal.append(float(u[0]))
        if errors.lag:
            decay, older, newer = lag_weights(errors.lag, self.period)
            self.lagged.append(decay * self.lagged[-1] + older * self.signal[-2] + newer * self.signal[-1])
        else:
            self.lagged.append(self.signal[-1])
        k = len(self.signal) - 1
        whole, fraction = split_delay(errors.delay, self.period)
        late, later = self.lagged[max(k - whole, 0)], self.lagged[max(k - whole - 1, 0)]
        reading = self._disturbed(late if fraction == 0.0 else late + fraction * (later - late), now, k)
        kept = 1.0 - errors.drop_out
        for fault in self._active(now, "drop_out"):
            kept *= 1.0 - fault
        stuck = any(True for _ in self._active(now, "stuck"))
        self.readings.append(self.readings[-1] if stuck or self.uniforms[k] < 1.0 - kept else reading)
        return self.readings[-1:]

    def _active(self, now: float, *kinds: str) -> list[float]:
        edge = 1e-6 * self.period
        return [f.value for f in self.errors.faults if f.kind in kinds and f.start - edge <= now < f.until - edge]

    def _disturbed(self, value: float, now: float, k: int) -> float:
        errors, edge = self.errors, 1e-6 * self.period
        value = value * errors.gain + errors.bias
        variance = errors.noise * errors.noise
        for fault in errors.faults:
            if not fault.start - edge <= now < fault.until - edge:
                continue
            if fault.kind == "bias":
                value += fault.value
            elif fault.kind == "gain":
                value *= fault.value
            elif fault.kind == "drift":
                value += fault.value * (now - fault.start)
            elif fault.kind == "noise":
                variance += fault.value * fault.value
        if variance > 0.0:
            value += math.sqrt(variance) * float(self.normals[k])
        if errors.resolution > 0.0:
            value = errors.resolution * float(np.rint(value / errors.resolution))
        return min(max(value, errors.lowest), errors.highest)


class SourceTwin:
    """A source looked up point by point."""

    def __init__(self, source: SourceComponent) -> None:
        self.source = source

    def start(self, t0: float, u: Sequence[float]) -> list[float]:
        """The value at t0."""
        self.t0 = t0
        return self.step(t0, 0.0, u)

    def step(self, t: float, h: float, u: Sequence[float]) -> list[float]:
        """The value at t."""
        source, times, values = self.source, list(self.source.times), list(self.source.values)
        if source.shape == "sine":
            return [source.mean + source.amplitude * math.sin(source.omega * (t - self.t0) + source.phase)]
        if source.shape == "hold":
            past = [value for time, value in zip(times, values, strict=True) if time <= t + source.edge]
            return [float(past[-1] if past else values[0])]
        if t <= times[0] or t >= times[-1]:
            return [float(values[0] if t <= times[0] else values[-1])]
        after = next(index for index, time in enumerate(times) if time > t)
        share = (t - times[after - 1]) / (times[after] - times[after - 1])
        return [float(values[after - 1] + share * (values[after] - values[after - 1]))]
