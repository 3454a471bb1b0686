"""Cases run apart from each other, are kept, and give the same bytes however they are run."""

import csv
import json
import signal
import subprocess
import sys
import time

import pytest

from fmus.component import ConfigurationError
from harness.campaign import read_campaign
from harness.cases import execute

# A plant in Python that can be told to fail, beside the campaign as a user's own module would be.
MODULE = """
import os, signal, time
import numpy as np
from fmus.component import Signal

class Plant:
    role = "plant"
    inputs = (Signal("u", "N.m"),)
    outputs = (Signal("x", "rad"),)
    feedthrough = frozenset()

    def __init__(self, fate):
        self.fate = fate

    def start(self, t0, u):
        self.x = 0.0
        return np.array([self.x])

    def step(self, t, h, u):
        if t > 0.05:
            if self.fate == "crash":
                os.kill(os.getpid(), signal.SIGKILL)
            if self.fate == "exit":
                os._exit(7)
            if self.fate == "hang":
                time.sleep(60)
            if self.fate == "raise":
                raise ZeroDivisionError("no torque")
            if self.fate == "diverge":
                self.x = np.nan
        self.x += h * u[0]
        return np.array([self.x])

    def native(self):
        return None

    def close(self):
        pass

def make(fate: str = "none"):
    return Plant(fate)
"""

CAMPAIGN = """\
campaign: fates
clock: {time: {step: 1 ms, stop: 0.1 s}}
seed: 3
parts:
  torque: {use: source, unit: N.m, step: {at: 0.02 s, from: 0 N.m, to: 1 N.m}}
  plant: {use: a_plant_of_the_tests, wires: {u: torque}}
  sensor: {use: sensor, of: plant.x, noise: {std: 1 mrad}}
vary: {plant.fate: [none, %s]}
metrics:
  error: {rmse: [plant.x, sensor.value], unit: mrad}
accept:
  - error < 2 mrad
  - mean(error) < 2 mrad
limits: {case: 20 s}
"""


@pytest.fixture(scope="session")
def rig(tmp_path_factory):
    """A folder with a user's module."""
    folder = tmp_path_factory.mktemp("rig")
    (folder / "a_plant_of_the_tests.py").write_text(MODULE)
    return folder


def campaign(rig, fate="none2", *overrides, text=CAMPAIGN):
    file = rig / "fates.yaml"
    file.write_text(text % fate if "%s" in text else text)
    return read_campaign(file, overrides)


def run(campaign, folder, jobs=2, finished="kept"):
    told = []
    result = execute(campaign, folder, jobs, told.append, finished)
    return result, told


def case_json(folder, label):
    files = (json.loads(file.read_text()) for file in folder.glob("cases/*/case.json"))
    return next(content for content in files if content["label"] == label)


def same_bytes(first, second):
    names = [file.relative_to(first) for file in first.rglob("*") if file.suffix in (".parquet", ".csv")]
    assert len(names) > 1
    names.append("acceptance.json")
    return all((first / name).read_bytes() == (second / name).read_bytes() for name in names)


@pytest.mark.parametrize(
    ("fate", "outcome", "said"),
    [
        ("crash", "crash", "its process ended with the signal SIGKILL"),
        ("exit", "crash", "its process ended with exit code 7"),
        ("raise", "error", "no torque"),
        ("diverge", "diverged", "plant.x is nan"),
    ],
)
def test_a_case_that_fails_takes_no_other_with_it(rig, tmp_path, fate, outcome, said):
    result, told = run(campaign(rig, fate), tmp_path / "run")
    assert result.outcomes == {"plant.fate = none": "ok", f"plant.fate = {fate}": outcome}
    assert sorted(ended.outcome for ended in told) == sorted(["ok", outcome])
    found = case_json(tmp_path / "run", f"plant.fate = {fate}")
    assert said in found["message"]
    assert not result.accepted
    assert all(not verdict.passed for verdict in result.verdicts)
    assert f"plant.fate = {fate} ended with {outcome}" in result.verdicts[0].reason


def test_a_case_that_diverges_keeps_its_rows_and_says_when(rig, tmp_path):
    run(campaign(rig, "diverge"), tmp_path)
    found = case_json(tmp_path, "plant.fate = diverge")
    assert (found["part"], found["failed_at"]) == ("plant", pytest.approx(0.052))
    assert found["metrics"] == {}
    assert (tmp_path / "cases" / found["key"] / "signals.parquet").is_file()
    listed = json.loads((tmp_path / "campaign.json").read_text())["cases"]
    assert [(one["outcome"], one["part"], one["time"]) for one in listed][1] == (
        "diverged",
        "plant",
        found["failed_at"],
    )


def test_a_case_that_hangs_is_ended_at_its_limit(rig, tmp_path):
    began = time.monotonic()
    result, _ = run(campaign(rig, "hang", "limits.case=2 s"), tmp_path)
    assert result.outcomes["plant.fate = hang"] == "timeout"
    assert "took longer than its limit of 2 s" in case_json(tmp_path, "plant.fate = hang")["message"]
    # Far less than the minute it would sleep; the rest is starting processes on a busy machine.
    assert time.monotonic() - began < 40


