"""Whatever an FMU does to its process, the campaign and its other cases are unharmed, and nothing is left behind."""

from __future__ import annotations

import csv
import json
import os
import signal
import subprocess
import sys
import time
import uuid
from pathlib import Path

import numpy as np
import pytest
from misbehaving import misbehaving_fmu

from fmus.component import ConfigurationError
from harness.campaign import read_campaign
from harness.record import read_signals
from harness.worker import Limits, Worker, isolated

# Each way to misbehave, the outcome of its case, words of the message, and how many of the 51 rows are kept.
WAYS = {
    "segmentation fault": ("crash", "the signal SIGSEGV, in step", 20),
    "abort": ("crash", "the signal SIGABRT, in step", 20),
    "exit 0": ("crash", "exit code 0, in step", 20),
    "exit 3": ("crash", "exit code 3, in step", 20),
    "kill": ("crash", "the signal SIGKILL, in step", 20),
    "stack overflow": ("crash", "the signal SIGSEGV, in step", 20),
    "thread crashes": ("crash", "the signal SIGSEGV, in step", 20),
    "memory": ("crash", "more memory than its limit of 0.586 GiB, in step", None),
    "hang": ("timeout", "within its limit of 1 s, in step", 20),
    "hang, deaf": ("timeout", "within its limit of 1 s, in step", 20),
    "discard": ("discard", "doing the step", 20),
    "error": ("error", "doing the step", 20),
    "fatal": ("fatal", "doing the step", 20),
    "not a number": ("diverged", "plant.x is nan", 20),
    "infinity": ("diverged", "plant.x is inf", 20),
    "crash in instantiate": ("crash", "the signal SIGSEGV, in instantiate", 0),
    "crash in initialise": ("crash", "the signal SIGSEGV, in initialise", 0),
    "crash in terminate": ("crash", "the signal SIGSEGV, in terminate; all its rows are kept", 51),
    "crash in free": ("crash", "the signal SIGSEGV, in free; all its rows are kept", 51),
    "hang in instantiate": ("timeout", "within its limit of 1 s, in instantiate", 0),
    "hang in initialise": ("timeout", "within its limit of 1 s, in initialise", 0),
    "hang in terminate": ("timeout", "within its limit of 1 s, in terminate; all its rows are kept", 51),
}
# These are a nuisance to others only.
NUISANCES = (
    "flood",
    "interrupts",
    "changes folder",
    "rounds up",
    "child stays",
    "thread crashes later",
)
CAMPAIGN = """\
campaign: misbehaviour
clock: {time: {step: 1 ms, stop: 0.05 s}}
parts:
  speed: {use: source, unit: m/s, sine: {amplitude: 1 m/s, frequency: 20 Hz, mean: 0.5 m/s}}
  plant: {use: well.fmu, wires: {u: speed}}
  sensor: {use: sensor, of: plant.x, noise: {std: 1 mm}}
vary: {"plant.use, seed": [CASES]}
metrics: {error: {rmse: [plant.x, sensor.value], unit: mm}}
limits: {step: 1 s, memory: 600 MiB}
"""


@pytest.fixture(scope="module")
def fmus(tmp_path_factory):
    """A folder with an FMU for each way, and one that behaves."""
    folder = tmp_path_factory.mktemp("fmus")
    return folder, {way: misbehaving_fmu(folder, way).name for way in ("well", *WAYS, *NUISANCES)}


@pytest.fixture
def marked(tmp_path):
    """An environment by which all processes that a test starts are known, with a folder of its own for temporaries."""
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    return {**os.environ, "CRANKBENCH_TEST": uuid.uuid4().hex, "TMPDIR": str(temporary)}


def left_over(environment, patience):
    """The processes with the mark that are still there after so many seconds at most."""
    mark = f"CRANKBENCH_TEST={environment['CRANKBENCH_TEST']}".encode()
    until = time.monotonic() + patience
    while True:
        found = []
        for process in Path("/proc").glob("[0-9]*"):
            try:
                if mark in (process / "environ").read_bytes().split(b"\0"):
                    found.append((process / "cmdline").read_text())
            except OSError:
                continue
        if not found or time.monotonic() > until:
            return found
        time.sleep(0.05)


