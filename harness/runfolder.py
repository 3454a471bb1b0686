"""Writes and reads back what a run folder holds: campaign.json, the cases, metrics.csv, verdicts."""

from __future__ import annotations

import csv
import io
import json
import math
import platform
import subprocess
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any

from fmus.whole import write_whole
from harness.campaign import Campaign, Case
from harness.criteria import Judged, Verdict
from harness.definitions import Definition, Measured, Value, digest, meanings, measure, value_part
from harness.record import COMPLETE, Record
from harness.stored import StoredRecord
from harness.window import Recorded

VERSIONED = ("crankbench", "numpy", "scipy", "casadi", "fmpy", "pyarrow", "pandas")
# Outcomes that depend on the machine of the day: such a case is run again when the campaign is resumed.
UNFINISHED = ("", "crash", "timeout")


def plain(value: Any) -> Any:
    """The value as JSON has it: numbers that are not finite become null, arrays lists, tuples of names mappings."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, tuple) and hasattr(value, "_asdict"):
        return plain(value._asdict())
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value if value is None or isinstance(value, (bool, int, float, str)) else str(value)


def write_json(path: Path, content: Any) -> None:
    """Write JSON at once or not at all."""
    write_whole(path, json.dumps(plain(content), indent=1, ensure_ascii=False, allow_nan=False) + "\n")


def case_folder(folder: Path, key: str) -> Path:
    """Where a case keeps its files."""
    return folder / "cases" / key


def read_case(folder: Path, key: str) -> dict[str, Any]:
    """What case.json says; empty where the case is not finished, or its file is no case.json of that key."""
    path = case_folder(folder, key) / "case.json"
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (FileNotFoundError, json.JSONDecodeError, UnicodeDecodeError):
        return {}
    return found if isinstance(found, dict) and found.get("key") == key else {}


def signals_path(folder: Path, key: str) -> Path:
    """Where a case keeps its signals."""
    return case_folder(folder, key) / "signals.parquet"


def write_case(
    folder: Path, case: Case, record: Record, recorded: Recorded, definitions: Mapping[str, Definition]
) -> None:
    """Keep how a run ended and what its metrics are in case.json, which means done: its signals are kept already.

    Metrics are taken from `recorded`: the record itself, or what is stored of it.
    """
    complete = record.outcome in COMPLETE
    measured = measure(definitions, recorded, case.experiment) if complete else Measured({}, {}, {})
    warnings = [*([record.message] if record.outcome == "warning" else []), *record.tolerated]
    content = {
        **_identity(case),
        "outcome": record.outcome,
        "part": record.part,
        "failed_at": record.failed_at,
        "message": record.message,
        "starts": record.starts,
        "wall": record.wall,
        **_measured(measured),
        "definitions": digest(definitions),
        "warnings": warnings,
        "log": record.log,
        "order": record.order,
        "held": record.held,
        "fmus": record.fmus,
    }
    write_json(case_folder(folder, case.key) / "case.json", content)


def write_failure(
    folder: Path,
    case: Case,
    outcome: str,
    message: str,
    log: Sequence[Mapping[str, Any]] = (),
    part: str = "",
    failed_at: float = math.nan,
) -> None:
    """Keep what is known of a case whose worker did not come back with a record."""
    signals_path(folder, case.key).unlink(missing_ok=True)
    content = {
        **_identity(case),
        "outcome": outcome,
        "part": part,
        "failed_at": failed_at,
        "message": message,
        "log": list(log),
    }
    write_json(case_folder(folder, case.key) / "case.json", content)


def measure_again(folder: Path, case: Case, definitions: Mapping[str, Definition]) -> None:
    """Take a finished case's metrics anew from its signals."""
    content = read_case(folder, case.key)
    if content["outcome"] in COMPLETE:
        record = StoredRecord(signals_path(folder, case.key))
        content |= _measured(measure(definitions, record, case.experiment))
    write_json(case_folder(folder, case.key) / "case.json", {**content, "definitions": digest(definitions)})


