"""Equilibria of models whose equilibria are known, and the reasons where there is none."""

from __future__ import annotations

import re

import numpy as np
import pytest

from fmus.component import Signal
from fmus.jacobians import jacobians, point
from fmus.model import Model
from fmus.plants.driveline import MODEL as DRIVELINE
from fmus.steady import SteadyError, steady_state
from tests.models import BLOW_UP, FILTER, VAN_DER_POL


def tank(**bounds: float) -> Model:
    """area h' = q - c sqrt(h), at rest at h = (q/c)^2, in sizes far from one."""
    return Model(
        name="tank",
        description="a tank that drains",
        equations=lambda t, x, m, u, p: ({"h": (u.q - p.c * np.sqrt(np.maximum(x.h, 0.0))) / 3e3}, {"out": 2.0 * x.h}),
        inputs=(Signal("q", start=8.0),),
        states=(Signal("h", start=100.0, nominal=1e4, **bounds),),
        outputs=(Signal("out"),),
        parameters=(Signal("c", start=0.05),),
    )


def settle(model: Model, **values: float):
    return steady_state(jacobians(model), point(model, values))


def test_a_tank_comes_to_rest_where_it_lets_out_what_comes_in():
    found = settle(tank())
    # h = (8/0.05)^2; Newton's correction is below 1e-9 of the nominal value and quadratic before that.
    assert found.states["h"] == pytest.approx(25600.0, rel=1e-14)
    assert found.outputs["out"] == 2.0 * found.states["h"]
    assert found.residual * 1e4 * 3e3 < 1e-14 and found.correction < 1e-14 and found.worst == "h"
    # The time constant is 2 area sqrt(h)/c: it is the plant's own way that is gone, over many of them.
    assert found.after > 2.0 * 3e3 * 160.0 / 0.05


def test_the_driveline_in_its_middle_location_settles_to_its_matrix_equation():
    found = settle(DRIVELINE, T_eng=-10.0, location=2)
    p = {signal.name: float(signal.start) for signal in DRIVELINE.parameters}
    # slip = 0, no torque on the wheel, T = B_e omega_c: f_2(theta_e) = 0.
    torsion = (p["k_1"] - p["k"]) * (p["theta_e0"] - p["theta_1"]) / p["k"]
    assert found.states["theta_e"] == pytest.approx(torsion, rel=1e-12)
    assert found.states["omega_c"] == pytest.approx(-10.0 / p["B_e"], rel=1e-12)
    assert found.states["omega_p"] == pytest.approx(-10.0 / p["B_e"] * p["tau"], rel=1e-12)


FORK = Model(
    name="fork",
    description="x' = x - x^3 + u: two equilibria that are stable and one between that is not",
    equations=lambda t, x, m, u, p: ({"x": x.x - x.x**3 + u.u, "lag": 5.0 * (x.x - x.lag)}, {}),
    inputs=(Signal("u"),),
    states=(Signal("x", start=0.1), Signal("lag")),
)


@pytest.mark.parametrize(("start", "end"), [(0.1, 1.0), (-1e-6, -1.0), (30.0, 1.0), (-5.0, -1.0)])
def test_of_several_equilibria_it_is_the_one_that_the_plant_goes_to(start, end):
    assert settle(FORK, x=start).states["x"] == pytest.approx(end, rel=1e-12)


@pytest.mark.parametrize(
    ("model", "values", "message"),
    [
        (VAN_DER_POL, {}, "van_der_pol has not settled after .* s; . has the largest residual: .* a second"),
        (VAN_DER_POL, {"x": 0.0}, "van_der_pol rests on an equilibrium that is not stable: . leaves it at 0.5 1/s"),
        (FORK, {"x": 0.0}, "fork rests on an equilibrium that is not stable: x leaves it at 1 1/s"),
        (BLOW_UP, {}, "blow_up has not settled after 0.* s; x has the largest residual"),
        (FILTER, {}, "filter has no continuous state that could come to rest"),
        (tank(maximum=1e4), {}, "tank comes to rest with h = 25600, outside its range -inf to 10000"),
        (FORK, {"x": np.nan}, "fork cannot start here: the derivative of x is not finite"),
    ],
    ids=["cycle", "unstable-focus", "unstable-node", "blow-up", "nothing", "out-of-range", "not-finite"],
)
def test_what_stands_in_the_way_is_named(model, values, message):
    with pytest.raises(SteadyError, match=message):
        steady_state(jacobians(model), point(model, values), most_steps=300)


def test_a_state_that_nothing_holds_is_named():
    cart = Model(
        name="cart",
        description="a cart that rolls to rest wherever it is by then",
        equations=lambda t, x, m, u, p: ({"speed": -x.speed, "place": x.speed}, {}),
        states=(Signal("speed", start=1.0), Signal("place")),
    )
    with pytest.raises(SteadyError, match=re.escape("no single equilibrium here: place is free (singular Jacobian)")):
        settle(cart)


def test_two_states_that_run_away_are_told_apart_by_their_residuals():
    model = Model(
        name="pair",
        description="one state that settles and one that never does",
        equations=lambda t, x, m, u, p: ({"calm": -x.calm, "restless": 3.0 + 1e-3 * np.sin(x.restless)}, {}),
        states=(Signal("calm", start=1.0), Signal("restless")),
    )
    with pytest.raises(SteadyError, match="restless has the largest residual: 3"):
        steady_state(jacobians(model), point(model), most_steps=50)
