"""Gramian and Kalman measures against closed forms, scipy and python-control, and what is said where there are none."""

from __future__ import annotations

import itertools
import math

import control
import numpy as np
import pytest
import scipy.linalg
from hypothesis import given, settings
from hypothesis import strategies as st

from observers.modes import growing_modes, unseen_modes
from selection.measures import (
    Noise,
    Plant,
    augmented,
    gramian_factor,
    gramian_factors,
    information,
    kalman_error,
    plant,
    sampled,
)


def stable(rng: np.random.Generator, n: int) -> np.ndarray:
    """A random matrix whose modes all die out at half a unit or faster."""
    A = rng.normal(size=(n, n))
    return A - (np.linalg.eigvals(A).real.max() + 0.5) * np.eye(n)


def plant_of(A, sensors, time_constants=None, period=0.01, process=0.1) -> Plant:
    s = len(sensors)
    taus = np.zeros(s) if time_constants is None else np.array(time_constants, dtype=float)
    return plant(np.array(A), np.array(sensors), taus, np.ones(len(A)), Noise(np.ones(s), period, process))


@settings(deadline=None, max_examples=60)
@given(st.integers(0, 2**32 - 1), st.integers(1, 8), st.integers(1, 3))
def test_the_factor_squared_is_scipys_gramian(seed, n, s):
    rng = np.random.default_rng(seed)
    A, C = stable(rng, n), rng.normal(size=(s, n))
    R = gramian_factor(A, C)
    W = scipy.linalg.solve_continuous_lyapunov(A.T, -C.T @ C)
    # scipy loses digits with the separation of A's modes, which here is at least 1.
    assert np.abs(R.T @ R - W).max() <= 1e-9 * np.abs(W).max()
    assert np.abs(np.tril(R, -1)).max(initial=0.0) == 0.0


def test_a_decaying_state_has_the_gramian_of_its_integral():
    # The integral of exp(-2 a t)/(sigma^2 h): information 1/(2 a sigma^2 h).
    a, sigma, period = 3.0, 0.2, 0.05
    one = plant(np.array([[-a]]), np.array([[1.0]]), np.zeros(1), np.ones(1), Noise(np.array([sigma]), period, 0.0))
    wanted = 1.0 / (2.0 * a * sigma**2 * period)
    least, log_det, trace_inverse, why = information(gramian_factors(one), [0])
    assert (least, log_det, trace_inverse) == pytest.approx((wanted, math.log(wanted), 1.0 / wanted), rel=1e-12)
    assert why == ""


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 2**32 - 1))
def test_information_on_some_states_is_the_schur_complement_with_the_others_and_the_sensors_states_unknown(seed):
    rng = np.random.default_rng(seed)
    n, wanted = 4, [0, 2]
    A, C = stable(rng, n), rng.normal(size=(3, n))
    made = plant_of(A, C, [0.0, 0.7, 2.0])
    factors = gramian_factors(made)
    for members in ((0, 1), (0, 1, 2)):
        full_A, full_C = augmented(made, members)
        W = scipy.linalg.solve_continuous_lyapunov(full_A.T, -full_C.T @ full_C / made.noise.period)
        inverse = np.linalg.inv(W)[np.ix_(wanted, wanted)]
        found = information(factors[list(members)], wanted)
        condition = np.linalg.cond(W)
        if condition < 1e10:
            # The inverse of the full Gramian loses as many digits as its condition has.
            tolerance = 1e-13 * condition + 1e-9
            assert found.trace_inverse == pytest.approx(np.trace(inverse), rel=tolerance)
            assert found.log_det == pytest.approx(-np.linalg.slogdet(inverse)[1], rel=tolerance, abs=tolerance)
            assert found.least == pytest.approx(1.0 / np.linalg.eigvalsh(inverse).max(), rel=tolerance)


def test_small_information_is_resolved_far_below_the_rounding_of_the_gramian():
    # A cascade x_1' = -x_1 + e x_2, x_2' = -2 x_2, seen at x_1: with x_1 unknown too, the information on x_2 is the
    # part of e (exp(-t) - exp(-2t)) orthogonal to exp(-t): e^2 (1/12 - (1/6)^2/(1/2)) = e^2/36.
    e = 1e-7
    found = information(gramian_factors(plant_of([[-1.0, e], [0.0, -2.0]], [[1.0, 0.0]], period=1.0)), [1])
    assert found.least == pytest.approx(e * e / 36.0, rel=1e-6)


