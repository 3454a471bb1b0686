"""The laws of time and chance, and the C loop against its plain-Python oracle, bit for bit."""

from __future__ import annotations

import itertools
import math
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from loop_parts import Clockwork, Linear
from oracle import run_plainly

from fmus.component import ConfigurationError
from harness.run import run
from harness.scenario import Scenario
from harness.started import StartedSystem
from harness.wiring import System, wire


def scenario(parts: dict[str, Any], step: str = "1 ms", stop: str = "10 ms", **rest: Any) -> Scenario:
    return Scenario.model_validate({"clock": {"time": {"step": step, "stop": stop}}, "parts": parts, **rest})


def system(parts: dict[str, Any], step: str = "1 ms", stop: str = "10 ms", **rest: Any) -> System:
    return wire(scenario(parts, step, stop, **rest))


STEP_AT_2 = {"use": "source", "unit": "1", "step": {"at": "2 s", "from": 0, "to": 1}}
NOISE = {"use": "sensor", "of": "plant.y", "noise": {"std": "1 rpm"}, "drop_out": 0.2}
PLANT = {"use": "loop_parts:truth"}


# Time


def test_time_is_counted_and_never_accumulated() -> None:
    record = run(system({"part": {"use": "loop_parts:clockwork"}}, "0.1 s", "1000 s"))
    k = np.arange(10001)
    assert np.array_equal(record.time, 0.0 + k * 0.1)
    assert np.array_equal(record["part.t"][1:], 0.0 + (k[1:] - 1) * 0.1)
    assert np.any(np.cumsum(np.full(10000, 0.1)) != record.time[1:]), "accumulating would show here"


def test_time_starts_where_the_clock_says() -> None:
    timed = {"clock": {"time": {"start": "-1 s", "step": "0.3 s", "stop": "2 s"}}}
    record = run(wire(Scenario.model_validate({**timed, "parts": {"part": {"use": "loop_parts:clockwork"}}})))
    assert np.array_equal(record.time, [-1.0 + k * 0.3 for k in range(11)])


def test_a_slow_part_steps_at_the_end_of_its_period_over_all_of_it() -> None:
    record = run(system({"part": {"use": "loop_parts:clockwork", "every": "3 ms"}}))
    assert record["part.calls"].tolist() == [0, 0, 0, 1, 1, 1, 2, 2, 2, 3, 3]
    assert record["part.t"].tolist()[3::3] == [0.0, 3 * 0.001, 6 * 0.001]
    assert record["part.h"].tolist()[3::3] == [3 * 0.001] * 3


def test_a_step_source_acts_from_the_row_after_its_time() -> None:
    record = run(system({"source": STEP_AT_2}, "1 ms", "2.01 s"))
    assert record["source.value"][2000] == 0.0 and record["source.value"][2001] == 1.0
    assert np.count_nonzero(record["source.value"]) == 10


@pytest.mark.parametrize("step", ["1 ms", "0.1 s", "0.3 ms", "0.7 ms"])
def test_a_jump_on_an_instant_acts_in_the_next_row_whatever_the_last_bit(step: str) -> None:
    h = float(step.split()[0]) * (1.0 if step.endswith(" s") else 1e-3)
    for n in range(1, 60):
        jump = {"use": "source", "unit": "1", "step": {"at": f"{n * h!r} s", "from": 0, "to": 1}}
        record = run(system({"source": jump}, step, f"{(n + 2) * h!r} s"))
        assert record["source.value"].tolist() == [0.0] * (n + 1) + [1.0] * 2


def test_row_0_of_a_source_is_its_value_at_the_start() -> None:
    sine = {"amplitude": 2, "frequency": "5 Hz", "mean": 1, "phase": "0.5 rad"}
    record = run(system({"source": {"use": "source", "unit": "1", "sine": sine}}, "1 ms", "0.5 s"))
    exact = 1.0 + 2.0 * np.sin(2.0 * np.pi * 5.0 * record.time + 0.5)
    assert record["source.value"][0] == exact[0]
    # Row k holds the value at t_{k-1}; the sine of two libraries may differ in the last bits.
    np.testing.assert_allclose(record["source.value"][1:], exact[:-1], rtol=0, atol=1e-14)


