"""Points and exact Jacobians of models against differences, and structures by regime."""

from __future__ import annotations

import numpy as np
import pytest

from fmus.component import Signal
from fmus.jacobians import Point, jacobians, point
from fmus.model import FlatModel, Model, ModelError
from fmus.plants.driveline import MODEL as DRIVELINE
from tests.models import FILTER, VAN_DER_POL

VALVE = Model(
    name="valve",
    description="a flow that does not see what is behind it once that is below half",
    equations=lambda t, x, m, u, p: ({"a": -np.sqrt(1.0 - np.maximum(x.b, 0.5)), "b": u.u - x.b}, {"y": x.a * u.u}),
    inputs=(Signal("u"),),
    states=(Signal("a"), Signal("b", start=0.7)),
    outputs=(Signal("y"),),
)


def test_a_point_is_the_start_values_then_the_set_then_what_is_given():
    chosen = point(DRIVELINE, {"k": 900.0, "theta_e": 0.01, "T_eng": 5.0, "location": 2}, "wide_gap")
    p = dict(zip([signal.name for signal in DRIVELINE.parameters], chosen.p, strict=True))
    assert (p["k"], p["J_v"], p["B_e"]) == (900.0, 140.0, 0.05)
    assert list(chosen.x) == [0.01, 0.0, 0.0] and list(chosen.u) == [5.0] and list(chosen.m) == [2.0]


def test_an_array_is_given_whole_or_by_scalar():
    names = [name for signal in FILTER.parameters for name in signal.scalar_names()]
    p = dict(zip(names, point(FILTER, {"A": np.eye(2), "L[2]": 7.0}).p, strict=True))
    assert [p[f"A[{i},{j}]"] for i in (1, 2) for j in (1, 2)] == [1.0, 0.0, 0.0, 1.0]
    assert (p["L[1]"], p["L[2]"]) == (0.5, 7.0)


def test_an_unknown_name_is_refused_with_the_nearest():
    with pytest.raises(ModelError, match=r"no state, input or parameter is named 'theta'; did you mean 'theta_\w+'"):
        point(DRIVELINE, {"theta": 1.0})
    with pytest.raises(ModelError, match="no parameter set is named 'gap'; did you mean 'wide_gap'"):
        point(DRIVELINE, None, "gap")


@pytest.mark.parametrize("model", [DRIVELINE, VAN_DER_POL, VALVE], ids=lambda model: model.name)
def test_values_are_those_of_the_source_and_derivatives_their_differences(model):
    found, at = jacobians(model), point(model)
    at = at._replace(x=at.x + 0.01 * np.arange(1, len(at.x) + 1), u=at.u + 0.3)
    flat = FlatModel(model)

    def both(x, u):
        dx, y = flat.derivatives_and_outputs(0.0, list(x), list(at.m), list(u), list(at.p))
        return np.array([*dx, *y], dtype=float)

    linear = found.at(at)
    np.testing.assert_allclose(np.concatenate(found.values(at)), both(at.x, at.u), rtol=1e-14)
    np.testing.assert_array_equal(linear.dx, found.values(at)[0])
    exact = np.block([[linear.A, linear.B], [linear.C, linear.D]])
    known = np.concatenate([at.x, at.u])
    for j in range(len(known)):
        step = np.zeros(len(known))
        step[j] = 1e-5
        up, down = (both((known + sign * step)[: len(at.x)], (known + sign * step)[len(at.x) :]) for sign in (1, -1))
        # Central differences of h = 1e-5: h^2 of the third derivative and 1e-16/h of rounding, of values up to 1e3.
        np.testing.assert_allclose((up - down) / 2e-5, exact[:, j], rtol=1e-7, atol=1e-7)


def test_a_structure_is_that_of_the_regime_of_its_points():
    found = jacobians(VALVE)
    free, choked = (point(VALVE, {"b": b, "u": 1.0}) for b in (0.7, 0.3))
    assert found.structure([free]).A.tolist() == [[False, True], [False, True]]
    assert found.structure([choked]).A.tolist() == [[False, False], [False, True]]
    both = found.structure([choked, free])
    assert both.A.tolist() == [[False, True], [False, True]]
    assert (both.B.tolist(), both.C.tolist(), both.D.tolist()) == ([[False], [True]], [[True, False]], [[False]])


def test_a_structure_wants_a_point():
    with pytest.raises(ValueError, match="the structure of valve wants one point or more, got none"):
        jacobians(VALVE).structure([])


def test_a_structure_of_a_point_without_values_is_refused():
    beyond = point(VALVE, {"b": 1.5})
    with pytest.raises(ModelError, match=r"valve has no finite derivative .* a"):
        jacobians(VALVE).structure([beyond])


def test_a_point_may_be_written_by_hand():
    at = Point(np.array([2.0, 0.0]), np.zeros(0), np.zeros(0), np.array([1.0]))
    np.testing.assert_allclose(jacobians(VAN_DER_POL).at(at).A, [[0.0, 1.0], [-1.0, -3.0]])
