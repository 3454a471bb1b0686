"""Each metric against its closed form on signals made by hand."""

import math

import numpy as np
import pytest
from records import TIME, measured, on_crank, record, values_of

from fmus.component import Signal
from harness.definitions import Definition, digest, measure, misfits, shown_unit
from harness.diagnosismetrics import detection
from harness.metrics import KINDS
from harness.percentile import percentile
from harness.places import Places
from harness.record import Record
from harness.signalmetrics import dwell_min


def sine():
    return np.sin(2 * np.pi * TIME)


def test_the_rmse_of_a_sine_is_its_amplitude_over_the_root_of_two():
    values, _, _ = measured(
        {"rmse": ["plant.x", "observer.x"], "until": "0.999 s"},
        {"plant.x": (np.zeros(1001), "rad"), "observer.x": (3 * sine(), "rad")},
    )
    # One whole period of samples: the mean of sin^2 is exactly 1/2 up to rounding.
    assert values["m"].value == pytest.approx(3 / math.sqrt(2), rel=1e-12)
    assert values["m"].unit == "rad"


def test_bias_and_maximum_error_keep_apart_what_is_constant_and_what_is_not():
    columns = {"plant.x": (np.zeros(1001), "rad"), "observer.x": (sine() - 0.25, "rad")}
    window = {"until": "0.999 s"}
    assert measured({"bias": ["plant.x", "observer.x"], **window}, columns)[0]["m"].value == pytest.approx(-0.25)
    assert measured({"max_error": ["plant.x", "observer.x"]}, columns)[0]["m"].value == pytest.approx(1.25)


def test_a_norm_over_pairs_weighs_each_with_its_scale():
    columns = {
        "plant.a": (np.zeros(1001), "rad"),
        "observer.a": (np.full(1001, 0.3), "rad"),
        "plant.b": (np.zeros(1001), "rpm"),
        "observer.b": (np.full(1001, 40.0 * 2 * np.pi / 60), "rpm"),
    }
    pairs = [["plant.a", "observer.a"], ["plant.b", "observer.b"]]
    values, _, _ = measured({"rmse": {"pairs": pairs, "scales": ["0.1 rad", "10 rpm"]}}, columns)
    assert values["m"].value == pytest.approx(5.0)  # 3-4-5
    assert values["m"].unit == "1"


def test_the_share_within_a_bound_counts_rows_and_takes_the_bound_from_a_signal_too():
    columns = {
        "plant.x": (np.zeros(1001), "rad"),
        "observer.x": (np.where(TIME < 0.25, 0.2, 0.05), "rad"),
        "observer.bound": (np.where(TIME < 0.125, 0.3, 0.1), "rad"),
    }
    fixed = {"share_within": {"error": ["plant.x", "observer.x"], "bound": "0.1 rad"}}
    assert measured(fixed, columns)[0]["m"].value == pytest.approx(751 / 1001)
    moving = {"share_within": {"error": ["plant.x", "observer.x"], "bound": "observer.bound"}, "unit": "%"}
    assert measured(moving, columns)[0]["m"] == (pytest.approx(100 * 876 / 1001), "%")


def test_a_detection_takes_from_the_change_to_the_first_equal_row():
    truth = np.where(TIME < 0.2, 1, np.where(TIME < 0.6, 2, 3))
    estimate = np.where(TIME < 0.23, 1, np.where(TIME < 0.67, 2, 3))
    values, samples, _ = measured(
        {"detection": ["plant.q", "observer.q"], "unit": "ms"},
        {"plant.q": (truth, "1"), "observer.q": (estimate, "1")},
    )
    assert samples["m.delay"] == pytest.approx([30.0, 70.0])
    assert values["m.delay_median"] == (pytest.approx(50.0), "ms")
    assert values["m.delay_p95"].value == pytest.approx(70.0)
    assert values["m.missed"].value == 0
    assert values["m.false_alarms_per_min"] == (0.0, "1/min")
    assert values["m.accuracy"].value == pytest.approx(1 - 100 / 1001)


def test_a_detection_counts_engine_cycles_where_it_is_given_one():
    crank = 6.0 * np.arange(1001)
    truth = np.where(crank < 1440.0, 0, np.where(crank < 3600.0, 1, 2))
    estimate = np.where(crank < 1800.0, 0, 1)  # half a cycle late, and the second change missed
    columns = {"plant.q": (truth, "1"), "observer.q": (estimate, "1")}
    pair = ["plant.q", "observer.q"]
    found = measured({"detection": {"pair": pair, "cycle": "720 deg"}, "unit": "ms"}, on_crank(columns, crank))
    assert found.samples["m.delay_cycles"] == pytest.approx([0.5, math.inf])
    assert found.values["m.delay_cycles_median"] == (math.inf, "1")
    assert found.samples["m.delay"] == pytest.approx([360.0 / 6000.0 * 1e3, math.inf])
    until = {"detection": {"pair": pair, "cycle": "1 rev"}, "until": "2160 deg"}
    assert values_of(until, on_crank(columns, crank))["delay_cycles_p95"] == pytest.approx(1.0)
    without = measured({"detection": pair}, on_crank(columns, crank))
    assert not any("cycle" in name for name in (*without.values, *without.samples))


