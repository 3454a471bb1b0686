"""Exhaust to sensor: pulses that add up, mass and fuel conserved, mixing by fuel fraction, transfer functions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from exhaust_runs import MASS, T_EXH, Course, harmonic, parameters, run
from scipy.integrate import quad

from fmus.component import Signal
from fmus.exhaust_path import (
    Breathing,
    path_gain_and_phase,
    path_harmonics,
    path_response,
    profile_response,
    sensor_response,
)
from fmus.export import cached_fmu
from fmus.fmu import load_fmu
from fmus.jacobians import Point, jacobians, point
from fmus.model import FlatModel
from fmus.plants.exhaust_afr import CELLS, CYCLE, FIRING, MODEL, OUTPUTS, cell_mass, exhaust_profile
from fmus.tracing import Symbol
from fmus.turbocharger import turbine_pressure

P = parameters()
DEGREE = np.pi / 180.0
OUTPUT_NAMES = [signal.name for signal in OUTPUTS]
EQUAL = np.full(4, MASS)


def test_a_cylinder_exhausts_all_its_mass_between_its_valves_angles():
    inside = quad(lambda theta: float(exhaust_profile(theta, P)), P.EVO, P.EVC, epsabs=1e-13)[0]
    assert inside == pytest.approx(1.0, abs=1e-12)
    outside = np.concatenate([np.linspace(0.0, P.EVO, 50), np.linspace(P.EVC, CYCLE, 50)])
    assert (exhaust_profile(outside, P) == 0.0).all()
    # Turn after turn, backwards too.
    turned = exhaust_profile(np.radians(200.0) + CYCLE * np.arange(-3, 1000), P)
    np.testing.assert_allclose(turned, exhaust_profile(np.radians(200.0), P), rtol=1e-10)


@pytest.mark.parametrize(("opens", "closes"), [(135.0, 375.0), (140.3, 380.3), (500.0, 740.0), (130.0, 142.0)])
@pytest.mark.parametrize("step", [6.0, 4.0, 1.0])
def test_the_samples_of_a_cycle_add_up_to_one_exactly_wherever_they_fall(opens, closes, step):
    p = parameters(EVO=opens * DEGREE, EVC=closes * DEGREE)
    for offset in np.random.default_rng(3).uniform(0.0, step, 20):
        samples = exhaust_profile(np.arange(offset, 720.0, step) * DEGREE, p)
        # Every width here is two steps or more: roots of one add up to nothing. Sums of up to 720 terms.
        assert step * DEGREE * samples.sum() == pytest.approx(1.0, abs=1e-12)


def test_samples_of_a_width_that_is_no_multiple_of_the_step_miss_what_its_spectrum_says():
    p = parameters(EVC=P.EVO + 237.0 * DEGREE)
    for offset in (0.0, 1.7, 4.0):
        samples = exhaust_profile((offset + np.arange(0.0, 720.0, 6.0)) * DEGREE, p)
        # Poisson's sum: harmonics of the sampling, 60 per revolution. Ten of them, falling as 1/k^3.
        expected = 1.0
        for k in range(1, 11):
            gain, phase = profile_response(60.0 * k, p)
            expected += 2.0 * gain * np.cos(60.0 * k * offset * DEGREE + phase)
        assert 6.0 * DEGREE * samples.sum() == pytest.approx(expected, abs=1e-7)
        assert abs(expected - 1.0) < 1e-4


def test_the_cylinders_exhaust_one_after_the_other_in_firing_order():
    flat, x = FlatModel(MODEL), point(MODEL)
    theta = np.radians(np.arange(0.0, 720.0, 1.0))
    middles = []
    for cylinder in (1, 3, 4, 2):
        masses = [MASS if i == cylinder else 0.0 for i in (1, 2, 3, 4)]
        inputs = [[a, 100.0, *[20.0] * 4, *masses, T_EXH] for a in theta]
        outputs = [flat.derivatives_and_outputs(0.0, list(x.x), [], u, list(x.p))[1] for u in inputs]
        flow = [float(y[OUTPUT_NAMES.index("W_exh")]) for y in outputs]
        middles.append(np.angle(np.exp(0.5j * theta) @ flow) % (2.0 * np.pi) * 360.0 / np.pi)
        # The flow over time is the mass, at 100 rad/s.
        assert np.sum(flow) * DEGREE / 100.0 == pytest.approx(MASS, rel=1e-12)
    np.testing.assert_allclose(np.array(middles) - 255.0, [0.0, 180.0, 360.0, 540.0 - 720.0], atol=1e-9)


# What has gone in and out since the start, beside the plant's own equations.
LEDGER = tuple(Signal(f"{what}_{way}", "kg") for what in ("mass", "fuel") for way in ("in", "out"))


def with_ledger():
    """The plant with what enters and leaves it added up as further states."""

    def equations(t, x, m, u, p):
        dx, y = MODEL.equations(t, x, m, u, p)
        shares = [u[f"m_exh_{i}"] * u.omega_e * exhaust_profile(u.theta - FIRING[i], p) for i in (1, 2, 3, 4)]
        dx["mass_in"], dx["mass_out"] = y["W_exh"], y["W_turb"]
        dx["fuel_in"] = sum(share / (1.0 + u[f"afr_{i}"]) for i, share in zip((1, 2, 3, 4), shares, strict=True))
        dx["fuel_out"] = y["W_turb"] / (1.0 + y["afr_turbine"])
        return dx, y

    return replace(MODEL, name="exhaust_ledger", states=(*MODEL.states, *LEDGER), equations=equations)


@pytest.mark.parametrize("N", [800.0, 1500.0, 6000.0])
def test_mass_and_fuel_are_conserved_over_many_cycles_of_changing_cylinders(N):
    generator = np.random.default_rng(4)
    ratios, masses = generator.uniform(13.0, 30.0, (150, 4)), generator.uniform(2e-4, 9e-4, (150, 4))
    course = Course(N, cycles=150)
    y = run(course, lambda k: ratios[k], lambda k: masses[k], model=with_ledger())
    # RK4 keeps sums exactly: rounding of 2e4 steps' sums, each 1e-16 of the whole.
    scale = 1e-12 * y["mass_in"][-1]
    np.testing.assert_allclose(y["m_em"] - y["m_em"][0], y["mass_in"] - y["mass_out"], rtol=0.0, atol=scale)
    fuel = y["m_fuel"] + y["m_fuel_pipe"]
    np.testing.assert_allclose(fuel - fuel[0], y["fuel_in"] - y["fuel_out"], rtol=0.0, atol=scale)
    # Masses change at 0 deg, where the valves of cylinders 2 and 4 are open: they go on with what they are then told.
    n = course.per_cycle
    weights = np.array(
        [[exhaust_profile(np.radians(6.0 * k + 3.0) - FIRING[i], P) for i in (1, 2, 3, 4)] for k in range(n)]
    )
    entered = (masses @ weights.T * 6.0 * DEGREE).sum()
    assert y["mass_in"][-1] == pytest.approx(entered, rel=1e-12)


def test_in_each_cycle_exactly_the_mass_of_the_cylinders_goes_in():
    masses = (6.3e-4, 4.1e-4, 5e-4, 7.7e-4)
    y = run(Course(2500.0, cycles=50), (20.0,) * 4, masses, model=with_ledger())
    np.testing.assert_allclose(np.diff(y["mass_in"][::120]), sum(masses), rtol=1e-11)


def test_where_the_speed_swings_the_mass_of_a_cycle_is_right_but_for_half_a_steps_change_of_it():
    swing, step, m = 0.02, np.radians(6.0), MASS
    component = load_fmu(cached_fmu(with_ledger()))
    names, t, entered = [signal.name for signal in component.outputs], 0.0, []
    component.start(0.0, point(MODEL).u)
    for k in range(1, 361):
        # Speed over crank angle; a step takes the time of its mean and is given angle and speed of its end.
        theta = k * step
        mean = 150.0 * (1.0 + swing * np.sin(2.0 * (theta - 0.5 * step)) * np.sinc(step / np.pi))
        u = np.array([theta, 150.0 * (1.0 + swing * np.sin(2.0 * theta)), *[20.0] * 4, *[m] * 4, T_EXH])
        entered.append(component.step(t, step / mean, u)[names.index("mass_in")])
        t += step / mean
    component.close()
    found = (entered[359] - entered[239]) / (4.0 * m) - 1.0
    # The integral of f (omega - mean)/omega: half a step of 2 swing cos(2 theta), by the profile's transform.
    gain, phase = profile_response(2.0, P)
    assert found == pytest.approx(0.5 * step * 2.0 * swing * gain * np.cos(phase), abs=5e-5)
    assert abs(found) < 6e-4


@pytest.mark.parametrize("N", [800.0, 6000.0])
def test_four_equal_cylinders_show_exactly_their_air_fuel_ratio(N):
    shown = ("afr_manifold", "afr_turbine", "afr_lag", "afr_sensor")
    at_once = run(Course(N, cycles=20), (14.3,) * 4, starts={"afr_start": 14.3})
    for name in shown:
        # 1/(1/(1 + A)) - 1 rounds by an ulp or two.
        np.testing.assert_allclose(at_once[name], 14.3, rtol=1e-14)
    settled = run(Course(N, cycles=200), (14.3,) * 4, starts={"afr_start": 22.0})
    for name in shown:
        # Twenty time constants of 60 ms and more: 1e-9 of the change is left at most.
        assert settled[name][0] == pytest.approx(22.0, rel=1e-14)
        assert settled[name][-1] == pytest.approx(14.3, abs=1e-7)


def test_with_unequal_cylinders_the_mean_by_mass_of_the_fuel_fraction_comes_out():
    ratios, masses = np.array([15.0, 20.0, 24.0, 18.0]), np.array([7e-4, 5e-4, 6e-4, 4e-4])
    course = Course(1500.0, cycles=100)
    y = run(course, ratios, masses, model=with_ledger())
    cycle = course.per_cycle
    fuel, mass = (y[name][-1] - y[name][-1 - cycle] for name in ("fuel_out", "mass_out"))
    fraction = (masses / (1.0 + ratios)).sum() / masses.sum()
    # Periodic by then (1e-12), and what goes out in a cycle is what goes in.
    assert fuel / mass == pytest.approx(fraction, rel=1e-10)
    by_mass = 1.0 / fraction - 1.0
    # The sensor averages AFR over time, not fuel over the flow: 0.7 % beside it here; mixing AFRs would give 3.2 %.
    shown, mixed = y["afr_sensor"][-cycle:].mean(), (masses @ ratios) / masses.sum()
    assert shown == pytest.approx(by_mass, rel=1e-2) and mixed > by_mass * 1.03


def test_the_air_fuel_ratio_mixes_as_derived_and_as_published_to_first_order_only():
    generator, plant = np.random.default_rng(5), jacobians(MODEL)
    for spread in (1.0, 1e-2, 1e-4):
        ratios = 20.0 * (1.0 + 0.4 * spread * generator.uniform(-1.0, 1.0, 4))
        u = np.array([np.radians(290.0), 150.0, *ratios, *generator.uniform(4e-4, 8e-4, 4), T_EXH])
        A = 20.0 * (1.0 + 0.4 * spread * generator.uniform(-1.0, 1.0))
        start = point(MODEL)
        x = start.x.copy()
        x[1] = x[0] * (1.0 / (1.0 + A) - 1.0 / 21.0)
        dx, y = plant.values(start._replace(x=x, u=u))
        z = 1.0 / (1.0 + A)
        # dz/dt by the plant's own balances; z = m_fuel/m.
        slope = -((1.0 + A) ** 2) * (dx[1] + (1.0 / 21.0 - z) * dx[0]) / x[0]
        W = np.array([u[5 + i] * 150.0 * float(exhaust_profile(u[0] - FIRING[i], P)) for i in (1, 2, 3, 4)])
        rate = P.R_e * T_EXH / (y[OUTPUT_NAMES.index("p_em")] * P.V_em)
        derived = rate * (W * (1.0 + A) / (1.0 + ratios) * (ratios - A)).sum()
        published = rate * (W * (ratios - A)).sum()
        # Differences of fractions that agree to `spread`, each to rounding.
        assert slope == pytest.approx(derived, rel=1e-10 / spread)
        assert abs(published / derived - 1.0) < 2.0 * spread
        assert spread < 1.0 or abs(published / derived - 1.0) > 0.01


def at_rest(W: float) -> Point:
    """Where cylinder 1 alone exhausts W [kg/s] at a standing angle, and the manifold passes on as much, at AFR 20."""
    start = point(MODEL)
    theta = np.radians(200.0)  # Cylinder 1 alone has open valves here.
    masses = [W / (150.0 * float(exhaust_profile(theta, P))), 0.0, 0.0, 0.0]
    x = start.x.copy()
    x[0] = float(turbine_pressure(W, T_EXH, P.p_t, P)) * P.V_em / (P.R_e * T_EXH)
    return start._replace(x=x, u=np.array([theta, 150.0, *[20.0] * 4, *masses, T_EXH]))


@pytest.mark.parametrize("W", [0.005, 0.03, 0.12])
def test_linearised_mixing_pipe_and_lags_are_their_closed_transfer_functions(W):
    at = at_rest(W)
    linear = jacobians(MODEL).at(at)
    assert abs(linear.dx).max() < 1e-9 * W
    m, m_c = at.x[0], float(cell_mass(T_EXH, P))
    for omega in (0.0, 3.0, 78.5, 157.0, 235.6, 900.0):
        s = 1j * omega
        gains = linear.C @ np.linalg.solve(s * np.eye(len(at.x)) - linear.A, linear.B[:, 2]) + linear.D[:, 2]
        found = dict(zip(OUTPUT_NAMES, gains, strict=True))
        mixing = 1.0 / (1.0 + s * m / W)
        pipe = mixing / (1.0 + s * m_c / W) ** CELLS
        expected = {
            "afr_manifold": mixing,
            "afr_turbine": pipe,
            "afr_lag": pipe / (1.0 + s * P.tau_1),
            "afr_sensor": pipe / ((1.0 + s * P.tau_1) * (1.0 + s * P.tau_2)),
        }
        for name, gain in expected.items():
            # A chain of 14 states solved at once; rounding.
            assert abs(found[name] - gain) < 1e-11, name
        assert expected["afr_sensor"] / pipe == pytest.approx(sensor_response(1.0, omega, P), rel=1e-14)


def test_the_profiles_response_is_the_integral_of_the_profile():
    # At 0 and at 1.5 per revolution, where 240 deg are a whole period, one of the terms is 0/0.
    for order in (0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 7.3):

        def turned(a, order=order):
            return exhaust_profile(a, P) * np.exp(-1j * order * a)

        gain, phase = profile_response(order, P)
        expected = quad(turned, P.EVO, P.EVC, epsabs=1e-13, complex_func=True)[0]
        assert abs(gain * np.exp(1j * phase) - expected) < 1e-12


@pytest.mark.parametrize("N", [800.0, 1500.0, 3000.0, 6000.0])
def test_the_plants_harmonics_are_those_of_the_periodic_response(N):
    deviation, cylinder = 2e-4, 3
    course = Course(N, step=2.0, cycles=120)
    y = run(course, [20.0 + (deviation if i == cylinder else 0.0) for i in (1, 2, 3, 4)])
    G = path_harmonics(3, course.omega, EQUAL, T_EXH, P)
    for k in (1, 2, 3):
        w = harmonic(y["afr_turbine"], course.per_cycle, k) / deviation
        # Flow held over 2 deg: (k/2 x 2 deg)^2/24 is left of the hold and its aliases, 1e-5 k^2; the deviation's
        # square, 1e-5 of it.
        assert w == pytest.approx(G[cylinder - 1, k], rel=2e-4)
        shown = harmonic(y["afr_sensor"], course.per_cycle, k)
        # Between steps w is no sum of three harmonics; what the plant's rows miss of it is in higher ones.
        assert shown / (w * deviation) == pytest.approx(sensor_response(k / 2.0, course.omega, P), rel=1e-6)


@pytest.mark.parametrize("masses", [(6e-4, 5e-4, 4e-4, 7e-4)])
def test_unequal_exhausts_have_each_its_own_response(masses):
    course = Course(2000.0, step=2.0, cycles=120)
    deviations = np.array([1.0, -0.5, 0.7, -0.3]) * 2e-4
    y = run(course, 20.0 + deviations, masses)
    G = path_harmonics(3, course.omega, np.array(masses), T_EXH, P)
    for k in (0, 1, 2, 3):
        found = harmonic(y["afr_turbine"] - 20.0, course.per_cycle, k)
        assert abs(found - deviations @ G[:, k]) < 2e-4 * abs(deviations).max() * abs(G[:, k]).max()


@pytest.mark.parametrize("N", [800.0, 1000.0, 1500.0, 3000.0, 6000.0])
def test_the_closed_form_is_the_periodic_response_but_for_how_the_manifold_pulsates(N):
    omega, orders = N * np.pi / 30.0, np.array([0.5, 1.0, 1.5])
    closed = path_response(orders, Breathing(omega, MASS, T_EXH), P)
    exact = path_harmonics(3, omega, EQUAL, T_EXH, P)[0, 1:]
    missed = abs(closed / exact - 1.0)
    # Pressure pulsates by 5 to 9 %, and the flow three times as much. Measured: 4.1, 16 and 39 % at 800 rpm, 1.6, 5.3
    # and 9.8 % at 1500 rpm, 0.2, 0.5 and 3.2 % at 6000 rpm.
    assert (missed < np.array([0.045, 0.17, 0.42])).all()
    assert N < 1500.0 or (missed < np.array([0.02, 0.06, 0.11])).all()
    # The larger the manifold, the less it pulsates, in proportion.
    distances = []
    for V in (8e-3, 16e-3, 32e-3):
        larger = parameters(V_em=V)
        exact = path_harmonics(1, omega, EQUAL, T_EXH, larger)[0, 1]
        distances.append(abs(path_response(0.5, Breathing(omega, MASS, T_EXH), larger) / exact - 1.0))
    assert distances[2] < 0.6 * distances[1] < 0.36 * distances[0] and distances[2] < 6e-3


def test_at_order_zero_each_of_four_equal_cylinders_has_a_quarter():
    gain, phase = path_gain_and_phase(0.0, Breathing(150.0, MASS, T_EXH), P)
    assert gain == 0.25 and phase == 0.0
    G = path_harmonics(0, 150.0, EQUAL, T_EXH, P)
    np.testing.assert_allclose(G[:, 0], 0.25, rtol=1e-12)


def test_the_closed_form_takes_symbols():
    import casadi as ca

    speed = ca.SX.sym("speed")
    gain, phase = path_gain_and_phase(0.5, Breathing(Symbol(speed), MASS, T_EXH), P)
    values = ca.Function("path", [speed], [gain.sx, phase.sx])(157.0)
    expected = path_gain_and_phase(0.5, Breathing(157.0, MASS, T_EXH), P)
    np.testing.assert_allclose([float(value) for value in values], expected, rtol=1e-14)


@pytest.mark.parametrize(("held", "late"), [(0.0, 0.5), (1.0, -0.5)])
def test_an_angle_held_from_the_steps_beginning_is_half_a_step_late_and_from_its_end_early(held, late):
    course = Course(1500.0, cycles=120, held=held)
    y = run(course, (20.0002, 20.0, 20.0, 20.0))
    G = path_harmonics(3, course.omega, EQUAL, T_EXH, P)[0]
    for k in (1, 2, 3):
        shifted = G[k] * np.exp(-0.5j * k * late * 6.0 * DEGREE)
        # (k/2 x 6 deg)^2/24 of the hold and its aliases, 1e-4 k^2.
        assert harmonic(y["afr_turbine"], 120, k) / 2e-4 == pytest.approx(shifted, rel=1.5e-3)


def test_an_aged_sensor_is_later_by_its_own_time_constants():
    course = Course(1500.0, cycles=120)
    fresh, aged = (run(course, (16.0, 20.0, 20.0, 20.0), starts={"tau_1": tau}) for tau in (0.025, 0.060))
    np.testing.assert_array_equal(fresh["afr_turbine"], aged["afr_turbine"])
    for k in (1, 2):
        ratio = harmonic(aged["afr_sensor"], 120, k) / harmonic(fresh["afr_sensor"], 120, k)
        s = 0.5j * k * course.omega
        assert ratio == pytest.approx((1.0 + 0.025 * s) / (1.0 + 0.060 * s), rel=1e-4)


def test_air_alone_is_shown_as_the_most_the_sensor_tells_apart():
    y = run(Course(1500.0, cycles=150), (1e9,) * 4)
    assert np.isfinite(y["afr_sensor"]).all()
    assert y["afr_sensor"][-1] == pytest.approx(1000.0, rel=1e-3) and (y["m_fuel"] > -1e-15).all()


def test_a_standing_engine_blows_down_to_the_pressure_after_the_turbine_and_stays_there():
    step = Course(6.0, step=6.0, cycles=3)  # 20 s a cycle
    y = run(step, (20.0,) * 4, (0.0,) * 4)
    assert y["p_em"][-1] == pytest.approx(P.p_t, rel=1e-6) and y["W_turb"][-1] < 1e-6
    assert (y["p_em"] >= P.p_t * (1.0 - 1e-9)).all()
