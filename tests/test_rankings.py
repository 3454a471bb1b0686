"""Measures against metrics: the correlation and its interval against scipy, the campaign's section, the report's."""

import json
import math
import textwrap

import numpy as np
import pytest
from scipy import stats
from test_report import page_of
from test_report_folder import build_run

from fmus.component import ConfigurationError
from harness.campaign import read_campaign
from harness.cases import execute
from harness.criteria import Judged
from harness.definitions import Value
from harness.operating import Operation
from harness.preflight import preflight
from harness.rankings import correlate, median_cost, rankings_content, spearman
from harness.reportsection import Ranking
from harness.runfolder import plain, write_json
from harness.selecting import SHOWN, select
from harness.wishes import Wishes
from reports.folder import RunFolderError, read_run
from reports.html import write_report
from reports.rankings import read_rankings

CAMPAIGN = """\
campaign: ranked
clock: {time: {step: 1 ms, stop: 0.2 s}}
parts:
  torque: {use: source, unit: N.m, constant: -10 N.m}
  plant: {use: fmus.plants.driveline, wires: {T_eng: torque}}
  fine: {use: sensor, of: plant.y, noise: {std: 0.1 rpm}}
  fair: {use: sensor, of: plant.y, noise: {std: 1 rpm}}
  poor: {use: sensor, of: plant.y, noise: {std: 10 rpm}}
vary: {seed: 1..4}
metrics:
  error_fine: {rmse: [plant.y, fine.value], unit: rpm}
  error_fair: {rmse: [plant.y, fair.value], unit: rpm}
  error_poor: {rmse: [plant.y, poor.value], unit: rpm}
report:
  rankings:
    - title: Is a dear sensor a good one?
      metric: 'error_{observer}'
      resamples: 200
      measures:
        price: {better: higher, values: {fine: 30, fair: 20, poor: 10}}
        size: {values: {fine: 3, fair: 2, poor: null}}
"""


def read(tmp_path, text):
    path = tmp_path / "ranked.yaml"
    path.write_text(textwrap.dedent(text))
    return read_campaign(path)


def problems(tmp_path, text):
    with pytest.raises(ConfigurationError) as caught:
        read(tmp_path, text)
    return [str(problem) for problem in caught.value.problems]


@pytest.mark.parametrize("values", [12, 3], ids=["few ties", "many ties"])
def test_the_correlation_is_that_of_scipy_with_ties_too(values):
    draw = np.random.default_rng(1)
    one, other = draw.integers(values, size=(2, 50, 20)).astype(float)
    expected = [stats.spearmanr(a, b).statistic for a, b in zip(one, other, strict=True)]
    # Both add twenty products; the order of the sums is all that can differ.
    np.testing.assert_allclose(spearman(one, other), expected, atol=1e-14)


def test_infinite_values_rank_last_and_all_ties_have_no_correlation():
    assert spearman(np.array([1.0, 2.0, np.inf]), np.array([5.0, 6.0, 7.0])) == pytest.approx(1.0)
    assert math.isnan(spearman(np.ones(4), np.arange(4.0)))


def test_a_failed_case_is_infinite_in_a_median_and_one_without_the_metric_is_not_counted():
    costs = np.array([[1.0, 2.0, 9.0], [1.0, np.inf, np.inf], [1.0, np.nan, 3.0], [np.nan] * 3])
    np.testing.assert_array_equal(median_cost(costs), [2.0, np.inf, 2.0, np.nan])


def test_the_interval_of_one_case_is_that_of_scipys_bootstrap_over_pairs():
    # With one case nothing but the observers is drawn anew, which scipy does too: the two differ by their draws alone.
    draw = np.random.default_rng(3)
    measure = draw.normal(size=40)
    costs = (measure + draw.normal(size=40))[:, None]
    found = correlate(measure, costs, resamples=5000, seed=5)
    reference = stats.bootstrap(
        (measure, costs[:, 0]), lambda a, b: stats.spearmanr(a, b).statistic, paired=True, vectorized=False,
        n_resamples=2000, method="percentile", rng=np.random.default_rng(6),
    )  # fmt: skip
    assert found.value == pytest.approx(stats.spearmanr(measure, costs[:, 0]).statistic)
    # The error of a 2.5 % quantile from 2000 draws is about 0.0035/density; the density there is near 1 per 0.05.
    assert found.lower == pytest.approx(reference.confidence_interval.low, abs=0.03)
    assert found.upper == pytest.approx(reference.confidence_interval.high, abs=0.03)
    assert found.resamples == 5000


def test_cases_are_drawn_too_so_that_noise_widens_the_interval():
    measure = np.arange(30.0)
    quiet = np.repeat(measure[:, None], 5, axis=1)
    noisy = quiet + np.random.default_rng(2).normal(scale=30.0, size=quiet.shape)
    still, shaken = (correlate(measure, costs, 500, 0) for costs in (quiet, noisy))
    assert still.lower == pytest.approx(1.0)
    assert shaken.upper - shaken.lower > 0.1


