"""Parts that feed each other: order of convergence, algebraic loops, smaller steps, exact steering."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from oracle import run_plainly
from scipy.linalg import expm

from fmus.component import ConfigurationError
from harness.record import Record
from harness.run import run
from harness.scenario import Scenario
from harness.system import System
from harness.wiring import wire

OSCILLATOR = {
    "mass": {"use": "coupled_parts:MASS", "wires": {"force": "spring.force"}},
    "spring": {"use": "coupled_parts:SPRING", "wires": {"x": "mass.x"}},
}


def system(parts: dict[str, Any], step: float = 1e-2, stop: float = 1.0, **rest: Any) -> System:
    clock = {"time": {"step": f"{step!r} s", "stop": f"{stop!r} s"}}
    return wire(Scenario.model_validate({"clock": clock, "parts": parts, **rest}))


def problems(parts: dict[str, Any], **rest: Any) -> str:
    with pytest.raises(ConfigurationError) as caught:
        system(parts, **rest)
    return str(caught.value)


def ring(*gains: tuple[float, float], use: str = "coupled_parts:LINE", **more: Any) -> dict[str, Any]:
    """Lines in a ring, each reading the one before: (gain, offset) each."""
    count = len(gains)
    return {
        f"p{i}": {"use": use, "with": {"gain": gain, "offset": offset, **more}, "wires": {"u": f"p{(i - 1) % count}.y"}}
        for i, (gain, offset) in enumerate(gains)
    }


# Two plants that feed each other


def _oscillation(t: float) -> float:
    """x(t) of the two masses in one piece, from their matrix exponential."""
    k = 0.5
    a = np.array([[0, 1, 0, 0], [-1 - k, 0, k, 0], [0, 0, 0, 1], [k, 0, -1 - k, 0]], dtype=float)
    return float((expm(a * t) @ np.array([1.0, 0.0, 0.0, 0.0]))[0])


@pytest.mark.parametrize("method", ["gauss-seidel", "jacobi"])
def test_coupled_plants_converge_to_the_closed_form_with_order_one(method: str) -> None:
    """Inputs are held over a step, which is of order one, whatever the integrators inside are."""
    errors = []
    for step in (0.02, 0.01, 0.005, 0.0025):
        record = run(system(OSCILLATOR, step, 4.0, coupling={"method": method}))
        exact = np.array([_oscillation(t) for t in record.time[:: round(0.5 / step)]])
        errors.append(np.max(np.abs(record["mass.x"][:: round(0.5 / step)] - exact)))
    orders = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    # The second term of the error's expansion in h is still seen at these steps.
    assert np.all(np.abs(orders - 1.0) < 0.12), (method, errors, orders)


def test_jacobi_shows_every_plant_the_instant_before_and_says_so() -> None:
    wired = system(OSCILLATOR, coupling={"method": "jacobi"})
    assert {str(wire) for wire in wired.held} == {"spring.force -> mass.force", "mass.x -> spring.x"}
    one = system(OSCILLATOR)
    assert {str(wire) for wire in one.held} == {"spring.force -> mass.force"}
    assert not np.array_equal(run(wired)["mass.x"], run(one)["mass.x"])
    swapped = {name: OSCILLATOR[name] for name in ("spring", "mass")}
    again = run(system(swapped, coupling={"method": "jacobi"}))
    assert np.array_equal(again["mass.x"], run(wired)["mass.x"]), "the order of declaration does not matter"


def test_a_late_wire_carries_the_instant_before_whatever_the_order() -> None:
    wave = {"use": "source", "unit": "1", "sine": {"amplitude": 1, "frequency": "3 Hz", "mean": 0}}
    line = {"use": "coupled_parts:LINE", "with": {"gain": 2.0}}
    parts = {"wave": wave, "line": {**line, "wires": {"u": {"from": "wave", "delay": 1}}}}
    record = run(system(parts))
    np.testing.assert_array_equal(record["line.y"][1:], 2.0 * record["wave.value"][:-1])
    assert record.held == ("wave.value -> line.u",) and record.names == ["wave.value", "line.y"]


def test_a_delay_breaks_an_algebraic_loop() -> None:
    parts = ring((0.5, 1.0), (1.0, 0.0))
    assert "algebraic loop: p0.y -> p1.u, p1.y -> p0.u; let it be solved by `coupling: {solve: newton}`" in problems(
        parts
    )
    parts["p0"]["wires"]["u"] = {"from": "p1.y", "delay": 1}
    record = run(system(parts))
    np.testing.assert_allclose(record["p0.y"][1:], 0.5 * record["p1.y"][:-1] + 1.0, rtol=1e-15)


# Algebraic loops


@pytest.mark.parametrize("solve", ["fixed-point", "newton"])
@pytest.mark.parametrize("gains", [[(0.5, 1.0), (0.9, -2.0)], [(-0.4, 1.0), (0.8, 0.1), (1.1, 3.0)], [(0.3, 2.0)]])
def test_a_linear_loop_is_solved_at_the_start_and_at_every_step(solve: str, gains: list[tuple[float, float]]) -> None:
    parts = ring(*gains)
    parts["p0"]["with"]["drift"] = "3 1/s"
    record = run(system(parts, coupling={"solve": solve, "iterations": 200}))
    assert record.outcome == "ok", record.message
    # y = a y + b + a_rest * 3 t around the loop, exact for the last part of it.
    gain, offset = 1.0, np.zeros(len(record.time))
    for index, (a, b) in enumerate(gains):
        gain, offset = gain * a, a * offset + b + (3.0 * record.time if index == 0 else 0.0)
    exact = offset / (1.0 - gain)
    # Tolerance 1e-9 of the residual, which 1 / (1 - gain) of the loop enlarges in the solution.
    np.testing.assert_allclose(record[f"p{len(gains) - 1}.y"], exact, rtol=2e-9 / abs(1.0 - gain), atol=1e-8)


def test_newton_solves_a_loop_that_the_fixed_point_iteration_leaves() -> None:
    parts = ring((-3.0, 4.0), (1.0, 0.0))
    record = run(system(parts, coupling={"solve": "newton"}))
    np.testing.assert_allclose(record["p0.y"], 1.0, rtol=1e-8)
    fixed = run(system(parts, coupling={"solve": "fixed-point"}))
    assert fixed.outcome == "error" and "p1.y -> p0.u" in fixed.message and "by fixed-point" in fixed.message
    relaxed = run(system(parts, coupling={"solve": "fixed-point", "relaxation": 0.3}))
    np.testing.assert_allclose(relaxed["p0.y"], 1.0, rtol=1e-8)


@pytest.mark.parametrize("solve", ["fixed-point", "newton"])
def test_a_nonlinear_loop_finds_the_known_fixed_point_of_the_cosine(solve: str) -> None:
    parts = {"cosine": {"use": "coupled_parts:COSINE", "wires": {"u": "line.y"}}, **ring((1.0, 0.0))}
    parts = {"cosine": parts["cosine"], "line": {**parts["p0"], "wires": {"u": "cosine.y"}}}
    record = run(system(parts, coupling={"solve": solve, "iterations": 200}))
    np.testing.assert_allclose(record["cosine.y"], 0.7390851332151607, rtol=3e-9)


def test_newtons_method_takes_the_derivatives_that_the_fmus_give() -> None:
    parts = {"cosine": {"use": "coupled_parts:COSINE", "wires": {"u": "line.y"}}}
    parts["line"] = {"use": "coupled_parts:LINE", "with": {"gain": 0.9}, "wires": {"u": "cosine.y"}}
    by_derivatives = run(system(parts, coupling={"solve": "newton"}))
    (entry,) = [one for one in by_derivatives.log if one["category"] == "coupling"]
    assert "by directional derivatives" in entry["text"] and entry["part"] == "cosine, line"


@pytest.mark.parametrize("solve", ["fixed-point", "newton"])
def test_a_loop_without_a_fixed_point_is_refused_with_its_cycle(solve: str) -> None:
    record = run(system(ring((1.0, 1.0), (1.0, 0.0)), coupling={"solve": solve}))
    assert record.outcome == "error" and record.failed_at == 0.0
    assert (
        "algebraic loop not solved: p0.y -> p1.u, p1.y -> p0.u; " in record.message
        and "is there a solution?" in record.message
    )


def test_a_loop_that_loses_its_solution_ends_there_and_keeps_the_rows_before() -> None:
    parts = ring((1.0, 0.0), (0.0, 0.0))
    parts["p1"] = {"use": "coupled_parts:SQUARE", "wires": {"u": "p0.y"}}
    parts["p0"]["with"] = {"gain": 1.0, "offset": 0.0, "drift": "1 1/s"}
    parts["p0"]["wires"]["u"] = "p1.y"
    record = run(system(parts, coupling={"solve": "newton"}))
    # y = y^2 + t has a solution as long as t <= 1/4.
    assert record.outcome == "error" and 0.24 < record.failed_at <= 0.27 and "p1.y -> p0.u" in record.message
    # A residual of 1e-9 is one of 1e-8 in the solution where the two roots are a tenth apart, and more where they meet.
    rows = record.time < 0.2475
    np.testing.assert_allclose(record["p0.y"][rows], 0.5 - np.sqrt(0.25 - record.time[rows]), atol=1e-8)


def test_a_loop_with_states_agrees_with_its_elimination() -> None:
    """x' = (u - x)/T, y = x + d u, u = -y: the loop closed by hand is u = -x / (1 + d)."""
    parts = {
        "filter": {"use": "coupled_parts:FILTER", "with": {"x": 1.0}, "wires": {"u": "back.y"}},
        "back": {"use": "coupled_parts:LINE", "with": {"gain": -1.0}, "wires": {"u": "filter.y"}},
    }
    errors = []
    for step in (2e-3, 1e-3):
        record = run(system(parts, step, 0.3, coupling={"solve": "newton"}))
        exact = np.exp(-(1.0 + 1.0 / 1.5) / 0.1 * record.time)
        errors.append(np.max(np.abs(record["filter.x"] - exact)))
        np.testing.assert_allclose(record["back.y"], -record["filter.y"], rtol=1e-8, atol=1e-9)
    assert 1.8 < errors[0] / errors[1] < 2.2, "held inputs are of order one"


