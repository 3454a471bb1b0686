"""Metrics from the campaign file to the run folder: problems at their place, units in criteria, versions, matrices."""

import csv
import json
import math
import re
from pathlib import Path

import jsonschema
import numpy as np
import pyarrow.parquet as pq
import pytest

from fmus.component import ConfigurationError
from harness.campaign import read_campaign
from harness.cases import execute
from harness.cli import main, schema_text
from harness.metrics import KINDS
from harness.metricslist import SHARED, metric_kinds
from reports.definitions import definitions
from reports.errors import declared_confusions
from reports.folder import read_run
from reports.html import write_report
from reports.standing import quantities

DOCS = Path(__file__).parent.parent / "docs"
# An alarm that comes 20 ms late, goes 20 ms late, and is false once; classes that are told apart but for one.
CAMPAIGN = """\
campaign: diagnosed
description: a fault and what is said of it
clock: {time: {step: 1 ms, stop: 1 s}}
parts:
  fault: {use: source, unit: "1", table: {time: [0 s, 0.2 s, 0.4 s], value: [0, 1, 0]}}
  said: {use: source, unit: "1", table: {time: [0 s, 0.22 s, 0.42 s, 0.7 s, 0.8 s], value: [0, 1, 0, 1, 0]}}
vary: {seed: 1..2}
metrics:
  alarmed: {alarm: [fault.value, said.value], unit: ms}
  confused: {confusion: {pair: [fault.value, said.value], classes: {sound: 0, faulty: 1}}}
  settled: {settling: {error: [fault.value, said.value], bound: 0.5}, unit: ms}
  unsettled: {settling: {error: [fault.value, said.value], bound: 0.5}, until: 0.75 s}
accept:
  - p95(alarmed.delay) < 21 ms
  - alarmed.false_alarms_per_hour < 2 1/min
  - confused.recall_faulty > 85 %
  - settled < 1 s
  - settled < unsettled
"""


def run(folder, text):
    file = folder / "campaign.yaml"
    file.write_text(text)
    return execute(read_campaign(file), folder / "run", 1, lambda ended: None)


@pytest.fixture(scope="module")
def diagnosed(tmp_path_factory):
    """The folder of the campaign above, run."""
    folder = tmp_path_factory.mktemp("diagnosed")
    run(folder, CAMPAIGN)
    return folder / "run"


def test_criteria_judge_metrics_in_any_unit_of_their_dimension(diagnosed):
    told = {entry["text"]: entry for entry in json.loads((diagnosed / "acceptance.json").read_text())}
    assert told["p95(alarmed.delay) < 21 ms"]["passed"]
    assert told["p95(alarmed.delay) < 21 ms"]["value"] == pytest.approx(20.0, abs=1e-6)
    # One in 0.8 s without the fault is 75 in a minute.
    rate = told["alarmed.false_alarms_per_hour < 2 1/min"]
    assert (rate["passed"], rate["value"], rate["unit"]) == (False, pytest.approx(75.0, rel=1e-2), "1/min")
    recall = told["confused.recall_faulty > 85 %"]
    assert (recall["passed"], recall["value"]) == (True, pytest.approx(90.0))
    assert told["settled < 1 s"]["passed"]


def test_a_value_that_never_came_is_infinite_in_every_file_and_passes_nothing(diagnosed):
    (case, _) = (json.loads(path.read_text()) for path in sorted(diagnosed.glob("cases/*/case.json")))
    assert case["metrics"]["unsettled"] == {"value": None, "unit": "s", "is": "inf"}
    assert case["metrics"]["settled"]["value"] == pytest.approx(801.0)  # the source acts from the row after
    run_read = read_run(diagnosed)
    assert run_read.cases[0].metrics["unsettled"].value == math.inf
    rows = list(csv.DictReader((diagnosed / "metrics.csv").open()))
    assert [float(row["value"]) for row in rows if row["metric"] == "unsettled"] == [math.inf] * 2
    verdicts = {criterion.text: criterion for criterion in run_read.criteria}
    assert not verdicts["settled < unsettled"].passed


def test_a_run_folder_says_of_each_metric_its_kind_version_meaning_and_what_is_compared(diagnosed):
    told = json.loads((diagnosed / "campaign.json").read_text())["metrics"]["confused"]
    assert (told["kind"], told["version"]) == ("confusion", KINDS["confusion"].version)
    assert told["meaning"] == KINDS["confusion"].meaning
    assert told["compares"] == [["fault.value", "said.value"]]
    page = write_report(diagnosed).read_text()
    assert "<td>confusion 1</td>" in page and "<td>alarm 2</td>" in page


