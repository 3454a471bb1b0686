"""Model Exchange FMUs follow their equations, have events where they happen, and a name for what goes wrong."""

from __future__ import annotations

import ctypes
import math
from pathlib import Path

import numpy as np
import pytest
from exchange_fmu import exchange_fmu
from scipy.integrate import solve_ivp
from third_party import reference_fmu

from fmus.component import DISCARD, ERROR, ConfigurationError, StepError, Vector
from fmus.description import describe
from fmus.exchange import Stepping, read_stepping
from fmus.export import cached_fmu
from fmus.fmu import FmuComponent, load_fmu
from fmus.plants.driveline import MODEL as DRIVELINE

TIGHT = Stepping(tolerance=1e-9)


def trajectory(
    component: FmuComponent, h: float, n: int, u: Vector | None = None, t0: float = 0.0
) -> dict[str, Vector]:
    """Outputs at t0 + k h, k = 0..n, by name; u holds the inputs of the steps, shape (n, n_inputs)."""
    inputs = np.zeros((n, len(component.inputs))) if u is None else u
    rows = [component.start(t0, inputs[0])]
    rows += [component.step(t0 + k * h, h, inputs[k]) for k in range(n)]
    return dict(zip((signal.name for signal in component.outputs), np.array(rows).T, strict=True))


@pytest.mark.parametrize("method", ["bdf", "adams"])
@pytest.mark.parametrize("fmi", [2, 3])
def test_dahlquists_equation_decays_as_its_exponential(fmi: int, method: str):
    component = load_fmu(reference_fmu("Dahlquist", fmi), kind="me", stepping=Stepping(method, 1e-9))
    x = trajectory(component, 0.1, 50)["x"]
    component.close()
    # Local errors of 1e-9 of a state of size 1 (its nominal value) add up over some 300 steps of the solver.
    assert np.abs(x - np.exp(-0.1 * np.arange(51))).max() < 1e-7


def test_a_larger_tolerance_gives_a_larger_error_and_fewer_steps():
    errors, steps = [], []
    for tolerance in (1e-4, 1e-9):
        component = load_fmu(reference_fmu("Dahlquist"), kind="me", stepping=Stepping(tolerance=tolerance))
        x = trajectory(component, 1.0, 5)["x"]
        errors.append(np.abs(x - np.exp(-np.arange(6.0))).max())
        steps.append(component.slave.exchange.steps)
        component.close()
    assert errors[0] > 100 * errors[1] and steps[0] < steps[1] / 2


def test_the_step_of_the_solver_can_be_bounded():
    component = load_fmu(reference_fmu("Dahlquist"), kind="me", stepping=Stepping(step=0.01))
    trajectory(component, 1.0, 2)
    assert component.slave.exchange.steps >= 200
    component.close()


@pytest.mark.parametrize("fmi", [2, 3])
def test_the_van_der_pol_oscillator_agrees_with_another_solver(fmi: int):
    component = load_fmu(reference_fmu("VanDerPol", fmi), starts={"mu": 5.0}, kind="me", stepping=TIGHT)
    x = trajectory(component, 0.05, 400)
    component.close()

    def rates(t: float, x: Vector) -> list[float]:
        return [x[1], 5.0 * (1 - x[0] ** 2) * x[1] - x[0]]

    truth = solve_ivp(rates, (0, 20), [2, 0], method="DOP853", rtol=1e-12, atol=1e-12, t_eval=0.05 * np.arange(401)).y
    # The stiff jumps stretch the local errors of 1e-9 by their slope of about 20, over three periods.
    assert np.abs(x["x0"] - truth[0]).max() < 1e-5


