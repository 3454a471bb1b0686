"""Row spaces modulo a prime, in C, against exact rational arithmetic and closed forms."""

from __future__ import annotations

import itertools
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from linear_oracles import chain, rational_augmented, rational_indices

from selection.rowspace import Field, Rows, spanned_units

FIELDS = [Field(31), Field(61)]
small = st.integers(-3, 3)


def indices(A, C, lags, sets=None, bits=61):
    field = Field(bits)
    rows = Rows(field.residues(A), field.residues(C), np.array(lags, dtype=np.int64))
    return spanned_units(rows, sets or [tuple(range(len(C)))], field).tolist()


@st.composite
def systems(draw, most=4):
    """A, C and lags of whole numbers: entries of C A^k are below 3 * 12^4, and no minor of theirs is near 2^61."""
    n, s = draw(st.integers(1, most)), draw(st.integers(1, 3))
    A = draw(st.lists(st.lists(small, min_size=n, max_size=n), min_size=n, max_size=n))
    C = draw(st.lists(st.lists(small, min_size=n, max_size=n), min_size=s, max_size=s))
    return A, C, draw(st.lists(st.integers(0, 1), min_size=s, max_size=s))


@settings(deadline=None, max_examples=300)
@given(systems())
def test_indices_equal_those_of_rational_elimination(system):
    A, C, lags = system
    assert indices(A, C, lags) == [rational_indices(A, C, lags)]


@settings(deadline=None, max_examples=150)
@given(systems(most=3), st.integers(1, 7))
def test_a_lag_is_a_sensor_with_a_state_of_its_own_whatever_its_time_constant(system, tau):
    A, C, lags = system
    n = len(A)
    augmented = rational_augmented(A, C, lags, Fraction(tau, 2))
    with_states = rational_indices(*augmented, [0] * len(C))
    assert indices(A, C, lags) == [with_states[:n]]
    # The states of the sensors themselves are known from their values, but a row of zeros is a sensor all the same.
    assert with_states[n:] == [1] * sum(lags)


@pytest.mark.parametrize("bits", [31, 61])
def test_a_chain_of_integrators_is_seen_from_its_head_one_state_a_derivative(bits):
    n = 9
    head = [[int(j == 0) for j in range(n)]]
    assert indices(chain(n), head, [0], bits=bits) == [list(range(1, n + 1))]
    assert indices(chain(n), head, [1], bits=bits) == [list(range(2, n + 2))]
    tail = [[int(j == n - 1) for j in range(n)]]
    assert indices(chain(n), tail, [0], bits=bits) == [[0] * (n - 1) + [1]]


def test_parallel_chains_are_seen_as_deep_as_each_is_long_and_all_sets_in_one_call():
    lengths = (2, 3, 5)
    n = sum(lengths)
    A = np.zeros((n, n), dtype=int)
    heads = []
    for length in lengths:
        begin = sum(lengths[: len(heads)])
        A[begin : begin + length, begin : begin + length] = chain(length)
        heads.append([int(j == begin) for j in range(n)])
    sets = [c for k in (1, 2, 3) for c in itertools.combinations(range(3), k)]
    found = indices(A.tolist(), heads, [0, 0, 0], sets)
    for members, row in zip(sets, found, strict=True):
        wanted = [k + 1 if i in members else 0 for i, length in enumerate(lengths) for k in range(length)]
        assert row == wanted


@settings(deadline=None, max_examples=100)
@given(systems())
def test_a_sensor_more_never_raises_an_index(system):
    A, C, lags = system
    sets = [c for k in range(1, len(C) + 1) for c in itertools.combinations(range(len(C)), k)]
    found = dict(zip(sets, indices(A, C, lags, sets), strict=True))
    for more, fewer in itertools.product(sets, sets):
        if set(fewer) < set(more):
            assert all(b and b <= a for a, b in zip(found[fewer], found[more], strict=True) if a)


@pytest.mark.parametrize("field", FIELDS, ids=str)
def test_products_and_inverses_are_those_of_the_field_at_its_edges(field):
    p = field.prime
    edge = [1, 2, 3, p - 1, p - 2, p // 2, p // 2 + 1, 2**30, 2**30 - 1]
    # The value of a row after one step is its product with A; that a row is in a space needs an inverse.
    for a, b in itertools.product(edge, edge):
        A = [[0, b], [0, 0]]
        assert indices(A, [[a, 1]], [0], bits=field.bits) == [[2, 2]]
        # a (1, b) and (1, b): the same space, so nothing is known unless the product is right.
        assert indices([[0, 0], [0, 0]], [[a, a * b], [1, b]], [0, 0], bits=field.bits) == [[0, 0]]


def test_a_field_has_one_of_two_primes():
    with pytest.raises(ValueError, match="bits wants 31 or 61, got 17"):
        Field(17)


def test_threads_give_what_one_gives_and_tell_of_every_set():
    field, rng = Field(), np.random.default_rng(3)
    A = field.random(rng, (7, 7))
    rows = Rows(
        A * (rng.random((7, 7)) < 0.3), field.random(rng, (14, 7)) * (rng.random((14, 7)) < 0.4), np.zeros(14, int)
    )
    sets = [c for k in range(1, 6) for c in itertools.combinations(range(14), k)]
    told: list[int] = []
    found = [spanned_units(rows, sets, field, told.append, threads) for threads in (1, 2)]
    assert (found[0] == found[1]).all()
    assert sum(told) == 2 * len(sets)
