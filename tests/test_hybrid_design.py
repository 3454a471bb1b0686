"""The design of observers for hybrid plants: sampling, classes, Eq. 9 and Proposition 3.3.1 against themselves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from fmus.component import Signal
from fmus.hybrid import Automaton, Location, Transition
from fmus.model import ModelError
from observers import hybrid
from observers.affine import advance, error_matrix, overshoot, place, pole_pattern, sample_observer, spectral_abscissa
from observers.bank import nominal_automaton
from observers.convergence import design_gains, error_bound
from observers.residuals import design_signatures, settling_abscissa, signature_classes

PLANT = "fmus.plants.driveline"
DRIVELINE = nominal_automaton(PLANT, None, None)
BOUNDS = {"theta_e": "0.12 rad", "omega_c": "70 rad/s", "omega_p": "10 rad/s", "T_eng": "30 N.m"}
DEMANDS = {"delay": 0.02, "dwell": 0.1, "rate": 5.0, "threshold": "0.005 rpm", "entry_error": 15.0, "bounds": BOUNDS}
LARGEST = ((0.12, 70.0, 10.0), (30.0,))
FASTEST = 2000.0


def two_tanks(second_drift: float) -> Automaton:
    """Two locations with the same A, B, C that differ in the drift of the measured state."""
    A, B, C = np.array([[-1.0, 0.0], [1.0, -2.0]]), np.array([[1.0], [0.0]]), np.array([[1.0, 0.0], [0.0, 1.0]])
    states = (Signal("level_a", "m"), Signal("level_b", "m"))
    locations = (Location(A, B, C, np.zeros(2)), Location(A, B, C, np.array([second_drift, 0.0])))
    edges = (Transition(1, 2, np.array([1.0, 0.0]), -1.0), Transition(2, 1, np.array([-1.0, 0.0]), 1.0))
    outputs = (Signal("y_a", "m"), Signal("y_b", "m"))
    return Automaton(states, (Signal("inflow", "m/s"),), outputs, locations, edges)


@pytest.mark.parametrize("automaton", [DRIVELINE, two_tanks(0.3)], ids=["driveline", "two outputs"])
def test_the_sampled_observer_is_the_integrated_one(automaton):
    generator = np.random.default_rng(3)
    n, m, p = len(automaton.states), len(automaton.inputs), len(automaton.outputs)
    location, h = automaton.locations[1], 1e-3
    gain = place(location, automaton.scales, -80.0)
    sampled = sample_observer(location, gain, h)
    x, u = generator.normal(size=n) * automaton.scales, generator.normal(size=m)
    before, now = generator.normal(size=p), generator.normal(size=p)

    def derivative(t, state):
        y = before + (now - before) * t / h
        return location.A @ state + location.B @ u + location.E + gain @ (y - location.C @ state)

    wanted = solve_ivp(derivative, (0.0, h), x, rtol=1e-12, atol=1e-14).y[:, -1]
    # Both are exact but for rounding and the integrator's 1e-12, relative to the state's scale.
    np.testing.assert_allclose(
        advance(sampled, x, u, before, now) / automaton.scales, wanted / automaton.scales, rtol=1e-9
    )


@pytest.mark.parametrize("order", [1, 2, 3, 4])
def test_the_pole_pattern_is_real_distinct_and_has_abscissa_minus_one(order):
    poles = pole_pattern(order)
    np.testing.assert_allclose(np.poly(poles).imag, 0.0, atol=1e-12)
    np.testing.assert_allclose(poles.real, -1.0)
    assert len(np.unique(poles)) == order


@pytest.mark.parametrize("abscissa", [-5.0, -100.0, -1500.0])
@pytest.mark.parametrize("number", [1, 2])
def test_placed_poles_are_where_they_were_wanted(abscissa, number):
    location = DRIVELINE.locations[number - 1]
    gain = place(location, DRIVELINE.scales, abscissa)
    got = np.linalg.eigvals(location.A - gain @ location.C)
    wanted = -abscissa * pole_pattern(3)
    # Eigenvalues of a matrix with condition number 1e5 in scaled coordinates: 1e-6 relative is far above rounding.
    np.testing.assert_allclose(got[np.argsort(got.imag)], wanted, rtol=1e-6)


def test_an_unobservable_location_is_refused_with_its_mode():
    free_play = nominal_automaton(PLANT, {"k": "0 N.m/rad"}, None)
    with pytest.raises(ModelError, match=r"location 2: not observable: the mode with eigenvalue"):
        design_gains(free_play, 5.0, 0.1, 0.02, FASTEST)


def test_the_overshoot_bounds_the_matrix_exponential():
    location = DRIVELINE.locations[1]
    matrix = error_matrix(location, place(location, DRIVELINE.scales, -60.0), DRIVELINE.scales)
    for t in np.linspace(0.0, 0.2, 50):
        bound = overshoot(matrix) * np.exp(spectral_abscissa(matrix) * t)
        assert np.linalg.norm(expm(matrix * t), 2) <= bound


def test_locations_one_and_three_of_the_driveline_share_a_signature():
    assert signature_classes(DRIVELINE) == ((1, 3), (2,))


@pytest.mark.parametrize(("drift", "classes"), [(0.3, ((1,), (2,))), (0.0, ((1, 2),))])
def test_constant_terms_that_the_residual_shows_make_classes_of_their_own(drift, classes):
    assert signature_classes(two_tanks(drift)) == classes


def test_an_invisible_constant_term_leaves_no_residual_and_a_visible_one_does():
    for automaton, visible in ((DRIVELINE, False), (two_tanks(0.3), True)):
        one, other = automaton.locations[0], automaton.locations[-1]
        gain = place(other, automaton.scales, -50.0)
        settled = other.C @ np.linalg.solve(other.A - gain @ other.C, one.E - other.E)
        # 1e-9 of the outputs' unit: rounding of terms of order 1e3.
        assert bool(np.linalg.norm(settled) > 1e-9) is visible


def test_after_the_delay_the_right_residual_is_within_the_threshold():
    delay, threshold, entry_error = 0.02, 0.005, 15.0
    scales = DRIVELINE.scales
    for signature in design_signatures(DRIVELINE, delay, (threshold,), entry_error, FASTEST):
        location = signature.location
        matrix = error_matrix(location, signature.gain, scales)
        assert signature.abscissa <= settling_abscissa(
            location, signature.gain, scales, delay, (threshold,), entry_error
        )
        for t in delay + np.linspace(0.0, 0.1, 40):
            assert np.linalg.norm((location.C * scales) @ expm(matrix * t), 2) * entry_error <= threshold


def test_slower_poles_than_those_chosen_miss_equation_nine():
    delay, threshold, entry_error = 0.02, 0.005, 15.0
    for signature in design_signatures(DRIVELINE, delay, (threshold,), entry_error, FASTEST):
        gain = place(signature.location, DRIVELINE.scales, 0.99 * signature.abscissa)
        bound = settling_abscissa(signature.location, gain, DRIVELINE.scales, delay, (threshold,), entry_error)
        assert 0.99 * signature.abscissa > bound


def test_the_gains_give_the_rate_demanded_over_a_dwell_time():
    rate, dwell, delay = 5.0, 0.1, 0.02
    for location, gain in zip(DRIVELINE.locations, design_gains(DRIVELINE, rate, dwell, delay, FASTEST), strict=True):
        matrix = error_matrix(location, gain, DRIVELINE.scales)
        assert np.linalg.norm(expm(matrix * (dwell - delay)), 2) <= np.exp(-rate * dwell) / 2.0


def test_the_published_bound_is_equation_twenty():
    rate, dwell, delay = 5.0, 0.1, 0.02
    gains = design_gains(DRIVELINE, rate, dwell, delay, FASTEST)
    got = error_bound(DRIVELINE, gains, *LARGEST, rate, dwell, delay)
    by_hand = []
    for number, gain in enumerate(gains, start=1):
        matrix = error_matrix(DRIVELINE.locations[number - 1], gain, DRIVELINE.scales)
        # A_i - A_j = +-(k_1 - k) (0, -tau/J_e, 1/J_v) (1, 0, 0); scaled, the largest row is the wheel's or the crank's.
        row = 3500.0 * 0.01 * max(0.125 / 0.15 / 1.0, 1.0 / 80.0 / 0.1)
        largest = max(0.12 / 0.01, 70.0 / 1.0, 10.0 / 0.1)
        by_hand.append(overshoot(matrix) * row * largest * delay / (1.0 - np.exp(spectral_abscissa(matrix) * dwell)))
    assert got.published == pytest.approx(max(by_hand), rel=1e-9)


def test_at_the_edge_of_the_ball_the_rate_does_not_hold_and_from_the_rate_radius_on_it_does():
    rate, dwell, delay = 5.0, 0.1, 0.02
    gains = design_gains(DRIVELINE, rate, dwell, delay, FASTEST)
    bound = error_bound(DRIVELINE, gains, *LARGEST, rate, dwell, delay)
    # The middle location, left for locations with larger |x|, decides all radii.
    matrix = error_matrix(DRIVELINE.locations[1], gains[1], DRIVELINE.scales)
    free, decay = overshoot(matrix), np.exp(spectral_abscissa(matrix) * (dwell - delay))

    def after_a_dwell(radius: float) -> float:
        return free * decay * radius + free * bound.drive * delay

    demanded = np.exp(-rate * dwell)
    assert after_a_dwell(bound.ball) == pytest.approx(bound.ball)
    assert after_a_dwell(bound.ball) > demanded * bound.ball
    assert after_a_dwell(bound.rate_radius) == pytest.approx(demanded * bound.rate_radius)
    assert after_a_dwell(2.0 * bound.rate_radius) < demanded * 2.0 * bound.rate_radius
    assert bound.ball < bound.rate_radius
    unhurried = error_bound(DRIVELINE, gains, *LARGEST, 0.0, dwell, delay)
    assert unhurried.rate_radius == pytest.approx(unhurried.ball)


def test_the_errors_of_late_detections_stay_inside_the_sharp_and_the_corrected_bound():
    """Plant 3 -> 2 -> 3 ... every D, found Delta late; error by the exact piecewise solution."""
    rate, dwell, delay, h = 5.0, 0.1, 0.02, 1e-3
    gains = design_gains(DRIVELINE, rate, dwell, delay, FASTEST)
    bound = error_bound(DRIVELINE, gains, *LARGEST, rate, dwell, delay, guard_speed=100.0)
    scales, threshold = DRIVELINE.scales, -0.01
    theta = lambda t: threshold - 0.012 * np.sin(np.pi * t / dwell)  # noqa: E731
    error, largest = np.zeros(3), 0.0
    for k in range(2000):
        t = (k + 0.5) * h
        truth = 2 if theta(t) < threshold else 3
        believed = 2 if theta(t - delay) < threshold else 3
        there, here = DRIVELINE.locations[truth - 1], DRIVELINE.locations[believed - 1]
        x = np.array([theta(t), 0.0, 0.0])
        drive = ((there.A - here.A) @ x + there.E - here.E) / scales
        matrix = error_matrix(here, gains[believed - 1], scales)
        block = np.zeros((4, 4))
        block[:3, :3], block[:3, 3] = matrix, drive
        error = (expm(block * h) @ np.append(error, 1.0))[:3]
        largest = max(largest, float(np.linalg.norm(error)))
    assert 0.0 < largest <= bound.sharp_peak <= bound.peak
    assert bound.sharp <= bound.ball <= bound.published


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"delay": 0.1}, r"dwell wants a time above the delay 0.1 s"),
        ({"delay": 1e-3}, r"location 3: a delay of 0.001 s .* cannot be met with poles up to 2000 1/s"),
        ({"rate": 0.0}, r"rate wants a value above 0"),
        ({"threshold": "1 N.m"}, r"threshold wants rpm, got 1 N.m"),
        ({"threshold": "0 rpm"}, r"threshold wants a value above 0"),
        ({"parameters": {"k2": "5000 N.m/rad"}}, r"no parameter is named 'k2'; did you mean"),
        ({"parameters": {"k": "5000 N.m"}}, r"k wants N.m/rad, got 5000 N.m"),
        ({"start": {"theta": "1 mrad"}}, r"no state is named 'theta'; did you mean 'theta_e'"),
        ({"bounds": {"theta_e": "0.1 rad"}}, r"bounds want the largest deviation of omega_c, omega_p, T_eng too"),
        ({"parameter_set": "wide"}, r"did you mean 'wide_gap'"),
        ({"plant": "fmus.plants.nothing"}, r"plant wants a module, got 'fmus.plants.nothing'"),
        ({"initial_location": 4}, r"initial_location wants 0 \(unknown\) to 3, got 4"),
        ({"sample_time": 0.0}, r"sample_time wants a value above 0 s"),
    ],
)
def test_demands_that_cannot_be_met_are_refused_in_words(change, message):
    with pytest.raises(ModelError, match=message):
        hybrid.make(**{"plant": PLANT, **DEMANDS, **change})


def test_an_automaton_refuses_pieces_that_do_not_fit():
    location = replace(DRIVELINE.locations[0], E=np.zeros(2))
    with pytest.raises(ModelError, match=r"location 1: E wants shape \(3,\), got \(2,\)"):
        replace(DRIVELINE, locations=(location,))
    with pytest.raises(ModelError, match="a transition wants locations 1 to 3, got 4"):
        replace(DRIVELINE, transitions=(Transition(1, 4, np.zeros(3), 0.0),))
