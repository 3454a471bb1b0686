"""Draw the figures of docs/crank_engine.md: `python docs/crank_engine/draw.py` writes them beside itself."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import SimpleNamespace

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from fmus.component import Vector
from fmus.export import cached_fmu
from fmus.fmu import load_fmu
from fmus.jacobians import point
from fmus.plants.crank_engine import MODEL, cylinder_volume
from fmus.units import parse_unit

STYLE = {
    "svg.hashsalt": "crankbench",
    "svg.fonttype": "none",
    "font.family": "DejaVu Sans",
    "font.size": 9.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
    "legend.fontsize": 8.0,
    "lines.linewidth": 1.2,
}
RPM = np.pi / 30.0
FUEL = {None: 2.1162e-5, "si": 1.894e-5}  # kg, 8 bar at 1500 rpm
COLOURS = {1: "C3", 2: "C0", 3: "C1", 4: "C2"}


def draw(folder: Path, seconds: float = 3.0) -> list[Path]:
    """Write the figures into `folder` and return their paths; the imbalance lasts for `seconds`."""
    with matplotlib.rc_context(STYLE):
        figures = {"cycle": _cycle(), "imbalance": _imbalance(seconds)}
        paths = [folder / f"{name}.svg" for name in figures]
        for path, figure in zip(paths, figures.values(), strict=True):
            figure.savefig(path, metadata={"Date": None, "Creator": "docs/crank_engine/draw.py"})
    return paths


def _course(
    parameter_set: str | None, rpm: float, begin: float, stop: float, degrees: float, extra: float = 0.0
) -> dict[str, Vector]:
    """Signals by name from `begin` to `stop` [s] in steps of so many degrees; offset_1 is `extra` from half way on."""
    given = MODEL.parameter_sets[parameter_set] if parameter_set else {}
    units = {signal.name: signal.unit for signal in MODEL.parameters}
    starts = {name: parse_unit(units[name]).to_si(float(value)) for name, value in given.items()}
    component = load_fmu(cached_fmu(MODEL), starts={**starts, "omega_e": rpm * RPM} if rpm != 1500.0 else starts)
    inputs = {f"m_f_{i}": FUEL[parameter_set] for i in COLOURS} | {"speed_demand": rpm * RPM}
    h, rows, times = degrees / (6.0 * rpm), [], []
    y = component.start(0.0, _vector(inputs))
    for k in range(round(stop / h)):
        if k * h >= 0.5 * stop:
            inputs["offset_1"] = extra
        y = component.step(k * h, h, _vector(inputs))
        if k * h >= begin:
            rows.append(y)
            times.append((k + 1) * h)
    names = [signal.name for signal in component.outputs]
    component.close()
    return {**dict(zip(names, np.array(rows).T, strict=True)), "time": np.array(times)}


def _vector(inputs: Mapping[str, float]) -> Vector:
    return np.array([inputs.get(signal.name, signal.start) for signal in MODEL.inputs], dtype=float)


def _cycle() -> Figure:
    """The last of some cycles: pressure, volume, temperature, heat, valves and the crank, both engines."""
    figure = Figure(figsize=(11.0, 6.6), layout="constrained")
    axes = figure.subplots(2, 3)
    for parameter_set, rpm, style in ((None, 1500.0, "-"), (None, 6000.0, ":"), ("si", 1500.0, "--")):
        cycle = 120.0 / rpm
        run = _course(parameter_set, rpm, 49.0 * cycle, 52.0 * cycle, 0.5)
        angle = np.degrees(run["theta"])
        middle = 720.0 * (angle[0] // 720.0 + 2.0)
        shown = np.abs(angle - middle) <= 360.0
        phi, one = (angle - middle)[shown], {name: values[shown] for name, values in run.items()}
        label = f"{parameter_set or 'default'}, {rpm:.0f} rpm"
        names = [signal.name for signal in MODEL.parameters]
        p = SimpleNamespace(**dict(zip(names, point(MODEL, None, parameter_set).p, strict=True)))
        V = np.array([cylinder_volume(1, theta, p) for theta in one["theta"]])
        lines: tuple[tuple[Axes, Vector, Vector], ...] = (
            (axes[0, 0], phi, 1e-5 * one["p_1"]),
            (axes[0, 1], 1e6 * V, 1e-5 * one["p_1"]),
            (axes[0, 2], phi, one["T_1"]),
            (axes[1, 0], phi, 1e-3 * (one["Q_burn_1"] - one["Q_wall_1"])),
            (axes[1, 2], phi, 100.0 * (one["omega_e"] / one["omega_e"].mean() - 1.0)),
        )
        for axis, x, y in lines:
            axis.plot(x, y, style, color="C3" if parameter_set is None else "C0", label=label)
        if rpm == 1500.0:
            colour = "C3" if parameter_set is None else "C0"
            axes[1, 1].plot(phi, 1e3 * one["W_exh_1"], "-", color=colour, label=f"{label}, out")
            axes[1, 1].plot(phi, 1e3 * one["W_int_1"], "--", color=colour, label=f"{label}, in")
    axes[0, 1].set(xscale="log", yscale="log", xlabel="volume of cylinder 1 [cm3]", ylabel="p_1 [bar]")
    axes[0, 1].set_xticks([30, 60, 100, 200, 300, 600], ["30", "60", "100", "200", "300", "600"])
    axes[0, 1].xaxis.set_minor_formatter(NullFormatter())
    for axis, y in ((axes[0, 0], "p_1 [bar]"), (axes[0, 2], "T_1 [K]"), (axes[1, 1], "flow through the valves [g/s]")):
        axis.set_ylabel(y)
    axes[1, 0].set_ylabel("Q_burn_1 - Q_wall_1 [kW]")
    axes[1, 2].set_ylabel("omega_e over its mean - 1 [%]")
    for axis in axes.flat:
        if axis is not axes[0, 1]:
            axis.set(xticks=range(-360, 361, 180), xlabel="crank angle [deg]")
    axes[1, 0].set_xlim(-90.0, 135.0)
    axes[1, 0].set_xticks([-90, -45, 0, 45, 90, 135])
    axes[0, 0].legend()
    axes[1, 1].legend()
    return figure


def _imbalance(seconds: float) -> Figure:
    """A quarter more IMEP of cylinder 1 from half way on."""
    run = _course(None, 1500.0, 0.0, seconds, 6.0, 0.23345)
    figure = Figure(figsize=(9.6, 4.8), layout="constrained")
    axes = figure.subplots(2, 2)
    cycle = slice(-361, None)
    for i, colour in COLOURS.items():
        axes[0, 0].plot(run["time"], 1e-5 * run[f"imep_{i}"], color=colour, label=f"cylinder {i}")
        axes[1, 0].plot(run["time"], run[f"afr_{i}"], color=colour)
    angle = np.degrees(run["theta"][cycle])
    angle = angle - 720.0 * (angle[0] // 720.0 + 1.0)
    axes[0, 1].plot(angle, run["torque_gas"][cycle], color="0.3")
    axes[1, 1].plot(angle, run["omega_e"][cycle] / RPM, color="0.3")
    for axis, x, y in (
        (axes[0, 0], "time [s]", "imep [bar]"),
        (axes[1, 0], "time [s]", "afr"),
        (axes[0, 1], "crank angle [deg]", "torque_gas [N.m]"),
        (axes[1, 1], "crank angle [deg]", "omega_e [rpm]"),
    ):
        axis.set(xlabel=x, ylabel=y)
    for axis in axes[:, 1]:
        axis.set(xlim=(0.0, 1440.0), xticks=range(0, 1441, 180))
    axes[0, 0].legend()
    return figure


if __name__ == "__main__":
    print(*draw(Path(__file__).parent), sep="\n")
