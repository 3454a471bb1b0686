"""Fit the map parameters of `turbo_si_egr` to steady points of `gas_exchange`, and write its parameter set `reference`.

`python docs/turbo_si_egr/fit.py` holds the exported reference at each point for 8 s, takes the means of its last cycle,
fits by least squares where the control model settles, and writes fmus/plants/turbo_si_egr_reference.py. What is fitted
are pressures, temperatures, flows and the turbocharger's speed at rest: no burnt fraction, no transient, no estimate.
"""

from __future__ import annotations

import itertools
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from fmus.component import Vector
from fmus.export import cached_fmu
from fmus.fmu import load_fmu
from fmus.jacobians import jacobians, point
from fmus.plants import gas_exchange
from fmus.plants.turbo_si_egr import MODEL
from fmus.steady import steady_state
from fmus.units import parse_unit

TARGET = Path(__file__).resolve().parents[2] / "fmus" / "plants" / "turbo_si_egr_reference.py"
SECONDS = 8.0
SAMPLES = 72  # a cycle, for what the reference shows at instants only
# The named point, and the corners of the speeds, wastegates and valves that the engine is driven at: rpm, mm, deg.
NAMED = (3200.0, 11.6, 10.0)
POINTS = (NAMED, *itertools.product((2400.0, 3200.0, 4000.0), (11.6, 16.0), (6.0, 16.0)))
# What is compared at rest, relative to its size.
COMPARED = ("p_boost", "p_im", "p_em", "p_t", "p_mix", "T_im", "T_em", "omega_tc", "W_mix", "W_egr")
# All that the reference tells of a point: the observers' deviations are from these at the named one.
TOLD = (
    "p_boost", "p_im", "p_em", "T_boost", "T_im", "T_em", "omega_tc", "F_mix", "F_boost", "F_im", "F_em", "F_t",
    "F_egr", "W_a", "W_egr", "W_mix", "W_cac", "W_cyl", "p_t", "p_mix",
)  # fmt: skip
INSTANT = {"p_t": "p_t_inst", "p_mix": "p_mix_inst"}
# Filling, restrictions, exhaust temperature, turbine and compressor maps. Each may lie within a factor of five of its
# default; the turbine's efficiency is one of means in pulsating flow, which may be more than the wheel's.
RANGE = 0.2, 5.0
FITTED = ("C_c", "k_af", "k_es", "C_egr", "T_0", "K_s", "k_1", "eta_t_max", "Psi_max", "Phi_max")
DEFAULTS = {signal.name: float(signal.start) for signal in MODEL.parameters}


class Fit(NamedTuple):
    """The parameters, and what is left at each point of what is compared: logarithms of model over reference."""

    parameters: dict[str, float]
    left: Vector


def steady_points(points: Sequence[tuple[float, float, float]] = POINTS) -> list[dict[str, float]]:
    """What the reference shows at rest at each point, in SI."""
    engine = load_fmu(cached_fmu(gas_exchange.MODEL))
    inputs = gas_exchange.MODEL.inputs
    units = {signal.name: parse_unit(signal.unit) for signal in inputs}
    rest = {signal.name: float(signal.start) for signal in inputs}

    def held(at: tuple[float, float, float]) -> Vector:
        values = rest | dict(zip(("N", "wastegate", "egr_valve"), at, strict=True))
        return np.array([units[signal.name].to_si(values[signal.name]) for signal in inputs])

    names = [signal.name for signal in engine.outputs]
    engine.start(0.0, held(points[0]))
    t, found = 0.0, []
    for at in points:
        u = held(at)
        cycle = 4.0 * np.pi / u[[signal.name for signal in inputs].index("N")]
        for _ in range(round(SECONDS / cycle) - 1):
            engine.step(t, cycle, u)
            t += cycle
        rows = []
        for _ in range(SAMPLES):
            rows.append(engine.step(t, cycle / SAMPLES, u))
            t += cycle / SAMPLES
        last = dict(zip(names, rows[-1], strict=True))
        means = dict(zip(names, np.mean(rows, axis=0), strict=True))
        shown = {name: float(means[INSTANT[name]] if name in INSTANT else last[name]) for name in TOLD}
        found.append(dict(zip(("N", "wastegate", "egr_valve"), at, strict=True)) | shown)
    engine.close()
    return found


