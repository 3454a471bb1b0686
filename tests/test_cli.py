"""The command line: exit codes, what is printed where, and that nothing is written on bad input."""

import errno
import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from harness import runfolder
from harness.cli import main, schema_text

CAMPAIGN = """\
campaign: small
description: a source, measured
clock: {time: {step: 1 ms, stop: 0.2 s}}
parts:
  torque: {use: source, unit: N.m, step: {at: 0.1 s, from: 0 N.m, to: -10 N.m}}
  gauge: {use: sensor, of: torque, noise: {std: 0.1 N.m}}
metrics:
  error: {rmse: [torque.value, gauge.value]}
accept:
  - error < 1 N.m
"""


@pytest.fixture
def crankbench(monkeypatch, capsys):
    """Calls the command line in this process: (exit code, stdout, stderr)."""

    def call(*arguments):
        monkeypatch.setattr(sys, "argv", ["crankbench", *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            main()
        said = capsys.readouterr()
        return ended.value.code or 0, said.out, said.err

    return call


@pytest.fixture
def small(tmp_path):
    """A campaign file."""
    file = tmp_path / "small.yaml"
    file.write_text(CAMPAIGN)
    return file


def test_a_run_ends_with_the_path_of_its_report_and_every_file_of_the_folder(crankbench, small, tmp_path):
    code, out, _ = crankbench("run", small, "--out", tmp_path / "run", "--jobs", 1)
    assert code == 0
    assert out.splitlines() == [
        "[1/1] as declared  ok",
        "1 of 1 cases ran to their end",
        "pass  error < 1 N.m",
        str(tmp_path / "run" / "report.html"),
    ]
    (key,) = os.listdir(tmp_path / "run" / "cases")
    files = {str(file.relative_to(tmp_path / "run")) for file in (tmp_path / "run").rglob("*") if file.is_file()}
    wanted = {"campaign.json", "metrics.csv", "acceptance.json", "report.html"}
    assert files == wanted | {f"cases/{key}/case.json", f"cases/{key}/signals.parquet"}


def test_an_impossible_bound_ends_with_1_and_still_writes_the_report(crankbench, small, tmp_path):
    code, out, _ = crankbench("run", small, "--out", tmp_path / "run", "--set", "accept=[error < 1e-9 N.m]")
    assert code == 1
    assert "FAIL  error < 1e-9 N.m  (0." in out
    assert Path(out.splitlines()[-1]).is_file()


def test_a_disk_that_takes_nothing_more_ends_with_1_and_the_name_of_the_file(crankbench, small, tmp_path, monkeypatch):
    def full(path, content):
        raise OSError(errno.ENOSPC, "No space left on device", str(path))

    monkeypatch.setattr(runfolder, "write_whole", full)
    code, _, err = crankbench("run", small, "--out", tmp_path / "run")
    assert code == 1
    assert err == f"[Errno {errno.ENOSPC}] No space left on device: '{tmp_path / 'run' / 'campaign.json'}'\n"


def test_the_folder_of_a_run_has_the_name_of_its_campaign_where_none_is_given(crankbench, small, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, out, _ = crankbench("run", small.name)
    assert (code, out.splitlines()[-1]) == (0, str(Path("runs", "small", "report.html")))


def test_a_run_in_json_says_it_all_on_stdout_and_its_progress_on_stderr(crankbench, small, tmp_path):
    code, out, err = crankbench("run", small, "--out", tmp_path / "run", "--json")
    found = json.loads(out)
    assert code == 0
    assert (found["accepted"], found["outcomes"]) == (True, {"as declared": "ok"})
    assert [one["text"] for one in found["criteria"]] == ["error < 1 N.m"]
    assert "[1/1] as declared  ok" in err


def test_the_report_is_written_again_from_the_records(crankbench, small, tmp_path):
    crankbench("run", small, "--out", tmp_path / "run")
    before = (tmp_path / "run" / "report.html").read_bytes()
    (tmp_path / "run" / "report.html").unlink()
    code, out, _ = crankbench("report", tmp_path / "run")
    assert (code, out.strip()) == (0, str(tmp_path / "run" / "report.html"))
    assert (tmp_path / "run" / "report.html").read_bytes() == before


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["run", "no-such-campaign"], "no built-in campaign is named 'no-such-campaign'"),
        (["run", "no.yaml"], "no campaign file 'no.yaml'"),
        (["run"], "Missing argument"),
        (["run", "SMALL", "--jobs", "0"], "jobs"),
        (["run", "SMALL", "--set", "gauge.nois.std=1"], "unknown key 'nois' in parts.gauge; did you mean 'noise'?"),
        (["run", "SMALL", "--set", "gauge"], "wants path=value"),
        (["run", "SMALL", "--out", "SMALL"], "--out wants a folder, got the file"),
        (["rnu", "SMALL"], "No such command"),
        (["report", "nowhere"], "nowhere is no run folder"),
        (["inspect", "no.fmu"], "no FMU file 'no.fmu'"),
        (["build", "drivelin", "--out", "d.fmu"], "no model is named 'drivelin'; did you mean 'driveline'?"),
        (["build", "driveline", "--out", "d.zip"], "wants a file that ends in .fmu, got d.zip"),
        (["build", "driveline", "--out", "d.fmu", "--fmi", "1"], "fmi"),
        (["build", "driveline", "--out", "d.fmu", "--platforms", "vax"], "no platform is named 'vax'"),
        (
            ["build", "driveline", "--out", "d.fmu", "--with", "kk=1 N.m/rad"],
            "no parameter or start value is named 'kk'",
        ),
        (["build", "driveline", "--out", "d.fmu", "--with", "k=1 s"], "wants N.m/rad, got 1 s"),
        (["build", "driveline", "--out", "d.fmu", "--with", "k"], "wants name=value"),
        (["build", "fmus.units", "--out", "d.fmu"], "wants a Model or a function that makes one"),
    ],
)
def test_misuse_ends_with_2_says_why_and_writes_nothing(crankbench, small, tmp_path, monkeypatch, arguments, said):
    monkeypatch.chdir(tmp_path)
    code, out, err = crankbench(*(small.name if argument == "SMALL" else argument for argument in arguments))
    assert (code, out) == (2, "")
    # A terminal's box around usage errors breaks lines.
    assert said in " ".join(err.replace("│", " ").split())
    assert os.listdir(tmp_path) == ["small.yaml"]


