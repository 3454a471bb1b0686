"""The crank mechanism: the piston's way by plane geometry, its slopes, and an inertia that loses no energy."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from fmus.crank_mechanism import crank_inertia, piston_motion
from fmus.tracing import Symbol

RADIUS, RATIO = 0.046, 0.31
ANGLES = np.linspace(0.0, 4.0 * np.pi, 181)
FIRING = np.array([0.0, 3.0, 1.0, 2.0]) * np.pi
radii, ratios = st.floats(0.01, 0.2), st.floats(0.05, 0.6)


@given(alpha=st.floats(-20.0, 20.0), radius=radii, ratio=ratios)
def test_the_piston_is_where_the_connecting_rod_lets_it(alpha, radius, ratio):
    rod = radius / ratio
    # From the crank's axis: r cos + sqrt(l^2 - r^2 sin^2), at top dead centre r + l.
    height = radius * np.cos(alpha) + np.sqrt(rod**2 - (radius * np.sin(alpha)) ** 2)
    # Differences of lengths up to r + l, to some roundings of that.
    assert piston_motion(alpha, radius, ratio).travel == pytest.approx(
        radius + rod - height, abs=1e-14 * (radius + rod)
    )


def test_the_piston_stands_at_its_dead_centres_a_stroke_apart():
    top, bottom = (piston_motion(alpha, RADIUS, RATIO) for alpha in (0.0, np.pi))
    assert top.travel == 0.0 and bottom.travel == pytest.approx(2.0 * RADIUS, rel=1e-15)
    assert top.slope == 0.0 and bottom.slope == pytest.approx(0.0, abs=1e-16)
    # r (1 + k) at the top, -r (1 - k) at the bottom.
    assert top.curvature == pytest.approx(RADIUS * 1.31, rel=1e-15)
    assert bottom.curvature == pytest.approx(-RADIUS * 0.69, rel=1e-15)


def test_slope_and_curvature_are_the_derivatives_that_casadi_finds():
    alpha = ca.SX.sym("alpha")
    travel = piston_motion(Symbol(alpha), RADIUS, RATIO).travel.sx
    slope = ca.jacobian(travel, alpha)
    exact = ca.Function("exact", [alpha], [slope, ca.jacobian(slope, alpha)])
    for angle in ANGLES:
        motion = piston_motion(angle, RADIUS, RATIO)
        np.testing.assert_allclose(
            [motion.slope, motion.curvature], np.array(exact(angle)).ravel(), atol=1e-16, rtol=1e-13
        )


def inertia(theta: float, rotating: float = 0.2, reciprocating: float = 1.0) -> tuple[float, float]:
    """J and dJ/dtheta of the four-cylinder engine."""
    return crank_inertia(rotating, reciprocating, [piston_motion(theta - tdc, RADIUS, RATIO) for tdc in FIRING])


def test_the_slope_of_the_inertia_is_that_of_its_differences():
    h = 1e-4
    for theta in ANGLES:
        difference = (inertia(theta + h)[0] - inertia(theta - h)[0]) / (2.0 * h)
        # h^2/6 of the third derivative, some 0.1, is 2e-10; rounding of 0.2 over h as much again.
        assert inertia(theta)[1] == pytest.approx(difference, abs=1e-9)


def test_the_inertia_has_the_pistons_full_share_where_they_are_fastest_and_none_at_dead_centre():
    assert inertia(0.0)[0] == pytest.approx(0.2, abs=1e-16)
    # At 90 deg every piston's slope is r.
    assert inertia(0.5 * np.pi)[0] == pytest.approx(0.2 + 4.0 * RADIUS**2, rel=1e-14)


def test_a_crank_that_nothing_drives_keeps_its_kinetic_energy():
    def rates(t, x):
        J, slope = inertia(x[0], 0.01)
        return x[1], -0.5 * slope * x[1] ** 2 / J

    run = solve_ivp(rates, (0.0, 0.5), (0.3, 150.0), rtol=1e-12, atol=1e-12, method="DOP853")
    energy = [0.5 * inertia(theta, 0.01)[0] * omega**2 for theta, omega in run.y.T]
    # The speed swings by a third; twelve turns at 1e-12 a step.
    assert np.ptp(run.y[1]) > 20.0
    np.testing.assert_allclose(energy, energy[0], rtol=1e-9)
