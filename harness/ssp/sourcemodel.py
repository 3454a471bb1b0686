"""A source as a model in equations, so that it is exported as an FMU like any other part."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from fmus.component import Kind, Signal
from fmus.model import Model, Values
from fmus.units import Unit, parse_unit
from harness.points import Points
from harness.source import SourceComponent, Wave
from harness.sourcepart import SHAPES, SourcePart

MOST_POINTS = 2000  # each is a branch in the code of the FMU
_Parameters = Mapping[str, tuple[str, float]]


class Inexpressible(ValueError):
    """Something that an FMU of ours cannot do as the part does."""


def source_model(
    name: str, spec: SourcePart, source: SourceComponent, start: float, unit: str, kind: Kind = "real"
) -> Model:
    """The model of a source: y(t) is its value at t, in `unit`; the clock starts at `start` [s].

    For inputs of whole numbers or truth values it is rounded to them. What the campaign gives is a parameter, in the
    source's unit; points of tables and drive cycles are not. Outside of its points it is as the source is, or holds the
    nearest where the source has nothing.

    Raises Inexpressible: more than MOST_POINTS points.
    """
    shape = next(key for key in SHAPES if getattr(spec, key) is not None)
    own, shown, given = parse_unit(spec.unit), parse_unit(unit), source.given
    if isinstance(given, Points) and len(given.times) > MOST_POINTS:
        raise Inexpressible(f"has {len(given.times)} points, at most {MOST_POINTS} are exported")
    parameters = _parameters(shape, spec.unit, own, given)

    def output(t: Any, p: Values) -> Any:
        value = _wave(given, t, p, start) if isinstance(given, Wave) else _point(shape, given, own, t, p)
        found = value if own == shown else from_si(to_si(value, own), shown)
        return found if kind == "real" else rounded(found)

    return Model(
        name=name,
        description=f"The source {name} of a campaign: {shape}",
        equations=lambda t, x, m, u, p: ({}, {"value": output(t, p)}),
        outputs=(Signal("value", unit, kind=kind),),
        parameters=tuple(Signal(key, of, value) for key, (of, value) in parameters.items()),
    )


def _parameters(shape: str, unit: str, own: Unit, given: Points | Wave) -> _Parameters:
    """Unit and value of what a campaign gives for a source of this shape."""
    if isinstance(given, Wave):
        turns = {"frequency": ("Hz", given.omega / (2.0 * math.pi))}
        swept = {
            "from": ("Hz", given.omega / (2.0 * math.pi)),
            "to": ("Hz", _last(given) / (2.0 * math.pi)),
            "begin": ("s", given.begin or 0.0),
            "duration": ("s", given.duration),
        }
        size = {"mean": (unit, own.from_si(given.mean)), "amplitude": (unit, given.amplitude / own.factor)}
        return {**size, "phase": ("rad", given.phase), **(turns if given.shape == "sine" else swept)}
    first, last = own.from_si(float(given.values[0])), own.from_si(float(given.values[-1]))
    begin, end = float(given.times[0]), float(given.times[-1])
    ends = {"from": (unit, first), "to": (unit, last)}
    found: Mapping[str, _Parameters] = {
        "constant": {"constant": (unit, first)},
        "step": {"at": ("s", end), **ends},
        "ramp": {"at": ("s", begin), "until": ("s", end), **ends},
    }
    return found.get(shape, {})


def _last(given: Wave) -> float:
    """The angular frequency [rad/s] at the end of a chirp."""
    if given.shape == "logarithmic chirp":
        return given.omega * math.exp(given.rate * given.duration)
    return given.omega + 2.0 * given.rate * given.duration


def _wave(given: Wave, t: Any, p: Values, start: float) -> Any:
    if given.shape == "sine":
        angle = 2.0 * math.pi * p["frequency"] * (t - start)
    else:
        since = np.minimum(np.maximum(t - p["begin"], 0.0), p["duration"])
        if given.shape == "linear chirp":
            angle = 2.0 * math.pi * (p["from"] + 0.5 * (p["to"] - p["from"]) * since / p["duration"]) * since
        else:
            rate = np.log(p["to"] / p["from"]) / p["duration"]
            angle = 2.0 * math.pi * p["from"] * (np.exp(rate * since) - 1.0) / rate
    return p["mean"] + p["amplitude"] * np.sin(angle + p["phase"])


def _point(shape: str, given: Points, own: Unit, t: Any, p: Values) -> Any:
    """The value at t of points, in the source's unit."""
    match shape:
        case "constant":
            return p["constant"]
        case "step":
            return np.where(t >= p["at"] - given.edge, p["to"], p["from"])
        case "ramp":
            return _lines(t, [p["at"], p["until"]], [p["from"], p["to"]])
    times, values = [float(one) for one in given.times], [own.from_si(float(one)) for one in given.values]
    if given.ends == "repeat":
        span = times[-1] - times[0]
        since = t - times[0]
        since = since - span * np.floor(since / span)
        t = times[0] + np.where(since + given.edge >= span, 0.0, since)
    return _lines(t, times, values) if given.between == "linear" else _held(t, times, values, given.edge)


def _held(t: Any, times: list[float], values: list[float], near: float) -> Any:
    """The value of the last point at or before t, of the first before that."""
    found: Any = values[0]
    for time, value in zip(times[1:], values[1:], strict=True):
        found = np.where(t >= time - near, value, found)
    return found


def _lines(t: Any, times: list[Any], values: list[Any]) -> Any:
    """The value on the lines between points, that of the ends outside."""
    found: Any = values[0]
    for index in range(1, len(times)):
        share = (t - times[index - 1]) / (times[index] - times[index - 1])
        found = np.where(t > times[index - 1], values[index - 1] + share * (values[index] - values[index - 1]), found)
    return np.where(t >= times[-1], values[-1], found)


def rounded(value: Any) -> Any:
    """To the nearest whole number, halves to the even one, as C's rint; of floats and symbols."""
    below = np.floor(value)
    odd = below - 2.0 * np.floor(0.5 * below)
    up = np.where(value - below == 0.5, odd, np.where(value - below > 0.5, 1.0, 0.0))
    return below + up


def to_si(value: Any, unit: Unit) -> Any:
    """A number in SI, untouched where its unit is one of SI."""
    return value if unit.factor == 1.0 and unit.offset == 0.0 else unit.factor * value + unit.offset


def from_si(value: Any, unit: Unit) -> Any:
    """A number of SI in a unit, untouched where that is one of SI."""
    return value if unit.factor == 1.0 and unit.offset == 0.0 else (value - unit.offset) / unit.factor