def test_tables_hold_or_join_their_points_and_hold_their_ends() -> None:
    points = {"time": ["2 ms", "4 ms", "5 ms"], "value": [1, 3, -1]}
    held = {"use": "source", "unit": "1", "table": points}
    joined = {"use": "source", "unit": "1", "table": {**points, "between": "linear"}}
    ramp = {"use": "source", "unit": "1", "ramp": {"at": "2 ms", "until": "6 ms", "from": 0, "to": 4}}
    record = run(system({"held": held, "joined": joined, "ramp": ramp}, stop="8 ms"))
    assert record["held.value"].tolist() == [1, 1, 1, 1, 1, 3, -1, -1, -1]
    # 4 ms is 0.004 to the last bit here, so the interpolation errs by a few last bits only.
    np.testing.assert_allclose(record["joined.value"], [1, 1, 1, 1, 2, 3, -1, -1, -1], atol=1e-12)
    np.testing.assert_allclose(record["ramp.value"], [0, 0, 0, 0, 1, 2, 3, 4, 4], atol=1e-12)


# Order


def test_a_chain_shows_each_part_the_value_of_the_same_instant() -> None:
    chain = {
        "last": {"use": "sensor", "of": "first"},
        "first": {"use": "sensor", "of": "plant.y"},
        "plant": PLANT,
    }
    record = run(system(chain))
    assert record.order == ("plant", "first", "last") and record.held == ()
    assert np.array_equal(record["last.value"], record["plant.y"])


def test_a_held_wire_shows_the_value_of_the_instant_before() -> None:
    loop = {
        "plant": {"use": "loop_parts:linear", "with": {"seed": 1}, "wires": {"u0": "controller"}},
        "controller": {"use": "loop_parts:linear", "with": {"seed": 2, "direct": 1.0}, "wires": {"u0": "plant"}},
    }
    wired = system(loop)
    record = run(wired)
    assert record.order == ("plant", "controller") and record.held == ("controller.y0 -> plant.u0",)
    plant = wired.components["plant"]
    assert isinstance(plant, Linear)
    u, y = record["controller.y0"], record["plant.y0"]
    for k in range(1, 11):
        before = record.time[k - 1]
        predicted = plant.a[0] * y[k - 1] + 0.01 * before + 0.1 * 0.001 + plant.b[0, 0] * u[k - 1]
        assert y[k] == pytest.approx(predicted, rel=1e-14)  # the order of the sums differs by a rounding


def test_the_plant_in_the_row_of_an_estimate_is_that_of_the_same_instant() -> None:
    parts = {
        "plant": PLANT,
        "y": {"use": "sensor", "of": "plant.y"},
        "location": {"use": "sensor", "of": "plant.location"},
        "observer": {
            "use": "loop_parts:estimator",
            "with": {"gain": "1 Hz"},
            "wires": {"y": "y", "location": "location"},
        },
    }
    record = run(system(parts))
    assert np.array_equal(record["observer.y_hat"], record["plant.y"])


# Chance


def test_adding_an_observer_or_a_sensor_changes_no_sample_of_another_sensor() -> None:
    alone = run(system({"plant": PLANT, "encoder": NOISE}, stop="10 s", seed=7))
    observer = {
        "use": "loop_parts:estimator",
        "with": {"gain": "1 Hz"},
        "wires": {"y": "encoder", "location": "where"},
    }
    more = {
        "other": {**NOISE, "of": "plant.torque", "noise": {"std": "1 N.m"}},
        "observer": observer,
        "plant": PLANT,
        "where": {"use": "sensor", "of": "plant.location"},
        "encoder": NOISE,
    }
    crowd = run(system(more, stop="10 s", seed=7))
    assert np.array_equal(alone["encoder.value"], crowd["encoder.value"])
    assert not np.array_equal(crowd["other.value"] - crowd["plant.torque"], crowd["encoder.value"] - crowd["plant.y"])


