"""Sensors: what is wrong between a signal and its reading. The arithmetic is in sensor.c, the numbers of chance here.

Reading k measures the signal at the end of step k; reading 0 is the initialised one. With u_k the samples of the
signal and H the sample time,

    x_k = a x_{k-1} + (r - a) u_{k-1} + (1 - r) u_k,   a = exp(-H/lag),  r = (1 - a) lag/H,   x_0 = u_0

is the first-order lag, exact for a signal that is linear between samples; a delay of (m + f) H, m whole, reads
(1 - f) x_{k-m} + f x_{k-m-1}, and before the first sample the signal is taken to have been u_0. Then come gain, bias,
the faults in the order they are listed, noise, drop-out, quantisation and limits. A lost sample and a stuck sensor
repeat the last reading as it was; the first sample is neither. Faults of noise add in quadrature, faults of drop-out
as independent losses.
"""

from __future__ import annotations

import ctypes
import hashlib
import math
from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from fmus.component import OK, Native, Reversal, Role, Signal, StepError, Vector
from harness.findings import Findings
from harness.native import address, call, native_reversal, native_step
from harness.scenario import Fault, SensorPart

BLOCK = 4096
# Samples that may follow a kept state, as in sensor.c.
REVERSIBLE = 64
FAULTS = ("bias", "gain", "drift", "stuck", "drop_out", "noise")
MOST_DELAYED_SAMPLES = 10_000_000


def stream(seed: int, part: str, purpose: str) -> np.random.Generator:
    """The random numbers of one purpose of one part: they depend on these three and on nothing else in the scenario."""
    names = [hashlib.sha256(name.encode()).digest() for name in (part, purpose)]
    words = [int.from_bytes(digest[i : i + 4], "little") for digest in names for i in range(0, 32, 4)]
    return np.random.Generator(np.random.Philox(np.random.SeedSequence([seed, *words])))


class FaultWindow(NamedTuple):
    """A fault of one kind, one of FAULTS, in SI, active for start <= t < until [s]."""

    kind: str
    value: float
    start: float
    until: float


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
    faults: tuple[FaultWindow, ...] = ()

    @property
    def normals(self) -> bool:
        """Whether it takes a normal number a sample."""
        return self.noise > 0.0 or any(fault.kind == "noise" for fault in self.faults)

    @property
    def uniforms(self) -> bool:
        """Whether it takes a uniform number a sample."""
        return self.drop_out > 0.0 or any(fault.kind == "drop_out" for fault in self.faults)


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


class _Fault(ctypes.Structure):
    _fields_ = [
        ("kind", ctypes.c_int64),
        *((name, ctypes.c_double) for name in ("value", "start", "until")),
    ]


_Draw = ctypes.CFUNCTYPE(None)


class _Sensor(ctypes.Structure):
    _fields_ = [
        ("lags", ctypes.c_int64),
        *((name, ctypes.c_double) for name in ("decay", "older", "newer")),
        *((name, ctypes.c_int64) for name in ("length", "whole")),
        ("fraction", ctypes.c_double),
        ("line", ctypes.c_void_p),
        *(
            (name, ctypes.c_double)
            for name in ("gain", "bias", "noise", "drop_out", "resolution", "lowest", "highest", "edge")
        ),
        ("plain", ctypes.c_int64),
        ("faults", ctypes.POINTER(_Fault)),
        ("fault_count", ctypes.c_int64),
        *((name, ctypes.c_void_p) for name in ("normals", "uniforms")),
        *((name, ctypes.c_int64) for name in ("drawn", "used")),
        *((name, _Draw) for name in ("draw_normals", "draw_uniforms")),
        ("next", ctypes.c_int64),
        *((name, ctypes.c_double) for name in ("lagged", "input", "reading")),
        *((name, ctypes.c_int64) for name in ("since", "kept_used", "kept_next")),
        *((name, ctypes.c_double) for name in ("kept_lagged", "kept_input", "kept_reading")),
    ]


