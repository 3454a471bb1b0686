"""Reads rankings.json of a run folder: what each measure said of the observers, and how well it ranked them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from reports.folder import Run, read_entries

ANSWERS = {
    "agrees": "yes: what the measure puts first does better",
    "open": "not shown: the interval holds zero",
    "opposes": "the opposite: what the measure puts first does worse",
    "undefined": "cannot be told: all are alike, or too few cases",
}


@dataclass(frozen=True)
class Ranked:
    """A measure's values by observer (NaN: it has none) and their rank correlation with the medians of the metric.

    Of a measure that is a metric itself, named in `metric`, the values are its medians, in `unit`.
    """

    name: str
    title: str
    metric: str
    unit: str
    higher_is_better: bool
    values: Mapping[str, float]
    correlation: float
    lower: float
    upper: float
    resamples: int
    answer: str

    @property
    def told(self) -> str:
        """The answer in words."""
        return ANSWERS[self.answer]


@dataclass(frozen=True)
class Ranking:
    """One question: medians of a metric by observer (infinite: at least half of the cases failed), and the measures."""

    title: str
    metric: str
    unit: str
    higher_is_better: bool
    experiments: tuple[str, ...]
    cases: int
    failed: int
    resamples: int
    seed: int
    level: float
    note: str
    medians: Mapping[str, float]
    measures: tuple[Ranked, ...]


def read_rankings(run: Run) -> tuple[Ranking, ...]:
    """The rankings of a run; none where the file is not there: none are declared, or it was never run to its end.

    Raises RunFolderError: the file does not hold what the contract says.
    """
    return read_entries(run.path / "rankings.json", "ranking", _ranking)


def _ranking(entry: Mapping[str, Any]) -> Ranking:
    worst = -math.inf if entry["better"] == "higher" else math.inf
    return Ranking(
        title=str(entry["title"]),
        metric=str(entry["metric"]),
        unit=str(entry["unit"]),
        higher_is_better=entry["better"] == "higher",
        experiments=tuple(map(str, entry["experiments"])),
        cases=int(entry["cases"]),
        failed=int(entry["failed"]),
        resamples=int(entry["resamples"]),
        seed=int(entry["seed"]),
        level=float(entry["level"]),
        note=str(entry["note"]),
        medians={str(name): _or(value, worst) for name, value in entry["medians"].items()},
        measures=tuple(_measure(one) for one in entry["measures"]),
    )


def _measure(entry: Mapping[str, Any]) -> Ranked:
    answer = str(entry["answer"])
    if answer not in ANSWERS:
        raise ValueError(f"an answer wants one of {', '.join(ANSWERS)}, got {answer!r}")
    return Ranked(
        name=str(entry["name"]),
        title=str(entry["title"]),
        metric=str(entry.get("metric") or ""),
        unit=str(entry.get("unit") or "1"),
        higher_is_better=entry["better"] == "higher",
        values={str(name): _or(value, math.nan) for name, value in entry["values"].items()},
        correlation=_or(entry["correlation"], math.nan),
        lower=_or(entry["lower"], math.nan),
        upper=_or(entry["upper"], math.nan),
        resamples=int(entry["resamples"]),
        answer=answer,
    )


def _or(value: Any, missing: float) -> float:
    return missing if value is None else float(value)
