"""Faults on sensors and wires, swapped wires, and the signal that tells the truth about them."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from lawbook import check_component
from loop_parts import StatusPart
from oracle import run_plainly
from test_run import scenarios

from fmus.component import ConfigurationError, Signal
from harness.campaign import read_campaign
from harness.cases import execute
from harness.clock import CrankGrid, Pace
from harness.faults import ActingFault, Sampling, Window
from harness.onwire import Given
from harness.record import Record
from harness.run import run
from harness.scenario import Scenario
from harness.sensor import Errors, SensorComponent
from harness.swap import SwapComponent
from harness.wiring import System, wire
from reports.folder import read_run
from reports.html import write_report
from reports.traces import declared_figures

RPM = 2.0 * math.pi / 60.0
PLANT = {"use": "loop_parts:truth"}
BIAS = {"bias": "60 rpm", "from": "3 ms", "to": "6 ms"}


def system(parts: dict[str, Any], stop: str = "10 ms", **rest: Any) -> System:
    clock = {"time": {"step": "1 ms", "stop": stop}}
    return wire(Scenario.model_validate({"clock": clock, "parts": parts, **rest}))


def record(parts: dict[str, Any], stop: str = "10 ms", **rest: Any) -> Record:
    wired = system(parts, stop, **rest)
    found = run(wired)
    assert found.outcome == "ok", found.message
    assert np.array_equal(np.column_stack([found.time, found.values]), run_plainly(wired)), "C and plain Python"
    return found


def problems(parts: dict[str, Any], **rest: Any) -> list[str]:
    with pytest.raises(ConfigurationError) as caught:
        system(parts, **rest)
    return [problem.message for problem in caught.value.problems]


def source(**keys: Any) -> dict[str, Any]:
    return {"use": "source", "unit": "1", **(keys or {"constant": 1})}


def follower(source_: Any, **keys: Any) -> dict[str, Any]:
    """A part with one input that its output does not depend on directly."""
    return {"use": "loop_parts:linear", "wires": {"u0": source_}, **keys}


def faulty(of: str, *faults: dict[str, Any]) -> dict[str, Any]:
    return {"from": of, "faults": list(faults)}


# The fault signal


def test_the_fault_signal_marks_exactly_the_rows_whose_reading_the_fault_changes() -> None:
    found = record({"plant": PLANT, "encoder": {"use": "sensor", "of": "plant.y", "faults": [BIAS]}})
    assert found["encoder.fault"].tolist() == [0, 0, 0, 1, 1, 1, 0, 0, 0, 0, 0]
    assert np.array_equal(found["encoder.value"] != found["plant.y"], found["encoder.fault"] != 0)


def test_the_fault_signal_of_a_slow_sensor_stands_with_its_reading() -> None:
    slow = {"use": "sensor", "of": "plant.y", "every": "2 ms", "faults": [BIAS]}
    found = record({"plant": PLANT, "encoder": slow})
    # Sampled at 0, 2, 4 ... ms: the samples at 4 ms only are inside 3 to 6 ms.
    assert found["encoder.fault"].tolist() == [0, 0, 0, 0, 1, 1, 0, 0, 0, 0, 0]


def test_of_faults_that_overlap_the_first_listed_is_told_and_a_code_stands_for_its_place() -> None:
    faults = [
        {"gain": 2.0, "from": "2 ms", "to": "5 ms"},
        {"stuck": True, "from": "1 ms", "to": "7 ms", "code": 9},
        {"noise": "1 rpm", "from": "6 ms", "to": "9 ms"},
    ]
    found = record({"plant": PLANT, "encoder": {"use": "sensor", "of": "plant.y", "faults": faults}})
    assert found["encoder.fault"].tolist() == [0, 9, 1, 1, 1, 9, 9, 3, 3, 0, 0]


def test_the_fault_signal_says_what_its_codes_mean_and_is_an_integer() -> None:
    faults = [BIAS, {"stuck": True, "from": "1 s", "code": 4}, {"gain": 2.0, "from": "2 s", "code": 4}]
    found = record({"plant": PLANT, "encoder": {"use": "sensor", "of": "plant.y", "faults": faults}})
    signal = next(signal for signal in found.signals if signal.name == "encoder.fault")
    assert (signal.description, signal.kind, signal.unit) == (
        "the fault that acts; 1: bias 60.0 rpm; 4: stuck or gain 2.0",
        "integer",
        "1",
    )


def test_only_parts_with_faults_have_a_fault_signal_and_the_reading_stays_what_a_sensor_stands_for() -> None:
    parts = {
        "plant": PLANT,
        "plain": {"use": "sensor", "of": "plant.y"},
        "encoder": {"use": "sensor", "of": "plant.y", "faults": [BIAS]},
        "behind": {"use": "sensor", "of": "encoder"},
    }
    found = record(parts, record=["plain", "encoder", "behind"])
    assert found.names == ["plain.value", "encoder.value", "encoder.fault", "behind.value"]
    assert np.array_equal(found["behind.value"], found["encoder.value"])


@pytest.mark.parametrize("reader", [{"use": "sensor", "of": "encoder.fault"}, follower("encoder.fault")])
def test_no_part_reads_a_fault_signal(reader: dict[str, Any]) -> None:
    encoder = {"use": "sensor", "of": "plant.location", "faults": [{"stuck": True, "from": "1 s"}]}
    (told,) = problems({"plant": PLANT, "encoder": encoder, "reader": reader})
    assert "reads encoder.fault, the truth about faults: metrics read it, no part does" in told


# Delay


def test_a_delay_holds_the_last_reading_until_the_late_signal_arrives_and_ends_at_once() -> None:
    ramp = source(ramp={"at": "0 s", "until": "1 s", "from": 0, "to": 1000})
    late = {"use": "sensor", "of": "ramp", "faults": [{"delay": "3 ms", "from": "4 ms", "to": "9 ms"}]}
    found = record({"ramp": ramp, "late": late}, "12 ms")
    now = found["ramp.value"]
    held, behind = [now[3]] * 3, now[4 : 9 - 3].tolist()
    assert found["late.value"].tolist() == [*now[:4], *held, *behind, *now[9:]]
    assert found["late.fault"].tolist() == [0] * 4 + [1] * 5 + [0] * 4


def test_a_delay_between_samples_is_linear_there_and_adds_to_the_sensors_own() -> None:
    ramp = source(ramp={"at": "0 s", "until": "1 s", "from": 0, "to": 1000})
    fault = {"delay": "2.5 ms", "from": "4 ms"}
    late = {"use": "sensor", "of": "ramp", "delay": "1.25 ms", "faults": [fault]}
    found = record({"ramp": ramp, "late": late}, "20 ms")
    k = np.arange(8, 21)
    # Row k of the source holds its value at t_{k-1}, k - 1; the rest is rounding of sums of a few numbers up to 20.
    np.testing.assert_allclose(found["late.value"][8:], k - 1 - 3.75, atol=1e-12)


def test_a_delay_is_refused_where_it_is_negative_or_beyond_memory() -> None:
    def told(delay: str) -> list[str]:
        faults = [{"delay": delay, "from": "1 s"}, {"delay": "9000 s", "from": "1 s"}]
        return problems({"plant": PLANT, "encoder": {"use": "sensor", "of": "plant.y", "faults": faults}})

    assert told("-1 ms") == ["encoder.faults[0].delay wants 0 or more, got -1.0 ms"]
    assert told("9000 s") == ["encoder.faults[1].delay wants at most 10000000 samples in all, got 9000.0 s"]
    assert told("1 m") == ["encoder.faults[0].delay wants s, got 1 m"]


# Wires


def test_a_part_that_stands_on_a_wire_with_faults_is_named_after_it_and_says_what_the_part_really_got() -> None:
    wires = {"u0": faulty("torque", {"gain": 0.5, "from": "2 ms", "to": "5 ms"})}
    parts = {"torque": source(), "plant": {"use": "loop_parts:linear", "wires": wires}}
    found = record(parts)
    assert found.order == ("torque", "plant__u0", "plant")
    assert found.names == ["torque.value", "plant__u0.value", "plant__u0.fault", "plant.y0"]
    halved = {"torque": source(table={"time": ["0 s", "2 ms", "5 ms"], "value": [1, 0.5, 1]})}
    assert np.array_equal(found["plant.y0"], record({**halved, "plant": follower("torque")})["plant.y0"])


def test_a_fault_on_a_sources_wire_acts_from_the_row_in_which_a_step_of_the_source_would() -> None:
    step = source(step={"at": "3 ms", "from": 1, "to": 2})
    found = record({"torque": step, "plant": follower(faulty("torque", {"bias": 10, "from": "3 ms"}))})
    assert found["torque.value"].tolist() == [1.0] * 4 + [2.0] * 7
    assert found["plant__u0.value"].tolist() == [1.0] * 4 + [12.0] * 7
    assert found["plant__u0.fault"].tolist() == [0] * 4 + [1] * 7


def test_a_fault_on_the_wire_of_a_controller_acts_on_its_values_of_the_windows_times() -> None:
    """The plant's wire is held: over (k-1, k] it is given the controller's value at k-1, and that fault."""
    loop = {
        "plant": follower(faulty("controller", {"bias": 10, "from": "3 ms", "to": "4 ms"})),
        "controller": {"use": "loop_parts:linear", "with": {"direct": 1.0}, "wires": {"u0": "plant"}},
    }
    found = record(loop)
    assert found.held == ("plant__u0.value -> plant.u0",)
    assert np.flatnonzero(found["plant__u0.fault"]).tolist() == [3]
    sound = record({**loop, "plant": follower("controller")})
    assert np.flatnonzero(found["plant.y0"] != sound["plant.y0"])[0] == 4


def test_a_late_wire_with_faults_is_late_behind_them() -> None:
    wave = source(ramp={"at": "0 s", "until": "10 ms", "from": 1, "to": 2})
    direct = {"use": "loop_parts:linear", "with": {"direct": 1.0}}
    wire_ = {**faulty("wave", {"bias": 10, "from": "3 ms", "to": "5 ms"}), "delay": 1}
    found = record({"wave": wave, "plant": {**direct, "wires": {"u0": wire_}}})
    assert found.held == ("plant__u0.value -> plant.u0",)
    assert np.flatnonzero(found["plant__u0.fault"]).tolist() == [4, 5]
    sound = record({"wave": wave, "plant": {**direct, "wires": {"u0": {"from": "wave", "delay": 1}}}})
    assert np.flatnonzero(found["plant.y0"] != sound["plant.y0"])[0] == 5


def test_a_late_faulty_wire_breaks_an_algebraic_loop() -> None:
    direct = {"use": "loop_parts:linear", "with": {"direct": 1.0}}
    late = {**faulty("b", {"noise": 0.1, "from": "2 ms"}), "delay": 1}
    found = record({"a": {**direct, "wires": {"u0": late}}, "b": {**direct, "wires": {"u0": "a"}}})
    assert found.order == ("a", "b", "a__u0") and found.held == ("a__u0.value -> a.u0",)


def test_every_kind_of_fault_acts_on_a_wire() -> None:
    wave = source(ramp={"at": "0 s", "until": "10 ms", "from": 1, "to": 2})
    kinds = (
        {"bias": 1},
        {"gain": 2},
        {"drift": 5},
        {"stuck": True},
        {"drop_out": 1.0},
        {"noise": 1},
        {"delay": "1 ms"},
    )
    for kind in kinds:
        found = record({"wave": wave, "plant": follower(faulty("wave", {**kind, "from": "3 ms", "to": "7 ms"}))})
        changed = found["plant__u0.value"] != found["wave.value"]
        # A drift is nothing yet at its begin.
        assert np.flatnonzero(changed).tolist() == ([5, 6, 7] if "drift" in kind else [4, 5, 6, 7]), kind


@settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.too_slow, HealthCheck.filter_too_much])
@given(described=scenarios(), data=st.data())
def test_a_fault_that_never_acts_changes_no_signal_of_any_other_part(described: Scenario, data: st.DataObject) -> None:
    written = described.model_dump(mode="json", by_alias=True, exclude_none=True)
    wires = [(name, key) for name, part in written["parts"].items() for key in part.get("wires", {})]
    assume(wires)
    try:
        plain = run(wire(described))
    except ConfigurationError:
        assume(False)
    fault = {"bias": 1, "from": "1 s"}
    for name, key in data.draw(st.lists(st.sampled_from(wires), min_size=1, unique=True)):
        written["parts"][name]["wires"][key]["faults"].append(fault)
    found = run(wire(Scenario.model_validate(written)))
    assert all(np.array_equal(plain[name], found[name]) for name in plain.names if not name.endswith(".fault"))


def test_a_fault_on_a_wire_or_a_sensor_changes_no_number_of_anothers_noise() -> None:
    noisy = {"use": "sensor", "of": "plant.y0", "noise": {"std": 0.1}, "drop_out": 0.2}
    parts = {"wave": source(), "plant": follower("wave"), "one": noisy, "other": noisy}
    noise = {"noise": 0.0, "from": "0 s"}
    burst = {"noise": 0.3, "from": "1 s"}
    more = {
        **parts,
        "one": {**noisy, "faults": [burst, {"drop_out": 0.5, "from": "1 s"}]},
        "plant": follower(faulty("wave", noise)),
    }
    before, after = (record(described, "3 s", seed=5) for described in (parts, more))
    assert np.array_equal(before["other.value"], after["other.value"])
    calm = before.time < 1.0
    assert np.array_equal(before["one.value"][calm], after["one.value"][calm])
    assert not np.array_equal(before["one.value"][~calm], after["one.value"][~calm])


def test_the_noise_on_two_wires_of_one_source_is_independent_and_follows_the_seed() -> None:
    def noise(seed: int) -> tuple[Any, Any]:
        parts = {"wave": source(), "a": follower(faulty("wave", fault)), "b": follower(faulty("wave", fault))}
        found = record(parts, "10 s", seed=seed)
        return found["a__u0.value"] - 1.0, found["b__u0.value"] - 1.0

    fault = {"noise": 1.0, "from": "0 s"}
    a, b = noise(1)
    # The correlation of n independent pairs has the standard deviation 1/sqrt(n); five of them are allowed.
    assert abs(np.corrcoef(a, b)[0, 1]) < 5.0 / math.sqrt(len(a))
    assert np.array_equal(a, noise(1)[0]) and not np.array_equal(a, noise(2)[0])


def test_a_wire_between_arrays_has_its_faults_on_every_scalar_with_noise_of_its_own() -> None:
    parts = {"zero": source(constant=0), "a": {"use": "loop_parts:arrays", "wires": {"u[1]": "zero", "u[2]": "zero"}}}
    wires = {"u": faulty("a.y", {"noise": 1.0, "from": "2 ms"})}
    found = record({**parts, "b": {"use": "loop_parts:arrays", "wires": wires}})
    first, second = (found[f"b__u_{i}.value"] - found[f"a.y[{i}]"] for i in (1, 2))
    assert np.all(first[:2] == 0.0) and np.all(first[2:] != 0.0) and np.all(first[2:] != second[2:])


def test_a_discrete_signal_stays_one_where_its_faults_only_repeat_it() -> None:
    def parts(**fault: Any) -> dict[str, Any]:
        where = {"use": "sensor", "of": "plant.location"}
        wires = {"y": "encoder", "location": faulty("where", {**fault, "from": "0.4 s"})}
        observer = {"use": "loop_parts:estimator", "with": {"gain": "1 Hz"}, "wires": wires}
        return {"plant": PLANT, "encoder": {"use": "sensor", "of": "plant.y"}, "where": where, "observer": observer}

    for fault in ({"stuck": True}, {"drop_out": 0.5}, {"delay": "3 ms"}):
        found = record(parts(**fault), "1 s")
        assert set(found["observer__location.value"]) <= {0.0, 1.0}
    told = "observer.location wants integer values, which these faults do not leave; "
    assert problems(parts(bias=1)) == [told + "use stuck, drop_out or a delay of whole steps"]
    assert problems(parts(delay="2.5 ms")) == [told + "use stuck, drop_out or a delay of whole steps"]


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        ({"bias": "1 V", "from": "1 s"}, "plant.wires.u0.faults[0].bias wants 1, got 1 V"),
        ({"bias": 1, "from": "1 m"}, "plant.wires.u0.faults[0].from wants s, got 1 m"),
        ({"gain": 2, "from": "2 s", "to": "1 s"}, "plant.wires.u0.faults[0].to wants a time after 2.0 s, got 1.0 s"),
        (
            {"gain": 2, "from": "12 rev"},
            "plant.wires.u0.faults[0].from wants a time, got 12.0 rev: a crank angle is for a crank clock",
        ),
        (
            {"gain": 2, "from": "1 s", "to": "720 deg"},
            "plant.wires.u0.faults[0].to wants a time, got 720.0 deg: a crank angle is for a crank clock",
        ),
    ],
)
def test_what_is_wrong_with_a_fault_on_a_wire_is_told_there(fault: dict[str, Any], message: str) -> None:
    assert problems({"torque": source(), "plant": follower(faulty("torque", fault))}) == [message]


def test_a_name_that_a_part_on_a_wire_takes_is_not_free() -> None:
    fault = {"gain": 2.0, "from": "1 s"}
    (told,) = problems({"plant__u0": source(), "plant": follower(faulty("plant__u0", fault))})
    assert told == "the part that stands on this wire is named plant__u0, and so is another; rename that one"


def test_an_unknown_source_of_a_faulty_wire_is_told_once() -> None:
    (told,) = problems({"torque": source(), "plant": follower(faulty("torqe", {"gain": 2.0, "from": "1 s"}))})
    assert told == "plant.wires.u0: no part is named 'torqe'; did you mean 'torque'?"


# Law 6


def test_a_faulty_wire_from_a_plant_to_an_observer_still_reads_the_truth() -> None:
    wires = {"y": faulty("plant.y", BIAS), "location": "where"}
    parts = {
        "plant": PLANT,
        "where": {"use": "sensor", "of": "plant.location"},
        "observer": {"use": "loop_parts:estimator", "with": {"gain": "1 Hz"}, "wires": wires},
    }
    (told,) = problems(parts)
    assert told.startswith("observer.y reads the truth, plant.y: put a sensor between")


def test_what_a_plant_really_got_is_the_truth_too_and_a_sensor_may_measure_it() -> None:
    plant = follower(faulty("torque", {"gain": 0.5, "from": "1 ms"}), **{"with": {"role": "plant"}})
    observer = {"use": "loop_parts:linear", "with": {"role": "observer"}}
    parts = {"torque": source(), "plant": plant}
    (told,) = problems({**parts, "observer": {**observer, "wires": {"u0": "plant__u0"}}})
    assert told.startswith("observer.u0 reads the truth, plant__u0.value: put a sensor between")
    load_cell = {"use": "sensor", "of": "plant__u0"}
    found = record({**parts, "load_cell": load_cell, "observer": {**observer, "wires": {"u0": "load_cell"}}})
    assert np.array_equal(found["load_cell.value"], found["plant__u0.value"])


# Swaps


def test_what_reads_one_of_two_swapped_signals_reads_the_other_and_the_signals_stay_themselves() -> None:
    parts = {
        "one": source(constant=1),
        "two": source(sine={"amplitude": 1, "frequency": "100 Hz", "mean": 2}),
        "a": {"use": "sensor", "of": "one"},
        "b": {"use": "sensor", "of": "two"},
        "reads_a": {"use": "sensor", "of": "a"},
        "reads_b": {"use": "sensor", "of": "b"},
        "crossed": {"use": "swap", "between": ["a", "b"], "from": "3 ms", "to": "6 ms", "code": 7},
    }
    found = record(parts)
    inside = (np.arange(11) >= 3) & (np.arange(11) < 6)
    assert found["crossed.fault"].tolist() == (7 * inside).tolist()
    assert np.array_equal(found["reads_a.value"], np.where(inside, found["two.value"], found["one.value"]))
    assert np.array_equal(found["reads_b.value"], np.where(inside, found["one.value"], found["two.value"]))
    assert np.array_equal(found["a.value"], found["one.value"])
    assert np.array_equal(found["crossed.first"], found["reads_a.value"])


def test_swapped_sources_are_swapped_from_the_row_in_which_a_step_of_theirs_would_act() -> None:
    parts = {"one": source(constant=1), "two": source(constant=2), "plant": follower("one")}
    found = record({**parts, "crossed": {"use": "swap", "between": ["one", "two"], "from": "3 ms"}})
    assert found["crossed.first"].tolist() == [1.0] * 4 + [2.0] * 7
    assert found.order == ("one", "two", "crossed", "plant")


def test_a_signal_swapped_twice_passes_the_swaps_in_their_order() -> None:
    parts = {name: source(constant=value) for name, value in (("one", 1), ("two", 2), ("three", 3))}
    readers = {f"reads_{name}": follower(name) for name in parts}
    parts |= {f"s_{name}": {"use": "sensor", "of": name} for name in ("one", "two", "three")}
    swaps = {
        "first": {"use": "swap", "between": ["one", "two"], "from": "0 s"},
        "then": {"use": "swap", "between": ["three", "one"], "from": "0 s"},
    }
    found = record({**parts, **readers, **swaps})
    # After the first swap the readers see 2, 1, 3; then those of `one` and `three` are swapped.
    assert [found[f"s_{name}.value"][-1] for name in ("one", "two", "three")] == [3.0, 1.0, 2.0]


def test_swapped_actuators_may_be_swapped_behind_their_faults() -> None:
    bias = {"bias": 10, "from": "0 s"}
    parts = {
        "one": source(constant=1),
        "two": source(constant=2),
        "plant": {
            "use": "loop_parts:linear",
            "with": {"inputs": 2},
            "wires": {"u0": faulty("one", bias), "u1": "two"},
        },
        "crossed": {"use": "swap", "between": ["plant__u0", "two"], "from": "0 s"},
    }
    wired = system(parts)
    assert [str(entry) for entry in wired.wires if entry.part == "plant"] == [
        "crossed.first -> plant.u0",
        "crossed.second -> plant.u1",
    ]
    found = record(parts)
    assert (found["crossed.first"][-1], found["crossed.second"][-1]) == (2.0, 11.0)


def test_signals_of_different_dimensions_are_not_swapped() -> None:
    parts = {"plant": PLANT, "crossed": {"use": "swap", "between": ["plant.y", "plant.torque"], "from": "1 s"}}
    expected = "crossed.between wants two signals of one dimension, got rpm from plant.y and N.m from plant.torque"
    assert problems(parts) == [expected]


def test_swapping_does_not_let_an_observer_read_the_truth() -> None:
    parts = {
        "plant": PLANT,
        "encoder": {"use": "sensor", "of": "plant.y"},
        "where": {"use": "sensor", "of": "plant.location"},
        "observer": {
            "use": "loop_parts:estimator",
            "with": {"gain": "1 Hz"},
            "wires": {"y": faulty("encoder", {"gain": 2.0, "from": "1 s"}), "location": "where"},
        },
        "other": PLANT,
        "crossed": {"use": "swap", "between": ["other.y", "encoder"], "from": "1 s"},
    }
    told = "while encoder.value is swapped, observer.y reads the truth, other.y: swap it with a sensor of that"
    assert problems(parts) == [told]
    behind = {**parts, "crossed": {"use": "swap", "between": ["observer__y", "other.y"], "from": "1 s"}}
    assert problems(behind) == [told.replace("encoder.value", "observer__y.value")]


def test_a_swap_gives_no_real_values_to_an_integer_input() -> None:
    parts = {
        "plant": PLANT,
        "where": {"use": "sensor", "of": "plant.location"},
        "shaky": {"use": "sensor", "of": "plant.location", "noise": {"std": 1}},
        "encoder": {"use": "sensor", "of": "plant.y"},
        "observer": {
            "use": "loop_parts:estimator",
            "with": {"gain": "1 Hz"},
            "wires": {"y": "encoder", "location": "where"},
        },
        "crossed": {"use": "swap", "between": ["where", "shaky"], "from": "1 s"},
    }
    told = "while where.value is swapped, observer.location wants integer values, got real ones from shaky.value"
    assert problems(parts) == [told]


@pytest.mark.parametrize(
    ("between", "message"),
    [
        (["one", "one"], "crossed.between wants two signals, got one.value twice"),
        (["one", "too"], "crossed.between: no part is named 'too'; did you mean 'two'?"),
        (
            ["one", "other.first"],
            "crossed.between wants the signals themselves, got other.first of a swap; a signal may be in several swaps",
        ),
    ],
)
def test_what_is_wrong_with_the_signals_of_a_swap_is_told(between: list[str], message: str) -> None:
    parts = {"one": source(), "two": source(), "other": {"use": "swap", "between": ["one", "two"], "from": "1 s"}}
    assert problems({**parts, "crossed": {"use": "swap", "between": between, "from": "1 s"}}) == [message]


# Crank angles


@st.composite
def _samplings(draw: st.DrawFn) -> Sampling:
    cycle = draw(st.sampled_from([4, 60, 7200]))
    per_step = draw(st.booleans())
    grid = CrankGrid(
        start=0.0,
        steps=10_000,
        stop=math.inf,
        numerator=720.0 / cycle if per_step else 720.0,
        denominator=1 if per_step else cycle,
        origin=draw(st.sampled_from([-720.0, -0.1, 0.0, 30.0, 45.5])),
        cycle=cycle,
        tdc=(),
        slowest=0.1,
    )
    due = bytes(draw(st.lists(st.integers(0, 1), min_size=cycle, max_size=cycle))) if cycle <= 60 else b""
    return Sampling(grid, Pace(due=due) if any(due) else Pace(draw(st.integers(1, 9))))


@given(sampling=_samplings(), instant=st.integers(-10, 400), share=st.sampled_from([0.0, 0.001, 0.5, 0.999]))
def test_the_first_sample_at_or_after_an_angle_is_counted_whatever_the_last_bit(
    sampling: Sampling, instant: int, share: float
) -> None:
    grid, pace = sampling.grid, sampling.pace
    assert isinstance(grid, CrankGrid)
    angle = math.degrees(math.radians(grid.origin + (instant + share) * grid.degrees))
    stepped = [0]
    k = 0
    while stepped[-1] < instant + share:
        k += 1
        if pace.due[k % grid.cycle] if pace.due else k % pace.period == 0:
            stepped.append(k)
    assert sampling.at(angle) == len(stepped) - 1


def on_crank(parts: dict[str, Any], **clock: Any) -> Record:
    crank = {"step": "6 deg", "stop": "4 rev", "speed": "engine.omega", "origin": "60 deg", **clock}
    engine = {"use": "crank_parts:ENGINE", "with": {"rate": "100 rad/s2"}}
    described = {"clock": {"crank": crank}, "parts": {"engine": engine, **parts}, "seed": 3}
    wired = wire(Scenario.model_validate(described))
    found = run(wired)
    assert found.outcome == "ok", found.message
    assert np.array_equal(np.column_stack([found.time, found.values]), run_plainly(wired)), "C and plain Python"
    return found


def between(found: Record, begin: float, end: float) -> Any:
    assert found.crank is not None
    return (found.crank >= begin) & (found.crank < end)


def test_on_a_crank_clock_a_fault_acts_between_crank_angles_or_times() -> None:
    sensor = {"use": "sensor", "of": "engine.omega"}
    bias = {"bias": "1 rad/s"}
    found = on_crank(
        {
            "angle": {**sensor, "faults": [{**bias, "from": "1 rev", "to": "720 deg"}]},
            "slow": {**sensor, "every": "30 deg", "faults": [{**bias, "from": "370 deg", "to": "700 deg"}]},
            "fired": {**sensor, "at": "tdc", "faults": [{**bias, "from": "185 deg", "to": "720 deg"}]},
            "time": {**sensor, "faults": [{**bias, "from": "30 ms", "to": "50 ms"}]},
            "both": {**sensor, "faults": [{**bias, "from": "30 ms", "to": "2 rev"}]},
        },
        firing_order=[1, 3, 4, 2],
    )
    late = (found.time >= 0.03) & (found.time < 0.05)
    assert np.array_equal(found["angle.fault"] == 1, between(found, 360.0, 720.0))
    # Samples at 60, 90 ... deg; those from 390 to 690 deg are inside, and each stands for 30 deg.
    assert np.array_equal(found["slow.fault"] == 1, between(found, 390.0, 720.0))
    # Samples at 60, 180, 360, 540 ... deg: those at 360 and 540 deg are inside.
    assert np.array_equal(found["fired.fault"] == 1, between(found, 360.0, 720.0))
    assert np.array_equal(found["time.fault"] == 1, late) and late.any()
    assert np.array_equal(found["both.fault"] == 1, (found.time >= 0.03) & between(found, 60.0, 720.0))
    changed = found["angle.value"] - found["engine.omega"]
    np.testing.assert_allclose(changed, np.where(between(found, 360.0, 720.0), 1.0, 0.0), atol=1e-13)


def test_on_a_crank_clock_a_drift_grows_from_the_first_sample_of_its_window() -> None:
    drift = {"drift": "10 rad/s", "from": "363 deg"}
    found = on_crank({"encoder": {"use": "sensor", "of": "engine.omega", "faults": [drift]}})
    begun = found.crank >= 366.0 if found.crank is not None else None
    expected = np.where(begun, 10.0 * (found.time - found.time[begun][0]), 0.0)
    # The difference of readings near 100 rad/s is good to its rounding.
    np.testing.assert_allclose(found["encoder.value"] - found["engine.omega"], expected, atol=1e-13)


def test_on_a_crank_clock_a_delay_is_a_crank_angle() -> None:
    fault = {"delay": "30 deg", "from": "360 deg"}
    found = on_crank({"encoder": {"use": "sensor", "of": "engine.omega", "faults": [fault]}})
    begin = int(np.argmax(between(found, 360.0, math.inf)))
    reading, speed = found["encoder.value"], found["engine.omega"]
    assert np.array_equal(reading[:begin], speed[:begin])
    assert np.all(reading[begin : begin + 4] == speed[begin - 1])
    assert np.array_equal(reading[begin + 4 :], speed[begin - 1 : -5])
    for delay, rest, told in (
        ("2 ms", {}, "wants a crank angle, since samples of a crank clock are no fixed time apart, got 2.0 ms"),
        ("6 deg", {"at": "cycle"}, "wants a part that samples evenly, by `every` and not by `at`"),
    ):
        with pytest.raises(ConfigurationError) as caught:
            fault = {"delay": delay, "from": "0 s"}
            on_crank({"encoder": {"use": "sensor", "of": "engine.omega", "faults": [fault], **rest}})
        assert caught.value.problems[0].message == f"encoder.faults[0].delay {told}"


def test_on_a_crank_clock_wires_have_faults_and_signals_are_swapped_by_angle() -> None:
    window = {"from": "360 deg", "to": "720 deg"}
    parts = {
        "one": source(constant=1),
        "two": {"use": "sensor", "of": "engine.ratio"},
        "plant": follower(faulty("one", {"noise": 1.0, **window})),
        "reader": follower("two"),
        "three": {"use": "sensor", "of": "engine.ratio"},
        "crossed": {"use": "swap", "between": ["two", "three"], **window},
    }
    found = on_crank({**parts, "three": {**parts["three"], "gain": 2.0}})
    # The row of a source's value is the one after that whose angle it belongs to.
    assert np.array_equal(found["plant__u0.fault"] == 1, between(found, 366.0, 726.0))
    assert np.array_equal(found["crossed.fault"] == 1, between(found, 360.0, 720.0))
    swapped = np.where(between(found, 360.0, 720.0), found["three.value"], found["two.value"])
    assert np.array_equal(found["crossed.first"], swapped)


def test_where_a_clock_steers_exactly_faults_are_taken_back_with_the_plant() -> None:
    burst = {"noise": "5 N.m", "from": "360 deg", "to": "720 deg"}
    parts = {
        "torque": {"use": "source", "unit": "N.m", "constant": "30 N.m"},
        "engine": {
            "use": "crank_parts:LOADED",
            "with": {"theta": "60 deg"},
            "wires": {"torque": faulty("torque", burst)},
        },
    }
    found = on_crank(parts, angle="engine.theta", steer="exact")
    assert np.array_equal(found["engine__torque.fault"] == 1, between(found, 366.0, 726.0))
    assert np.array_equal(found["engine__torque.value"] != 30.0, found["engine__torque.fault"] == 1)


# Coupled parts


def test_an_algebraic_loop_is_solved_through_a_faulty_wire() -> None:
    """a = 0.5 b + 1 and b = 0.5 a', a' being a with a bias of 3 from 4 ms on: a = 4/3, then 7/3."""
    bias = {"bias": 3, "from": "4 ms"}
    a = {"use": "coupled_parts:LINE", "with": {"gain": 0.5, "offset": 1.0}, "wires": {"u": "b.y"}}
    b = {"use": "coupled_parts:LINE", "with": {"gain": 0.5}, "wires": {"u": faulty("a.y", bias)}}
    for solve in ("fixed-point", "newton"):
        found = record({"a": a, "b": b}, coupling={"solve": solve})
        expected = np.where(np.arange(11) < 4, 4.0 / 3.0, 7.0 / 3.0)
        # A loop is solved to 1e-9 of its signals.
        np.testing.assert_allclose(found["a.y"], expected, rtol=1e-8)
    crossed = {"use": "swap", "between": ["a.y", "b.y"], "from": "4 ms"}
    with pytest.raises(ConfigurationError, match="algebraic loop"):
        system({"a": a, "b": {**b, "wires": {"u": "one"}}, "one": source(), "crossed": crossed})


def test_plants_that_take_smaller_steps_have_no_faults_between_them() -> None:
    mass = {"use": "coupled_parts:MASS", "wires": {"force": faulty("spring.force", {"gain": 2.0, "from": "1 s"})}}
    spring = {"use": "coupled_parts:SPRING", "wires": {"x": "mass.x"}}
    told = "plants that feed each other take smaller steps (coupling.error), which faults between them cannot count"
    parts = {"mass": mass, "spring": spring}
    assert problems(parts, coupling={"error": 1e-6}) == [told]
    sound = {"use": "coupled_parts:MASS", "wires": {"force": "spring.force"}}
    swapped = {"use": "swap", "between": ["mass.x", "other.x"], "from": "1 s"}
    parts |= {"mass": sound, "other": sound, "crossed": swapped}
    assert problems(parts, coupling={"error": 1e-6}) == [told, told]
    assert len(record(parts).time) == 11


# A campaign

CAMPAIGN = """\
campaign: diagnosis
clock: {time: {step: 1 ms, stop: 4 s}}
parts:
  torque: {use: source, unit: N.m, constant: 5 N.m}
  plant: {use: fmus.plants.driveline, wires: {T_eng: {from: torque, faults: [{gain: 0.5, from: 3 s}]}}}
  a: {use: sensor, of: plant.y, noise: {std: 0.1 rpm}, faults: [{bias: 50 rpm, from: 1 s, to: 2 s, code: 1}]}
  b: {use: sensor, of: plant.y, noise: {std: 0.1 rpm}, faults: [{drift: 100 rpm, from: 1 s, to: 2 s, code: 2}]}
  c: {use: sensor, of: plant.y, noise: {std: 0.1 rpm}}
  vote: {use: "loop_parts:vote", with: {bound: 5 rpm}, wires: {a: a, b: b, c: c}}
