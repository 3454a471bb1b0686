"""The rod: base excitation by three ways of solving it, its transfer function, and what the printed equation says."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from exhaust_runs import Course
from scipy.integrate import solve_ivp
from scipy.signal import cont2discrete

from fmus.export import cached_fmu
from fmus.fmu import load_fmu
from fmus.jacobians import jacobians, point
from fmus.model import FlatModel
from fmus.plants.rod import MODEL, PARAMETERS, rod_response

P = SimpleNamespace(**{signal.name: float(signal.start) for signal in PARAMETERS})
SPEED = 157.0
# Orders and complex amplitudes [rad/s] of a speed with everything in it that a cycle has, near the resonance too.
SWING = {0.5: 0.3 - 0.2j, 1.0: 0.1j, 2.0: 4.0 - 1.0j, 4.0: 0.8 + 0.5j, 4.5: 0.2, 6.0: 0.3j, 8.0: 0.1}


def swinging(alpha, derivative=0):
    """SPEED + sum of Re(c exp(i k alpha)), or a derivative of it by alpha."""
    value = SPEED if derivative == 0 else 0.0
    return value + sum(((1j * k) ** derivative * c * np.exp(1j * k * alpha)).real for k, c in SWING.items())


def shaken(course: Course, xi: float = P.xi, order: float = P.order, amplitude: float = 1.0):
    """Speeds at the cylinders and at the rod's end, each step exactly `course.step` of crank angle."""
    component = load_fmu(cached_fmu(MODEL), starts={"xi": xi, "order": order, "omega_rod": course.omega})
    step, t, given, found = np.radians(course.step), 0.0, [], []
    try:
        component.start(0.0, np.array([SPEED]))
        for k in range(course.per_cycle * course.cycles):
            shape = (swinging((k + course.held) * step) - SPEED) * amplitude / SPEED
            u = course.omega * (1.0 + shape)
            h = step / u
            found.append(float(component.step(t, h, np.array([u]))[0]))
            given.append(u)
            t += h
    finally:
        component.close()
    return np.array(given), np.array(found)


def coefficient(signal, per_cycle, order):
    alpha = np.arange(1 - per_cycle, 1) * 4.0 * np.pi / per_cycle
    return np.mean(signal[-per_cycle:] * np.exp(-1j * order * alpha))


def test_without_a_derivative_of_the_input_it_is_base_excitation_in_crank_angle():
    flat, p = FlatModel(MODEL), list(point(MODEL).p)

    def model(t, state):
        x2 = swinging(state[2])
        dx, _ = flat.derivatives_and_outputs(t, list(state[:2]), [], [x2], p)
        return [*map(float, dx), x2]

    def excited(alpha, state):
        x1, slope = state
        damping = 2.0 * P.xi * P.order
        return [slope, -damping * (slope - swinging(alpha, 1)) - P.order**2 * (x1 - swinging(alpha))]

    ours = solve_ivp(model, (0.0, 0.4), [150.0, 2.0, 0.0], method="DOP853", rtol=1e-11, atol=1e-11, dense_output=True)
    alphas = ours.y[2]
    slope = 2.0 + 2.0 * P.xi * P.order * (swinging(0.0) - 150.0)
    other = solve_ivp(
        excited, (0.0, alphas[-1]), [150.0, slope], method="DOP853", rtol=1e-11, atol=1e-11, t_eval=alphas
    )
    # 60 rad, and the integrators' tolerance of 1e-9 of 150 rad/s.
    np.testing.assert_allclose(ours.y[0], other.y[0], rtol=0.0, atol=1e-6)


@pytest.mark.parametrize("N", [800.0, 1500.0, 6000.0])
@pytest.mark.parametrize(("xi", "order"), [(0.15, 5.0), (0.05, 2.5), (0.6, 9.375)])
def test_linearised_it_is_its_closed_transfer_function(N, xi, order):
    omega = N * np.pi / 30.0
    p = SimpleNamespace(xi=xi, order=order)
    at = point(MODEL, {"xi": xi, "order": order, "omega_e": omega, "omega_rod": omega})
    linear = jacobians(MODEL).at(at)
    assert abs(linear.dx).max() == 0.0
    for k in (0.0, 0.5, 1.0, 2.0, 4.5, order, 8.0, 30.0):
        found = np.linalg.solve(1j * k * omega * np.eye(2) - linear.A, linear.B[:, 0])[0]
        assert found == pytest.approx(rod_response(k, p), rel=1e-11)


@pytest.mark.parametrize("N", [800.0, 1500.0, 6000.0])
def test_its_samples_are_those_of_its_exact_discrete_form_at_any_swing_of_the_speed(N):
    course = Course(N, cycles=30)
    u, y = shaken(course, amplitude=5.0)
    w, damping = P.order, 2.0 * P.xi * P.order
    A, B = np.array([[-damping, 1.0], [-(w**2), 0.0]]), np.array([[damping], [w**2]])
    Ad, Bd, *_ = cont2discrete((A, B, np.eye(2), np.zeros((2, 1))), np.radians(course.step), method="zoh")
    x, expected = np.array([course.omega, 0.0]), []
    for value in u:
        x = Ad @ x + Bd[:, 0] * value
        expected.append(x[0])
    # RK4 within steps of 0.4 to 2 deg, 1e-5 of a swing of 20 % at 6000 rpm.
    assert abs(y - expected).max() < 2e-5 * np.ptp(u)


