"""Combustion, heat to the walls and valves of a cylinder, by closed forms and hand-worked values."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad

from fmus.cylinder import hohenberg, valve_opening, wiebe

DEG = np.pi / 180.0
EXHAUST = (135.0 * DEG, 370.0 * DEG)


@pytest.mark.parametrize(("start", "duration", "a", "m"), [(-5.0, 20.0, 5.0, 2.0), (-20.0, 50.0, 6.9, 1.3)])
def test_wiebes_rate_adds_up_to_its_burnt_fraction(start, duration, a, m):
    arguments = (start * DEG, duration * DEG, a, m)
    for phi in np.linspace(start - 30.0, start + 2.0 * duration, 25) * DEG:
        burnt, _ = wiebe(phi, *arguments)
        area, _ = quad(
            lambda angle: wiebe(angle, *arguments)[1], start * DEG, max(phi, start * DEG), epsabs=1e-13, epsrel=1e-13
        )
        assert burnt == pytest.approx(area, abs=1e-12)
    assert wiebe((start + duration) * DEG, *arguments)[0] == pytest.approx(1.0 - np.exp(-a), rel=1e-14)
    assert wiebe(start * DEG, *arguments) == (0.0, 0.0)
    assert wiebe(np.pi, *arguments) == pytest.approx((1.0, 0.0), abs=1e-15)


def test_half_of_the_fuel_is_burnt_where_wiebes_function_says():
    # 1 - exp(-a s^(m+1)) = 1/2 at s = (ln 2/a)^(1/(m+1)).
    s = (np.log(2.0) / 5.0) ** (1.0 / 3.0)
    assert wiebe((-5.0 + 20.0 * s) * DEG, -5.0 * DEG, 20.0 * DEG, 5.0, 2.0)[0] == pytest.approx(0.5, rel=1e-14)


def test_hohenbergs_heat_transfer_is_that_of_a_value_worked_by_hand():
    # 130 (5e-5)^-0.06 50^0.8 1500^-0.4 (4.6 + 1.4)^0.8: logarithms 4.86753 + 0.59421 + 3.12962 - 2.92529 + 1.43341.
    assert hohenberg(50e5, 1500.0, 5e-5, 4.6) == pytest.approx(np.exp(7.09948), rel=1e-4)


def test_a_valve_is_shut_outside_of_its_angles_and_fully_open_in_the_middle():
    opens, shuts = EXHAUST
    inside = np.linspace(opens, shuts, 201)[1:-1]
    assert (valve_opening(inside, *EXHAUST) > 0.0).all()
    outside = np.linspace(shuts - 4.0 * np.pi, opens, 201)
    # At the seat itself the cosine is right to rounding, and its square to rounding squared.
    assert valve_opening(outside, *EXHAUST).max() < 1e-30
    assert valve_opening(0.5 * (opens + shuts), *EXHAUST) == pytest.approx(1.0, rel=1e-14)
    np.testing.assert_allclose(
        valve_opening(inside + 4.0 * np.pi, *EXHAUST), valve_opening(inside, *EXHAUST), atol=1e-14
    )


def test_a_valve_leaves_its_seat_with_no_slope():
    opens, _ = EXHAUST
    shares = [valve_opening(opens + step, *EXHAUST) / step for step in (1e-2, 1e-3, 1e-4)]
    assert shares[1] == pytest.approx(shares[0] / 10.0, rel=0.1) and shares[2] == pytest.approx(
        shares[1] / 10.0, rel=0.02
    )