def test_every_problem_of_a_file_is_printed_with_its_place(crankbench, tmp_path):
    file = tmp_path / "bad.yaml"
    file.write_text(CAMPAIGN.replace("noise:", "nois:").replace("step: 1 ms", "steps: 1 ms"))
    code, _, err = crankbench("run", file, "--out", tmp_path / "run")
    assert code == 2
    assert err.splitlines() == [
        f"{file}:3:9: clock.time wants the key 'step'",
        f"{file}:3:16: unknown key 'steps' in clock.time; did you mean 'step'?",
        f"{file}:6:36: unknown key 'nois' in parts.gauge; did you mean 'noise'?",
    ]


@pytest.mark.parametrize(
    "command", ["campaigns", "run", "report", "compare", "build", "inspect", "check", "doctor", "schema"]
)
def test_every_command_explains_itself(crankbench, command):
    code, out, _ = crankbench(command, "--help")
    assert code == 0
    assert "Usage" in out


def test_the_built_in_campaigns_are_listed_with_a_line_on_each(crankbench):
    _, as_json, _ = crankbench("campaigns", "--json")
    listed = json.loads(as_json)
    _, text, _ = crankbench("campaigns")
    assert [line.split()[0] for line in text.splitlines()] == [one["name"] for one in listed]
    assert all(one["description"] in text for one in listed)