def test_the_seed_changes_the_samples() -> None:
    one, two = (run(system({"plant": PLANT, "encoder": NOISE}, seed=seed)) for seed in (1, 2))
    assert not np.array_equal(one["encoder.value"], two["encoder.value"])


def test_two_runs_of_one_system_give_the_same_bytes() -> None:
    wired = system({"plant": PLANT, "encoder": NOISE}, stop="10 s")
    assert run(wired).values.tobytes() == run(wired).values.tobytes()


@settings(max_examples=20, deadline=None)
@given(cuts=st.lists(st.integers(1, 9999), max_size=6))
def test_a_run_in_pieces_gives_the_same_bytes(cuts: list[int]) -> None:
    wired = _noisy_loop()
    whole = run(wired)
    started = StartedSystem(wired)
    rows = np.empty((10001, 1 + len(whole.names)))
    rows[0] = started.row()
    instants = [0, *sorted(set(cuts)), 10000]
    for begin, end in itertools.pairwise(instants):
        assert started.advance(begin, end, rows[begin + 1 :]) == end
    assert rows.tobytes() == np.column_stack([whole.time, whole.values]).tobytes()


def _noisy_loop() -> System:
    plant = {"use": "loop_parts:linear", "with": {"inputs": 2, "outputs": 2}, "wires": {"u0": "y0", "u1": "wave"}}
    wave = {"use": "source", "unit": "1", "sine": {"amplitude": 1, "frequency": "3 Hz", "mean": 0}}
    sensor = {"use": "sensor", "of": "plant.y0", "noise": {"std": 0.1}, "drop_out": 0.1, "delay": "2.5 ms"}
    return system({"plant": plant, "y0": sensor, "wave": wave}, stop="10 s")


# The oracle


@st.composite
def scenarios(draw: st.DrawFn) -> Scenario:
    """Up to six parts of all kinds and rates, wired at random."""
    count = draw(st.integers(1, 6))
    kinds = [draw(st.sampled_from(["source", "sensor", "native", "python"])) for _ in range(count)]
    if all(kind == "sensor" for kind in kinds):
        kinds[0] = "native"
    shapes = [(draw(st.integers(0, 3)), draw(st.integers(1, 3))) for _ in range(count)]
    anything = [
        f"p{i}.{f'y{j}' if kind in ('native', 'python') else 'value'}"
        for i, (kind, (_, outputs)) in enumerate(zip(kinds, shapes, strict=True))
        for j in range(outputs if kind in ("native", "python") else 1)
    ]
    measurable = [name for name in anything if kinds[int(name[1])] != "sensor"]
    rate = st.sampled_from(["1 ms", "2 ms", "3 ms"])
    parts: dict[str, Any] = {}
    wires = st.sampled_from(anything)
    wires |= st.builds(lambda name, faults: {"from": name, "faults": faults}, wires, st.lists(_faults, max_size=3))
    for i, (kind, (inputs, outputs)) in enumerate(zip(kinds, shapes, strict=True)):
        if kind == "source":
            parts[f"p{i}"] = draw(_sources)
        elif kind == "sensor":
            parts[f"p{i}"] = {"use": "sensor", "of": draw(st.sampled_from(measurable)), **draw(_errors)}
        else:
            chosen = {
                "inputs": inputs,
                "outputs": outputs,
                "seed": draw(st.integers(0, 99)),
                "direct": draw(st.sampled_from([0.0, 0.2])),
                "language": kind,
            }
            wired = {f"u{j}": draw(wires) for j in range(inputs)}
            parts[f"p{i}"] = {"use": "loop_parts:linear", "with": chosen, "wires": wired, "every": draw(rate)}
    for i in range(draw(st.integers(0, 2)) if len(anything) > 1 else 0):
        pair = draw(st.lists(st.sampled_from(anything), min_size=2, max_size=2, unique=True))
        parts[f"s{i}"] = {"use": "swap", "between": pair, **draw(_windows)}
    return scenario(parts, stop="40 ms", seed=draw(st.integers(0, 2**40)))