def judged(folder: Path, case: Case) -> Judged:
    """What acceptance needs of a case, from case.json: a null value is what `is` says, a null sample infinite."""
    found = read_case(folder, case.key)
    metrics = {
        name: Value(float(entry.get("is", "nan")) if entry["value"] is None else entry["value"], entry["unit"])
        for name, entry in (found.get("metrics") or {}).items()
    }
    samples = {
        name: [math.inf if sample is None else sample for sample in values]
        for name, values in (found.get("samples") or {}).items()
    }
    return Judged(case.key, case.label, case.experiment, str(found.get("outcome", "")), metrics, samples, case.values)


def write_metrics(folder: Path, cases: Iterable[Judged], definitions: Mapping[str, Definition]) -> None:
    """metrics.csv: one row a case and value. `part` is the one that is measured: an estimate's, where there is one."""
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(["case", "experiment", "part", "metric", "value", "unit"])
    for case in cases:
        for name, (value, unit) in case.metrics.items():
            table.writerow([case.key, case.experiment, value_part(definitions, name), name, repr(value), unit])
    write_whole(folder / "metrics.csv", text.getvalue())


def write_acceptance(folder: Path, verdicts: Iterable[Verdict]) -> None:
    """acceptance.json: one entry a criterion."""
    write_json(folder / "acceptance.json", [asdict(verdict) for verdict in verdicts])


def write_campaign(folder: Path, campaign: Campaign) -> None:
    """campaign.json: what was asked for, with what, and how each case ended so far."""
    found = {case.key: read_case(folder, case.key) for case in campaign.cases}
    ended = [content for content in found.values() if content]
    first = next((content for content in ended if content.get("order")), {})
    fmus: dict[str, Any] = {}
    for content in ended:
        fmus = {**(content.get("fmus") or {}), **fmus}
    as_written = campaign.written
    told = meanings(campaign.metrics)
    content = {
        "campaign": campaign.name,
        "description": as_written.get("description", ""),
        "file": str(campaign.file),
        "file_sha256": campaign.file_sha256,
        "versions": {"python": platform.python_version(), **{name: version(name) for name in VERSIONED}},
        "platform": f"{platform.system()} {platform.machine()}",
        "commit": commit(),
        "seeds": sorted({case.scenario.seed for case in campaign.cases}),
        "cases": [
            {
                **_identity(case),
                "outcome": found[case.key].get("outcome", ""),
                "part": found[case.key].get("part", ""),
                "time": found[case.key].get("failed_at"),
                "message": found[case.key].get("message", ""),
            }
            for case in campaign.cases
        ],
        "fmus": fmus,
        "order": first.get("order", []),
        "held": first.get("held", []),
        "experiments": as_written.get("experiments") or {},
        "validation": as_written.get("validation", "warn"),
        "metrics": {name: {**raw, **told[name]} for name, raw in (as_written.get("metrics") or {}).items()},
        **{key: as_written.get(key) for key in ("clock", "parts", "accept", "report")},
    }
    write_json(folder / "campaign.json", content)


def commit() -> str:
    """The commit of the checkout that crankbench runs from, `-dirty` where files differ; empty where it is none."""
    here = Path(__file__).resolve().parent
    if not (here.parent / ".git").exists():
        return ""
    command = ["git", "-C", str(here), "describe", "--always", "--dirty", "--abbrev=40", "--exclude", "*"]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return ""


def _measured(measured: Measured) -> dict[str, Any]:
    """What case.json keeps of the metrics. JSON has no infinity: such a value is null and `is` says which."""
    values = {
        name: {**value._asdict(), **({"is": str(value.value)} if math.isinf(value.value) else {})}
        for name, value in measured.values.items()
    }
    return {"metrics": values, "samples": measured.samples, "matrices": measured.matrices}


def _identity(case: Case) -> dict[str, Any]:
    return {"key": case.key, "label": case.label, "experiment": case.experiment, "values": case.values}
