"""The page on a selection of sensors by error: the sets, the proofs, and the trade of error against sensors."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import matplotlib
import numpy as np
from markupsafe import Markup
from matplotlib.figure import Figure as Drawing
from matplotlib.ticker import MaxNLocator

from reports.figures import INK, STYLE, svg
from reports.numbers import short
from reports.page import page_of
from reports.setfigures import CELL, LETTER

METHODS = {
    "h2": "The sets are those that the semidefinite program chooses, which weighs the error of the filter against a "
    "weighted l1 norm of its gain; beside each is what it lacks to the best set of as many sensors.",
    "optimal": "Of each number of sensors the best set is proven by branch and bound.",
}


def optimal_page(content: Mapping[str, Any]) -> str:
    """The page of a selection by error, from the JSON that `crankbench select` gives."""
    return page_of(
        "optimal.html.jinja",
        content=content,
        meaning=METHODS[content["method"]],
        best=best_of_all(content),
        units={state["name"]: state["unit"] for state in content["states"]},
        drawings={name: Markup(drawing) for name, drawing in optimal_drawings(content).items()},
    )


def best_of_all(content: Mapping[str, Any]) -> str:
    """The verdict: the best set of each number of sensors."""
    known = [size for size in content["by_size"] if size["sensors"]]
    if not known:
        return "no set sees what it must"
    told = [f"{', '.join(size['sensors'])} ({short(size['error'], 3)})" for size in known]
    return f"best of {_counted(known)}: {'; '.join(told)}"


def _counted(known: list[Mapping[str, Any]]) -> str:
    numbers = [str(size["size"]) for size in known]
    return numbers[0] if len(numbers) == 1 else f"{', '.join(numbers[:-1])} and {numbers[-1]}"


def optimal_drawings(content: Mapping[str, Any]) -> dict[str, str]:
    """The drawings as SVG elements: error by number of sensors, and of a sweep over alpha which sensors it uses."""
    drawn = {"tradeoff": _tradeoff(content)}
    if any(point["used"] for point in content["curve"]):
        drawn["used"] = _used(content)
    return drawn


def _tradeoff(content: Mapping[str, Any]) -> str:
    """Error against the number of sensors: every set shown, the best, the greedy, the safest after a loss."""
    sizes = [size for size in content["by_size"] if size["sensors"]]
    with matplotlib.rc_context(STYLE):
        drawing = Drawing(figsize=(7.6, 3.6), layout="constrained")
        axis = drawing.subplots()
        sets = [row for row in content["sets"] if row["error"] is not None]
        label = "chosen by the program" if content["method"] == "h2" else "sets shown"
        marks = ([len(row["sensors"]) for row in sets], [row["error"] for row in sets])
        axis.plot(*marks, "o", color="C0", markersize=6, markerfacecolor="none", label=label, zorder=3)
        counts = [size["size"] for size in sizes]
        axis.plot(counts, [size["error"] for size in sizes], "-", color="C0", marker=".", label="best, proven")
        loss = [(s["size"], s["safest"]["error_after_loss"]) for s in sizes if s["safest"]]
        if loss:
            axis.plot(*zip(*loss, strict=True), ":", color="C1", marker=".", label="safest, after the worst loss")
        for key, text in (("without_sensors", "without sensors"), ("with_all_sensors", "with all sensors")):
            if content[key] is not None:
                axis.axhline(content[key], color=INK, linewidth=0.8, linestyle="--", alpha=0.6)
                axis.annotate(text, (1.0, content[key]), xycoords=("axes fraction", "data"), ha="right", va="bottom")
        axis.set_ylim(0.0, None)
        axis.xaxis.set_major_locator(MaxNLocator(8, integer=True))
        axis.set_xlabel("sensors")
        axis.set_ylabel("expected error, of the states' sizes")
        axis.legend(loc="upper left", bbox_to_anchor=(1.005, 1.02), borderaxespad=0.0)
        return svg(drawing, "tradeoff")


def _used(content: Mapping[str, Any]) -> str:
    """How much of each sensor the program uses at each alpha, w_j ||Q_j||_1, and above it the bound on the error."""
    points = [point for point in content["curve"] if point["used"]]
    names = list(points[0]["used"])
    values = np.array([[point["used"][name] for point in points] for name in names])
    with matplotlib.rc_context(STYLE | {"axes.grid": False}):
        width, height = 1.2 + LETTER * max(map(len, names)) + 1.6 * CELL * len(points), CELL * len(names)
        drawing = Drawing(figsize=(max(width, 5.0), height + 2.6), layout="constrained")
        above, axis = drawing.subplots(2, 1, sharex=True, height_ratios=[1.7, max(height, 0.5)])
        places = np.arange(len(points)) + 0.5
        wanted = len(content["estimate"])
        above.plot(places, [np.sqrt(point["trace_T"] / wanted) for point in points], "o-", color="C0", markersize=4)
        above.set_ylabel("error at most")
        above.set_ylim(0.0, None)
        axis.pcolormesh(np.clip(values, 0.0, 1.0), cmap="cividis_r", vmin=0.0, vmax=1.0, edgecolors=INK, linewidth=0.3)
        axis.set_yticks(np.arange(len(names)) + 0.5, names)
        axis.set_xticks(places, [short(point["alpha"], 2) for point in points], rotation=90)
        axis.set_ylim(len(names), 0)
        axis.set_xlabel("alpha")
        axis.tick_params(length=0)
        return svg(drawing, "used")