_level = st.floats(-2.0, 2.0)
_sources = st.one_of(
    st.builds(lambda a: {"use": "source", "unit": "1", "constant": a}, _level),
    st.builds(
        lambda a, b, t: {"use": "source", "unit": "1", "step": {"at": f"{t} ms", "from": a, "to": b}},
        _level,
        _level,
        st.integers(-5, 50),
    ),
    st.builds(
        lambda a, f: {"use": "source", "unit": "1", "sine": {"amplitude": a, "frequency": f"{f} Hz", "mean": 0.1}},
        _level,
        st.floats(0.0, 500.0),
    ),
    st.builds(
        lambda a, f, g, begin, sweep: {
            "use": "source",
            "unit": "1",
            "chirp": {
                **{"amplitude": a, "mean": 0.1, "from": f"{f} Hz", "to": f"{g} Hz", "sweep": sweep},
                **{"begin": f"{begin} ms", "duration": "25 ms"},
            },
        },
        _level,
        st.floats(1.0, 500.0),
        st.floats(1.0, 500.0),
        st.integers(-5, 45),
        st.sampled_from(["linear", "logarithmic"]),
    ),
    st.builds(
        lambda times, a, b, ends: {
            "use": "source",
            "unit": "1",
            "table": {
                **{"time": [f"{t} ms" for t in sorted(times)], "value": [a * t for t in times]},
                **{"between": b, "ends": ends},
            },
        },
        st.sets(st.integers(-5, 45), min_size=2, max_size=5),
        _level,
        st.sampled_from(["hold", "linear"]),
        st.sampled_from(["hold", "repeat"]),
    ),
)
_probability = st.floats(0.0, 1.0)
_windows = st.builds(
    lambda begin, length: {"from": f"{begin} ms", **({} if length is None else {"to": f"{begin + length} ms"})},
    st.integers(-5, 40),
    st.none() | st.integers(1, 20),
)
_faults = st.builds(
    lambda fault, window: {**fault, **window},
    st.one_of(
        st.builds(lambda a: {"bias": a}, _level),
        st.builds(lambda a: {"gain": a}, _level),
        st.builds(lambda a: {"drift": a}, _level),
        st.just({"stuck": True}),
        st.builds(lambda a: {"drop_out": a}, _probability),
        st.builds(lambda a: {"noise": abs(a)}, _level),
        st.builds(lambda t: {"delay": f"{t} ms"}, st.floats(0.0, 9.0) | st.integers(0, 9)),
    ),
    _windows,
)
_errors = st.fixed_dictionaries(
    {},
    optional={
        "lag": st.builds(lambda t: f"{t} ms", st.floats(0.01, 100.0)),
        "delay": st.builds(lambda t: f"{t} ms", st.floats(0.0, 12.0) | st.integers(0, 12)),
        "gain": _level,
        "bias": _level,
        "noise": st.builds(lambda a: {"std": abs(a)}, _level),
        "drop_out": _probability,
        "quantise": st.floats(1e-3, 0.5),
        "limits": st.builds(lambda a: [-abs(a), abs(a) + 0.1], _level),
        "faults": st.lists(_faults, max_size=4),
        "every": st.sampled_from(["1 ms", "2 ms", "5 ms"]),
    },
)


