"""Published statements: judged as criteria are at the end of a run, told in the report, never counted against it."""

import json

import pytest
from test_report import page_of
from test_report_folder import build_run

from fmus.component import ConfigurationError
from harness.campaign import read_campaign
from harness.cases import execute
from harness.preflight import preflight
from reports.folder import RunFolderError, read_run
from reports.html import render
from reports.published import published, read_statements

CAMPAIGN = """\
campaign: stated
clock: {time: {step: 1 ms, stop: 0.2 s}}
parts:
  torque: {use: source, unit: N.m, constant: -10 N.m}
  plant: {use: fmus.plants.driveline, wires: {T_eng: torque}}
  fine: {use: sensor, of: plant.y, noise: {std: 0.1 rpm}}
  poor: {use: sensor, of: plant.y, noise: {std: 10 rpm}}
experiments:
  calm: {vary: {seed: 1..3}}
  loud: {set: {fine.noise.std: 20 rpm}, vary: {seed: 1..3}}
metrics:
  error_fine: {rmse: [plant.y, fine.value], unit: rpm}
  error_poor: {rmse: [plant.y, poor.value], unit: rpm}
accept: [error_fine < 100 rpm]
report:
  published:
    - {what: less, published: 'yes', holds: error_fine < error_poor}
    - {what: less when calm, published: 'yes', experiment: calm, holds: error_fine < 0.05 * error_poor, note: A note}
    - {what: error, published: 0.1 rpm, experiment: calm, metric: error_fine}
    - {what: tiny, published: 'yes', experiment: calm, metric: error_fine, holds: p95(error_fine) < 1e-3 rad/s}
"""


def read(tmp_path, text):
    path = tmp_path / "stated.yaml"
    path.write_text(text)
    return read_campaign(path)


@pytest.fixture(scope="module")
def ran(tmp_path_factory):
    folder = tmp_path_factory.mktemp("stated")
    result = execute(read(folder, CAMPAIGN), folder / "run", 1, lambda ended: None)
    assert result.accepted  # though two statements do not hold
    return read_run(folder / "run")


def both(case):
    """What was measured of both encoders in a case."""
    return case.metrics["error_fine"].value, case.metrics["error_poor"].value


def test_each_statement_is_judged_over_its_own_experiment_with_the_values_of_both_sides(ran):
    rows = published(ran)
    assert [row.statement and row.statement.holds for row in rows] == [False, True, None, False]
    everywhere, calm, _, tiny = (row.statement for row in rows)
    worst = ran.case(everywhere.case)
    assert worst.experiment == "loud"
    assert (everywhere.value, everywhere.bound) == both(worst)
    fine, poor = both(ran.case(calm.case))
    assert (calm.value, calm.bound) == (fine, 0.05 * poor)
    assert tiny.unit == "rad/s" and tiny.bound == 1e-3
    # 0.1 rpm is 0.0105 rad/s; of 200 samples the deviation is known to 5 %.
    assert tiny.value == pytest.approx(0.01047, rel=0.15)


def test_the_page_says_which_statements_hold_and_keeps_published_values_apart(ran):
    text = page_of(ran.path).text("published")
    assert "1 of 3 published statements hold here." in text
    assert "✗ does not hold less yes error_fine < error_poor" in text
    assert "✓ holds less when calm yes error_fine < 0.05 * error_poor" in text
    assert "A note" in text
    assert "error 0.1 rpm 0.1" in text
    assert "Accepted" in page_of(ran.path).text()


def test_a_statement_over_a_failed_case_does_not_hold_and_says_why(tmp_path):
    text = CAMPAIGN.replace("poor: {use: sensor, of: plant.y, noise", "poor: {use: sensor, of: broken.omega, noise")
    text = text.replace("  fine:", "  broken: {use: 'crank_parts:broken_speed', with: {at: 0.1 s}}\n  fine:")
    text = text.replace("[plant.y, poor.value]", "[broken.omega, poor.value]")
    execute(read(tmp_path, text), tmp_path / "run", 1, lambda ended: None)
    first, *_ = published(read_run(tmp_path / "run"))
    assert first.statement is not None and not first.statement.holds
    assert "ended with" in first.statement.reason


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("error_fine < error_poor", "error_fime < error_poor", r":17:\d+: holds: no metric is named 'error_fime'; did"),
        ("error_fine < error_poor", "error_fine", r":17:\d+: holds: 'error_fine' wants one of <= >= "),
        ("experiment: calm, holds", "experiment: clam, holds", r":18:\d+: report: no experiment is named 'clam'"),
        ("holds: error_fine < error_poor", "holds: 3", r":17:\d+: report\.published\[0\]\.holds wants text, got 3"),
    ],
)
def test_a_statement_that_cannot_be_read_is_told_with_its_place(tmp_path, old, new, told):
    assert old in CAMPAIGN
    with pytest.raises(ConfigurationError, match=r"stated\.yaml" + told):
        read(tmp_path, CAMPAIGN.replace(old, new))


def test_a_statement_about_metrics_measured_nowhere_in_its_experiment_is_refused(tmp_path):
    text = CAMPAIGN.replace("[plant.y, poor.value], unit: rpm", "[plant.y, poor.value], unit: rpm, only: [loud]")
    with pytest.raises(ConfigurationError, match=r"holds: 'error_fine < 0.05 \* error_poor' covers no experiment"):
        read(tmp_path, text)


def test_a_bound_of_another_dimension_is_told_before_the_run(tmp_path):
    with pytest.raises(ConfigurationError, match=r"stated\.yaml:20:\d+: holds: 'p95\(error_fine\) < 1e-3 s'"):
        preflight(read(tmp_path, CAMPAIGN.replace("1e-3 rad/s", "1e-3 s")))


def test_a_run_whose_campaign_states_nothing_any_more_keeps_no_statements(tmp_path, ran):
    campaign = read(tmp_path, CAMPAIGN.partition("report:")[0])
    execute(campaign, tmp_path / "run", 1, lambda ended: None)
    assert not (tmp_path / "run" / "statements.json").exists()
    execute(read(tmp_path, CAMPAIGN), tmp_path / "run", 1, lambda ended: None)
    assert len(read_statements(read_run(tmp_path / "run"))) == 3
    execute(campaign, tmp_path / "run", 1, lambda ended: None)
    assert not (tmp_path / "run" / "statements.json").exists()


def test_a_damaged_file_of_statements_is_named(tmp_path):
    folder = build_run(tmp_path / "run")
    (folder / "statements.json").write_text(json.dumps([{"entry": 0}]))
    with pytest.raises(RunFolderError, match=r"statements\.json: an entry is not what a statement wants: KeyError"):
        render(read_run(folder))
