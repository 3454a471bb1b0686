"""One page over several run folders: what changed between them, and whether the ranking of the observers holds."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fmus.whole import write_whole
from reports import standing
from reports.folder import Case, Run, RunFolderError, read_run
from reports.html import verdict
from reports.page import page_of

# What of campaign.json says how a campaign was run; the rest are results, or follows from these.
_SETTINGS = ("clock", "seeds", "parts", "experiments", "metrics", "accept", "versions", "platform", "commit", "fmus")
_DIFFERENCES_LISTED = 200


@dataclass(frozen=True)
class Difference:
    """One setting that the campaigns do not share: its path in campaign.json, and the text in each folder."""

    path: str
    values: tuple[str, ...]


@dataclass(frozen=True)
class Ranking:
    """One quantity in every folder: medians by observer, in `unit`, and the observers' order, best first.

    Over the scenarios that all folders share; the median of the scenarios' medians.

    `holds` is True where the observers that all folders share come in the same order in each.
    """

    label: str
    unit: str
    observers: tuple[str, ...]
    medians: Mapping[str, tuple[float, ...]]
    places: Mapping[str, tuple[int | None, ...]]
    holds: bool


@dataclass(frozen=True)
class Shift:
    """One metric in one scenario: its median in each folder, and the largest of them over the smallest."""

    scenario: str
    metric: str
    unit: str
    medians: tuple[float, ...]
    factor: float


@dataclass(frozen=True)
class Comparison:
    """Several runs side by side, the first as the base."""

    runs: tuple[Run, ...]
    names: tuple[str, ...]
    differences: tuple[Difference, ...]
    rankings: tuple[Ranking, ...]
    shifts: tuple[Shift, ...]
    criteria: Mapping[str, tuple[tuple[bool, float, str] | None, ...]]


def compare(folders: Sequence[Path | str]) -> Comparison:
    """The runs in two or more folders side by side.

    Raises RunFolderError: fewer than two folders, or one that holds no run.
    """
    if len(folders) < 2:
        raise RunFolderError(f"a comparison wants two run folders or more, got {len(folders)}")
    runs = tuple(read_run(folder) for folder in folders)
    return Comparison(
        runs=runs,
        names=_names(runs),
        differences=tuple(_differences(runs)),
        rankings=tuple(_rankings(runs)),
        shifts=tuple(_shifts(runs)),
        criteria=_criteria(runs),
    )


def write_comparison(folders: Sequence[Path | str], path: Path | str) -> Path:
    """The path of the self-contained page written about the runs in several folders. Raises RunFolderError."""
    found = compare(folders)
    content = page_of(
        "comparison.html.jinja",
        found=found,
        verdicts=[verdict(run) for run in found.runs],
        listed=found.differences[:_DIFFERENCES_LISTED],
        titles={part: title for run in reversed(found.runs) for part, title in standing.observers(run).items()},
    )
    write_whole(Path(path), content)
    return Path(path)


def as_json(found: Comparison) -> dict[str, Any]:
    """The comparison as JSON: what is not finite is null."""
    return {
        "folders": [str(run.path) for run in found.runs],
        "accepted": [run.accepted for run in found.runs],
        "differences": [{"path": one.path, "values": list(one.values)} for one in found.differences],
        "rankings": [
            {
                "quantity": one.label,
                "unit": one.unit,
                "holds": one.holds,
                "medians": {name: [_finite(value) for value in values] for name, values in one.medians.items()},
                "places": {name: list(places) for name, places in one.places.items()},
            }
            for one in found.rankings
        ],
        "metrics": [
            {
                "scenario": one.scenario,
                "metric": one.metric,
                "unit": one.unit,
                "medians": [_finite(value) for value in one.medians],
            }
            for one in found.shifts
        ],
    }


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _names(runs: Sequence[Run]) -> tuple[str, ...]:
    """The folders' own names where they differ, else their paths."""
    short = [run.path.resolve().name for run in runs]
    return tuple(short) if len(set(short)) == len(short) else tuple(str(run.path) for run in runs)


