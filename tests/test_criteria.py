"""Criteria are read with their errors at their place, and judged over cases without dropping any."""

import math

import pytest

from harness.criteria import CriterionError, Judged, bound_misfit, judge, parse_criterion
from harness.definitions import Value
from harness.metrics import Result

KNOWN = {
    "rmse": ("rmse", Result("error")),
    "other": ("other", Result("error")),
    "temperature": ("temperature", Result("signal")),
    "located.delay": ("located", Result("s", sampled=True)),
    "located.delay_median": ("located", Result("s")),
}
UNITS = {"rmse": "rad", "other": "mrad", "temperature": "degC", "located.delay": "ms", "located.delay_median": "ms"}


def case(key, outcome="ok", experiment="", delays=(), **values):
    metrics = {name: Value(value, UNITS[name]) for name, value in values.items()}
    return Judged(key, f"case {key}", experiment, outcome, metrics, {"located.delay": list(delays)} if delays else {})


def verdict(text, *cases):
    return judge(parse_criterion(text, KNOWN), cases, UNITS)


def test_a_criterion_is_judged_by_the_worst_case():
    found = verdict("rmse < 1 mrad", case("a", rmse=0.5e-3), case("b", rmse=0.9e-3))
    assert (found.passed, found.value, found.bound, found.unit, found.case) == (
        True,
        pytest.approx(0.9),
        1.0,
        "mrad",
        "b",
    )
    found = verdict("rmse > 0.6 mrad", case("a", rmse=0.5e-3), case("b", rmse=0.9e-3))
    assert (found.passed, found.value, found.case) == (False, pytest.approx(0.5), "a")
    assert found.reason == "0.5 mrad is not > 0.6 mrad in case a"


def test_a_bound_without_unit_is_in_the_unit_of_the_metric():
    assert verdict("rmse < 1e-3", case("a", rmse=0.9e-3)).unit == "rad"


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_a_value_that_is_not_finite_never_passes(value):
    for comparison in ("<", "<=", ">", ">=", "==", "!="):
        assert not verdict(f"rmse {comparison} 1 rad", case("a", rmse=value)).passed


def test_a_failed_case_fails_the_criterion_whatever_the_others_give():
    found = verdict("median(rmse) < 1 rad", case("a", rmse=0.1), case("b", "crash"), case("c", rmse=0.1))
    assert (found.passed, found.case, found.reason) == (False, "b", "case b ended with crash")


def test_a_case_without_the_metric_fails_the_criterion():
    found = verdict("rmse < 1 rad", case("a", rmse=0.1), case("b"))
    assert (found.passed, found.case, found.reason) == (False, "b", "rmse has no finite value in case b")


def test_a_criterion_that_covers_no_case_fails():
    assert verdict("rmse < 1 rad").reason == "covers no case"


def test_two_metrics_are_compared_case_by_case():
    cases = case("a", rmse=0.1, other=250.0), case("b", rmse=1.0, other=2100.0)
    found = verdict("rmse < 0.5 * other", *cases)
    assert (found.passed, found.case) == (True, "a")
    assert (found.value, found.bound, found.unit) == (pytest.approx(0.1), pytest.approx(0.125), "rad")
    assert not verdict("rmse < 0.3 * other", *cases).passed


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("mean(rmse) < 9 rad", 3.0),
        ("median(rmse) < 9 rad", 2.0),
        ("max(rmse) < 9 rad", 6.0),
        ("worst(rmse) < 9 rad", 6.0),
        ("best(rmse) < 9 rad", 1.0),
        ("worst(rmse) > 0 rad", 1.0),
        ("2 * mean(rmse) < 9 rad", 6.0),
        ("9 rad > mean(rmse)", 3.0),
    ],
)
def test_aggregates_over_the_cases_are_what_their_names_say(text, value):
    found = verdict(text, case("a", rmse=2.0), case("b", rmse=1.0), case("c", rmse=6.0))
    assert found.passed
    assert found.value == pytest.approx(value)


def test_p95_over_twenty_cases_is_the_second_largest():
    assert verdict("p95(rmse) < 99 rad", *(case(str(i), rmse=float(i)) for i in range(1, 21))).value == 19.0


