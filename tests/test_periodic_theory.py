"""Gains and multipliers of periodic-input observers against Eq. 5 itself, Riccati solvers and the paper's numbers."""

from __future__ import annotations

import itertools

import control
import numpy as np
import pytest
from periodic_runs import RPM, STEP, T180, T720, lag, rod, two_lags
from scipy.integrate import solve_ivp
from scipy.linalg import expm, solve_discrete_are, solve_discrete_lyapunov

from fmus.model import ModelError
from observers.periodic import (
    Gains,
    PeriodicSystem,
    error_matrix,
    full_measurement_gains,
    gains_of,
    input_row,
    internal_model,
    monodromy,
    multipliers,
    output_row,
    partial_measurement_gains,
    sampled_error,
    sampled_monodromy,
    sampled_multipliers,
    summed,
    transition,
    unseen_harmonics,
    variance_gain,
)
from observers.periodic_design import Demand, design, meet
from observers.periodic_response import check_resolved
from observers.periodic_schedule import Sampling, certify, refined, schedule
from observers.periodic_settings import per_radian

OMEGA = 1500.0 * RPM
SYSTEMS = {
    "lag": lag(0.025),
    "slow lag": lag(0.2),
    "two lags": two_lags(0.025, 0.02),
    "rod": rod(),
    "rod in angle": rod(5.0, per="rad"),
    "equal lags": two_lags(0.02, 0.02, harmonics=1),
}


def lag_gains(tau: float, omega: float, per: str, harmonics: int = 3) -> Gains:
    """The paper's, per radian."""
    one = lag(tau, harmonics)
    weights = [4.0 / (k * k + 1) for k in range(harmonics + 1)]
    L, L_k = full_measurement_gains(one.A, one.A0, one.C, np.array([[-4.0 / tau]]), weights)
    return Gains(L / omega, L_k * per_radian(per, omega, STEP) + 0j)


def rod_gains(system: PeriodicSystem, omega: float, sign: str, per: str = "rad") -> Gains:
    A, A0 = system.rates(omega)
    wr = np.sqrt(-system.A[1, 0])
    L = np.array([[0.3 * wr], [2.0 * wr**2]]) / (omega if system.per == "s" else 1.0)
    orders = [k * system.order for k in range(system.harmonics + 1)]
    L_k = partial_measurement_gains(A, A0, system.C, L, orders, 0.1, sign)
    return Gains(L, L_k * per_radian(per, omega, STEP))


def by_integration(system: PeriodicSystem, gains_at, speed) -> np.ndarray:
    """The monodromy matrix of Eq. 5 as it is printed, in x~ and c~_k, by scipy; real and imaginary parts apart."""
    n, m = system.A0.shape
    h, w0 = system.harmonics, system.order

    def rate(alpha: float, flat: np.ndarray) -> np.ndarray:
        A, A0 = system.rates(speed(alpha))
        gains = gains_at(speed(alpha))
        e, c = flat[:n], [flat[n : n + m] + 0j]
        for k in range(1, h + 1):
            begin = n + m * (2 * k - 1)
            c.append(flat[begin : begin + m] + 1j * flat[begin + m : begin + 2 * m])
        turn = [np.exp(1j * k * w0 * alpha) for k in range(h + 1)]
        driven = c[0].real + 2.0 * sum((c[k] * turn[k]).real for k in range(1, h + 1))
        y = system.C @ e
        moved = [-np.conj(turn[k]) * (gains.harmonics[k] @ y) for k in range(h + 1)]
        parts = [moved[0].real, *(part for one in moved[1:] for part in (one.real, one.imag))]
        return np.concatenate([A @ e - gains.state @ y + A0 @ driven, *parts])

    columns = [
        solve_ivp(rate, (0.0, system.period), unit, method="DOP853", rtol=1e-11, atol=1e-13).y[:, -1]
        for unit in np.eye(system.size)
    ]
    return np.array(columns).T


def largest_first(matrix: np.ndarray) -> np.ndarray:
    return np.sort(np.abs(np.linalg.eigvals(matrix)))[::-1]


