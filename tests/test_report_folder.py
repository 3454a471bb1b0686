"""A run folder is read as the contract says, a damaged one is named; holds the synthetic run of other tests too."""

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from reports.folder import RunFolderError, read_run

RPM = 2 * math.pi / 60
UNITS = {"theta_e": ("rad", "rad"), "omega_c": ("rad/s", "rpm"), "location": ("1", "1"), "r_low": ("rad/s", "rpm")}
SIGNALS = [
    "plant.theta_e",
    "plant.omega_c",
    "plant.location",
    "hybrid.theta_e",
    "hybrid.omega_c",
    "hybrid.location",
    "hybrid.r_low",
    "open_loop.theta_e",
    "open_loop.omega_c",
]
DECLARED: dict[str, Any] = {
    "rmse_hybrid": {"rmse": {"pairs": [["plant.theta_e", "hybrid.theta_e"]]}, "after": "0.5 s", "unit": "rad"},
    "rmse_open_loop": {"rmse": {"pairs": [["plant.theta_e", "open_loop.theta_e"]]}, "after": "0.5 s", "unit": "rad"},
    "speed_hybrid": {"max_error": {"pairs": [["plant.omega_c", "hybrid.omega_c"]]}, "unit": "rpm"},
    "speed_open_loop": {"max_error": {"pairs": [["plant.omega_c", "open_loop.omega_c"]]}, "unit": "rpm"},
    "located": {
        "detection": {"pair": ["plant.location", "hybrid.location"]},
        "meaning": "How fast a location is found.",
    },
}
# As campaign.json keeps them: with the kind, its version and what is compared.
METRICS = {
    name: {**declared, "kind": kind, "version": 1, "compares": arguments.get("pairs") or [arguments["pair"]]}
    for name, declared in DECLARED.items()
    for kind, arguments in declared.items()
    if isinstance(arguments, dict)
}
REPORT: dict[str, Any] = {
    "observers": {
        "hybrid": {"title": "Hybrid observer", "metrics": ["rmse_hybrid", "speed_hybrid", "located"]},
        "open_loop": {"title": "Open loop", "metrics": ["rmse_open_loop", "speed_open_loop"]},
    },
    "figures": [
        {
            "title": "Figure 6",
            "experiment": "figure_6",
            "traces": [
                ["plant.theta_e", "hybrid.theta_e", "open_loop.theta_e"],
                ["plant.omega_c", "hybrid.omega_c"],
                ["hybrid.r_low"],
                ["plant.location", "hybrid.location"],
            ],
            "lines": {"-0.010 rad": "lower threshold", "-40 mrad": "upper threshold"},
        }
    ],
    "published": [
        {"what": "settles in", "published": "location 2", "metric": "rmse_hybrid", "experiment": "figure_6"},
        {"what": "not measured", "published": "yes", "metric": "no_such_metric"},
    ],
}
CRITERIA: list[dict[str, Any]] = [
    {"text": "rmse_hybrid < 0.01 rad", "experiment": "", "value": 0.0021, "bound": 0.01, "unit": "rad", "passed": True},
    {
        "text": "p95(located.delay) < 20 ms",
        "experiment": "figure_6",
        "value": 12.0,
        "bound": 20,
        "unit": "ms",
        "passed": True,
    },
]


def build_run(
    folder: Path, *, seeds: int = 3, rows: int = 2001, failing: Sequence[str] = (), criteria: Any = None
) -> Path:
    """A run folder as the contract has it: two experiments and `seeds` seeds; `failing` names cases that diverged."""
    cases = []
    for experiment, values in (
        ("figure_6", {}),
        ("mismatch", {"plant.k": "1650 N.m/rad"}),
        ("mismatch", {"plant.k": "1800 N.m/rad"}),
    ):
        for seed in range(1, seeds + 1):
            varied = {**values, "seed": str(seed)}
            label = f"{experiment}: " + ", ".join(f"{path} = {text}" for path, text in varied.items())
            key = f"{len(cases):04x}{'0' * 12}"
            failed = label in failing
            ending: dict[str, Any] = {"outcome": "diverged" if failed else "ok", "part": "open_loop" if failed else ""}
            ending |= {"message": "open_loop.theta_e is nan" if failed else ""}
            identity = {"key": key, "label": label, "experiment": experiment, "values": varied}
            write_case(
                folder, identity, ending, seed, scale=1.0 + 8.0 * len(values), rows=rows // 2 if failed else rows
            )
            cases.append({**identity, **ending, "time": 2.0 if failed else None})
    (folder / "campaign.json").write_text(json.dumps(campaign(cases, seeds)))
    (folder / "acceptance.json").write_text(json.dumps(with_worst(CRITERIA if criteria is None else criteria, cases)))
    return folder