def test_samples_are_pooled_over_the_cases():
    cases = case("a", delays=[1.0, 2.0, 3.0]), case("b", delays=[50.0])
    assert verdict("median(located.delay) < 0.02 s", *cases).value == pytest.approx(0.0025)
    assert not verdict("p95(located.delay) < 20 ms", *cases).passed


def test_a_missed_change_among_the_samples_fails_a_percentile():
    assert not verdict("p95(located.delay) < 20 ms", case("a", delays=[1.0, math.inf])).passed


def test_aggregates_may_stand_on_both_sides():
    cases = case("a", rmse=1.0, other=9000.0), case("b", rmse=2.0, other=3000.0)
    assert verdict("max(rmse) < 0.5 * mean(other)", *cases).bound == pytest.approx(3.0)


def test_the_worst_bound_of_a_below_is_the_smallest():
    cases = case("a", rmse=1.0, other=9000.0), case("b", rmse=2.0, other=3000.0)
    assert verdict("worst(rmse) < worst(other)", *cases).bound == pytest.approx(3.0)
    assert verdict("mean(rmse) < best(other)", *cases).bound == pytest.approx(9.0)
    assert verdict("worst(rmse) < p95(other)", *cases).bound == pytest.approx(9.0)


def test_an_absolute_temperature_is_compared_with_the_offset_of_its_unit():
    found = verdict("temperature < 300 K", case("a", temperature=20.0))
    assert (found.value, found.passed) == (pytest.approx(293.15), True)


@pytest.mark.parametrize(
    ("text", "said", "offset"),
    [
        ("rmsee < 1 rad", "did you mean 'rmse'", 0),
        ("rmse < 1 raad", "unknown unit 'raad'", 8),
        ("rmse 1 rad", "got none", 0),
        ("rmse = 1 rad", "got =", 5),
        ("0 < rmse < 1 rad", "got < and <", 2),
        ("1 < 2", "wants a metric on one side", 0),
        ("medain(rmse) < 1 rad", "no aggregate is named 'medain'; did you mean 'median'", 0),
        ("located.delay < 1 s", "wants an aggregate like p95(located.delay)", 0),
        ("rmse < p95(other)", "on both sides or on none", 6),
        ("rmse < 0.5 * othr", "did you mean 'other'", 13),
        ("rmse < 0.5 other", "write '0.5 * other'", 10),
        ("rmse <", "wants a metric or a number", 6),
    ],
)
def test_what_cannot_be_read_is_told_at_its_place(text, said, offset):
    with pytest.raises(CriterionError) as error:
        parse_criterion(text, KNOWN)
    assert said in str(error.value)
    assert error.value.offset == offset


def test_a_bound_of_another_dimension_names_both_units():
    assert bound_misfit(parse_criterion("rmse < 1 s", KNOWN), UNITS) == "'rmse < 1 s': rmse is in rad, the bound in s"
    assert bound_misfit(parse_criterion("rmse < 1 mrad", KNOWN), UNITS) == ""
    assert "located.delay_median is in ms" in bound_misfit(parse_criterion("located.delay_median < rmse", KNOWN), UNITS)


def test_of_values_that_never_came_a_median_counts_them_as_the_worst():
    cases = [case(key, rmse=value) for key, value in zip("abc", (1.0, 2.0, math.inf), strict=True)]
    assert verdict("median(rmse) < 3 rad", *cases).value == 2.0
    assert verdict("median(rmse) < 3 rad", *cases).passed
    assert not verdict("p95(rmse) < 3 rad", *cases).passed
    assert not verdict("mean(rmse) < 3 rad", *cases).passed


@pytest.mark.parametrize("comparison", ["<", "<=", ">", ">=", "==", "!="])
def test_two_values_that_never_came_are_no_match_for_each_other_and_decide(comparison):
    both = case("b", rmse=math.inf, other=math.inf)
    found = verdict(f"rmse {comparison} other", case("a", rmse=1.0, other=2000.0), both)
    assert (found.passed, found.case) == (False, "b")