def test_serial_parallel_and_resumed_runs_give_the_same_bytes(rig, tmp_path):
    asked = campaign(rig, text=CAMPAIGN.replace("{plant.fate: [none, %s]}", "{seed: 1..4}"))
    run(asked, tmp_path / "serial", jobs=1)
    run(asked, tmp_path / "parallel", jobs=2)
    run(asked, tmp_path / "resumed", jobs=2)
    key = asked.cases[2].key
    (tmp_path / "resumed" / "cases" / key / "case.json").unlink()
    (tmp_path / "resumed" / "cases" / key / "signals.parquet").write_bytes(b"half a file")
    _, told = run(asked, tmp_path / "resumed", jobs=2)
    assert [(ended.case.label, ended.reused) for ended in told] == [
        ("seed = 1", True),
        ("seed = 2", True),
        ("seed = 4", True),
        ("seed = 3", False),
    ]
    assert same_bytes(tmp_path / "serial", tmp_path / "parallel")
    assert same_bytes(tmp_path / "serial", tmp_path / "resumed")


def test_a_finished_case_is_kept_and_run_again_only_on_request(rig, tmp_path):
    asked = campaign(rig)
    _, first = run(asked, tmp_path)
    _, second = run(asked, tmp_path)
    _, third = run(asked, tmp_path, finished="run again")
    assert [[ended.reused for ended in told] for told in (first, second, third)] == [
        [False, False],
        [True, True],
        [False, False],
    ]


def test_a_crashed_case_is_run_again(rig, tmp_path):
    run(campaign(rig, "crash"), tmp_path)
    _, told = run(campaign(rig, "crash"), tmp_path)
    assert [(ended.outcome, ended.reused) for ended in told] == [("ok", True), ("crash", False)]


def test_another_definition_is_measured_from_the_kept_signals(rig, tmp_path):
    def metric():
        with (tmp_path / "metrics.csv").open() as file:
            return [(row["metric"], float(row["value"]), row["unit"]) for row in csv.DictReader(file)]

    run(campaign(rig), tmp_path)
    before = metric()
    text = CAMPAIGN.replace("unit: mrad}", "unit: rad}").replace("none, %s", "none, none2")
    _, told = run(campaign(rig, text=text), tmp_path)
    assert all(ended.reused for ended in told)
    assert metric() == [(name, pytest.approx(value / 1000), "rad") for name, value, _ in before]
    fresh = tmp_path / "fresh"
    run(campaign(rig, text=text), fresh)
    assert (fresh / "metrics.csv").read_bytes() == (tmp_path / "metrics.csv").read_bytes()


def test_an_impossible_bound_is_not_accepted_and_says_value_and_bound(rig, tmp_path):
    result, _ = run(campaign(rig, "none2", "accept=[error < 1e-9 mrad]"), tmp_path)
    assert not result.accepted
    (entry,) = json.loads((tmp_path / "acceptance.json").read_text())
    assert (entry["text"], entry["passed"], entry["bound"], entry["unit"]) == ("error < 1e-9 mrad", False, 1e-9, "mrad")
    # 101 samples of noise with 1 mrad: six standard errors of the RMSE are 0.42 mrad.
    assert entry["value"] == pytest.approx(1.0, abs=0.42)
    assert entry["case"] in {case.key for case in campaign(rig).cases}


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("wires: {u: torque}", "wires: {u: torqu}", "torque"),
        ("[plant.x, sensor.value]", "[plant.y, sensor.value]", "no recorded signal is named 'plant.y'"),
        ("error < 2 mrad\n  - m", "error < 2 rpm\n  - m", "error is in mrad, the bound in rpm"),
        ("use: a_plant_of_the_tests", "use: a_plant_of_the_test", "module"),
        ("step: 1 ms", "step: -1 ms", "positive step"),
        ("unit: N.m", "unit: rad/s", "N.m"),
    ],
)
def test_a_wrong_configuration_writes_nothing(rig, tmp_path, old, new, said):
    assert old in CAMPAIGN
    with pytest.raises(ConfigurationError) as error:
        run(campaign(rig, text=CAMPAIGN.replace(old, new).replace("%s", "none2")), tmp_path / "run")
    assert any(said in problem.message and problem.line for problem in error.value.problems)
    assert not (tmp_path / "run").exists()


def test_a_wrong_case_among_right_ones_is_an_error_of_its_own(rig, tmp_path):
    text = CAMPAIGN.replace("{plant.fate: [none, %s]}", "{torque.unit: [N.m, rpm]}")
    result, _ = run(campaign(rig, text=text), tmp_path)
    assert result.outcomes == {"torque.unit = N.m": "ok", "torque.unit = rpm": "error"}


def test_an_interrupted_run_keeps_what_was_finished(rig, tmp_path):
    file = rig / "slow.yaml"
    file.write_text(CAMPAIGN % "hang")
    command = [sys.executable, "-m", "harness", "run", str(file), "--out", str(tmp_path / "run"), "--jobs", "1"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None and process.stderr is not None
        assert process.stdout.readline().endswith("plant.fate = none  ok\n")
        process.send_signal(signal.SIGINT)
        said = process.stderr.read()
    assert process.returncode == 130
    assert "what was finished is kept" in said
    outcomes = [case["outcome"] for case in json.loads((tmp_path / "run" / "campaign.json").read_text())["cases"]]
    assert outcomes == ["ok", ""]
    assert not (tmp_path / "run" / "acceptance.json").exists()
