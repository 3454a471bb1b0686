"""Published values and statements beside ours: medians of metrics, and whether what is stated holds here."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from reports import numbers, standing
from reports.errors import samples_of
from reports.folder import Run, read_entries


@dataclass(frozen=True)
class Statement:
    """A published statement as a criterion: whether it holds, and the values on both of its sides, in `unit`."""

    text: str
    holds: bool
    value: float
    bound: float
    unit: str
    case: str
    reason: str


@dataclass(frozen=True)
class Row:
    """What was published and what came here; the statement where the entry makes one."""

    what: str
    published: Any
    ours: str
    experiment: str
    metric: str
    note: str
    statement: Statement | None


def published(run: Run) -> list[Row]:
    """A row for each published entry of the campaign. Raises RunFolderError: statements.json is damaged."""
    statements = read_statements(run)
    entries = (run.campaign.get("report") or {}).get("published") or ()
    return [_row(run, entry, statements.get(index)) for index, entry in enumerate(entries)]


def read_statements(run: Run) -> dict[int, Statement]:
    """The judged statements by the number of their entry; none where the campaign makes none or was never judged.

    Raises RunFolderError: the file does not hold what the contract says.
    """
    return dict(read_entries(run.path / "statements.json", "statement", _statement))


def _statement(entry: Mapping[str, Any]) -> tuple[int, Statement]:
    return int(entry["entry"]), Statement(
        text=str(entry["text"]),
        holds=bool(entry["holds"]),
        value=math.nan if entry["value"] is None else float(entry["value"]),
        bound=math.nan if entry["bound"] is None else float(entry["bound"]),
        unit=str(entry["unit"]),
        case=str(entry["case"]),
        reason=str(entry["reason"]),
    )


def _row(run: Run, entry: dict[str, Any], statement: Statement | None) -> Row:
    metric, experiment = str(entry.get("metric") or ""), str(entry.get("experiment") or "")
    return Row(
        what=str(entry.get("what")),
        published=entry.get("published"),
        ours=_ours(run, entry, metric, experiment),
        experiment=experiment,
        metric=metric,
        note=str(entry.get("note") or ""),
        statement=statement,
    )


def _ours(run: Run, entry: dict[str, Any], metric: str, experiment: str) -> str:
    """The median of the metric over the cases, else what the entry says."""
    cases = [case for case in run.cases if experiment in ("", case.experiment)]
    values = [case.metrics[metric].value for case in cases if metric in case.metrics]
    values = [value for value in values if not math.isnan(value)] or list(samples_of(run, metric, cases))
    unit = standing.unit_of(run, metric)
    if len(values) == 1:
        return numbers.with_unit(values[0], unit)
    if values:
        spread = f"{numbers.short(min(values))} to {numbers.short(max(values))}"
        return f"{numbers.with_unit(float(np.median(values)), unit)} (median of {len(values)}; {spread})"
    if metric:
        return f"{metric}: no case of {experiment or 'the campaign'} has it"
    return str(entry["ours"]) if entry.get("ours") is not None else "" if entry.get("holds") else "see the figures"
