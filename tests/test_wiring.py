"""From a scenario to a system: the order of parts, and every problem that keeps parts from being wired."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fmus.component import ConfigurationError
from harness.order import AlgebraicLoop, Wire, held_wires, order_parts
from harness.places import Place, Places, read_yaml
from harness.run import run
from harness.scenario import Scenario
from harness.wiring import System, wire

RPM = 2.0 * 3.141592653589793 / 60.0
PLANT = {"use": "loop_parts:truth"}
OBSERVER = {
    "use": "loop_parts:estimator",
    "with": {"gain": "1 Hz"},
    "wires": {"y": "encoder", "location": "where"},
}
WHOLE = {
    "plant": PLANT,
    "encoder": {"use": "sensor", "of": "plant.y"},
    "where": {"use": "sensor", "of": "plant.location"},
    "observer": OBSERVER,
}


def system(parts: dict[str, Any], **rest: Any) -> System:
    clock = {"time": {"step": "1 ms", "stop": "10 ms"}}
    return wire(Scenario.model_validate({"clock": clock, "parts": parts, **rest}))


def problems(parts: dict[str, Any], **rest: Any) -> list[str]:
    with pytest.raises(ConfigurationError) as caught:
        system(parts, **rest)
    return [problem.message for problem in caught.value.problems]


def changed(part: str, **keys: Any) -> dict[str, Any]:
    return {**WHOLE, part: {**WHOLE[part], **keys}}


# Order


@st.composite
def _graphs(draw: st.DrawFn) -> tuple[dict[str, bool], list[Wire]]:
    names = [f"p{i}" for i in range(draw(st.integers(1, 7)))]
    name = st.sampled_from(names)
    wires = draw(st.lists(st.tuples(name, name, st.booleans()), max_size=14))
    parts = {part: draw(st.booleans()) for part in names}
    return parts, [Wire(source, "y", part, f"u{i}", direct) for i, (source, part, direct) in enumerate(wires)]


def _has_direct_cycle(parts: list[str], wires: list[Wire]) -> bool:
    """By trying all orders: a cycle of direct wires is there when no order puts each after its source."""
    direct = [entry for entry in wires if entry.direct]
    if any(entry.source == entry.part for entry in direct):
        return True
    orders = itertools.permutations(parts)
    return not any(all(o.index(entry.source) < o.index(entry.part) for entry in direct) for o in orders)


@settings(max_examples=300, deadline=None)
@given(graph=_graphs())
def test_an_order_exists_exactly_where_no_cycle_is_direct_throughout(graph: tuple[dict[str, bool], list[Wire]]) -> None:
    parts, wires = graph
    if len(parts) > 6:
        return
    try:
        order = order_parts(parts, wires).parts
    except AlgebraicLoop as error:
        assert _has_direct_cycle(list(parts), wires)
        loop = error.wires
        assert all(entry.direct for entry in loop)
        assert all(a.part == b.source for a, b in zip(loop, [*loop[1:], loop[0]], strict=True)), "they form a cycle"
        return
    assert sorted(order) == sorted(parts) and not _has_direct_cycle(list(parts), wires)
    held = held_wires(order, wires)
    assert not any(entry.direct for entry in held)
    assert order == order_parts(parts, list(reversed(wires))).parts, "the order of the wires does not matter"


@settings(max_examples=200, deadline=None)
@given(graph=_graphs())
def test_only_wires_in_a_cycle_are_held(graph: tuple[dict[str, bool], list[Wire]]) -> None:
    parts, wires = graph
    try:
        held = held_wires(order_parts(parts, wires).parts, wires)
    except AlgebraicLoop:
        return
    for entry in held:
        reached, ends = {entry.part}, [entry.part]
        while ends:
            end = ends.pop()
            for other in wires:
                if other.source == end and other.part not in reached:
                    reached.add(other.part)
                    ends.append(other.part)
        assert entry.source in reached


def test_parts_that_do_not_depend_on_each_other_stay_as_declared() -> None:
    assert order_parts({"c": False, "a": False, "b": False}, [Wire("b", "y", "c", "u", True)]).parts == (
        "a",
        "b",
        "c",
    )


def test_a_closed_loop_is_cut_at_the_plant_and_not_at_a_delayed_sensor() -> None:
    loop = [
        Wire("plant", "y", "sensor", "of", False),
        Wire("sensor", "value", "controller", "y", True),
        Wire("controller", "u", "plant", "u", False),
    ]
    order = order_parts({"sensor": True, "controller": False, "plant": False}, loop).parts
    assert order == ("plant", "sensor", "controller")
    assert [str(entry) for entry in held_wires(order, loop)] == ["controller.u -> plant.u"]


def test_an_algebraic_loop_is_refused_with_its_cycle() -> None:
    direct = {"use": "loop_parts:linear", "with": {"direct": 1.0}}
    found = problems({"a": {**direct, "wires": {"u0": "b"}}, "b": {**direct, "wires": {"u0": "a"}}})
    assert len(found) == 1
    assert found[0].startswith("algebraic loop: ")
    assert "a.y0 -> b.u0" in found[0] and "b.y0 -> a.u0" in found[0]


def test_a_sensor_delayed_by_a_step_breaks_an_algebraic_loop() -> None:
    direct = {"use": "loop_parts:linear", "with": {"direct": 1.0}}
    loop = {
        "a": {**direct, "wires": {"u0": "late"}},
        "b": {**direct, "wires": {"u0": "a"}},
        "late": {"use": "sensor", "of": "b", "delay": "1 ms"},
    }
    wired = system(loop)
    assert wired.order == ("late", "a", "b")
    assert [str(entry) for entry in wired.held] == ["b.y0 -> late.of"]


# Names


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        (changed("encoder", of="plnt.y"), "encoder.of: no part is named 'plnt'; did you mean 'plant'?"),
        (changed("encoder", of="plant.why"), "encoder.of: no signal is named 'plant.why'; did you mean 'plant.y'?"),
        (
            changed("encoder", of="plant"),
            "encoder.of wants one output of plant, got 'plant'; there are plant.y, plant.torque, plant.location",
        ),
        (
            changed("observer", wires={"y": "encoder", "location": "were"}),
            "observer.wires.location: no part is named 'were'; did you mean 'where'?",
        ),
        (
            changed("observer", wires={**OBSERVER["wires"], "yy": "encoder"}),
            "observer.wires.yy: no input of observer is named 'yy'; did you mean 'y'?",
        ),
        (
            changed("observer", wires={"y": "encoder"}),
            "observer.location wants a wire; write `wires: {location: part.output}`",
        ),
        (
            changed("observer", use="observers.hybird"),
            "observer.use: no module is named 'observers.hybird'; did you mean 'observers.hybrid'?",
        ),
        (
            changed("observer", use="loop_parts:estimater"),
            "observer.use: no model in loop_parts is named 'estimater'; did you mean 'estimator'?",
        ),
        (changed("observer", use="no/such.fmu"), "observer.use wants an FMU, but there is no file no/such.fmu"),
        (
            changed("observer", use="json"),
            "observer.use wants a module with a MODEL or a make, got json, which has neither",
        ),
        ({**WHOLE, "a.b": PLANT}, "a part's name wants letters, digits and _, got 'a.b'"),
    ],
)
def test_an_unknown_name_is_answered_with_the_nearest_known(parts: dict[str, Any], message: str) -> None:
    assert problems(parts) == [message]


def test_an_unknown_recorded_signal_is_answered_with_the_nearest_known() -> None:
    expected = ["record[1]: no signal is named 'plant.locaton'; did you mean 'plant.location'?"]
    assert problems(WHOLE, record=["encoder", "plant.locaton"]) == expected


# Units and kinds


def test_a_wire_between_dimensions_is_refused_naming_both() -> None:
    parts = {**WHOLE, "encoder": {"use": "sensor", "of": "plant.torque"}}
    assert problems(parts) == ["observer.y wants rpm, got N.m from encoder"]


def test_real_values_do_not_enter_an_integer_input() -> None:
    parts = changed("where", noise={"std": 0.1})
    assert problems(parts) == ["observer.location wants integer values, got real ones from where"]


def test_an_unknown_unit_of_a_source_is_named() -> None:
    assert problems({"s": {"use": "source", "unit": "Nm", "constant": 1}}) == ["s.unit: unknown unit 'Nm'"]


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"constant": "1 N"}, "s.constant wants N.m, got 1 N"),
        ({"step": {"at": "1 m", "from": "0 N.m", "to": "1 N.m"}}, "s.step.at wants s, got 1 m"),
        (
            {"ramp": {"at": "2 s", "until": "1 s", "from": "0 N.m", "to": "1 N.m"}},
            "s.ramp.until wants a time after 2.0 s, got 1.0 s; a jump is a step",
        ),
        ({"sine": {"amplitude": "1 N.m", "frequency": "1 s", "mean": "0 N.m"}}, "s.sine.frequency wants Hz, got 1 s"),
        (
            {"table": {"time": ["0 s", "1 s"], "value": ["1 N.m"]}},
            "s.table wants as many values as times and at least one, got 1 and 2",
        ),
        (
            {"table": {"time": ["0 s", "0 s"], "value": ["1 N.m", "1 N.m"]}},
            "s.table.time[1] wants a time after 0.0 s, got 0.0 s",
        ),
    ],
)
def test_a_wrong_source_is_named_with_what_was_wanted(keys: dict[str, Any], message: str) -> None:
    assert problems({"s": {"use": "source", "unit": "N.m", **keys}}) == [message]


# Law 6


def test_an_observer_wired_to_the_truth_is_refused() -> None:
    found = problems(changed("observer", wires={"y": "plant.y", "location": "where"}))
    assert found == [
        "observer.y reads the truth, plant.y: put a sensor between, like `y_sensor: {use: sensor, of: plant.y}`"
    ]


def test_a_controller_may_read_a_plant_and_an_observer_a_source() -> None:
    parts = {
        "plant": {"use": "loop_parts:linear", "with": {"role": "plant"}, "wires": {"u0": "controller"}},
        "controller": {"use": "loop_parts:linear", "wires": {"u0": "plant"}},
        "source": {"use": "source", "unit": "1", "constant": 1},
        "observer": {"use": "loop_parts:linear", "with": {"role": "observer"}, "wires": {"u0": "source"}},
    }
    assert system(parts).order == ("plant", "controller", "source", "observer")


# Clock


@pytest.mark.parametrize(
    ("clock", "message"),
    [
        ({"step": "0 s", "stop": "1 s"}, "clock.time.step wants a positive step, got 0.0 s"),
        ({"step": "-1 ms", "stop": "1 s"}, "clock.time.step wants a positive step, got -1.0 ms"),
        ({"step": "1 ms", "stop": "0 s"}, "clock.time.stop wants a time after the start, 0.0 s, got 0.0 s"),
        ({"step": "1 m", "stop": "1 s"}, "clock.time.step wants s, got 1 m"),
        ({"step": 1, "stop": "1 s"}, "clock.time.step wants s, got the bare number 1: write '1 s'"),
        ({"step": "2 s", "stop": "1 s"}, "clock.time.step wants at least one step up to 1.0 s, got 2.0 s"),
        ({"step": "1 us", "stop": "1000 h"}, "clock.time.step wants at most 100000000 steps, got 3.6e+12 of"),
    ],
)
def test_a_clock_that_cannot_tick_is_refused(clock: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        wire(Scenario.model_validate({"clock": {"time": clock}, "parts": WHOLE}))
    assert next(problem.message for problem in caught.value.problems).startswith(message)


@pytest.mark.parametrize(
    ("step", "stop", "steps"), [("0.1 s", "0.3 s", 3), ("0.7 ms", "7 s", 10000), ("0.3 s", "1 s", 3)]
)
def test_the_last_instant_is_the_last_multiple_up_to_the_stop(step: str, stop: str, steps: int) -> None:
    clock = {"time": {"step": step, "stop": stop}}
    assert wire(Scenario.model_validate({"clock": clock, "parts": WHOLE})).grid.steps == steps


def test_a_part_steps_at_multiples_of_the_clock_only() -> None:
    expected = "observer.every wants a multiple of the clock's step, 0.001 s, got 2.5 ms; near are 0.002 s or 0.003 s"
    assert problems(changed("observer", every="2.5 ms")) == [expected]
    assert {part.name: part.pace.period for part in system(changed("encoder", every="3 ms")).parts}["encoder"] == 3


# Settings


def test_arguments_of_make_are_converted_to_the_units_they_are_annotated_with() -> None:
    given_ = {"gain": "2 1/min", "delays": ["1 ms", "2 s"], "order": 3, "label": "5 m"}
    part: Any = system(changed("observer", **{"with": given_})).components["observer"]
    assert part.arguments == {"gain": 2.0 / 60.0, "delays": [0.001, 2.0], "order": 3, "label": "5 m"}
    text: Any = system(changed("observer", **{"with": {**given_, "delays": "[1, 2] ms"}})).components["observer"]
    assert text.arguments["delays"] == [0.001, 0.002]


@pytest.mark.parametrize(
    ("given_", "message"),
    [
        ({"gain": "2 s"}, "observer.with.gain wants 1/s, got 2 s"),
        ({"gain": 2}, "observer.with.gain wants 1/s, got the bare number 2: write '2 1/s'"),
        ({"gain": "fast"}, "observer.with.gain: 'fast' wants a number with a unit"),
        ({"gain": "1 Hz", "order": 1.5}, "observer.with.order wants an integer, got 1.5"),
        ({"gain": "-1 Hz"}, "observer: gain wants a positive number, got -1.0"),
        ({"gian": "1 Hz"}, "observer.with.gian: no argument is named 'gian'; did you mean 'gain'?"),
        ({}, "observer.with.gain wants a value; write `with: {gain: ...}`"),
    ],
)
def test_a_wrong_argument_of_make_is_named(given_: dict[str, Any], message: str) -> None:
    assert any(
        found.startswith(message) or message in found for found in problems(changed("observer", **{"with": given_}))
    )


DRIVELINE = {
    "torque": {"use": "source", "unit": "N.m", "constant": "1 N.m"},
    "plant": {"use": "fmus.plants.driveline", "wires": {"T_eng": "torque"}},
}


def driveline(**keys: Any) -> dict[str, Any]:
    return {**DRIVELINE, "plant": {**DRIVELINE["plant"], **keys}}


def test_settings_of_a_model_reach_its_fmu_in_any_unit() -> None:
    wired = system(driveline(**{"with": {"k": "1.6 kN.m/rad", "omega_c": "30 rpm", "solver.step": "0.1 ms"}}))
    record = run(wired)
    assert record.outcome == "ok", record.message
    starts = record.starts["plant"]
    assert starts["k"] == pytest.approx(1600.0, rel=1e-15) and starts["solver.step"] == pytest.approx(1e-4, rel=1e-15)
    assert record["plant.omega_c"][0] == pytest.approx(30.0 * RPM, rel=1e-14)
    assert wired.settings["plant"]["omega_c"] == pytest.approx(30.0 * RPM, rel=1e-15)


def test_a_named_parameter_set_is_applied_and_settings_go_before_it() -> None:
    from fmus.plants.driveline import MODEL

    name, values = next(iter(MODEL.parameter_sets.items()))
    key = next(iter(values))
    starts = run(system(driveline(set=name))).starts["plant"]
    assert all(starts[k] == pytest.approx(v, rel=1e-14) for k, v in values.items())
    unit = next(signal.unit for signal in MODEL.parameters if signal.name == key)
    own = run(system(driveline(set=name, **{"with": {key: f"{2 * values[key]!r} {unit}"}}))).starts["plant"]
    assert own[key] == pytest.approx(2 * values[key], rel=1e-14)


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"with": {"kk": "1 N.m"}}, "plant.with.kk: no parameter or start value is named 'kk'; did you mean 'k'?"),
        ({"with": {"k": "1 N.m"}}, "plant.with.k wants N.m/rad, got 1 N.m"),
        ({"set": "nonesuch"}, "plant.set: no parameter set of driveline is named 'nonesuch'; did you mean"),
        ({"wires": {}}, "plant.T_eng wants a wire; write `wires: {T_eng: part.output}`"),
    ],
)
def test_a_wrong_setting_of_a_model_is_named(keys: dict[str, Any], message: str) -> None:
    found = problems(driveline(**keys))
    assert len(found) == 1 and found[0].startswith(message)


def test_an_fmu_file_is_found_from_the_folder_of_the_campaign(tmp_path: Path) -> None:
    from fmus.export import build_fmu
    from fmus.plants.driveline import MODEL

    (tmp_path / "models").mkdir()
    build_fmu(MODEL, tmp_path / "models" / "driveline.fmu")
    parts = driveline(use="models/driveline.fmu", **{"with": {"k": "1.6 kN.m/rad"}})
    described = Scenario.model_validate({"clock": {"time": {"step": "1 ms", "stop": "5 ms"}}, "parts": parts})
    record = run(wire(described, Places(str(tmp_path / "campaign.yaml"))))
    same = run(system(driveline(**{"with": {"k": "1.6 kN.m/rad"}})))
    assert record.starts["plant"]["k"] == pytest.approx(1600.0, rel=1e-15)
    assert record["plant.y"].tobytes() == same["plant.y"][:6].tobytes()


RAMP = {"use": "source", "unit": "1", "ramp": {"at": "0 s", "until": "1 s", "from": 0, "to": 1000}}


def test_a_sampled_part_samples_at_the_ends_of_its_steps_unless_it_is_told() -> None:
    def steps(**keys: Any) -> list[float]:
        record = run(system({"u": RAMP, "held": {"use": "loop_parts:sampled", "wires": {"u": "u"}, **keys}}))
        assert record.outcome == "ok", record.message
        return [round(value, 9) for value in record["held.y"].tolist()]

    # The ramp is k in row k+1: a source shows the value it had when the step began.
    assert steps()[2:] == [1, 2, 3, 4, 5, 6, 7, 8, 9]
    assert steps(every="2 ms")[2:] == [1, 1, 3, 3, 5, 5, 7, 7, 9]
    assert steps(**{"with": {"sample_time": "4 ms"}})[4:] == [3, 3, 3, 3, 7, 7, 7]


def test_a_sample_time_between_the_steps_of_the_part_is_refused() -> None:
    held = {"use": "loop_parts:sampled", "wires": {"u": "u"}, "with": {"design": "1 ms"}, "every": "2 ms"}
    expected = "held.with.period wants a multiple of what the part steps by, 0.002 s, got 0.001 s"
    assert problems({"u": RAMP, "held": held}) == [expected]


def test_two_parts_of_one_make_share_no_state() -> None:
    twin = {"use": "loop_parts:linear", "wires": {"u0": "u"}}
    wired = system({"u": RAMP, "a": twin, "b": twin, "c": {**twin, "use": "loop_parts:sampled", "wires": {"u": "u"}}})
    assert wired.components["a"] is not wired.components["b"]
    record = run(wired)
    assert np.array_equal(record["a.y0"], record["b.y0"])


# All at once


def test_all_problems_are_found_at_once_each_at_its_place() -> None:
    text = """\