def test_only_parts_that_can_be_taken_back_are_solved_for() -> None:
    parts = {
        "adder": {"use": "coupled_parts:forgetful", "wires": {"u": "line.y"}},
        "line": {"use": "coupled_parts:LINE", "with": {"gain": 0.5}, "wires": {"u": "adder.y"}},
    }
    said = problems(parts, coupling={"solve": "newton"})
    assert "adder is one of parts that feed each other and wants to be taken back" in said
    assert "Adder has no methods keep and restore" in said


def test_parts_of_a_loop_step_at_the_same_instants() -> None:
    parts = ring((0.5, 1.0), (0.9, 0.0))
    parts["p1"]["every"] = "20 ms"
    assert "p1.every wants to be that of p0" in problems(parts, coupling={"solve": "newton"})


# Smaller steps


def test_plants_take_smaller_steps_until_their_error_is_below_what_is_asked() -> None:
    fixed = run(system(OSCILLATOR, 0.1, 5.0))
    exact = np.array([_oscillation(t) for t in fixed.time])
    errors = {}
    for error in (1e-3, 1e-4):
        record = run(system(OSCILLATOR, 0.1, 5.0, coupling={"error": error}))
        errors[error] = float(np.max(np.abs(record["mass.x"] - exact)))
        (entry,) = [one for one in record.log if one["category"] == "coupling"]
        assert "rejected" in entry["text"] and entry["part"] == "mass, spring"
    alone = float(np.max(np.abs(fixed["mass.x"] - exact)))
    # A step's error is of order h^2, so a tenth of it leaves the root of a tenth of the global error.
    assert errors[1e-3] < 0.5 * alone and errors[1e-4] < 0.5 * errors[1e-3]


