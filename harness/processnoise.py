"""Estimates a model's noise from recorded runs of what it stands for, as `crankbench noise` is asked to."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from fmus.component import ConfigurationError, Problem, Vector
from fmus.model import unknown
from fmus.statespace import StateSpace, imbalance, scales, si_unit
from fmus.units import UnitError, parse_unit
from harness.likelynoise import LikelyNoise, likely_noise
from harness.operating import Operating, Operation, operate
from harness.quantity import read_measure
from harness.recordedstates import Course, Rows, columns, read_course
from harness.recordexport import find_records
from selection.noise import PAPERS, Linear, Rule, corrected, density, measurement, moments, residuals

By = Literal["published", "density", "likelihood"]
# A sensor of which nothing is said is exact to a hundredth.
ACCURACY = 0.01
# What the likelihood tells of a state's noise counts where it knows it to a factor of e.
TELLING = 1.0
# What quadrature may leave of a residual, of its deviation, without a word.
QUADRATURE = 0.1


@dataclass(frozen=True)
class NoiseWishes:
    """What a user asks, as it is written on the command line.

    `mapping` are `signal=recorded`, or the JSON file of `crankbench inspect --like`; `lags` states without process
    noise, and `sensors` what is measured: those that the model's module declares where none is named.
    """

    record: Path
    operation: Operation
    mapping: Sequence[str] = ()
    part: str = ""
    after: str = "0 s"
    until: str = ""
    average: str = ""
    accuracy: Sequence[str] = ()
    lags: Sequence[str] = ()
    sensors: Sequence[str] = ()
    by: By = "published"
    rule: Rule = PAPERS


class _Read(NamedTuple):
    """The wishes as they were understood."""

    lags: tuple[str, ...]
    sensors: tuple[str, ...]
    accuracies: Vector
    window: tuple[float, float]
    average: tuple[float, str]


def estimate_noise(wishes: NoiseWishes) -> dict[str, Any]:
    """The noise as `crankbench noise --json` prints it; docs/noise.md has what each entry means.

    Raises ConfigurationError: no record, names and units that do not fit, a linear model that nothing can be said of.
    """
    operating = operate(wishes.operation)
    space = operating.space
    read = _understand(wishes, operating)
    if not wishes.record.exists():
        raise ConfigurationError(f"no record at {wishes.record}")
    paths = find_records(wishes.record)
    found = columns(space, paths[0], _mapping(wishes.mapping, wishes.part), wishes.part, read.sensors)
    courses = [read_course(path, space, found, read.lags, read.sensors, read.window) for path in paths]
    known = ~np.any([np.isnan(course.x).any(axis=0) for course in courses], axis=0)
    whys = _whys(space, known, read.lags)
    sought = [i for i, why in enumerate(whys) if not why]
    if not sought:
        raise ConfigurationError(f"{wishes.record}: no state of {wishes.operation.target} can be told of: {whys[0]}")
    edges = [_edges(course, read.average) for course in courses]
    states = _states(space, courses, edges, sought, wishes.rule)
    told = {space.states[i].name: row for i, row in zip(sought, states, strict=True)}
    noise = [_sensor(space, courses, j, read) for j in range(len(read.sensors))]
    likely = _likely(space, courses, edges, noise, read, told) if wishes.by == "likelihood" else None
    rows, notes = _states_by_name(space, told, whys, likely, wishes, read.lags)
    held = [s.name for s in space.inputs if s.name not in found.names]
    intervals = np.concatenate([np.diff(c.time[e]) for c, e in zip(courses, edges, strict=True)])
    return {
        "model": wishes.operation.target,
        "records": [str(path) for path in paths],
        "by": wishes.by,
        "rows": int(sum(len(course.time) for course in courses)),
        "intervals": len(intervals),
        "interval": float(intervals.mean()),
        "states": rows,
        "sensors": noise,
        "process": {row["name"]: _written(row["process"], row["unit"]) for row in rows if row["process"] is not None},
        "noise": {row["name"]: _written(row["noise"], row["unit"]) for row in noise if row["noise"] is not None},
        "map": dict(found.names),
        "held": held,
        "followed": sorted({name for course in courses for name in course.followed}),
        "rule": {"skewness": wishes.rule.skewness, "kurtosis": wishes.rule.kurtosis},
        "log_likelihood": None if likely is None else likely.log_likelihood,
        "point": space.point(),
        "imbalance": float(imbalance(space.A, space.rates, scales(space.states)).max(initial=0.0)),
        "rung": space.rung,
        "notes": notes,
    }


def _written(value: float, unit: str) -> str:
    """A value as campaign files have it."""
    return f"{value:.6g}" if unit == "1" else f"{value:.6g} {unit}"


def _understand(wishes: NoiseWishes, operating: Operating) -> _Read:
    problems: list[Problem] = []
    states = [s.name for s in operating.space.states]
    measurable = list(dict.fromkeys([*states, *(s.name for s in operating.space.outputs)]))
    sensors = tuple(wishes.sensors or operating.sensors)
    lags = tuple(wishes.lags or operating.lags)
    problems += [
        Problem(f"--sensors {n}: {unknown(n, measurable, 'state or output')}") for n in sensors if n not in measurable
    ]
    problems += [Problem(f"--lags {n}: {unknown(n, states, 'state')}") for n in lags if n not in states]
    accuracies = {name: operating.accuracies.get(name, ACCURACY) for name in sensors}
    for text in wishes.accuracy:
        name, equals, value = (part.strip() for part in text.partition("="))
        if not equals or name not in accuracies:
            problems.append(Problem(f"--accuracy {text}: {unknown(name, sensors, 'sensor')}"))
            continue
        accuracies[name] = _quantity(value, "1", f"--accuracy {name}", problems)
        if accuracies[name] <= 0.0:
            problems.append(Problem(f"--accuracy {name}: wants more than 0, got {value}"))
    after = _quantity(wishes.after, "s", "--after", problems)
    until = _quantity(wishes.until, "s", "--until", problems) if wishes.until else np.inf
    average = (0.0, "")
    if wishes.average:
        unit = "deg" if _is_angle(wishes.average) else "s"
        average = _quantity(wishes.average, unit, "--average", problems), unit
        if average[0] <= 0.0:
            problems.append(Problem(f"--average wants more than 0, got {wishes.average}"))
    if problems:
        raise ConfigurationError(problems)
    return _Read(lags, sensors, np.array(list(accuracies.values())), (after, until), average)


def _is_angle(text: str) -> bool:
    try:
        return parse_unit(read_measure(text).unit).same_dimension(parse_unit("deg"))
    except (ValueError, UnitError):
        return False


def _quantity(text: str, unit: str, option: str, problems: list[Problem]) -> float:
    try:
        return read_measure(text).si(unit)
    except (ValueError, UnitError) as error:
        problems.append(Problem(f"{option}: {error}"))
        return 1.0


def _mapping(given: Sequence[str], part: str) -> dict[str, str]:
    found: dict[str, str] = {}
    problems = []
    for text in given:
        name, equals, recorded = (piece.strip() for piece in text.partition("="))
        if equals and name and recorded:
            found[name] = recorded
        elif text.endswith(".json") and Path(text).is_file():
            content = json.loads(Path(text).read_text(encoding="utf-8"))
            matched = content.get("like", {}).get("matched", ())
            found |= {one["signal"]: f"{part}.{one['variable']}" if part else one["variable"] for one in matched}
        else:
            problems.append(Problem(f"--map {text}: wants signal=recorded, or a file of crankbench inspect --like"))
    if problems:
        raise ConfigurationError(problems)
    return found


def _whys(space: StateSpace, known: Vector, lags: Sequence[str]) -> list[str]:
    """By state, why nothing is estimated of it; empty where something is."""
    names = [s.name for s in space.states]
    found = []
    for i, name in enumerate(names):
        missing = [names[j] for j in np.flatnonzero(space.A[i]) if not known[j]]
        if name in lags:
            found.append("a lag: no noise by definition")
        elif not known[i]:
            found.append(f"{name} is not recorded")
        else:
            found.append(f"it depends on {', '.join(missing)}, not recorded" if missing else "")
    return found


def _edges(course: Course, average: tuple[float, str]) -> Rows:
    """The rows between which residuals are averaged: all, or one at each multiple of a time [s] or a crank angle."""
    size, unit = average
    if not unit:
        return np.arange(len(course.time))
    if unit == "deg":
        if course.crank is None:
            raise ConfigurationError("--average of a crank angle wants a record on a crank clock; give a time")
        axis, size = course.crank - course.crank[0], float(np.rad2deg(size))
    else:
        axis = course.time - course.time[0]
    # The first row at or after each multiple, by a millionth of the step before it to allow for rounding.
    step = float(np.median(np.diff(axis)))
    marks = np.arange(int(axis[-1] / size + 1e-6) + 1) * size
    edges: Rows = np.unique(np.searchsorted(axis, marks - 1e-6 * step))
    edges = edges[edges < len(axis)]
    if len(edges) < 3:
        raise ConfigurationError(f"--average leaves {len(edges) - 1} intervals of the record, wants two or more")
    return edges


def _states(
    space: StateSpace, courses: Sequence[Course], edges: Sequence[Rows], sought: Sequence[int], rule: Rule
) -> list[dict[str, Any]]:
    linear = Linear(space.A, space.B, space.x0, space.u0, space.rates)
    # What is not known is not in the rows sought; it stays out of the sums.
    found = [
        residuals(c.time, np.where(np.isnan(c.x), space.x0, c.x), c.u, linear, e)
        for c, e in zip(courses, edges, strict=True)
    ]
    values = np.concatenate([one.values for one in found])[:, sought]
    interval = float(np.concatenate([one.intervals for one in found]).mean())
    told, error = moments(values), np.max([one.error for one in found], axis=0)[sought]
    by_rule = corrected(told, rule)
    # Records are put end to end: of some thousand intervals the seams are few.
    dense = density(values, interval)
    return [
        {
            "mean": float(told.mean[k]),
            "deviation": float(told.deviation[k]),
            "skewness": float(told.skewness[k]),
            "kurtosis": float(told.kurtosis[k]),
            "by_skewness": float(by_rule.by_skewness[k]),
            "published": float(by_rule.process[k]),
            "rule": by_rule.rules[k],
            "density": float(dense[k]),
            "quadrature": float(error[k]),
        }
        for k in range(len(sought))
    ]


def _likely(
    space: StateSpace,
    courses: Sequence[Course],
    edges: Sequence[Rows],
    noise: Sequence[Mapping[str, Any]],
    read: _Read,
    told: Mapping[str, Mapping[str, Any]],
) -> LikelyNoise:
    missing = [row["name"] for row in noise if row["noise"] is None]
    if not noise:
        raise ConfigurationError("--by likelihood wants --sensors: what is measured")
    if missing:
        none = f"--by likelihood wants readings of its sensors that vary, not of {', '.join(missing)}"
        raise ConfigurationError(f"{none}: say what they are by --map, or name others by --sensors")
    sensors = {row["name"]: row["noise"] for row in noise}
    first = {name: row["density"] for name, row in told.items()}
    return likely_noise(space, courses, edges, sensors, read.lags, first)


def _sensor(space: StateSpace, courses: Sequence[Course], j: int, read: _Read) -> dict[str, Any]:
    name = read.sensors[j]
    signal, rest = _signal(space, name)
    y = np.concatenate([course.y[:, [j]] for course in courses])
    recorded = bool(np.isfinite(y).all())
    largest = float(np.abs(y - rest).max()) if recorded else None
    noise = float(measurement(y, np.array([rest]), read.accuracies[[j]])[0]) if recorded else None
    return {
        "name": name, "unit": si_unit(signal), "accuracy": float(read.accuracies[j]), "at_point": rest,
        "largest": largest, "noise": noise or None,
    }  # fmt: skip


def _signal(space: StateSpace, name: str) -> tuple[Any, float]:
    """The state or output of a name, and its value at the point."""
    for signals, values in ((space.states, space.x0), (space.outputs, space.y0)):
        for signal, value in zip(signals, values, strict=True):
            if signal.name == name:
                return signal, float(value)
    raise KeyError(name)


def _states_by_name(
    space: StateSpace,
    told: Mapping[str, Mapping[str, Any]],
    whys: Sequence[str],
    likely: LikelyNoise | None,
    wishes: NoiseWishes,
    lags: Sequence[str],
) -> tuple[list[dict[str, Any]], list[str]]:
    """A row for each state, with what is taken as its noise, and notes."""
    rows, notes = [], []
    blank = dict.fromkeys(
        ("mean", "deviation", "skewness", "kurtosis", "by_skewness", "published", "rule", "density", "quadrature")
    )
    for signal, why in zip(space.states, whys, strict=True):
        name = signal.name
        row = {"name": name, "unit": si_unit(signal), **blank, **told.get(name, {}), "why": why}
        row["likelihood"] = None if likely is None else likely.process.get(name)
        error = None if likely is None else likely.errors.get(name)
        row["likelihood_error"] = error if error is not None and np.isfinite(error) else None
        row["process"] = 0.0 if name in lags else row[wishes.by]
        if wishes.by == "likelihood" and name not in lags and not (error is not None and error < TELLING):
            row["process"] = row["density"]
            notes.append(f"the sensors do not tell of the noise of {name}: its density is taken")
        if row["process"] is None:
            notes.append(f"no process noise of {name}: {why or 'nothing is estimated'}")
        elif row["quadrature"] is not None and row["quadrature"] > QUADRATURE * max(row["deviation"], 1e-300):
            notes.append(
                f"{name}: quadrature leaves {row['quadrature']:.3g} of a deviation of {row['deviation']:.3g}; "
                "record in shorter steps"
            )
        rows.append(row)
    return rows, notes