def test_the_report_adds_the_matrices_of_the_cases_up_and_draws_them(diagnosed):
    expected = np.zeros((2, 2), dtype=int)
    for path in diagnosed.glob("cases/*/signals.parquet"):
        table = pq.read_table(path)
        for true, seen in zip(*(table.column(f"{part}.value").to_pylist() for part in ("fault", "said")), strict=True):
            expected[int(true), int(seen)] += 1
    (matrix,) = declared_confusions(read_run(diagnosed))
    assert (matrix.classes, matrix.cases, matrix.metric) == (("sound", "faulty"), 2, "confused")
    assert np.array_equal(matrix.counts, expected)
    page = write_report(diagnosed).read_text()
    assert "fault.value and said.value (<code>confused</code>)" in page
    assert page.count("estimated: said.value") == 1
    assert "All samples in the window of the metric, those of 2 cases: " in page


def test_the_report_takes_no_signals_for_a_truth_and_its_estimate_that_are_not(diagnosed):
    found = definitions(read_run(diagnosed))
    assert found["settled"].pairs == found["alarmed"].pairs == (("fault.value", "said.value"),)
    assert found["alarmed"].part == "said"
    labels = [quantity.label for quantity in quantities(read_run(diagnosed))]
    assert "Settling of fault.value (bound 0.5)" in labels
    assert "alarmed.faults" in labels  # neither more nor less is better


def test_metrics_are_taken_anew_from_the_signals_where_their_definition_changed(tmp_path):
    run(tmp_path, CAMPAIGN)
    kept = sorted((tmp_path / "run").glob("cases/*/signals.parquet"))
    before = [path.stat().st_mtime_ns for path in kept]
    run(tmp_path, CAMPAIGN.replace("bound: 0.5}, unit: ms}", "bound: 0.5}, after: 0.3 s, unit: ms}"))
    assert [path.stat().st_mtime_ns for path in kept] == before
    assert read_run(tmp_path / "run").cases[0].metrics["settled"].value == pytest.approx(501.0)


def documented():
    (text,) = (
        block
        for block in re.findall(r"```yaml\n(.*?)```", (DOCS / "metrics.md").read_text(), re.DOTALL)
        if block.startswith("campaign:")
    )
    return text


@pytest.fixture(scope="module")
def ripple(tmp_path_factory):
    """The example of the documentation, run: its values by name."""
    folder = tmp_path_factory.mktemp("ripple")
    result = run(folder, documented())
    assert result.accepted, [verdict.reason for verdict in result.verdicts]
    return read_run(folder / "run").cases[0].metrics


def test_the_documented_harmonic_is_that_of_the_source(ripple):
    # 100 Hz in rows of 0.1 ms, linear between them: short by at most (2 pi 0.01)^2/8 = 0.05 %.
    assert ripple["second_order"].value == pytest.approx(40.0, rel=6e-4)
    assert (ripple["second_order"].unit, ripple["second_order.phase"].unit) == ("N.m", "deg")
    # sin(2 pi 100 Hz t) is cos(4 w theta - 90 deg).
    assert ripple["second_order.phase"].value == pytest.approx(-90.0, abs=0.1)
    assert (ripple["second_order.cycles"].value, ripple["second_order.dropped"].value) == (
        25.0,
        pytest.approx(0, abs=3),
    )


def test_the_documented_gauge_is_a_first_order_lag_at_the_second_order(ripple):
    # 1/(1 + i 2 pi 100 Hz 1 ms), and noise of 0.5 N.m/sqrt(number of rows) a component, a tenth of that in phase.
    lag = 1 / (1 + 2j * math.pi * 0.1)
    assert ripple["second_order_error.amplitude"].value == pytest.approx(40 * (abs(lag) - 1), abs=0.1)
    assert ripple["second_order_error.phase"].value == pytest.approx(math.degrees(np.angle(lag)), abs=0.2)
    assert ripple["second_order_error"].value == pytest.approx(40 * abs(lag - 1), abs=0.1)


def test_the_documented_window_after_top_dead_centre_has_the_mean_of_half_an_oscillation(ripple):
    # 90 deg after each firing are half an oscillation: the mean of a lagged sine there, 45 rows from 0 to 88 deg.
    lag = 1 / (1 + 2j * math.pi * 0.1)
    phase = np.radians(4 * np.arange(0, 90, 2) / 2)
    expected = 100 + 40 * np.mean(np.imag(lag * np.exp(1j * phase)))
    assert ripple["expansion"].value == pytest.approx(expected, abs=0.1)
    assert ripple["expansion.spread"].value < 0.5
    assert ripple["locked.scatter"].value == pytest.approx(0.5, rel=0.3)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ((", angle: crankshaft.value}", "}"), "metrics.second_order: wants the crank angle of the rows"),
        (
            ("per_cycle: 4, step: 2 deg}, angle", "per_cycle: 4}, angle"),
            "metrics.second_order: wants the `step` that the signals are interpolated at over crankshaft.value",
        ),
        (
            ("angle: crankshaft.value, after: 1440 deg}", "after: 1440 deg}"),
            "metrics.locked: after 1440.0 deg wants the crank angle of the rows",
        ),
    ],
)
def test_a_metric_over_crank_angle_says_what_it_wants_at_its_place_before_anything_runs(tmp_path, change, message):
    assert change[0] in documented()
    with pytest.raises(ConfigurationError) as refused:
        run(tmp_path, documented().replace(*change, 1))
    found = [problem for problem in refused.value.problems if problem.message.startswith(message)]
    assert len(found) == 1
    name = message.split(":")[0].removeprefix("metrics.")
    written = documented().replace(*change, 1).splitlines()
    assert written[found[0].line - 1].lstrip().startswith(f"{name}:")
    assert not (tmp_path / "run").exists()