@pytest.mark.parametrize("fmi", [2, 3])
def test_the_bouncing_ball_bounces_when_mechanics_says(fmi: int):
    component = load_fmu(reference_fmu("BouncingBall", fmi), starts={"h": 1.0, "e": 0.7}, kind="me", stepping=TIGHT)
    heights = trajectory(component, 0.01, 200)["h"]
    component.close()
    g = 9.81
    fall = math.sqrt(2 / g)
    bounces = [fall]
    speed = g * fall
    while len(bounces) < 6:
        speed *= 0.7
        bounces.append(bounces[-1] + 2 * speed / g)
    t = 0.01 * np.arange(201)
    truth = 1.0 - g * t**2 / 2
    for k, begin in enumerate(bounces[:-1]):
        up = g * fall * 0.7 ** (k + 1)
        inside = (t >= begin) & (t < bounces[k + 1])
        truth[inside] = up * (t - begin)[inside] - g * (t - begin)[inside] ** 2 / 2
    known = t < bounces[-1]
    # Bounces are located within the tolerance; each passes its error on in time, at up to 4.4 m/s.
    assert np.abs(heights - truth)[known].max() < 1e-6


@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.parametrize("h", [1.0, 0.25, 0.3])
def test_events_of_time_happen_at_their_time_whatever_the_step(fmi: int, h: float):
    component = load_fmu(reference_fmu("Stair", fmi), kind="me", name="stair")
    n = math.floor(8.5 / h)
    counter = trajectory(component, h, n)["counter"]
    assert np.array_equal(counter, 1 + np.floor(h * np.arange(n + 1) + 1e-9))
    with pytest.raises(StepError, match=r"asked to end at t = 9 s") as raised:
        component.step(n * h, 1.0, np.empty(0))
    assert (raised.value.status, raised.value.part) == (DISCARD, "stair")
    component.close()


@pytest.mark.parametrize("fmi", [2, 3])
def test_our_own_exports_run_alike_by_both_kinds(fmi: int):
    torque = np.repeat(np.array([0.0, 50.0, -30.0, 80.0, 0.0]), 20)[:, None]
    path = cached_fmu(DRIVELINE, fmi)
    slave = load_fmu(path, starts={"solver.tolerance": 1e-10})
    model = load_fmu(path, kind="me", stepping=TIGHT)
    one, other = trajectory(slave, 0.01, 100, torque), trajectory(model, 0.01, 100, torque)
    slave.close()
    model.close()
    assert one.keys() == other.keys()
    for name in ("theta_e", "omega_c", "omega_p"):
        # The fixed Runge-Kutta steps of the slave and the events inside them: 1e-5 of the signal's size.
        assert np.abs(one[name] - other[name]).max() < 1e-5 * max(np.abs(other[name]).max(), 1e-3), name


@pytest.mark.parametrize("fmi", [1, 2])
def test_inputs_are_held_over_a_step_and_states_events_and_time_events_counted(tmp_path: Path, fmi: int):
    u = np.arange(200.0)[:, None] % 7
    component = load_fmu(exchange_fmu(tmp_path, fmi))
    y = trajectory(component, 0.01, 200, u)
    component.close()
    # x' = u with u held: a sum; some ten steps of the solver in each, every one exact but for rounding.
    assert np.allclose(y["x"], np.concatenate([[0.0], np.cumsum(u[:, 0] * 0.01)]), atol=1e-12)
    t = 0.01 * np.arange(201)
    # r swings at a slope of 2 between -1 and 1: from 0.5 down; located to the rounding of the root finder.
    phase = (2 * t + 0.5) % 4
    assert np.abs(y["r"] - np.where(phase < 2, 1 - phase, phase - 3)).max() < 1e-9
    assert np.array_equal(y["ticks"], np.floor(t / 0.25 + 1e-9))
    assert y["switches"][-1] == 2
    clear = np.abs(phase - 2) % 2 > 1e-9  # at the very instant of a switch rounding decides
    assert np.array_equal(y["up"][clear], (phase >= 2)[clear].astype(float))


