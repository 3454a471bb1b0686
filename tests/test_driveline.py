"""The driveline plant against the paper's own formulas, scipy with events, and the energy balance."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp

from fmus.model import FlatModel
from fmus.plants.driveline import MODEL, PARAMETER_SETS, automaton, elastic_torque

DEFAULTS = {signal.name: float(signal.start) for signal in MODEL.parameters}
SETS = {"default": DEFAULTS, **{name: {**DEFAULTS, **values} for name, values in PARAMETER_SETS.items()}}
FLAT = FlatModel(MODEL)


def published_torque(x1: float, p: SimpleNamespace) -> float:
    """f(x1) as printed in Section 2 (for theta_e0 > theta_1)."""
    if x1 + p.theta_e0 < -p.theta_1:
        return p.k_1 * x1 + 2.0 * (p.k_1 - p.k) * p.theta_1
    if x1 + p.theta_e0 > p.theta_1:
        return p.k_1 * x1
    return p.k * x1 - (p.k_1 - p.k) * (p.theta_e0 - p.theta_1)


def location_at(theta_e: float, p: SimpleNamespace) -> int:
    """The location that the torsion deviation lies in."""
    return 1 + (theta_e + p.theta_e0 > -p.theta_1) + (theta_e + p.theta_e0 > p.theta_1)


def simulate(torque: float, stop: float, parameters: dict[str, float]) -> tuple[np.ndarray, np.ndarray, list[int]]:
    """Times (n,), states (3, n) and visited locations of the model's own functions under scipy with events."""
    p = list(parameters.values())
    x, m, t = [0.0, 0.0, 0.0], [3.0], 0.0
    times, states, visited = [0.0], [np.array(x)], [3]

    def indicator(index: int, sign: float):
        def event(time, state):
            return FLAT.indicators(time, list(state), m, [torque], p)[index]

        event.terminal, event.direction = True, sign
        return event

    above = [1.0, 1.0]
    while t < stop:
        events = [indicator(i, -1.0 if above[i] else 1.0) for i in range(2)]

        def derivative(time, state, m=m):
            return FLAT.derivatives_and_outputs(time, list(state), m, [torque], p)[0]

        run = solve_ivp(derivative, (t, stop), x, events=events, rtol=1e-10, atol=1e-13, max_step=1e-2)
        times += list(run.t[1:])
        states += list(run.y.T[1:])
        t, x = run.t[-1], list(run.y[:, -1])
        crossed = [i for i in range(2) if len(run.t_events[i])]
        for i in crossed:
            above[i] = 1.0 - above[i]
        if crossed:
            x, m = FLAT.transition(t, x, m, [torque], p, above)
            visited.append(int(m[0]))
    return np.array(times), np.array(states).T, visited


@pytest.mark.parametrize("name", SETS)
def test_the_elastic_torque_is_the_published_one_in_every_location(name):
    p = SimpleNamespace(**SETS[name])
    for x1 in np.linspace(-0.12, 0.05, 341):
        ours = float(elastic_torque(x1, location_at(x1, p), p))
        # Sums of terms up to 1e3 N.m in another order: a few ulps of 1e3.
        assert ours == pytest.approx(published_torque(x1, p), abs=1e-11)


@pytest.mark.parametrize("theta_e0", [0.025, 0.0, -0.03])
def test_the_elastic_torque_is_continuous_and_zero_at_the_equilibrium(theta_e0):
    p = SimpleNamespace(**{**DEFAULTS, "theta_e0": theta_e0})
    for threshold, (below, above) in ((-p.theta_1, (1, 2)), (p.theta_1, (2, 3))):
        x1 = threshold - theta_e0
        assert float(elastic_torque(x1, below, p)) == pytest.approx(float(elastic_torque(x1, above, p)), abs=1e-11)
    assert float(elastic_torque(0.0, location_at(0.0, p), p)) == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("name", SETS)
def test_the_automaton_has_the_equations_of_the_model(name):
    parameters = SETS[name]
    pieces = automaton(parameters)
    generator = np.random.default_rng(1)
    for number, location in enumerate(pieces.locations, start=1):
        for _ in range(20):
            x, u = generator.normal(size=3) * pieces.scales, generator.normal(size=1) * 10.0
            dx, y = FLAT.derivatives_and_outputs(0.0, list(x), [float(number)], list(u), list(parameters.values()))
            # Same sums in another order: relative rounding of the largest terms.
            np.testing.assert_allclose(location.A @ x + location.B @ u + location.E, dx, rtol=1e-9, atol=1e-10)
            np.testing.assert_allclose(location.C @ x, y, rtol=1e-14)