CRANK_CLOCK = """\
campaign: turning
clock: {crank: {step: 6 deg, stop: 10 rev, speed: engine, firing_order: [1, 3, 4, 2], origin: 90 deg}}
parts:
  engine: {use: source, unit: rpm, ramp: {at: 0 s, until: 1 s, from: 1500 rpm, to: 3000 rpm}}
  crank: {use: crank}
  gauge: {use: sensor, of: crank.phase, bias: 2 deg}
metrics:
  window: {crank_average: {signal: crank.phase, from: 180 deg, to: 360 deg}, unit: deg, after: 720 deg}
  error: {crank_error: {error: [crank.phase, gauge.value]}, unit: deg}
  first: {minimum: crank.angle, after: 1000 deg, unit: deg}
"""


@pytest.mark.parametrize(("record", "apart"), [("", 6), ("record: {every: 5}\n", 30)])
def test_on_a_crank_clock_crank_metrics_take_the_recorded_rows(tmp_path, record, apart):
    run(tmp_path, CRANK_CLOCK + record)
    found = read_run(tmp_path / "run").cases[0].metrics
    rows = np.arange(180, 360, apart)
    # The angle passes through radians and back.
    assert found["window"].value == pytest.approx(rows.mean(), abs=1e-9)
    assert (found["window"].unit, found["window.windows"].value) == ("deg", 4)
    assert (found["error"].value, found["error.scatter"].value) == (pytest.approx(2.0), pytest.approx(0.0, abs=1e-9))
    assert found["error.cycles"].value == 4
    assert found["first"].value == pytest.approx(90 + apart * math.ceil((1000 - 90) / apart))


def test_rows_that_do_not_divide_the_cycle_are_refused_before_the_run(tmp_path):
    with pytest.raises(ConfigurationError, match="rows 42 deg apart do not divide the cycle"):
        run(tmp_path, CRANK_CLOCK + "record: {every: 7}\n")


def test_every_kind_is_in_the_table_of_the_documentation_with_every_value_it_gives():
    table = re.findall(r"^\| (`.*?) \|.*?\| (.*) \|$", (DOCS / "campaign.md").read_text(), re.MULTILINE)
    told = {kind: values for kinds, values in table for kind in re.findall(r"`(\w+)`", kinds)}
    assert told.keys() >= KINDS.keys()
    for name, kind in KINDS.items():
        if name == "nis":
            continue  # "the same"
        for suffix in filter(None, kind.results):
            shown = re.sub(r"\{(\w+)\}", lambda match: "NAME" if match[1] == "class" else "N", suffix)
            assert f"`.{shown}`" in told[name], (name, suffix)


def test_the_command_line_lists_the_kinds_with_arguments_units_and_versions(capsys, monkeypatch):
    def call(*arguments):
        monkeypatch.setattr("sys.argv", ["crankbench", "metrics", *arguments])
        with pytest.raises(SystemExit) as ended:
            main()
        assert not ended.value.code
        return capsys.readouterr().out

    listed = json.loads(call("--json"))
    assert [entry["kind"] for entry in listed] == list(KINDS)
    by_kind = {entry["kind"]: entry for entry in listed}
    assert by_kind["settling"]["values"] == [{"name": "", "unit": "s", "samples": False}]
    assert {"name": ".phase", "unit": "deg", "samples": False} in by_kind["harmonic"]["values"]
    arguments = {argument["name"]: argument for argument in by_kind["crank_average"]["arguments"]}
    assert arguments["signal"]["required"] and not arguments["from"]["required"]
    assert all(argument["description"] for entry in listed for argument in entry["arguments"])
    text = call()
    for name, kind in KINDS.items():
        assert f"{name} (version {kind.version})" in text


def test_arguments_as_listed_are_the_keys_that_the_schema_knows():
    schema = json.loads(schema_text())
    definition = schema["$defs"]["Definition"]["properties"]
    assert definition.keys() == {*KINDS, *SHARED}
    for entry in metric_kinds():
        name = KINDS[entry["kind"]].arguments.__name__
        found = schema["$defs"][name]
        long = next((form for form in found.get("anyOf", []) if "properties" in form), found)
        assert long["properties"].keys() == {argument["name"] for argument in entry["arguments"]}
    jsonschema.Draft202012Validator.check_schema(schema)