def test_a_model_is_called_in_the_order_of_the_standard(tmp_path: Path):
    component = load_fmu(exchange_fmu(tmp_path, 2))
    calls = (ctypes.c_char * 65536).in_dll(ctypes.CDLL(str(component.description.library)), "calls")
    ctypes.memset(calls, 0, 65536)
    component.start(0.0, np.array([1.0]))
    component.step(0.0, 0.1, np.array([1.0]))
    assert calls.value == b"Ix[s]Ec"  # the input did not change: no event
    component.step(0.1, 0.1, np.array([2.0]))
    component.step(0.2, 0.1, np.array([2.0]))
    assert calls.value == b"Ix[s]Ec" + b"esEc" + b"eEc"  # the input jumps; the event of time at 0.25
    component.close()
    assert calls.value == b"Ix[s]EcesEceEc" + b"TF"


@pytest.mark.parametrize("fmi", [1, 2])
@pytest.mark.parametrize(
    ("mode", "status", "message"),
    [
        (1, ERROR, r"chattering: 1000 events in a row"),
        (2, ERROR, r"event iteration does not settle"),
        (3, ERROR, r"the derivative of state 1 is not finite near t = 0\.6"),
        (4, ERROR, r"lost at 0\.6"),
        (5, DISCARD, r"discards its derivatives near t = 0\.6"),
        (6, DISCARD, r"asked to end at t = 0\.5 s"),
    ],
)
def test_what_goes_wrong_has_a_name_and_a_time(tmp_path: Path, fmi: int, mode: int, status: int, message: str):
    component = load_fmu(exchange_fmu(tmp_path, fmi), starts={"mode": mode}, name="plant")
    with pytest.raises(StepError, match=message) as raised:
        trajectory(component, 0.01, 100)
    assert (raised.value.status, raised.value.part) == (status, "plant")
    component.close()


def test_a_step_event_is_handled_and_a_step_may_ask_to_end(tmp_path: Path):
    component = load_fmu(exchange_fmu(tmp_path, 2), starts={"mode": 8})
    assert trajectory(component, 0.1, 5)["step_events"][-1] == 3
    component.close()
    component = load_fmu(exchange_fmu(tmp_path, 2), starts={"mode": 7})
    with pytest.raises(StepError, match=r"asked to end at t = 0\.3"):
        trajectory(component, 0.1, 5)
    component.close()


def test_a_start_forgets_all_that_went_before(tmp_path: Path):
    component = load_fmu(exchange_fmu(tmp_path, 2))
    u = np.arange(50.0)[:, None]
    first = trajectory(component, 0.01, 50, u)
    again = trajectory(component, 0.01, 50, u)
    component.close()
    assert all(np.array_equal(first[name], again[name]) for name in first)


def test_a_reset_instance_runs_as_a_fresh_one(tmp_path: Path):
    component = load_fmu(exchange_fmu(tmp_path, 2))
    u = np.arange(30.0)[:, None]
    first = trajectory(component, 0.01, 30, u)
    rows = [component.restart(0.0, u[0]), *(component.step(k * 0.01, 0.01, u[k]) for k in range(30))]
    component.close()
    assert np.array_equal(np.array(rows), np.array(list(first.values())).T)


def test_what_is_model_exchange_alone_is_run_without_being_asked(tmp_path: Path):
    description = describe(exchange_fmu(tmp_path, 2))
    assert (description.kinds, description.kind, description.runnable) == (("me",), "me", True)
    with pytest.raises(ConfigurationError, match="it offers me, not cs"):
        load_fmu(exchange_fmu(tmp_path, 2), kind="cs")
    assert describe(reference_fmu("Dahlquist")).kind == "cs"


def test_unknown_or_impossible_settings_of_the_solver_are_all_told():
    assert read_stepping({"method": "adams", "tolerance": 1e-3}) == Stepping("adams", 1e-3)
    with pytest.raises(ConfigurationError) as raised:
        read_stepping({"metod": "bdf", "method": "euler", "tolerance": 2.0, "step": -1.0})
    told = [str(problem) for problem in raised.value.problems]
    assert len(told) == 4
    assert "did you mean 'solver.method'?" in told[0]
    assert told[1] == "solver.method wants one of adams, bdf, got 'euler'"
