"""The observability index by four methods: closed forms, each other, and the turbocharged engine of the paper."""

from __future__ import annotations

from collections import Counter
from itertools import combinations

import control
import numpy as np
import pytest
from engine_sensors import (
    ESTIMATE,
    LAGS,
    SENSORS,
    STATE_NAMES,
    TABLE_1,
    WANTED,
    measured,
    paper_structure,
    places,
    sets_of,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from linear_oracles import chain, rational_indices

from fmus.component import Signal
from fmus.linearmodel import LinearModel
from fmus.model import Model
from fmus.plants.turbo_si import MODEL
from fmus.sensing import with_sensors
from fmus.statespace import StateSpace, at, linearised, scales, settle
from selection.branch import Branch
from selection.methods import METHODS
from selection.numerical import numerical_indices, scaled
from selection.observability import Measured, Options, observe, subset_index
from selection.rowspace import Field, spanned_units
from selection.structure import Structure, branch_structure, free_rows, structurally_observable

EXACT_METHODS = ("structural", "coupled", "exact")
TRIPLES = sets_of(3)


def linear_model(A: np.ndarray, C: np.ndarray) -> Model:
    """x' = A x, y = C x."""
    n, q = len(A), len(C)
    return Model(
        name="linear",
        description="x' = A x",
        equations=lambda t, x, m, u, p: (
            {f"x{i}": sum(float(A[i, j]) * x[f"x{j}"] for j in range(n)) for i in range(n)},
            {f"y{i}": sum(float(C[i, j]) * x[f"x{j}"] for j in range(n)) for i in range(q)},
        ),
        states=tuple(Signal(f"x{i}", start=0.0) for i in range(n)),
        outputs=tuple(Signal(f"y{i}") for i in range(q)),
    )


def all_measured(model: Model, sensors: tuple[str, ...], taus: tuple[float, ...], **values: float) -> Measured:
    system = LinearModel(model)
    x, u = at(system.states, values), at(system.inputs, values)
    space = linearised(system, x, u)
    return Measured(space, sensors, taus, branch_structure(Branch(system, x, u)), system)


def histogram(indices: np.ndarray) -> dict[int, int]:
    return dict(sorted(Counter(indices.tolist()).items()))


@pytest.mark.parametrize("method", METHODS)
def test_a_chain_has_the_index_of_its_length_by_every_method(method):
    A = np.array(chain(6))
    head = all_measured(linear_model(A, np.eye(6)[:1]), ("y0", "x0", "x3"), (0.0, 0.5, 0.0))
    seen = observe(head, [5], [(0,), (1,), (2,), (0, 2)], method)
    # x5 is five derivatives from x0, a sixth for a sensor with a lag, and two from x3.
    assert seen.index.tolist() == [6, 7, 3, 3]
    assert seen.whole.tolist() == [6, 7, 0, 3]
    assert seen.hidden(2) == [0, 1, 2]


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 2**32 - 1))
def test_every_method_agrees_on_matrices_of_whole_numbers_with_rational_elimination(seed):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 5))
    A, C = rng.integers(-2, 3, (n, n)), rng.integers(-1, 2, (2, n))
    model = all_measured(linear_model(A, C), ("y0", "y1"), (0.0, 0.0))
    sets = [(0,), (1,), (0, 1)]
    for wanted in ([0], [n - 1, 0], list(range(n))):
        oracle = [
            rational_indices(A.tolist(), [C[m].tolist() for m in members], [0] * len(members)) for members in sets
        ]
        index = subset_index(np.array(oracle), wanted).tolist()
        # Constants of the equations are held by both: they are neither states, inputs nor parameters.
        assert observe(model, wanted, sets, "coupled").index.tolist() == index
        assert observe(model, wanted, sets, "exact").index.tolist() == index
        numerical = observe(model, wanted, sets, "numerical")
        assert numerical.index.tolist() == index
        for place, members in enumerate(sets):
            ranked = np.linalg.matrix_rank(control.obsv(A.astype(float), C[list(members)].astype(float))) == n
            assert bool(numerical.whole[place]) == ranked
            assert numerical.hidden(place) == [j for j, rho in enumerate(oracle[place]) if not rho]


