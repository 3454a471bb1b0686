"""`crankbench check`: each probe is passed by a sound FMU and failed, with evidence, by one that lies about itself."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from deceiver import deceiver, faults
from third_party import OPENMODELICA, pythonfmu3_fmu, pythonfmu_fmu, reference_fmu, third_party_fmu

from fmus.export import cached_fmu
from fmus.plants import driveline
from harness.checking import NAMES, Checked, check, flags
from harness.cli import main

# Enough for any probe of a sound FMU here; what hangs is waited for this long.
SECONDS = 3.0
# What each way of failing shows in; `flags` where a capability was declared.
SHOWN_BY = {
    "NONE": set(),
    "CRASHES_WHEN_WRITTEN": {"serialise", "flags"},
    "HANGS_IN_RESET": {"reset"},
    "FORGETS_WHEN_TAKEN_BACK": {"rollback", "serialise", "serialise_new_process", "flags"},
    "DERIVES_WRONGLY": {"directional_derivative", "flags"},
    "TAKES_ONE_STEP_LENGTH": {"variable_step", "flags"},
    "SHARES_ITS_STATE": {"instantiate_twice"},
    "NEVER_TWICE_THE_SAME": {"deterministic", "instantiate_twice"},
    "NOT_A_NUMBER": {"finite"},
    "KEEPS_ITS_STATE_IN_RESET": {"reset"},
    "WRITES_AN_ADDRESS": {"serialise_new_process", "flags"},
    "IGNORES_THE_STEP_LENGTH": {"variable_step", "flags"},
    "HANGS_IN_INSTANTIATE": {"load"},
    "EXITS_IN_STEP": set(NAMES) - {"load", "serialise_new_process", "directional_derivative", "adjoint_derivative"},
    "CANNOT_BE_KEPT": {"rollback", "serialise", "flags"},
    "LENDS_WHAT_IT_KEEPS": {"rollback", "flags"},
    "BELIEVES_WHAT_IT_IS_TOLD": set(),
}
EVIDENCE = {
    "CRASHES_WHEN_WRITTEN": ("serialise", "SIGSEGV"),
    "HANGS_IN_RESET": ("reset", "timeout"),
    "DERIVES_WRONGLY": ("directional_derivative", "d der(x) / d x is -1.01, by differences -1;"),
    "NOT_A_NUMBER": ("finite", "y is nan at t = 0.4 s"),
    "KEEPS_ITS_STATE_IN_RESET": ("reset", "y 1.5 and 2.5"),
    "HANGS_IN_INSTANTIATE": ("load", "timeout while it was doing instantiate"),
    "EXITS_IN_STEP": ("finite", "exit code 0"),
    "IGNORES_THE_STEP_LENGTH": ("variable_step", "its length is ignored"),
    "FORGETS_WHEN_TAKEN_BACK": ("flags", "rollback declared, does not work"),
}


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


def by_name(checked: Checked) -> dict:
    return {found.name: found for found in checked.probes}


@pytest.mark.parametrize("fault", faults())
def test_each_way_of_failing_shows_in_its_probes_and_in_no_other(tmp_path: Path, fault: str):
    checked = check(deceiver(tmp_path, fault), SECONDS)
    assert checked.runnable
    assert set(checked.failed) == SHOWN_BY[fault]
    assert all(found.evidence for found in checked.probes)
    if fault in EVIDENCE:
        name, said = EVIDENCE[fault]
        assert said in by_name(checked)[name].evidence


def test_what_is_not_declared_does_not_count_but_is_told(tmp_path: Path):
    works = by_name(check(deceiver(tmp_path, "NONE", declared=False), SECONDS))
    assert works["rollback"].passed is None
    assert works["rollback"].evidence.startswith("not declared, works all the same: ")
    assert works["flags"].passed is True
    fails = by_name(check(deceiver(tmp_path, "CRASHES_WHEN_WRITTEN", declared=False), SECONDS))
    assert (fails["serialise"].passed, fails["serialise"].observed) == (None, False)
    assert fails["flags"].passed is True


@pytest.mark.parametrize("fmi", [2, 3])
def test_our_own_exports_pass_every_probe_in_both_kinds(fmi: int):
    checked = check(cached_fmu(driveline.MODEL, fmi), 30.0)
    adjoint = {"adjoint_derivative", "me_adjoint_derivative"}
    verdicts = {found.name: found.passed for found in checked.probes}
    assert {name for name, passed in verdicts.items() if passed is not True} == (adjoint if fmi == 2 else set())
    assert len(checked.probes) == 2 * len(NAMES)


@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.parametrize("model", ["VanDerPol", "Dahlquist", "BouncingBall", "Feedthrough", "Stair"])
def test_the_reference_fmus_fail_no_probe(model: str, fmi: int):
    checked = check(reference_fmu(model, fmi), 30.0)
    assert (checked.runnable, checked.failed) == (True, [])


@pytest.mark.parametrize("model", ["MassSpringSystem", "Mass_Damper", "add", "ramp"])
def test_fmus_of_openmodelica_fail_no_probe(model: str):
    checked = check(third_party_fmu(f"{model}.fmu", OPENMODELICA), 30.0)
    assert (checked.runnable, checked.failed) == (True, [])
    assert {found.kind for found in checked.probes} == {"cs", "me"}


@pytest.mark.parametrize("made", [pythonfmu_fmu, pythonfmu3_fmu])
def test_fmus_with_python_inside_fail_no_probe(tmp_path: Path, made: Callable[[Path], Path]):
    checked = check(made(tmp_path), 30.0)
    assert (checked.runnable, checked.failed) == (True, [])


def test_flags_count_only_where_they_were_declared():
    assert flags([]).passed is None


def test_a_check_in_json_has_the_shape_of_the_contract(crankbench, tmp_path: Path):
    path = deceiver(tmp_path, "NONE")
    code, out, _ = crankbench("check", path, "--json")
    found = json.loads(out)
    assert (code, found["fmu"], found["runnable"]) == (0, str(path), True)
    assert [probe["name"] for probe in found["probes"]] == list(NAMES)
    assert all(probe["passed"] in (True, False, None) and probe["evidence"] for probe in found["probes"])


def test_a_failed_probe_ends_with_1_and_is_printed_with_its_evidence(crankbench, tmp_path: Path):
    code, out, _ = crankbench("check", deceiver(tmp_path, "NOT_A_NUMBER"))
    assert code == 1
    assert "FAIL finite y is nan at t = 0.4 s" in [" ".join(line.split()) for line in out.splitlines()]
    assert out.splitlines()[-1].startswith("runnable, ")
    assert out.splitlines()[-1].endswith("1 failed: finite")


def test_what_is_no_fmu_or_cannot_be_run_ends_with_2_and_the_reason(crankbench, tmp_path: Path):
    (tmp_path / "text.fmu").write_text("this is no archive")
    code, out, err = crankbench("check", tmp_path / "text.fmu")
    assert (code, out) == (2, "")
    assert "is no intact zip archive" in err
    code, _, err = crankbench("check", tmp_path / "nowhere.fmu")
    assert code == 2 and "no FMU file" in err
    code, out, err = crankbench("check", third_party_fmu("CoupledClutches_CS_win64.fmu"), "--json")
    assert code == 2 and "no binary for" in err
    found = json.loads(out)
    assert found["runnable"] is False and found["reasons"]
    assert {probe["passed"] for probe in found["probes"]} == {None}


def test_strict_validation_refuses_what_is_tolerated_otherwise(crankbench):
    path = third_party_fmu("CoupledClutches_CS_win64.fmu")
    code, out, _ = crankbench("inspect", path)
    assert code == 0
    strict, _, err = crankbench("inspect", path, "--validation", "strict")
    assert (strict, "breaks a rule of the standard" in err) == ((2, True) if "caution: " in out else (0, False))


def test_a_folder_gives_a_page_with_a_row_for_every_fmu_however_broken(crankbench, tmp_path: Path):
    folder = tmp_path / "fmus"
    (folder / "deep").mkdir(parents=True)
    sound = deceiver(folder / "deep", "NONE")
    deceiver(folder, "EXITS_IN_STEP")
    (folder / "text.fmu").write_text("this is <no> archive")
    page = tmp_path / "page.html"
    code, out, _ = crankbench("check", folder, "--report", page, "--jobs", 2, "--seconds", SECONDS)
    assert code == 1
    assert out.splitlines()[-1] == str(page)
    text, kept = page.read_text(), json.loads((tmp_path / "page.json").read_text())
    rows = {row["fmu"]: row for row in kept["fmus"]}
    assert list(rows) == ["deep/none.fmu", "exits_in_step.fmu", "text.fmu"]
    assert rows["deep/none.fmu"]["runnable"] and not rows["text.fmu"]["runnable"]
    assert all(name in text for name in rows)
    assert "2 of 3 run here, 1 pass every probe" in text
    assert "is no intact zip archive" in text
    assert "by hand" in text and "exit code 0" in text
    assert "http://" not in text and "https://" not in text and "<script" not in text
    code, _, _ = crankbench("check", sound.parent)
    assert code == 0


def test_a_folder_without_fmus_is_refused(crankbench, tmp_path: Path):
    code, _, err = crankbench("check", tmp_path)
    assert code == 2 and "found no file that ends in .fmu" in err
    code, _, err = crankbench("check", tmp_path, "--report", tmp_path / "page.txt")
    assert code == 2 and "wants a file that ends in .html" in err
