"""Where a report's numbers come from: hashes, versions, seeds, settings, order of steps, what was tolerated."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

from reports.folder import Case, Run
from reports.numbers import duration, short


class Applied(NamedTuple):
    """A start value as it was applied in the cases: one value, or how many and their range."""

    part: str
    name: str
    value: str


class Tolerated(NamedTuple):
    """A warning or a message of a part, and in how many cases it came."""

    message: str
    cases: int


class Binary(NamedTuple):
    """An FMU as it was loaded."""

    part: str
    sha256: str
    tool: str
    fmi_version: str


def facts(run: Run) -> list[tuple[str, str]]:
    """The campaign's identity as (what, value), gaps said to be gaps."""
    campaign = run.campaign
    wall = sum(case.wall.get("total", 0.0) for case in run.cases)
    versions = ", ".join(f"{name} {version}" for name, version in (campaign.get("versions") or {}).items())
    return [
        ("campaign file", str(campaign.get("file") or "not recorded")),
        ("its SHA-256", str(campaign.get("file_sha256") or "not recorded")),
        ("commit", str(campaign.get("commit") or "not recorded")),
        ("platform", _words(campaign.get("platform")) or "not recorded"),
        ("versions", versions or "not recorded"),
        ("validation of FMUs", str(campaign.get("validation") or "not recorded")),
        ("seeds", ranges(campaign.get("seeds")) or "not recorded"),
        ("clock", _words(campaign.get("clock")) or "not recorded"),
        ("wall time", f"{duration(wall)} in all cases together" if wall else "not recorded"),
    ]


def binaries(run: Run) -> list[Binary]:
    """The FMUs of the campaign and of its cases, each once."""
    found: dict[Binary, None] = {}
    for fmus in [run.campaign.get("fmus") or {}, *(case.fmus for case in run.cases)]:
        for part, fmu in fmus.items():
            fields = [str(fmu.get(name) or "not recorded") for name in ("sha256", "tool", "fmi_version")]
            found[Binary(part, *fields)] = None
    return sorted(found)


def step_orders(run: Run) -> list[tuple[tuple[str, ...], tuple[str, ...], int]]:
    """Every order of steps with its held wires, and the number of cases stepped so."""
    counted = Counter((case.order, case.held) for case in run.cases if case.order)
    if not counted and run.campaign.get("order"):
        return [(tuple(run.campaign["order"]), tuple(run.campaign.get("held") or ()), len(run.cases))]
    return [(order, held, cases) for (order, held), cases in counted.most_common()]


def applied_starts(run: Run) -> tuple[list[Applied], list[Applied]]:
    """Start values applied over all cases, in declared units: the solvers' settings, and the rest."""
    values: dict[tuple[str, str], dict[str, None]] = {}
    for case in run.cases:
        for part, starts in case.starts.items():
            for name, value in starts.items():
                text = short(value, 6) if isinstance(value, float) else str(value)
                values.setdefault((part, name), {})[text] = None
    rows = [Applied(part, name, _several(list(found))) for (part, name), found in values.items()]
    solver = [row for row in rows if row.name.startswith("solver.")]
    return solver, [row for row in rows if not row.name.startswith("solver.")]


def tolerated(run: Run) -> list[Tolerated]:
    """Warnings and log messages that did not end a case, each once with the number of cases it came in."""
    counted: Counter[str] = Counter()
    for case in run.cases:
        counted.update({_message(entry) for entry in (*case.warnings, *case.log) if not _is_trace(entry)})
    return [Tolerated(message, cases) for message, cases in counted.most_common()]


def traces(case: Case) -> str:
    """What a part written in Python printed as it failed."""
    return "\n".join(str(entry.get("text", "")) for entry in case.log if _is_trace(entry)).strip()


def ranges(seeds: Any) -> str:
    """Whole numbers as ranges: 1..20, 42."""
    if not isinstance(seeds, list):
        return "" if seeds is None else str(seeds)
    numbers = sorted({int(seed) for seed in seeds})
    runs: list[list[int]] = []
    for number in numbers:
        if runs and number == runs[-1][-1] + 1:
            runs[-1].append(number)
        else:
            runs.append([number])
    return ", ".join(str(group[0]) if len(group) == 1 else f"{group[0]}..{group[-1]}" for group in runs)


def _is_trace(entry: Any) -> bool:
    return isinstance(entry, Mapping) and entry.get("category") == "trace"


def _message(entry: Any) -> str:
    if isinstance(entry, Mapping):
        head = ", ".join(str(entry[key]) for key in ("part", "category") if entry.get(key) not in (None, ""))
        said = str(entry.get("text") or entry.get("message") or _words(entry))
        return f"{head}: {said}" if head else said
    if isinstance(entry, (list, tuple)):
        return " ".join(str(item) for item in entry)
    return str(entry)


def _several(texts: list[str]) -> str:
    return (
        texts[0]
        if len(texts) == 1
        else f"{', '.join(texts[:8])}{f', ... ({len(texts)} values)' if len(texts) > 8 else ''}"
    )


def _words(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {_words(item)}".strip() for key, item in value.items())
    if isinstance(value, Iterable) and not isinstance(value, str):
        return ", ".join(_words(item) for item in value)
    return value if isinstance(value, str) else json.dumps(value, default=str)
