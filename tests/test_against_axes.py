"""Curves and powers against the axes of a campaign: what is computed, kept, drawn, and refused."""

import json
import math

import numpy as np
import pytest
from scipy import stats
from test_report import page_of
from test_report_folder import build_run

from fmus.component import ConfigurationError
from harness.campaign import read_campaign
from harness.cases import execute
from harness.criteria import Judged
from harness.curves import curves_content
from harness.definitions import Value
from harness.powers import Share, clopper_pearson, powers_content, smallest_found
from harness.preflight import preflight
from harness.reportaxes import Curve, Power
from harness.runfolder import plain
from reports.curves import read_curves
from reports.folder import RunFolderError, read_run
from reports.html import render
from reports.powers import read_powers

# An offset in normal noise of deviation s is told beyond a threshold c with P(|a + s n| > c): both signs alike.
CAMPAIGN = """\
campaign: found
clock: {time: {step: 1 ms, stop: 1 ms}}
parts:
  offset: {use: source, unit: rpm, constant: 0 rpm}
  noisy: {use: sensor, of: offset, noise: {std: 1 rpm}}
  low: {use: 'verdict_parts:BEYOND', with: {threshold: 1 rpm}, wires: {u: noisy}}
  high: {use: 'verdict_parts:BEYOND', with: {threshold: 2 rpm}, wires: {u: noisy}}
vary:
  noisy.noise.std: "[2, 0.1, 0.5] rpm"
  offset.constant: "[-3, -1.5, -0.5, 0, 0.5, 1.5, 3] rpm"
  seed: 1..12
metrics:
  hit_low: {final: low.hit}
  hit_high: {final: high.hit, unit: '%'}
  seen: {final: noisy.value, unit: rpm}
  error_noisy: {rmse: [offset.value, noisy.value], unit: rpm}
report:
  observers: {low: {title: Low threshold}, high: {title: High threshold}}
  curves:
    - {title: Error against noise, metric: 'error_{observer}', against: noisy.noise.std, panels: offset.constant}
  powers:
    - {title: Smallest offset, metric: 'hit_{observer}', magnitude: offset.constant, against: noisy.noise.std, note: A note}
"""  # noqa: E501


def read(tmp_path, text):
    path = tmp_path / "found.yaml"
    path.write_text(text)
    return read_campaign(path)


@pytest.fixture(scope="module")
def ran(tmp_path_factory):
    folder = tmp_path_factory.mktemp("found")
    execute(read(folder, CAMPAIGN), folder / "run", 2, lambda ended: None)
    return read_run(folder / "run")


def test_shares_are_those_of_the_probability_of_finding_it_and_the_smallest_magnitude_follows(ran):
    (power,) = read_powers(ran)
    assert (power.magnitude_unit, power.against_unit) == ("rpm", "rpm")
    for line, threshold in zip(power.lines, (1.0, 2.0), strict=True):
        for point in line.points:
            sizes = [share.magnitude for share in point.shares]
            assert sizes == [0.0, 0.5, 1.5, 3.0]
            assert [share.cases for share in point.shares] == [12, 24, 24, 24]  # both signs of each seed
            noise = stats.norm(scale=point.at)
            chance = [noise.sf(threshold - size) + noise.cdf(-threshold - size) for size in sizes]
            for share, p in zip(point.shares, chance, strict=True):
                # Four deviations of the binomial, and a hit more or less where the chance is next to 0 or 1.
                assert share.hits == pytest.approx(share.cases * p, abs=4 * math.sqrt(share.cases * p * (1 - p)) + 0.5)
            found = [
                size for size in sizes[1:] if all(one.share >= 0.95 for one in point.shares if one.magnitude >= size)
            ]
            assert point.smallest == (found[0] if found else None)
    # Without much noise it is the next size above the threshold, with much of it there is none.
    assert [line.points[0].smallest for line in power.lines] == [1.5, 3.0]
    assert power.lines[1].points[2].smallest is None


