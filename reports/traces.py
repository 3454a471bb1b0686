"""The figures a campaign declares: which signals of which case, over what, in what unit, colour and panel."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from fmus.units import UnitError, parse_quantity, parse_unit
from reports.along import Cycles, Ends, Thinned, read_along
from reports.axis import TIME, Axis, axis_over, engine_of
from reports.declared import degrees, si
from reports.definitions import definitions
from reports.faultwindows import Window, fault_windows
from reports.folder import Case, Run, RunFolderError
from reports.signals import Column, Vector, same_dimension
from reports.standing import observers

# Okabe and Ito's colours (the blue lighter), readable on light and dark and by the colour-blind; the truth is grey.
COLOURS = (
    "#1A7FC1",
    "#D55E00",
    "#009E73",
    "#CC79A7",
    "#E69F00",
    "#56B4E9",
    "#8C6BB1",
    "#A6761D",
)
# Points a trace may have.
POINTS = 6000
# Cycles of a stretch that are laid over each other, the last ones: more would hide each other.
MOST_CYCLES = 100
TRUTH_COLOUR, FAULT_COLOUR = "#808080", "#E69F00"
DASHES = ("solid", "dash", "dot", "dashdot")


@dataclass(frozen=True)
class Trace:
    """One line of a panel: values of shape (n,) in the panel's unit along its axis, thinned where they were many.

    Of cycles laid over each other each has a line; the `strength` of the last is 1, and it stands in the legend.
    """

    name: str
    along: Vector
    values: Vector
    unit: str
    discrete: bool
    colour: str
    dash: str
    is_truth: bool
    strength: float = 1.0


@dataclass(frozen=True)
class Panel:
    """Traces that share a vertical axis, and horizontal reference lines as (value, label)."""

    label: str
    traces: tuple[Trace, ...]
    lines: tuple[tuple[float, str], ...]


@dataclass(frozen=True)
class Figure:
    """A declared figure with its data; where it cannot be drawn, `problem` says why and there are no panels.

    `rows` is how many rows of the record its traces stand for, `cycles` how many are laid over each other, the last of
    `whole`.
    """

    title: str
    case: Case | None
    panels: tuple[Panel, ...] = ()
    windows: tuple[Window, ...] = ()
    problem: str = ""
    rows: int = 0
    axis: Axis = TIME
    cycles: int = 0
    whole: int = 0


def declared_figures(run: Run) -> list[Figure]:
    """Every figure of the campaign's report section, drawn from the first case of its experiment that left a record."""
    return [_figure(run, entry) for entry in (run.campaign.get("report") or {}).get("figures") or ()]


def part_colours(run: Run) -> dict[str, str]:
    """One colour an observer, the same in every figure."""
    return {part: COLOURS[index % len(COLOURS)] for index, part in enumerate(observers(run))}


def colours_of(run: Run, parts: Sequence[str]) -> dict[str, str]:
    """A colour for each of the parts: that of an observer in all figures, for others those that are left, in turn."""
    known = part_colours(run)
    spare = [colour for colour in COLOURS if colour not in known.values()] or list(COLOURS)
    others = [part for part in parts if part not in known]
    return {**known, **{part: spare[index % len(spare)] for index, part in enumerate(others)}}


def _figure(run: Run, entry: Mapping[str, Any]) -> Figure:
    title, experiment = str(entry.get("title") or "Signals"), entry.get("experiment")
    cases = [case for case in run.cases if experiment in (None, case.experiment)]
    case = next(
        (case for case in cases if (run.path / "cases" / case.key / "signals.parquet").is_file()),
        None,
    )
    if case is None:
        return Figure(
            title,
            None,
            problem=f"no case of {experiment or 'the campaign'} left a record ({len(cases)} declared)",
        )
    groups = [[group] if isinstance(group, str) else list(group) for group in entry.get("traces") or ()]
    over, angle = str(entry.get("over") or "time"), str(entry.get("angle") or "")
    engine = engine_of(run, case, angle, entry.get("cycle"))
    overlaid = Cycles(engine.cycle, _last(entry)) if over == "cycle" else None
    names = [name for group in groups for name in group]
    along: Literal["time", "crank"] = "time" if over == "time" else "crank"
    try:
        thinned = read_along(run, case, names, along, ends_of(entry), POINTS, angle, overlaid)
    except (KeyError, RunFolderError) as error:
        return Figure(title, case, problem=str(error.args[0]))
    if not thinned.rows:
        what = f"no whole cycle of {engine.cycle:g} deg" if overlaid else "no rows to draw"
        return Figure(title, case, problem=f"the record of {case.label} ({case.outcome}) has {what}")
    thinned = _in_cycles(thinned, engine.cycle) if over == "cycles" else thinned
    unit = str(entry.get("unit") or "")
    panels = [_panel(run, group, thinned.pieces, entry.get("lines") or {}, unit) for group in groups]
    windows = () if overlaid else fault_windows(run, case, *thinned.time)
    return Figure(
        title,
        case,
        tuple(panels),
        windows if along == "time" else _along(windows, thinned.passed),
        rows=thinned.rows,
        axis=axis_over(over, engine, *thinned.crank),
        cycles=len(thinned.pieces) if overlaid else 0,
        whole=thinned.whole,
    )