def test_the_automaton_has_the_published_constant_terms():
    p = SimpleNamespace(**DEFAULTS)
    carried = np.array([0.0, -p.tau / p.J_e, 1.0 / p.J_v])
    one, two, three = (location.E for location in automaton(DEFAULTS).locations)
    np.testing.assert_allclose(one, 2.0 * (p.k_1 - p.k) * p.theta_1 * carried, rtol=1e-12)
    np.testing.assert_allclose(two, -(p.k_1 - p.k) * (p.theta_e0 - p.theta_1) * carried, rtol=1e-12)
    np.testing.assert_allclose(three, 0.0, atol=1e-12)


def test_guards_change_sign_where_the_indicators_do():
    p = list(DEFAULTS.values())
    for edge in automaton(DEFAULTS).transitions:
        index = 0 if {edge.source, edge.target} == {1, 2} else 1
        for theta in (-0.05, -0.04, -0.02, -0.01, 0.01):
            z = FLAT.indicators(0.0, [theta, 0.0, 0.0], [2.0], [0.0], p)[index]
            guard = edge.normal @ np.array([theta, 0.0, 0.0]) + edge.offset
            assert guard == pytest.approx(z if edge.target > edge.source else -z, abs=1e-15)


def test_a_step_of_minus_ten_reaches_both_published_thresholds_and_settles_between():
    times, states, visited = simulate(-10.0, 3.0, DEFAULTS)
    assert visited[:3] == [3, 2, 1]
    assert visited[-1] == 2
    assert states[0].min() < -0.040
    # The last location holds from well before the end.
    settled = states[0][times > 2.0]
    assert settled.max() < -0.010 and settled.min() > -0.040


@pytest.mark.parametrize("torque", [-10.0, 6.0])
def test_stored_energy_equals_work_done_minus_losses(torque):
    """J_e w_c^2/2 + J_v w_p^2/2 + integral of f = integral of (T w_c - B_e w_c^2 - b_sm slip^2)."""
    p = SimpleNamespace(**DEFAULTS)
    times, (theta, omega_c, omega_p), _ = simulate(torque, 1.0, DEFAULTS)
    slip = p.tau * omega_c - omega_p
    power = torque * omega_c - p.B_e * omega_c**2 - p.b_sm * slip**2
    supplied = np.interp(
        1.0, times, np.concatenate([[0.0], np.cumsum(np.diff(times) * (power[1:] + power[:-1]) / 2.0)])
    )
    kinks = [
        k for k in (-p.theta_1 - p.theta_e0, p.theta_1 - p.theta_e0) if min(theta[-1], 0.0) < k < max(theta[-1], 0.0)
    ]
    elastic = quad(lambda angle: published_torque(angle, p), 0.0, theta[-1], points=kinks or None)[0]
    stored = p.J_e * omega_c[-1] ** 2 / 2.0 + p.J_v * omega_p[-1] ** 2 / 2.0 + elastic
    # Trapezoids over steps of at most 10 ms (DOP/RK45 chooses about 2 ms): quadrature error near 1e-4 of the work.
    assert stored == pytest.approx(supplied, rel=2e-3)


def test_the_linear_part_moves_as_its_matrix_exponential():
    from scipy.linalg import expm

    location = automaton(DEFAULTS).locations[2]
    torque, stop = 2.0, 0.3  # stays in location 3: +2 N.m stretches the driveline
    _, states, visited = simulate(torque, stop, DEFAULTS)
    block = np.zeros((4, 4))
    block[:3, :3], block[:3, 3] = location.A, location.B[:, 0] * torque
    assert visited == [3]
    # rtol 1e-10 of the integrator, about ten oscillations: 1e-7 of the amplitude.
    np.testing.assert_allclose(states[:, -1], expm(block * stop)[:3, 3], rtol=1e-7)


def test_every_parameter_states_a_unit_and_the_sets_are_complete():
    assert {signal.name for signal in MODEL.parameters} == set(SETS["wide_gap"])
    assert [signal.name for signal in MODEL.states] == ["theta_e", "omega_c", "omega_p"]
    assert MODEL.outputs[0].unit == "rpm" and MODEL.inputs[0].unit == "N.m"