# A flow W = p^2 - q^2 out of one volume into another, and what it does to a temperature: all that is seen of p and q is
# W. The structure does not tell.
ONE_FLOW = Model(
    name="one_flow",
    description="Three equations with one flow in them",
    equations=lambda t, x, m, u, p: (
        {"p": -(x.p**2 - x.q**2), "q": x.p**2 - x.q**2, "T": 3.0 * (x.p**2 - x.q**2) - x.T},
        {},
    ),
    states=(Signal("p", start=2.0), Signal("q", start=2.0), Signal("T", start=0.0)),
)
# p' = u - p, T' = p (1 - T): at rest T is 1, and p does not move it.
AT_REST_APART = Model(
    name="at_rest_apart",
    description="A flow that carries what is there already",
    equations=lambda t, x, m, u, p: ({"p": u.u - x.p, "T": x.p * (1.0 - x.T)}, {}),
    states=(Signal("p", start=2.0), Signal("T", start=1.0)),
    inputs=(Signal("u", start=2.0),),
)


def test_what_comes_from_one_flow_stays_tied_but_by_structure_alone():
    one = all_measured(ONE_FLOW, ("T",), (0.0,))
    index = {method: observe(one, [0, 1], [(0,)], method).index.tolist() for method in METHODS}
    assert index == {"structural": [3], "coupled": [0], "exact": [0], "numerical": [0]}
    assert observe(one, [0, 1], [(0,)], "coupled").hidden(0) == [0, 1]


def test_what_holds_at_rest_alone_is_seen_by_exact_and_numerical_arithmetic_only():
    one = all_measured(AT_REST_APART, ("T",), (0.0,))
    index = {method: observe(one, [0], [(0,)], method).index.tolist() for method in METHODS}
    assert index == {"structural": [2], "coupled": [2], "exact": [0], "numerical": [0]}


def test_the_equilibrium_of_the_exact_method_is_found_beyond_double_precision():
    # x rests at the cube root of 5, which no double is. There y' does not depend on it, but next to it it does.
    cube = Model(
        name="cube",
        description="x' = u - x^3, y' = (x^3 - u)^2 + z - y, z' = -z",
        equations=lambda t, x, m, u, p: (
            {"x": u.u - x.x**3, "y": (x.x**3 - u.u) ** 2 + x.z - x.y, "z": -x.z},
            {},
        ),
        states=(Signal("x", start=5.0 ** (1 / 3)), Signal("y"), Signal("z")),
        inputs=(Signal("u", start=5.0),),
    )
    one = all_measured(cube, ("y",), (0.0,))
    assert one.space.A[1, 0] != 0.0
    found = observe(one, [0, 2], [(0,)], "exact")
    assert found.states.tolist() == [[0, 1, 2]] and found.hidden(0) == [0]
    assert found.evidence["digits"] == 120 and observe(one, [0], [(0,)], "coupled").index.tolist() == [3]


def test_an_equilibrium_that_is_not_isolated_is_refused_where_it_is_none_of_doubles():
    # p^2 = 2 q^2 has a line of equilibria and no point in doubles on it.
    free = Model(
        name="free",
        description="p' = 2 q^2 - p^2, q' = p^2 - 2 q^2",
        equations=lambda t, x, m, u, p: ({"p": 2 * x.q**2 - x.p**2, "q": x.p**2 - 2 * x.q**2}, {}),
        states=(Signal("p", start=2.0**0.5), Signal("q", start=1.0)),
    )
    with pytest.raises(ArithmeticError, match="there is no isolated equilibrium at the point: A is singular there"):
        observe(all_measured(free, ("p",), (0.0,)), [0], [(0,)], "exact")


def test_a_method_that_wants_equations_says_so():
    one = all_measured(ONE_FLOW, ("T",), (0.0,))
    without = Measured(one.space, one.sensors, one.time_constants, one.structure)
    for method in ("coupled", "exact"):
        with pytest.raises(ValueError, match=f"the method {method} wants the equations of a model"):
            observe(without, [0], [(0,)], method)


def test_a_scaling_that_is_singular_is_named():
    one = all_measured(ONE_FLOW, ("T",), (0.0,))
    states = (Signal("p", nominal=0.0), *one.space.states[1:])
    flat = StateSpace(**{**one.space.__dict__, "states": states})
    with pytest.raises(ValueError, match="the scaling is singular: p has the nominal value 0"):
        observe(Measured(flat, one.sensors, one.time_constants, one.structure), [0], [(0,)], "numerical")