def test_a_detection_in_cycles_on_a_time_clock_wants_the_signal_of_the_angle():
    columns = {"plant.q": (np.where(TIME < 0.5, 0, 1), "1"), "observer.q": (np.where(TIME < 0.6, 0, 1), "1")}
    turning = {**columns, "crank.angle": (80.0 * np.pi * TIME, "rad")}  # 2400 rpm: 20 cycles a second
    definition = {"detection": {"pair": ["plant.q", "observer.q"], "cycle": "720 deg"}, "angle": "crank.angle"}
    assert values_of(definition, record(turning))["delay_cycles_median"] == pytest.approx(2.0)


def test_a_change_not_seen_before_the_next_one_is_missed_and_its_delay_infinite():
    truth = np.where((TIME >= 0.2) & (TIME < 0.3), 2, 1)
    found = detection(TIME, truth, np.ones(1001))
    assert list(found["delay"]) == [math.inf, 0.0]
    assert found["missed"] == 1
    assert found["false_alarms"] == 0


def test_a_false_alarm_is_a_move_to_a_wrong_value_while_nothing_is_pending():
    truth = np.where(TIME < 0.5, 1, 2)
    # Wrong at 0.1 s (alarm), back at 0.2 s; the wrong guess at 0.52 s falls while the change at 0.5 s is pending.
    estimate = np.select([TIME < 0.1, TIME < 0.2, TIME < 0.52, TIME < 0.55], [1, 3, 1, 3], 2)
    found = detection(TIME, truth, estimate)
    assert found["false_alarms"] == 1
    assert found["false_alarms_per_min"] == pytest.approx(60.0)
    assert list(found["delay"]) == pytest.approx([0.05])


def test_a_truth_that_never_changes_leaves_nothing_to_detect():
    found = detection(TIME, np.ones(1001), np.where(TIME < 0.5, 1, 2))
    assert (len(found["delay"]), found["missed"], found["false_alarms"]) == (0, 0, 1)
    assert math.isnan(found["delay_median"])


def test_an_estimate_that_was_there_before_the_truth_has_no_delay_but_was_an_alarm():
    found = detection(TIME, np.where(TIME < 0.5, 1, 2), np.where(TIME < 0.4, 1, 2))
    assert list(found["delay"]) == [0.0]
    assert found["false_alarms"] == 1


def test_the_spread_is_the_mean_of_the_largest_less_the_smallest_signal():
    columns = {
        "engine.imep_1": (np.full(1001, 9e5), "Pa"),
        "engine.imep_2": (np.where(TIME < 0.5005, 8e5, 9.4e5), "Pa"),
        "engine.imep_3": (np.full(1001, 8.5e5), "Pa"),
    }
    values, _, _ = measured({"spread": list(columns), "unit": "bar"}, columns)
    # 501 rows from 8 to 9 bar, 500 from 8.5 to 9.4 bar.
    assert values["m"].value == pytest.approx((501 * 1.0 + 500 * 0.9) / 1001)
    assert values["m.final"].value == pytest.approx(0.9)


def test_the_convergence_rate_of_an_exponential_is_its_exponent():
    columns = {"plant.x": (np.zeros(1001), "rad"), "observer.x": (2 * np.exp(-12.0 * TIME), "rad")}
    definition = {"convergence_rate": {"error": ["plant.x", "observer.x"], "demanded": "10 1/s"}, "after": "0.1 s"}
    values, _, _ = measured(definition, columns)
    # A straight line in the logarithm: the fit is exact up to rounding.
    assert values["m"] == (pytest.approx(12.0, rel=1e-10), "1/s")
    assert values["m.ratio"].value == pytest.approx(1.2, rel=1e-10)


def test_the_shortest_dwell_is_between_two_changes():
    signal = np.select([TIME < 0.1, TIME < 0.4, TIME < 0.45], [1, 2, 3], 1)
    columns = {"plant.q": (signal, "1")}
    assert measured({"dwell_min": "plant.q", "unit": "ms"}, columns)[0]["m"] == (pytest.approx(50.0), "ms")
    assert dwell_min(TIME, np.ones(1001)) == pytest.approx(1.0)


def test_values_of_a_signal_are_shown_with_the_offset_of_their_unit_and_errors_without():
    columns = {"plant.T": (np.full(1001, 300.0), "degC"), "observer.T": (np.full(1001, 301.5), "degC")}
    assert measured({"mean": "plant.T"}, columns)[0]["m"] == (pytest.approx(26.85), "degC")
    assert measured({"final": "plant.T", "unit": "K"}, columns)[0]["m"] == (pytest.approx(300.0), "K")
    assert measured({"rmse": ["plant.T", "observer.T"]}, columns)[0]["m"] == (pytest.approx(1.5), "degC")


@pytest.mark.parametrize("kind", ["minimum", "maximum", "mean", "final"])
def test_the_values_of_a_constant_signal_are_the_constant(kind):
    assert measured({kind: "plant.x"}, {"plant.x": (np.full(1001, 4.0), "rad")})[0]["m"].value == 4.0