def campaign_file(fmus, cases, name):
    folder, files = fmus
    listed = ", ".join(f"[{files[way]}, {seed}]" for way, seed in cases)
    file = folder / f"{name}.yaml"
    file.write_text(CAMPAIGN.replace("CASES", listed))
    return file


def run(file, out, environment):
    command = [sys.executable, "-m", "harness", "run", str(file), "--out", str(out), "--jobs", "2", "--json"]
    return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120, check=False)


def cases_of(folder):
    """What campaign.json and metrics.csv say of each case, and its folder, by FMU and seed."""
    with (folder / "metrics.csv").open() as file:
        rows = list(csv.DictReader(file))
    return {
        (one["values"]["plant.use"], int(one["values"]["seed"])): {
            **one,
            "folder": folder / "cases" / one["key"],
            "metrics": {row["metric"]: row["value"] for row in rows if row["case"] == one["key"]},
        }
        for one in json.loads((folder / "campaign.json").read_text())["cases"]
    }


@pytest.mark.skipif(sys.platform != "linux", reason="looks for processes in /proc")
def test_a_campaign_is_unharmed_by_cases_that_misbehave(fmus, tmp_path, marked):
    bad = [(way, seed) for seed, way in enumerate((*WAYS, *NUISANCES), start=1)]
    good = [("well", seed) for seed in range(1, len(bad) + 1)]
    mixed = [case for pair in zip(good, bad, strict=True) for case in pair]
    ended = run(campaign_file(fmus, mixed, "mixed"), tmp_path / "mixed", marked)
    assert left_over(marked, patience=5) == []
    assert list(Path(marked["TMPDIR"]).iterdir()) == []
    assert list((tmp_path / "mixed").rglob(".*")) == []

    assert ended.returncode == 1 and ended.stdout, ended.stderr
    assert len(json.loads(ended.stdout)["outcomes"]) == len(mixed)
    assert "a line of 40 letters" not in ended.stderr
    assert run(campaign_file(fmus, good, "good"), tmp_path / "good", marked).returncode == 0

    cases, alone = cases_of(tmp_path / "mixed"), cases_of(tmp_path / "good")
    for way, seed in good:
        case, other = cases[fmus[1][way], seed], alone[fmus[1][way], seed]
        assert case["outcome"] == "ok", case
        assert (case["folder"] / "signals.parquet").read_bytes() == (other["folder"] / "signals.parquet").read_bytes()
        assert case["metrics"] == other["metrics"] != {}
    for way, seed in bad:
        case = cases[fmus[1][way], seed]
        outcome, words, rows = WAYS.get(way, ("ok", "", 51))
        assert (case["outcome"], words in case["message"]) == (outcome, True), (way, case)
        assert case["part"] == ("plant" if outcome != "ok" else ""), (way, case)
        if rows == 0:
            assert case["time"] == 0.0
        kept = read_signals(case["folder"] / "signals.parquet")
        whole = read_signals(alone["well.fmu", seed]["folder"] / "signals.parquet")
        if rows is None:
            rows = len(kept.time)
            assert 20 < rows < 51
        assert len(kept.time) == rows, way
        if outcome != "ok" and 0 < rows < 51:
            assert case["time"] == whole.time[rows], way
        if way != "rounds up":
            assert kept.names == whole.names
            assert np.array_equal(kept.time, whole.time[:rows]), way
            assert np.array_equal(kept.values, whole.values[:rows]), way
    printed = {way: cases[fmus[1][way], seed]["folder"] / "output.txt" for way, seed in bad}
    flood = printed["flood"].read_text()
    assert flood.count("a line of 40 letters") > 1000
    assert "bytes ...]" in flood and len(flood) < 100_000
    assert "about to abort" in printed["abort"].read_text()
    assert not printed["hang"].exists()