@pytest.mark.parametrize("name", SYSTEMS)
def test_a_step_of_the_reference_model_is_its_matrix_exponential(name):
    system = SYSTEMS[name]
    for omega in (30.0, OMEGA, 600.0):
        wanted = expm(internal_model(system, omega) * STEP)
        np.testing.assert_allclose(
            transition(system, omega, STEP), wanted, rtol=1e-9, atol=1e-12 * np.abs(wanted).max()
        )


CONTINUOUS = {
    "lag, per s": (lag(0.025), lambda omega: lag_gains(0.025, omega, "s")),
    "lag, per sample": (lag(0.025), lambda omega: lag_gains(0.025, omega, "sample")),
    "lag, per rad": (lag(0.025), lambda omega: lag_gains(0.025, omega, "rad")),
    "rod, minus": (rod(), lambda omega: rod_gains(rod(), omega, "minus")),
    "rod, plus": (rod(), lambda omega: rod_gains(rod(), omega, "plus")),
    "rod in angle, plus": (rod(5.0, per="rad"), lambda omega: rod_gains(rod(5.0, per="rad"), omega, "plus", "sample")),
}


@pytest.mark.parametrize("name", CONTINUOUS)
def test_multipliers_are_those_of_the_time_varying_error_equation_integrated(name):
    system, gains_at = CONTINUOUS[name]
    wanted = largest_first(by_integration(system, gains_at, lambda alpha: OMEGA))
    found = np.abs(multipliers(system, gains_at(OMEGA), OMEGA))
    # The integrator's 1e-11 over a period.
    np.testing.assert_allclose(found, wanted, rtol=1e-7, atol=1e-9)
    # Over a whole period nothing is left of the turning.
    matrix = expm(error_matrix(system, gains_at(OMEGA), OMEGA) * system.period)
    np.testing.assert_allclose(largest_first(matrix), wanted, rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("name", ["lag, per s", "lag, per sample", "rod, plus", "rod in angle, plus"])
def test_over_a_speed_that_varies_and_repeats_the_monodromy_is_that_of_the_integrated_equation(name):
    system, gains_at = CONTINUOUS[name]

    def speed(alpha: float) -> float:
        return OMEGA * (1.0 + 0.2 * np.sin(system.order * alpha) + 0.1 * np.cos(2.0 * system.order * alpha))

    wanted = by_integration(system, gains_at, speed)
    coarse, fine = (monodromy(system, gains_at, speed, steps) for steps in (360, 720))
    size = np.abs(wanted).max()
    # Of order two in the step: half the step, a quarter of the error.
    assert np.abs(fine - wanted).max() < 1e-3 * size
    assert np.abs(fine - wanted).max() < 0.3 * np.abs(coarse - wanted).max() + 1e-10 * size
    np.testing.assert_allclose(largest_first(fine), largest_first(wanted), rtol=1e-3, atol=1e-5)


@pytest.mark.parametrize("name", ["lag", "rod", "two lags"])
def test_the_sampled_monodromy_at_a_constant_speed_has_the_sampled_multipliers(name):
    system = SYSTEMS[name]
    K = design(system, OMEGA, STEP, 0.4)
    wanted = np.abs(sampled_multipliers(system, K, OMEGA, STEP))
    found = largest_first(sampled_monodromy(system, lambda omega: K, lambda alpha: OMEGA, STEP))
    np.testing.assert_allclose(found, wanted, rtol=1e-6, atol=1e-9)


def test_for_small_steps_the_sampled_multipliers_are_those_of_the_continuous_observer():
    system, gains = rod(), rod_gains(rod(), OMEGA, "plus")
    wanted = abs(multipliers(system, gains, OMEGA)[0])
    away = []
    for step in (STEP / 10.0, STEP / 20.0):
        found = abs(sampled_multipliers(system, gains.times(step, step).stacked(), OMEGA, step)[0])
        away.append(abs(found - wanted))
    assert away[0] < 1e-2 and away[1] < 0.6 * away[0]  # of order one in the step


def test_the_published_lag_has_the_gains_that_the_paper_prints():
    tau = 0.025
    L, L_k = full_measurement_gains(
        np.array([[-1 / tau]]), np.array([[1 / tau]]), np.eye(1), np.array([[-4.0 / tau]]), [4, 2, 0.8, 0.4]
    )
    assert L.item() == pytest.approx(3.0 / tau, rel=1e-14)
    # alpha_k^2 (1/tau) (tau/8) = 0.5/(k^2 + 1), in whatever unit tau counts.
    np.testing.assert_allclose(L_k.ravel(), 0.5 / (np.arange(4) ** 2 + 1.0), rtol=1e-14)
    seconds, samples = lag_gains(tau, OMEGA, "s"), lag_gains(tau, OMEGA, "sample")
    np.testing.assert_allclose(samples.harmonics / seconds.harmonics, OMEGA / STEP, rtol=1e-12)
    np.testing.assert_allclose(samples.state, seconds.state, rtol=1e-12)


def test_the_lyapunov_equation_of_full_measurement_holds_for_two_states():
    A, A0 = np.array([[0.0, 1.0], [-4.0, -1.0]]), np.array([[0.0], [4.0]])
    C, L_tilde = np.array([[1.0, 0.5], [0.0, 2.0]]), np.array([[-2.0, 1.0], [0.0, -3.0]])
    L, L_k = full_measurement_gains(A, A0, C, L_tilde, [1.0, 2.0])
    np.testing.assert_allclose(A - L @ C, L_tilde, atol=1e-12)
    P = (L_k[0] @ C).ravel() / 4.0  # its second row: A0' P = 4 P[1, :]
    whole = control.lyap(L_tilde.T, np.eye(2))
    np.testing.assert_allclose(P, whole[1], rtol=1e-12)
    np.testing.assert_allclose(L_k[1], 2.0 * L_k[0], rtol=1e-14)
    with pytest.raises(ValueError, match="as many outputs as states, 2, got 1"):
        full_measurement_gains(A, A0, np.eye(1, 2), L_tilde, [1.0])


@pytest.mark.parametrize("per", ["s", "sample", "rad"])
@pytest.mark.parametrize("square", ["one", "square"])
@pytest.mark.parametrize("sign", ["plus", "minus"])
def test_a_reading_of_the_rod_is_the_papers_equations_written_in_that_unit(per, square, sign):
    # The same observer, once as rod_inversion makes it, once with wr, w0 and the step counted in the unit itself.
    from observers import rod_inversion
    from observers.periodic_schedule import Schedule

    gains = {"published": {"per": per, "sign": sign, "input": square}}
    model = rod_inversion.make(gains, speed="[1500, 1500] rpm", frequency="125 Hz", allow_unstable=True)
    tables = {signal.name: np.asarray(signal.start) for signal in model.parameters}
    K = Schedule("speed", tables["gain_nodes_1"], tables["gain_table_1"]).gain(OMEGA)
    found = np.abs(sampled_multipliers(rod(), K, OMEGA, STEP))

    unit = {"s": OMEGA, "rad": 1.0, "sample": STEP}[per]  # rad in one of it
    wr, period, step = 2 * np.pi * 125.0 / OMEGA * unit, T180 / unit, STEP / unit
    A = np.array([[0.0, 1.0], [-(wr**2), -0.3 * wr]])
    A0 = np.array([[0.0], [1.0 if square == "one" else wr**2]])
    own = PeriodicSystem(A, A0, np.array([[1.0, 0.0]]), period, 2, "rad")
    L = np.array([[0.3 * wr], [2.0 * wr**2]])
    L_k = partial_measurement_gains(A, A0, own.C, L, [k * own.order for k in range(3)], 0.1, sign)
    wanted = np.abs(sampled_multipliers(own, Gains(L, L_k).times(step, step).stacked(), 1.0, step))
    np.testing.assert_allclose(found, wanted, rtol=1e-5, atol=1e-8)


@pytest.mark.parametrize("name", ["lag", "two lags", "rod", "rod in angle"])
@pytest.mark.parametrize("mu", [0.2, 0.6, 0.95])
def test_designed_gains_are_the_riccati_equations_of_scipy_and_of_python_control(name, mu):
    system = SYSTEMS[name]
    rho = np.sqrt(mu ** (STEP / system.period))
    F, C = transition(system, OMEGA, STEP) / rho, output_row(system)
    K = design(system, OMEGA, STEP, mu)
    P = solve_discrete_are(F.T, C.T, np.zeros_like(F), np.eye(1))
    np.testing.assert_allclose(K, P @ C.T / (C @ P @ C.T + 1.0), rtol=1e-6, atol=1e-7 * np.abs(K).max())
    _, _, predictor = control.dare(F.T, C.T, np.zeros_like(F), np.eye(1))
    # The predictor's gain is Phi K.
    np.testing.assert_allclose(np.linalg.solve(F, predictor.T), K, rtol=1e-6, atol=1e-7 * np.abs(K).max())


@pytest.mark.parametrize("name", ["lag", "slow lag", "two lags", "rod", "rod in angle"])
@pytest.mark.parametrize("omega", [60.0, 157.0, 630.0])
@pytest.mark.parametrize("mu", [0.05, 0.3, 0.9])
def test_all_periodic_modes_end_at_the_demanded_multiplier_and_none_beyond(name, omega, mu):
    system = SYSTEMS[name]
    found = np.abs(sampled_multipliers(system, design(system, omega, STEP, mu), omega, STEP))
    # Powers of 30 and 120 of eigenvalues; a plant's mode at the same place as a periodic one is a double one, the root.
    assert found[0] == pytest.approx(mu, rel=1e-3)
    assert np.sum(np.isclose(found, mu, rtol=1e-3)) >= 2 * system.harmonics + 1


def test_designed_gains_do_not_jump_where_a_mode_of_the_plant_becomes_too_slow():
    system = lag(0.025)
    at = -T720 / 0.025 / np.log(0.3)  # the speed at which its own multiplier e^(-T0/(omega tau)) is 0.3
    slower, faster = (design(system, at * (1.0 + away), STEP, 0.3) for away in (1e-6, -1e-6))
    np.testing.assert_allclose(slower, faster, rtol=1e-3, atol=1e-4)


def test_designed_gains_weigh_two_outputs_by_their_noise():
    A = np.array([[-40.0, 0.0], [0.0, -40.0]])
    system = PeriodicSystem(A, np.array([[40.0], [40.0]]), np.eye(2), T720, 2)
    K = design(system, OMEGA, STEP, 0.5, np.array([1.0, 3.0]))
    # Two like sensors of one input: what each is worth goes with the inverse of its variance.
    np.testing.assert_allclose(K[:, 0], 9.0 * K[:, 1], rtol=1e-9, atol=1e-12)


def test_the_variance_gain_is_the_lyapunov_equation_of_scipy_and_of_python_control():
    for system in (lag(0.025), rod()):
        K = design(system, OMEGA, STEP, 0.5)
        moved, H = sampled_error(system, K, OMEGA, STEP), input_row(system)
        found = variance_gain([(moved, K, H)])
        scale = np.diag(1.0 / np.abs(K).ravel().clip(1e-9))
        scaled, driven = scale @ moved @ np.linalg.inv(scale), scale @ K
        for P in (solve_discrete_lyapunov(scaled, driven @ driven.T), control.dlyap(scaled, driven @ driven.T)):
            back = np.linalg.inv(scale)
            assert found[0] == pytest.approx((H @ back @ P @ back.T @ H.T).item(), rel=1e-6)


def test_the_variance_gain_of_a_cascade_is_that_of_its_stages_as_one_system():
    # A cascade by simulating its impulse response: the sum of squares of w to one unit of noise on y.
    first, second = lag(0.02), lag(0.025)
    maps = []
    for system in (first, second):
        K = design(system, OMEGA, STEP, 0.5)
        maps.append((sampled_error(system, K, OMEGA, STEP), K, input_row(system)))
    (F1, K1, H1), (F2, K2, H2) = maps
    e1, e2, total = -K1, K2 @ H1 @ -K1, 0.0
    for _ in range(4000):
        total += (H2 @ e2).item() ** 2
        e1 = F1 @ e1
        e2 = F2 @ e2 + K2 @ H1 @ e1
    assert variance_gain(maps)[0] == pytest.approx(total, rel=1e-9)


def test_a_sum_without_end_is_refused():
    assert summed(np.array([[0.5]]), np.eye(1)).item() == pytest.approx(4.0 / 3.0, rel=1e-15)
    with pytest.raises(ValueError, match="within the unit circle"):
        summed(np.array([[1.0]]), np.eye(1))


def variance_of(system: PeriodicSystem):
    def variance(mu: float) -> float:
        K = design(system, OMEGA, STEP, mu)
        return float(variance_gain([(sampled_error(system, K, OMEGA, STEP), K, input_row(system))])[0])

    return variance


def test_a_demand_on_convergence_and_noise_is_met_or_refused_with_what_is_possible():
    variance = variance_of(lag(0.025))
    assert meet(Demand(0.3), variance) == 0.3
    fastest = meet(Demand(None, 0.4), variance)
    assert variance(fastest) <= 0.4 < variance(fastest * (1.0 - 1e-3))
    assert meet(Demand(0.6, 0.4), variance) == 0.6
    assert meet(Demand(0.6, 0.4, "convergence"), variance) == pytest.approx(fastest, rel=1e-3)
    with pytest.raises(ModelError, match=r"0\.3 has the variance gain .*, above 0\.4; 0\.4 is kept with 0\.4"):
        meet(Demand(0.3, 0.4), variance)
    with pytest.raises(ModelError, match="wants a multiplier from"):
        meet(Demand(1.2), variance)


def test_the_variance_gain_falls_as_the_demand_on_convergence_does():
    for system in (lag(0.025), rod()):
        gains = [variance_of(system)(mu) for mu in (0.05, 0.2, 0.5, 0.8, 0.95)]
        assert all(a > b for a, b in itertools.pairwise(gains))


@pytest.mark.parametrize("kind", ["published", "designed"])
def test_of_a_lag_the_gains_lie_on_a_line_and_two_nodes_are_exact(kind):
    system = lag(0.025)

    def law(omega: float) -> np.ndarray:
        if kind == "designed":
            return design(system, omega, STEP, 0.8)
        return lag_gains(0.025, omega, "sample").times(STEP, STEP).stacked()

    found = schedule(law, 60.0, 400.0, 7)
    assert len(found.nodes) == 2 and found.variable == ("speed" if kind == "designed" else "interval")
    for omega in (60.0, 77.0, 200.0, 399.0):
        np.testing.assert_allclose(found.gain(omega), law(omega), rtol=1e-9, atol=1e-12)


def test_between_nodes_the_demand_is_kept_after_nodes_were_put_in():
    system = rod()
    step = Sampling(STEP, "rad").angle

    def law(omega: float) -> np.ndarray:
        return design(system, omega, STEP, 0.3)

    coarse = schedule(law, 100.0, 500.0, 3)
    assert certify(system, coarse, 100.0, 500.0, 3, step).worst[0] > 0.31
    fine = refined(system, coarse, law, step, 0.3)
    assert certify(system, fine, 100.0, 500.0, 3, step).worst[0] < 0.3 * 1.006
    # At speeds that nobody looked at.
    for omega in np.random.default_rng(1).uniform(100.0, 500.0, 40):
        assert abs(sampled_multipliers(system, fine.gain(omega), omega, STEP)[0]) < 0.3 * 1.01


def test_harmonics_that_are_not_seen_are_named():
    assert unseen_harmonics(rod(), OMEGA) == []
    integrator = PeriodicSystem(np.zeros((1, 1)), np.eye(1), np.eye(1), T720, 2)
    assert [k for k, _ in unseen_harmonics(integrator, OMEGA)] == [0]


def test_a_system_that_polynomials_do_not_resolve_is_refused():
    # Twelve lags over eleven decades: the polynomial's factors are lost in each other.
    rates = -(10.0 ** np.linspace(-4, 7, 12))
    A = np.diag(rates) + np.diag(np.ones(11), -1)
    system = PeriodicSystem(A, np.eye(12, 1), np.eye(1, 12, 11), T720, 2)
    with pytest.raises(ModelError, match="A of 12 states is too badly conditioned"):
        check_resolved(system, [OMEGA])
    check_resolved(two_lags(0.02, 0.02), [30.0, OMEGA, 700.0])


def test_stacked_gains_come_apart_again():
    gains = rod_gains(rod(), OMEGA, "plus")
    again = gains_of(gains.stacked(), rod())
    np.testing.assert_array_equal(again.state, gains.state)
    np.testing.assert_allclose(
        again.harmonics, gains.harmonics.real + 1j * gains.harmonics.imag * [[[0]], [[1]], [[1]]]
    )