PAIR = ["plant.x", "observer.x"]
# What each kind is given at the least.
ARGUMENTS = {
    "nrmse": {"error": PAIR, "by": "range"},
    "share_within": {"error": PAIR, "bound": "1 rad"},
    "settling": {"error": PAIR, "bound": "1 rad"},
    "convergence_rate": {"error": PAIR, "demanded": "1 1/s"},
    "nees": {"pairs": [PAIR], "std": ["observer.x"]},
    "nis": {"innovations": ["observer.x"], "std": ["observer.x"]},
    "alarm": {"pair": PAIR, "cycle": "720 deg"},
    "confusion": {"pair": PAIR, "classes": [0, 1]},
    "crank_average": {"signal": "plant.x", "firing_order": [1, 2]},
    "crank_error": {"error": PAIR},
    "harmonic": {"signal": "plant.x", "per_cycle": 1},
    "harmonic_error": {"error": PAIR, "per_cycle": 1},
    **dict.fromkeys(("dwell_min", "final", "minimum", "maximum", "mean"), "plant.x"),
}
COUNTS = {"missed", "changes", "faults", "false_alarms", "samples", "indefinite", "windows", "cycles", "dropped"}


@pytest.mark.parametrize("kind", KINDS)
def test_an_empty_window_gives_no_number_rather_than_an_error(kind):
    columns = {"plant.x": (sine(), "rad"), "observer.x": (sine(), "rad")}
    definition = {kind: ARGUMENTS.get(kind, PAIR), "after": "7 s"}
    values = values_of(definition, record(columns, crank=6.0 * np.arange(1001)))
    results = Definition.model_validate(definition).results
    assert values.keys() == {suffix for suffix, result in results.items() if not result.sampled}
    assert all(value == 0 if name in COUNTS else math.isnan(value) for name, value in values.items())


def test_the_ends_of_a_window_belong_to_it_even_where_a_product_misses_them_by_rounding():
    time = np.arange(0, 11) * 0.1  # 3 * 0.1 is above 0.3, 7 * 0.1 above 0.7
    definition = Definition.model_validate({"detection": ["a.q", "b.q"], "after": "0.3 s", "until": "0.7 s"})
    truth = np.where(time < 0.65, 1.0, 2.0)
    signals = (Signal("a.q"), Signal("b.q"))
    values, _, _ = measure({"m": definition}, Record(signals, time, np.column_stack([truth, truth])), "")
    assert values["m.changes"].value == 1


def test_a_metric_for_one_experiment_is_not_measured_in_another():
    columns = {"plant.x": (sine(), "rad")}
    assert measured({"mean": "plant.x", "only": ["figure_6"]}, columns, "steps") == ({}, {}, {})


def test_the_nearest_rank_percentile_is_a_sample():
    assert percentile(np.arange(1.0, 21.0), 95.0) == 19.0
    assert percentile(np.array([1.0, math.inf]), 95.0) == math.inf
    assert math.isnan(percentile(np.array([]), 50.0))


def test_names_and_units_that_do_not_fit_are_told():
    signals = {signal.name: signal for signal in (Signal("plant.x", "rad"), Signal("observer.w", "rpm"))}

    def said(definition):
        found = misfits("m", Definition.model_validate(definition), signals, Places("c.yaml"))
        return " ".join(problem.message for problem in found)

    assert "no recorded signal is named 'plant.y'; did you mean 'plant.x'?" in said({"mean": "plant.y"})
    assert "observer.w wants rad like plant.x, got rpm" in said({"rmse": ["plant.x", "observer.w"]})
    assert "unit wants rad or alike, got s" in said({"mean": "plant.x", "unit": "s"})
    within = {"error": ["plant.x", "plant.x"], "bound": "3 rpm"}
    assert "the bound wants rad" in said({"share_within": within})
    pairs = [["plant.x", "plant.x"], ["observer.w", "observer.w"]]
    assert "wants scales" in said({"rmse": pairs})


def test_the_unit_shown_of_a_detection_is_that_of_its_delays_only():
    definition = Definition.model_validate({"detection": ["plant.q", "observer.q"], "unit": "ms"})
    results = definition.kind.results
    assert shown_unit(definition, results["delay"], {}) == "ms"
    assert shown_unit(definition, results["missed"], {}) == "1"


def test_a_unit_of_shares_is_not_that_of_counts():
    columns = {"plant.q": (TIME > 0.5, "1"), "observer.q": (TIME > 0.6, "1")}
    found = measured({"detection": ["plant.q", "observer.q"], "unit": "%"}, columns).values
    assert (found["m.accuracy"].unit, found["m.changes"]) == ("%", (1.0, "1"))


def test_another_definition_has_another_digest():
    first, second = (Definition.model_validate({"mean": "plant.x", "after": after}) for after in ("1 s", "2 s"))
    assert digest({"m": first}) != digest({"m": second})
    assert digest({"m": first}) == digest({"m": Definition.model_validate({"mean": "plant.x", "after": "1 s"})})
