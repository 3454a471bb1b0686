"""Turns the axes and overrides of a campaign into cases: paths like `encoder.noise.std` and the values they take."""

from __future__ import annotations

import copy
import itertools
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from fmus.component import Problem
from fmus.model import unknown
from harness.places import KeyPath, Move, Place, Places
from harness.scenario import MODEL, PART_KINDS, part_kind
from harness.validation import known_keys

# What a path may begin with besides the name of a part.
ROOTS = ("clock", "seed", "record", "coupling", "validation")
_RANGE = re.compile(r"\s*([+-]?\d+)\s*\.\.\s*([+-]?\d+)\s*$")
_LIST = re.compile(r"\s*\[([^\[\]]*)\]\s*(.*?)\s*$")
_COMMA = re.compile(r",(?![^\[]*\])")
MOST_CASES = 100_000


class PathError(ValueError):
    """A path that leads nowhere; the message names the nearest known step."""


class Setting(NamedTuple):
    """A value to put at a path, and where the value and the path were written."""

    name: str
    value: Any
    place: Place
    key: Place


@dataclass(frozen=True)
class Axis:
    """One direction of variation: each point sets all of `paths`, jointly."""

    paths: tuple[str, ...]
    points: tuple[tuple[Setting, ...], ...]


def locate(path: str, scenario: Mapping[str, Any]) -> KeyPath:
    """The keys that a path like `plant.k`, `encoder.noise.std`, `clock.time.step` or `seed` leads to.

    After a part's name stands a key of the part's own, else a name under its `with`. `parts.` may stand before it.
    Raises PathError: no such part.
    """
    head, *rest = path.strip().split(".")
    parts = scenario.get("parts")
    parts = parts if isinstance(parts, dict) else {}
    if head == "parts" and head not in parts and rest:
        head, *rest = rest
    if head not in parts:
        if head in ROOTS:
            return (head, *rest)
        raise PathError(unknown(head, [*parts, *ROOTS], "part"))
    part, kind = parts[head], part_kind(parts[head])
    if not rest or kind != MODEL or rest[0] in known_keys(PART_KINDS[MODEL]):
        return ("parts", head, *(int(step) if step.isdigit() else step for step in rest))
    settings = part.get("with") if isinstance(part, dict) else None
    if isinstance(settings, dict) and isinstance(settings.get(rest[0]), dict):
        return ("parts", head, "with", *rest)
    return ("parts", head, "with", ".".join(rest))


def put(document: dict[str, Any], path: KeyPath, value: Any) -> None:
    """Set what is at `path`, making mappings where there is nothing. Raises PathError: a step has no keys."""
    target: Any = document
    for depth, step in enumerate(path[:-1]):
        around = ".".join(map(str, path[: depth + 1]))
        if isinstance(target, dict) and target.get(step) is None:
            target[step] = {}
        target = _inside(target, step, around)
    last = path[-1]
    if isinstance(target, dict):
        target[last] = value
    else:
        _inside(target, last, ".".join(map(str, path)))
        target[last] = value


def _inside(target: Any, step: str | int, around: str) -> Any:
    if isinstance(target, dict):
        return target[step]
    if isinstance(target, list) and isinstance(step, int) and step < len(target):
        return target[step]
    what = f"a list of {len(target)}" if isinstance(target, list) else f"{target!r}"
    raise PathError(f"'{around}' leads nowhere: there is {what}")


def apply(
    scenario: Mapping[str, Any], places: Places, settings: Sequence[Setting]
) -> tuple[dict[str, Any], Places, list[Problem]]:
    """The scenario with all settings put at their paths, the places that follow, and the paths that lead nowhere."""
    document = copy.deepcopy(dict(scenario))
    problems = []
    moves = []
    for name, value, place, key in settings:
        try:
            path = locate(name, document)
            put(document, path, copy.deepcopy(value))
        except PathError as error:
            problems.append(Problem(f"{name}: {error}", *key))
        else:
            moves.append(Move(path, place, key))
    return document, places.moved(moves), problems


def read_axes(raw: Any, places: Places, below: KeyPath) -> tuple[list[Axis], list[Problem]]:
    """The axes of a `vary` mapping that stands at `below`, and what is wrong with them."""
    axes: list[Axis] = []
    problems: list[Problem] = []
    for key, written in (raw or {}).items():
        names = tuple(name.strip() for name in _COMMA.split(key))
        values = _points(written)
        if not values:
            wanted = 'a list, "[1, 2] unit" or 1..20'
            problems.append(places.problem(f"vary {key}: wants {wanted}, got {written!r}", *below, key))
            continue
        points = []
        for index, value in enumerate(values):
            place = places.of((*below, key, index))
            together = value if len(names) > 1 else [value]
            if not isinstance(together, list) or len(together) != len(names):
                problems.append(Problem(f"vary {key}: wants {len(names)} values together, got {value!r}", *place))
                continue
            named = places.of((*below, key), places.keys)
            points.append(tuple(Setting(name, one, place, named) for name, one in zip(names, together, strict=True)))
        repeated = {name for name in names for axis in axes if name in axis.paths}
        problems += [places.key_problem(f"{name} is varied twice", *below, key) for name in sorted(repeated)]
        axes.append(Axis(names, tuple(points)))
    if not problems and _count(axes) > MOST_CASES:
        problems.append(places.key_problem(f"vary wants at most {MOST_CASES} cases, got {_count(axes)}", *below))
    return ([], problems) if problems else (axes, [])


def combine(axes: Sequence[Axis]) -> Iterator[tuple[Setting, ...]]:
    """Every combination of the axes' points, the last axis fastest."""
    for points in itertools.product(*(axis.points for axis in axes)):
        yield tuple(setting for point in points for setting in point)


def shown(value: Any) -> str:
    """A value as text, as the labels and the tables have it."""
    if isinstance(value, str):
        return value
    if isinstance(value, float):
        return f"{value:.12g}"
    return json.dumps(value) if isinstance(value, (dict, list)) or value is None else str(value)


def _count(axes: Sequence[Axis]) -> int:
    count = 1
    for axis in axes:
        count *= len(axis.points)
    return count


def _points(written: Any) -> list[Any]:
    if isinstance(written, list):
        return written
    if not isinstance(written, str):
        return []
    span = _RANGE.match(written)
    if span:
        first, last = int(span[1]), int(span[2])
        return list(range(first, last + 1)) if last - first < MOST_CASES else []
    several = _LIST.match(written)
    if several:
        return [f"{item.strip()} {several[2]}".strip() for item in several[1].split(",") if item.strip()]
    return []