@pytest.mark.parametrize(("hits", "cases"), [(0, 10), (3, 10), (23, 24), (24, 24)])
def test_the_interval_holds_every_share_for_which_what_came_is_not_too_unlikely(hits, cases):
    lower, upper = clopper_pearson(hits, cases, 0.95)
    # By the definition, tails of the binomial at the ends; by inversion of the beta distribution the same.
    if hits:
        assert stats.binom.sf(hits - 1, cases, lower) == pytest.approx(0.025, rel=1e-6)
        assert lower == pytest.approx(stats.beta.ppf(0.025, hits, cases - hits + 1), rel=1e-9)
    if hits < cases:
        assert stats.binom.cdf(hits, cases, upper) == pytest.approx(0.025, rel=1e-6)
    assert (lower == 0.0) == (hits == 0) and (upper == 1.0) == (hits == cases)


def shares(**found):
    return [Share(float(name[1:]), hits, 20, 0, 0.0, 1.0) for name, hits in found.items()]


def test_a_magnitude_counts_only_where_all_larger_ones_are_found_too():
    assert smallest_found(shares(m1=20, m2=18, m3=19, m4=20), 0.95).magnitude == 3.0
    assert smallest_found(shares(m1=20, m2=20, m3=18), 0.95) is None
    assert smallest_found(shares(m0=20, m1=20), 0.95).magnitude == 1.0  # at zero there is nothing to find
    assert smallest_found([], 0.95) is None


def case(outcome="ok", experiment="", values=None, **metrics):
    found = {name: Value(value, "1") for name, value in metrics.items()} if outcome == "ok" else {}
    return Judged("key", f"case {values}", experiment, outcome, found, {}, values or {})


def asked(**more):
    return Power.model_validate({"title": "?", "metric": "hit_{observer}", "magnitude": "a", "against": "n", **more})


def test_failed_cases_and_values_that_are_none_are_not_found_and_those_not_measured_do_not_count():
    at = {"n": "1 rpm", "a": "2 rad"}
    cases = [
        case(values=at, hit_x=1.0),
        case(values=at, hit_x=math.nan),
        case("crash", values=at),
        case(values=at),
        case(values={"n": "1 rpm"}, hit_x=1.0),
    ]
    (found,) = powers_content([asked()], cases, [["x"]])
    (share,) = found["lines"][0]["points"][0]["shares"]
    assert (share["hits"], share["cases"], share["failed"]) == (1, 3, 1)
    assert (found["cases"], found["failed"]) == (4, 1)  # the one without the axis is none of them


def test_of_several_axes_the_largest_that_a_case_varies_is_its_magnitude():
    power = asked(magnitude=["a_1", "a_2"], hit=0.5)
    cases = [
        case("ok", "one", {"n": "1000 rpm", "a_1": "-5 %"}, hit_x=0.6),
        case("ok", "two", {"n": "1000 rpm", "a_2": "0.05"}, hit_x=0.4),
        case("ok", "both", {"n": "1000 rpm", "a_1": "0 %", "a_2": "-10 %"}, hit_x=1.0),
        case("ok", "none", {"n": "1000 rpm", "b": "0 %"}, hit_x=1.0),
    ]
    (found,) = powers_content([power], cases, [["x"]])
    (point,) = found["lines"][0]["points"]
    assert [(one["magnitude"], one["hits"], one["cases"]) for one in point["shares"]] == [(5.0, 1, 2), (10.0, 1, 1)]
    assert (found["magnitude_unit"], point["smallest"]) == ("%", 10.0)


def test_a_metric_that_is_no_share_is_told_by_name_after_the_run(tmp_path):
    text = CAMPAIGN.replace("threshold: 2 rpm}", "threshold: 2 rpm, told: 3}").replace("seed: 1..12", "seed: 1..2")
    text = text.replace("[2, 0.1, 0.5] rpm", "[2] rpm")
    execute(read(tmp_path, text), tmp_path / "run", 1, lambda ended: None)
    said = page_of(tmp_path / "run").text("powers")
    assert "Not told of High threshold: hit_high wants a share from 0 to 1, got 3 in " in said
    assert "Low threshold 2 rpm" in said


