"""The closed form of the exhaust path, from the cylinders' AFR to harmonics and back, against a simulation of it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm

from observers.path_inversion import (
    Path,
    Pattern,
    conditioning,
    deviations_of,
    harmonics_of,
    locate,
    path_phasors,
    pattern_of,
)

LAGS = (0.025, 0.02)  # s, those of the paper's sensor
PATH = Path(
    centre=230.0, pulse=180.0, mixing_time=0.02, mixing_angle=90.0, delay_time=2e-3, delay_angle=60.0, lags=LAGS
)
SPEEDS = [800.0, 1500.0, 3000.0, 4500.0]


def simulated(deviations: np.ndarray, path: Path, omega: float, step: float = 0.5) -> np.ndarray:
    """c_1..c_3 of a staircase through a delay and lags in series, periodic, by matrix exponentials; (3,)."""
    h = np.radians(step) / omega
    taus = [path.mixing_time + np.radians(path.mixing_angle) / omega, *path.lags]
    A = np.diag([-1.0 / tau for tau in taus]) + np.diag([1.0 / tau for tau in taus[1:]], -1)
    block = np.zeros((4, 4))
    block[:3, :3], block[0, 3] = A, 1.0 / taus[0]
    whole = expm(block * h)
    phi, gamma = whole[:3, :3], whole[:3, 3]
    n = round(720 / step)
    opens = path.centre - path.pulse / 2.0
    place = np.floor((step * (np.arange(n) + 0.5) - opens) / 180.0).astype(int) % 4
    u = np.asarray(deviations)[place]
    forced = np.zeros(3)
    for value in u:
        forced = phi @ forced + gamma * value
    x = np.linalg.solve(np.eye(3) - np.linalg.matrix_power(phi, n), forced)
    y = []
    for value in u:
        y.append(x[2])
        x = phi @ x + gamma * value
    c = np.fft.fft(y)[1:4] / n
    delay = omega / 2.0 * path.delay_time + np.radians(path.delay_angle) / 2.0
    return c * np.exp(-1j * np.arange(1, 4) * delay)


@pytest.mark.parametrize("rpm", SPEEDS)
def test_the_harmonics_are_those_of_a_simulated_path(rpm):
    omega = rpm * np.pi / 30.0
    deviations = np.array([-3.0, 1.0, 2.5, -0.5])
    found = harmonics_of(deviations, PATH, omega)
    # The aliases of 1440 samples of a signal whose harmonics fall with k^-4 are below 1e-9 of it.
    np.testing.assert_allclose(found, simulated(deviations, PATH, omega), rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("cells", [1, 10])
def test_cells_in_a_row_are_lags_that_share_the_delay(cells):
    omega = 157.0
    delay = PATH.delay_time + np.radians(PATH.delay_angle) / omega
    wanted = path_phasors(PATH._replace(delay_time=0.0, delay_angle=0.0, lags=(*LAGS, *[delay / cells] * cells)), omega)
    for g, one in zip(path_phasors(PATH._replace(cells=cells), omega), wanted, strict=True):
        assert g == pytest.approx(one, rel=1e-12)


def test_very_many_cells_are_a_true_delay():
    for g, one in zip(path_phasors(PATH._replace(cells=10_000), 157.0), path_phasors(PATH, 157.0), strict=True):
        # Of n cells the gain is that of e^{-i x} to x^2/(2 n), here 3e-4, the phase to x^3/(3 n^2).
        assert g == pytest.approx(one, rel=1e-3)


@pytest.mark.parametrize("pulse", [30.0, 120.0, 180.0, 300.0])
def test_deviations_come_back_from_their_harmonics(pulse):
    path, generator = PATH._replace(pulse=pulse), np.random.default_rng(1)
    for rpm in SPEEDS:
        phasors = path_phasors(path, rpm * np.pi / 30.0)
        deviations = generator.normal(size=4)
        deviations -= deviations.mean()
        c = harmonics_of(deviations, path, rpm * np.pi / 30.0)
        found = deviations_of(locate(c.real, c.imag, phasors))
        # Rounding, times a condition number below 100.
        np.testing.assert_allclose(found, deviations, rtol=0, atol=1e-12)


def matrix(phasors) -> np.ndarray:
    """The map from d (4,) to the real and imaginary parts of c_1..c_3, (6, 4), written out."""
    rows = [g.size * np.exp(1j * (g.angle - k * np.pi / 2.0 * np.arange(4))) for k, g in enumerate(phasors, start=1)]
    return np.vstack([np.real(rows), np.imag(rows)])


@pytest.mark.parametrize("rpm", SPEEDS)
def test_locating_is_the_least_squares_solution_and_its_conditioning_that_of_the_matrix(rpm):
    phasors = path_phasors(PATH, rpm * np.pi / 30.0)
    zero_sum = np.linalg.qr(np.hstack([np.ones((4, 1)), np.eye(4)[:, :3]]))[0][:, 1:]
    reduced = matrix(phasors) @ zero_sum
    c = np.random.default_rng(2).normal(size=(2, 3))  # what no deviations give exactly
    wanted = zero_sum @ np.linalg.lstsq(reduced, c.ravel(), rcond=None)[0]
    scale = np.abs(wanted).max()
    np.testing.assert_allclose(deviations_of(locate(c[0], c[1], phasors)), wanted, rtol=0, atol=1e-10 * scale)
    assert conditioning(phasors) == pytest.approx(np.linalg.cond(reduced), rel=1e-9)


def test_a_pattern_is_the_transform_over_the_firing_order_and_back():
    deviations = np.array([0.7, -0.2, 1.1, -1.9])
    pattern = pattern_of(deviations)
    transform = np.fft.fft(deviations)
    np.testing.assert_allclose([complex(pattern.one_real, pattern.one_imaginary), pattern.two], transform[1:3])
    np.testing.assert_allclose(deviations_of(pattern), deviations - deviations.mean(), atol=1e-15)


@pytest.mark.parametrize("first", [0, 1])
def test_two_opposite_cylinders_alike_raise_the_second_harmonic_only_and_unlike_the_others_only(first):
    d = 0.8
    alike, unlike = np.zeros(4), np.zeros(4)
    alike[[first, first + 2]] = d
    unlike[[first, first + 2]] = d, -d
    omega = 157.0
    sizes = [abs(g.size) for g in path_phasors(PATH, omega)]
    np.testing.assert_allclose(np.abs(harmonics_of(alike, PATH, omega)), [0, 2 * d * sizes[1], 0], atol=1e-16)
    np.testing.assert_allclose(
        np.abs(harmonics_of(unlike, PATH, omega)), [2 * d * sizes[0], 0, 2 * d * sizes[2]], atol=1e-16
    )


def test_a_delay_that_is_wrong_by_less_than_90_degrees_of_crank_angle_still_names_the_cylinder():
    slow = PATH._replace(mixing_time=0.1)  # |g_3|^2 is below a thousandth of |g_1|^2 and does not count
    omega = 157.0
    for error, right in {-100.0: False, -80.0: True, 80.0: True, 100.0: False}.items():
        c = harmonics_of([-3.0, 1.0, 1.0, 1.0], slow._replace(delay_angle=60.0 + error), omega)
        found = deviations_of(locate(c.real, c.imag, path_phasors(slow, omega)))
        assert (int(np.argmax(np.abs(found))) == 0) == right


def test_a_path_in_arrays_is_the_path_at_each_speed():
    omega = np.array([84.0, 157.0, 471.0])
    together = path_phasors(PATH, omega)
    for j, value in enumerate(omega):
        for g, one in zip(together, path_phasors(PATH, value), strict=True):
            assert (g.size[j], g.angle[j]) == (one.size, one.angle)


def test_of_one_cylinder_the_pattern_turns_with_its_place():
    for place in range(4):
        pattern = pattern_of(np.eye(4)[place])
        turned = (-1j) ** place
        assert pattern == Pattern(turned.real, turned.imag, (-1.0) ** place)