def test_what_a_set_does_not_see_has_no_information_and_says_so():
    made = plant_of([[-1.0, 0.0], [0.0, -2.0]], [[1.0, 0.0]])
    found = information(gramian_factors(made), [1])
    assert found[:3] == (None, None, None) and "information on a state is zero" in found.why
    assert information(gramian_factors(made), [0]).least is not None


@pytest.mark.parametrize(("A", "rate"), [([[0.3]], "0.3"), ([[0.0]], "0"), ([[-1.0, 0.0], [5.0, 0.0]], "0")])
def test_a_mode_that_does_not_die_out_is_named_not_used(A, rate):
    with pytest.raises(ValueError, match=f"no Gramian over all time: a mode of {rate}/s does not die out"):
        gramian_factors(plant_of(A, [[1.0] * len(A)]))


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 2**32 - 1), st.integers(1, 5), st.integers(1, 3))
def test_the_kalman_error_is_that_of_python_control(seed, n, s):
    rng = np.random.default_rng(seed)
    A, C = rng.normal(size=(n, n)), rng.normal(size=(s, n))
    made = plant_of(A, C)
    found = kalman_error(made, range(s), range(n))
    F, Q = sampled(A, made.noise.process**2 * np.eye(n), made.noise.period)
    try:
        _, before, _ = control.dlqe(F, np.eye(n), C, Q, np.eye(s))
    except (control.ControlArgument, np.linalg.LinAlgError, ValueError):
        return
    after = before - before @ C.T @ np.linalg.solve(C @ before @ C.T + np.eye(s), C @ before)
    assert found.deviations == pytest.approx(np.sqrt(np.diag(after)), rel=1e-5)


def test_each_state_may_have_a_process_noise_of_its_own():
    A, C = np.array([[-1.0, 0.5], [0.0, -3.0]]), np.array([[1.0, 0.0]])
    alike = kalman_error(plant_of(A, C, process=np.array([0.1, 0.1])), [0], [0, 1])
    np.testing.assert_array_equal(alike.deviations, kalman_error(plant_of(A, C), [0], [0, 1]).deviations)
    apart = kalman_error(plant_of(A, C, process=np.array([0.1, 0.4])), [0], [0, 1])
    F, Q = sampled(A, np.diag([0.01, 0.16]), 0.01)
    before = scipy.linalg.solve_discrete_are(F.T, C.T, Q, np.eye(1))
    after = before - before @ C.T @ np.linalg.solve(C @ before @ C.T + np.eye(1), C @ before)
    assert apart.deviations == pytest.approx(np.sqrt(np.diag(after)), rel=1e-9)


def test_a_state_that_nothing_disturbs_is_known_in_the_end():
    # As the lag of an actuator, which follows its command and dies out.
    A, C = np.array([[-1.0, 0.5], [0.0, -20.0]]), np.array([[1.0, 0.0]])
    found = kalman_error(plant_of(A, C, process=np.array([0.1, 0.0])), [0], [0, 1])
    assert found.why == "" and found.deviations[0] > 0.0 and found.deviations[1] < 1e-9


@settings(deadline=None, max_examples=25)
@given(st.integers(0, 2**32 - 1))
def test_the_steady_error_is_where_the_filters_recursion_ends(seed):
    rng = np.random.default_rng(seed)
    A, C = stable(rng, 3), rng.normal(size=(2, 3))
    made = plant_of(A, C, [0.0, 0.3], period=0.1)
    F_A, F_C = augmented(made, [0, 1])
    intensity = np.diag([*[made.noise.process**2] * 3, 0.0])
    F, Q = sampled(F_A, intensity, made.noise.period)
    P = np.eye(4)
    for _ in range(4000):
        P = F @ P @ F.T + Q
        K = np.linalg.solve(F_C @ P @ F_C.T + np.eye(2), F_C @ P).T
        P = (np.eye(4) - K @ F_C) @ P
    found = kalman_error(made, [0, 1], [0, 1, 2])
    assert found.deviations == pytest.approx(np.sqrt(np.diag(P))[:3], rel=1e-6)
    assert found.rms == pytest.approx(math.sqrt(np.mean(np.diag(P)[:3])), rel=1e-6)