@pytest.mark.parametrize("method", ["gauss-seidel", "jacobi"])
def test_smaller_steps_leave_sensors_and_rows_on_the_clock(method: str) -> None:
    parts = {**OSCILLATOR, "seen": {"use": "sensor", "of": "mass.x", "noise": {"std": "0.01 m"}}}
    record = run(system(parts, 0.1, 2.0, coupling={"error": 1e-4, "method": method}))
    plain = run(system(parts, 0.1, 2.0, coupling={"method": method}))
    noise = [one["seen.value"] - one["mass.x"] for one in (record, plain)]
    np.testing.assert_allclose(noise[0], noise[1], atol=1e-15)
    assert np.array_equal(record.time, plain.time)


# Exact steering


def test_a_clock_that_steers_exactly_meets_the_plants_angle_at_every_row() -> None:
    parts = {
        "torque": {
            "use": "source",
            "unit": "N.m",
            "sine": {"amplitude": "60 N.m", "frequency": "9 Hz", "mean": "30 N.m"},
        },
        "engine": {"use": "crank_parts:LOADED", "wires": {"torque": "torque"}},
        "crank": {"use": "crank"},
        "seen": {"use": "sensor", "of": "engine.omega", "noise": {"std": "1 rad/s"}},
    }
    crank = {"step": "6 deg", "stop": "50 rev", "speed": "engine.omega", "angle": "engine.theta", "steer": "exact"}
    record = run(wire(Scenario.model_validate({"clock": {"crank": crank}, "parts": parts})))
    assert record.outcome == "ok", record.message
    # A ten billionth of a radian is what steering asks for, and some bits of the angle.
    assert np.max(np.abs(record["engine.theta"] - np.radians(6.0) * np.arange(3001))) < 2e-10
    assert np.max(np.abs(record["crank.residual"])) < 2e-10
    next_ = {**crank, "steer": "next"}
    missed = run(wire(Scenario.model_validate({"clock": {"crank": next_}, "parts": parts})))["crank.residual"]
    assert np.max(np.abs(missed)) > 1e-5


