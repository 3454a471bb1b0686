"""Writes what was measured into docs/speed.md, between its marks, and draws the growth beside it."""

from __future__ import annotations

import os
import platform
import re
from collections.abc import Iterator, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure

from benchmarks.comparison import BARE, FMPY_CALLS, PEERS, SIMULATE_FMU, Comparison
from benchmarks.growth import Growth, line
from benchmarks.long_run import LIMIT, LongRun
from benchmarks.periodic import HARMONICS, STAGES, STATES, Costs
from benchmarks.real_time import RealTime
from fmus.toolchain import find_compiler

OURS = "crankbench, everything recorded"
ENGINES = ("fmpy", "ecospy", "libcosimpy")
# Repeatable bytes, and text as text.
STYLE: dict[Any, Any] = {
    "svg.hashsalt": "crankbench",
    "svg.fonttype": "none",
    "font.size": 9.0,
    "axes.grid": True,
    "grid.alpha": 0.3,
}


def replace_section(text: str, name: str, content: str) -> str:
    """The text with what stands between `<!-- NAME -->` and `<!-- end of NAME -->` replaced.

    Raises ValueError: there are no such marks.
    """
    begin, end = f"<!-- {name} -->", f"<!-- end of {name} -->"
    pattern = re.compile(f"{re.escape(begin)}.*?{re.escape(end)}", re.DOTALL)
    if not pattern.search(text):
        raise ValueError(f"there is no '{begin}' with '{end}' after it")
    return pattern.sub(lambda _: f"{begin}\n{content.strip()}\n{end}", text)


def write_page(
    page: Path,
    comparisons: Sequence[Comparison],
    growths: Sequence[Growth],
    long: LongRun | None,
    costs: Costs | None = None,
    kept: RealTime | None = None,
) -> None:
    """Replace the sections of the page that were measured, and the drawings in the folder of its name."""
    text = page.read_text(encoding="utf-8")
    for name, content in (
        ("machine", machine()),
        ("peers", "\n".join(_peers(comparisons))),
        ("growth", "\n".join(_growths(growths))),
        ("long run", _long_run(long)),
    ):
        text = replace_section(text, name, content)
    if costs is not None:
        text = replace_section(text, "periodic", "\n".join(periodic(costs)))
    if kept is not None:
        text = replace_section(text, "imbalance", "\n".join(real_time(kept)))
    folder = page.with_suffix("")
    folder.mkdir(exist_ok=True)
    for growth in growths:
        draw(growth, folder / f"{growth.things}.svg")
    temporary = page.with_suffix(".tmp")
    temporary.write_text(text, encoding="utf-8")
    os.replace(temporary, page)


def machine() -> str:
    """One line on what was measured on: processor, cores, system, Python, compiler, engines."""
    compiler = find_compiler().version.splitlines()[0]
    engines = [f"{name} {_version(name)}" for name in ENGINES]
    system = f"{platform.system()} on {platform.machine()}"
    return (
        f"Measured on {_processor()}, {os.cpu_count()} cores, {system}, Python {platform.python_version()}, "
        f"{compiler}, {', '.join(engines)}."
    )


def _processor() -> str:
    known = Path("/proc/cpuinfo")
    if known.is_file():
        for entry in known.read_text().splitlines():
            if entry.startswith("model name"):
                return entry.partition(":")[2].strip()
    return platform.processor() or "an unknown processor"


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "(not installed)"


def _peers(comparisons: Sequence[Comparison]) -> Iterator[str]:
    """Engines against set-ups: microseconds a step, and how many times the bare C loop's that is."""
    yield f"| microseconds a step (times bare C) | {' | '.join(one.measures[0].name for one in comparisons)} |"
    yield f"|---|{'---|' * len(comparisons)}"
    times = [{measure.peer_name: measure.peer for measure in one.measures} for one in comparisons]
    for known, one in zip(times, comparisons, strict=True):
        known[OURS] = one.measures[0].ours
    absent: dict[str, str] = {}
    for engine in (BARE, OURS, FMPY_CALLS, SIMULATE_FMU, *PEERS):
        cells = [_cell(known[engine], known[BARE]) if engine in known else "" for known in times]
        yield f"| {engine} | {' | '.join(cells)} |"
        for one in comparisons:
            if engine in one.absent:
                absent[engine] = one.absent[engine]
    for engine, reason in absent.items():
        yield f"\n{engine}: not measured here, {reason}"


def _cell(seconds: float, bare: float) -> str:
    times = seconds / bare
    return f"{_three(seconds * 1e6)} ({times:.2f})" if times < 10 else f"{_three(seconds * 1e6)} ({times:.0f})"


