"""Reads a campaign file: its schema, every problem at its place, and the cases it asks for."""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import resources
from pathlib import Path
from typing import Any

from fmus.component import ConfigurationError, Problem
from fmus.model import unknown
from fmus.units import UnitError
from harness.campaignfile import CampaignFile, Limits
from harness.criteria import Criterion, CriterionError, parse_criterion
from harness.definitions import Definition, results
from harness.expansion import PathError, Setting, apply, combine, locate, put, read_axes, shown
from harness.fingerprint import case_key
from harness.places import KeyPath, Place, Places, read_yaml, read_yaml_file
from harness.reportsection import ReportSection
from harness.scenario import Scenario
from harness.validation import validate

SCENARIO_KEYS = ("clock", "parts", "seed", "record")


@dataclass(frozen=True)
class Case:
    """One run of a campaign: an experiment, the values varied, and the scenario they give."""

    key: str
    label: str
    experiment: str
    values: Mapping[str, str]
    scenario: Scenario
    places: Places


@dataclass(frozen=True)
class Campaign:
    """A campaign as read: `written` is the file as plain data, overrides of the command line included."""

    name: str
    file: Path
    file_sha256: str
    written: Mapping[str, Any]
    places: Places
    cases: tuple[Case, ...]
    metrics: Mapping[str, Definition]
    criteria: tuple[Criterion, ...]
    report: ReportSection
    case_limit: float


def read_campaign(file: Path, overrides: Sequence[str] = ()) -> Campaign:
    """The campaign of a YAML file, with `path=value` overrides on top of everything in it.

    Modules beside the file can be imported from then on.

    Raises ConfigurationError: every problem of the file and the overrides, each with line and column.
    """
    document, places = read_yaml_file(file)
    if str(file.parent.absolute()) not in sys.path:
        sys.path.append(str(file.parent.absolute()))
    if not isinstance(document, dict):
        raise ConfigurationError(places.problem("a campaign wants a mapping of keys to values, got none"))
    problems: list[Problem] = []
    document, places, on_top = _override(document, places, overrides, problems)
    checked, found = validate(CampaignFile, document, places)
    problems += [*found, *_name_problems(document, places)]
    cases = list(_cases(document, places, on_top, file.parent, problems))
    criteria = list(_criteria(document, places, problems))
    problems += _reference_problems(document, places)
    if problems or checked is None:
        raise ConfigurationError(sorted(dict.fromkeys(problems), key=lambda one: (one.file, one.line, one.column)))
    return Campaign(
        name=checked.campaign,
        file=file,
        file_sha256=hashlib.sha256(file.read_bytes()).hexdigest(),
        written=document,
        places=places,
        cases=tuple(cases),
        metrics=checked.metrics,
        criteria=tuple(criteria),
        report=checked.report,
        case_limit=checked.limits.case.si("s"),
    )


def find_campaign(name: str) -> Path:
    """The file of a campaign given by path or by built-in name.

    Raises ConfigurationError: neither is there; with the nearest built-in name.
    """
    path = Path(name)
    if path.suffix in (".yaml", ".yml") or path.is_file():
        if path.is_file():
            return path
        raise ConfigurationError(f"no campaign file '{name}'")
    built_in = built_in_campaigns()
    if name not in built_in:
        raise ConfigurationError(f"{unknown(name, built_in, 'built-in campaign')}; a file ends in .yaml")
    return built_in[name]


def built_in_campaigns() -> dict[str, Path]:
    """The campaigns that ship with crankbench, by name."""
    folder = Path(str(resources.files("harness.campaigns")))
    return {path.stem: path for path in sorted(folder.glob("*.yaml"))}


def describe_campaign(file: Path) -> str:
    """The one-line description in a campaign file."""
    document, _ = read_yaml_file(file)
    return str(document.get("description", "")) if isinstance(document, dict) else ""


def _override(
    document: dict[str, Any], places: Places, overrides: Sequence[str], problems: list[Problem]
) -> tuple[dict[str, Any], Places, list[Setting]]:
    """The document with the overrides put in, and those of them that experiments and axes must not undo."""
    on_top = []
    for override in overrides:
        place = Place(f"--set {override}")
        path, equals, text = override.partition("=")
        if not equals or not path.strip():
            problems.append(Problem("wants path=value, like plant.k='1500 N.m/rad'", *place))
            continue
        try:
            value, _ = read_yaml(text, place.file)
        except ConfigurationError as error:
            problems += error.problems
            continue
        try:
            target = _target(path.strip(), document)
            put(document, target, value)
        except PathError as error:
            problems.append(Problem(str(error), *place))
            continue
        places = places.moved(target, place, place)
        if target[0] in SCENARIO_KEYS:
            on_top.append(Setting(path.strip(), value, place, place))
    return document, places, on_top