def test_a_wandering_state_has_the_error_of_the_scalar_riccati_equation():
    # x wanders with intensity q, a sample each h with noise r: P- = P+ + q h, 1/P+ = 1/P- + 1/r.
    q, h = 0.1**2, 0.01
    step = q * h
    wanted = (-step + math.sqrt(step**2 + 4.0 * step)) / 2.0
    (found,) = kalman_error(plant_of([[0.0]], [[1.0]]), [0], [0]).deviations
    assert found == pytest.approx(math.sqrt(wanted), rel=1e-9)


def test_a_mode_that_grows_unseen_is_named_and_one_that_is_seen_is_no_matter():
    made = plant_of([[0.2, 0.0], [0.0, -1.0]], [[0.0, 1.0], [1.0, 0.0]])
    unseen = kalman_error(made, [0], [1])
    assert unseen.deviations is None and unseen.rms is None
    assert unseen.why == "undetectable: a mode of 0.2/s is not seen and does not die out"
    assert kalman_error(made, [0, 1], [1]).rms is not None
    assert [mode.real for mode in growing_modes(made.A)] == pytest.approx([0.2])
    assert unseen_modes(made.A, made.sensors[[1]]) == []


def test_more_sensors_never_hold_less_information_nor_leave_a_larger_error():
    rng = np.random.default_rng(11)
    made = plant_of(stable(rng, 5), rng.normal(size=(4, 5)), [0.0, 0.5, 0.0, 2.0])
    factors = gramian_factors(made)
    sets = [c for k in range(1, 5) for c in itertools.combinations(range(4), k)]
    for fewer, more in itertools.product(sets, sets):
        if set(fewer) < set(more):
            one, other = (information(factors[list(members)], [1, 3]) for members in (fewer, more))
            if one.least is not None:
                assert other.least >= one.least * (1 - 1e-9) and other.log_det >= one.log_det - 1e-9
            assert kalman_error(made, more, [1, 3]).rms <= kalman_error(made, fewer, [1, 3]).rms * (1 + 1e-9)


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 2**32 - 1), st.floats(1.0, 5.0))
def test_sampling_a_stiff_system_gives_the_covariance_of_its_integral(seed, decades):
    rng = np.random.default_rng(seed)
    n, period = 3, 0.1
    A = np.diag(-np.logspace(0, decades, n)) + 0.1 * rng.normal(size=(n, n))
    intensity = np.diag(rng.uniform(0.1, 1.0, n))
    F, Q = sampled(A, intensity, period)
    assert pytest.approx(scipy.linalg.expm(A * period), rel=1e-10, abs=1e-12) == F
    # Q = P - F P F' with the covariance P that the noise would end in.
    P = scipy.linalg.solve_continuous_lyapunov(A, -intensity)
    assert np.abs(Q - (P - F @ P @ F.T)).max() <= 1e-10 * np.abs(P).max()


def test_units_of_states_and_sensors_make_no_difference():
    rng = np.random.default_rng(2)
    A, C = stable(rng, 4), rng.normal(size=(3, 4))
    sizes, deviations = np.array([1e5, 300.0, 0.02, 5.0]), np.array([1e3, 2.0, 1e-4])
    taus = np.array([0.0, 3.0, 0.0])
    ones = plant(A, C, taus, np.ones(4), Noise(np.ones(3), 0.01, 0.1))
    scaled = plant(
        A * sizes[:, None] / sizes, C * deviations[:, None] / sizes, taus, sizes, Noise(deviations, 0.01, 0.1)
    )
    first, second = (information(gramian_factors(p), [0, 1]) for p in (ones, scaled))
    assert first[:3] == pytest.approx(second[:3], rel=1e-9)
    errors = [kalman_error(p, [0, 1, 2], [0, 1]).rms for p in (ones, scaled)]
    assert errors[0] == pytest.approx(errors[1], rel=1e-9)


@pytest.mark.parametrize("sizes", [[1.0, 0.0], [1.0, math.nan], [math.inf, 1.0]])
def test_a_scaling_that_is_singular_is_refused(sizes):
    with pytest.raises(ValueError, match="a size of a state is"):
        plant(np.eye(2), np.eye(2), np.zeros(2), np.array(sizes), Noise(np.ones(2), 0.01, 0.1))
    with pytest.raises(ValueError, match="a standard deviation of a sensor's noise is"):
        plant(np.eye(2), np.eye(2), np.zeros(2), np.ones(2), Noise(np.array(sizes), 0.01, 0.1))
