"""Structure: what is zero on a branch, and three tests of structural observability that must agree."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from linear_oracles import chain, lin_observable

from fmus.component import Signal
from fmus.interface import dependence
from fmus.linearmodel import LinearModel
from fmus.model import Model
from fmus.statespace import at, scales
from selection.branch import Branch
from selection.rowspace import Field, spanned_units
from selection.structure import (
    branch_structure,
    distances,
    error_probability,
    free_rows,
    structurally_observable,
    widest_structure,
)


def generically_observable(A: np.ndarray, C: np.ndarray) -> bool:
    field = Field()
    rows = free_rows(A, C, [0] * len(C), field, seed=0)
    return bool(spanned_units(rows, [tuple(range(len(C)))], field).all())


@st.composite
def patterns(draw, most=7):
    n, s = draw(st.integers(1, most)), draw(st.integers(1, 3))
    density = draw(st.floats(0.05, 0.6))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    return rng.random((n, n)) < density, rng.random((s, n)) < density


@settings(deadline=None, max_examples=400)
@given(patterns())
def test_shields_and_pearson_and_lin_and_the_generic_rank_agree(pattern):
    A, C = pattern
    assert structurally_observable(A, C) == lin_observable(A, C) == generically_observable(A, C)


def test_a_contraction_is_not_observable_although_every_state_reaches_the_output():
    # Two states drive one output and nothing else depends on them: their sum alone is seen.
    A, C = np.zeros((2, 2), dtype=bool), np.ones((1, 2), dtype=bool)
    assert not structurally_observable(A, C)
    assert structurally_observable(A, np.eye(2, dtype=bool))
    assert structurally_observable(np.eye(2, dtype=bool), C), "with a rate of its own each, they are told apart"


def test_a_chain_is_observable_from_its_head_only():
    A = np.array(chain(6), dtype=bool)
    assert [structurally_observable(A, np.eye(6, dtype=bool)[[k]]) for k in range(6)] == [True] + [False] * 5


@pytest.mark.parametrize("states", [60, 100])
def test_a_network_of_many_states_is_answered_at_once(states: int):
    # The matching of scipy.sparse.csgraph did not end within ten minutes on the second.
    rng = np.random.default_rng(states)
    A = np.eye(states, dtype=bool) | np.roll(np.eye(states, dtype=bool), 1, axis=1)
    A |= rng.random((states, states)) < 3 / states
    C = np.eye(states, dtype=bool)[[0]]
    assert structurally_observable(A, C) and lin_observable(A, C)
    A[:, 7] = False
    assert not structurally_observable(A, C) and not lin_observable(A, C)


def test_without_a_sensor_nothing_is_observable():
    assert not structurally_observable(np.eye(3, dtype=bool), np.zeros((0, 3), dtype=bool))


def test_the_way_from_a_state_to_a_sensor_is_counted_in_derivatives():
    A = np.array(chain(4), dtype=bool)
    C = np.array([[1, 0, 0, 0], [0, 0, 1, 0], [1, 0, 1, 0]], dtype=bool)
    assert distances(A, C, [0, 0, 1]).tolist() == [[0, 1, 2, 3], [-1, -1, 0, 1], [1, 2, 1, 2]]


@settings(deadline=None, max_examples=100)
@given(patterns(most=5))
def test_a_state_appears_first_in_the_derivative_in_which_the_generic_row_has_it(pattern):
    A, C = pattern
    rows = free_rows(A, C, [0] * len(C), Field(), 1)
    a = np.array(rows.A, dtype=object)
    row, first = np.array(rows.sensors, dtype=object), np.full(C.shape, -1)
    for k in range(len(A)):
        first[(first < 0) & (row != 0)] = k
        row = row @ a % Field().prime
    assert (distances(A, C, [0] * len(C)) == first).all()


# A branch of a flow that goes either way, as those of engines are: what is downstream counts backwards only.
TWO_WAYS = Model(
    name="two_ways",
    description="A flow between two volumes that carries what is upstream",
    equations=lambda t, x, m, u, p: (
        {
            "a": -np.where(x.a >= x.b, x.a * x.T, x.b * x.S) * (x.a - x.b),
            "b": u.q - x.b,
            "T": np.maximum(x.b, x.T) - x.T * p.off,
            "S": np.abs(x.b - x.a) * (x.S - x.S + 1.0) - x.S,
        },
        {"W": np.minimum(x.a, x.b) + 0.0 * x.S},
    ),
    states=(Signal("a", start=2.0), Signal("b", start=1.0), Signal("T", start=3.0), Signal("S", start=4.0)),
    inputs=(Signal("q", start=1.0),),
    outputs=(Signal("W"),),
    parameters=(Signal("off", start=0.0),),
)


def structure_at(**values: float):
    system = LinearModel(TWO_WAYS, {k: v for k, v in values.items() if k == "off"})
    return branch_structure(Branch(system, at(system.states, values), at(system.inputs, values)))


def test_the_structure_is_that_of_the_branch_and_without_what_cancels():
    forward, backward = structure_at(), structure_at(a=1.0, b=2.0, T=1.0)
    assert forward.A.astype(int).tolist() == [[1, 1, 1, 0], [0, 1, 0, 0], [0, 0, 1, 0], [1, 1, 0, 1]]
    assert backward.A.astype(int).tolist() == [[1, 1, 0, 1], [0, 1, 0, 0], [0, 1, 0, 0], [1, 1, 0, 1]]
    assert forward.C.astype(int).tolist()[4] == [0, 1, 0, 0]
    assert backward.C.astype(int).tolist()[4] == [1, 0, 0, 0]


def test_an_input_or_parameter_of_zero_is_switched_off_and_any_other_stands_for_all():
    # T' = max(b, T) - off T: at off = 1 exactly and T above b nothing would be left of it, at all others something is.
    assert structure_at(off=1.0).A[2].tolist() == [False, False, True, False]
    assert structure_at(off=0.0, b=1.0).A[2].tolist() == [False, False, True, False]
    assert structure_at(off=0.0, a=9.0, b=8.0).A[2].tolist() == [False, True, False, False]


def test_the_structure_of_a_branch_lies_within_the_symbolic_one_of_all_branches():
    system = LinearModel(TWO_WAYS)
    widest = widest_structure(system)
    for found in (structure_at(), structure_at(a=1.0, b=2.0, T=1.0)):
        assert not (found.A & ~widest.A).any() and not (found.C & ~widest.C).any()
    assert (dependence(system.traced.equations, 0, "x") == widest.A).all()


def test_the_structure_is_that_of_exact_derivatives_at_points_of_the_branch():
    rng = np.random.default_rng(5)
    system = LinearModel(TWO_WAYS)
    for values in ({}, {"a": 1.0, "b": 2.0, "T": 1.0}):
        x, u = at(system.states, values), at(system.inputs, values)
        seen = np.zeros((4, 4), dtype=bool)
        for _ in range(5):
            seen |= system.partials(x + 0.1 * scales(system.states) * rng.uniform(-1, 1, 4), u).A != 0.0
        assert (seen == branch_structure(Branch(system, x, u)).A).all()


def test_the_chance_of_an_error_grows_with_sets_states_and_degrees_and_stays_small():
    one = error_probability(13, 1, [0, 1], 1, Field())
    # (n + 1) n sum(rho) minors' degrees for rho up to n + 1, over 2^61 - 2.
    assert one == pytest.approx(14 * 13 * (14 * 15 / 2) / (2**61 - 2), rel=1e-12)
    assert error_probability(13, 131071, [0, 1], 1, Field()) == pytest.approx(131071 * one)
    assert error_probability(13, 131071, [0, 1], 10**4, Field(31)) == 1.0