def test_the_interval_covers_the_true_correlation_about_as_often_as_it_says():
    # Of two normal variables with Pearson's r the true Spearman's rho is (6/pi) asin(r/2).
    r, hits, runs = 0.5, 0, 200
    truth = 6.0 / math.pi * math.asin(r / 2.0)
    for seed in range(runs):
        pair = np.random.default_rng(seed).multivariate_normal([0.0, 0.0], [[1.0, r], [r, 1.0]], size=40)
        found = correlate(pair[:, 0], pair[:, 1:], 200, seed)
        hits += found.lower <= truth <= found.upper
    # 95 % of 200 is 190, three deviations of that binomial are 9; percentile intervals of 40 pairs are a little short.
    assert 174 <= hits <= 199


def test_the_same_seed_gives_the_same_interval():
    measure, costs = np.arange(10.0), np.random.default_rng(0).normal(size=(10, 4))
    assert correlate(measure, costs, 300, 7) == correlate(measure, costs, 300, 7)
    assert correlate(measure, costs, 300, 7) != correlate(measure, costs, 300, 8)


@pytest.mark.parametrize(
    ("sign", "answer"), [(1.0, "agrees"), (-1.0, "opposes"), (0.0, "undefined")], ids=["same", "opposite", "all alike"]
)
def test_the_answer_is_what_the_interval_says(sign, answer):
    costs = np.arange(12.0)[:, None]
    assert correlate(sign * costs[:, 0], costs, 200, 0).answer == answer


def test_no_relation_is_told_as_open():
    draw = np.random.default_rng(11)
    assert correlate(draw.normal(size=25), draw.normal(size=(25, 3)), 500, 0).answer == "open"


def test_a_failed_case_counts_for_all_and_other_experiments_do_not():
    ranking = Ranking.model_validate(
        {
            "title": "?", "metric": "m_{observer}", "experiments": ["a"], "resamples": 100,
            "measures": {"index": {"values": {"x": 1, "y": 2, "z": 3}}},
        }
    )  # fmt: skip

    def case(key, experiment, outcome, values):
        metrics = {f"m_{name}": Value(value, "%") for name, value in zip("xyz", values, strict=True)}
        return Judged(key, key, experiment, outcome, metrics if outcome == "ok" else {})

    cases = [
        case("1", "a", "ok", [1.0, 2.0, 3.0]),
        case("2", "a", "ok", [3.0, 4.0, 5.0]),
        case("3", "a", "crash", [0.0, 0.0, 0.0]),
        case("4", "b", "ok", [9.0, 8.0, 7.0]),
    ]
    (found,) = rankings_content([ranking], cases, {"m_x": "%"})
    assert (found["cases"], found["failed"], found["unit"]) == (3, 1, "%")
    assert found["medians"] == {"x": 3.0, "y": 4.0, "z": 5.0}
    assert found["measures"][0]["correlation"] == pytest.approx(1.0)


def test_a_campaign_answers_the_question_in_its_run_folder_and_its_report(tmp_path):
    campaign = read(tmp_path, CAMPAIGN)
    execute(campaign, tmp_path / "run", 1, lambda ended: None)
    (ranking,) = read_rankings(read_run(tmp_path / "run"))
    price, size = ranking.measures
    assert price.correlation == pytest.approx(1.0)
    assert size.correlation == pytest.approx(0.5)  # ranks 2, 1, 3 and 1, 2, 3: 1 - 6 (1 + 1 + 0)/(3 (9 - 1))
    page = page_of(tmp_path / "run")
    assert "Is a dear sensor a good one?" in page.text("rankings")
    assert "yes: what the measure puts first does better" in page.text("rankings")


SELECTION = """\
  selection:
    target: turbo_si
    estimate: [p_im, T_im, p_em]
    max_sensors: 1
    noise: {p_im: 1 kPa}
    also_at: ['p_im=40 kPa']
"""


def test_a_selection_is_kept_in_the_run_folder_as_the_command_gives_it_and_drawn(tmp_path):
    campaign = read(tmp_path, CAMPAIGN + SELECTION)
    execute(campaign, tmp_path / "run", 1, lambda ended: None)
    wishes = Wishes(estimate=["p_im", "T_im", "p_em"], most=1, noise=["p_im=1 kPa"])
    others = [Operation("turbo_si", ("p_im=40 kPa",))]
    expected = select(Operation("turbo_si"), wishes, others, lambda what, done, total: None).to_json(SHOWN)
    kept = json.loads((tmp_path / "run" / "selection.json").read_text())
    # The measures were computed twice, on one machine by one code.
    assert {**kept, "commit": ""} == {**plain(expected), "commit": ""}
    page = page_of(tmp_path / "run")
    assert "Which sensors see p_im, T_im, p_em?" in page.text("selection")
    assert "(X)" in page.text("selection")  # p_im acts on p_ic and T_ic, but not where the throttle chokes


