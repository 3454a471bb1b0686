"""Draw the figure of docs/exhaust_afr.md: `python docs/exhaust_afr/draw.py` writes it beside itself."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from fmus.exhaust_path import Breathing, path_gain_and_phase, path_harmonics, path_response, sensor_response
from fmus.export import cached_fmu
from fmus.fmu import load_fmu
from fmus.plants.exhaust_afr import CYCLE, FIRING, FIRING_ORDER, MODEL, PARAMETERS

STYLE = {
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
P = SimpleNamespace(**{signal.name: float(signal.start) for signal in PARAMETERS})
SHOWN = 1500.0  # rpm
SPEEDS = (800.0, 1000.0, 1500.0, 2000.0, 3000.0, 4500.0, 6000.0)  # rpm
M_EXH, T_EXH = 6e-4, 800.0
AFR, RICH = 20.0, 16.0  # cylinder 1 with a quarter more fuel
STEP = np.radians(6.0)
PER_CYCLE = round(CYCLE / STEP)
SIGNALS = ("afr_manifold", "afr_turbine", "afr_sensor")


def draw(folder: Path, speeds: Sequence[float] = SPEEDS) -> list[Path]:
    """Write the figure into `folder` and return its path; `speeds` [rpm] are those simulated for the gains."""
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(9.6, 6.4), layout="constrained")
        above, below = figure.subfigures(2, 1, height_ratios=(1.0, 1.1))
        _traces(above.subplots())
        _gains(below.subplots(1, 2), speeds)
        path = folder / "oscillation.svg"
        figure.savefig(path, metadata={"Date": None, "Creator": "docs/exhaust_afr/draw.py"})
    return [path]


def simulate(N: float, rich: float, cycles: int = 80) -> dict[str, Any]:
    """The last cycle at N [rpm] with cylinder 1 at an AFR of `rich`, the angle held from the middle of each step."""
    omega = N * np.pi / 30.0
    component = load_fmu(cached_fmu(MODEL))
    names, rows = [signal.name for signal in component.outputs], []

    def inputs(k: int) -> Any:
        return np.array([(k + 0.5) * STEP, omega, rich, AFR, AFR, AFR, *[M_EXH] * 4, T_EXH])

    component.start(0.0, inputs(0))
    for k in range(PER_CYCLE * cycles):
        rows.append(component.step(k * STEP / omega, STEP / omega, inputs(k)))
    component.close()
    last = np.array(rows[-PER_CYCLE:])
    return {name: last[:, names.index(name)] for name in SIGNALS}


def harmonic(signal: Any, k: int) -> complex:
    """The coefficient of exp(i k theta/2) of a cycle whose rows are at the ends of its steps."""
    return complex(np.mean(signal * np.exp(-0.5j * k * STEP * np.arange(1, PER_CYCLE + 1))))


def _traces(axis: Axes) -> None:
    last = simulate(SHOWN, RICH)
    angle = np.degrees(STEP) * np.arange(1, 2 * PER_CYCLE + 1)
    for cylinder in FIRING_ORDER:
        for turn in (-1, 0, 1):
            opens, closes = np.degrees([P.EVO, P.EVC]) + np.degrees(FIRING[cylinder]) + 720.0 * turn
            if opens < 1440.0 and closes > 0.0:
                level = 17.35 + 0.12 * FIRING_ORDER.index(cylinder)
                axis.plot([max(opens, 0.0), min(closes, 1440.0)], [level] * 2, color="0.6", linewidth=3.0)
                middle = 0.5 * (max(opens, 0.0) + min(closes, 1440.0))
                axis.annotate(f"{cylinder}", (middle, level), ha="center", va="center", fontsize=7.0)
    for name, colour in zip(SIGNALS, ("0.2", "C0", "C3"), strict=True):
        axis.plot(angle, np.tile(last[name], 2), color=colour, label=name)
    axis.set(xlim=(0.0, 1440.0), xticks=range(0, 1441, 180), xlabel="crank angle [deg]", ylabel="air over fuel")
    axis.set_title(f"Cylinder 1 at {RICH:g}, the others at {AFR:g}; {SHOWN:g} rpm; grey: exhaust phases", fontsize=9.0)
    axis.set(ylim=(17.2, 20.1))
    axis.legend(ncols=3, loc="upper right")


def _gains(axes: Any, speeds: Sequence[float]) -> None:
    N = np.linspace(min(speeds), max(speeds), 61)
    omega = N * np.pi / 30.0
    breathing, some = Breathing(omega, M_EXH, T_EXH), slice(None, None, 6)
    measured = {one: simulate(one, AFR + 1e-3) for one in speeds}
    exact = np.array([path_harmonics(3, one, np.full(4, M_EXH), T_EXH, P)[0] for one in omega[some]])
    for k, colour in zip((1, 2, 3), ("C0", "C1", "C2"), strict=True):
        order = 0.5 * k
        for name, marker in (("afr_turbine", "o"), ("afr_sensor", "s")):
            lags = sensor_response(order, omega, P) if name == "afr_sensor" else np.ones(len(N))
            line, course = path_response(order, breathing, P) * lags, exact[:, k] * lags[some]
            # The closed form's phase goes on beyond a turn; the others are near it.
            phase = path_gain_and_phase(order, breathing, P)[1] + np.angle(lags)
            plant = np.array([harmonic(measured[one][name], k) / 1e-3 for one in speeds])
            near = np.interp(speeds, N, phase)
            label = f"{name}, {k} per cycle"
            axes[0].plot(N, np.abs(line), ":", N[some], np.abs(course), "-", color=colour)
            axes[0].plot(speeds, np.abs(plant), marker, color=colour, markersize=3.5, label=label)
            axes[1].plot(N, -np.degrees(phase), ":", color=colour)
            axes[1].plot(N[some], _late(course, phase[some]), "-", color=colour)
            axes[1].plot(speeds, _late(plant, near), marker, color=colour, markersize=3.5)
    axes[0].set(yscale="log", xlabel="N [rpm]", ylabel="gain from AFR of cylinder 1", ylim=(1e-6, 0.2))
    axes[1].set(xlabel="N [rpm]", ylabel="late after its firing TDC [deg of the harmonic]")
    axes[0].set_title("Marks: plant; lines: periodic response; dotted: closed form", fontsize=9.0)
    axes[1].set_title("Phase: a turn is a cycle, a half, a third of it", fontsize=9.0)
    axes[0].legend(fontsize=7.0, ncols=2, loc="lower left")


def _late(response: Any, near: Any) -> Any:
    """Lag [deg] of a response, on the turn on which the phase [rad] `near` is."""
    return -np.degrees(near + np.angle(response * np.exp(-1j * near)))


if __name__ == "__main__":
    print(*draw(Path(__file__).parent), sep="\n")