def test_the_page_tells_what_is_found_and_none_found_is_a_row(ran):
    said = page_of(ran.path).text("powers")
    assert "Smallest offset" in said and "A note." in said
    # The share where it is found, its interval by Clopper and Pearson (24 of 24: 0.025^(1/24) = 0.8575).
    assert "Low threshold 0.1 rpm 1.5 rpm 100 % 85.8 to 100 % 24 of 24 1.5 rpm 0 of 12" in said
    assert "High threshold 2 rpm none found" in said


def test_a_curve_holds_the_median_and_the_band_of_the_cases_at_each_value(ran):
    (curve,) = read_curves(ran)
    assert [panel.value for panel in curve.panels] == [f"{size} rpm" for size in (-3, -1.5, -0.5, 0, 0.5, 1.5, 3)]
    (points,) = curve.panels[1].lines.values()
    assert [point.at for point in points] == [0.1, 0.5, 2.0]
    for point in points:
        cases = [
            one for one in ran.cases
            if one.values["offset.constant"] == "-1.5 rpm" and one.values["noisy.noise.std"] == f"{point.at:g} rpm"
        ]  # fmt: skip
        values = sorted(one.metrics["error_noisy"].value for one in cases)
        assert len(values) == point.cases == 12
        assert point.median == pytest.approx(np.median(values), rel=1e-15)
        # By nearest rank the 5th and the 95th percentile of twelve are the first and the last.
        assert (point.low, point.high) == (values[0], values[-1])
    said = page_of(ran.path).text("curves")
    assert "Error against noise" in said and "Median over 252 cases" in said


@pytest.mark.parametrize(("better", "worst"), [("lower", math.inf), ("higher", -math.inf)])
def test_a_failed_case_counts_as_the_worst_and_values_convert_to_one_unit(better, worst):
    curve = Curve.model_validate({"title": "?", "metric": "m_{observer}", "against": "n", "better": better})
    cases = [
        case(values={"n": "60 rpm"}, m_x=1.0),
        case(values={"n": "1 1/min"}, m_x=4.0),
        case("crash", values={"n": "60 rpm"}),
        case("crash", values={"n": "60 rpm"}),
        case(values={"n": "120 rpm"}, m_x=math.nan),
        case(values={"m": "120 rpm"}, m_x=9.0),
    ]
    cases[1] = case(values={"n": "6.283185307179586 rad/s"}, m_x=4.0)
    (found,) = curves_content([curve], cases, [["x"]], {"m_x": "%"})
    (line,) = found["panels"][0]["lines"]
    # 60 rpm and 2 pi rad/s are one place; where a case has no value there is no point.
    (point,) = line["points"]
    assert (point["at"], point["cases"], point["failed"]) == (60.0, 2, 2)
    assert point["median"] == worst and (found["failed"], found["cases"]) == (2, 5)