class Resting:
    """Where the control model settles at the points, each sought from where it was found before."""

    def __init__(self, points: Sequence[Mapping[str, float]]) -> None:
        self._points = points
        self._derivatives = jacobians(MODEL)
        self._found: dict[int, Vector] = {}

    def __call__(self, parameters: Mapping[str, float]) -> Vector:
        """What is compared, a row a point, in the model's units, which are SI. Raises SteadyError."""
        rows = []
        for k, one in enumerate(self._points):
            commands = {name: one[name] for name in ("N", "wastegate", "egr_valve")}
            positions = {"wastegate_position": one["wastegate"], "egr_position": one["egr_valve"]}
            at = point(MODEL, {**parameters, **commands, **positions})
            rest = steady_state(self._derivatives, at._replace(x=self._found.get(k, at.x)))
            self._found[k] = rest.point.x
            names = [signal.name for signal in MODEL.states]
            shown = dict(zip(names, rest.point.x.tolist(), strict=True)) | dict(rest.outputs)
            rows.append([shown[name] for name in COMPARED])
        return np.array(rows)


def fitted(points: Sequence[Mapping[str, float]]) -> Fit:
    """The parameters for which the control model rests nearest to the reference, by the sum of squared logarithms."""
    wanted = np.array([[one[name] for name in COMPARED] for one in points])
    first = np.array([DEFAULTS[name] for name in FITTED])
    resting = Resting(points)

    def left(shares: Vector) -> Vector:
        return np.log(resting(dict(zip(FITTED, shares * first, strict=True))) / wanted).ravel()

    found = least_squares(left, np.ones(len(FITTED)), bounds=RANGE, diff_step=1e-3, ftol=1e-6, xtol=1e-6, x_scale=0.1)
    best = dict(zip(FITTED, (float(f"{value:.6g}") for value in found.x * first), strict=True))
    return Fit(best, np.reshape(found.fun, wanted.shape))


def written(points: Sequence[Mapping[str, float]], fit: Fit) -> str:
    """The text of the module."""
    rms = np.sqrt(np.mean(np.expm1(fit.left) ** 2, axis=0))
    quality = ", ".join(f"{name} {100.0 * value:.1f}" for name, value in zip(COMPARED, rms, strict=True))
    lines = [
        '"""Steady points of the engine `gas_exchange`, and the parameters of `turbo_si_egr` that were fitted to them.',
        "",
        "Computed [C] by `python docs/turbo_si_egr/fit.py`: means of a cycle after eight seconds at each point, in SI",
        "but for the inputs N [rpm], wastegate [mm] and egr_valve [deg]. The fit is by least squares on what is at",
        f"rest, each relative to its size: {', '.join(COMPARED)}.",
        "What it leaves, root mean square over the points [%]:",
        f"{quality}.",
        '"""',
        "",
        "_NAMES = (",
        *_wrapped(f'"{name}"' for name in points[0]),
        ")  # fmt: skip",
        "_VALUES = (",
    ]
    for one in points:
        lines += ["    (", *_wrapped((f"{value:.8g}" for value in one.values()), 8), "    ),"]
    lines += [
        ")  # fmt: skip",
        "# The named point first.",
        "STEADY: tuple[dict[str, float], ...] = tuple(dict(zip(_NAMES, row, strict=True)) for row in _VALUES)",
        "FITTED: dict[str, float] = {",
        *(f'    "{name}": {value:.6g},' for name, value in fit.parameters.items()),
        "}",
    ]
    return "\n".join(lines) + "\n"


def _wrapped(items: Iterable[str], indent: int = 4) -> list[str]:
    margin = " " * indent
    return textwrap.wrap(", ".join(items) + ",", 118, initial_indent=margin, subsequent_indent=margin)


if __name__ == "__main__":
    found = steady_points()
    TARGET.write_text(written(found, fitted(found)), encoding="utf-8")
    print(TARGET)
