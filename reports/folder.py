"""Reads a run folder into frozen values: the campaign, its cases, their metrics and the criteria.

What takes long to import is imported where it is used, so that the pytest plug-in starts fast.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:
    import pandas as pd

COMPLETE = ("ok", "warning")
MISSING = "missing"
Entry = TypeVar("Entry")


class RunFolderError(Exception):
    """A run folder that cannot be read: which file, what was wanted, what came."""


@dataclass(frozen=True)
class Measured:
    """One metric of one case, in the unit the campaign declares for it; NaN where it does not apply."""

    value: float
    unit: str = "1"


@dataclass(frozen=True)
class Matrix:
    """`counts[i][j]`: how many rows of a case had the true class `classes[i]` and the estimated class `classes[j]`."""

    classes: tuple[str, ...]
    counts: tuple[tuple[int, ...], ...]


@dataclass(frozen=True)
class Case:
    """One case: what was varied, how it ended, what was measured; `outcome` is `missing` where it never finished."""

    key: str
    label: str
    experiment: str = ""
    values: Mapping[str, str] = field(default_factory=dict)
    outcome: str = MISSING
    part: str = ""
    failed_at: float = math.nan
    message: str = ""
    metrics: Mapping[str, Measured] = field(default_factory=dict)
    samples: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    matrices: Mapping[str, Matrix] = field(default_factory=dict)
    starts: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    wall: Mapping[str, float] = field(default_factory=dict)
    warnings: tuple[Any, ...] = ()
    log: tuple[Any, ...] = ()
    order: tuple[str, ...] = ()
    held: tuple[str, ...] = ()
    fmus: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    @property
    def complete(self) -> bool:
        """True when the case ran to its end."""
        return self.outcome in COMPLETE

    @property
    def scenario(self) -> str:
        """What was varied but the seed: the experiment and the values, as one line."""
        varied = ", ".join(f"{path} = {text}" for path, text in self.values.items() if path != "seed")
        return ": ".join(part for part in (self.experiment, varied) if part) or "as declared"


@dataclass(frozen=True)
class Criterion:
    """One acceptance criterion and what came: `case` is the key of the worst case."""

    text: str
    experiment: str
    value: float
    bound: float
    unit: str
    passed: bool
    case: str
    reason: str

    @property
    def name(self) -> str:
        """The criterion as it was declared, with its experiment in front."""
        return f"{self.experiment}: {self.text}" if self.experiment else self.text


@dataclass(frozen=True)
class Run:
    """A run folder: `campaign` is campaign.json as written; `criteria` is None where acceptance.json is not there."""

    path: Path
    campaign: Mapping[str, Any]
    cases: tuple[Case, ...]
    criteria: tuple[Criterion, ...] | None

    @property
    def name(self) -> str:
        """Name of the campaign."""
        return str(self.campaign["campaign"])

    @property
    def missing(self) -> tuple[Case, ...]:
        """Cases that the campaign declares and that were never finished."""
        return tuple(case for case in self.cases if case.outcome == MISSING)

    @property
    def failed(self) -> tuple[Case, ...]:
        """Cases that did not run to their end, missing ones included."""
        return tuple(case for case in self.cases if not case.complete)

    @property
    def accepted(self) -> bool:
        """True when every case ran to its end and every criterion passed."""
        return not self.failed and self.criteria is not None and all(criterion.passed for criterion in self.criteria)

    def case(self, key: str) -> Case:
        """The case of that key or label. Raises KeyError with the nearest."""
        for case in self.cases:
            if key in (case.key, case.label):
                return case
        raise KeyError(_unknown(key, [case.label for case in self.cases], "case"))

    def metric_names(self) -> list[str]:
        """Names of all metrics any case has, in order of appearance."""
        return list(dict.fromkeys(name for case in self.cases for name in case.metrics))

    def metric(self, name: str, experiment: str | None = None) -> pd.Series:
        """One metric over the cases that have it (of one experiment where given), indexed by the case's label.

        A case that failed, or that lacks the metric, is NaN: it is not dropped. The unit is in `.attrs["unit"]`.
        Raises KeyError with the nearest name: no case has that metric, or there is no such experiment.
        """
        import pandas as pd

        if name not in self.metric_names():
            raise KeyError(_unknown(name, self.metric_names(), "metric"))
        experiments = [case.experiment for case in self.cases]
        if experiment is not None and experiment not in experiments:
            raise KeyError(_unknown(experiment, experiments, "experiment"))
        cases = [case for case in self.cases if experiment in (None, case.experiment)]
        values = {case.label: case.metrics[name].value if name in case.metrics else math.nan for case in cases}
        series = pd.Series(values, name=name, dtype=float)
        series.attrs["unit"] = next(case.metrics[name].unit for case in self.cases if name in case.metrics)
        return series

    def signals(self, case: Case | str, names: Sequence[str] | None = None) -> pd.DataFrame:
        """Recorded signals of a case in SI, one column a signal, indexed by time [s].

        Raises KeyError with the nearest name: a signal was not recorded. Raises RunFolderError: no record.
        """
        import pandas as pd

        from reports.signals import read_columns

        case = case if isinstance(case, Case) else self.case(case)
        columns = read_columns(self, case, names)
        index = pd.Index(columns.time, name="time")
        return pd.DataFrame(
            {name: column.values for name, column in columns.signals.items()},
            index=index,
        )


def read_run(folder: Path | str) -> Run:
    """The run kept in `folder`. Cases without a case.json come as `missing`.

    Raises RunFolderError: no such folder, no campaign.json in it, or a file that does not hold what the contract says.
    """
    path = Path(folder)
    if not path.is_dir():
        raise RunFolderError(f"{path}: wants a run folder, got {'a file' if path.exists() else 'nothing there'}")
    if not (path / "campaign.json").is_file():
        raise RunFolderError(f"{path}: wants campaign.json in a run folder, got {_listing(path)}")
    campaign = read_json(path / "campaign.json", dict)
    for key, kind in (("campaign", str), ("cases", list)):
        if not isinstance(campaign.get(key), kind):
            raise RunFolderError(
                f"{path / 'campaign.json'}: wants '{key}' as {_JSON_NAMES[kind]}, got {_short(campaign.get(key))}"
            )
    cases = tuple(_read_case(path, entry) for entry in campaign["cases"])
    return Run(
        path,
        campaign,
        cases,
        read_criteria(path) if (path / "acceptance.json").exists() else None,
    )


def read_criteria(folder: Path) -> tuple[Criterion, ...]:
    """The criteria in the folder's acceptance.json, in their order.

    Raises RunFolderError: the file is missing, no JSON list, or an entry lacks `text` or `passed`.
    """
    path = folder / "acceptance.json"
    if not path.is_file():
        raise RunFolderError(f"{path} is missing: the campaign was not judged; run it to its end with `crankbench run`")
    criteria = []
    for number, entry in enumerate(read_json(path, list), start=1):
        if (
            not isinstance(entry, dict)
            or not isinstance(entry.get("text"), str)
            or not isinstance(entry.get("passed"), bool)
        ):
            raise RunFolderError(
                f"{path}: criterion {number} wants an object with 'text' and 'passed', got {_short(entry)}"
            )
        criteria.append(
            Criterion(
                text=entry["text"],
                experiment=str(entry.get("experiment") or ""),
                value=_number(entry.get("value")),
                bound=_number(entry.get("bound")),
                unit=str(entry.get("unit") or ""),
                passed=entry["passed"],
                case=str(entry.get("case") or ""),
                reason=str(entry.get("reason") or ""),
            )
        )
    return tuple(criteria)


_JSON_NAMES: dict[type, str] = {dict: "an object", list: "a list", str: "text"}


def _read_case(folder: Path, entry: Any) -> Case:
    if not isinstance(entry, dict) or not isinstance(entry.get("key"), str):
        raise RunFolderError(f"{folder / 'campaign.json'}: a case wants an object with 'key', got {_short(entry)}")
    key = entry["key"]
    path = folder / "cases" / key / "case.json"
    known = {
        "key": key,
        "label": str(entry.get("label") or key),
        "experiment": str(entry.get("experiment") or ""),
    }
    if not path.is_file():
        return Case(
            **known,
            values=_texts(entry.get("values")),
            message="no case.json: the case was never finished",
        )
    found = read_json(path, dict)
    if found.get("key", key) != key:
        raise RunFolderError(f"{path}: wants key {key}, got {_short(found['key'])}")
    return Case(
        **known,
        values=_texts(found.get("values") or entry.get("values")),
        outcome=str(found.get("outcome") or MISSING),
        part=str(found.get("part") or ""),
        failed_at=_number(found.get("failed_at")),
        message=str(found.get("message") or ""),
        metrics={name: _measured(path, name, metric) for name, metric in (found.get("metrics") or {}).items()},
        samples={name: tuple(map(_sample, values)) for name, values in (found.get("samples") or {}).items()},
        matrices={name: _matrix(path, name, raw) for name, raw in (found.get("matrices") or {}).items()},
        starts=found.get("starts") or {},
        wall=found.get("wall") or {},
        warnings=tuple(found.get("warnings") or ()),
        log=tuple(found.get("log") or ()),
        order=tuple(found.get("order") or ()),
        held=tuple(found.get("held") or ()),
        fmus=found.get("fmus") or {},
    )


def _measured(path: Path, name: str, metric: Any) -> Measured:
    """A metric; JSON has no infinity: a value is null then, and `is` says which."""
    if not isinstance(metric, dict) or "value" not in metric:
        raise RunFolderError(f"{path}: metric {name} wants {{value, unit}}, got {_short(metric)}")
    infinite = metric["value"] is None and metric.get("is") in ("inf", "-inf")
    return Measured(float(metric["is"]) if infinite else _number(metric["value"]), str(metric.get("unit") or "1"))


def _matrix(path: Path, name: str, raw: Any) -> Matrix:
    found: Mapping[str, Any] = raw if isinstance(raw, dict) else {}
    classes, counts = found.get("classes"), found.get("counts")
    if isinstance(classes, list) and isinstance(counts, list):
        sizes = [len(counts), *(len(row) if isinstance(row, list) else -1 for row in counts)]
        if sizes == [len(classes)] * (len(classes) + 1):
            return Matrix(tuple(map(str, classes)), tuple(tuple(map(int, row)) for row in counts))
    raise RunFolderError(
        f"{path}: matrix {name} wants {{classes, counts}}, a row and a column a class, got {_short(raw)}"
    )


def read_json(path: Path, wanted: type) -> Any:
    """What a JSON file of a run folder holds, a `wanted`. Raises RunFolderError: it is no JSON, or of another kind."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise RunFolderError(f"{path}: wants JSON, got {error}") from error
    if not isinstance(content, wanted):
        raise RunFolderError(f"{path}: wants {_JSON_NAMES[wanted]}, got {_short(content)}")
    return content