def _target(path: str, document: Mapping[str, Any]) -> KeyPath:
    """Where an override goes: a path of the scenario, or a key of the campaign like `limits.case` or `vary.seed`."""
    head, _, rest = path.partition(".")
    fields = [name for name in CampaignFile.model_fields if name not in SCENARIO_KEYS]
    if head in fields and head not in (document.get("parts") or {}):
        steps: list[str] = []
        inside: Any = document.get(head)
        while rest and isinstance(inside, dict) and rest not in inside and head != "vary":
            step, _, rest = rest.partition(".")
            steps.append(step)
            inside = inside.get(step)
            if step == "vary":
                break
        return (head, *steps, *([rest] if rest else []))
    return locate(path, document)


def _name_problems(document: Mapping[str, Any], places: Places) -> Iterator[Problem]:
    """Names that could not be told apart from others in a path."""
    for section in ("parts", "metrics", "experiments"):
        named = document.get(section)
        for name in named if isinstance(named, dict) else ():
            if not name.isidentifier():
                message = f"{section}: a name wants letters, digits and _, got '{name}'"
                yield places.key_problem(message, section, name)
            elif section == "parts" and name in ("clock", "seed", "record"):
                yield places.key_problem(
                    f"parts: '{name}' is a key of the campaign; name the part otherwise", "parts", name
                )


def _cases(
    document: Mapping[str, Any], places: Places, on_top: Sequence[Setting], folder: Path, problems: list[Problem]
) -> Iterator[Case]:
    scenario = {key: document[key] for key in SCENARIO_KEYS if key in document}
    experiments = document.get("experiments") or {}
    if not isinstance(experiments, dict) or not isinstance(document.get("vary") or {}, dict):
        return
    if experiments and document.get("vary"):
        problems.append(places.key_problem("vary wants to stand inside the experiments where there are any", "vary"))
    variants: list[tuple[str, KeyPath, dict[str, Any]]] = [
        (name, ("experiments", name), body) for name, body in experiments.items() if isinstance(body, dict)
    ]
    for name, below, body in variants or [("", (), {"vary": document.get("vary")})]:
        raw_overrides, raw_axes = body.get("set") or {}, body.get("vary") or {}
        if not isinstance(raw_overrides, dict) or not isinstance(raw_axes, dict):
            continue
        overrides = [
            Setting(path, value, places.of((*below, "set", path)), places.of((*below, "set", path), places.keys))
            for path, value in raw_overrides.items()
        ]
        axes, found = read_axes(raw_axes, places, (*below, "vary"))
        problems += found
        fixed = {setting.name for setting in on_top}
        for path in sorted({path for axis in axes for path in axis.paths} & fixed):
            place = next(setting.place for setting in on_top if setting.name == path)
            target = ".".join(map(str, (*below, "vary", path)))
            problems.append(Problem(f"the campaign varies {path}; write {target}='[...]' to vary it otherwise", *place))
        for point in combine(axes):
            yield from _case(scenario, places, name, [*overrides, *point, *on_top], point, folder, problems)


def _case(
    scenario: Mapping[str, Any],
    places: Places,
    experiment: str,
    settings: Sequence[Setting],
    point: Sequence[Setting],
    folder: Path,
    problems: list[Problem],
) -> Iterator[Case]:
    document, places, found = apply(scenario, places, settings)
    checked, misfits = validate(Scenario, document, places)
    problems += found + misfits
    if checked is None:
        return
    values = {setting.name: shown(setting.value) for setting in point}
    varied = ", ".join(f"{path} = {value}" for path, value in values.items())
    label = ": ".join(part for part in (experiment, varied) if part) or "as declared"
    yield Case(case_key(checked, experiment, folder), label, experiment, values, checked, places)


def _criteria(document: Mapping[str, Any], places: Places, problems: list[Problem]) -> Iterator[Criterion]:
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


def _mapping(document: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    found = document.get(key)
    return found if isinstance(found, dict) else {}


def _reference_problems(document: Mapping[str, Any], places: Places) -> Iterator[Problem]:
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
        "experiment": experiments,
        "part": list(_mapping(document, "parts")),
    }
    report, _ = validate(ReportSection, _mapping(document, "report"), places)
    for path, kind, name in report.references() if report is not None else ():
        if name not in names[kind]:
            yield places.problem(f"report: {unknown(name, names[kind], kind)}", "report", *path)
    limits, _ = validate(Limits, _mapping(document, "limits"), places)
    if limits is None:
        return
    try:
        if limits.case.si("s") <= 0:
            yield places.problem(f"limits.case wants a time above 0 s, got {limits.case}", "limits", "case")
    except UnitError as error:
        yield places.problem(f"limits.case {error}", "limits", "case")