# The engine.


@pytest.mark.parametrize("choked", [False, True], ids=["open", "choked"])
def test_the_plant_has_the_papers_structure_while_all_flows_go_forwards(choked):
    A, C = paper_structure(choked)
    structure = measured("choked" if choked else "open").structure
    every = np.concatenate([structure.C, np.eye(13, dtype=bool)])
    assert (structure.A == A).all() and (every[measured("open").places] == C).all()


@pytest.mark.parametrize("choked", [False, True], ids=["open", "choked"])
def test_the_engine_is_structurally_observable_from_any_single_sensor_as_published(choked):
    A, C = paper_structure(choked)
    assert all(structurally_observable(A, C[[sensor]]) for sensor in range(17))


@pytest.mark.parametrize("choked", [False, True], ids=["open", "choked"])
def test_primes_and_seeds_agree_on_every_set_of_one_two_and_three_sensors(choked):
    A, C = paper_structure(choked)
    sets = sets_of(1, 2, 3)
    assert len(sets) == 17 + 136 + 680
    found = [
        spanned_units(free_rows(A, C, LAGS, Field(bits), seed), sets, Field(bits))
        for bits in (31, 61)
        for seed in (0, 1)
    ]
    assert all((other == found[0]).all() for other in found[1:])


def test_primes_and_seeds_agree_on_all_131071_sets():
    A, C = paper_structure(choked=False)
    sets = sets_of(*range(1, 18))
    assert len(sets) == 2**17 - 1
    found = [
        subset_index(spanned_units(free_rows(A, C, LAGS, Field(bits), bits), sets, Field(bits), threads=2), WANTED)
        for bits in (31, 61)
    ]
    assert (found[0] == found[1]).all() and (found[0] > 0).all()
    # A slow sensor on T_im alone sees it late, and no sensor sees it at once: no set has an index of 1.
    assert found[0].min() == 2


@pytest.mark.parametrize("throttle", ["open", "choked"])
@pytest.mark.parametrize("method", ["structural", "coupled"])
def test_primes_and_seeds_agree_on_the_plant(throttle, method):
    sets = sets_of(1, 2, 3)
    found = [
        observe(measured(throttle), WANTED, sets, method, Options(Field(bits), seed)).index
        for bits, seed in ((61, 0), (61, 1), (31, 2))
    ]
    assert (found[0] == found[1]).all() and (found[0] == found[2]).all()


@pytest.mark.parametrize("throttle", ["open", "choked"])
@pytest.mark.parametrize("method", METHODS)
def test_the_states_themselves_are_the_only_triple_of_index_2_by_every_method(throttle, method):
    index = observe(measured(throttle), WANTED, TRIPLES, method).index
    assert [TRIPLES[i] for i in np.flatnonzero((index > 0) & (index <= 2))] == [places(ESTIMATE)]
    assert index[TRIPLES.index(places(ESTIMATE))] == 2


@pytest.mark.parametrize("throttle", ["open", "choked"])
@pytest.mark.parametrize(("richness", "parameters"), [(1.0, ""), (0.9, ""), (1.0, "A_realistic"), (1.0, "B")])
def test_at_equilibria_five_of_680_triples_have_an_index_of_at_most_3_as_the_paper_concludes(
    throttle, richness, parameters
):
    index = observe(measured(throttle, richness, parameters), WANTED, TRIPLES, "exact").index
    few = {TRIPLES[i]: int(index[i]) for i in np.flatnonzero(index <= 3)}
    published = {places(names): at_most for names, at_most in TABLE_1.items()}
    assert len(few) == 5 and few.keys() < published.keys()
    assert few == {
        places(names): 2 if names == ESTIMATE else 3 for names in TABLE_1 if names != ("p_im", "p_em", "p_t")
    }
    # The row of Table 1 that is none of the five: one derivative more than published.
    assert index[TRIPLES.index(places(("p_im", "p_em", "p_t")))] == 5


