"""pytest collects a run folder's criteria as tests, and says clearly what failed or is missing."""

import json
import subprocess
import sys

import pytest
from test_report_folder import CRITERIA, build_run

pytest_plugins = ["pytester"]

IMPOSSIBLE = {
    "text": "rmse_hybrid < 1e-9 rad",
    "experiment": "mismatch",
    "value": 0.0018,
    "bound": 1e-9,
    "unit": "rad",
    "passed": False,
}


def run(pytester: pytest.Pytester, *arguments: str) -> pytest.RunResult:
    """pytest with those arguments, without hypothesis' plug-in, which takes a second to import anew each time."""
    return pytester.runpytest("-p", "no:hypothesispytest", *arguments)


def test_a_run_gives_one_passed_test_a_criterion_named_as_declared(pytester):
    build_run(pytester.path / "runs", seeds=1, rows=50)
    result = run(pytester, "runs", "-v")
    result.assert_outcomes(passed=2)
    result.stdout.fnmatch_lines(
        ["*acceptance.json::rmse_hybrid < 0.01 rad PASSED*", "*::figure_6: p95(located.delay) < 20 ms PASSED*"]
    )


def test_a_failed_criterion_is_named_with_value_bound_and_worst_case(pytester):
    build_run(
        pytester.path / "runs", seeds=1, rows=50, criteria=[*CRITERIA, {**IMPOSSIBLE, "reason": "9 of 9 cases above"}]
    )
    result = run(pytester, "runs")
    result.assert_outcomes(passed=2, failed=1)
    assert result.ret == pytest.ExitCode.TESTS_FAILED
    result.stdout.fnmatch_lines(
        [
            "value 0.0018 rad, bound 1e-09 rad: mismatch: rmse_hybrid < 1e-9 rad",
            "worst case: figure_6: seed = 1 (0000000000000000), ok",
            "9 of 9 cases above",
            "FAILED runs/acceptance.json::mismatch: rmse_hybrid < 1e-9 rad*",
        ]
    )
    assert "Traceback" not in result.stdout.str() and "acceptance.py" not in result.stdout.str()


def test_one_criterion_can_be_chosen(pytester):
    build_run(pytester.path / "runs", seeds=1, rows=50, criteria=[*CRITERIA, IMPOSSIBLE])
    run(pytester, "runs/acceptance.json::rmse_hybrid < 0.01 rad").assert_outcomes(passed=1)
    run(pytester, "runs", "-k", "located").assert_outcomes(passed=1, deselected=2)


def test_a_missing_acceptance_file_is_an_error_and_not_an_empty_run(pytester):
    (build_run(pytester.path / "runs", seeds=1, rows=50) / "acceptance.json").unlink()
    result = run(pytester, "runs")
    result.assert_outcomes(errors=1)
    result.stdout.fnmatch_lines(["*acceptance.json is missing: the campaign was not judged*"])


@pytest.mark.parametrize("content", ["[{", "{}", '[{"text": "a < 1"}]'])
def test_a_corrupt_acceptance_file_is_an_error(pytester, content):
    (build_run(pytester.path / "runs", seeds=1, rows=50) / "acceptance.json").write_text(content)
    result = run(pytester, "runs")
    result.assert_outcomes(errors=1)
    result.stdout.fnmatch_lines(["*acceptance.json: *wants*"])


def test_an_incomplete_campaign_fails_every_criterion_and_names_the_missing_case(pytester):
    folder = build_run(pytester.path / "runs", seeds=2, rows=50)
    (folder / "cases" / "0001000000000000" / "case.json").unlink()
    result = run(pytester, "runs")
    result.assert_outcomes(failed=2)
    result.stdout.fnmatch_lines(["incomplete campaign: 1 of 6 cases have no case.json: figure_6: seed = 2"])


def test_an_incomplete_campaign_without_criteria_is_an_error(pytester):
    folder = build_run(pytester.path / "runs", seeds=1, rows=50, criteria=[])
    (folder / "cases" / "0000000000000000" / "case.json").unlink()
    result = run(pytester, "runs")
    result.assert_outcomes(errors=1)
    result.stdout.fnmatch_lines(["*incomplete campaign: 1 of 3 cases*"])


def test_a_folder_outside_the_root_directory_works(pytester, tmp_path_factory):
    folder = build_run(tmp_path_factory.mktemp("elsewhere"), seeds=1, rows=50)
    pytester.makeini("[pytest]")
    run(pytester, "--rootdir", str(pytester.path), "-c", "tox.ini", str(folder)).assert_outcomes(passed=2)
    run(pytester, str(folder)).assert_outcomes(passed=2)


def test_two_criteria_of_one_text_stay_two_tests(pytester):
    build_run(pytester.path / "runs", seeds=1, rows=50, criteria=[CRITERIA[0], CRITERIA[0]])
    result = run(pytester, "runs", "-v")
    result.assert_outcomes(passed=2)
    result.stdout.fnmatch_lines(["*::rmse_hybrid < 0.01 rad (2) PASSED*"])


def test_a_campaign_json_of_someone_else_is_left_alone(pytester):
    (pytester.path / "campaign.json").write_text(json.dumps({"ads": 3}))
    pytester.mkdir("cases_of_ours").joinpath("test_a.py").write_text("def test_a(): pass")
    run(pytester).assert_outcomes(passed=1)


def test_a_test_of_ones_own_reads_a_run_through_the_fixture(pytester):
    build_run(pytester.path / "runs" / "driveline", seeds=2, rows=50)
    pytester.makepyfile(
        """
        def test_close(crankbench_run):
            run = crankbench_run("runs/driveline")
            assert run.metric("rmse_hybrid").max() < 0.01
            assert run.signals(run.cases[0], ["plant.theta_e"]).shape == (50, 1)
        """
    )
    run(pytester, "test_a_test_of_ones_own_reads_a_run_through_the_fixture.py").assert_outcomes(passed=1)


def test_loading_the_plug_in_imports_nothing_heavy():
    heavy = {"numpy", "pandas", "pyarrow", "matplotlib", "plotly"}
    code = f"import sys, reports.acceptance, reports.folder; print(sorted({heavy} & set(sys.modules)))"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "[]"