def ends_of(entry: Mapping[str, Any]) -> Ends:
    """The `from` and `to` of something declared, each a time or a crank angle."""
    ends = Ends()
    for index, raw in enumerate((entry.get("from"), entry.get("to"))):
        for along, at in {"time": si(raw, "s"), "crank": degrees(raw)}.items():
            if at is not None:
                known = list(getattr(ends, along))
                known[index] = at
                ends = ends._replace(**{along: tuple(known)})
    return ends


def _last(entry: Mapping[str, Any]) -> int:
    """How many whole cycles are laid over each other: as many as are asked for, else those of a stretch, else one."""
    named = entry.get("from") is not None or entry.get("to") is not None
    return int(entry["last"]) if entry.get("last") else MOST_CYCLES if named else 1


def _in_cycles(thinned: Thinned, cycle: float) -> Thinned:
    """The same with places counted in cycles."""
    pieces = tuple({name: (at / cycle, column) for name, (at, column) in one.items()} for one in thinned.pieces)
    return replace(thinned, pieces=pieces, passed=(thinned.passed[0], thinned.passed[1] / cycle))


def _along(windows: Sequence[Window], passed: tuple[Vector, Vector]) -> tuple[Window, ...]:
    """Windows of time [s] where they are along the axis."""
    edges = [np.interp((window.since, window.until), *passed) for window in windows]
    return tuple(Window(window.label, *map(float, at)) for window, at in zip(windows, edges, strict=True))


def _panel(
    run: Run,
    names: Sequence[str],
    pieces: Sequence[Mapping[str, tuple[Vector, Column]]],
    lines: Mapping[str, str],
    unit: str,
) -> Panel:
    truths = {truth for definition in definitions(run).values() for truth, _ in definition.pairs}
    colours = part_colours(run)
    # Signals of one observer among themselves, such as those of its cylinders, are told apart by colour.
    if len({name.partition(".")[0] for name in names}) == 1 and len(names) > 1:
        colours = {}
    spare = [colour for colour in COLOURS if colour not in colours.values()] or list(COLOURS)
    traces: list[Trace] = []
    drawn: dict[str, int] = {}
    for index, name in enumerate(names):
        part = name.split(".")[0]
        is_truth = name in truths and part not in colours
        colour = TRUTH_COLOUR if is_truth else colours.get(part) or spare[index % len(spare)]
        dash = DASHES[drawn.get(colour, 0) % len(DASHES)]
        drawn[colour] = drawn.get(colour, 0) + 1
        for number, piece in enumerate(pieces, start=1):
            along, column = piece[name]
            values, shown = column.shown(unit), column.shown_in(unit)
            strength = 0.2 + 0.6 * number / len(pieces) if number < len(pieces) else 1.0
            traces.append(Trace(name, along, values, shown, column.discrete, colour, dash, is_truth, strength))
    units = list(dict.fromkeys(trace.unit for trace in traces))
    common = _common(names)
    label = f"{common} [{', '.join(units)}]" if units != ["1"] else common
    at = [(si(text, units[0]), str(meaning)) for text, meaning in lines.items() if _fits(text, units[0])]
    scale = parse_unit(units[0]) if at else None
    return Panel(
        label,
        tuple(traces),
        tuple((scale.from_si(value), meaning) for value, meaning in at if scale and value is not None),
    )


def _common(names: Sequence[str]) -> str:
    short = list(dict.fromkeys(name.split(".", 1)[-1] for name in names))
    return short[0] if len(short) == 1 else ", ".join(short) if len(", ".join(short)) <= 28 else ""


def _fits(text: str, unit: str) -> bool:
    try:
        return same_dimension(parse_quantity(str(text))[1] or "1", unit)
    except UnitError:
        return False
