"""Sensors: what is wrong between a signal and its reading. The arithmetic is in sensor.c, the numbers of chance here.

Reading k measures the signal at the end of step k; reading 0 is the initialised one. With u_k the samples of the
signal and H the sample time,

    x_k = a x_{k-1} + (r - a) u_{k-1} + (1 - r) u_k,   a = exp(-H/lag),  r = (1 - a) lag/H,   x_0 = u_0

is the first-order lag, exact for a signal that is linear between samples; a delay of (m + f) H, m whole, reads
(1 - f) x_{k-m} + f x_{k-m-1}, and before the first sample the signal is taken to have been u_0. On a crank clock H is
the length of each step, and a delay D reads x at t_k - D, linear between the samples' own times. Then come gain, bias,
the faults in the order they are listed, noise, drop-out, quantisation and limits. A lost sample and a stuck sensor
repeat the last reading as it was; the first sample is neither. Faults of noise add in quadrature, faults of drop-out
as independent losses. A fault of delay D that acts on its n-th sample in a row adds min(D, n) samples to the delay:
the signal stands as it was last read until what is late arrives, and when the fault ends, what was under way is lost.
When a fault acts says faults.py.
"""

from __future__ import annotations

import ctypes
import hashlib
import math
from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from fmus.component import ERROR, OK, Native, Reversal, Role, Signal, StepError, Vector
from harness.faults import (
    MOST_DELAYED_SAMPLES,
    ActingFault,
    CFault,
    Sampling,
    Timed,
    c_faults,
    edge,
    fault_signal,
    latest,
    read_faults,
)
from harness.findings import Findings
from harness.native import address, call, native_reversal, native_step
from harness.scenario import SensorPart

BLOCK = 4096
# A delay on a crank clock has places for the samples of a speed up to this [rad/s]: 20,000 rpm.
FASTEST = 20_000.0 * 2.0 * math.pi / 60.0
# Samples that may follow a kept state, as in sensor.c.
REVERSIBLE = 64
# Faults after which a reading is still a value that the signal had.
REPEATING = ("stuck", "drop_out", "delay")


def stream(seed: int, part: str, purpose: str) -> np.random.Generator:
    """The random numbers of one purpose of one part: they depend on these three and on nothing else in the scenario."""
    names = [hashlib.sha256(name.encode()).digest() for name in (part, purpose)]
    words = [int.from_bytes(digest[i : i + 4], "little") for digest in names for i in range(0, 32, 4)]
    return np.random.Generator(np.random.Philox(np.random.SeedSequence([seed, *words])))


class Errors(NamedTuple):
    """What a sensor does to its signal, in SI. The default is the identity."""

    lag: float = 0.0
    delay: float = 0.0
    gain: float = 1.0
    bias: float = 0.0
    noise: float = 0.0
    drop_out: float = 0.0
    resolution: float = 0.0
    lowest: float = -math.inf
    highest: float = math.inf
    faults: tuple[ActingFault, ...] = ()

    @property
    def normals(self) -> bool:
        """Whether it takes a normal number a sample."""
        return self.noise > 0.0 or any(fault.kind == "noise" for fault in self.faults)

    @property
    def uniforms(self) -> bool:
        """Whether it takes a uniform number a sample."""
        return self.drop_out > 0.0 or any(fault.kind == "drop_out" for fault in self.faults)

    def repeat(self, period: float) -> bool:
        """Whether every reading, one a `period` [s], is a value that the signal had at some sample."""
        if period == 0.0 and self.delay:
            return False
        late = [split_delay(self.delay, period), *(split_delay(f.value, 1.0) for f in self.faults if f.kind == "delay")]
        return (
            self._replace(delay=0.0, drop_out=0.0, faults=()) == Errors()
            and all(fraction == 0.0 for _, fraction in late)
            and all(fault.kind in REPEATING for fault in self.faults)
        )


def split_delay(delay: float, period: float) -> tuple[int, float]:
    """Whole samples and the fraction of one in a delay [s] at a sample time [s]; a billionth of a sample is none."""
    if delay == 0.0:
        return 0, 0.0
    samples = delay / period
    whole = math.floor(samples + 1e-9)
    fraction = samples - whole
    return whole, 0.0 if fraction < 1e-9 else fraction


def lag_weights(lag: float, period: float) -> tuple[float, float, float]:
    """The weights of x_{k-1}, u_{k-1} and u_k in x_k, for a lag and a sample time [s]."""
    ratio = period / lag
    decay = math.exp(-ratio)
    mean = -math.expm1(-ratio) / ratio
    return decay, mean - decay, 1.0 - mean