def test_points_whose_cases_failed_are_read_back_as_infinite_and_drawn_at_the_edge(tmp_path):
    folder = build_run(tmp_path / "run")
    curve = Curve.model_validate({"title": "Half failed", "metric": "m_{observer}", "against": "n"})
    cases = [case(values={"n": "1 rpm"}, m_x=1.0), case("crash", values={"n": "2 rpm"})]
    content = curves_content([curve], cases, [["x"]], {})
    (folder / "curves.json").write_text(json.dumps(plain(content)))
    (found,) = read_curves(read_run(folder))
    assert [point.median for point in found.panels[0].lines["x"]] == [1.0, math.inf]
    assert "1 cases failed and count as infinitely bad" in page_of(folder).text("curves")


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("magnitude: offset.constant", "magnitude: offset.cnst", "no axis is named 'offset.cnst'; did you mean 'o"),
        ("against: noisy.noise.std, p", "against: noise.std, p", "no axis is named 'noise.std'; did you mean 'no"),
        ("magnitude: offset.constant", "magnitude: 3", "magnitude wants a list, got 3"),
        ("magnitude: offset.constant", "magnitude: []", "magnitude wants at least 1 items, got []"),
        ("magnitude: offset.constant", "magnitude: [offset.constant, 4]", "magnitude[1] wants text, got 4"),
        ("panels: offset.constant", "panels: low.use", "no axis is named 'low.use'"),
        ("'error_{observer}'", "eror", "wants the name of a metric with {observer} in it once, got 'eror'"),
        ("'error_{observer}'", "'eror_{observer}'", "no part has a metric named like 'eror_{observer}'; did"),
        ("note: A note", "observers: [low, hgih]", "no part is named 'hgih'; did you mean 'high'?"),
        ("note: A note", "observers: [noisy]", "no metric with one value a case is named 'hit_noisy'"),
        ("note: A note", "experiments: [calm]", "no experiment is named 'calm'"),
        ("note: A note", "share: 120 %", "share wants a share below 100 %, like 95 %, got 120.0 %"),
        ("note: A note", "confidence: 100 %", "confidence wants a share below 100 %, like 95 %, got 100.0 %"),
        ("note: A note", "hit: 2", "hit wants at most 1.0, got 2"),
        ('"[2, 0.1, 0.5] rpm"', "[2 rpm, 1 rad/s, 3 s]", "noisy.noise.std wants values in rpm or alike, got 3 s"),
    ],
)  # fmt: skip
def test_what_is_wrong_with_a_curve_or_a_power_is_told_with_its_place(tmp_path, old, new, told):
    assert old in CAMPAIGN
    with pytest.raises(ConfigurationError) as caught:
        read(tmp_path, CAMPAIGN.replace(old, new))
    found = [str(problem) for problem in caught.value.problems]
    assert any(told in one and "found.yaml:" in one and ":0:" not in one for one in found), found


def test_an_axis_whose_values_are_no_numbers_is_refused_by_name(tmp_path):
    text = CAMPAIGN.replace('noisy.noise.std: "[2, 0.1, 0.5] rpm"', "low.use: ['verdict_parts:BEYOND']").replace(
        "against: noisy.noise.std", "against: low.use"
    )
    with pytest.raises(
        ConfigurationError, match=r"low\.use wants to be an axis of numbers, got 'verdict_parts:BEYOND'"
    ):
        read(tmp_path, text)


def test_an_experiment_that_varies_only_some_of_the_axes_is_refused_by_name(tmp_path):
    head, _, tail = CAMPAIGN.partition("vary:\n")
    axes, _, rest = tail.partition("metrics:\n")
    whole = "experiments:\n  whole:\n    vary:\n" + "".join(f"    {line}\n" for line in axes.splitlines())
    text = f"{head}{whole}  other: {{vary: {{offset.constant: [1 rpm]}}}}\nmetrics:\n{rest}"
    assert read(tmp_path, text).cases  # by default only those that vary all axes count
    with pytest.raises(ConfigurationError, match=r"other wants to vary what is drawn against it: noisy.noise.std, off"):
        read(tmp_path, text.replace("note: A note", "experiments: [whole, other]"))


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("{final: low.hit}", "{rmse: [offset.value, noisy.value]}", r"wants a metric that is a share .* a rmse in rpm"),
        ("{final: low.hit}", "{final: noisy.value}", r"wants a metric that is a share .* got hit_low, a final in rpm"),
        ("error_noisy: {", "error_low: {mean: low.hit}\n  error_noisy: {", r"wants one unit, got error_"),
    ],
)  # fmt: skip
def test_a_metric_that_cannot_be_a_share_or_is_of_another_unit_is_told_before_the_run(tmp_path, old, new, told):
    assert old in CAMPAIGN
    with pytest.raises(ConfigurationError, match=r"found\.yaml:\d+:\d+: report: " + told):
        preflight(read(tmp_path, CAMPAIGN.replace(old, new)))


@pytest.mark.parametrize("name", ["curves", "powers"])
def test_a_damaged_file_is_named(tmp_path, name):
    folder = build_run(tmp_path / "run")
    (folder / f"{name}.json").write_text('[{"title": "only"}]')
    with pytest.raises(RunFolderError, match=rf"{name}\.json: an entry is not what a {name[:-1]} wants: KeyError"):
        render(read_run(folder))
