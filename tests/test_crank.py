"""The crank clock: rows at exact angles, times that follow from the speed, events of the cycle, and its failures."""

from __future__ import annotations

import math
import re
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from crank_parts import OSCILLATOR, SPEED
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from oracle import run_plainly

from fmus.component import ConfigurationError
from fmus.export import build_fmu
from harness.campaign import read_campaign
from harness.cases import execute
from harness.record import Record, read_signals
from harness.run import run
from harness.scenario import Scenario
from harness.system import System
from harness.wiring import wire

ENGINE = {"use": "crank_parts:ENGINE"}


def system(parts: dict[str, Any], clock: dict[str, Any] | None = None, **rest: Any) -> System:
    """A system on a crank clock that reads engine.omega."""
    crank = {"step": "6 deg", "stop": "10 rev", "speed": "engine.omega", **(clock or {})}
    crank = {key: value for key, value in crank.items() if value is not None}
    return wire(Scenario.model_validate({"clock": {"crank": crank}, "parts": parts, **rest}))


def problems(parts: dict[str, Any], clock: dict[str, Any] | None = None) -> str:
    with pytest.raises(ConfigurationError) as caught:
        system(parts, clock)
    return str(caught.value)


def accelerating(rate: str, start: str = "1000 rpm") -> dict[str, Any]:
    return {**ENGINE, "with": {"rate": rate, "omega": start}}


# Instants


def test_rows_are_at_exact_multiples_of_the_step() -> None:
    record = run(system({"engine": accelerating("50 rad/s2")}, {"stop": "100 rev"}))
    assert record.outcome == "ok" and record.crank is not None
    assert np.array_equal(record.crank, 6.0 * np.arange(6001))
    assert np.all(np.diff(record.time) > 0) and np.diff(record.time)[0] > 1.5 * np.diff(record.time)[-1]


@pytest.mark.parametrize("count", [7, 11, 120, 720, 1440])
def test_a_step_given_as_a_share_of_the_cycle_meets_every_cycle_exactly(count: int) -> None:
    record = run(system({"engine": ENGINE}, {"step": None, "per_cycle": count, "stop": "20 rev"}))
    assert record.crank is not None
    assert np.array_equal(record.crank[::count], 720.0 * np.arange(11))


def test_times_follow_from_the_speed_at_the_begin_of_each_step() -> None:
    record = run(system({"engine": accelerating("80 rad/s2")}))
    expected = np.concatenate([[0.0], np.cumsum(math.radians(6.0) / record["engine.omega"][:-1])])
    # Sums of 600 steps differ by roundings only.
    np.testing.assert_allclose(record.time, expected, rtol=1e-13)


def test_at_constant_speed_it_is_the_clock_in_time_bit_for_bit() -> None:
    parts = {
        "engine": ENGINE,
        "wave": {"use": "source", "unit": "N.m", "sine": {"amplitude": "2 N.m", "frequency": "7 Hz", "mean": "0 N.m"}},
        "rod": {"use": "crank_parts:OSCILLATOR", "wires": {"force": "wave"}},
        "slow": {"use": "loop_parts:linear", "with": {"inputs": 1}, "wires": {"u0": "engine.ratio"}, "every": "30 deg"},
        "knock": {"use": "sensor", "of": "engine.omega", "noise": {"std": "1 rad/s"}},
    }
    on_crank = run(system(parts, {"stop": "200 rev"}))
    h = math.radians(6.0) / SPEED
    parts["slow"]["every"] = f"{5 * h!r} s"
    clock = {"time": {"step": f"{h!r} s", "stop": f"{12000 * h!r} s"}}
    in_time = run(wire(Scenario.model_validate({"clock": clock, "parts": parts})))
    assert len(on_crank.time) == 12001 and on_crank.time.tobytes() == in_time.time.tobytes()
    assert on_crank.values.tobytes() == in_time.values.tobytes()


def test_a_run_at_varying_speed_reaches_the_state_of_a_fine_run_in_time() -> None:
    parts = {
        "torque": {"use": "source", "unit": "N.m", "constant": "30 N.m"},
        "engine": {"use": "crank_parts:LOADED", "wires": {"torque": "torque"}},
    }
    on_crank = run(system(parts, {"stop": "100 rev"}))
    end = float(on_crank.time[-1])
    clock = {"time": {"step": f"{end / 200_000!r} s", "stop": f"{end!r} s"}}
    fine = run(wire(Scenario.model_validate({"clock": clock, "parts": parts, "record": {"signals": ["engine"]}})))
    # The input is constant, so both only integrate: RK4 of the FMU with inner steps of 0.1 ms at most, whose error is
    # far below 1e-9 on either grid.
    for name in ("engine.omega", "engine.theta"):
        assert on_crank[name][-1] == pytest.approx(fine[name][-1], rel=1e-9)


