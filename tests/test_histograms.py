"""Histograms of errors that a campaign declares: the same bins for all, every row of the cases that count, once."""

import numpy as np
import pyarrow.parquet as pq
import pytest
from test_report import page_of

from fmus.component import ConfigurationError
from harness.campaign import read_campaign
from harness.cases import execute
from harness.preflight import preflight
from reports.folder import read_run
from reports.histograms import declared_histograms

CAMPAIGN = """\
campaign: spread
clock: {time: {step: 1 ms, stop: 0.3 s}}
parts:
  torque: {use: source, unit: N.m, constant: -10 N.m}
  plant: {use: fmus.plants.driveline, wires: {T_eng: torque}}
  fine: {use: sensor, of: plant.y, noise: {std: 0.1 rpm}}
  poor: {use: sensor, of: plant.y, noise: {std: 2 rpm}, bias: 1 rpm}
experiments:
  calm: {vary: {seed: 1..3}}
  loud: {set: {fine.noise.std: 20 rpm}, vary: {seed: 1..2}}
metrics:
  error_fine: {rmse: [plant.y, fine.value], unit: rpm}
report:
  observers: {fine: {title: Fine encoder}, poor: {title: Poor encoder}}
  histograms:
    - {title: Calm, experiments: [calm], pairs: [[plant.y, fine.value], [plant.y, poor.value]], from: 0.1 s, to: 0.2 s, unit: rpm}
    - {title: All, pairs: [[plant.y, fine.value]], bins: 20, reach: 3 rpm, scale: log}
"""  # noqa: E501


def read(tmp_path, text):
    path = tmp_path / "spread.yaml"
    path.write_text(text)
    return read_campaign(path)


@pytest.fixture(scope="module")
def ran(tmp_path_factory):
    folder = tmp_path_factory.mktemp("spread")
    execute(read(folder, CAMPAIGN), folder / "run", 1, lambda ended: None)
    return read_run(folder / "run")


def errors_of(run, estimate, experiments, begin=-np.inf, end=np.inf):
    """Estimate minus truth of all rows, in rpm, read without the histograms."""
    found = []
    for case in run.cases:
        if case.experiment in experiments:
            frame = run.signals(case, ["plant.y", estimate])
            frame = frame[(frame.index >= begin) & (frame.index <= end)]
            found.append((frame[estimate] - frame["plant.y"]).to_numpy() * 60 / (2 * np.pi))
    return np.concatenate(found)


def test_each_estimate_has_a_panel_over_the_same_bins_and_every_row_counts_once(ran):
    calm, _ = declared_histograms(ran)
    assert (calm.unit, calm.cases, calm.recorded) == ("rpm", 3, 3)
    reach = 0.0
    for panel in calm.panels:
        error = errors_of(ran, panel.estimate, ["calm"], 0.1, 0.2)
        reach = max(reach, np.abs(error).max())
        assert panel.rows == panel.counts.sum() == len(error) == 3 * 101
        assert panel.mean == pytest.approx(error.mean(), rel=1e-9, abs=1e-12)
        assert panel.rms == pytest.approx(np.sqrt(np.mean(error**2)), rel=1e-9)
        assert panel.largest == pytest.approx(np.abs(error).max(), rel=1e-12)
    np.testing.assert_allclose(calm.edges, np.linspace(-reach, reach, 61), rtol=1e-12)


def test_what_lies_beyond_the_bins_is_in_the_outermost(ran):
    _, everything = declared_histograms(ran)
    (panel,) = everything.panels
    error = errors_of(ran, "fine.value", ["calm", "loud"])
    np.testing.assert_allclose(everything.edges, np.linspace(-3, 3, 21), rtol=1e-12)
    assert panel.rows == 5 * 301 and everything.logarithmic
    # The bins' own, and no error lies within rounding of an edge.
    assert panel.counts[0] == np.count_nonzero(error < -2.7) and panel.counts[-1] == np.count_nonzero(error >= 2.7)
    assert panel.counts[10] == np.count_nonzero((error >= 0.0) & (error < 0.3))


def test_it_is_the_same_from_one_row_group_and_from_many(ran, tmp_path):
    before = declared_histograms(ran)
    for path in ran.path.glob("cases/*/signals.parquet"):
        pq.write_table(pq.read_table(path), path, row_group_size=7)
    for one, other in zip(before, declared_histograms(ran), strict=True):
        for first, second in zip(one.panels, other.panels, strict=True):
            np.testing.assert_array_equal(first.counts, second.counts)


def test_the_page_draws_it_and_names_the_cases(ran):
    text = page_of(ran.path).text("errors")
    assert "Calm [rpm]" in text and "Fine encoder" in text and "Poor encoder" in text
    assert "Rows of 3 cases (calm) from 0.1 s to 0.2 s; a case that failed counts up to its failure." in text


def test_cases_without_a_record_are_said_to_be_missing(tmp_path):
    execute(read(tmp_path, CAMPAIGN), tmp_path / "run", 1, lambda ended: None)
    run = read_run(tmp_path / "run")
    (run.path / "cases" / run.cases[0].key / "signals.parquet").unlink()
    assert "Rows of 2 cases (calm) (of 3: the others left no record)" in page_of(run.path).text("errors")
    for case in run.cases[1:3]:
        (run.path / "cases" / case.key / "signals.parquet").unlink()
    assert "Not drawn: no case of calm left a record of fine.value, plant.y, poor.value" in page_of(run.path).text(
        "errors"
    )


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("bins: 20", "bins: 1", r"report.histograms\[1\].bins wants at least 2, got 1"),
        ("reach: 3 rpm", "reach: 0 rpm", r"reach wants a value above 0, got 0.0 rpm"),
        ("experiments: [calm]", "experiments: [clam]", r"no experiment is named 'clam'; did you mean 'calm'"),
        ("[[plant.y, fine.value]], bins", "[[plant.y]], bins", r"pairs\[0\]"),
    ],
)
def test_what_is_wrong_with_a_histogram_is_told_with_its_place(tmp_path, old, new, told):
    assert old in CAMPAIGN
    with pytest.raises(ConfigurationError, match=r"spread\.yaml:\d+:\d+: .*" + told):
        read(tmp_path, CAMPAIGN.replace(old, new))


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("poor.value]], from", "poor.valu]], from", r"no recorded signal is named 'poor.valu'; did you mean 'poor"),
        ("poor.value]], from", "torque.value]], from", r"wants signals in rpm or alike, got torque.value in N.m"),
        ("reach: 3 rpm", "reach: 3 s", r"reach wants rpm, got 3.0 s"),
        ("from: 0.1 s", "from: 720 deg", r"from wants the crank angle of the rows"),
    ],
)  # fmt: skip
def test_signals_that_do_not_fit_are_told_before_the_run(tmp_path, old, new, told):
    assert old in CAMPAIGN
    with pytest.raises(ConfigurationError, match=r"spread\.yaml:\d+:\d+: report: " + told):
        preflight(read(tmp_path, CAMPAIGN.replace(old, new)))
