"""The Kalman steps against closed forms, scipy and python-control, without any model around them."""

from __future__ import annotations

from itertools import pairwise

import control
import numpy as np
import pytest
from scipy.linalg import expm
from scipy.stats import norm

from fmus.model import ModelError
from observers import ekf, ukf
from observers.constant_gain import weights
from observers.kalman import (
    Gaussian,
    SingularInnovation,
    correct,
    discretise,
    innovation_root,
    normalised_square,
    predict_covariance,
)
from observers.stationary import stationary

# A damped mass on a spring and a slow drift: x' = v, v' = -4 x - 0.5 v + d, d' = -0.1 d.
A = np.array([[0.0, 1.0, 0.0], [-4.0, -0.5, 1.0], [0.0, 0.0, -0.1]])
C = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.5]])
DENSITY = np.array([0.0, 0.3, 0.05])
VARIANCE = np.array([0.04, 0.01])
H = 0.1
NAMES = ["x", "v", "d"]


def van_loan(A: np.ndarray, density: np.ndarray, h: float) -> tuple[np.ndarray, np.ndarray]:
    n = len(A)
    block = np.zeros((2 * n, 2 * n))
    block[:n, :n], block[:n, n:], block[n:, n:] = -A, np.diag(density), A.T
    found = expm(block * h)
    transition = found[n:, n:].T
    return transition, transition @ found[:n, n:]