def test_a_built_model_can_be_inspected(crankbench, tmp_path):
    path = tmp_path / "d.fmu"
    code, out, _ = crankbench("build", "driveline", "--out", path, "--with", "k=2 kN.m/rad")
    assert (code, out.strip()) == (0, str(path))
    code, out, _ = crankbench("inspect", path, "--json")
    found = json.loads(out)
    assert code == 0
    assert {"fmi_version", "kinds", "tool", "platforms", "variables", "capabilities", "runnable", "reasons"} <= set(
        found
    )
    assert (found["fmi_version"], found["runnable"], found["reasons"]) == ("2.0", True, [])
    stiffness = next(variable for variable in found["variables"] if variable["name"] == "k")
    assert (stiffness["causality"], stiffness["unit"], float(stiffness["start"])) == ("parameter", "N.m/rad", 2000.0)
    code, out, _ = crankbench("inspect", path)
    assert code == 0
    assert "theta_e" in out and out.splitlines()[-1] == "runnable"


def test_a_model_is_built_for_fmi_3(crankbench, tmp_path):
    code, _, _ = crankbench("build", "fmus.plants.driveline:MODEL", "--out", tmp_path / "d.fmu", "--fmi", 3)
    assert code == 0
    with zipfile.ZipFile(tmp_path / "d.fmu") as archive:
        assert b'fmiVersion="3.0"' in archive.read("modelDescription.xml")


def test_the_doctor_names_the_compiler_and_the_cache(crankbench):
    code, out, _ = crankbench("doctor", "--json")
    found = json.loads(out)
    assert (code, found["problems"]) == (0, [])
    assert found["compiler"] and found["versions"]["crankbench"]
    assert Path(found["cache"]["folder"]).is_dir()


def test_the_doctor_ends_with_2_where_the_compiler_asked_for_is_missing(crankbench, monkeypatch):
    monkeypatch.setenv("CRANKBENCH_CC", "no-such-compiler")
    code, out, _ = crankbench("doctor")
    assert code == 2
    assert "no-such-compiler" in out


def test_the_schema_is_printed_as_published(crankbench):
    _, out, _ = crankbench("schema")
    assert out == schema_text()
    assert json.loads(out)["additionalProperties"] is False


def test_the_module_is_the_same_command():
    done = subprocess.run([sys.executable, "-m", "harness", "--version"], capture_output=True, text=True, check=True)
    assert done.stdout.strip()


def test_a_model_that_cannot_be_traced_is_built_with_python_inside_on_request(crankbench, tmp_path):
    out = tmp_path / "pendulum.fmu"
    code, _, said = crankbench("build", "tests.test_python_export:PENDULUM", "--out", out)
    assert code == 2
    assert "np.sin for math.sin" in said and "--python" in said
    assert not out.exists()
    code, printed, _ = crankbench("build", "tests.test_python_export:PENDULUM", "--python", "--out", out)
    assert (code, printed.strip()) == (0, str(out))
    assert json.loads(crankbench("inspect", out, "--json")[1])["capabilities"]["needsExecutionTool"] is True


def test_threads_of_linear_algebra_are_one_before_numpy_counts_them_unless_they_are_asked_for():
    text = (
        "import os, sys, harness.__main__ as entry\n"
        "assert 'numpy' not in sys.modules\n"
        "sys.argv = ['crankbench', '--help']\n"
        "try:\n    entry.main()\n"
        "except SystemExit:\n    pass\n"
        "print([os.environ[name] for name in entry.THREADS])\n"
    )
    clear = {key: value for key, value in os.environ.items() if not key.endswith("NUM_THREADS")}
    for asked, expected in (({}, "['1', '1', '1']"), ({"OPENBLAS_NUM_THREADS": "2"}, "['1', '2', '1']")):
        ended = subprocess.run(
            [sys.executable, "-c", text], env={**clear, **asked}, capture_output=True, text=True, check=True
        )
        assert ended.stdout.splitlines()[-1] == expected
