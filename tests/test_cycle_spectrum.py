"""Fourier coefficients and means of an engine cycle from samples at equal and unequal angles."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad

from fmus.crankcycle import pass_step, passes
from observers.cycle_spectrum import UNSEEN, Sample, Spectrum, Sums, Windows, add_step

EXHAUST = Windows([140.0, 320.0, 500.0, 680.0], 230.0)
# A signal with harmonics 0 to 5 of the cycle, of which c_k is known.
COEFFICIENTS = np.array([20.0, 0.3 - 0.2j, -0.1 + 0.25j, 0.05 + 0.15j, 0.1 - 0.05j, -0.02 + 0.04j])


def signal(angle: float | np.ndarray) -> np.ndarray:
    phase = np.multiply.outer(np.asarray(angle) * 2.0 * np.pi / 720.0, np.arange(6))
    return np.real(COEFFICIENTS[0]) + 2.0 * np.real(np.exp(1j * phase[..., 1:]) @ COEFFICIENTS[1:])


def spectra(angles, values, windows=EXHAUST, origin=0.0, longest=60.0, omega=None) -> list[tuple[int, Spectrum]]:
    """What each whole cycle gave, and the index of the sample it ended with."""
    omega = np.full(len(angles), 100.0) if omega is None else omega
    sums = Sums(UNSEEN, np.zeros(4), np.zeros(4), np.zeros(4), 0.0, 0.0, 0.0)
    samples = [Sample(*row) for row in zip(angles, values, omega, strict=True)]
    found = []
    for k in range(1, len(samples)):
        sums, whole, spectrum = add_step(sums, samples[k - 1], samples[k], windows, origin, longest)
        if whole:
            found.append((k, spectrum))
    return found


def coefficients(spectrum: Spectrum) -> np.ndarray:
    return np.array(spectrum.real, dtype=float) + 1j * np.array(spectrum.imaginary, dtype=float)


@pytest.mark.parametrize("step", [1.0, 6.0, 30.0])
def test_of_samples_at_equal_angles_the_coefficients_are_the_discrete_fourier_transform(step):
    n = round(720 / step)
    values = np.random.default_rng(3).normal(20.0, 1.0, size=3 * n + 1)
    angles = step * np.arange(3 * n + 1)
    found = spectra(angles, values)
    assert [k for k, _ in found] == [2 * n, 3 * n]  # that the first one was whole cannot be known at its begin
    for last, spectrum in found:
        # The samples at both ends of the cycle stand for half a step each.
        cycle = values[last - n : last].copy()
        cycle[0] = (values[last - n] + values[last]) / 2.0
        # Sums of n terms of size 20 in another order.
        np.testing.assert_allclose(coefficients(spectrum), np.fft.fft(cycle)[:4] / n, rtol=0, atol=1e-12)
        assert spectrum.share == pytest.approx((n - 0.5) / n**2, rel=1e-12)
        assert spectrum.omega == pytest.approx(100.0, rel=1e-12)


@pytest.mark.parametrize(("step", "tolerance"), [(1.0, 1e-4), (6.0, 4e-3)])
def test_means_over_exhaust_phases_are_those_of_the_signal(step, tolerance):
    angles = np.arange(0.0, 1440.0 + step / 2, step)
    _, spectrum = spectra(angles, signal(angles))[-1]
    for begin, mean in zip(EXHAUST.begins, spectrum.means, strict=True):
        exact = quad(signal, begin, begin + EXHAUST.length, limit=200)[0] / EXHAUST.length
        # The line between two samples is off by step^2/12 max|w''| on average: 3.0e-4 and 1.1e-2 at the most here.
        assert mean == pytest.approx(exact, abs=tolerance)


@pytest.mark.parametrize("spread", [0.0, 0.5])
def test_at_unequal_angles_the_error_stays_within_that_of_the_trapezoidal_rule(spread):
    generator = np.random.default_rng(7)
    errors = []
    for step in (9.0, 4.5, 2.25):
        steps = step * (1.0 + spread * generator.uniform(-1.0, 1.0, size=round(2300 / step)))
        angles = 13.0 + np.cumsum(steps)
        found = spectra(angles, signal(angles))
        for _, spectrum in found:
            k, w = np.arange(6) * 2.0 * np.pi / 720.0, 2.0 * np.abs(COEFFICIENTS)
            error = np.abs(coefficients(spectrum) - COEFFICIENTS[:4])
            for j in range(4):
                # |f''| of f = w e^{-i j a}, where w has the harmonics i: at most sum |c_i| (i + j)^2, in deg^-2.
                curved = np.sum(w * (k + k[j]) ** 2) - COEFFICIENTS[0].real * k[j] ** 2
                bound = steps.max() ** 2 / 12.0 * curved
                # The ends of the cycle lie between two samples, where the line is off by w'' step^2/8.
                bound += 2.0 * steps.max() ** 3 / 8.0 * np.sum(w[1:] * k[1:] ** 2) / 720.0
                assert error[j] <= bound + 1e-12
        errors.append(max(np.abs(coefficients(spectrum) - COEFFICIENTS[:4]).max() for _, spectrum in found))
    # Of the second order: a quarter for half the step, or better where errors cancel.
    assert errors[2] < errors[0] / 8.0


def test_the_mean_speed_is_that_of_the_time_of_the_cycle():
    angles = np.arange(0.0, 1441.0, 1.0)
    omega = 150.0 * (1.0 + 0.1 * np.sin(np.radians(2.0 * angles)))
    _, spectrum = spectra(angles, signal(angles), omega=omega)[-1]
    time = quad(lambda a: 1.0 / (150.0 * (1.0 + 0.1 * np.sin(2.0 * a))), 0.0, 4.0 * np.pi, limit=200)[0]
    assert spectrum.omega == pytest.approx(4.0 * np.pi / time, rel=1e-9)  # the trapezoidal rule of a periodic function


def test_a_cycle_with_a_step_that_is_too_long_or_goes_back_does_not_count_and_the_next_one_does():
    angles = np.arange(0.0, 720.0 * 5 + 1, 6.0)
    without = np.delete(angles, slice(130, 150))  # 120 deg of the second cycle
    assert [round(without[k]) for k, _ in spectra(without, signal(without))] == [2160, 2880, 3600]
    over_the_end = np.delete(angles, slice(230, 250))  # the end of the second and the begin of the third
    assert [round(over_the_end[k]) for k, _ in spectra(over_the_end, signal(over_the_end))] == [2880, 3600]
    back = np.insert(angles, 200, [1100.0, 1150.0])
    assert [round(back[k]) for k, _ in spectra(back, signal(back))] == [2160, 2880, 3600]
    # Backwards over an end and forward again: the end that comes again has no whole cycle, and begins one.
    rocking = np.insert(angles, 242, [1430.0, 1435.0])
    assert [k for k, _ in spectra(rocking, signal(rocking))] == [240, 362, 482, 602]


def test_an_origin_moves_where_cycles_begin_and_nothing_else():
    angles = np.arange(0.0, 2161.0, 6.0)
    (_, first), (_, moved) = (
        spectra(angles, signal(angles))[-1],
        spectra(angles + 90.0, signal(angles), origin=90.0)[-1],
    )
    np.testing.assert_allclose(coefficients(moved), coefficients(first), rtol=0, atol=1e-12)
    np.testing.assert_allclose(np.array(moved.means, float), np.array(first.means, float), rtol=0, atol=1e-12)


@settings(max_examples=200, deadline=None)
@given(st.floats(-2000, 2000), st.floats(0, 90), st.floats(-360, 360), st.floats(-5, 5), st.floats(-5, 5))
def test_what_a_step_passes_is_the_step_itself(begin, length, origin, at_begin, at_end):
    passed = pass_step(begin, begin + length, at_begin, at_end, origin)
    assert passed.before.length + passed.after.length == pytest.approx(length, abs=1e-9)
    whole = passed.before.integral() + passed.after.integral()
    assert whole == pytest.approx(length * (at_begin + at_end) / 2.0, abs=1e-5)
    assert bool(passed.ends) == bool(length > 0.0 and passes(begin, begin + length, origin))
    assert passed.before.end <= 720.0 and (passed.after.begin >= 0.0 or passed.after.length == 0.0)


def test_a_step_that_is_off_an_end_by_rounding_ends_the_cycle_once():
    ends = [bool(pass_step(a, b, 1.0, 1.0, 0.0).ends) for a, b in [(714.0, 720.0 - 1e-9), (720.0 - 1e-9, 726.0)]]
    assert ends == [True, False]