@pytest.mark.parametrize(("method", "drawings"), [("optimal", 1), ("h2", 2)])
def test_a_selection_by_error_is_kept_and_drawn_too(tmp_path, method, drawings):
    asked = SELECTION.partition("    noise")[0] + f"    method: {method}\n    sensors: [p_im, W_th]\n"
    campaign = read(tmp_path, CAMPAIGN + asked + "    disturbances: {p_im: 500 Pa}\n")
    execute(campaign, tmp_path / "run", 1, lambda ended: None)
    kept = json.loads((tmp_path / "run" / "selection.json").read_text())
    assert kept["method"] == method and kept["disturbances"] == {"p_im": pytest.approx(500.0)}
    text = page_of(tmp_path / "run").text("selection")
    assert f"best of 1: {', '.join(kept['by_size'][0]['sensors'])}" in text
    assert ("Which sensors the program uses at each alpha" in text) == (drawings == 2)


def test_a_selection_of_what_is_not_there_is_told_before_anything_is_run(tmp_path):
    campaign = read(tmp_path, CAMPAIGN + SELECTION.replace("T_im, p_em", "T_imm, p_em"))
    with pytest.raises(ConfigurationError, match=r"ranked\.yaml:\d+:\d+: report: selection: .*did you mean 'T_im'"):
        execute(campaign, tmp_path / "run", 1, lambda ended: None)
    assert not (tmp_path / "run").exists()


def test_a_damaged_selection_is_named(tmp_path):
    folder = build_run(tmp_path / "run")
    (folder / "selection.json").write_text('{"sets": []}')
    with pytest.raises(RunFolderError, match=r"selection\.json: is not what a selection wants"):
        write_report(folder)


def test_a_campaign_that_asks_nothing_writes_no_rankings(tmp_path):
    campaign = read(tmp_path, CAMPAIGN.partition("report:")[0])
    execute(campaign, tmp_path / "run", 1, lambda ended: None)
    assert not (tmp_path / "run" / "rankings.json").exists()
    assert read_rankings(read_run(tmp_path / "run")) == ()


def test_names_that_are_not_known_are_told_with_their_places(tmp_path):
    text = CAMPAIGN.replace("fine: 30", "fime: 30").replace("resamples: 200", "experiments: [noise]")
    found = problems(tmp_path, text)
    assert any("no part is named 'fime'; did you mean 'fine'?" in one for one in found), found
    assert any(
        "no metric with one value a case is named 'error_fime'; did you mean 'error_fine'?" in one for one in found
    )
    assert any("no experiment is named 'noise'" in one for one in found)
    assert all("ranked.yaml:" in one for one in found)


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("'error_{observer}'", "error_fine", "wants the name of a metric with {observer} in it once, got 'error_fine'"),
        ("'error_{observer}'", "'{x}_{observer}'", "wants the name of a metric with {observer} in it once"),
        (", poor: 10", "", "wants values of 3 observers or more, got 2"),
        ("poor: 10", "poor: .inf", "wants a finite value of poor, or null for none, got inf"),
        ("resamples: 200", "resamples: 10", "wants at least 100, got 10"),
        ("better: higher", "better: more", "better wants 'lower' or 'higher', got 'more'"),
    ],
)  # fmt: skip
def test_what_is_wrong_with_a_ranking_is_told(tmp_path, old, new, told):
    assert old in CAMPAIGN
    found = problems(tmp_path, CAMPAIGN.replace(old, new))
    assert any(told in one for one in found), found


def test_metrics_of_two_units_are_not_ranked_together(tmp_path):
    text = CAMPAIGN.replace("[plant.y, poor.value], unit: rpm", "[plant.y, poor.value], unit: rad/s")
    with pytest.raises(
        ConfigurationError, match="a ranking wants one unit, got error_fine in rpm and error_poor in rad/s"
    ):
        preflight(read(tmp_path, text))


def test_a_damaged_rankings_file_is_named(tmp_path):
    folder = build_run(tmp_path / "run")
    write_json(folder / "rankings.json", [{"title": "only"}])
    with pytest.raises(RunFolderError, match=r"rankings\.json: an entry is not what a ranking wants: KeyError"):
        read_rankings(read_run(folder))


