"""Draw the figures of docs/gas_exchange.md into docs/gas_exchange: `python -m benchmarks.gas_exchange_figures`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from benchmarks.cantera_cylinder import MOTORED, trace
from fmus.export import cached_fmu
from fmus.fmu import load_fmu
from fmus.model import Model
from fmus.plants import gas_exchange, single_cylinder
from fmus.units import parse_unit

FOLDER = Path(__file__).parents[1] / "docs" / "gas_exchange"
STYLE: dict[Any, Any] = {
    "svg.hashsalt": "crankbench",
    "svg.fonttype": "none",
    "font.family": "DejaVu Sans",
    "font.size": 9.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
    "legend.fontsize": 8.0,
    "lines.linewidth": 1.3,
}
SPEEDS = (2400.0, 3200.0, 4000.0)  # rpm
SECONDS = 2.5  # in which a steady cycle is reached to 1e-3


def draw(folder: Path, points: int = 9) -> list[Path]:
    """Write the figures into `folder` and return their paths; `points` is how many make a curve of the trends."""
    with matplotlib.rc_context(STYLE):
        figures = {"cantera": _cantera(), "cycle": _cycle(), "trends": _trends(points), "step": _step()}
        paths = [folder / f"{name}.svg" for name in figures]
        for path, figure in zip(paths, figures.values(), strict=True):
            figure.savefig(path, metadata={"Date": None, "Creator": "benchmarks/gas_exchange_figures.py"})
    return paths


def _run(
    model: Model, values: Mapping[str, float], spans: Sequence[tuple[float, int]]
) -> dict[str, NDArray[np.float64]]:
    """Outputs by name over the last of the spans (s, steps), under held inputs."""
    component = load_fmu(cached_fmu(model))
    given = {signal.name: values.get(signal.name, float(signal.start)) for signal in model.inputs}
    u = np.array([parse_unit(signal.unit).to_si(given[signal.name]) for signal in model.inputs])
    rows, time = [component.start(0.0, u)], 0.0
    for h, steps in spans:
        rows = rows[-1:]
        for _ in range(steps):
            rows.append(component.step(time, h, u))
            time += h
    component.close()
    table = np.array(rows)
    return {signal.name: table[:, k] for k, signal in enumerate(component.outputs)}


def _settled(**values: float) -> dict[str, float]:
    cycle = 120.0 / values.get("N", 3200.0)
    return {
        name: float(one[-1])
        for name, one in _run(gas_exchange.MODEL, values, [(cycle, round(SECONDS / cycle))]).items()
    }


def _cantera() -> Figure:
    degrees = np.arange(-180.0, 541.0)
    parameters = {signal.name: float(signal.start) for signal in single_cylinder.MODEL.parameters}
    figure = Figure(figsize=(9.6, 5.4), layout="constrained")
    axes = figure.subplots(2, 2, sharex=True, height_ratios=(2, 1))
    cases = {"motored": {"lambda": MOTORED, "T_ex": 320.0, "F_ex": 0.0}, "fired": {}}
    for (name, given), column in zip(cases.items(), axes.T, strict=True):
        values = {signal.name: float(signal.start) for signal in single_cylinder.MODEL.inputs} | given
        ours = _run(single_cylinder.MODEL, values, [(1.0 / 6.0 / values["N"], len(degrees) - 1)])["p"]
        theirs = trace(parameters, values, {"p": 1e5, "T": 320.0, "F": 0.03}, degrees).p
        column[0].semilogy(degrees, 1e-5 * theirs, color="C1", linewidth=3.0, alpha=0.5, label="Cantera")
        column[0].semilogy(degrees, 1e-5 * ours, color="C0", label="single_cylinder")
        column[0].set_title(f"{name}, {values['N']:.0f} rpm", fontsize=9.0)
        column[1].plot(degrees, 1e2 * (ours - theirs) / theirs.max(), color="C3")
        column[1].set(xlabel="crank angle [deg]", ylim=(-0.12, 0.12), xticks=np.arange(-180, 541, 90))
    axes[0, 0].set_ylabel("pressure [bar]")
    axes[1, 0].set_ylabel("difference\n[% of the peak]")
    axes[0, 0].legend()
    return figure


def _cycle() -> Figure:
    cycle = 120.0 / 3200.0
    y = _run(gas_exchange.MODEL, {}, [(cycle, 4), (cycle / 720, 720)])
    degrees = np.arange(721.0)
    figure = Figure(figsize=(9.6, 7.2), layout="constrained")
    axes = figure.subplots(4, 1, sharex=True)
    for i in range(1, 5):
        axes[0].semilogy(degrees, 1e-5 * y[f"p_cyl[{i}]"], label=f"cylinder {i}")
    for name in ("im", "boost", "em", "t", "mix"):
        axes[1].plot(degrees, 1e-5 * y[f"p_{name}_inst"], label=f"p_{name}")
    for name in ("a", "mix", "cac", "throttle"):
        axes[2].plot(degrees, 1e3 * y[f"W_{name}_inst"], label=f"W_{name}")
    for name in ("mix", "boost", "im"):
        axes[3].plot(degrees, 1e2 * y[f"F_{name}_inst"], label=f"F_{name}")
    for axis, label in zip(
        axes, ("cylinders [bar]", "pressures [bar]", "flows [g/s]", "burnt fraction [%]"), strict=True
    ):
        axis.set_ylabel(label)
        axis.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    axes[3].set(xlabel="crank angle [deg]", xticks=np.arange(0, 721, 90))
    return figure


def _trends(points: int) -> Figure:
    figure = Figure(figsize=(9.6, 6.4), layout="constrained")
    axes = figure.subplots(2, 2)
    _volumetric_efficiency(axes[0, 0], points)
    _residual_gas(axes[0, 1], points)
    for N, colour in zip(SPEEDS, ("C0", "C1", "C2"), strict=True):
        diameters, angles = np.linspace(0.0, 20.0, points), np.linspace(0.0, 24.0, points)
        boost = [_settled(N=N, wastegate=d)["p_boost"] for d in diameters]
        ratio = [_settled(N=N, egr_valve=angle)["egr_ratio"] for angle in angles]
        axes[1, 0].plot(diameters, 1e-5 * np.array(boost), "o-", markersize=3.0, color=colour, label=f"{N:.0f} rpm")
        axes[1, 1].plot(angles, 1e2 * np.array(ratio), "o-", markersize=3.0, color=colour, label=f"{N:.0f} rpm")
    axes[1, 0].set(xlabel="wastegate [mm]", ylabel="p_boost [bar]")
    axes[1, 1].set(xlabel="LP-EGR valve [deg]", ylabel="EGR ratio [%]")
    axes[1, 1].axhspan(1.5, 11.0, color="0.92", zorder=0)
    axes[1, 1].annotate("range of the paper's cycle", (0.3, 10.0), fontsize=8.0, color="0.4")
    for axis in axes[1]:
        axis.legend()
    return figure


def _volumetric_efficiency(axis: Axes, points: int) -> None:
    p = {signal.name: float(signal.start) for signal in gas_exchange.MODEL.parameters}
    displaced = 0.25 * np.pi * p["bore"] ** 2 * p["stroke"]
    speeds = np.linspace(800.0, 7000.0, points)
    found = []
    for N in speeds:
        cycle = 120.0 / N
        flow = _run(single_cylinder.MODEL, {"N": N}, [(cycle, 6), (cycle / 720, 720)])["W_in"]
        found.append(flow[1:].sum() * cycle / 720 / (1e5 / (287.1 * 320.0) * displaced))
    axis.plot(speeds, found, "o-", markersize=3.0)
    axis.set(xlabel="N [rpm]", ylabel="volumetric efficiency", ylim=(0.8, 1.0))
    axis.set_title("one cylinder, 1.0 bar before and 1.05 bar behind", fontsize=9.0)


def _residual_gas(axis: Axes, points: int) -> None:
    for N, colour in zip(SPEEDS, ("C0", "C1", "C2"), strict=True):
        cycle, pressure, residual = 120.0 / N, [], []
        for angle in np.geomspace(6.0, 60.0, points):
            values = {"N": N, "throttle": angle, "egr_valve": 0.0, "wastegate": 20.0}
            # 600 deg after it fired the intake valves of cylinder 1 have shut.
            y = _run(gas_exchange.MODEL, values, [(cycle, round(SECONDS / cycle)), (cycle * 600.0 / 720.0, 1)])
            pressure.append(1e-5 * y["p_im"][-1])
            residual.append(1e2 * y["F_cyl[1]"][-1])
        axis.plot(pressure, residual, "o-", markersize=3.0, color=colour, label=f"{N:.0f} rpm")
    axis.set(xlabel="p_im [bar]", ylabel="residual gas [%]", ylim=(0.0, None))
    axis.set_title("throttle 6 to 60 deg, wastegate 20 mm, LP-EGR valve shut", fontsize=9.0)
    axis.legend()


def _step() -> Figure:
    y = _run(gas_exchange.MODEL, {"egr_valve": 20.0}, [(1e-3, 800)])
    t = 1e-3 * np.arange(801)
    figure = Figure(figsize=(9.6, 3.0), layout="constrained")
    axis = figure.subplots()
    for name in ("mix", "boost", "im"):
        axis.plot(t, 1e2 * y[f"F_{name}_inst"], label=f"F_{name}_inst")
    axis.step(t, 1e2 * y["F_im"], where="post", color="0.3", linewidth=0.9, label="F_im")
    axis.set(xlabel="time since the LP-EGR valve went from 10 to 20 deg [s]", ylabel="burnt fraction [%]")
    axis.legend()
    return figure


if __name__ == "__main__":
    print(*draw(FOLDER), sep="\n")