_Draw = ctypes.CFUNCTYPE(None)


class _Sensor(ctypes.Structure):
    _fields_ = [
        ("lags", ctypes.c_int64),
        *((name, ctypes.c_double) for name in ("decay", "older", "newer", "lag", "weighted", "wait")),
        *((name, ctypes.c_int64) for name in ("places", "head", "tail")),
        *((name, ctypes.c_void_p) for name in ("times", "waiting")),
        ("delay", ctypes.c_double),
        ("length", ctypes.c_int64),
        ("line", ctypes.c_void_p),
        *(
            (name, ctypes.c_double)
            for name in ("gain", "bias", "noise", "drop_out", "resolution", "lowest", "highest", "edge")
        ),
        *((name, ctypes.c_int64) for name in ("early", "plain")),
        ("faults", ctypes.POINTER(CFault)),
        ("fault_count", ctypes.c_int64),
        *((name, ctypes.c_void_p) for name in ("normals", "uniforms")),
        *((name, ctypes.c_int64) for name in ("drawn", "used")),
        *((name, _Draw) for name in ("draw_normals", "draw_uniforms")),
        *((name, ctypes.c_int64) for name in ("next", "sample", "code")),
        *((name, ctypes.c_double) for name in ("lagged", "input", "reading")),
        *((name, ctypes.c_int64) for name in ("since", "kept_used", "kept_next", "kept_sample", "kept_code")),
        *((name, ctypes.c_int64) for name in ("kept_head", "kept_tail")),
        *((name, ctypes.c_double) for name in ("kept_lagged", "kept_input", "kept_reading")),
    ]


class SensorComponent:
    """A sensor of one signal, sampled every `period` [s], with the random streams of (seed, part).

    Its input is named `of`, its outputs `value` and, where it has faults, `fault`: the code of the one that acts. The
    value depends directly on the input unless it is delayed by a sample or more. `timed` is the instant of a step that
    a reading belongs to. A period of 0 is none that stays the same, and then `shortest` [s] is the least it may be.
    """

    tells_faults = True

    def __init__(
        self,
        measured: Signal,
        errors: Errors,
        period: float,
        *,
        seed: int = 0,
        part: str = "sensor",
        role: Role = "sensor",
        timed: Timed = "end",
        shortest: float = 0.0,
    ) -> None:
        self.errors, self.period, self.seed, self.part = errors, period, seed, part
        self.shortest = shortest
        self.role, self.timed = role, timed
        kind = measured.kind if errors.repeat(period) else "real"
        signal = Signal("value", measured.unit, measured.start, measured.description, measured.nominal, kind=kind)
        self.inputs: Sequence[Signal] = (Signal("of", measured.unit, measured.start, kind=measured.kind),)
        told = [fault_signal([(fault.code, fault.meaning) for fault in errors.faults])] if errors.faults else []
        self.outputs: Sequence[Signal] = (signal, *told)
        self._state: _Sensor | None = None
        late = period > 0.0 and split_delay(errors.delay, period)[0] > 0
        self.feedthrough = frozenset(() if late else {("value", "of")})

    def start(self, t0: float, u: Vector) -> Vector:
        """The reading at t0 [s] of the signal u, and the fault that acts, shape (outputs,)."""
        errors = self.errors
        varies = self.period == 0.0
        decay, older, newer = lag_weights(errors.lag, self.period) if errors.lag and not varies else (0.0, 0.0, 1.0)
        delay = errors.delay / self.period if errors.delay and not varies else 0.0
        places = math.ceil(errors.delay / self.shortest) + 4 + REVERSIBLE if errors.delay and varies else 0
        self._times, self._waiting = np.zeros(max(places, 1)), np.zeros(max(places, 1))
        reach = delay + latest(errors.faults)
        length = split_delay(reach, 1.0)[0] + 2 + REVERSIBLE if reach else 0
        self._line = np.zeros(max(length, 1))
        self._normals = np.zeros(REVERSIBLE + BLOCK)[REVERSIBLE:] if errors.normals else None
        self._uniforms = np.zeros(REVERSIBLE + BLOCK)[REVERSIBLE:] if errors.uniforms else None
        noise, losses = (stream(self.seed, self.part, purpose) for purpose in ("noise", "drop_out"))
        self._faults = c_faults(errors.faults)
        # Called from C, NumPy's own functions run no line of Python, at which a signal could break in.
        self._draws = (
            _Draw(partial(noise.standard_normal, out=self._normals)),
            _Draw(partial(losses.random, out=self._uniforms)),
        )
        self._state = _Sensor(
            lags=errors.lag > 0.0,
            decay=decay,
            older=older,
            newer=newer,
            lag=errors.lag if varies else 0.0,
            wait=errors.delay if varies else 0.0,
            places=places,
            times=address(self._times),
            waiting=address(self._waiting),
            delay=delay,
            length=length,
            line=address(self._line),
            gain=errors.gain,
            bias=errors.bias,
            noise=errors.noise,
            drop_out=errors.drop_out,
            resolution=errors.resolution,
            lowest=errors.lowest,
            highest=errors.highest,
            edge=edge(self.period),
            early=self.timed == "begin",
            faults=self._faults,
            fault_count=len(errors.faults),
            normals=address(self._normals),
            uniforms=address(self._uniforms),
            drawn=BLOCK,
            used=BLOCK,
            draw_normals=self._draws[0],
            draw_uniforms=self._draws[1],
        )
        return self._reading("crankbench_sensor_start", t0, u=u)

    def step(self, t: float, h: float, u: Vector) -> Vector:
        """The reading at t + h [s] of the signal that is u there, and the fault that acts, shape (outputs,)."""
        return self._reading("crankbench_sensor_step", t, h, u=u)

    def native(self) -> Native:
        """The step in C."""
        return native_step("crankbench_sensor_step", self._started())

    def reversal(self) -> Reversal:
        """Keeping and going back in C, the numbers of chance included; REVERSIBLE samples at most may lie between."""
        return native_reversal("crankbench_sensor_keep", "crankbench_sensor_restore", self._started())

    def failure(self, status: int, time: float) -> StepError:
        """The error for a step from `time` [s] that ended in `status`."""
        fastest = f"{FASTEST * 30.0 / math.pi:g} rpm"
        reach = f"its delay of {self.errors.delay:g} s reaches over more samples than come at {fastest}"
        told = reach if status == ERROR else "the sensor has no random numbers"
        return StepError(told, part=self.part, time=time, status=status)

    def close(self) -> None:
        """Forget the state: it wants a start before the next step."""
        self._state = None

    def _started(self) -> _Sensor:
        if self._state is None:
            raise StepError(f"the sensor {self.part} wants a start before it is stepped")
        return self._state

    def _reading(self, function: str, *times: float, u: Vector) -> Vector:
        status, outputs = call(function, self._started(), *times, u=u, outputs=len(self.outputs))
        if status != OK:
            raise self.failure(status, times[0])
        return outputs