def test_the_report_draws_sets_without_a_value_and_never_computes_a_correlation(tmp_path):
    folder = build_run(tmp_path / "run")
    observers = ["hybrid", "open_loop", "other"]
    measure = {
        "name": "index", "title": "index", "better": "lower", "values": dict(zip(observers, [2, 3, None], strict=True)),
        "correlation": 0.123, "lower": -0.4, "upper": 0.6, "resamples": 99, "answer": "open",
    }  # fmt: skip
    entry = {
        "title": "Asked", "metric": "m_{observer}", "better": "lower", "unit": "%", "experiments": [], "cases": 9,
        "failed": 0, "resamples": 100, "seed": 4, "level": 0.95, "note": "A note",
        "medians": dict(zip(observers, [1.0, 2.0, None], strict=True)), "measures": [measure],
    }  # fmt: skip
    (folder / "rankings.json").write_text(json.dumps([entry]))
    said = page_of(folder).text("rankings")
    for text in ("0.12", "-0.4 to 0.6", "not shown: the interval holds zero", "A note.", "seed 4"):
        assert text in said.replace("\N{MINUS SIGN}", "-"), text


def test_a_measure_that_is_a_metric_is_drawn_anew_with_the_same_cases():
    draw = np.random.default_rng(4)
    level = np.arange(8.0)[:, None]
    shared = draw.normal(scale=30.0, size=(1, 5))
    costs = level + shared  # what disturbs a case disturbs it for all observers
    found = correlate(2.0 * costs, costs, 500, 3)
    # Drawn with the same cases both medians keep one order in every resample.
    assert found.value == found.lower == found.upper == pytest.approx(1.0)
    plain_medians = correlate(np.median(costs, axis=1), costs, 500, 3)
    assert plain_medians.value == pytest.approx(1.0)


@pytest.mark.parametrize("cases", [1, 6])
def test_the_correlation_of_two_metrics_is_that_of_scipy_of_their_medians(cases):
    draw = np.random.default_rng(8)
    one, other = draw.normal(size=(2, 9, cases))
    expected = stats.spearmanr(np.median(one, axis=1), np.median(other, axis=1)).statistic
    assert correlate(one, other, 200, 0).value == pytest.approx(expected, abs=1e-14)


EXPECTED = """\
    - title: Does what is expected come?
      metric: 'error_{observer}'
      resamples: 200
      measures:
        expected: {title: expected error, values: {fine: 0.1, fair: 1, poor: 10}}
        largest: {title: largest error, metric: 'largest_{observer}', observers: [fine, fair, poor]}
"""
LARGEST = """\
  largest_fine: {max_error: [plant.y, fine.value], unit: rpm}
  largest_fair: {max_error: [plant.y, fair.value], unit: rpm}
  largest_poor: {max_error: [plant.y, poor.value], unit: rpm}
report:
  observers: {fine: {title: Fine encoder}, fair: {title: Fair encoder}, poor: {title: Poor encoder}}
"""


def test_one_metric_is_drawn_against_another_with_the_observers_named(tmp_path):
    text = CAMPAIGN.replace("report:\n", LARGEST) + EXPECTED
    execute(read(tmp_path, text), tmp_path / "run", 1, lambda ended: None)
    run = read_run(tmp_path / "run")
    ranking = read_rankings(run)[1]
    expected, largest = ranking.measures
    assert (expected.unit, largest.unit, largest.metric) == ("1", "rpm", "largest_{observer}")
    for observer, value in largest.values.items():
        assert value == pytest.approx(np.median([case.metrics[f"largest_{observer}"].value for case in run.cases]))
    assert expected.correlation == largest.correlation == pytest.approx(1.0)
    said = page_of(tmp_path / "run").text("rankings")
    assert said.count("Fine encoder") == 4  # beside its point in each of the four panels
    assert "largest error [rpm]" in said


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        (", observers: [fine, fair, poor]}", "}", "measures.largest wants values of 3 observers or more, got 0"),
        ("fair, poor]}", "fair, poor], values: {fine: 1}}", "wants values by observer, or a metric with observers"),
        ("'largest_{observer}'", "'lrgest_{observer}'", "no metric with one value a case is named 'lrgest_fine'"),
        ("observers: [fine,", "observers: [fime,", "no part is named 'fime'; did you mean 'fine'?"),
    ],
)  # fmt: skip
def test_what_is_wrong_with_a_measure_that_is_a_metric_is_told(tmp_path, old, new, told):
    text = CAMPAIGN.replace("report:\n", LARGEST) + EXPECTED
    assert old in text
    found = problems(tmp_path, text.replace(old, new))
    assert any(told in one and "ranked.yaml:" in one for one in found), found


def test_a_measure_of_metrics_of_two_units_is_refused(tmp_path):
    text = CAMPAIGN.replace("report:\n", LARGEST) + EXPECTED
    text = text.replace(
        "{max_error: [plant.y, poor.value], unit: rpm}", "{max_error: [plant.y, poor.value], unit: rad/s}"
    )
    with pytest.raises(
        ConfigurationError, match=r"a ranking wants one unit, got largest_fine in rpm and largest_poor in"
    ):
        preflight(read(tmp_path, text))
