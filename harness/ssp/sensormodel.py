"""A sensor as a model in equations, so that it is exported as an FMU like any other part."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from fmus.component import Signal
from fmus.model import Model, Values
from fmus.units import Unit, parse_unit
from harness.faults import FAULT_SIGNAL, ActingFault, edge
from harness.sensor import Errors, SensorComponent, lag_weights, split_delay
from harness.ssp.sourcemodel import Inexpressible, from_si, rounded, to_si

MOST_SAMPLES = 1000  # that a sensor delays by: each is a state of its FMU


def sensor_model(name: str, sensor: SensorComponent, step: float, read: str, shown: str) -> Model:
    """The model of a sensor without chance: `of` in the unit `read`, `value` in `shown`, on a clock of `step` [s].

    One that only has a gain, a bias and the like, and samples at every step, follows its input at once; any other
    samples at the end of each of its periods, as the sensor does. Gain and bias are parameters.

    Raises Inexpressible: noise, drop-out, a fault that delays, or a delay of more than MOST_SAMPLES.
    """
    errors, (measured,), reading = sensor.errors, sensor.inputs, sensor.outputs[0]
    if errors.normals or errors.uniforms:
        raise Inexpressible("has noise or drop-out: no FMU draws the random numbers of this project")
    if any(fault.kind == "delay" for fault in errors.faults):
        raise Inexpressible("has a fault that delays, which no FMU of ours makes")
    whole, _ = split_delay(errors.delay, sensor.period)
    if whole > MOST_SAMPLES:
        raise Inexpressible(f"is delayed by {whole} samples, at most {MOST_SAMPLES} are exported")
    of, value = parse_unit(read), parse_unit(shown)
    found = Model(
        name=name,
        description=f"The sensor {name} of a campaign",
        equations=lambda t, x, m, u, p: (
            {},
            {
                "value": from_si(_limited(_disturbed(to_si(u["of"], of), t, p, sensor), errors), value),
                **_told(_code(t, sensor), errors),
            },
        ),
        inputs=(Signal("of", read, of.from_si(float(measured.start)), kind=measured.kind),),
        outputs=(Signal("value", shown, kind=reading.kind), *sensor.outputs[1:]),
        parameters=(Signal("gain", "1", errors.gain), Signal("bias", of.si_name(), errors.bias))
        if reading.kind == "real"
        else (),
    )
    if sensor.period < 1.5 * step and not errors.lag and not errors.delay and not _sticks(errors):
        return found
    return _sampled(found, sensor, of, value)


def _sampled(direct: Model, sensor: SensorComponent, of: Unit, value: Unit) -> Model:
    """The model of a sensor that remembers: its last reading, and what its lag and its delay want."""
    errors = sensor.errors
    whole, fraction = split_delay(errors.delay, sensor.period)
    decay, older, newer = lag_weights(errors.lag, sensor.period) if errors.lag else (0.0, 0.0, 1.0)
    kind = direct.outputs[0].kind
    states = [Signal("reading", kind=kind, local=True), Signal("begun", kind="boolean", local=True)]
    states += [Signal("code", kind="integer", local=True)] if errors.faults else []
    states += [Signal(one, local=True) for one in ("before", "lagged") if errors.lag]
    states += [Signal("line", shape=(whole + 2,), local=True)] if errors.delay else []

    def begin(t: Any, x: Values, m: Values, u: Values, p: Values, above: Values) -> Mapping[str, Any]:
        signal = to_si(u["of"], of)
        first = {
            "begun": m["begun"],
            "code": _code(t, sensor),
            "reading": _limited(_disturbed(signal, t, p, sensor), errors),
            "before": signal,
            "lagged": signal,
            "line": np.array([signal] * (whole + 2), dtype=object),
        }
        return {state.name: np.where(m["begun"], m[state.name], first[state.name]) for state in states}

    def sample(t: Any, x: Values, m: Values, u: Values, p: Values) -> Mapping[str, Any]:
        signal = to_si(u["of"], of)
        new: dict[str, Any] = {"begun": 1.0}
        late = signal
        if errors.lag:
            late = decay * m["lagged"] + older * m["before"] + newer * signal
            new |= {"before": signal, "lagged": late}
        if errors.delay:
            line = np.array([late, *m["line"][:-1]], dtype=object)
            new["line"] = line
            late = line[whole] if fraction == 0.0 else line[whole] + fraction * (line[whole + 1] - line[whole])
        reading = _limited(_disturbed(late, t, p, sensor), errors)
        for fault in errors.faults:
            if fault.kind == "stuck":
                reading = np.where(_active(fault, t, sensor), m["reading"], reading)
        return {**new, "reading": reading, **({"code": _code(t, sensor)} if errors.faults else {})}

    return replace(
        direct,
        equations=lambda t, x, m, u, p: (
            {},
            {"value": from_si(m["reading"], value), **(_told(m["code"], errors) if errors.faults else {})},
        ),
        discrete=tuple(states),
        parameters=(*direct.parameters, Signal("sample_time", "s", sensor.period)),
        # Until the first sample the discrete states follow the input; what initialises them wants an indicator.
        indicator_names=("always",),
        indicators=lambda t, x, m, u, p: {"always": 1.0},
        transition=begin,
        sample=sample,
        sample_time="sample_time",
    )


def _disturbed(value: Any, t: Any, p: Values, sensor: SensorComponent) -> Any:
    """A sample with gain, bias and the faults of the time, rounded to the resolution; in the order of the sensor."""
    errors = sensor.errors
    if sensor.outputs[0].kind != "real":
        return value
    value = value * p["gain"] + p["bias"]
    for fault in errors.faults:
        changed = {
            "bias": value + fault.value,
            "gain": value * fault.value,
            "drift": value + fault.value * (t - fault.window.start),
        }.get(fault.kind)
        if changed is not None:
            value = np.where(_active(fault, t, sensor), changed, value)
    return errors.resolution * rounded(value / errors.resolution) if errors.resolution > 0.0 else value


def _limited(value: Any, errors: Errors) -> Any:
    if errors.lowest > -math.inf:
        value = np.maximum(value, errors.lowest)
    return np.minimum(value, errors.highest) if errors.highest < math.inf else value


def _active(fault: ActingFault, t: Any, sensor: SensorComponent) -> Any:
    near, window = edge(sensor.period), fault.window
    begun = t >= window.start - near
    return begun if window.until == math.inf else np.logical_and(begun, t < window.until - near)


def _code(t: Any, sensor: SensorComponent) -> Any:
    """The code of the first fault listed that acts, 0 where none does."""
    code: Any = 0.0 * t
    for fault in reversed(sensor.errors.faults):
        code = np.where(_active(fault, t, sensor), float(fault.code), code)
    return code


def _told(code: Any, errors: Errors) -> dict[str, Any]:
    """The fault signal, of a sensor that has one."""
    return {FAULT_SIGNAL: code} if errors.faults else {}


def _sticks(errors: Errors) -> bool:
    return any(fault.kind == "stuck" for fault in errors.faults)
