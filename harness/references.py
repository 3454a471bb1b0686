"""Checks what the sections of a campaign say of each other: criteria of metrics, metrics and figures of experiments."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

from fmus.component import Problem
from fmus.model import unknown
from fmus.units import UnitError
from harness.campaignfile import Limits
from harness.criteria import Criterion, CriterionError, parse_criterion
from harness.definitions import Definition, results
from harness.expansion import ROOTS
from harness.places import KeyPath, Place, Places
from harness.reportsection import ReportSection
from harness.validation import validate


def name_problems(document: Mapping[str, Any], places: Places) -> Iterator[Problem]:
    """Names that could not be told apart from others in a path."""
    sections: list[KeyPath] = [("parts",), ("metrics",), ("experiments",)]
    sections += [("experiments", name, "parts") for name in _mapping(document, "experiments")]
    for section in sections:
        for name in _mapping(document, *section):
            if not name.isidentifier():
                message = f"{section[-1]}: a name wants letters, digits and _, got '{name}'"
                yield places.key_problem(message, *section, name)
            elif section[-1] == "parts" and name in ROOTS:
                message = f"parts: '{name}' is a key of the campaign; name the part otherwise"
                yield places.key_problem(message, *section, name)


def read_criteria(document: Mapping[str, Any], places: Places, problems: list[Problem]) -> Iterator[Criterion]:
    """The criteria, read as far as the metrics they speak of are in order."""
    metrics, broken = _metrics(document)
    known = results(metrics)
    named = list(_mapping(document, "experiments"))
    experiments = named or [""]
    written = document.get("accept")
    for index, entry in enumerate(written if isinstance(written, list) else ()):
        for experiment, text in entry.items() if isinstance(entry, dict) else [("", entry)]:
            where: KeyPath = ("accept", index, experiment) if isinstance(entry, dict) else ("accept", index)
            if not isinstance(text, str):
                continue
            if experiment and experiment not in experiments:
                problems.append(places.key_problem(unknown(experiment, named, "experiment"), *where))
            try:
                criterion = parse_criterion(text, known)
            except CriterionError as error:
                if not any(name in text for name in broken):
                    place = places.of(where)
                    problems.append(place_at(f"accept: {error}", place, error.offset))
                continue
            speaks_of = {known[side.metric][0] for side in (criterion.left, criterion.right) if side.metric}
            asked = [experiment] if experiment else experiments
            covered = [name for name in asked if all(metrics[metric].covers(name) for metric in speaks_of)]
            if not covered:
                message = f"accept: '{text}' covers no experiment: its metrics are measured elsewhere"
                problems.append(places.problem(message, *where))
            yield replace(criterion, experiment=experiment, covered=tuple(covered))


def place_at(message: str, place: Place, offset: int) -> Problem:
    """A Problem `offset` characters into the value at `place`."""
    return Problem(message, place.file, place.line, place.column and place.column + offset)


def _metrics(document: Mapping[str, Any]) -> tuple[dict[str, Definition], list[str]]:
    """The metrics that are in order, and the names of the others."""
    checked = {name: validate(Definition, raw, Places())[0] for name, raw in _mapping(document, "metrics").items()}
    sound = {name: definition for name, definition in checked.items() if definition is not None}
    return sound, [name for name in checked if name not in sound]


def _mapping(document: Mapping[str, Any], *path: str | int) -> Mapping[str, Any]:
    found: Any = document
    for key in path:
        found = found.get(key) if isinstance(found, dict) else None
    return found if isinstance(found, dict) else {}


def reference_problems(document: Mapping[str, Any], places: Places) -> Iterator[Problem]:
    """Names in metrics and the report that name nothing, and a limit that is no time."""
    metrics, broken = _metrics(document)
    experiments = list(_mapping(document, "experiments"))
    for name, definition in metrics.items():
        for index, only in enumerate(definition.only or []):
            if only not in experiments:
                message = f"metrics.{name}: {unknown(only, experiments, 'experiment')}"
                yield places.problem(message, "metrics", name, "only", index)
    names = {
        "metric": [*metrics, *broken, *results(metrics)],
        "value": [*broken, *(name for name, (_, result) in results(metrics).items() if not result.sampled)],
        "experiment": experiments,
        "part": [
            *_mapping(document, "parts"),
            *(part for experiment in experiments for part in _mapping(document, "experiments", experiment, "parts")),
        ],
    }
    report, _ = validate(ReportSection, _mapping(document, "report"), places)
    for path, kind, name in report.references() if report is not None else ():
        if name not in names[kind]:
            called = "metric with one value a case" if kind == "value" else kind
            yield places.problem(f"report: {unknown(name, names[kind], called)}", "report", *path)
    limits, _ = validate(Limits, _mapping(document, "limits"), places)
    if limits is None:
        return
    for name, limit in {"case": limits.case, "step": limits.step}.items():
        try:
            if limit.si("s") <= 0:
                yield places.problem(f"limits.{name} wants a time above 0 s, got {limit}", "limits", name)
        except UnitError as error:
            yield places.problem(f"limits.{name} {error}", "limits", name)