clock: {time: {step: 1 ms, stop: 10 ms}}
parts:
  plant: {use: "loop_parts:truth"}
  encoder: {use: sensor, of: plant.y, noise: {std: 1 N.m}}
  where: {use: sensor, of: plant.locatio}
  observer:
    use: loop_parts:estimator
    with: {gain: 1 Hz}
    wires:
      y: plant.torque
      location: where
record: [encoder, plant.why]
"""
    raw, places = read_yaml(text, "file.yaml")
    with pytest.raises(ConfigurationError) as caught:
        wire(Scenario.model_validate(raw), places)
    assert [str(problem) for problem in caught.value.problems] == [
        "file.yaml:4:52: encoder.noise.std wants rpm, got 1 N.m",
        "file.yaml:5:28: where.of: no signal is named 'plant.locatio'; did you mean 'plant.location'?",
        "file.yaml:10:10: observer.y wants rpm, got N.m from plant",
        "file.yaml:10:10: observer.y reads the truth, plant.torque: put a sensor between, "
        "like `torque_sensor: {use: sensor, of: plant.torque}`",
        "file.yaml:12:19: record[1]: no signal is named 'plant.why'; did you mean 'plant.y'?",
    ]


def test_the_wires_of_a_part_with_wrong_settings_are_checked_too() -> None:
    found = problems(changed("observer", **{"with": {"gain": "1 m"}, "wires": {"y": "encodr", "location": "where"}}))
    assert found == [
        "observer.with.gain wants 1/s, got 1 m",
        "observer.wires.y: no part is named 'encodr'; did you mean 'encoder'?",
    ]


def test_a_missing_wire_points_to_the_part() -> None:
    places = Places("file.yaml", {("parts", "observer"): Place("file.yaml", 7, 3)})
    parts = changed("observer", wires={"y": "encoder"})
    clock = {"time": {"step": "1 ms", "stop": "10 ms"}}
    with pytest.raises(ConfigurationError, match=r"file\.yaml:7:3: observer\.location wants a wire"):
        wire(Scenario.model_validate({"clock": clock, "parts": parts}), places)


def test_what_was_opened_is_closed_when_a_problem_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    import loop_parts

    closed: list[str] = []
    monkeypatch.setattr(loop_parts.Linear, "close", lambda self: closed.append("closed"))
    problems({"a": {"use": "loop_parts:linear", "with": {"inputs": 0}}, "b": {"use": "sensor", "of": "a.nothing"}})
    assert closed == ["closed"]


def test_wrong_settings_do_not_hide_what_is_wrong_with_the_wires():
    plant = {"use": "fmus.plants.driveline", "with": {"k": "1500 N.m", "kk": 3}, "wires": {"T_engine": "torque"}}
    parts = {
        "torque": {"use": "source", "unit": "N.m", "constant": "1 N.m"},
        "plant": plant,
        "observer": {**OBSERVER, "wires": {"y": "plant.y", "location": "plant.location"}},
    }
    said = "\n".join(problems(parts))
    assert "plant.with.k wants N.m/rad" in said
    assert "did you mean 'k'?" in said
    assert "did you mean 'T_eng'?" in said
    assert "observer.y reads the truth" in said