@pytest.mark.parametrize("throttle", ["open", "choked"])
def test_what_the_structure_alone_allows_is_never_less_than_what_the_couplings_leave(throttle):
    found = {m: observe(measured(throttle), WANTED, sets_of(1, 2, 3), m) for m in EXACT_METHODS}
    for seen in found.values():
        assert (seen.index > 0).all(), "every set sees the estimate"
    # Each tie more leaves fewer rows independent: the whole state is seen no earlier.
    assert (found["structural"].whole <= found["coupled"].whole).all()
    assert (found["coupled"].whole <= found["exact"].whole).all()


def test_the_index_of_the_whole_state_is_no_less_than_states_over_sensors():
    for size in (1, 2, 3, 4):
        sets = sets_of(size)
        whole = observe(measured("open"), WANTED, sets, "structural").whole
        # A slow sensor's first value is its own state's: it gives one row less.
        bound = [-(-(13 + sum(LAGS[m] for m in members)) // size) for members in sets]
        assert (whole >= bound).all()


def test_lags_stand_for_the_augmented_system_by_singular_values():
    one = measured("open")
    rows = np.concatenate([one.space.C, np.eye(13)])[one.places]
    system = scaled(one.space.A, rows, np.array(one.time_constants), scales(one.space.states))
    pairs = [TRIPLES[i] for i in range(0, 680, 9)]
    index = numerical_indices(system, pairs, WANTED).subset
    exact = observe(one, WANTED, pairs, "exact").index
    # Rounding hides the highest derivatives of a few sets; what is seen is seen when the exact method says.
    assert ((index == exact) | (index == 0) | (exact > 6)).all()
    assert ((index == exact).mean()) > 0.9


@pytest.mark.parametrize("sensors", [("p_im", "T_im", "p_em"), ("T_im", "p_em", "T_em"), ("W_af", "T_t")])
def test_lags_stand_for_a_model_with_its_sensors_states_in_it(sensors):
    augmented = with_sensors(MODEL, sensors)
    system = LinearModel(augmented)
    u = at(system.inputs, {})
    x = settle(system, at(system.states, {}), u)
    space = linearised(system, x, u)
    names = tuple(f"{name}_sensor" for name in sensors)
    inside = Measured(space, names, (0.0,) * len(names), branch_structure(Branch(system, x, u)), system)
    outside = measured_at_start()
    members = tuple(outside.sensors.index(name) for name in sensors)
    every = tuple(range(len(names)))
    for method in EXACT_METHODS:
        with_states = observe(inside, range(13), [every], method).states
        with_lags = observe(outside, range(13), [members], method).states
        assert with_states[0][:13].tolist() == with_lags[0].tolist()
        assert set(with_states[0][13:].tolist()) <= {1}


def measured_at_start() -> Measured:
    system = LinearModel(MODEL)
    u = at(system.inputs, {})
    x = settle(system, at(system.states, {}), u)
    taus = tuple(3.0 * lag for lag in LAGS)
    return Measured(linearised(system, x, u), SENSORS, taus, branch_structure(Branch(system, x, u)), system)


@pytest.mark.parametrize("method", ["structural", "coupled", "exact"])
def test_a_sensor_more_never_raises_the_index_on_the_engine(method):
    sets = sets_of(1, 2, 3)
    index = dict(zip(sets, observe(measured("open"), WANTED, sets, method).index.tolist(), strict=True))
    for members in sets_of(2, 3):
        assert index[members] <= min(index[fewer] for fewer in combinations(members, len(members) - 1))


def test_the_numerical_index_hangs_on_tolerance_and_scaling_where_the_exact_one_does_not():
    """With a tolerance that counts more of what is small as zero, rows are lost, and so are sets."""
    counts = [
        histogram(observe(measured("choked"), WANTED, TRIPLES, "numerical", Options(tolerance=tolerance)).index)
        for tolerance in (None, 1e-12, 1e-8)
    ]
    assert counts[0].get(0, 0) < counts[1][0] < counts[2][0]
    assert 0 not in histogram(observe(measured("choked"), WANTED, TRIPLES, "exact").index)


def test_states_and_sensors_are_those_of_the_paper():
    assert len(STATE_NAMES) == 13 and len(SENSORS) == 17 and sum(LAGS) == 6
    assert Structure(*paper_structure(False), "typed in").A.sum() == 67