@pytest.mark.skipif(sys.platform != "linux", reason="looks for processes in /proc")
@pytest.mark.parametrize("ending", [signal.SIGINT, signal.SIGKILL])
def test_no_process_outlives_a_campaign_that_is_interrupted_or_killed(fmus, tmp_path, marked, ending):
    file = campaign_file(fmus, [("well", 1), ("hang, deaf", 1), ("child stays", 2), ("hang", 2)], "endless")
    command = [sys.executable, "-m", "harness", "run", str(file), "--out", str(tmp_path / "run"), "--jobs", "2"]
    with subprocess.Popen(
        [*command, "--set", "limits.step=100 s"], env=marked, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        assert [process.stdout.readline()[:5] for _ in range(2)] == ["[1/4]", "[2/4]"]
        assert len(left_over(marked, patience=0)) > 3
        process.send_signal(ending)
        process.wait(10)
    assert process.returncode == (130 if ending == signal.SIGINT else -signal.SIGKILL)
    assert left_over(marked, patience=5) == []


def give(value):
    print("said aloud")
    return value


def refuse():
    raise ValueError("no such thing")


def die(code):
    os._exit(code)


def sleep(seconds):
    time.sleep(seconds)


def eat():
    eaten = []
    while True:
        eaten.append(bytearray(b"x" * 20_000_000))
        time.sleep(0.002)


def whose_process():
    return os.getpid()


def test_an_isolated_function_gives_its_result_what_it_raised_or_how_its_process_ended():
    given = isolated(give, {"a": np.arange(3)})
    assert (given.kind, given.output) == ("result", "said aloud\n")
    assert given.value["a"].tolist() == [0, 1, 2]
    refused = isolated(refuse)
    assert (refused.kind, str(refused.error)) == ("error", "no such thing")
    assert "in refuse" in refused.message
    assert isolated(give, open).kind == "result"
    unfit = isolated(eval, "lambda: 0")
    assert unfit.kind == "error" and "pickle" in str(unfit.error)
    died = isolated(die, 7)
    assert (died.kind, died.message) == ("crash", "its process ended with exit code 7")


def test_an_isolated_function_is_ended_at_its_limits():
    began = time.monotonic()
    late = isolated(sleep, 60, seconds=0.5)
    assert (late.kind, late.message) == ("timeout", "it took longer than its limit of 0.5 s and was ended")
    # Half a second, and what it takes to start a process on a busy machine.
    assert time.monotonic() - began < 20
    full = isolated(eat, memory=300 * 2.0**20)
    assert (full.kind, full.message) == ("crash", "it took more memory than its limit of 0.293 GiB")


def test_a_worker_stays_for_the_next_call_and_is_replaced_when_it_was_lost():
    worker = Worker()
    try:
        first = worker.call(whose_process, limits=Limits())
        second = worker.call(whose_process, limits=Limits())
        worker.call(die, 1, limits=Limits())
        third = worker.call(whose_process, limits=Limits())
    finally:
        worker.close()
    assert first.value == second.value != third.value
    assert (first.first, second.first, third.first) == (True, False, True)


@pytest.mark.parametrize(
    ("limits", "said"),
    [
        ("{memory: 4}", "limits.memory wants an amount like '4 GiB'"),
        ("{memory: 4 Gib}", "limits.memory wants an amount like '4 GiB'"),
        ("{memory: -4 GiB}", "limits.memory wants an amount like '4 GiB'"),
        ("{step: 0 s}", "limits.step wants a time above 0 s"),
        ("{step: 3 m}", "limits.step wants s, got 3 m"),
    ],
)
def test_limits_want_times_and_amounts_of_memory(tmp_path, limits, said):
    file = tmp_path / "campaign.yaml"
    file.write_text(CAMPAIGN.replace("CASES", "[well.fmu, 1]").replace("{step: 1 s, memory: 600 MiB}", limits))
    with pytest.raises(ConfigurationError, match=said.replace("[", r"\[")):
        read_campaign(file)


def test_limits_are_read_in_seconds_and_bytes_and_have_defaults(tmp_path):
    file = tmp_path / "campaign.yaml"
    file.write_text(CAMPAIGN.replace("CASES", "[well.fmu, 1]"))
    assert read_campaign(file).limits == Limits(600.0, 1.0, 600 * 2.0**20)
    assert read_campaign(file, ["limits={case: 5 s, memory: 2 GB}"]).limits == Limits(5.0, 30.0, 2e9)
    assert read_campaign(file, ["limits.memory=512 MiB"]).limits.memory == 2.0**29