def read_entries(path: Path, what: str, one: Callable[[Any], Entry]) -> tuple[Entry, ...]:
    """What a file of the run's end holds, each entry read by `one`; none where the file is not there.

    Then none are declared, or the run never came to its end. Raises RunFolderError: an entry is not what `what` wants.
    """
    if not path.is_file():
        return ()
    try:
        return tuple(one(entry) for entry in read_json(path, list))
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise RunFolderError(f"{path}: an entry is not what a {what} wants: {error!r}") from error


def _number(raw: Any) -> float:
    return float(raw) if isinstance(raw, (int, float)) else math.nan


def _sample(raw: Any) -> float:
    """A sample; null is one that never came, like the delay of a missed change."""
    return math.inf if raw is None else _number(raw)


def _texts(raw: Mapping[str, Any] | None) -> dict[str, str]:
    return {str(path): str(text) for path, text in (raw or {}).items()}


def _short(raw: Any) -> str:
    text = "nothing" if raw is None else json.dumps(raw, default=str)
    return text if len(text) <= 80 else text[:77] + "..."


def _listing(path: Path) -> str:
    return ", ".join(sorted(child.name for child in path.iterdir())[:6]) or "an empty folder"


def _unknown(name: str, known: Iterable[str], kind: str) -> str:
    from fmus.model import unknown

    return unknown(name, known, kind)
