"""Normalised errors and settling, each against its closed form."""

import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from pydantic import ValidationError
from records import TIME, measured, on_crank, record, values_of

from harness.definitions import Definition, misfits
from harness.errormetrics import nrmse, settling
from harness.places import Places

PAIR = ["plant.x", "observer.x"]
STEP = np.where(TIME < 0.5, 10.0, 14.0)


@pytest.mark.parametrize(
    ("by", "divisor"),
    [
        ("range", 4.0),
        ("mean", (500 * 10.0 + 501 * 14.0) / 1001),
        (
            "std",
            4.0 * math.sqrt(500 * 501) / 1001,
        ),  # of two values with the shares p and 1 - p: |a - b| sqrt(p (1 - p))
        ("5 rad", 5.0),
        ("5000 mrad", 5.0),
    ],
)
def test_an_rmse_is_divided_by_what_the_campaign_says(by, divisor):
    columns = {"plant.x": (STEP, "rad"), "observer.x": (STEP + 0.5, "rad")}
    found = measured({"nrmse": {"error": PAIR, "by": by}}, columns).values["m"]
    assert found == (pytest.approx(0.5 / divisor, rel=1e-12), "1")
    shown = measured({"nrmse": {"error": PAIR, "by": by}, "unit": "%"}, columns).values["m"]
    assert shown == (pytest.approx(50.0 / divisor, rel=1e-12), "%")


def test_the_normaliser_is_of_the_truth_in_the_window_and_none_where_the_truth_stands_still():
    columns = {"plant.x": (STEP, "rad"), "observer.x": (STEP + 0.5, "rad")}
    definition = {"nrmse": {"error": PAIR, "by": "range"}, "until": "0.4 s"}
    assert math.isnan(values_of(definition, record(columns))[""])


@settings(max_examples=50, deadline=None)
@given(
    st.lists(st.tuples(st.floats(-100, 100), st.floats(-100, 100)), min_size=2, max_size=20),
    st.floats(0.01, 100),
    st.floats(-1000, 1000),
)
def test_a_share_of_the_range_does_not_depend_on_the_unit_nor_on_the_zero(rows, scale, offset):
    truth, estimate = np.array(rows).T
    assume(np.ptp(truth) > 1e-3)  # else nothing of the range is left beside the rounding of the offset
    before = nrmse(estimate - truth, truth, "range")
    after = nrmse((scale * estimate + offset) - (scale * truth + offset), scale * truth + offset, "range")
    # The offset of up to 1e3 over a range of at least 1e-5 costs up to eight of sixteen digits.
    assert after == pytest.approx(before, rel=1e-7, abs=1e-7)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"error": PAIR}, "by"),
        ({"error": PAIR, "by": "median"}, "wants range, mean, std or a value with its unit, got 'median'"),
        ({"error": PAIR, "by": "-2 rad"}, "wants a value above 0"),
        ({"error": {"pairs": [PAIR], "scales": ["1 rad"]}, "by": "range"}, "wants an error without scales"),
        ({"error": [PAIR, PAIR], "by": "range"}, "wants one pair"),
    ],
)
def test_a_normaliser_that_says_nothing_is_refused(arguments, message):
    with pytest.raises(ValidationError, match=message):
        Definition.model_validate({"nrmse": arguments})


def test_a_value_to_divide_by_has_the_dimension_of_the_error():
    signals = {
        signal.name: signal for signal in record({"plant.x": (TIME, "rad"), "observer.x": (TIME, "rad")}).signals
    }
    definition = Definition.model_validate({"nrmse": {"error": PAIR, "by": "5 rpm"}})
    (problem,) = misfits("m", definition, signals, Places("c.yaml"))
    assert problem.message == "metrics.m: by wants rad, got 5.0 rpm"


def decay(columns=None):
    """An error 2 exp(-10 t) from 0.2 s on, before it 2."""
    error = 2.0 * np.exp(-10.0 * np.maximum(TIME - 0.2, 0.0))
    return {"plant.x": (np.zeros(1001), "rad"), "observer.x": (-error, "rad"), **(columns or {})}


def test_an_exponential_settles_when_it_falls_below_the_bound():
    definition = {"settling": {"error": PAIR, "bound": "0.1 rad"}, "after": "0.2 s", "unit": "ms"}
    found = measured(definition, decay()).values["m"]
    # The first row at or after 0.1 ln(2/0.1) = 299.57 ms.
    assert found == (pytest.approx(300.0, abs=1e-9), "ms")


def test_settling_counts_from_the_instant_asked_for_not_from_the_first_row_after_it():
    # One row in 100 kept: 0, 0.1, 0.2 ... s; the error is within from 0.5 s on, 2 exp(-3) = 0.0996.
    columns = {name: (values[::100], unit) for name, (values, unit) in decay().items()}
    definition = {"settling": {"error": PAIR, "bound": "0.1 rad"}, "after": "0.25 s"}
    assert values_of(definition, record(columns, TIME[::100]))[""] == pytest.approx(0.5 - 0.25)
    assert values_of({**definition, "after": "-3 s"}, record(columns, TIME[::100]))[""] == pytest.approx(0.5)


def test_settling_from_a_crank_angle_counts_from_the_time_it_is_reached():
    columns = {name: (values[::100], unit) for name, (values, unit) in decay().items()}
    recorded = on_crank(columns, 600.0 * np.arange(11))  # 0.1 s a row
    definition = {"settling": {"error": PAIR, "bound": "0.1 rad"}, "after": "1500 deg"}
    assert values_of(definition, recorded)[""] == pytest.approx(0.5 - 0.25)


def test_what_leaves_the_bound_at_the_last_row_never_settles():
    errors = np.array([0.0, 0.0, 0.0, 5.0])
    assert settling(np.arange(4.0), errors, 1.0, 0.0) == math.inf
    assert settling(np.arange(4.0), errors[:3], 1.0, 0.0) == 0.0
    assert settling(np.arange(4.0), np.array([0.0, np.nan, 0.0, 0.0]), 1.0, 0.0) == 2.0


def test_settling_takes_its_bound_from_a_signal_too():
    bound = np.where(TIME < 0.6, 0.0, 3.0)
    definition = {"settling": {"error": PAIR, "bound": "observer.bound"}}
    assert values_of(definition, record(decay({"observer.bound": (bound, "rad")})))[""] == pytest.approx(0.6)


@settings(max_examples=50, deadline=None)
@given(st.lists(st.floats(0, 10), min_size=1, max_size=30), st.floats(0.1, 9))
def test_settling_is_what_looking_at_every_row_finds(errors, bound):
    time = 0.5 * np.arange(len(errors))
    within = [all(error <= bound for error in errors[row:]) for row in range(len(errors))]
    expected = time[within.index(True)] if True in within else math.inf
    assert settling(time, np.array(errors), bound, 0.0) == expected