def test_a_clock_that_steers_keeps_to_the_plants_angle_and_its_residual_does_not_grow() -> None:
    parts = {"engine": accelerating("200 rad/s2"), "crank": {"use": "crank"}}
    blind = run(system({"engine": accelerating("200 rad/s2")}, {"stop": "200 rev"}))
    steered = run(system(parts, {"stop": "200 rev", "angle": "engine.theta"}))
    missed = np.degrees(steered["engine.theta"]) - steered.crank
    # One step's acceleration: (step/omega)^2 rate/2 of angle is missed; without steering the misses add up.
    at_most = np.degrees(0.5 * 200.0 * (np.diff(steered.time)) ** 2)
    assert np.all(np.abs(missed[1:]) <= 1.01 * at_most + 1e-9)
    assert np.degrees(blind["engine.theta"][-1]) - blind.crank[-1] > 100 * np.abs(missed[-1])
    np.testing.assert_allclose(np.degrees(steered["crank.residual"]), missed, atol=1e-9)


def test_it_ends_at_a_time_too_with_the_first_row_from_there_on() -> None:
    record = run(system({"engine": accelerating("50 rad/s2")}, {"stop": "0.5 s"}))
    assert record.outcome == "ok" and record.time[-1] >= 0.5 > record.time[-2]
    assert len(record.values) == len(record.time) == len(record.crank if record.crank is not None else ())


# The crank part


