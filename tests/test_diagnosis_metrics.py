"""Alarms and confusions against counts made by hand and row by row."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError
from records import TIME, measured, on_crank, record, values_of

from fmus.component import Signal
from harness.definitions import Definition, misfits, results
from harness.diagnosismetrics import alarm, confusion
from harness.places import Places

PAIR = ["plant.fault", "monitor.alarm"]


def within(*spans):
    return np.any([(start <= TIME) & (end > TIME) for start, end in spans], axis=0).astype(float)


def diagnosed(fault, raised):
    return {"plant.fault": (fault, "1", "boolean"), "monitor.alarm": (raised, "1", "boolean")}


def test_an_alarm_is_measured_in_delay_misses_false_alarms_and_rates():
    fault = within((0.2, 0.3), (0.6, 0.7))
    # Seen after 20 ms and kept 50 ms beyond the fault; one alarm without a fault; the second fault is missed.
    raised = within((0.22, 0.35), (0.4, 0.45))
    values, samples, _ = measured({"alarm": PAIR, "unit": "ms"}, diagnosed(fault, raised))
    assert samples["m.delay"] == pytest.approx([20.0, math.inf])
    assert (values["m.faults"].value, values["m.missed"].value, values["m.false_alarms"].value) == (2, 1, 1)
    assert values["m.delay_median"] == (math.inf, "ms")
    # 1 s less two faults of 100 rows: each row stands for the millisecond before it.
    assert values["m.false_alarms_per_hour"] == (pytest.approx(1 / (0.8 / 3600)), "1/h")
    assert values["m.true_positive_rate"].value == pytest.approx(80 / 200)
    assert values["m.false_positive_rate"].value == pytest.approx(100 / 801)
    assert "m.false_alarms_per_cycle" not in values


def test_false_alarms_per_cycle_are_over_the_cycles_without_a_fault():
    fault, raised = within((0.5, 2.0)), within((0.1, 0.2), (0.3, 0.4), (0.6, 2.0))
    recorded = on_crank(diagnosed(fault, raised), 6.0 * np.arange(1001))
    found = values_of({"alarm": {"pair": PAIR, "cycle": "720 deg"}}, recorded)
    # The fault starts with row 500: rows 0 to 499 are 499 steps of 6 deg without it.
    assert found["false_alarms_per_cycle"] == pytest.approx(2 / (499 * 6 / 720))
    assert found["delay_cycles_median"] == pytest.approx(100 * 6 / 720)  # from row 500 to row 600
    two_stroke = values_of({"alarm": {"pair": PAIR, "cycle": "1 rev"}}, recorded)
    assert two_stroke["false_alarms_per_cycle"] == pytest.approx(1 / (499 * 6 / 720))


def test_what_is_on_at_the_first_row_starts_there():
    ones, zeros = np.ones(1001), np.zeros(1001)
    found = alarm(TIME, ones, within((0.3, 0.4)), None)
    assert (list(found["delay"]), found["faults"]) == (pytest.approx([0.3]), 1)
    assert math.isnan(found["false_alarms_per_hour"]) and math.isnan(found["false_positive_rate"])
    found = alarm(TIME, zeros, ones, None)
    assert (found["faults"], found["false_alarms"], found["false_positive_rate"]) == (0, 1, 1.0)
    assert math.isnan(found["true_positive_rate"]) and math.isnan(found["delay_p95"])


def test_an_alarm_that_was_on_before_its_fault_has_no_delay_but_was_false():
    found = alarm(TIME, within((0.5, 0.6)), within((0.4, 0.55)), None)
    assert (list(found["delay"]), found["false_alarms"]) == ([0.0], 1)


@settings(max_examples=50, deadline=None)
@given(st.lists(st.tuples(st.booleans(), st.booleans()), min_size=1, max_size=40))
def test_an_alarm_is_what_looking_at_every_row_finds(rows):
    fault, raised = np.array(rows, dtype=float).T
    time = 2.0 * np.arange(len(rows))
    delays: list[float] = []
    false, pending, sound = 0, None, 0.0
    for row, (faulty, on) in enumerate(rows):
        before_fault, before_on = rows[row - 1] if row else (False, False)
        if row and not faulty:
            sound += 2.0
        if on and not before_on and not faulty:
            false += 1
        if faulty and not before_fault:
            delays.append(math.inf)
            pending = row
        if faulty and on and pending is not None:
            delays[-1], pending = time[row] - time[pending], None
        if not faulty:
            pending = None
    found = alarm(time, fault, raised, None)
    assert list(found["delay"]) == delays
    assert found["false_alarms"] == false
    assert found["missed"] == sum(math.isinf(delay) for delay in delays)
    if sound:
        assert found["false_alarms_per_hour"] == pytest.approx(false * 3600 / sound, rel=1e-12)


def test_rates_of_an_alarm_are_the_recalls_of_its_confusion():
    fault, raised = within((0.2, 0.3), (0.6, 0.9)), within((0.25, 0.4), (0.5, 0.7))
    rates = values_of({"alarm": PAIR}, record(diagnosed(fault, raised)))
    counted = values_of(
        {"confusion": {"pair": PAIR, "classes": {"sound": 0, "faulty": 1}}}, record(diagnosed(fault, raised))
    )
    assert rates["true_positive_rate"] == counted["recall_faulty"]
    assert rates["false_positive_rate"] == pytest.approx(1 - counted["recall_sound"], rel=1e-12)


# Misfires by cylinder, 0 none: by hand, N = [[4, 1, 0], [0, 2, 1], [0, 0, 2]].
TRUE = [0, 0, 0, 0, 0, 1, 1, 1, 2, 2]
SEEN = [0, 0, 0, 0, 1, 1, 1, 2, 2, 2]


def misfires(kind="integer"):
    return record({"plant.q": (TRUE, "1", kind), "observer.q": (SEEN, "1", kind)}, np.arange(10.0))


def test_a_confusion_counts_rows_by_true_and_estimated_class():
    definition = {"confusion": {"pair": ["plant.q", "observer.q"], "classes": {"none": 0, "first": 1, "second": 2}}}
    found = measured(definition, misfires())
    assert found.matrices["m"] == (["none", "first", "second"], [[4, 1, 0], [0, 2, 1], [0, 0, 2]])
    values = {name: value.value for name, value in found.values.items()}
    assert values == {
        "m.accuracy": 0.8,
        "m.recall_none": 0.8,
        "m.precision_none": 1.0,
        "m.recall_first": pytest.approx(2 / 3),
        "m.precision_first": pytest.approx(2 / 3),
        "m.recall_second": 1.0,
        "m.precision_second": pytest.approx(2 / 3),
    }
    shown = measured({**definition, "unit": "%"}, misfires()).values["m.recall_none"]
    assert shown == (pytest.approx(80.0), "%")


def test_classes_are_found_where_none_are_named():
    found = measured({"confusion": ["plant.q", "observer.q"]}, misfires())
    assert found.matrices["m"] == (["0", "1", "2"], [[4, 1, 0], [0, 2, 1], [0, 0, 2]])
    assert list(found.values) == ["m.accuracy"]


def test_what_is_no_class_counts_as_other_and_is_never_right():
    found = measured({"confusion": {"pair": ["plant.q", "observer.q"], "classes": [0, 1]}}, misfires())
    assert found.matrices["m"] == (["0", "1", "other"], [[4, 1, 0], [0, 2, 1], [0, 0, 2]])
    assert found.values["m.accuracy"].value == 0.6
    assert found.values["m.recall_1"].value == pytest.approx(2 / 3)


def test_a_class_that_never_comes_has_no_recall_and_no_precision():
    found = values_of({"confusion": {"pair": ["plant.q", "observer.q"], "classes": [0, 1, 2, 7]}}, misfires())
    assert math.isnan(found["recall_7"]) and math.isnan(found["precision_7"])
    assert found["accuracy"] == 0.8


@settings(max_examples=50, deadline=None)
@given(
    st.lists(st.tuples(st.integers(0, 4), st.integers(0, 4)), min_size=1, max_size=60),
    st.permutations(range(5)),
)
def test_a_confusion_keeps_every_row_and_does_not_depend_on_the_order_of_rows_or_names(rows, order):
    truth, estimate = np.array(rows, dtype=float).T
    found = confusion(truth, estimate, {str(value): float(value) for value in range(5)})
    counts = np.array(found["matrix"].counts)
    assert counts.sum() == len(rows)
    assert all(counts[true, seen] == rows.count((true, seen)) for true in range(5) for seen in range(5))
    renamed = confusion(truth[::-1], estimate[::-1], {str(value): float(value) for value in order})
    assert np.array_equal(np.array(renamed["matrix"].counts), counts[np.ix_(order, order)])
    assert {name: found[name] for name in found if name != "matrix" and not np.isnan(found[name])} == {
        name: renamed[name] for name in renamed if name != "matrix" and not np.isnan(renamed[name])
    }


def test_criteria_may_name_the_classes_named_and_no_others():
    named = Definition.model_validate({"confusion": {"pair": PAIR, "classes": {"closed": -1, "open": 1}}})
    assert [name for name in results({"m": named})] == [
        "m.accuracy",
        "m.recall_closed",
        "m.recall_open",
        "m.precision_closed",
        "m.precision_open",
    ]


@pytest.mark.parametrize(
    ("classes", "message"),
    [
        ([0, -1], r"wants whole numbers from 0 on, or names for them like \{closed: -1\}"),
        ([0.5], "wants whole numbers"),
        ({"not a name": 1}, "a name wants letters, digits and _"),
        ({"other": 1}, "and not 'other'"),
        ({"a": 1, "b": 1}, "want a value each"),
    ],
)
def test_classes_that_cannot_be_told_apart_are_refused(classes, message):
    with pytest.raises(ValidationError, match=message):
        Definition.model_validate({"confusion": {"pair": PAIR, "classes": classes}})


def test_real_signals_want_their_classes_named():
    signals = {name: Signal(name) for name in PAIR}
    found = misfits("m", Definition.model_validate({"confusion": PAIR}), signals, Places("c.yaml"))
    assert "plant.fault is real: a confusion of it wants its classes" in found[0].message
    named = Definition.model_validate({"confusion": {"pair": PAIR, "classes": [0, 1]}})
    assert misfits("m", named, signals, Places("c.yaml")) == []


def test_alarms_per_cycle_want_a_crank_angle_before_the_run():
    signals = {name: Signal(name, kind="boolean") for name in PAIR} | {"crank.angle": Signal("crank.angle", "rad")}
    definition = {"alarm": {"pair": PAIR, "cycle": "720 deg"}}
    (problem,) = misfits("m", Definition.model_validate(definition), signals, Places("c.yaml"))
    assert "cycle wants the crank angle of the rows" in problem.message
    assert "`angle: part.signal`" in problem.message
    for sound, apart in ((definition, 6.0), ({**definition, "angle": "crank.angle"}, None)):
        assert misfits("m", Definition.model_validate(sound), signals, Places("c.yaml"), apart) == []
