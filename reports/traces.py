"""The figures a campaign declares: which signals of which case, in what unit, colour and panel."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

from fmus.units import UnitError, parse_quantity, parse_unit
from reports.definitions import definitions
from reports.folder import Case, Run, RunFolderError
from reports.signals import Column, Steps, Vector, read_fault_signals, read_thinned, same_dimension
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
TRUTH_COLOUR, FAULT_COLOUR = "#808080", "#E69F00"
DASHES = ("solid", "dash", "dot", "dashdot")


@dataclass(frozen=True)
class Trace:
    """One line of a panel: values of shape (n,) in the panel's unit over time [s], thinned where they were many."""

    name: str
    time: Vector
    values: Vector
    unit: str
    discrete: bool
    colour: str
    dash: str
    is_truth: bool


@dataclass(frozen=True)
class Panel:
    """Traces that share a vertical axis, and horizontal reference lines as (value, label)."""

    label: str
    traces: tuple[Trace, ...]
    lines: tuple[tuple[float, str], ...]


@dataclass(frozen=True)
class Window:
    """A stretch of time in which a fault is active [s]."""

    label: str
    since: float
    until: float


@dataclass(frozen=True)
class Figure:
    """A declared figure with its data; where it cannot be drawn, `problem` says why and there are no panels.

    `rows` is how many rows of the record its traces stand for.
    """

    title: str
    case: Case | None
    panels: tuple[Panel, ...] = ()
    windows: tuple[Window, ...] = ()
    problem: str = ""
    rows: int = 0


def declared_figures(run: Run) -> list[Figure]:
    """Every figure of the campaign's report section, drawn from the first case of its experiment that left a record."""
    return [_figure(run, entry) for entry in (run.campaign.get("report") or {}).get("figures") or ()]


def part_colours(run: Run) -> dict[str, str]:
    """One colour an observer, the same in every figure."""
    return {part: COLOURS[index % len(COLOURS)] for index, part in enumerate(observers(run))}


def labelled(windows: Sequence[Window]) -> list[tuple[int, Window]]:
    """The first window of each label, numbered from 0: labels stand one below the other, so that none hides another."""
    first: dict[str, Window] = {}
    for window in windows:
        first.setdefault(window.label, window)
    return list(enumerate(first.values()))


def fault_windows(run: Run, case: Case, begin: float, stop: float) -> tuple[Window, ...]:
    """When faults act between two times [s]: as recorded, else as the campaign declares and the case overrides them."""
    signals = read_fault_signals(run, case)
    windows = list(_recorded_windows(signals, begin, stop))
    told = {name.partition(".")[0] for name in signals}
    for part, spec in (run.campaign.get("parts") or {}).items():
        if part in told:
            continue
        declared = spec.get("faults") if isinstance(spec, Mapping) else None
        for index, fault in enumerate(_overridden(run, case, f"{part}.faults", declared or [])):
            settings = {key: value for key, value in fault.items() if value is not None}
            settings |= _changed(run, case, f"{part}.faults.{index}.")
            since, until = (_si(settings.pop(key, None), "s") for key in ("from", "to"))
            settings.pop("code", None)
            kind = ", ".join(key if value is True else f"{key} {value}" for key, value in settings.items())
            if since is not None and since < stop:
                windows.append(Window(f"{part}: {kind}", since, stop if until is None else min(until, stop)))
    return tuple(sorted(windows, key=lambda window: window.since))


def _recorded_windows(signals: Mapping[str, Steps], begin: float, stop: float) -> Iterator[Window]:
    """The stretches in which a fault signal stays at one code, each from its first row to the first row after it."""
    for name, steps in signals.items():
        meanings = dict(item.split(": ", 1) for item in steps.column.description.split("; ")[1:])
        stretches = zip(pairwise(steps.edges.tolist()), steps.column.values, strict=True)
        for (since, until), code in stretches:
            if code and since < stop and until > begin:
                meaning = meanings.get(f"{code:g}", f"fault {code:g}")
                yield Window(f"{name.partition('.')[0]}: {meaning}", max(since, begin), min(until, stop))


def _overridden(run: Run, case: Case, path: str, declared: Any) -> list[Mapping[str, Any]]:
    value = _settings(run, case).get(path, declared)
    return [fault for fault in value if isinstance(fault, Mapping)] if isinstance(value, list) else []


def _changed(run: Run, case: Case, prefix: str) -> dict[str, Any]:
    settings = {**_settings(run, case), **case.values}
    return {path.removeprefix(prefix): value for path, value in settings.items() if path.startswith(prefix)}


def _settings(run: Run, case: Case) -> Mapping[str, Any]:
    experiments = run.campaign.get("experiments") or {}
    return (experiments.get(case.experiment) or {}).get("set") or {}


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
    begin, end = _si(entry.get("from"), "s"), _si(entry.get("to"), "s")
    span = (-math.inf if begin is None else begin, math.inf if end is None else end)
    try:
        thinned = read_thinned(run, case, [name for group in groups for name in group], span, POINTS)
    except (KeyError, RunFolderError) as error:
        return Figure(title, case, problem=str(error.args[0]))
    if not thinned.rows:
        return Figure(title, case, problem=f"the record of {case.label} ({case.outcome}) has no rows to draw")
    unit = str(entry.get("unit") or "")
    panels = [_panel(run, group, thinned.signals, entry.get("lines") or {}, unit) for group in groups]
    windows = fault_windows(run, case, thinned.first, thinned.last)
    return Figure(title, case, tuple(panels), windows, rows=thinned.rows)


def _panel(
    run: Run,
    names: Sequence[str],
    signals: Mapping[str, tuple[Vector, Column]],
    lines: Mapping[str, str],
    unit: str,
) -> Panel:
    truths = {truth for definition in definitions(run).values() for truth, _ in definition.pairs}
    colours = part_colours(run)
    spare = [colour for colour in COLOURS if colour not in colours.values()] or list(COLOURS)
    traces: list[Trace] = []
    drawn: dict[str, int] = {}
    for name in names:
        part, (time, column) = name.split(".")[0], signals[name]
        is_truth = name in truths and part not in colours
        colour = TRUTH_COLOUR if is_truth else colours.get(part) or spare[len(traces) % len(spare)]
        dash = DASHES[drawn.get(colour, 0) % len(DASHES)]
        drawn[colour] = drawn.get(colour, 0) + 1
        shown = column.shown_in(unit)
        traces.append(
            Trace(
                name,
                time,
                column.shown(unit),
                shown,
                column.discrete,
                colour,
                dash,
                is_truth,
            )
        )
    units = list(dict.fromkeys(trace.unit for trace in traces))
    common = _common([trace.name for trace in traces])
    label = f"{common} [{', '.join(units)}]" if units != ["1"] else common
    at = [(_si(text, units[0]), str(meaning)) for text, meaning in lines.items() if _fits(text, units[0])]
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


def _si(raw: Any, unit: str) -> float | None:
    if raw is None:
        return None
    try:
        number, written = parse_quantity(str(raw))
        return parse_unit(written or unit).to_si(number) if same_dimension(written or unit, unit) else None
    except UnitError:
        return None