class SensorComponent:
    """A sensor of one signal, sampled every `period` [s], with the random streams of (seed, part).

    Its input is named `of`, its output `value`. The output depends directly on the input unless it is delayed by a
    sample or more.
    """

    role: Role = "sensor"

    def __init__(self, measured: Signal, errors: Errors, period: float, *, seed: int = 0, part: str = "sensor") -> None:
        self.errors, self.period, self.seed, self.part = errors, period, seed, part
        kind = measured.kind if errors == Errors() else "real"
        signal = Signal("value", measured.unit, measured.start, measured.description, measured.nominal, kind=kind)
        self.inputs: Sequence[Signal] = (Signal("of", measured.unit, measured.start, kind=measured.kind),)
        self.outputs: Sequence[Signal] = (signal,)
        self._state: _Sensor | None = None
        self._whole, self._fraction = split_delay(errors.delay, period)
        self.feedthrough = frozenset({("value", "of")} if self._whole == 0 else ())

    def start(self, t0: float, u: Vector) -> Vector:
        """The reading at t0 [s] of the signal u, shape (1,)."""
        errors = self.errors
        decay, older, newer = lag_weights(errors.lag, self.period) if errors.lag else (0.0, 0.0, 1.0)
        length = self._whole + 2 + REVERSIBLE if errors.delay else 0
        self._line = np.zeros(max(length, 1))
        self._normals = np.zeros(REVERSIBLE + BLOCK)[REVERSIBLE:] if errors.normals else None
        self._uniforms = np.zeros(REVERSIBLE + BLOCK)[REVERSIBLE:] if errors.uniforms else None
        noise, losses = (stream(self.seed, self.part, purpose) for purpose in ("noise", "drop_out"))
        self._faults = (_Fault * max(len(errors.faults), 1))(
            *(_Fault(FAULTS.index(fault.kind), *fault[1:]) for fault in errors.faults)
        )
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
            length=length,
            whole=self._whole,
            fraction=self._fraction,
            line=address(self._line),
            gain=errors.gain,
            bias=errors.bias,
            noise=errors.noise,
            drop_out=errors.drop_out,
            resolution=errors.resolution,
            lowest=errors.lowest,
            highest=errors.highest,
            edge=1e-6 * self.period,
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
        """The reading at t + h [s] of the signal that is u there, shape (1,)."""
        return self._reading("crankbench_sensor_step", t, h, u=u)

    def native(self) -> Native:
        """The step in C."""
        return native_step("crankbench_sensor_step", self._started())

    def reversal(self) -> Reversal:
        """Keeping and going back in C, the numbers of chance included; REVERSIBLE samples at most may lie between."""
        return native_reversal("crankbench_sensor_keep", "crankbench_sensor_restore", self._started())

    def close(self) -> None:
        """Forget the state: it wants a start before the next step."""
        self._state = None

    def _started(self) -> _Sensor:
        if self._state is None:
            raise StepError(f"the sensor {self.part} wants a start before it is stepped")
        return self._state

    def _reading(self, function: str, *times: float, u: Vector) -> Vector:
        status, reading = call(function, self._started(), *times, u=u)
        if status != OK:
            raise StepError("the sensor has no random numbers", part=self.part, time=times[0], status=status)
        return np.array([reading])


def build_sensor(
    spec: SensorPart, measured: Signal, period: float, seed: int, part: str, found: Findings
) -> SensorComponent:
    """The sensor a scenario describes, sampled every `period` [s]; what is wrong with it goes to `found`."""
    unit = measured.unit
    lag = found.at("lag").value(spec.lag, "s") if spec.lag else 0.0
    delay = found.at("delay").value(spec.delay, "s") if spec.delay else 0.0
    noise = found.at("noise", "std").difference(spec.noise.std, unit) if spec.noise else 0.0
    resolution = found.at("quantise").difference(spec.quantise, unit)
    for key, value in (("lag", lag), ("delay", delay), ("quantise", resolution)):
        if value < 0.0:
            found.at(key).add(f"wants 0 or more, got {getattr(spec, key)}")
    if noise < 0.0 and spec.noise:
        found.at("noise", "std").add(f"wants 0 or more, got {spec.noise.std}")
    if delay > MOST_DELAYED_SAMPLES * period:
        found.at("delay").add(f"wants at most {MOST_DELAYED_SAMPLES} samples of {period:g} s, got {spec.delay}")
        delay = 0.0
    lowest, highest = -math.inf, math.inf
    if spec.limits:
        lowest, highest = (found.at("limits").value(limit, unit) for limit in spec.limits)
        if lowest > highest:
            found.at("limits").add(f"wants the lower limit first, got {spec.limits[0]} and {spec.limits[1]}")
    faults = tuple(_fault_window(fault, unit, found.at("faults", index)) for index, fault in enumerate(spec.faults))
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
        faults=faults,
    )
    return SensorComponent(measured, errors, period, seed=seed, part=part)


def _fault_window(fault: Fault, unit: str, found: Findings) -> FaultWindow:
    kind = next(kind for kind in FAULTS if getattr(fault, kind) is not None)
    given = getattr(fault, kind)
    start = found.at("from").value(fault.start, "s")
    until = found.at("to").value(fault.until, "s") if fault.until else math.inf
    if until <= start:
        found.at("to").add(f"wants a time after {fault.start}, got {fault.until}")
    measured = kind in ("bias", "drift", "noise")
    value = found.at(kind).difference(given, unit) if measured else float(given)
    if kind == "noise" and value < 0.0:
        found.at(kind).add(f"wants 0 or more, got {given}")
    if kind == "drop_out" and not 0.0 <= value <= 1.0:
        found.at(kind).add(f"wants a probability between 0 and 1, got {given:g}")
    return FaultWindow(kind, value, start, until)