@settings(max_examples=300, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(described=scenarios())
def test_the_c_loop_matches_the_plain_python_oracle_bit_for_bit(described: Scenario) -> None:
    try:
        wired = wire(described)
    except ConfigurationError as error:
        assert "algebraic loop" in str(error)
        return
    record = run(wired)
    assert record.outcome == "ok", record.message
    plain = run_plainly(wired)
    different = np.argwhere(np.column_stack([record.time, record.values]) != plain)
    assert not len(different), (["time", *record.names][different[0][1]], different[0], wired.order)


def test_recorded_signals_come_in_the_order_asked_for() -> None:
    wired = system({"plant": PLANT, "encoder": NOISE}, record=["encoder", "plant.y", "plant.torque"])
    record = run(wired)
    assert record.names == ["encoder.value", "plant.y", "plant.torque"]
    assert np.array_equal(record.values, run_plainly(wired)[:, 1:])


# Failure


@pytest.mark.parametrize("what", ["nan", "inf", "-inf"])
def test_an_output_that_is_not_finite_ends_the_run_as_diverged(what: str) -> None:
    record = run(system({"part": {"use": "loop_parts:clockwork", "with": {"at": "4.5 ms", "what": what}}}))
    assert (record.outcome, record.part, record.message) == ("diverged", "part", f"part.calls is {what}")
    assert record.failed_at == 5 * 0.001
    assert len(record.time) == len(record.values) == 5 and np.all(np.isfinite(record.values))


@pytest.mark.parametrize("rest", [{}, {"record": ["one.value"]}])
def test_finite_outputs_whose_sum_overflows_are_fine(rest: dict[str, Any]) -> None:
    huge = {"use": "source", "unit": "1", "step": {"at": "4 ms", "from": 0, "to": 1.7e308}}
    record = run(system({"one": huge, "two": huge}, **rest))
    assert (record.outcome, len(record.time), record["one.value"][-1]) == ("ok", 11, 1.7e308)


def test_what_python_raises_ends_the_run_with_part_time_and_trace() -> None:
    record = run(system({"part": {"use": "loop_parts:clockwork", "with": {"at": "4.5 ms", "what": "raise"}}}))
    assert (record.outcome, record.part) == ("error", "part")
    assert record.message == "ZeroDivisionError: a bug" and record.failed_at == 5 * 0.001
    assert "loop_parts.py" in record.log[-1]["text"]
    assert len(record.time) == 5


@pytest.mark.parametrize("what", ["discard", "error", "fatal"])
def test_a_step_error_gives_the_outcome_of_its_status(what: str) -> None:
    record = run(system({"part": {"use": "loop_parts:clockwork", "with": {"at": "4.5 ms", "what": what}}}))
    assert (record.outcome, record.part, record.message, len(record.time)) == (what, "part", "told so", 5)


def test_a_step_that_returns_too_few_outputs_is_an_error() -> None:
    record = run(system({"part": {"use": "loop_parts:clockwork", "with": {"at": "4.5 ms", "what": "short"}}}))
    assert record.outcome == "error" and "wants to return 3 outputs, got 1" in record.message


@pytest.mark.parametrize(("status", "outcome"), [(2, "discard"), (3, "error"), (4, "fatal")])
def test_a_status_above_warning_ends_the_run(status: int, outcome: str) -> None:
    record = run(system({"part": {"use": "loop_parts:status", "with": {"at": "4.5 ms", "status": status}}}))
    assert (record.outcome, record.part, len(record.time)) == (outcome, "part", 5)
    assert record.failed_at == 5 * 0.001


def test_warnings_are_counted_and_the_run_goes_on() -> None:
    record = run(system({"part": {"use": "loop_parts:status", "with": {"at": "4.5 ms", "status": 1}}}))
    assert record.outcome == "warning" and len(record.time) == 11
    assert record.message == "steps that ended with a warning: part 6"


def test_an_interrupt_inside_a_python_part_comes_through() -> None:
    with pytest.raises(KeyboardInterrupt):
        run(system({"part": {"use": "loop_parts:clockwork", "with": {"at": "4.5 ms", "what": "interrupt"}}}))


@contextmanager
def interrupted_after(delay: float) -> Iterator[None]:
    main = threading.main_thread().ident
    assert main is not None
    timer = threading.Timer(delay, lambda: signal.pthread_kill(main, signal.SIGINT))
    timer.start()
    try:
        yield
    finally:  # a signal still to come would strike another test
        timer.join()


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize("handler", [signal.default_int_handler, lambda *_: signal.default_int_handler(*_)])
def test_an_interrupt_amid_callbacks_is_not_lost(handler: Any) -> None:
    """With Python's own handler it waits for the end of a piece; with another it strikes anywhere in the callbacks."""
    part = {"use": "loop_parts:clockwork"}
    wired = system({"part": part, "plant": PLANT, "encoder": NOISE}, stop="1000 s")
    before = signal.signal(signal.SIGINT, handler)
    try:
        for delay in (0.02, 0.05, 0.1):
            with pytest.raises(KeyboardInterrupt), interrupted_after(delay):
                run(wired)
    finally:
        signal.signal(signal.SIGINT, before)
    assert signal.getsignal(signal.SIGINT) is before


def test_an_interrupt_during_native_steps_comes_through_at_once() -> None:
    sine = {"use": "source", "unit": "1", "sine": {"amplitude": 1, "frequency": "1 Hz", "mean": 0}}
    noisy = {"use": "sensor", "of": "source", "noise": {"std": 1}}
    wired = system({"source": sine, "noisy": noisy}, "1 us", "100 s", record=[])
    began = time.perf_counter()
    with pytest.raises(KeyboardInterrupt), interrupted_after(0.3):
        run(wired)
    assert time.perf_counter() - began < 2.0  # 0.3 s and a piece or two; the whole takes about 5 s


def test_progress_is_told_up_to_the_last_step() -> None:
    told: list[tuple[int, int]] = []
    run(system({"source": STEP_AT_2}, stop="1 s"), progress=lambda k, steps: told.append((k, steps)))
    assert told[-1] == (1000, 1000) and [k for k, _ in told] == sorted({k for k, _ in told})


def test_the_loop_lets_other_threads_run() -> None:
    """A thread counts while the loop, in C, holds on to one processor: with the GIL held it could not."""
    wired = system({"source": STEP_AT_2}, "1 us", "5 s", record=[])
    started = StartedSystem(wired)
    counted = 0
    done = threading.Event()

    def count() -> None:
        nonlocal counted
        while not done.is_set():
            counted += 1

    thread = threading.Thread(target=count)
    thread.start()
    before = counted
    began = time.perf_counter()
    started.advance(0, 5_000_000, np.empty((5_000_000, 1)))
    took, grown = time.perf_counter() - began, counted - before
    done.set()
    thread.join()
    # Held, the GIL would let at most one slice of the other thread in before the call and none during it.
    assert grown > 1e5 * took


def test_a_part_that_fails_to_start_leaves_no_rows() -> None:
    wired = system({"part": {"use": "loop_parts:clockwork"}})
    part = wired.components["part"]
    assert isinstance(part, Clockwork)
    part.start = lambda t0, u: np.array([math.nan, 0.0, 0.0])  # type: ignore[method-assign]
    record = run(wired)
    assert (record.outcome, record.part, record.message) == ("diverged", "part", "part.t is nan")
    assert record.values.shape == (0, 3) and record.failed_at == 0.0


def test_the_time_of_each_part_is_told_and_is_part_of_the_whole() -> None:
    slow = {"use": "loop_parts:linear", "with": {"outputs": 3, "language": "python"}, "wires": {"u0": "source"}}
    wired = system({"source": STEP_AT_2, "slow": slow}, stop="2 s")
    walls = [run(wired).wall for _ in range(5)]
    assert all(list(wall) == ["source", "slow", "total"] for wall in walls)
    # What else runs on the machine may slow one run down as a whole, but not five.
    assert any(w["slow"] > 5 * w["source"] and 0.3 * w["total"] < w["slow"] < 1.5 * w["total"] for w in walls)
