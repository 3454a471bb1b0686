"""A model with sensors on it: an output for each signal measured, and a lag with a state of its own where one is slow.

Source: Andersson, Frisk, Eriksson, Sensor selection for observer feedback in turbocharged spark ignited engines,
IFAC 2005, Section 2.2: dT_sensor/dt = (T - T_sensor)/tau for each temperature measured, tau "in the order of several
seconds", all other sensors taken as fast. 3 s is chosen [I].
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from fmus.component import Signal
from fmus.model import Model, ModelError, Values, unknown
from fmus.units import parse_unit

TEMPERATURE_LAG = 3.0  # s
_KELVIN = parse_unit("K")


def sensor_name(signal: str) -> str:
    """The output of the sensor on a signal; its lag, where it has one, is the parameter `tau_` + signal."""
    return f"{signal}_sensor"


def with_sensors(model: Model, sensors: Sequence[str], lags: Mapping[str, float] | None = None) -> Model:
    """The model with the output `sensor_name(s)` for each s of `sensors`, after those it has, in the order given.

    A sensor measures a scalar state or output. One on a temperature follows it by dz/dt = (s - z)/tau_s. There z is a
    state of its own, after those of the model, which starts where s starts and is no output itself, and tau_s is a
    parameter, 3 s. `lags` [s] by signal gives other time constants, also of other signals; 0 is a sensor without lag.

    Raises ModelError: a signal that is no scalar state or output, one named twice, a lag below zero or of a signal that
    is not measured.
    """
    measurable = {signal.name: signal for signal in (*model.states, *model.outputs) if not signal.shape}
    for name in sensors:
        if name not in measurable:
            raise ModelError(f"{model.name}: a sensor on {name}: {unknown(name, measurable, 'scalar state or output')}")
        if list(sensors).count(name) > 1:
            raise ModelError(f"{model.name}: a sensor on {name} is asked for twice")
    for name, lag in (lags or {}).items():
        if name not in sensors:
            raise ModelError(f"{model.name}: a lag of {name}: {unknown(name, sensors, 'sensor')}")
        if not lag >= 0.0:
            raise ModelError(f"{model.name}: the sensor on {name} wants a lag of 0 s or more, got {lag:g} s")
    taus = {name: _lag(measurable[name], lags or {}) for name in sensors}
    slow = [name for name in sensors if taus[name] > 0.0]
    known_states = {signal.name for signal in model.states}

    def equations(t: Any, x: Values, m: Values, u: Values, p: Values) -> tuple[dict[str, Any], dict[str, Any]]:
        derivatives, outputs = (dict(found) for found in model.equations(t, x, m, u, p))
        signals = {name: x[name] if name in known_states else outputs[name] for name in sensors}
        for name in slow:
            derivatives[_lagged(name)] = (signals[name] - x[_lagged(name)]) / p[f"tau_{name}"]
        for name in sensors:
            outputs[sensor_name(name)] = x[_lagged(name)] if name in slow else signals[name]
        return derivatives, outputs

    def made(name: str, source: str, what: str, local: bool) -> Signal:
        signal = measurable[source]
        return Signal(name, signal.unit, signal.start, f"{what}: {signal.description}", signal.nominal, local=local)

    return replace(
        model,
        equations=equations,
        states=(*model.states, *(made(_lagged(name), name, "inside its sensor", True) for name in slow)),
        outputs=(*model.outputs, *(made(sensor_name(name), name, "measured", False) for name in sensors)),
        parameters=(
            *model.parameters,
            *(
                Signal(f"tau_{name}", "s", taus[name], f"time constant of the sensor on {name}", minimum=1e-9)
                for name in slow
            ),
        ),
    )


def _lagged(name: str) -> str:
    return f"{name}_lagged"


def _lag(signal: Signal, lags: Mapping[str, float]) -> float:
    is_temperature = parse_unit(signal.unit).same_dimension(_KELVIN)
    return float(lags.get(signal.name, TEMPERATURE_LAG if is_temperature else 0.0))
