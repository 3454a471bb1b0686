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
from harness.ofobservers import of_observer
from harness.places import KeyPath, Place, Places
from harness.reportsection import ReportSection
from harness.validation import nearest_hint, validate


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
    reader = _Reader(document, places, problems)
    written = document.get("accept")
    for index, entry in enumerate(written if isinstance(written, list) else ()):
        for experiment, text in entry.items() if isinstance(entry, dict) else [("", entry)]:
            where: KeyPath = ("accept", index, experiment) if isinstance(entry, dict) else ("accept", index)
            if experiment and experiment not in reader.experiments:
                problems.append(places.key_problem(unknown(experiment, reader.named, "experiment"), *where))
            criterion = reader.read("accept", text, experiment, where)
            if criterion is not None:
                yield criterion


def read_statements(document: Mapping[str, Any], places: Places, problems: list[Problem]) -> dict[int, Criterion]:
    """What the published entries that have a `holds` state, by the number of the entry, read as criteria are."""
    reader = _Reader(document, places, problems)
    written = _mapping(document, "report").get("published")
    found = {}
    for index, entry in enumerate(written if isinstance(written, list) else ()):
        if isinstance(entry, dict) and "holds" in entry:
            where: KeyPath = ("report", "published", index, "holds")
            criterion = reader.read("holds", entry["holds"], str(entry.get("experiment") or ""), where)
            if criterion is not None:
                found[index] = criterion
    return found


class _Reader:
    """Reads criteria of the metrics of a campaign; what is wrong with them goes to `problems`."""

    def __init__(self, document: Mapping[str, Any], places: Places, problems: list[Problem]) -> None:
        self.metrics, self._broken = _metrics(document)
        self._known = results(self.metrics)
        self.named = list(_mapping(document, "experiments"))
        self.experiments = self.named or [""]
        self._places, self._problems = places, problems

    def read(self, section: str, text: Any, experiment: str, where: KeyPath) -> Criterion | None:
        """The criterion that stands at `where`, of one experiment or, where it is empty, of all."""
        if not isinstance(text, str):
            return None
        try:
            criterion = parse_criterion(text, self._known)
        except CriterionError as error:
            if not any(name in text for name in self._broken):
                self._problems.append(place_at(f"{section}: {error}", self._places.of(where), error.offset))
            return None
        speaks_of = {self._known[side.metric][0] for side in (criterion.left, criterion.right) if side.metric}
        asked = [experiment] if experiment else self.experiments
        covered = [name for name in asked if all(self.metrics[metric].covers(name) for metric in speaks_of)]
        if not covered:
            message = f"{section}: '{text}' covers no experiment: its metrics are measured elsewhere"
            self._problems.append(self._places.problem(message, *where))
        return replace(criterion, experiment=experiment, covered=tuple(covered))


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
        if kind == "pattern":
            if not any(of_observer(name, part) in names["value"] for part in names["part"]):
                message = f"report: no part has a metric named like '{name}'{nearest_hint(name, names['value'])}"
                yield places.problem(message, "report", *path)
        elif name not in names[kind]:
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
