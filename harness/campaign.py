"""Reads a campaign file: its schema, every problem at its place, and the cases it asks for."""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

from fmus.component import ConfigurationError, Problem
from fmus.model import unknown
from harness.axes import axis_problems
from harness.campaignfile import CampaignFile
from harness.criteria import Criterion
from harness.definitions import Definition
from harness.expansion import PathError, Setting, apply, combine, locate, put, read_axes, shown
from harness.fingerprint import case_key
from harness.places import KeyPath, Move, Place, Places, read_yaml, read_yaml_file
from harness.references import name_problems, read_criteria, read_statements, reference_problems
from harness.reportsection import ReportSection
from harness.scenario import Scenario
from harness.validation import validate
from harness.worker import Limits

OVERRIDE = "--set "  # begins the place of what stands on the command line
SCENARIO_KEYS = ("clock", "parts", "seed", "record", "coupling", "validation")


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
    """A campaign as read: `written` is the file as plain data, overrides of the command line included.

    `statements` are what published entries that have a `holds` state, by the number of the entry.
    """

    name: str
    file: Path
    file_sha256: str
    written: Mapping[str, Any]
    places: Places
    cases: tuple[Case, ...]
    metrics: Mapping[str, Definition]
    criteria: tuple[Criterion, ...]
    statements: Mapping[int, Criterion]
    report: ReportSection
    limits: Limits


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
    problems += [*found, *name_problems(document, places)]
    told = {problem[1:] for problem in found}
    of_cases: list[Problem] = []
    cases = list(_cases(document, places, on_top, file.parent, of_cases))
    problems += [problem for problem in of_cases if problem[1:] not in told]
    criteria = list(read_criteria(document, places, problems))
    statements = read_statements(document, places, problems)
    problems += reference_problems(document, places)
    if checked is not None and not of_cases:
        problems += axis_problems(checked.report, cases, places)
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
        statements=statements,
        report=checked.report,
        limits=checked.limits.for_worker(),
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
        place = Place(f"{OVERRIDE}{override}")
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
        places = places.moved([Move(target, place, place)])
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
        own_parts = body.get("parts") or {}
        if isinstance(own_parts, dict) and isinstance(scenario.get("parts"), dict):
            variant = {**scenario, "parts": {**scenario["parts"], **own_parts}}
        else:
            variant = scenario
        standing = places.mirrored((*below, "parts"), ("parts",))
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
            yield from _case(variant, standing, name, [*overrides, *point, *on_top], point, folder, problems)


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
    _anchor(document, places)
    checked, misfits = validate(Scenario, document, places)
    problems += found + misfits
    if checked is None:
        return
    values = {setting.name: shown(setting.value) for setting in point}
    varied = ", ".join(f"{path} = {value}" for path, value in values.items())
    label = ": ".join(part for part in (experiment, varied) if part) or "as declared"
    yield Case(case_key(checked, experiment, folder), label, experiment, values, checked, places)


def _anchor(document: Mapping[str, Any], places: Places) -> None:
    """Files named on the command line are looked for from where it was typed, not from the campaign's folder."""
    parts = document.get("parts")
    for name, part in parts.items() if isinstance(parts, dict) else ():
        table = part.get("table") if isinstance(part, dict) else None
        holders: tuple[tuple[Any, ...], ...] = ((part, "use"), (part, "file"), (table, "table", "file"))
        for holder, *keys in holders:
            named = holder.get(keys[-1]) if isinstance(holder, dict) else None
            typed = places.of(("parts", name, *keys)).file.startswith(OVERRIDE)
            if typed and isinstance(named, str) and (keys[-1] == "file" or named.endswith(".fmu")):
                holder[keys[-1]] = str(Path(named).absolute())