def _three(value: float) -> str:
    """Three significant digits, without an exponent."""
    return f"{value:.0f}" if value >= 100 else f"{value:.{2 if value < 10 else 1}f}" if value >= 1 else f"{value:.3f}"


def _growths(growths: Sequence[Growth]) -> Iterator[str]:
    yield "| number of | from, to | one more costs, a step | the bare C loop's | ratio | R² of the line |"
    yield "|---|---|---|---|---|---|"
    for growth in growths:
        ours, bare = line(growth.counts, growth.ours), line(growth.counts, growth.bare)
        numbers = f"{growth.counts[0]:,}, {growth.counts[-1]:,}"
        costs = f"{_three(ours.slope * 1e9)} ns | {_three(bare.slope * 1e9)} ns | {ours.slope / bare.slope:.2f}"
        yield f"| {growth.things} | {numbers} | {costs} | {ours.r_squared:.5f} |"


def periodic(costs: Costs) -> Iterator[str]:
    """Periodic-input observers: a sampling as FMU and in NumPy, and its operations, over harmonics, states and lags."""
    yield "| observer | exported FMU | Eq. 4 in NumPy | times | operations |"
    yield "|---|---|---|---|---|"
    for group, operations in zip((costs.harmonics, costs.states, costs.stages), costs.operations, strict=True):
        for one, count in zip(group, operations, strict=True):
            times = f"{_three(one.ours * 1e6)} us | {_three(one.peer * 1e6)} us | {1.0 / one.ratio:.0f}"
            yield f"| {one.name.partition(', ')[2]} | {times} | {count:,} |"
    yield ""
    things = ("harmonic", "state", "lag")
    told = [
        f"{one.slope:.0f} a {thing} (R² {one.r_squared:.5f})" for one, thing in zip(costs.lines(), things, strict=True)
    ]
    ranges = [f"{min(counts)} to {max(counts)}" for counts in (HARMONICS, STATES, STAGES)]
    yield f"Operations grow by {told[0]} from {ranges[0]}, {told[1]} from {ranges[1]}, {told[2]} from {ranges[2]}."


def real_time(kept: RealTime) -> Iterator[str]:
    """A whole case of the campaign imbalance: its time for a step beside the engine's, over the speed."""
    yield "| speed | a step here | a step of the engine | times as fast |"
    yield "|---|---|---|---|"
    for speed, one in zip(kept.speeds, kept.measures, strict=True):
        times = f"{_three(one.ours * 1e6)} us | {_three(one.peer * 1e6)} us | {1.0 / one.ratio:.1f}"
        yield f"| {speed:,} rpm | {times} |"
    yield ""
    shares = ", ".join(f"{name} {100.0 * share:.0f} %" for name, share in kept.shares.items())
    yield f"At {kept.speeds[-1]:,} rpm the parts share their time so: {shares}."


def _long_run(long: LongRun | None) -> str:
    if long is None:
        return "Not measured on this system."
    megabytes = [f"{size / 1e6:.0f} MB" for size in (long.largest, long.together, long.record)]
    together = f" ({megabytes[1]} in all its processes together)" if long.together else ""
    return (
        f"{long.steps:,} steps, {long.columns} columns recorded in each: {long.seconds:.0f} s from the command to its "
        f"end, {megabytes[0]} of resident memory at the peak of its largest process{together}, where the limit is "
        f"{LIMIT / 1e6:.0f} MB; signals.parquet has {megabytes[2]}."
    )


def draw(growth: Growth, path: Path) -> None:
    """The measured times with the lines through them, on logarithmic axes, as SVG."""
    whole = growth.things == "steps"
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(4.6, 3.2), layout="constrained")
        axis = figure.add_subplot()
        for name, times, colour in (("crankbench", growth.ours, "C0"), ("bare C loop", growth.bare, "C1")):
            fitted = line(growth.counts, times)
            slope = f"{_three(fitted.slope * 1e9)} ns each"
            axis.plot(growth.counts, times, "o", color=colour, label=f"{name}, {slope}")
            along = [growth.counts[0] * (growth.counts[-1] / growth.counts[0]) ** (i / 60) for i in range(61)]
            drawn = [(x, fitted.at_zero + fitted.slope * x) for x in along]
            axis.plot(*zip(*((x, y) for x, y in drawn if y > 0.0), strict=True), color=colour, linewidth=1.0)
        axis.set(xscale="log", yscale="log", xlabel=growth.things, ylabel=f"seconds a {'run' if whole else 'step'}")
        axis.legend()
        FigureCanvasSVG(figure).print_svg(path, metadata={"Date": None})
