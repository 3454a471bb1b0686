"""Process noise by maximum likelihood: the likelihood's own value, and known noise recovered within its own errors."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm, solve_discrete_are, solve_discrete_lyapunov
from scipy.stats import multivariate_normal

from selection.likelihood import Course, Sampling, log_likelihood, maximum_likelihood, stationary_covariances
from selection.measures import sampled

A = np.array([[-2.0, 1.0, 0.0], [0.0, -5.0, 2.0], [0.5, 0.0, -1.0]])
H = 0.05


def simulated(system: Sampling, process: np.ndarray, rows: int, seed: int) -> Course:
    """A course of the system at rest, with a known drive on the first state."""
    generator = np.random.default_rng(seed)
    n = len(system.A)
    intensity = np.zeros(n)
    intensity[list(system.moved)] = process**2
    F, Q = sampled(system.A, np.diag(intensity), system.period)
    drive = np.zeros((rows - 1, n))
    drive[:, 0] = 0.05 * np.sin(0.1 * np.arange(rows - 1))
    x = np.linalg.cholesky(solve_discrete_lyapunov(F, Q) + 1e-12 * np.eye(n)) @ generator.normal(size=n)
    root = np.linalg.cholesky(Q + 1e-14 * np.eye(n))
    measured = np.empty((rows, len(system.C)))
    for k in range(rows):
        measured[k] = system.C @ x + system.noise * generator.normal(size=len(system.C))
        if k + 1 < rows:
            x = F @ x + drive[k] + root @ generator.normal(size=n)
    return Course(drive, measured, np.zeros(n))


def test_the_likelihood_of_a_scalar_is_that_of_all_its_measurements_together():
    # x' = -x + w, y = x + e. All y together are Gaussian, with the drive's response as mean; given the first one, and
    # once the filter has come to rest, their density is the product of those of the innovations.
    system = Sampling(np.array([[-1.0]]), np.array([[1.0]]), np.array([0.3]), 0.1, (0,))
    course = simulated(system, np.array([0.7]), 300, 3)
    phi, k = np.exp(-0.1), np.arange(300)
    variance = 0.7**2 / 2.0
    mean = np.zeros(300)
    for j in range(299):
        mean[j + 1] = phi * mean[j] + course.drive[j, 0]
    covariance = variance * phi ** np.abs(k[:, None] - k) + 0.3**2 * np.eye(300)
    y = course.measured[:, 0]
    whole = multivariate_normal(mean, covariance).logpdf(y)
    head = multivariate_normal(mean[:60], covariance[:60, :60]).logpdf(y[:60])
    short = Course(course.drive[:59], course.measured[:60], course.start)
    found = log_likelihood(system, np.array([0.7]), [course]) - log_likelihood(system, np.array([0.7]), [short])
    # After 60 samples nothing is left of how either began: its gain forgets by exp(-0.15) each.
    assert found == pytest.approx(whole - head, abs=1e-5)


def test_known_noise_is_recovered_within_the_errors_that_it_tells():
    system = Sampling(A, np.eye(3), np.array([0.02, 0.02, 0.02]), H, (0, 1, 2))
    process = np.array([0.5, 0.2, 0.05])
    found = maximum_likelihood(system, np.array([0.1, 0.1, 0.1]), [simulated(system, process, 3000, 7)])
    off = np.log(found.process / process) / found.errors
    # Three normal deviates: beyond 3.5 errors once in two thousand.
    assert np.abs(off).max() < 3.5
    # A deviation seen in 3000 samples is known to 1/sqrt(2 3000) = 1.3 % at best, less well under the sensors' noise.
    assert (found.errors > 0.012).all() and (found.errors < 0.1).all()


def test_the_errors_are_those_of_many_repetitions():
    system = Sampling(np.array([[-1.0]]), np.array([[1.0]]), np.array([0.1]), 0.1, (0,))
    runs = [
        maximum_likelihood(system, np.array([0.4]), [simulated(system, np.array([0.5]), 300, seed)])
        for seed in range(24)
    ]
    logs = np.log([run.process[0] / 0.5 for run in runs])
    told = np.mean([run.errors[0] for run in runs])
    # Of 24 the deviation is known to 1/sqrt(48) = 14 %, thrice that is allowed; their mean to told/sqrt(24).
    assert logs.std() == pytest.approx(told, rel=0.43)
    assert abs(logs.mean()) < 4.0 * told / np.sqrt(24.0)


@pytest.mark.parametrize("growing", [0.9, 1.05])
def test_the_stationary_covariances_are_scipys(growing):
    generator = np.random.default_rng(6)
    F = generator.normal(size=(6, 6))
    F *= growing / np.abs(np.linalg.eigvals(F)).max()
    C, R = generator.normal(size=(2, 6)), np.diag([0.1, 2.0])
    Q = np.array([np.diag(10.0 ** generator.uniform(-4, 1, 6)) for _ in range(5)])
    found = stationary_covariances(F, C, Q, R)
    for one, intensity in zip(found, Q, strict=True):
        expected = solve_discrete_are(F.T, C.T, intensity, R)
        # Both lose some digits of the smallest eigenvalues to the largest.
        np.testing.assert_allclose(one, expected, atol=1e-9 * np.abs(expected).max())


def test_several_records_are_one_likelihood():
    system = Sampling(A, np.eye(3)[:2], np.array([0.02, 0.05]), H, (0, 2))
    courses = [simulated(system, np.array([0.5, 0.1]), 200, seed) for seed in (1, 2)]
    apart = [log_likelihood(system, np.array([0.4, 0.2]), [course]) for course in courses]
    assert log_likelihood(system, np.array([0.4, 0.2]), courses) == pytest.approx(sum(apart), rel=1e-12)


def test_a_state_that_the_sensors_hardly_see_has_a_large_error():
    # The second state reaches the sensor through 1e-6 only.
    A = np.array([[-2.0, 1e-6], [0.0, -5.0]])
    system = Sampling(A, np.array([[1.0, 0.0]]), np.array([0.02]), H, (0, 1))
    found = maximum_likelihood(system, np.array([0.2, 0.2]), [simulated(system, np.array([0.5, 0.2]), 500, 5)])
    assert found.errors[0] < 0.1 and found.errors[1] > 10.0
    assert found.process[0] == pytest.approx(0.5, rel=0.3)


def test_states_that_are_not_moved_have_no_noise_and_the_filter_rests_all_the_same():
    # A lag behind a state, as a slow sensor is: nothing disturbs it but what it follows.
    A = np.array([[-1.0, 0.0], [20.0, -20.0]])
    system = Sampling(A, np.array([[0.0, 1.0]]), np.array([0.05]), H, (0,))
    found = maximum_likelihood(system, np.array([0.1]), [simulated(system, np.array([0.6]), 2000, 11)])
    assert abs(np.log(found.process[0] / 0.6)) < 3.5 * found.errors[0] < 0.35


def test_a_mode_that_grows_unseen_is_refused():
    system = Sampling(np.diag([-1.0, 0.5]), np.array([[1.0, 0.0]]), np.array([0.1]), H, (0, 1))
    with pytest.raises(ValueError, match=r"a mode of 0\.5/s is not seen and does not die out"):
        maximum_likelihood(system, np.ones(2), [Course(np.zeros((9, 2)), np.zeros((10, 1)), np.zeros(2))])


def test_the_simulation_of_this_test_is_the_continuous_systems():
    # Of intensity q^2 over a step, by summing many small ones.
    F, Q = sampled(A, np.diag([0.25, 0.04, 0.0]), H)
    steps = 4000
    small = expm(A * H / steps)
    total, power = np.zeros((3, 3)), np.eye(3)
    for _ in range(steps):
        total += power @ np.diag([0.25, 0.04, 0.0]) @ power.T * H / steps
        power = small @ power
    np.testing.assert_allclose(F, expm(A * H), rtol=1e-10, atol=1e-14)
    np.testing.assert_allclose(Q, total, atol=1e-3 * np.abs(Q).max())