experiments:
  bias: {set: {b.faults: []}}
  drift: {set: {a.faults: []}}
metrics:
  a_found: {detection: [a.fault, vote.culprit], unit: ms, only: [bias]}
  b_found: {detection: [b.fault, vote.culprit], unit: ms, only: [drift]}
  right: {accuracy: [b.fault, vote.culprit], only: [drift]}
  a_alarm: {alarm: [a.fault, vote.culprit], unit: ms, only: [bias]}
  b_told: {confusion: {pair: [b.fault, vote.culprit], classes: {sound: 0, drifting: 2}}, only: [drift]}
  real_torque: {final: plant__T_eng.value, unit: N.m}
accept:
  - {bias: a_found.changes == 2}
  - {bias: a_found.delay_p95 == 0 ms}
  - {bias: a_found.false_alarms == 0}
  - {drift: b_found.missed == 0}
  - {drift: b_found.delay_p95 > 45 ms}
  - {drift: b_found.delay_p95 < 55 ms}
  - {drift: right > 0.98}
  - real_torque == 2.5 N.m
  - {bias: a_alarm.true_positive_rate == 1}
  - {bias: a_alarm.false_positive_rate == 0}
  - {drift: b_told.precision_drifting == 1}
report:
  figures:
    - {title: Readings, experiment: bias, traces: [[plant.y, a.value]]}
    - {title: Drift, experiment: drift, traces: [[plant.y, a.value]], from: 1.5 s, to: 3 s}