@pytest.mark.parametrize("N", [800.0, 1500.0, 6000.0])
def test_each_harmonic_passes_by_the_closed_transfer_function(N):
    course = Course(N, step=1.0, cycles=20)
    u, y = shaken(course)
    n, step = course.per_cycle, np.radians(course.step)
    for order in SWING:
        # u is held over each step, whose end the row shows; with it come the aliases at 360 m per revolution.
        heard = order + 360.0 * np.arange(-2000, 2001)
        hold = np.sinc(0.5 * heard * step / np.pi) * np.exp(0.5j * heard * step)
        expected = (rod_response(heard, P) * hold).sum()
        ratio = coefficient(y, n, order) / coefficient(u, n, order)
        # RK4 in steps of 1 deg and less; twenty cycles from the start.
        assert ratio == pytest.approx(expected, rel=1e-5), order
        assert expected == pytest.approx(rod_response(order, P) * np.exp(0.5j * order * step), rel=2e-3)


def test_at_a_steady_speed_it_shows_that_speed_exactly():
    component = load_fmu(cached_fmu(MODEL), starts={"omega_rod": 300.0})
    rows = [component.start(0.0, np.array([300.0]))[0]]
    rows += [component.step(k * 1e-3, 1e-3, np.array([300.0]))[0] for k in range(100)]
    component.close()
    assert set(rows) == {300.0}


@pytest.mark.parametrize("excitation", ["still", "periodic", "noise"])
def test_by_the_printed_equation_the_difference_dies_out_whatever_the_cylinders_do(excitation):
    """(x1-x2)'' + 2 xi w (x1-x2)' + w^2 (x1-x2) = 0, solved for x1'' = x2'' - 2 xi w (x1'-x2') - w^2 (x1-x2)."""
    noise = np.random.default_rng(8).normal(size=(3, 40))

    def x2(alpha, derivative=0):
        if excitation == "still":
            return SPEED if derivative == 0 else 0.0
        if excitation == "periodic":
            return swinging(alpha, derivative)
        orders = np.linspace(0.13, 11.7, 40)  # of no common period
        wave = (1j * orders) ** derivative * (noise[0] + 1j * noise[1]) * np.exp(1j * orders * alpha)
        return float(wave.real.sum())

    w, damping = P.order, 2.0 * P.xi * P.order

    def printed(alpha, state):
        x1, slope = state
        return [slope, x2(alpha, 2) - damping * (slope - x2(alpha, 1)) - w**2 * (x1 - x2(alpha))]

    alphas = np.linspace(0.0, 4.0 * np.pi, 200)
    begin = [x2(0.0) + 3.0, x2(0.0, 1) - 1.0]
    run = solve_ivp(printed, (0.0, alphas[-1]), begin, method="DOP853", rtol=1e-11, atol=1e-11, t_eval=alphas)
    decay, free = P.xi * w, w * np.sqrt(1.0 - P.xi**2)
    expected = np.exp(-decay * alphas) * (
        3.0 * np.cos(free * alphas) + (3.0 * decay - 1.0) / free * np.sin(free * alphas)
    )
    # The same free decay in all three, to the integrator's tolerance; 1e-4 of it is left after a cycle.
    np.testing.assert_allclose(run.y[0] - [x2(a) for a in alphas], expected, rtol=0.0, atol=1e-7)
    assert abs(expected[-1]) < 1e-3


@pytest.mark.parametrize("order", [0.5, 2.0, 4.0, 6.0])
def test_the_printed_matrix_gives_back_the_measured_coefficients_as_those_of_the_cylinders(order):
    w, damping = P.order, 2.0 * P.xi * P.order
    alpha = np.linspace(0.0, 4.0 * np.pi, 720, endpoint=False)
    cosine, sine = np.cos(order * alpha), np.sin(order * alpha)
    measured = np.array([0.7, -0.4])
    x1 = measured[0] * cosine + measured[1] * sine
    slope = order * (measured[1] * cosine - measured[0] * sine)
    # The w_0 by which the paper's second equation makes this x1, in coefficients of cosine and sine.
    w_0 = -(order**2) * x1 + damping * slope + w**2 * x1
    shown = 2.0 * np.array([np.mean(w_0 * cosine), np.mean(w_0 * sine)])
    printed = np.array([[w**2 - order**2, order * damping], [-order * damping, w**2 - order**2]])
    # "The coefficients of x_2": x1's own.
    np.testing.assert_allclose(np.linalg.solve(printed, shown), measured, rtol=1e-12)
    # Behind the rod of the plant the cylinders' are others.
    assert abs(1.0 / rod_response(order, P) - 1.0) > 0.005


def test_the_coefficients_at_the_cylinders_come_from_the_excitation_over_w_squared_and_the_damping():
    k = np.array([0.5, 1.0, 2.0, 4.0, 5.0, 8.0])
    damped = 2j * P.xi * P.order * k
    x1 = 1.3 - 0.2j
    excitation = (P.order**2 - k**2 + damped) * x1
    np.testing.assert_allclose(excitation / (P.order**2 + damped), x1 / rod_response(k, P), rtol=1e-13)
