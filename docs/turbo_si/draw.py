"""Draw the figures of docs/turbo_si.md: `python docs/turbo_si/draw.py` writes them beside itself."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from fmus.gas import Gas, isentropic_flow
from fmus.jacobians import Jacobians, jacobians, point
from fmus.plants.turbo_si import MODEL
from fmus.steady import Steady, steady_state
from fmus.turbocharger import compressor, turbine

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
SETS = (None, "A_realistic", "B")
SPEEDS = tuple(range(1000, 6001, 1000))  # rpm
THROTTLES = (0.05, 0.1, 0.15, 0.2, 0.3, 1.0)
WASTEGATE = 0.2
COLOURS = [matplotlib.colormaps["viridis"](share) for share in np.linspace(0.0, 0.9, len(THROTTLES))]


def draw(folder: Path, speeds: Sequence[float] = SPEEDS) -> list[Path]:
    """Write the figures into `folder` and return their paths; `speeds` [rpm] are those of the equilibria."""
    engine = jacobians(MODEL)
    with matplotlib.rc_context(STYLE):
        rests = {name: _rests(engine, name, speeds) for name in SETS}
        figures = {
            "maps": _maps(rests),
            "steady": _steady(rests),
            "time_constants": _time_constants(engine),
        }
        paths = [folder / f"{name}.svg" for name in figures]
        for path, figure in zip(paths, figures.values(), strict=True):
            figure.savefig(path, metadata={"Date": None, "Creator": "docs/turbo_si/draw.py"})
    return paths


def _parameters(parameter_set: str | None) -> SimpleNamespace:
    names = [signal.name for signal in MODEL.parameters]
    return SimpleNamespace(**dict(zip(names, point(MODEL, None, parameter_set).p, strict=True)))


def _rests(engine: Jacobians, parameter_set: str | None, speeds: Sequence[float]) -> dict[float, list[Steady]]:
    """Equilibria over speed by throttle, each found from the one before."""
    found: dict[float, list[Steady]] = {}
    for alpha in THROTTLES:
        found[alpha] = []
        for N in speeds:
            start = point(MODEL, {"N": N, "alpha": alpha, "u_wg": WASTEGATE}, parameter_set)
            if found[alpha]:
                start = start._replace(x=found[alpha][-1].point.x)
            found[alpha].append(steady_state(engine, start))
    return found


def _maps(rests: dict[str | None, dict[float, list[Steady]]]) -> Figure:
    figure = Figure(figsize=(11.0, 7.2), layout="constrained")
    axes = figure.subplots(2, 3)
    for axis, name in zip(axes[0], (None, "A_realistic"), strict=False):
        _compressor_map(axis, name, rests[name])
    _orifices(axes[0, 2])
    _compressor_efficiency(axes[1, 0])
    _turbine_flow(axes[1, 1])
    _turbine_efficiency(axes[1, 2])
    return figure


def _compressor_map(axis: Axes, parameter_set: str | None, rests: dict[float, list[Steady]]) -> None:
    p = _parameters(parameter_set)
    air = Gas(p.gamma_a, p.R_a)
    PI = np.linspace(0.9, 3.2, 93)
    for krad in (5, 10, 15, 20, 25, 30):
        W = compressor(1e5, 298.0, 1e5 * PI, 340.0, 1e3 * krad, air, p).W
        axis.plot(1e3 * W, PI, color="0.6")
        shown = np.flatnonzero(PI >= 1.0)[0]
        axis.annotate(f"{krad}", (1e3 * W[shown], 1.0), ha="center", va="top", fontsize=7.5, color="0.4")
    for (alpha, rest), colour in zip(rests.items(), COLOURS, strict=True):
        W = [1e3 * one.outputs["W_comp"] for one in rest]
        ratio = [one.states["p_comp"] / one.states["p_af"] for one in rest]
        axis.plot(W, ratio, "o-", markersize=3.0, color=colour, label=f"alpha {alpha:g}")
    axis.set(xlim=(-30.0, 150.0), ylim=(0.9, 3.2), xlabel="W_comp [g/s]", ylabel="p_comp/p_af")
    axis.set_title(f"Compressor, set {parameter_set or 'A'}, at constant speed [krad/s]", fontsize=9.0)
    axis.legend(title=f"at rest, u_wg {WASTEGATE:g}", title_fontsize=8.0, loc="upper right")


def _compressor_efficiency(axis: Axes) -> None:
    for name, colour in ((None, "C0"), ("A_realistic", "C1")):
        p = _parameters(name)
        air, omega = Gas(p.gamma_a, p.R_a), 1e4
        ND = omega * p.D_c / (2.0 * np.pi)
        PI = (1.0 + np.linspace(0.02, 0.999, 100) * p.Psi_max * ND**2 / (air.cp * 298.0)) ** 3.5
        wheel = compressor(1e5, 298.0, 1e5 * PI, 340.0, omega, air, p)
        Phi = wheel.W * air.R * 298.0 / (1e5 * ND * p.D_c**2)
        axis.plot(
            Phi, 298.0 * (PI ** (1.0 / 3.5) - 1.0) / (wheel.T_out - 298.0), color=colour, label=f"set {name or 'A'}"
        )
    axis.set(xlabel="Phi", ylabel="efficiency", ylim=(0.0, 1.0))
    axis.set_title("Compressor, efficiency over flow coefficient", fontsize=9.0)
    axis.legend()


def _turbine_flow(axis: Axes) -> None:
    expansion = np.linspace(1.0, 3.0, 60)
    for name, colour in ((None, "C0"), ("B", "C1")):
        p = _parameters(name)
        W = turbine(1e5 * expansion, 1100.0, 1e5, 900.0, 1e4, Gas(p.gamma_e, p.R_e), p).W
        axis.plot(expansion, 1e3 * W * np.sqrt(1100.0) / (100.0 * expansion), color=colour, label=f"set {name or 'A'}")
    axis.set(xlabel="p_em/p_t", ylabel="W sqrt(T_em)/p_em [g/s K^0.5/kPa]", ylim=(0.0, 20.0))
    axis.set_title("Turbine, flow", fontsize=9.0)
    axis.legend()


def _turbine_efficiency(axis: Axes) -> None:
    BSR = np.linspace(0.02, 1.6, 80)
    for name, colour in ((None, "C0"), ("B", "C1")):
        p = _parameters(name)
        exhaust = Gas(p.gamma_e, p.R_e)
        drop = exhaust.cp * 1100.0 * (1.0 - 0.5 ** ((exhaust.gamma - 1.0) / exhaust.gamma))
        wheel = turbine(2e5, 1100.0, 1e5, 900.0, 2.0 * BSR * np.sqrt(2.0 * drop) / p.D_t, exhaust, p)
        axis.plot(BSR, exhaust.cp * (1100.0 - wheel.T_out) / drop, color=colour, label=f"set {name or 'A'}")
    axis.set(xlabel="blade speed ratio", ylabel="efficiency", ylim=(0.0, 1.0))
    axis.set_title("Turbine, efficiency", fontsize=9.0)
    axis.legend()


def _orifices(axis: Axes) -> None:
    p = _parameters(None)
    ratio = np.concatenate([np.linspace(0.2, 0.98, 40), np.linspace(0.98, 1.02, 41), np.linspace(1.02, 1.1, 10)])
    for alpha, colour in zip(THROTTLES[:5], COLOURS, strict=False):
        area = p.a_0 + p.a_1 * alpha + p.a_2 * alpha**2
        W = isentropic_flow(1e5, 300.0, 1e5 * ratio, 300.0, area, Gas(p.gamma_a, p.R_a), p.PI_lin)
        axis.plot(ratio, 1e3 * W, color=colour, label=f"throttle, alpha {alpha:g}")
    for u_wg, style in ((0.2, ":"), (1.0, "--")):
        area, exhaust = p.A_wg_max * p.C_d * u_wg, Gas(p.gamma_e, p.R_e)
        W = isentropic_flow(1e5, 1100.0, 1e5 * ratio, 900.0, area, exhaust, p.PI_lin)
        axis.plot(ratio, 1e3 * W, style, color="C3", label=f"wastegate, u_wg {u_wg:g}")
    axis.set(xlabel="pressure behind over pressure before", ylabel="W [g/s]", ylim=(-95.0, 70.0))
    axis.set_title("Throttle (300 K), wastegate (1100 K), at 1 bar", fontsize=9.0)
    axis.legend(loc="lower left", fontsize=7.0)


def _steady(rests: dict[str | None, dict[float, list[Steady]]]) -> Figure:
    shown = [
        ("p_im [bar]", lambda rest: 1e-5 * rest.states["p_im"]),
        ("p_ic [bar]", lambda rest: 1e-5 * rest.states["p_ic"]),
        ("omega_tc [krad/s]", lambda rest: 1e-3 * rest.states["omega_tc"]),
        ("cac_stroke [g]", lambda rest: 1e3 * rest.outputs["cac_stroke"]),
        ("torque [N.m]", lambda rest: rest.outputs["torque"]),
    ]
    figure = Figure(figsize=(9.6, 11.0), layout="constrained")
    axes = figure.subplots(len(shown), len(rests), sharex=True, sharey="row")
    for column, (name, by_throttle) in zip(axes.T, rests.items(), strict=True):
        for axis, (_, value) in zip(column, shown, strict=True):
            for (alpha, found), colour in zip(by_throttle.items(), COLOURS, strict=True):
                speeds = [one.point.u[0] for one in found]
                axis.plot(speeds, [value(one) for one in found], color=colour, label=f"alpha {alpha:g}")
        column[0].set_title(f"Set {name or 'A'}, u_wg {WASTEGATE:g}", fontsize=9.0)
        column[-1].set_xlabel("N [rpm]")
    for axis, (label, _) in zip(axes[:, 0], shown, strict=True):
        axis.set_ylabel(label)
    axes[0, 0].legend(ncols=2)
    return figure


def _time_constants(engine: Jacobians) -> Figure:
    """Of the linearised engine over the throttle, and what RK4 at a millisecond asks of them."""
    throttles = [0.0, *np.geomspace(0.03, 1.0, 14)]
    figure = Figure(figsize=(9.6, 3.6), layout="constrained")
    axis = figure.subplots()
    start = point(MODEL, {"alpha": 0.0, "u_wg": WASTEGATE})
    for alpha in throttles:
        rest = steady_state(engine, point(MODEL, {"alpha": alpha, "u_wg": WASTEGATE})._replace(x=start.x))
        start = rest.point
        rates = -np.linalg.eigvals(engine.at(start).A).real
        axis.semilogy(np.full(13, alpha), 1.0 / rates, ".", color="C0", markersize=4.0)
    axis.axhline(1e-3 / 2.785, color="C3", linestyle="--")
    axis.annotate("shortest that RK4 bears at 1 ms", (0.7, 1e-3 / 2.785), va="bottom", color="C3", fontsize=8.0)
    axis.set(xlabel="alpha", ylabel="time constant [s]")
    axis.set_title(
        f"Set A at 2000 rpm, u_wg {WASTEGATE:g}: minus one over the real parts of the eigenvalues", fontsize=9.0
    )
    return figure


if __name__ == "__main__":
    print(*draw(Path(__file__).parent), sep="\n")