def build_sensor(
    spec: SensorPart, measured: Signal, sampling: Sampling, seed: int, part: str, found: Findings
) -> SensorComponent:
    """The sensor a scenario describes; what is wrong with it goes to `found`."""
    unit, period = measured.unit, sampling.pace.step
    lag = found.at("lag").value(spec.lag, "s") if spec.lag else 0.0
    delay = found.at("delay").value(spec.delay, "s") if spec.delay else 0.0
    noise = found.at("noise", "std").difference(spec.noise.std, unit) if spec.noise else 0.0
    resolution = found.at("quantise").difference(spec.quantise, unit)
    for key, value in (("lag", lag), ("delay", delay), ("quantise", resolution)):
        if value < 0.0:
            found.at(key).add(f"wants 0 or more, got {getattr(spec, key)}")
    if noise < 0.0 and spec.noise:
        found.at("noise", "std").add(f"wants 0 or more, got {spec.noise.std}")
    shortest = sampling.shortest(FASTEST)
    if delay > MOST_DELAYED_SAMPLES * shortest:
        found.at("delay").add(f"wants at most {MOST_DELAYED_SAMPLES} samples of {shortest:g} s, got {spec.delay}")
        delay = 0.0
    lowest, highest = -math.inf, math.inf
    if spec.limits:
        lowest, highest = (found.at("limits").value(limit, unit) for limit in spec.limits)
        if lowest > highest:
            found.at("limits").add(f"wants the lower limit first, got {spec.limits[0]} and {spec.limits[1]}")
    errors = Errors(
        lag=max(lag, 0.0),
        delay=max(delay, 0.0),
        gain=spec.gain,
        bias=found.at("bias").difference(spec.bias, unit),
        noise=noise,
        drop_out=spec.drop_out,
        resolution=resolution,
        lowest=lowest,
        highest=highest,
        faults=read_faults(spec.faults, unit, sampling, found.at("faults")),
    )
    return SensorComponent(measured, errors, period, seed=seed, part=part, shortest=shortest)
