"""Noise from recorded data: residuals, moments beside scipy's, the paper's rules, densities and lags."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats
from scipy.integrate import solve_ivp

from selection.noise import Linear, Moments, Rule, corrected, density, follow, measurement, moments, residuals

# Two states and an input about a point that is no equilibrium.
A = np.array([[-1.0, 0.3], [0.5, -2.0]])
B = np.array([[0.7], [-0.2]])
LINEAR = Linear(A, B, np.array([1.0, -2.0]), np.array([0.5]), np.array([0.1, 0.0]))


def wave(t: np.ndarray) -> np.ndarray:
    """A disturbance of both states and the input's course, (k, 3)."""
    return np.column_stack([0.4 * np.sin(3.0 * t), 0.2 * np.cos(5.0 * t), np.sin(t)])


def recorded(h: float, stop: float = 4.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Time, states and inputs of the system with its disturbance, by an integrator near rounding."""
    time = np.arange(round(stop / h) + 1) * h

    def rate(t: float, x: np.ndarray) -> np.ndarray:
        first, second, u = wave(np.array([t]))[0]
        return LINEAR.rates + A @ (x - LINEAR.x0) + B @ (np.array([u]) - LINEAR.u0) + [first, second]

    run = solve_ivp(rate, (0.0, stop), [1.2, -1.5], method="DOP853", t_eval=time, rtol=1e-12, atol=1e-13)
    return time, run.y.T, wave(time)[:, 2:]


def mean_wave(begin: np.ndarray, end: np.ndarray) -> np.ndarray:
    """The mean of the disturbance over each interval, by its integral."""
    first = -0.4 / 3.0 * (np.cos(3.0 * end) - np.cos(3.0 * begin))
    second = 0.2 / 5.0 * (np.sin(5.0 * end) - np.sin(5.0 * begin))
    return np.column_stack([first, second]) / (end - begin)[:, None]


@pytest.mark.parametrize("every", [1, 2, 10])
def test_the_residual_is_the_disturbance_that_was_put_in_over_each_interval(every):
    time, x, u = recorded(0.01)
    edges = np.arange(0, len(time), every)
    found = residuals(time, x, u, LINEAR, edges)
    expected = mean_wave(time[edges[:-1]], time[edges[1:]])
    # The trapezoidal rule leaves h^2/12 of the second derivative, which is a few units here: 1e-5 times those.
    assert np.abs(found.values - expected).max() < 1e-4
    np.testing.assert_allclose(found.intervals, 0.01 * every, rtol=1e-9)


def test_the_error_of_the_residual_is_told_and_falls_with_the_square_of_the_step():
    told = []
    for h in (0.02, 0.01):
        time, x, u = recorded(h)
        edges = np.arange(len(time))
        found = residuals(time, x, u, LINEAR, edges)
        real = np.sqrt(np.mean((found.values - mean_wave(time[:-1], time[1:])) ** 2, axis=0))
        # Richardson's estimate is good to its next order, a share of h^2.
        np.testing.assert_allclose(found.error, real, rtol=0.05)
        told.append(found.error)
    np.testing.assert_allclose(told[0] / told[1], 4.0, rtol=0.02)


def test_noise_on_the_record_comes_on_top_as_the_difference_at_the_ends_has_it():
    time, x, u = recorded(0.01, 20.0)
    noisy = x + 1e-3 * np.random.default_rng(1).normal(size=x.shape)
    for every in (1, 10):
        edges = np.arange(0, len(time), every)
        extra = residuals(time, noisy, u, LINEAR, edges).values - residuals(time, x, u, LINEAR, edges).values
        # sqrt(2) 1e-3 over the interval; of 200 intervals or more, a deviation is known to 1/sqrt(2 200) = 5 %.
        assert extra.std() == pytest.approx(np.sqrt(2.0) * 1e-3 / (0.01 * every), rel=0.15)


@pytest.mark.parametrize(
    ("time", "edges"),
    [([0.0, 1.0], [0, 1]), ([0.0, 1.0, 1.0], [0, 2]), ([0.0, 1.0, 2.0], [0, 3]), ([0.0, 1.0, 2.0], [0])],
)
def test_rows_that_do_not_ascend_and_edges_beyond_them_are_refused(time, edges):
    with pytest.raises(ValueError, match="residuals want"):
        residuals(np.array(time), np.zeros((len(time), 2)), np.zeros((len(time), 1)), LINEAR, np.array(edges))


@pytest.mark.parametrize("name", ["normal", "uniform", "exponential", "laplace"])
def test_the_moments_are_scipys(name):
    values = getattr(np.random.default_rng(4), name)(size=(500, 3)) * [1.0, 10.0, 1e-6] + [0.0, 3.0, -1e-6]
    found = moments(values)
    # The same sums in another order.
    np.testing.assert_allclose(found.mean, values.mean(axis=0), rtol=1e-12)
    np.testing.assert_allclose(found.deviation, values.std(axis=0), rtol=1e-12)
    np.testing.assert_allclose(found.skewness, stats.skew(values), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(found.kurtosis, stats.kurtosis(values), rtol=1e-9, atol=1e-12)


def test_where_nothing_varies_there_is_no_skewness_nor_kurtosis():
    found = moments(np.full((10, 1), 3.7))
    assert found.skewness[0] == found.kurtosis[0] == 0.0 and found.mean[0] == pytest.approx(3.7)


def one(mean: float, skewness: float, kurtosis: float, deviation: float = 2.0) -> Moments:
    return Moments(*(np.array([value]) for value in (mean, deviation, skewness, kurtosis)))


@pytest.mark.parametrize(
    ("found", "process", "rule"),
    [
        (one(0.5, 0.4, 0.0), 2.0, "symmetric"),
        (one(0.5, 0.6, 0.0), 1.5, "less"),
        (one(-0.5, -0.6, 0.0), 1.5, "less"),
        (one(0.5, -0.6, 0.0), 2.5, "more"),
        (one(-0.5, 0.6, 0.0), 2.5, "more"),
        (one(3.0, 0.6, 0.0), 1.0, "less"),  # what is subtracted may be more than there is
        (one(0.5, 0.0, -1.2), 2.4, "symmetric, flat"),
        (one(0.5, 0.6, -1.5), 2.25, "less, flat"),
        (one(0.5, 0.0, -1.0), 2.0, "symmetric"),
        (one(0.5, 0.0, 9.0), 2.0, "symmetric"),  # heavy tails are not corrected: the text has it the other way round
    ],
)
def test_the_papers_rules_correct_by_skewness_and_by_low_kurtosis(found, process, rule):
    by = corrected(found)
    assert by.process[0] == pytest.approx(process, rel=1e-14) and by.rules == (rule,)


def test_the_thresholds_of_the_rules_may_be_others_and_the_correction_has_no_jump_at_them():
    assert corrected(one(0.5, 0.6, 0.0), Rule(skewness=0.7)).rules == ("symmetric",)
    just = corrected(one(0.5, 0.0, -0.5 - 1e-9), Rule(kurtosis=-0.5)).process[0]
    assert just == pytest.approx(2.0, rel=1e-8)


def test_negative_excess_kurtosis_means_fewer_outliers_not_more():
    # The paper's Section 3.2.2 has it the other way round.
    generator = np.random.default_rng(0)
    flat, normal = generator.uniform(size=20000), generator.normal(size=20000)
    assert stats.kurtosis(flat) < -1.0 < stats.kurtosis(normal)
    beyond = [float(np.mean(np.abs(v - v.mean()) > 2.0 * v.std())) for v in (flat, normal)]
    assert beyond[0] == 0.0 < beyond[1]


@pytest.mark.parametrize("phi", [0.0, 0.6, 0.95])
def test_the_density_of_a_first_order_process_is_its_closed_form(phi):
    # x_k = phi x_k-1 + e: density at zero var(e)/(1 - phi)^2 times the interval; its root is sd(e)/(1 - phi).
    k, h = 200_000, 0.02
    e = np.random.default_rng(8).normal(size=k)
    x = np.empty(k)
    x[0] = e[0]
    for i in range(1, k):
        x[i] = phi * x[i - 1] + e[i]
    (found,) = density(x[:, None], h)
    # Andrews' width balances bias and spread, both k^(-1/3) of the density here: 6 % of its root, thrice that at 0.95.
    assert found == pytest.approx(np.sqrt(h) / (1.0 - phi), rel=0.06 if phi < 0.9 else 0.12)


def test_white_noise_of_any_interval_has_one_density_where_its_deviation_has_not():
    generator = np.random.default_rng(9)
    densities, deviations = [], []
    for h in (0.01, 0.04):
        # The mean of white noise of intensity 0.3^2 over h.
        values = 0.3 / np.sqrt(h) * generator.normal(size=(40_000, 1))
        densities.append(density(values, h)[0])
        deviations.append(moments(values).deviation[0])
    # 40000 samples know a deviation to 0.35 %, the density's root to about ten times that.
    np.testing.assert_allclose(densities, 0.3, rtol=0.05)
    assert deviations[0] == pytest.approx(2.0 * deviations[1], rel=0.02)


def test_a_mean_has_no_part_in_the_density_and_nothing_has_none():
    values = np.random.default_rng(2).normal(size=(100, 1))
    np.testing.assert_allclose(density(values + 50.0, 0.1), density(values, 0.1), rtol=1e-9)
    assert density(np.full((100, 1), 2.0), 0.1)[0] == 0.0


def test_measurement_noise_is_the_accuracy_of_the_largest_deviation():
    y = np.array([[1.0, 5.0], [1.5, -7.0], [0.2, 6.0]])
    np.testing.assert_allclose(measurement(y, np.array([1.0, 5.0]), np.array([0.05, 0.03])), [0.05 * 0.8, 0.03 * 12.0])


def test_what_follows_with_a_lag_is_exact_for_straight_lines():
    time = np.array([0.0, 0.1, 0.15, 0.4, 1.0])
    target = np.array([1.0, 2.0, 2.0, -1.0, 0.0])
    found = follow(time, target, 0.2, 0.5)
    run = solve_ivp(
        lambda t, x: (np.interp(t, time, target) - x) / 0.2, (0.0, 1.0), [0.5],
        t_eval=time, rtol=1e-11, atol=1e-12, max_step=1e-3,
    )  # fmt: skip
    np.testing.assert_allclose(found, run.y[0], atol=1e-9)