"""


def test_parts_with_faults_and_swaps_keep_the_laws_of_a_component() -> None:
    signal = Signal("y", start=1.0)
    kinds = [("bias", 0.3), ("gain", 1.5), ("drift", 9.0), ("noise", 0.1), ("drop_out", 0.4), ("delay", 2.5)]
    faults = tuple(
        ActingFault(kind, value, Window(0.004 * place, 0.004 * place + 0.015), place + 1)
        for place, (kind, value) in enumerate(kinds)
    )
    for timed in ("end", "begin"):
        check_component(lambda timed=timed: SensorComponent(signal, Errors(faults=faults), 1e-3, timed=timed))
    pair = [Given(f"{name}.y", signal, StatusPart(1.0, 0)) for name in ("one", "two")]
    check_component(lambda: SwapComponent(pair, Window(first=10, last=30), 1e-3))


def test_a_campaign_judges_a_diagnosis_by_the_fault_signals(tmp_path: Path) -> None:
    """A drift of 100 rpm/s passes the bound of 5 rpm after 50 ms; noise of 0.1 rpm is worth 1 ms of it."""
    file = tmp_path / "diagnosis.yaml"
    file.write_text(CAMPAIGN)
    result = execute(read_campaign(file), tmp_path / "out", 1, lambda ended: None)
    assert all(verdict.passed for verdict in result.verdicts), [v for v in result.verdicts if not v.passed]
    assert result.accepted and len(result.verdicts) == 11
    # The report shades what was recorded: a source's row is the one after that whose time it belongs to.
    (whole, part) = declared_figures(read_run(tmp_path / "out"))
    assert [(window.label, window.since, window.until) for window in whole.windows] == [
        ("a: bias 50.0 rpm", 1.0, 2.0),
        ("plant__T_eng: gain 0.5", 3.001, 4.0),
    ]
    assert [(window.label, window.since, window.until) for window in part.windows] == [("b: drift 100.0 rpm", 1.5, 2.0)]
    page = write_report(tmp_path / "out").read_text(encoding="utf-8")
    assert "Shaded, a fault is active: a: bias 50.0 rpm, 1 to 2 s" in page


def test_the_campaign_of_the_documentation_is_accepted(tmp_path: Path) -> None:
    page = (Path(__file__).parent.parent / "docs" / "faults.md").read_text(encoding="utf-8")
    (text,) = re.findall(r"```yaml\n(campaign: .*?)```", page, re.DOTALL)
    file = tmp_path / "faults.yaml"
    file.write_text(text)
    result = execute(read_campaign(file), tmp_path / "out", 1, lambda ended: None)
    assert result.accepted, result.verdicts


def test_faults_that_were_not_recorded_are_shaded_as_declared_in_time(tmp_path: Path) -> None:
    file = tmp_path / "diagnosis.yaml"
    record_ = "record: [plant.y, a.value, b, vote, plant__T_eng.value]\nexperiments:"
    text = re.sub(r"  (a_found:|a_alarm:|- \{bias: ).*\n", "", CAMPAIGN.replace("experiments:", record_))
    file.write_text(text)
    assert execute(read_campaign(file), tmp_path / "out", 1, lambda ended: None).accepted
    (whole, _) = declared_figures(read_run(tmp_path / "out"))
    assert [(window.label, window.since, window.until) for window in whole.windows] == [("a: bias 50 rpm", 1.0, 2.0)]
