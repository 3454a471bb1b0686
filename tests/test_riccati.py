"""The error of the best filter against closed forms, scipy and python-control; its tangents; and what has no answer."""

from __future__ import annotations

import math
from dataclasses import replace

import control
import numpy as np
import pytest
from estimations import engine_estimation, given, random_estimation, scipy_cost, subsets
from hypothesis import given as drawn
from hypothesis import settings
from hypothesis import strategies as st

from selection.estimation import EstimationError, refuse_unsound, unseen_by
from selection.riccati import Costs, best_filter, covariance, error_norm


def test_a_wandering_state_has_the_error_of_the_scalar_equation():
    # q = x^2/r: the error's variance is the root of q r.
    one = given([[0.0]], [[1.0], [1.0]], [[4.0]], [0.25, 1.0], [[1.0]])
    assert Costs(one).cost([0]) == pytest.approx(1.0, rel=1e-12)
    assert Costs(one).cost([1]) == pytest.approx(2.0, rel=1e-12)
    # Two sensors are one of the information of both: 1/r = 4 + 1.
    assert Costs(one).cost([0, 1]) == pytest.approx(math.sqrt(4.0 / 5.0), rel=1e-12)
    assert Costs(one).cost([]) == math.inf, "it wanders without bound unseen"


def test_a_decaying_state_has_the_error_of_the_scalar_equation():
    a, q, r = -0.7, 2.0, 0.3
    wanted = r * (a + math.sqrt(a * a + q / r))
    one = given([[a]], [[1.0]], [[q]], [r], [[1.0]])
    assert Costs(one).cost([0]) == pytest.approx(wanted, rel=1e-12)
    assert Costs(one).cost([]) == pytest.approx(q / (2 * -a), rel=1e-12)
    found = best_filter(one, [0])
    assert (found.trace, found.gain[0, 0], found.decay) == pytest.approx((wanted, wanted / r, wanted / r - a), rel=1e-9)


@settings(deadline=None, max_examples=60)
@drawn(st.integers(0, 2**32 - 1), st.integers(1, 7), st.integers(1, 5), st.floats(-1.0, 0.7))
def test_the_best_filter_is_that_of_python_control_and_the_error_system_has_its_norm(seed, n, m, growth):
    system = random_estimation(seed, n, m, growth, wanted=min(2, n))
    found = best_filter(system, range(m))
    L, P, _ = control.lqe(system.A, np.eye(n), system.C, system.process, np.diag(system.noise))
    # Random modes may nearly cancel: the solvers agree to the digits that their residuals leave, measured 1e-9.
    assert np.abs(found.gain - L).max() <= 1e-6 * np.abs(L).max()
    assert np.abs(found.covariance - P).max() <= 1e-6 * np.abs(P).max()
    assert Costs(system).cost(range(m)) == pytest.approx(found.trace, rel=1e-7)
    noise = np.concatenate([np.linalg.cholesky(system.process), -found.gain * np.sqrt(system.noise)], axis=1)
    error_system = control.ss(system.A - found.gain @ system.C, noise, system.W, 0)
    assert control.norm(error_system, 2) == pytest.approx(math.sqrt(found.trace), rel=1e-6)
    assert found.trace_again == pytest.approx(found.trace, rel=1e-6) and found.decay > 0.0


def test_no_other_gain_errs_less():
    system = random_estimation(3, 4, 2)
    found = best_filter(system, [0, 1])
    rng = np.random.default_rng(0)
    for _ in range(50):
        cost, _ = error_norm(system, found.gain + 0.05 * rng.normal(size=found.gain.shape))
        assert cost > found.trace


def test_costs_of_the_engine_are_scipys_for_every_single_sensor_and_pair():
    system = engine_estimation()
    costs = Costs(system)
    for members in subsets(17, 0, 1, 2):
        # scipy's solver, in units that are not balanced, leaves up to 2e-10.
        assert costs.cost(members) == pytest.approx(scipy_cost(system, members), rel=1e-8)


def test_a_sensors_own_state_changes_nothing_where_it_is_not_read():
    system = engine_estimation()
    fast = [i for i, place in enumerate(system.own) if place is None]
    assert len(system.on(fast).A) == 13 and len(system.A) == 19
    whole = replace(system, own=(None,) * 17)
    assert Costs(whole).cost(fast[:3]) == pytest.approx(Costs(system).cost(fast[:3]), rel=1e-10)


@settings(deadline=None, max_examples=40)
@drawn(st.integers(0, 2**32 - 1), st.integers(1, 6), st.integers(2, 5), st.floats(-1.0, 0.5))
def test_tangents_lie_below_the_cost_of_every_set_and_touch_where_they_are_taken(seed, n, m, growth):
    system = random_estimation(seed, n, m, growth, wanted=min(2, n))
    costs = Costs(system)
    rng = np.random.default_rng(seed)
    uses = [np.ones(m), rng.uniform(0.05, 1.0, m), rng.uniform(0.0, 0.1, m) + 1e-3]
    for use in uses:
        tangent = costs.tangent(use)
        assert tangent is not None and (tangent.slopes >= 0.0).all()
        for members in subsets(m, *range(m + 1)):
            below = tangent.offset - tangent.slopes[list(members)].sum()
            assert below <= costs.cost(members) * (1.0 + 1e-8)
    whole = costs.tangent(np.ones(m))
    assert whole.offset - whole.slopes.sum() == pytest.approx(costs.cost(range(m)), rel=1e-8)