def campaign(cases: Sequence[Mapping[str, Any]], seeds: int) -> dict[str, Any]:
    """campaign.json of the synthetic run."""
    return {
        "campaign": "driveline",
        "description": "A synthetic run <with markup> & more",
        "file": "driveline.yaml",
        "file_sha256": "ab" * 32,
        "versions": {"crankbench": "0.1.0", "numpy": "2.4"},
        "platform": "linux64",
        "commit": "0123456789abcdef",
        "experiments": {
            "figure_6": {"description": "The published step", "set": {"encoder.faults.0.to": "3.25 s"}},
            "mismatch": {"vary": {"plant.k": ["1650 N.m/rad", "1800 N.m/rad"]}},
        },
        "seeds": list(range(1, seeds + 1)),
        "cases": list(cases),
        "fmus": {"plant": {"sha256": "cd" * 32, "tool": "crankbench 0.1.0", "fmi_version": "2.0"}},
        "clock": {"time": {"step": "2 ms", "stop": "4 s"}},
        "parts": {
            "plant": {"use": "fmus.plants.driveline"},
            "encoder": {
                "use": "sensor",
                "of": "plant.y",
                "faults": [{"bias": "5 rpm", "from": "3 s", "to": "3500 ms"}],
            },
        },
        "metrics": METRICS,
        "accept": [criterion["text"] for criterion in CRITERIA],
        "report": REPORT,
        "order": ["torque", "plant", "encoder", "hybrid", "open_loop"],
        "held": [],
    }


def with_worst(criteria: Any, cases: Sequence[Mapping[str, Any]]) -> Any:
    """The criteria with the first case as the worst."""
    return (
        [{"case": cases[0]["key"], "reason": "", **criterion} for criterion in criteria]
        if isinstance(criteria, list)
        else criteria
    )


def write_case(
    folder: Path, identity: Mapping[str, Any], ending: Mapping[str, Any], seed: int, scale: float, rows: int
) -> None:
    """One case: signals.parquet of a step at 2 s, and case.json."""
    time = 0.002 * np.arange(rows)
    noise = np.random.default_rng(seed).normal(size=(4, rows))
    theta = -0.055 * (1 - np.exp(-np.maximum(time - 2.0, 0) / 0.3)) * np.cos(5 * np.maximum(time - 2.0, 0))
    speed = -2.0 * np.maximum(time - 2.0, 0)
    location = np.where(theta > -0.010, 1.0, np.where(theta > -0.040, 2.0, 3.0))
    values = {
        "plant.theta_e": theta,
        "plant.omega_c": speed,
        "plant.location": location,
        "hybrid.theta_e": theta + 2e-4 * scale * noise[0],
        "hybrid.omega_c": speed + 0.05 * noise[1],
        "hybrid.location": np.concatenate([location[:1].repeat(5), location])[:rows],
        "hybrid.r_low": 0.02 * noise[2],
        "open_loop.theta_e": 0.9 * theta + 0.002 * scale,
        "open_loop.omega_c": speed + 0.3 * scale + 0.05 * noise[3],
    }
    path = folder / "cases" / identity["key"]
    path.mkdir(parents=True)
    fields = [field("time", "s", "s")] + [field(name, *UNITS[name.split(".")[1]]) for name in SIGNALS]
    pq.write_table(
        pa.table([time, *(values[name] for name in SIGNALS)], schema=pa.schema(fields)), path / "signals.parquet"
    )
    case = {
        **identity,
        **ending,
        "failed_at": 2.0 if ending["outcome"] != "ok" else None,
        "starts": {"plant": {"k": 1500.0, "solver.method": 1, "solver.step": 0.001}, "hybrid": {"tau": 0.125}},
        "wall": {"total": 0.25, "plant": 0.1},
        "metrics": {} if ending["outcome"] != "ok" else measured(values, scale),
        "samples": {} if ending["outcome"] != "ok" else {"located.delay": [0.010, 0.012, None if seed == 2 else 0.014]},
        "warnings": ["the plant's FMU names no unit for tau"],
        "log": [],
        "order": ["torque", "plant", "encoder", "hybrid", "open_loop"],
        "held": [],
        "fmus": {},
    }
    (path / "case.json").write_text(json.dumps(case))


def measured(values: Mapping[str, np.ndarray], scale: float) -> dict[str, Any]:
    """The metrics of a case; written by hand so that the report can be seen to take them as they are."""
    return {
        "rmse_hybrid": {"value": 2e-4 * scale, "unit": "rad"},
        "rmse_open_loop": {"value": 0.0035 * scale, "unit": "rad"},
        "speed_hybrid": {"value": 1.5, "unit": "rpm"},
        "speed_open_loop": {"value": 3.0 * scale, "unit": "rpm"},
        "located.delay_median": {"value": 0.012, "unit": "s"},
        "located.delay_p95": {"value": 0.014, "unit": "s"},
        "located.changes": {"value": 3, "unit": "1"},
        "located.missed": {"value": 0, "unit": "1"},
        "located.false_alarms_per_min": {"value": 0.5, "unit": "1/min"},
        "located.accuracy": {"value": 0.98, "unit": "1"},
    }


