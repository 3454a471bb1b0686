"""Courses of the crank-angle engine's FMU, and its geometry written down anew, for the tests of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from scipy.interpolate import CubicSpline

from fmus.component import Vector
from fmus.export import cached_fmu
from fmus.fmu import load_fmu
from fmus.plants.crank_engine import MODEL
from fmus.units import parse_unit

CYLINDERS = (1, 2, 3, 4)
# Firing top dead centres for the order 1-3-4-2, rad.
FIRING = {1: 0.0, 2: 3.0 * np.pi, 3: np.pi, 4: 2.0 * np.pi}
CYCLE = 4.0 * np.pi
DEG, RPM = np.pi / 180.0, np.pi / 30.0
FUEL = {8: 2.1162e-5, 9: 2.3626e-5}  # kg a cylinder and cycle, by IMEP in bar, default set at 1500 rpm
SETS = [None, *MODEL.parameter_sets]
INPUT_NAMES = [signal.name for signal in MODEL.inputs]

Inputs = Mapping[str, float]
Course = dict[str, Vector]


def parameters(parameter_set: str | None = None) -> dict[str, float]:
    """Every parameter of a set by name, in declared units."""
    values = {signal.name: float(signal.start) for signal in MODEL.parameters}
    return values | dict(MODEL.parameter_sets[parameter_set] if parameter_set else {})


def fuelled(fuel: float | Sequence[float], rpm: float = 1500.0, **more: float) -> dict[str, float]:
    """Inputs with one fuel mass [kg], or one for each cylinder, at a speed demanded."""
    masses = np.broadcast_to(fuel, 4)
    return {f"m_f_{i}": float(masses[i - 1]) for i in CYLINDERS} | {"speed_demand": rpm * RPM} | more


def vector(u: Inputs) -> Vector:
    """Inputs in the FMU's order; those not named as they start."""
    return np.array([u.get(signal.name, signal.start) for signal in MODEL.inputs], dtype=float)


def course(
    u: Inputs | Callable[[float], Inputs],
    stop: float,
    h: float,
    starts: Mapping[str, float] | None = None,
    parameter_set: str | None = None,
    fmi: int = 2,
) -> Course:
    """States, discrete states and outputs by name over the `time` [s], in steps of h; u may depend on a step's begin.

    `starts` are of states, parameters and the solver, in declared units.
    """
    units = {signal.name: signal.unit for signal in (*MODEL.parameters, *MODEL.states, *MODEL.discrete)}
    given = {**(MODEL.parameter_sets[parameter_set] if parameter_set else {}), **(starts or {})}
    si = {name: parse_unit(units.get(name, "1")).to_si(float(value)) for name, value in given.items()}
    component = load_fmu(cached_fmu(MODEL, fmi), starts=si)
    held = None if callable(u) else vector(u)

    def at(t: float) -> Vector:
        return vector(u(t)) if callable(u) else held

    rows = [component.start(0.0, at(0.0))]
    try:
        for k in range(round(stop / h)):
            rows.append(component.step(k * h, h, at(k * h)))
    finally:
        component.close()
    found = {
        signal.name: np.array(values) for signal, values in zip(component.outputs, np.transpose(rows), strict=True)
    }
    return found | {"time": h * np.arange(len(rows))}


def volume(i: int, theta: Vector, p: Mapping[str, float]) -> Vector:
    """Volume [m3] of cylinder i by plane geometry: what is left above a piston at the end of its connecting rod."""
    r, alpha = 0.5 * p["stroke"], theta - FIRING[i]
    rod = r / p["rod_ratio"]
    height = r * np.cos(alpha) + np.sqrt(rod**2 - (r * np.sin(alpha)) ** 2)
    area = 0.25 * np.pi * p["bore"] ** 2
    clearance = area * p["stroke"] / (p["compression"] - 1.0)
    result: Vector = clearance + area * (r + rod - height)
    return result


def swept(p: Mapping[str, float]) -> float:
    """Volume that one piston sweeps [m3]."""
    return 0.25 * np.pi * p["bore"] ** 2 * p["stroke"]


def phase(i: int, theta: Vector) -> Vector:
    """Crank angle from cylinder i's firing top dead centre, -360 to 360 deg in rad: that of its own cycle."""
    result: Vector = np.mod(theta - FIRING[i] + 0.5 * CYCLE, CYCLE) - 0.5 * CYCLE
    return result


def integral(run: Course, values: Vector, begin: float, end: float) -> float:
    """Of `values` by time from the crank angle `begin` to `end` [rad], by a spline through the rows."""
    times = CubicSpline(run["theta"], run["time"])([begin, end])
    return float(CubicSpline(run["time"], values).integrate(*times))


def work(run: Course, i: int, begin: float, end: float, p: Mapping[str, float]) -> float:
    """Integral p dV [J] of cylinder i from the crank angle `begin` to `end` [rad], by a spline through the rows."""
    theta = run["theta"]
    V = CubicSpline(theta, volume(i, theta, p))
    return float(CubicSpline(theta, run[f"p_{i}"] * V(theta, 1)).integrate(begin, end))