def test_the_crank_tells_angle_cycle_and_the_phases_in_firing_order() -> None:
    clock = {"stop": "8 rev", "step": "30 deg", "firing_order": [1, 3, 4, 2]}
    record = run(system({"engine": ENGINE, "crank": {"use": "crank"}}, clock))
    degrees = 30.0 * np.arange(len(record.time))
    np.testing.assert_allclose(np.degrees(record["crank.angle"]), degrees, atol=1e-10)
    assert np.array_equal(record["crank.cycle"], degrees // 720)
    np.testing.assert_allclose(np.degrees(record["crank.phase"]), degrees % 720, atol=1e-10)
    assert np.array_equal(record["crank.cylinder"], np.array([1, 3, 4, 2])[(degrees % 720 // 180).astype(int)])
    for cylinder, tdc in ((1, 0.0), (3, 180.0), (4, 360.0), (2, 540.0)):
        np.testing.assert_allclose(np.degrees(record[f"crank.phase_{cylinder}"]), (degrees - tdc) % 720, atol=1e-10)


def test_a_crank_on_a_clock_in_time_reads_the_angle_it_is_given() -> None:
    parts = {"engine": ENGINE, "crank": {"use": "crank", "of": "engine.theta", "firing_order": [1, 2, 3]}}
    clock = {"time": {"step": "0.7 ms", "stop": "0.5 s"}}
    record = run(wire(Scenario.model_validate({"clock": clock, "parts": parts})))
    degrees = np.degrees(record["engine.theta"])
    assert np.array_equal(record["crank.angle"], record["engine.theta"])
    # At a multiple of the cycle the last bit decides between its begin and its end.
    apart = np.degrees(record["crank.phase_2"]) - (degrees - 240.0) % 720
    np.testing.assert_allclose((apart + 360.0) % 720 - 360.0, 0.0, atol=1e-6)
    assert np.array_equal(record["crank.cycle"], np.floor(degrees / 720 + 1e-9))


# Parts on a crank clock


@pytest.mark.parametrize(
    ("at", "expected"),
    [("tdc", [0, 180, 360, 540]), ("cycle", [0]), (["90 deg", "100 deg"], [90, 100])],
)
def test_events_of_the_cycle_step_a_part_from_the_last_event_to_this(at: Any, expected: list[int]) -> None:
    parts = {"engine": accelerating("100 rad/s2"), "part": {"use": "loop_parts:clockwork", "at": at}}
    record = run(system(parts, {"step": "10 deg", "stop": "6 rev", "firing_order": [1, 3, 4, 2]}))
    assert record.crank is not None
    moved = np.flatnonzero(np.diff(record["part.calls"])) + 1
    assert set(record.crank[moved] % 720) == set(expected)
    since = np.concatenate([[0], moved[:-1]])
    assert np.array_equal(record["part.t"][moved], record.time[since])
    np.testing.assert_allclose(record["part.t"][moved] + record["part.h"][moved], record.time[moved], rtol=1e-14)


def test_a_part_may_keep_steps_in_time_of_its_own_and_never_shows_the_future() -> None:
    parts = {"engine": accelerating("300 rad/s2"), "part": {"use": "loop_parts:clockwork", "every": "0.9 ms"}}
    wired = system(parts, {"stop": "40 rev"})
    record = run(wired)
    calls = record["part.calls"]
    assert np.array_equal(calls, np.floor(record.time / 0.9e-3 + 1e-6))
    moved = np.flatnonzero(np.diff(calls)) + 1
    assert np.array_equal(record["part.h"][moved], np.full(len(moved), 0.9 * 1e-3))
    assert np.all(record["part.t"][moved] + 0.9e-3 <= record.time[moved] + 1e-9)
    assert any("steps of 0.0009 s of its own" in note["text"] for note in record.tolerated)


def _of_one_length(folder: Path, step: str) -> Path:
    """The oscillator as an FMU of FMI 3 that takes only steps of one length, and where `step` is given says which."""
    whole, path = folder / "whole.fmu", folder / "fixed.fmu"
    build_fmu(OSCILLATOR, whole, fmi=3)
    told = f'fixedInternalStepSize="{step}"' if step else ""
    with zipfile.ZipFile(whole) as source, zipfile.ZipFile(path, "w") as target:
        for name in source.namelist():
            content = source.read(name)
            if name == "modelDescription.xml":
                flag = b'canHandleVariableCommunicationStepSize="true"'
                assert flag in content
                content = content.replace(flag, flag.replace(b"true", b"false") + b" " + told.encode())
            target.writestr(name, content)
    return path


def test_an_fmu_that_takes_steps_of_one_length_only_keeps_to_its_grid(tmp_path: Path) -> None:
    """The oscillator under a constant force on its grid is the same run on a clock in time, sampled where it stands."""
    parts = {
        "engine": accelerating("200 rad/s2"),
        "force": {"use": "source", "unit": "N.m", "constant": "3 N.m"},
        "rod": {"use": str(_of_one_length(tmp_path, "0.0005")), "wires": {"force": "force"}},
    }
    record = run(system(parts, {"stop": "30 rev"}))
    assert any("steps of 0.0005 s of its own" in note["text"] for note in record.tolerated)
    alone = {"force": parts["force"], "rod": {"use": "crank_parts:OSCILLATOR", "wires": {"force": "force"}}}
    clock = {"time": {"step": "0.5 ms", "stop": f"{float(record.time[-1]) + 1e-3!r} s"}}
    in_time = run(wire(Scenario.model_validate({"clock": clock, "parts": alone})))
    latest = np.floor(record.time / 0.0005 + 1e-6).astype(int)
    assert np.array_equal(record["rod.x"], in_time["rod.x"][latest])


def test_an_fmu_that_says_no_length_is_to_be_given_one(tmp_path: Path) -> None:
    rod = {"use": str(_of_one_length(tmp_path, "")), "wires": {"force": "force"}}
    parts = {"engine": ENGINE, "force": {"use": "source", "unit": "N.m", "constant": "3 N.m"}, "rod": rod}
    assert "rod.every wants a time, like 1 ms: this FMU takes only steps of one length" in problems(parts)
    assert run(system({**parts, "rod": {**rod, "every": "1 ms"}})).outcome == "ok"


def test_a_sampled_model_samples_at_each_step_of_a_crank_clock() -> None:
    parts = {
        "engine": accelerating("100 rad/s2"),
        "speed": {"use": "sensor", "of": "engine.omega"},
        "kept": {"use": "crank_parts:LATEST", "with": {"period": "0 s"}, "wires": {"u": "speed"}},
    }
    record = run(system(parts))
    assert np.array_equal(record["kept.y"][1:], record["engine.omega"][1:])
    parts["kept"]["with"] = {}
    assert "wants 0 s, to sample at each step of the crank clock" in problems(parts)


def test_only_one_row_in_so_many_is_kept_where_that_is_asked_for() -> None:
    parts = {"engine": accelerating("100 rad/s2")}
    everything = run(system(parts, {"stop": "20 rev"}))
    tenth = run(system(parts, {"stop": "20 rev"}, record={"every": 7}))
    assert tenth.time.tobytes() == everything.time[::7].tobytes()
    assert tenth.values.tobytes() == np.ascontiguousarray(everything.values[::7]).tobytes()
    assert everything.crank is not None and np.array_equal(tenth.crank, everything.crank[::7])


def test_the_example_of_the_documentation_is_accepted(tmp_path: Path) -> None:
    page = (Path(__file__).parent.parent / "docs" / "clocks.md").read_text(encoding="utf-8")
    (text,) = [block for block in re.findall(r"```yaml\n(.*?)```", page, re.DOTALL) if block.startswith("campaign:")]
    (tmp_path / "crank.yaml").write_text(text, encoding="utf-8")
    result = execute(read_campaign(tmp_path / "crank.yaml"), tmp_path / "out", 1, lambda ended: None)
    assert result.accepted, result.verdicts
    (signals,) = (tmp_path / "out" / "cases").glob("*/signals.parquet")
    record = read_signals(signals)
    assert np.array_equal(record.crank, 6.0 * np.arange(6001))


def test_a_lag_and_a_delay_on_a_crank_clock_are_those_in_time() -> None:
    """omega rises evenly: behind a lag T it follows T late, behind a delay D it is D late, whatever the steps are."""
    parts = {
        "engine": accelerating("100 rad/s2"),
        "lagged": {"use": "sensor", "of": "engine.omega", "lag": "20 ms"},
        "late": {"use": "sensor", "of": "engine.omega", "delay": "30 ms"},
        "both": {"use": "sensor", "of": "engine.omega", "lag": "20 ms", "delay": "30 ms", "every": "12 deg"},
    }
    record = run(system(parts, {"stop": "60 rev"}))
    settled = record.time > 0.5
    time, start = record.time[settled], record["engine.omega"][0]
    # The signal is linear in time, for which lag and delay are exact; the rest of the first lag is exp(-25) = 1e-11.
    np.testing.assert_allclose(record["lagged.value"][settled], start + 100.0 * (time - 0.02), rtol=1e-10)
    np.testing.assert_allclose(record["late.value"][settled], start + 100.0 * (time - 0.03), rtol=1e-12)
    even = settled & (np.arange(len(record.time)) % 2 == 0)
    np.testing.assert_allclose(record["both.value"][even], start + 100.0 * (record.time[even] - 0.05), rtol=1e-9)


def test_a_delay_longer_than_its_ring_is_an_error_that_names_the_sensor() -> None:
    parts = {
        "engine": accelerating("9000 rad/s2", "15000 rpm"),
        "late": {"use": "sensor", "of": "engine.omega", "delay": "50 ms"},
    }
    record = run(system(parts, {"stop": "400 rev"}))
    assert record.outcome == "error" and record.part == "late"
    assert "its delay of 0.05 s reaches over more samples than come at 20000 rpm" in record.message


# Failure


@pytest.mark.parametrize(
    ("with_", "said"),
    [
        ({"rate": "-40 rad/s2"}, "the crank clock wants at least"),
        ({"omega": "0 rad/s"}, "engine.omega is 0 rad/s: the crank clock wants at least 0.10472 rad/s"),
        ({"omega": "-5 rad/s"}, "engine.omega is -5 rad/s"),
    ],
)
def test_a_speed_too_low_or_negative_ends_the_run_by_name(with_: dict[str, str], said: str) -> None:
    record = run(system({"engine": {**ENGINE, "with": with_}}, {"stop": "500 rev"}))
    assert record.outcome == "error" and record.part == "engine" and said in record.message
    assert record.failed_at == record.time[-1]


def test_a_speed_that_is_no_number_is_an_outcome() -> None:
    engine = {"use": "crank_parts:broken_speed", "with": {"at": "50 ms"}}
    record = run(system({"engine": engine}))
    assert record.outcome == "diverged" and record.part == "engine" and "engine.omega is nan" in record.message


def test_a_plant_whose_angle_is_elsewhere_is_told_so() -> None:
    parts = {"engine": {**ENGINE, "with": {"theta": "30 deg"}}}
    record = run(system(parts, {"angle": "engine.theta"}))
    assert record.outcome == "error" and "engine.theta is 30 deg where the crank clock is at 0 deg" in record.message
    assert run(system(parts, {"angle": "engine.theta", "origin": "30 deg"})).outcome == "ok"


@pytest.mark.parametrize(
    ("clock", "said"),
    [
        ({"step": "7 deg"}, "clock.crank.step wants to divide the cycle of 720 deg, got 7.0 deg; near are"),
        ({"step": "6 ms"}, "clock.crank.step wants deg, got 6 ms"),
        ({"speed": "engine.theta"}, "clock.crank.speed wants rad/s, got rad from engine.theta"),
        ({"speed": "motor.omega"}, "no part is named 'motor'"),
        ({"stop": "0 deg"}, "clock.crank.stop wants an angle after the origin"),
        ({"firing_order": [1, 3, 3]}, "clock.crank.firing_order wants each cylinder 1 ... 3 once"),
        ({"firing_order": [1, 2], "tdc": ["0 deg"]}, "clock.crank.tdc wants one angle a cylinder"),
        ({"slowest": "0 rpm"}, "clock.crank.slowest wants a speed above 0 rpm"),
    ],
)
def test_what_is_wrong_with_a_crank_clock_is_said_before_the_run(clock: dict[str, Any], said: str) -> None:
    assert said in problems({"engine": ENGINE}, clock)


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        ({"every": "8 deg"}, "part.every wants a multiple of the clock's step, 6 deg, got 8.0 deg"),
        ({"at": "tdc"}, "part.at wants the clock to have a firing_order"),
        ({"at": ["3 deg"]}, "part.at wants events at instants of the clock"),
        ({"at": "cycle", "every": "6 deg"}, "part.at wants to stand without `every`"),
    ],
)
def test_what_is_wrong_with_a_parts_pace_is_said_before_the_run(keys: dict[str, Any], said: str) -> None:
    assert said in problems({"engine": ENGINE, "part": {"use": "loop_parts:clockwork", **keys}})


# The oracle


@st.composite
def _crank_systems(draw: st.DrawFn) -> System:
    """Parts of several paces and languages behind an engine whose speed swings, on clocks of several kinds."""
    rate = draw(st.floats(-200.0, 300.0))
    steers = draw(st.booleans())
    parts: dict[str, Any] = {"engine": accelerating(f"{rate} rad/s2"), "crank": {"use": "crank"}}
    paces = st.sampled_from(
        [{}, {"every": "12 deg"}, {"every": "60 deg"}, {"at": "tdc"}, {"at": "cycle"}, {"at": ["6 deg", "30 deg"]},
         {"every": "0.7 ms"}, {"every": "3 ms"}]
    )  # fmt: skip
    names = [f"part{i}" for i in range(draw(st.integers(1, 4)))]
    outputs = ["engine.ratio", "crank.cycle", *(f"{name}.y0" for name in names)]
    for seed, name in enumerate(names):
        language = draw(st.sampled_from(["native", "python"]))
        source, late = draw(st.sampled_from(outputs)), draw(st.sampled_from([0, 1]))
        parts[name] = {
            "use": "loop_parts:linear",
            "with": {"inputs": 1, "seed": seed, "language": language, "direct": draw(st.sampled_from([0.0, 1.0]))},
            "wires": {"u0": {"from": source, "delay": late}},
            **draw(paces),
        }
    slow = draw(
        st.fixed_dictionaries({}, optional={"lag": st.just("7 ms"), "delay": st.sampled_from(["0.3 ms", "9 ms"])})
    )
    parts["noisy"] = {"use": "sensor", "of": "engine.omega", "noise": {"std": "3 rad/s"}, **slow}
    clock = {
        "step": draw(st.sampled_from(["6 deg", "3 deg"])),
        "stop": draw(st.sampled_from(["3 rev", "0.1 s"])),
        "origin": draw(st.sampled_from(["0 deg", "60 deg"])),
        "firing_order": [1, 3, 2],
    }
    if steers:
        clock["angle"] = "engine.theta"
        parts["engine"]["with"]["theta"] = clock["origin"]
    try:
        return system(parts, clock, record={"every": draw(st.integers(1, 4))})
    except ConfigurationError as error:
        assert "algebraic loop" in str(error)
        assume(False)
        raise


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.too_slow, HealthCheck.filter_too_much])
@given(wired=_crank_systems())
def test_the_c_loop_on_a_crank_clock_matches_the_plain_python_oracle_bit_for_bit(wired: System) -> None:
    record: Record = run(wired)
    assert record.outcome == "ok", record.message
    plain = run_plainly(wired)
    ours = np.column_stack([record.time, record.values])
    assert ours.shape == plain.shape
    different = np.argwhere(ours != plain)
    assert not len(different), (["time", *record.names][different[0][1]], different[0], wired.order)