def test_slopes_of_a_tangent_are_the_differences_of_the_cost():
    costs = Costs(random_estimation(5, 4, 3))
    use = np.array([0.3, 0.8, 0.5])
    tangent, step = costs.tangent(use), 1e-5
    for j in range(3):
        ahead, behind = (costs.tangent(use + sign * step * np.eye(3)[j]).cost for sign in (1.0, -1.0))
        # Central differences: the cost is smooth, the error of the order of the step's square.
        assert -(ahead - behind) / (2.0 * step) == pytest.approx(tangent.slopes[j], rel=1e-6)


@settings(deadline=None, max_examples=30)
@drawn(st.integers(0, 2**32 - 1))
def test_one_more_sensor_never_raises_the_cost(seed):
    costs = Costs(random_estimation(seed, 4, 4, growth=0.2))
    for members in subsets(4, 1, 2, 3):
        for more in set(range(4)) - set(members):
            assert costs.cost([*members, more]) <= costs.cost(members) * (1.0 + 1e-9)


def test_units_of_states_and_sensors_make_no_difference():
    system = random_estimation(8, 4, 3)
    sizes = np.array([1e5, 300.0, 0.02, 5.0])
    in_sizes = system.scaled(sizes)
    for members in subsets(3, 1, 2, 3):
        assert Costs(in_sizes).cost(members) == pytest.approx(Costs(system).cost(members), rel=1e-9)


APART = given([[0.3, 0.0], [0.0, -1.0]], [[0.0, 1.0], [1.0, 0.0]], np.eye(2), [1.0, 1.0], np.eye(2))


def test_a_set_that_does_not_see_a_growing_mode_is_named_with_the_mode_and_its_states():
    assert Costs(APART).cost([0]) == math.inf and Costs(APART).cost([0, 1]) < math.inf
    assert Costs(APART).tangent(np.array([1.0, 0.0])) is None
    assert unseen_by(APART, [0]) == "the mode at 0.3 1/s in x0" and unseen_by(APART, [1]) == ""
    with pytest.raises(EstimationError, match=r"undetectable: y0 does not see the mode at 0.3 1/s in x0"):
        best_filter(APART, [0])
    with pytest.raises(EstimationError, match=r"undetectable: nothing sees the mode at 0.3 1/s in x0"):
        best_filter(APART, [])


def test_every_reason_why_there_is_no_best_filter_is_told_at_once():
    blind = replace(APART, C=np.array([[0.0, 1.0], [0.0, 2.0]]), noise=np.array([1.0, 0.0]))
    with pytest.raises(EstimationError) as caught:
        refuse_unsound(blind)
    assert caught.value.problems == [
        "the noise of y1 has the intensity 0, wants more than 0",
        "no sensor sees the mode at 0.3 1/s in x0: it does not die out by itself",
    ]


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (
            {"process": np.array([[1.0, 2.0], [2.0, 1.0]])},
            "the process noise is indefinite: -1 of a variance in x0, x1",
        ),
        ({"process": np.diag([1.0, -0.5])}, "the process noise is indefinite: -0.5 of a variance in x1"),
        ({"process": np.array([[1.0, 0.5], [0.0, 1.0]])}, "wants a symmetric covariance: x0 with x1 is not x1 with x0"),
        ({"process": np.full((2, 2), math.nan)}, "the process noise is not finite"),
        ({"noise": np.array([1.0, -2.0])}, "the noise of y1 has the intensity -2, wants more than 0"),
        ({"W": np.zeros((1, 2))}, "no noise reaches what is wanted"),
        ({"A": np.diag([0.0, -1.0]), "process": np.diag([0.0, 1.0])}, "no process noise moves the mode at 0 1/s in x0"),
    ],
)
def test_noise_that_is_none_is_refused_by_name(change, told):
    with pytest.raises(EstimationError, match=told):
        refuse_unsound(replace(APART, **change))


def test_an_oscillation_that_no_noise_moves_is_named_once():
    still = given([[0.0, 2.0], [-2.0, 0.0]], [[1.0, 0.0]], np.zeros((2, 2)), [1.0], [[1.0, 0.0]])
    with pytest.raises(EstimationError, match=r"no process noise moves the mode at 0\+2j 1/s in x0, x1"):
        refuse_unsound(still)


def test_a_sound_estimation_is_not_refused():
    refuse_unsound(APART)
    refuse_unsound(engine_estimation())


def test_states_that_no_noise_moves_drop_out_and_change_nothing():
    A = np.array([[-1.0, 0.5, 0.0], [0.0, -2.0, 0.0], [0.3, 0.0, -3.0]])
    system = given(A, [[1.0, 0.0, 0.0], [0.0, 1.0, 1.0]], np.diag([1.0, 0.0, 0.0]), [1.0, 1.0], np.eye(3))
    less = system.moved()
    # x1 drives x0 and has no noise; x2 has none either, but x0 drives it.
    assert less.states == ("x0", "x2")
    for members in subsets(2, 1, 2):
        assert Costs(less).cost(members) == pytest.approx(Costs(system).cost(members), rel=1e-9)
    growing = given([[0.2, 0.0], [0.0, -1.0]], [[1.0, 1.0]], np.diag([0.0, 1.0]), [1.0], np.eye(2))
    assert growing.moved() is growing, "what grows from its beginning is to be watched, moved or not"


def test_sizes_that_are_zero_are_refused_by_name():
    with pytest.raises(EstimationError, match="wants sizes above 0: x1 has the size 0"):
        APART.scaled(np.array([1.0, 0.0]))


def test_a_riccati_equation_without_a_stabilising_solution_is_refused():
    with pytest.raises(EstimationError, match="no stabilising solution"):
        covariance(np.zeros((1, 1)), np.zeros((1, 1)), np.ones((1, 1)))