def test_exact_steering_wants_parts_that_can_be_taken_back() -> None:
    parts = {
        "engine": {"use": "crank_parts:ENGINE"},
        "adder": {"use": "coupled_parts:forgetful", "wires": {"u": "engine.ratio"}},
        "second": {"use": "crank_parts:DRIVEN", "wires": {"pull": "adder.y"}},
    }
    crank = {"step": "6 deg", "stop": "5 rev", "speed": "second.omega", "angle": "second.theta", "steer": "exact"}
    with pytest.raises(ConfigurationError, match="exact wants adder, which is stepped before the angle is known"):
        wire(Scenario.model_validate({"clock": {"crank": crank}, "parts": parts}))


# The oracle


@st.composite
def _coupled_systems(draw: st.DrawFn) -> System:
    """Up to five FMUs, Python parts and sensors, wired at random, coupled and solved in any way, on both clocks."""
    count = draw(st.integers(2, 5))
    kinds = [draw(st.sampled_from(["line", "filter", "python", "sensor"])) for _ in range(count)]
    kinds[0] = "line"
    names = [f"p{i}" for i in range(count)]
    signal = {"line": "y", "filter": "y", "python": "y0", "sensor": "value"}
    anything = [f"{name}.{signal[kind]}" for name, kind in zip(names, kinds, strict=True)]
    level = st.floats(-0.9, 0.9)
    parts: dict[str, Any] = {"engine": {"use": "crank_parts:ENGINE", "with": {"rate": f"{draw(level) * 200} rad/s2"}}}
    for i, (name, kind) in enumerate(zip(names, kinds, strict=True)):
        source = draw(st.sampled_from([*anything, "engine.ratio"]))
        wires = {"u": {"from": source, "delay": draw(st.sampled_from([0, 0, 1]))}}
        if kind == "line":
            parts[name] = {
                "use": "coupled_parts:LINE",
                "with": {"gain": draw(level), "offset": draw(level)},
                "wires": wires,
            }
        elif kind == "filter":
            parts[name] = {"use": "coupled_parts:FILTER", "with": {"direct": draw(level)}, "wires": wires}
        elif kind == "python":
            chosen = {"inputs": 1, "seed": i, "direct": draw(st.sampled_from([0.0, 1.0])), "language": "python"}
            parts[name] = {"use": "loop_parts:linear", "with": {**chosen, "role": "plant"}, "wires": {"u0": wires["u"]}}
        else:
            measured = draw(st.sampled_from([one for one in anything if not one.endswith(".value")] + ["engine.ratio"]))
            parts[name] = {"use": "sensor", "of": measured, "noise": {"std": 0.1}}
    coupling = {
        "method": draw(st.sampled_from(["gauss-seidel", "jacobi"])),
        "solve": draw(st.sampled_from(["fixed-point", "newton"])),
        "error": draw(st.sampled_from([None, 1e-3])),
        "relaxation": draw(st.sampled_from([1.0, 0.7])),
        "iterations": 100,
    }
    clock: dict[str, Any] = {"time": {"step": "1 ms", "stop": "20 ms"}}
    if draw(st.booleans()):
        clock = {"crank": {"step": "6 deg", "stop": "1 rev", "speed": "engine.omega"}}
        if draw(st.booleans()):
            clock["crank"] |= {"angle": "engine.theta", "steer": draw(st.sampled_from(["next", "exact"]))}
    described = {"clock": clock, "parts": parts, "coupling": coupling, "record": {"every": draw(st.integers(1, 3))}}
    try:
        return wire(Scenario.model_validate(described))
    except ConfigurationError as error:
        assert "algebraic loop" in str(error) or "exact wants" in str(error), error
        assume(False)
        raise


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.too_slow, HealthCheck.filter_too_much])
@given(wired=_coupled_systems())
def test_coupled_systems_match_the_plain_python_oracle_bit_for_bit(wired: System) -> None:
    record: Record = run(wired)
    assume(record.outcome == "ok")
    plain = run_plainly(wired)
    ours = np.column_stack([record.time, record.values])
    assert ours.shape == plain.shape
    different = np.argwhere(ours != plain)
    assert not len(different), (["time", *record.names][different[0][1]], different[0], wired.order, wired.groups)
