"""The page of a run: what it must say, checked by parsing it; and that drawing loses no event."""

import json
import math
import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import plotly.graph_objects as go
import pyarrow.parquet as pq
import pytest
from test_report_folder import CRITERIA, METRICS, REPORT, build_run

from reports.envelope import envelope
from reports.errors import pool
from reports.folder import read_run
from reports.html import write_report
from reports.interactive import interactive
from reports.numbers import short, with_unit
from reports.provenance import ranges
from reports.standing import leaderboard, quantities, standing, unit_of
from reports.traces import declared_figures

FAILING = "mismatch: plant.k = 1800 N.m/rad, seed = 2"


class Page(HTMLParser):
    """A page as the texts of its sections, its addresses, its SVGs and its plots."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.addresses: list[str] = []
        self.ids: list[str] = []
        self.svgs = 0
        self.scripts: list[str] = []
        self.texts: dict[str, list[str]] = {"": []}
        self.open: list[str] = []
        self.section = ""
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        self.addresses += [
            value or "" for name, value in attrs if name in ("src", "href", "xlink:href", "data", "action")
        ]
        self.svgs += tag == "svg"
        if given.get("id"):
            self.ids.append(given["id"] or "")
        if tag == "section":
            self.section = given.get("id") or ""
            self.texts[self.section] = []
        if tag in ("script", "style"):
            self.open.append(tag)
            self.scripts.append("")

    def handle_endtag(self, tag: str) -> None:
        if self.open and self.open[-1] == tag:
            self.open.pop()

    def handle_data(self, data: str) -> None:
        if self.open:
            self.scripts[-1] += data
        else:
            self.texts[self.section].append(data)

    def text(self, section: str = "") -> str:
        """The visible text of a section, blanks joined."""
        return " ".join(" ".join(self.texts[section]).split())


def page_of(folder: Path) -> Page:
    """The parsed report of a run folder."""
    return Page(write_report(folder).read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def failed_page(tmp_path_factory):
    """A report with a failed case and a failed criterion."""
    criteria = [
        *CRITERIA,
        {"text": "rmse_open_loop < 1e-3 rad", "experiment": "mismatch", "value": 0.0315, "bound": 1e-3, "unit": "rad"}
        | {"passed": False, "reason": "0.0315 rad is not < 0.001 rad in figure_6: seed = 1"},
    ]
    return page_of(build_run(tmp_path_factory.mktemp("failed"), failing=[FAILING], criteria=criteria))


def test_an_accepted_run_says_so_first(tmp_path):
    page = page_of(build_run(tmp_path))
    assert page.text().startswith(
        "driveline: accepted driveline A synthetic run <with markup> & more Accepted 2 of 2 criteria passed."
    )
    assert "None: every case ran to its end." in page.text("failures")


def test_a_run_with_a_failed_case_is_not_accepted_and_names_it(failed_page):
    assert "Not accepted 2 of 3 criteria passed. 1 of 9 cases did not run to their end." in failed_page.text()
    for expected in ("diverged", FAILING, "open_loop.theta_e is nan", "2 s"):
        assert expected in failed_page.text("failures")


def test_failures_of_one_cause_are_counted_and_still_listed_one_by_one(tmp_path):
    failing = [f"figure_6: seed = {seed}" for seed in (1, 2)]
    text = page_of(build_run(tmp_path, rows=50, failing=failing)).text("failures")
    assert "2 times diverged : open_loop.theta_e is nan" in text
    assert all(label in text for label in failing)


def test_every_criterion_has_a_row_with_value_bound_and_worst_case(failed_page):
    text = failed_page.text("criteria")
    assert "✓ passed rmse_hybrid < 0.01 rad all 0.0021 rad 0.01 rad figure_6: seed = 1" in text
    assert "✓ passed p95(located.delay) < 20 ms figure_6 12 ms 20 ms" in text
    failed = "✗ failed rmse_open_loop < 1e-3 rad mismatch 0.0315 rad 0.001 rad figure_6: seed = 1"
    assert f"{failed} 0.0315 rad is not < 0.001 rad" in text


def test_the_page_fetches_nothing_from_elsewhere(failed_page):
    assert [address for address in failed_page.addresses if not address.startswith(("#", "data:"))] == []
    styles = [script for script in failed_page.scripts if "{" in script and "Plotly" not in script]
    assert not any(re.search(r"@import|url\(\s*['\"]?(https?:)?//", style) for style in styles)


def test_plotly_is_embedded_once_and_every_figure_is_static_too(failed_page):
    assert sum("plotly.js v" in script for script in failed_page.scripts) == 1
    # The declared figure, two heat maps, two error histograms, one confusion matrix, one delay distribution.
    assert failed_page.svgs == 7


def test_no_two_elements_share_an_id(failed_page):
    assert len(failed_page.ids) == len(set(failed_page.ids))


def test_the_page_stays_below_eight_megabytes(tmp_path):
    assert write_report(build_run(tmp_path, seeds=1, rows=60_000)).stat().st_size < 8e6


def test_the_same_folder_gives_the_same_page(tmp_path):
    build_run(tmp_path)
    assert write_report(tmp_path).read_bytes() == write_report(tmp_path).read_bytes()
    assert [path.name for path in tmp_path.glob(".report*")] == []


def test_provenance_says_what_was_run_and_that_the_tool_is_not_qualified(failed_page):
    text = failed_page.text("provenance")
    for expected in ("0123456789abcdef", "ab" * 32, "cd" * 32, "1..3", "time step 2 ms", "solver.method", "numpy 2.4"):
        assert expected in text
    assert "torque → plant → encoder → hybrid → open_loop (9 of the cases) No wire is held" in text
    assert "the plant's FMU names no unit for tau 9" in text
    assert "located detection of [plant.location, hybrid.location] detection 1 How fast a location is found." in text
    assert "not a qualified tool" in text


def test_published_values_stand_beside_ours_and_a_gap_is_said(failed_page):
    text = failed_page.text("published")
    assert "settles in location 2 0.0002 rad (median of 3; 0.0002 to 0.0002) figure_6" in text
    assert "no_such_metric: no case of the campaign has it" in text


def test_pooled_samples_carry_the_unit_of_their_median(tmp_path):
    run = read_run(build_run(tmp_path))
    assert unit_of(run, "located.delay") == "s"


def test_a_case_that_failed_before_its_first_row_has_its_place(tmp_path):
    run = read_run(build_run(tmp_path, seeds=1, failing=["figure_6: seed = 1"]))
    path = tmp_path / "cases" / run.cases[0].key / "signals.parquet"
    pq.write_table(pq.read_table(path).slice(0, 0), path)
    page = page_of(tmp_path)
    assert "the record of figure_6: seed = 1 (diverged) has no rows" in page.text("figures")


def test_a_run_that_was_not_judged_is_incomplete(tmp_path):
    (build_run(tmp_path) / "acceptance.json").unlink()
    assert "Incomplete The campaign was not judged" in page_of(tmp_path).text()


def test_a_missing_case_makes_the_run_incomplete_and_is_listed(tmp_path):
    run = read_run(build_run(tmp_path))
    (tmp_path / "cases" / run.cases[2].key / "case.json").unlink()
    page = page_of(tmp_path)
    assert "Incomplete" in page.text()
    assert "missing figure_6: seed = 3" in page.text("failures")


def test_a_campaign_that_declares_nothing_still_gets_a_page(tmp_path):
    campaign = {"campaign": "bare", "cases": [{"key": "a"}]}
    (tmp_path / "cases" / "a").mkdir(parents=True)
    (tmp_path / "campaign.json").write_text(json.dumps(campaign))
    (tmp_path / "acceptance.json").write_text("[]")
    (tmp_path / "cases" / "a" / "case.json").write_text(json.dumps({"key": "a", "outcome": "ok"}))
    assert "No criteria declared" in page_of(tmp_path).text()


def test_a_figure_of_an_unrecorded_signal_says_so_in_its_place(tmp_path):
    build_run(tmp_path)
    campaign = json.loads((tmp_path / "campaign.json").read_text())
    campaign["report"]["figures"] = [{"title": "Wrong", "traces": [["plant.theta"]]}]
    (tmp_path / "campaign.json").write_text(json.dumps(campaign))
    assert "Not drawn: no recorded signal is named 'plant.theta'; did you mean 'plant.theta_e'?" in page_of(
        tmp_path
    ).text("figures")


def test_declared_figures_convert_units_and_place_thresholds_on_the_panels_of_their_dimension(tmp_path):
    (figure,) = declared_figures(read_run(build_run(tmp_path)))
    torsion, speed, _, location = figure.panels
    assert speed.traces[0].values[-1] == pytest.approx(-4.0 * 60 / (2 * math.pi), rel=1e-12)  # rad/s shown in rpm
    assert speed.label == "omega_c [rpm]"
    assert torsion.lines == ((-0.010, "lower threshold"), (-0.040, "upper threshold"))
    assert speed.lines == () and location.lines == ()
    assert location.traces[0].discrete
    assert [(window.label, window.since, window.until) for window in figure.windows] == [
        ("encoder: bias 5 rpm", 3.0, 3.25)
    ]


def test_a_figure_may_show_a_window_of_time(tmp_path):
    folder = build_run(tmp_path)
    campaign = json.loads((folder / "campaign.json").read_text())
    campaign["report"]["figures"][0] |= {"from": "1 s", "to": "2000 ms"}
    (folder / "campaign.json").write_text(json.dumps(campaign))
    (figure,) = declared_figures(read_run(folder))
    for panel in figure.panels:
        for trace in panel.traces:
            assert (trace.along[0], trace.along[-1]) == (pytest.approx(1.0), pytest.approx(2.0))
            assert len(trace.values) == len(trace.along)


def test_an_error_is_better_when_less_even_where_a_criterion_bounds_it_from_below(tmp_path):
    folder = build_run(tmp_path)
    criteria = json.loads((folder / "acceptance.json").read_text())
    criteria[0]["text"] = "rmse_hybrid >= 0.999 * rmse_open_loop"
    (folder / "acceptance.json").write_text(json.dumps(criteria))
    found = {quantity.label: quantity for quantity in quantities(read_run(folder))}
    assert not found["RMSE of plant.theta_e"].higher_is_better


def test_interactive_figures_are_valid_plotly_with_one_time_axis(tmp_path):
    (figure,) = declared_figures(read_run(build_run(tmp_path)))
    plot = interactive(figure, 500)
    drawn = go.Figure(plot)  # raises on any name or value the plotly schema does not know
    assert {trace.xaxis for trace in drawn.data} == {"x"}
    assert [trace.yaxis for trace in drawn.data] == ["y", "y", "y", "y2", "y2", "y3", "y4", "y4"]


def test_thinning_keeps_the_ends_and_a_spike_of_one_sample():
    time = np.linspace(0.0, 1.0, 100_001)
    values = np.sin(time)
    values[12_345], values[54_321] = 9.0, -7.0
    thin_time, thin = envelope(time, values, 1000)
    assert len(thin) <= 1002
    assert (thin.max(), thin.min()) == (9.0, -7.0)
    assert (thin_time[0], thin_time[-1]) == (0.0, 1.0)
    assert np.all(np.diff(thin_time) > 0)
    assert (
        envelope(time[:900], values[:900], 1000)[1] is not None
        and len(envelope(time[:900], values[:900], 1000)[1]) == 900
    )


def test_confusion_counts_every_sample_of_every_case(tmp_path):
    run = read_run(build_run(tmp_path, failing=[FAILING], rows=2001))
    _, (matrix,) = pool(run)
    assert matrix.counts.sum() == 8 * 2001 + 1000  # the failed case counts up to its failure
    expected = np.zeros((3, 3), dtype=int)
    for case in run.cases:
        frame = run.signals(case, ["plant.location", "hybrid.location"]).to_numpy().astype(int)
        for true, seen in frame:
            expected[true - 1, seen - 1] += 1
    np.testing.assert_array_equal(matrix.counts, expected)


def test_errors_are_pooled_in_the_shown_unit_from_the_latest_start_on(tmp_path):
    errors, _ = pool(read_run(build_run(tmp_path)))
    by_pair = {pooled.pair[:2]: pooled for pooled in errors}
    torsion = by_pair["plant.theta_e", "hybrid.theta_e"]
    assert len(torsion.values) == 9 * (2001 - 250)  # from 0.5 s on at 2 ms
    speed = by_pair["plant.omega_c", "open_loop.omega_c"]
    assert speed.unit == "rpm"
    # mean of 0.3 scale rad/s with scale 1 in a third of the cases and 9 in the rest, noise 0.05 over 18009 samples
    assert speed.values.mean() == pytest.approx(0.3 * (1 + 9 + 9) / 3 * 60 / (2 * math.pi), abs=5 * 0.05 * 9.55 / 134)


def test_metrics_of_one_kind_and_truth_compare_observers_best_first(tmp_path):
    run = read_run(build_run(tmp_path))
    found = {quantity.label: quantity for quantity in quantities(run)}
    torsion = found["RMSE of plant.theta_e"]
    assert torsion.metrics == {"hybrid": "rmse_hybrid", "open_loop": "rmse_open_loop"}
    best, second = leaderboard(run, torsion)
    assert (best.observer, second.observer) == ("hybrid", "open_loop")
    # 3 cases at 2e-4 and 6 at 18e-4
    assert (best.median, best.worst, best.measured) == (pytest.approx(18e-4), pytest.approx(18e-4), 9)


def test_a_failed_case_is_the_worst_and_moves_the_median(tmp_path):
    run = read_run(build_run(tmp_path, failing=[f"figure_6: seed = {seed}" for seed in (1, 2)]))
    row = standing(run, "rmse_hybrid", "hybrid", False, run.cases[:3])
    assert (row.measured, row.failed) == (1, 2)
    assert math.isinf(row.median) and math.isinf(row.worst)
    higher = standing(run, "located.accuracy", "hybrid", True, run.cases[:3])
    assert higher.worst == -math.inf


def test_numbers_are_short_and_carry_their_unit():
    assert [short(value) for value in (0.012345, 1.2e-5, 350.0, 123456.0, -0.0004)] == [
        "0.01235",
        "1.2e-5",
        "350",
        "123456",
        "-0.0004",
    ]
    assert [short(value) for value in (math.nan, math.inf)] == ["n/a", "∞"]
    assert with_unit(0.5, "rad") == "0.5 rad" and with_unit(0.5, "1") == "0.5"
    assert ranges([3, 1, 2, 7]) == "1..3, 7"


def test_the_synthetic_run_has_what_the_contract_asks_for():
    assert set(REPORT) == {"observers", "figures", "published"}
    assert all(metric.split(".")[0] in METRICS for entry in REPORT["observers"].values() for metric in entry["metrics"])


def with_metrics(folder: Path, declared, measured) -> Path:
    """The folder with metrics more: their declarations, and their values (or samples, as lists) in every case."""
    campaign = json.loads((folder / "campaign.json").read_text())
    campaign["metrics"] |= declared
    (folder / "campaign.json").write_text(json.dumps(campaign))
    for path in folder.glob("cases/*/case.json"):
        case = json.loads(path.read_text())
        for name, (value, unit) in measured.items():
            if isinstance(value, list):
                case["samples"][name] = value
                case["metrics"][f"{name}_median"] = {"value": value[0], "unit": unit}
            else:
                case["metrics"][name] = {"value": value, "unit": unit}
        path.write_text(json.dumps(case))
    return folder


def declared(kind, observer, truth="plant.theta_e", **arguments):
    pair = [truth, f"{observer}.{truth.partition('.')[2]}"]
    return {kind: {"error": pair, **arguments}, "kind": kind, "version": 1, "compares": [pair]}


def test_metrics_that_are_given_different_numbers_are_not_compared(tmp_path):
    metrics = {
        "a": declared("nrmse", "hybrid", by="range"),
        "b": declared("nrmse", "open_loop", by="range"),
        "c": declared("nrmse", "hybrid", by="2 rad"),
        "d": declared("nrmse", "open_loop", by="range") | {"after": "720 deg"},
        "e": declared("nrmse", "hybrid", by="range") | {"after": "1440 deg"},
    }
    run = read_run(with_metrics(build_run(tmp_path), metrics, {name: (0.1, "1") for name in metrics}))
    found = [quantity for quantity in quantities(run) if quantity.label.startswith("NRMSE")]
    assert [(quantity.label, set(quantity.metrics.values())) for quantity in found] == [
        ("NRMSE of plant.theta_e (by range)", {"a", "b"}),
        ("NRMSE of plant.theta_e (by 2 rad)", {"c"}),
        ("NRMSE of plant.theta_e (by range)", {"d"}),
        ("NRMSE of plant.theta_e (by range)", {"e"}),
    ]


def test_what_has_a_sign_is_the_better_the_nearer_to_zero_it_is(tmp_path):
    metrics = {"a": declared("bias", "hybrid"), "b": declared("bias", "open_loop")}
    run = read_run(with_metrics(build_run(tmp_path), metrics, {"a": (-0.2, "rad"), "b": (0.1, "rad")}))
    (quantity,) = (quantity for quantity in quantities(run) if quantity.label.startswith("Bias"))
    assert quantity.label == "Bias of plant.theta_e, magnitude"
    assert [(row.metric, row.median) for row in leaderboard(run, quantity)] == [("b", 0.1), ("a", 0.2)]


def test_what_is_neither_better_for_being_more_nor_less_is_not_ranked(tmp_path):
    metrics = {"a": declared("nees", "hybrid"), "b": declared("nees", "open_loop")}
    run = read_run(with_metrics(build_run(tmp_path), metrics, {"a": (2.0, "1"), "b": (3.0, "1")}))
    assert [quantity.label for quantity in quantities(run) if {"a", "b"} & set(quantity.metrics.values())] == ["a", "b"]


def test_delays_of_several_metrics_are_drawn_over_one_axis_in_one_unit(tmp_path, monkeypatch):
    metrics = {
        "told": declared("alarm", "hybrid", truth="plant.location"),
        "told_late": declared("alarm", "open_loop", truth="plant.location"),
    }
    folder = build_run(tmp_path, failing=[])
    with_metrics(folder, metrics, {"told.delay": ([30.0], "ms"), "told_late.delay": ([40.0], "ms")})
    drawn = {}

    def delays(samples, unit, titles, colours, name):
        drawn.update(unit=unit, titles=titles, samples={one: values.max() for one, values in samples.items()})
        return ""

    monkeypatch.setattr("reports.html.figures.delays", delays)
    write_report(folder)
    assert drawn["unit"] == "s"
    assert drawn["samples"] == {"located": math.inf, "told": pytest.approx(0.030), "told_late": pytest.approx(0.040)}
    # Two of the hybrid observer go by their own names.
    assert drawn["titles"] == {"located": "located", "told": "told", "told_late": "Open loop"}