def field(name: str, unit: str, shown: str) -> pa.Field:
    """A column with the metadata of the contract."""
    kind = "integer" if name.endswith("location") else "real"
    return pa.field(name, pa.float64(), metadata={"unit": unit, "display_unit": shown, "kind": kind, "description": ""})


def test_a_run_is_read_with_its_cases_metrics_and_criteria(tmp_path):
    run = read_run(build_run(tmp_path))
    assert (run.name, len(run.cases), len(run.criteria or ())) == ("driveline", 9, 2)
    assert run.accepted
    assert run.cases[0].metrics["rmse_hybrid"].value == 2e-4
    assert run.cases[3].scenario == "mismatch: plant.k = 1650 N.m/rad"


def test_a_metric_is_a_series_over_the_cases_in_which_a_failed_case_stays_as_a_gap(tmp_path):
    run = read_run(build_run(tmp_path, failing=["figure_6: seed = 2"]))
    series = run.metric("rmse_hybrid", experiment="figure_6")
    assert list(series.index) == ["figure_6: seed = 1", "figure_6: seed = 2", "figure_6: seed = 3"]
    assert series.attrs["unit"] == "rad"
    assert math.isnan(series.iloc[1]) and series.max() == 2e-4


def test_signals_come_in_si_by_column(tmp_path):
    frame = read_run(build_run(tmp_path)).signals("figure_6: seed = 1", ["plant.omega_c"])
    assert list(frame.columns) == ["plant.omega_c"]
    assert frame["plant.omega_c"].iloc[-1] == -4.0
    assert frame.index[-1] == 4.0


def test_unknown_names_are_answered_with_the_nearest(tmp_path):
    run = read_run(build_run(tmp_path))
    with pytest.raises(KeyError, match="rmse_hybrid"):
        run.metric("rmse_hybird")
    with pytest.raises(KeyError, match="figure_6"):
        run.metric("rmse_hybrid", experiment="figure6")
    with pytest.raises(KeyError, match=r"plant\.theta_e"):
        run.signals(run.cases[0], ["plant.theta"])


def test_a_case_without_case_json_is_missing_and_the_run_not_accepted(tmp_path):
    run = read_run(build_run(tmp_path))
    (tmp_path / "cases" / run.cases[4].key / "case.json").unlink()
    again = read_run(tmp_path)
    assert [case.label for case in again.missing] == [run.cases[4].label]
    assert not again.accepted


def test_a_folder_without_a_campaign_is_named_with_what_is_in_it(tmp_path):
    with pytest.raises(RunFolderError, match="nothing there"):
        read_run(tmp_path / "nowhere")
    (tmp_path / "notes.txt").write_text("hello")
    with pytest.raises(RunFolderError, match=r"wants campaign\.json in a run folder, got notes\.txt"):
        read_run(tmp_path)


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("campaign.json", "{", r"campaign\.json: wants JSON"),
        ("campaign.json", "[]", "wants an object"),
        ("campaign.json", '{"campaign": "x"}', "wants 'cases' as a list, got nothing"),
        ("campaign.json", '{"campaign": "x", "cases": [3]}', "a case wants an object with 'key', got 3"),
        ("acceptance.json", "{}", r"acceptance\.json: wants a list"),
        ("acceptance.json", '[{"text": "a < 1"}]', "criterion 1 wants an object with 'text' and 'passed'"),
        ("cases/0000000000000000/case.json", '{"metrics": {"a": 3}}', "metric a wants {value, unit}, got 3"),
        (
            "cases/0000000000000000/case.json",
            '{"matrices": {"q": {"classes": ["a", "b"], "counts": [[1, 2]]}}}',
            "matrix q wants {classes, counts}, a row and a column a class",
        ),
        ("cases/0000000000000000/case.json", '{"key": "other"}', 'wants key 0000000000000000, got "other"'),
    ],
)
def test_a_damaged_file_is_named_with_what_was_wanted(tmp_path, file, content, message):
    build_run(tmp_path)
    (tmp_path / file).write_text(content)
    with pytest.raises(RunFolderError, match=message):
        read_run(tmp_path)


def test_a_delay_that_json_cannot_hold_is_infinite_and_a_metric_that_does_not_apply_is_nan(tmp_path):
    run = read_run(build_run(tmp_path))
    assert run.cases[1].samples["located.delay"][-1] == math.inf
    path = tmp_path / "cases" / run.cases[1].key / "case.json"
    case = json.loads(path.read_text())
    case["metrics"]["located.delay_p95"] |= {"value": None, "is": "inf"}
    case["metrics"]["rmse_hybrid"]["value"] = None
    path.write_text(json.dumps(case))
    metrics = read_run(tmp_path).cases[1].metrics
    assert metrics["located.delay_p95"].value == math.inf
    assert math.isnan(metrics["rmse_hybrid"].value)
