"""Several run folders on one page: what changed, and whether the ranking holds."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from test_report_folder import build_run

from reports.comparison import as_json, compare, write_comparison
from reports.folder import RunFolderError


def rewritten(folder: Path, case: str, metric: str, factor: float) -> None:
    """Multiplies one metric in the case.json of every case whose label begins with `case`."""
    for path in folder.glob("cases/*/case.json"):
        content = json.loads(path.read_text())
        if content["label"].startswith(case) and metric in content["metrics"]:
            content["metrics"][metric]["value"] *= factor
            path.write_text(json.dumps(content))


def two_runs(tmp_path: Path) -> tuple[Path, Path]:
    (tmp_path / "base").mkdir()
    (tmp_path / "other").mkdir()
    return build_run(tmp_path / "base"), build_run(tmp_path / "other")


def test_equal_runs_differ_in_nothing_and_keep_their_ranking(tmp_path):
    found = compare(two_runs(tmp_path))
    assert found.differences == ()
    assert found.rankings and all(ranking.holds for ranking in found.rankings)
    assert {shift.factor for shift in found.shifts} == {1.0}


def test_a_ranking_that_turns_is_said_to(tmp_path):
    base, other = two_runs(tmp_path)
    rewritten(other, "", "rmse_hybrid", 1000.0)
    ranking = next(one for one in compare([base, other]).rankings if one.label == "RMSE of plant.theta_e")
    assert not ranking.holds
    assert ranking.places["hybrid"] == (1, 2)
    assert ranking.places["open_loop"] == (2, 1)


def test_seeds_do_not_outweigh_a_scenario(tmp_path):
    base, _ = two_runs(tmp_path)
    (tmp_path / "many").mkdir()
    many = build_run(tmp_path / "many", seeds=6)
    assert all(ranking.holds for ranking in compare([base, many]).rankings)


def test_the_most_changed_metric_comes_first_with_its_factor(tmp_path):
    base, other = two_runs(tmp_path)
    rewritten(other, "figure_6", "rmse_hybrid", 3.0)
    first = compare([base, other]).shifts[0]
    assert (first.scenario, first.metric) == ("figure_6", "rmse_hybrid")
    assert first.factor == pytest.approx(3.0, rel=1e-12)


def test_what_changed_names_the_setting_and_both_values(tmp_path):
    base, other = two_runs(tmp_path)
    content = json.loads((other / "campaign.json").read_text())
    content["clock"] = {"time": {"step": "7 ms", "stop": "5 s"}}
    (other / "campaign.json").write_text(json.dumps(content))
    (step,) = (one for one in compare([base, other]).differences if one.path == "clock.time.step")
    assert step.values[1] == "7 ms"


def test_the_page_stands_alone_and_names_both_folders(tmp_path):
    base, other = two_runs(tmp_path)
    text = write_comparison([base, other], tmp_path / "comparison.html").read_text()
    assert "http" not in text.replace("http://www.w3.org", "")
    assert str(base) in text or base.name in text
    assert "Does the ranking hold?" in text
    assert json.loads(json.dumps(as_json(compare([base, other])), allow_nan=False))["accepted"] == [True, True]


def test_one_folder_is_no_comparison(tmp_path):
    base, _ = two_runs(tmp_path)
    with pytest.raises(RunFolderError, match="two run folders or more, got 1"):
        compare([base])