def _differences(runs: Sequence[Run]) -> Iterable[Difference]:
    flat = [{key: value for name in _SETTINGS for key, value in _flat(run.campaign.get(name), name)} for run in runs]
    for path in dict.fromkeys(key for one in flat for key in one):
        values = tuple(one.get(path, "-") for one in flat)
        if len(set(values)) > 1:
            yield Difference(path, values)


def _flat(value: Any, path: str) -> Iterable[tuple[str, str]]:
    if isinstance(value, Mapping) and value:
        for key, item in value.items():
            yield from _flat(item, f"{path}.{key}")
    elif value is not None:
        yield path, value if isinstance(value, str) else json.dumps(value, default=str)


def _rankings(runs: Sequence[Run]) -> Iterable[Ranking]:
    groups = [standing.scenarios(run) for run in runs]
    shared_scenarios = [name for name in groups[0] if all(name in group for group in groups)]
    boards: dict[tuple[str, str], list[dict[str, float]]] = {}
    for index, (run, group) in enumerate(zip(runs, groups, strict=True)):
        for quantity in standing.quantities(run):
            if len(quantity.metrics) > 1 and shared_scenarios:
                medians = {
                    observer: _median_of_medians(run, quantity, observer, [group[name] for name in shared_scenarios])
                    for observer in quantity.metrics
                }
                sign = -1.0 if quantity.higher_is_better else 1.0
                ordered = sorted(medians, key=lambda one: (math.isnan(medians[one]), sign * medians[one]))
                entry = boards.setdefault((quantity.label, quantity.unit), [{} for _ in runs])
                entry[index] = {observer: medians[observer] for observer in ordered}
    for (label, unit), board in boards.items():
        observers = tuple(dict.fromkeys(name for one in board for name in one))
        shared = [name for name in observers if all(name in one for one in board)]
        orders = {tuple(name for name in one if name in shared) for one in board}
        places = {
            name: tuple(list(one).index(name) + 1 if name in one else None for one in board) for name in observers
        }
        reached = {name: tuple(one.get(name, math.nan) for one in board) for name in observers}
        yield Ranking(label, unit, observers, reached, places, len(orders) == 1 and len(shared) > 1)


def _median_of_medians(
    run: Run, quantity: standing.Quantity, observer: str, scenarios: Sequence[Sequence[Case]]
) -> float:
    """Every scenario counts once, however many seeds a folder has of it."""
    metric, higher = quantity.metrics[observer], quantity.higher_is_better
    medians = [standing.standing(run, metric, observer, higher, cases).median for cases in scenarios]
    medians = [value for value in medians if not math.isnan(value)]
    return float(np.quantile(medians, 0.5, method="inverted_cdf")) if medians else math.nan


def _shifts(runs: Sequence[Run]) -> list[Shift]:
    """Metrics that two or more folders have for one scenario, the most changed first."""
    groups = [standing.scenarios(run) for run in runs]
    names = dict.fromkeys(name for run in runs for name in run.metric_names())
    shifts = []
    for scenario in dict.fromkeys(scenario for group in groups for scenario in group):
        for metric in names:
            medians = tuple(
                standing.standing(run, metric, "", False, group.get(scenario, [])).median
                for run, group in zip(runs, groups, strict=True)
            )
            present = [value for value in medians if not math.isnan(value)]
            if len(present) > 1:
                unit = next(standing.unit_of(run, metric) for run in runs if metric in run.metric_names())
                shifts.append(Shift(scenario, metric, unit, medians, _factor(present)))
    return sorted(shifts, key=lambda shift: -shift.factor)


def _factor(values: Sequence[float]) -> float:
    """The largest magnitude over the smallest, 1 where all are equal, infinite where one is zero or failed."""
    if len(set(values)) == 1:
        return 1.0
    sizes = np.abs(values)
    if min(values) < 0 < max(values) or sizes.min() == 0 or not np.isfinite(sizes).all():
        return math.inf
    return float(sizes.max() / sizes.min())


def _criteria(runs: Sequence[Run]) -> dict[str, tuple[tuple[bool, float, str] | None, ...]]:
    judged = [{one.name: (one.passed, one.value, one.unit) for one in run.criteria or ()} for run in runs]
    return {name: tuple(one.get(name) for one in judged) for name in dict.fromkeys(n for one in judged for n in one)}