def symmetric(seed: int, rates: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Eigenvectors U and the symmetric matrix with the eigenvalues -rates."""
    U, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(len(rates),) * 2))
    return U, -(U * rates) @ U.T


@pytest.mark.parametrize("h", [1e-3, 0.1, 1.0])
def test_an_interval_is_that_of_van_loans_exponential(h):
    found, (transition, noise) = discretise(A, DENSITY, h), van_loan(A, DENSITY, h)
    # Van Loan's product has values up to e^{|A| h} = e^5, rounded to 1e-16 of that.
    np.testing.assert_allclose(found.transition, transition, rtol=1e-12, atol=1e-13)
    np.testing.assert_allclose(found.noise, noise, rtol=1e-11, atol=1e-14)


def test_an_interval_of_a_stiff_system_keeps_its_digits():
    # For A = U diag(-r) U', Q_ij = (U' D U)_ij (1 - e^{-(r_i + r_j) h})/(r_i + r_j) in the basis U. Van Loan's
    # exponential would hold e^{1e5}.
    rates = np.array([1e5, 1e3, 10.0, 0.1])
    U, stiff = symmetric(3, rates)
    density = np.array([1.0, 2.0, 0.5, 3.0])
    sums = rates[:, None] + rates
    exact = U @ ((U.T * density) @ U * -np.expm1(-sums) / sums) @ U.T
    found = discretise(stiff, density, 1.0)
    # Eighteen doublings carry the rounding of A, 1e-16 of 1e5, over an interval of 1: 1e-11.
    np.testing.assert_allclose(found.transition, (U * np.exp(-rates)) @ U.T, atol=1e-10)
    np.testing.assert_allclose(found.noise, exact, rtol=1e-8, atol=1e-9)
    assert np.linalg.eigvalsh(found.noise).min() > 0.0


def test_two_intervals_are_one_of_twice_the_length():
    one, two = discretise(A, DENSITY, 0.35), discretise(A, DENSITY, 0.7)
    np.testing.assert_allclose(one.transition @ one.transition, two.transition, atol=1e-14)
    np.testing.assert_allclose(predict_covariance(one.noise, one), two.noise, rtol=1e-13, atol=1e-15)


def test_a_correction_is_the_conditional_gaussian():
    # Of the joint Gaussian of (x, y): mean + S_xy S_yy^-1 (y - mean_y), S_xx - S_xy S_yy^-1 S_yx.
    P = discretise(A, np.ones(3), 1.0).noise
    mean, y = np.array([1.0, -2.0, 0.5]), np.array([0.7, -1.0])
    found = correct(Gaussian(mean, P), y - C @ mean, C, VARIANCE)
    S = C @ P @ C.T + np.diag(VARIANCE)
    np.testing.assert_allclose(found.belief.mean, mean + P @ C.T @ np.linalg.inv(S) @ (y - C @ mean), rtol=1e-13)
    np.testing.assert_allclose(found.belief.covariance, P - P @ C.T @ np.linalg.inv(S) @ C @ P, rtol=1e-12, atol=1e-15)
    np.testing.assert_array_equal(found.belief.covariance, found.belief.covariance.T)
    v = y - C @ mean
    assert normalised_square(v, S) == pytest.approx(v @ np.linalg.inv(S) @ v, rel=1e-13)


def test_josephs_form_stays_definite_where_the_short_form_does_not():
    # A sensor a hundred million times better than what is known: P - K C P loses the variance in rounding.
    P = np.array([[1.0, 1.0 - 1e-9], [1.0 - 1e-9, 1.0]]) * 1e8
    found = correct(Gaussian(np.zeros(2), P), np.zeros(1), np.array([[1.0, 0.0]]), np.array([1e-8]))
    short = P - found.gain @ np.array([[1.0, 0.0]]) @ P
    assert np.diag(short).min() <= 0.0 or np.linalg.eigvalsh(short).min() < 0.0
    assert np.linalg.eigvalsh(found.belief.covariance).min() >= 0.0
    assert found.belief.covariance[0, 0] == pytest.approx(1e-8, rel=1e-6)


def test_a_sensor_that_says_nothing_new_is_named():
    twice = np.array([[1.0, 2.0, 0.0], [0.5, 1.0, 0.0]])
    with pytest.raises(SingularInnovation, match="measurement 2 is known without it") as caught:
        correct(Gaussian(np.zeros(3), np.eye(3)), np.zeros(2), twice, np.zeros(2))
    assert caught.value.row == 1
    with pytest.raises(SingularInnovation):
        innovation_root(np.zeros((1, 1)))


def test_the_stationary_filter_is_python_controls_dlqe():
    found = stationary(A, C, DENSITY, VARIANCE, H, NAMES)
    transition, noise = van_loan(A, DENSITY, H)
    gain, before, _ = control.dlqe(transition, np.eye(3), C, noise, np.diag(VARIANCE))
    # Both solve the same equation to rounding times its condition.
    # Its gain is that of the predictor, Phi K.
    np.testing.assert_allclose(transition @ found.gain, gain, rtol=1e-9)
    np.testing.assert_allclose(found.before, before, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(found.innovation_covariance, C @ before @ C.T + np.diag(VARIANCE), rtol=1e-9)


def test_the_extended_and_the_unscented_filter_come_to_rest_where_the_riccati_equation_says():
    rest = stationary(A, C, DENSITY, VARIANCE, H, NAMES)
    interval = discretise(A, DENSITY, H)
    extended = unscented = Gaussian(np.zeros(3), np.eye(3))
    generator = np.random.default_rng(1)
    for _ in range(600):  # the slowest mode decays by 1 % a step: e^-6 and its square
        y = generator.normal(size=2)
        prior = Gaussian(interval.transition @ extended.mean, ekf.predict(extended.covariance, A, A, DENSITY, H))
        found = correct(prior, y - C @ prior.mean, C, VARIANCE)
        extended = found.belief
        points = (unscented.mean + ukf.sigma_offsets(unscented.covariance, np.sqrt(3.0))) @ interval.transition.T
        prior = ukf.predict(interval.transition @ unscented.mean, points, interval.noise, np.sqrt(3.0))
        unscented = ukf.correct(prior, lambda x: C @ x, y, VARIANCE, np.sqrt(3.0)).belief
        # The same sums in another order, which the filter forgets as it forgets its start.
        np.testing.assert_allclose(unscented.mean, extended.mean, rtol=1e-10, atol=1e-12)
        np.testing.assert_allclose(unscented.covariance, extended.covariance, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(extended.covariance, rest.after, rtol=1e-4)
    np.testing.assert_allclose(found.gain, rest.gain, rtol=1e-4, atol=1e-8)


def test_the_extended_filter_follows_a_nonlinear_flow_to_the_third_order():
    # x' = -x^2: x(h) = x/(1 + x h), dx(h)/dx = 1/(1 + x h)^2.
    def missed(h: float) -> float:
        x, after = 2.0, 2.0 / (1.0 + 2.0 * h)
        found = ekf.predict(np.eye(1), np.array([[-2.0 * x]]), np.array([[-2.0 * after]]), np.zeros(1), h)
        return abs(np.sqrt(found[0, 0]) - 1.0 / (1.0 + x * h) ** 2)

    errors = [missed(0.02 / 2**k) for k in range(4)]
    assert all(7.0 < a / b < 9.0 for a, b in pairwise(errors))  # 2^3, and what is left of the fourth order


def test_the_unscented_mean_of_a_square_is_exact():
    # E x^2 = m^2 + P; the linearised mean is m^2.
    prior = Gaussian(np.array([0.7]), np.array([[0.3]]))
    found = ukf.correct(prior, lambda x: x**2, np.array([1.0]), np.array([0.01]), np.sqrt(3.0))
    assert found.innovation[0] == pytest.approx(1.0 - (0.7**2 + 0.3), rel=1e-14)
    # var x^2 = 4 m^2 P + 2 P^2, and about the centre P^2 more.
    assert found.innovation_covariance[0, 0] == pytest.approx(4 * 0.7**2 * 0.3 + 3 * 0.3**2 + 0.01, rel=1e-14)


def test_the_unscented_filter_is_nearer_to_the_true_mean_than_the_extended_one():
    # Of x(h) for x' = -x^2, x(0) of N(2, 0.3^2), by quadrature over six standard deviations to 1e-9.
    grid = np.linspace(2.0 - 1.8, 2.0 + 1.8, 4001)
    density = norm.pdf(grid, 2.0, 0.3)

    def flow(x):
        return x / (1.0 + 0.5 * x)

    exact = np.trapezoid(flow(grid) * density, grid) / np.trapezoid(density, grid)
    points = 2.0 + ukf.sigma_offsets(np.array([[0.09]]), np.sqrt(3.0))
    unscented = ukf.predict(np.array([flow(2.0)]), flow(points), np.zeros((1, 1)), np.sqrt(3.0)).mean[0]
    assert abs(unscented - exact) < 0.1 * abs(flow(2.0) - exact)


@pytest.mark.parametrize("spread", [1.0, np.sqrt(3.0), 3.0])
@pytest.mark.parametrize("n", [1, 3, 8])
def test_sigma_points_have_the_mean_and_the_covariance_they_are_made_of(n, spread):
    root = np.random.default_rng(n).normal(size=(n, n))
    P = root @ root.T
    mean = np.arange(n, dtype=float)
    found = ukf.predict(mean, mean + ukf.sigma_offsets(P, spread), np.zeros((n, n)), spread)
    np.testing.assert_allclose(found.mean, mean, atol=1e-13 * np.sqrt(np.trace(P)))
    np.testing.assert_allclose(found.covariance, P, rtol=1e-12, atol=1e-13 * np.trace(P))


def test_a_state_that_is_known_exactly_has_no_spread_and_an_impossible_covariance_is_refused():
    P = np.array([[4.0, 0.0, 2.0], [0.0, 0.0, 0.0], [2.0, 0.0, 1.0]])
    np.testing.assert_allclose(ukf.covariance_root(P), [[2.0, 0.0, 0.0], [0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    with pytest.raises(ModelError, match="not positive semidefinite, at state 2"):
        ukf.covariance_root(np.array([[1.0, 2.0], [2.0, 1.0]]))


def test_a_mode_that_no_sensor_sees_is_named_with_its_states():
    # Two integrators, of which the second one's speed alone is measured.
    double = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    with pytest.raises(ModelError, match=r"not detectable: the sensors do not see the mode at 0 1/s in position"):
        stationary(double, np.array([[0.0, 1.0, 1.0]]), np.ones(3), np.ones(1), H, ["position", "speed", "other"])
    swing = np.array([[0.0, 2.0, 0.0], [-2.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    with pytest.raises(ModelError, match=r"the mode at 0\+2j 1/s in a, b"):
        stationary(swing, np.array([[0.0, 0.0, 1.0]]), np.ones(3), np.ones(1), H, ["a", "b", "c"])


def test_what_decays_may_be_unseen():
    found = stationary(np.diag([-1.0, -2.0]), np.array([[1.0, 0.0]]), np.ones(2), np.ones(1), H, ["a", "b"])
    # What is not seen keeps the variance that its own noise gives it: q/(2 r).
    assert found.after[1, 1] == pytest.approx(1.0 / 4.0, rel=1e-10)
    assert found.gain[1, 0] == pytest.approx(0.0, abs=1e-14)


def test_an_integrator_without_noise_has_no_gain_at_rest():
    with pytest.raises(ModelError, match=r"no process noise moves the mode at 0 1/s in bias: its gain"):
        stationary(np.diag([-1.0, 0.0]), np.array([[1.0, 1.0]]), np.array([1.0, 0.0]), np.ones(1), H, ["a", "bias"])


def test_weights_interpolate_a_bilinear_table_exactly_and_hold_it_outside():
    x, y = np.array([1.0, 2.0, 4.0]), np.array([-1.0, 3.0])
    table = np.array([[2.0 + 3.0 * a - b + 0.5 * a * b for b in y] for a in x])

    def plane(a: float, b: float) -> float:
        a, b = np.clip(a, 1.0, 4.0), np.clip(b, -1.0, 3.0)
        return 2.0 + 3.0 * a - b + 0.5 * a * b

    for a, b in [(1.0, -1.0), (1.5, 0.3), (2.0, 1.0), (3.9, 3.0), (0.0, 9.0), (5.0, -7.0), (4.0, 0.0)]:
        assert np.dot(weights([(a, x), (b, y)]), table.ravel()) == pytest.approx(plane(a, b), rel=1e-14)
    assert weights([]) == [1.0]
    assert weights([(7.0, np.array([2.0]))]) == [1.0]
