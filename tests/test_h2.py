"""The semidefinite program against the Riccati equation, its published form and inequalities, and what it refuses."""

from __future__ import annotations

import warnings
from dataclasses import replace

import cvxpy as cp
import numpy as np
import pytest
from estimations import engine_estimation, given, random_estimation, scipy_cost, subsets

from selection.estimation import EstimationError
from selection.h2 import (
    HARDLY,
    SETTLED,
    Program,
    SdpError,
    published_inequalities,
    refit,
    reweighted,
    scaling,
)
from selection.riccati import Costs, best_filter, error_norm
from selection.tradeoff import trade


def program_of(system) -> Program:
    return Program(system, scaling(system, "deviation"))


@pytest.mark.parametrize(("seed", "n", "m", "growth"), [(1, 2, 2, -0.5), (2, 4, 3, -0.5), (3, 5, 3, 0.3)])
def test_without_the_l1_norm_the_program_is_the_riccati_equation_for_every_set(seed, n, m, growth):
    system = random_estimation(seed, n, m, growth)
    for members in subsets(m, *range(1, m + 1)):
        solution = refit(system, members)
        # What is promised is 1e-4; the solver stops at 1e-8.
        assert solution.trace == pytest.approx(scipy_cost(system, members), rel=1e-6)
        assert solution.status == "optimal" and max(solution.residuals[:3]) <= 1e-6
        own = system.on(members)
        norm, decay = error_norm(own, solution.gain)
        assert norm == pytest.approx(solution.trace, rel=1e-5) and decay > 0.0


@pytest.mark.parametrize("members", [(16,), (12, 16), (0, 7, 11), (6, 8, 12, 15, 16)])
def test_on_the_engine_the_program_is_the_riccati_equation(members):
    system = engine_estimation()
    assert refit(system, members).trace == pytest.approx(best_filter(system, members).trace, rel=1e-6)


def test_in_nominal_units_the_program_is_the_riccati_equation_too():
    system = random_estimation(4, 4, 3)
    program = Program(system, scaling(system, "nominal"))
    assert program.solve(0.0, np.zeros(3)).trace == pytest.approx(program.unit, rel=1e-6)


def published(system, unit: float, alpha: float, weights) -> float:
    """The least of Eq. 15 as it is printed, with T of process and sensors together; of a system that is scaled."""
    n, m = len(system.A), len(system.C)
    values, vectors = np.linalg.eigh(system.process)
    G, W = vectors * np.sqrt(np.maximum(values, 0.0)), system.W / np.sqrt(unit)
    P, Q = cp.Variable((n, n), symmetric=True), cp.Variable((n, m))
    T = cp.Variable((n + m, n + m), symmetric=True)
    both = cp.hstack([P @ G, -Q @ np.diag(np.sqrt(system.noise))])
    drift = P @ system.A + system.A.T @ P - Q @ system.C - system.C.T @ Q.T + W.T @ W
    used = sum(weights[j] * cp.norm1(Q[:, j]) for j in range(m))
    problem = cp.Problem(
        cp.Minimize((1.0 - alpha) * cp.trace(T) + alpha * used),
        [cp.bmat([[T, both.T], [both, P]]) >> 0, -0.5 * (drift + drift.T) >> 0],
    )
    problem.solve(solver=cp.CLARABEL)
    assert problem.status == cp.OPTIMAL
    return float(problem.value)


@pytest.mark.parametrize("alpha", [0.0, 0.05, 0.3])
def test_the_program_has_the_least_of_the_published_one(alpha):
    system = random_estimation(6, 3, 3)
    program = program_of(system)
    weights = np.array([2.0, 0.5, 1.0])
    ours = program.solve(alpha, weights)
    least = (1.0 - alpha) * ours.trace / program.unit + alpha * float(weights @ ours.norms)
    assert least == pytest.approx(published(program.scaled, program.unit, alpha, weights), rel=1e-6)


@pytest.mark.parametrize("alpha", [0.0, 0.05, 0.3])
def test_what_comes_out_satisfies_the_published_inequalities(alpha):
    for system in (random_estimation(6, 3, 3), random_estimation(7, 5, 4, growth=0.2)):
        program = program_of(system)
        solution = program.solve(alpha, np.ones(len(system.C)))
        trace, violation = published_inequalities(program.scaled, solution.P, solution.Q, program.unit)
        assert violation <= 1e-6
        assert trace * program.unit == pytest.approx(solution.trace, rel=1e-6)
        assert np.linalg.eigvalsh(solution.P)[0] > 0.0
        # T bounds the error system's norm from above, and is that norm with alpha = 0 (Eqs. 11 to 13).
        norm, _ = error_norm(system, solution.gain)
        assert norm <= solution.trace * (1.0 + 1e-6)


def test_published_inequalities_that_do_not_hold_are_seen():
    program = program_of(random_estimation(6, 3, 3))
    solution = program.solve(0.0, np.zeros(3))
    _, violation = published_inequalities(program.scaled, 0.5 * solution.P, solution.Q, program.unit)
    assert violation > 1e-3


def test_weights_go_on_until_they_stay_and_the_sensors_used_count_one_each():
    system = random_estimation(20, 4, 5)
    program = program_of(system)
    full = program.solve(0.0, np.zeros(5))
    relaxed = reweighted(program, 0.05, full)
    assert relaxed.settled and relaxed.rounds > 1
    again = program.solve(0.05, relaxed.weights)
    assert again.norms == pytest.approx(relaxed.solution.norms, rel=1e-4, abs=1e-6 * full.norms.max())
    following = 1.0 / (relaxed.solution.norms + HARDLY * full.norms.max())
    assert np.abs(following * relaxed.solution.norms - relaxed.counted).max() <= 2 * SETTLED
    assert relaxed.number == round(relaxed.counted.sum()) and len(relaxed.chosen()) == relaxed.number
    used = set(relaxed.chosen())
    assert min(relaxed.solution.norms[j] for j in used) > max(relaxed.solution.norms[j] for j in set(range(5)) - used)


def test_a_sensor_that_must_be_there_weighs_nothing_and_is_there():
    system = random_estimation(20, 4, 5)
    program = program_of(system)
    full = program.solve(0.0, np.zeros(5))
    worst = int(np.argmin(full.norms))
    relaxed = reweighted(program, 0.9, full, [worst])
    assert relaxed.weights[worst] == 0.0 and relaxed.chosen([worst]) == (worst,)


def test_the_trade_finds_a_set_of_each_number_of_sensors_the_best_or_nearly_so():
    system = random_estimation(31, 4, 5)
    told: list[int] = []
    found = trade(system, "deviation", range(1, 5), tell=told.append)
    assert told == list(range(1, len(found.tried) + 1))
    costs = Costs(system)
    assert {len(one.sensors) for one in found.chosen} | set(found.missing) == {1, 2, 3, 4}
    for one in found.chosen:
        assert one.solution.trace == pytest.approx(costs.cost(one.sensors), rel=1e-6)
        least = min(costs.cost(members) for members in subsets(5, len(one.sensors)))
        # No guarantee, so a loose bound: the program is a heuristic, and the gap is what a selection prints.
        assert least * (1.0 - 1e-6) <= one.solution.trace <= 1.5 * least
    assert [one.alpha for one in found.tried] == sorted(one.alpha for one in found.tried)
    traces = [one.relaxed.solution.trace for one in found.tried]
    assert traces[0] < traces[-1]


def test_a_trade_keeps_to_must_and_forbid():
    system = random_estimation(31, 4, 5)
    found = trade(system, "deviation", [2, 3], must=[4], forbid=[0])
    assert found.allowed == (1, 2, 3, 4)
    assert found.chosen and all(4 in one.sensors and 0 not in one.sensors for one in found.chosen)


@pytest.fixture
def hurried(monkeypatch: pytest.MonkeyPatch) -> None:
    """A solver that has to stop long before it is done."""
    solve = cp.Problem.solve
    monkeypatch.setattr(cp.Problem, "solve", lambda self, **rest: solve(self, max_iter=3, **rest))


def test_a_solver_that_does_not_get_there_is_told_in_its_words(hurried):
    program = program_of(random_estimation(6, 3, 3))
    with warnings.catch_warnings(), pytest.raises(SdpError, match=r"alpha 0.*CLARABEL (ended with the status|failed)"):
        warnings.simplefilter("error")
        program.solve(0.0, np.zeros(3))


@pytest.mark.parametrize("status", ["optimal_inaccurate", "infeasible", "infeasible_inaccurate", "unbounded"])
def test_any_status_but_optimal_is_refused(monkeypatch: pytest.MonkeyPatch, status):
    program = program_of(random_estimation(6, 3, 3))
    monkeypatch.setattr(cp.Problem, "status", status)
    with pytest.raises(SdpError, match=f"CLARABEL ended with the status {status}, wants optimal"):
        program.solve(0.1, np.ones(3))


def test_a_solution_that_is_said_optimal_but_violates_what_was_asked_is_refused(monkeypatch: pytest.MonkeyPatch):
    program = program_of(random_estimation(6, 3, 3))
    solve = cp.Problem.solve

    def spoilt(self, **rest):
        solve(self, **rest)
        program._T.value = 0.9 * program._T.value

    monkeypatch.setattr(cp.Problem, "solve", spoilt)
    with pytest.raises(SdpError, match=r"said optimal, but what it returned is off: performance \d"):
        program.solve(0.0, np.zeros(3))


def test_one_alpha_at_which_the_solver_fails_is_marked_and_the_others_count(monkeypatch: pytest.MonkeyPatch):
    solve, calls = Program.solve, []

    def failing(self, alpha, weights):
        calls.append(alpha)
        if alpha == 0.5:
            raise SdpError("alpha 0.5: CLARABEL ended with the status optimal_inaccurate, wants optimal")
        return solve(self, alpha, weights)

    monkeypatch.setattr(Program, "solve", failing)
    found = trade(random_estimation(31, 4, 5), "deviation", [1, 2])
    (failed,) = [one for one in found.tried if one.relaxed is None]
    assert (failed.alpha, failed.sensors) == (0.5, None) and "optimal_inaccurate" in failed.why
    assert found.chosen


def test_what_cannot_be_solved_is_refused_before_the_solver_sees_it():
    system = given([[0.3, 0.0], [0.0, -1.0]], [[0.0, 1.0], [1.0, 0.0]], np.eye(2), [1.0, 1.0], np.eye(2))
    with pytest.raises(EstimationError, match=r"undetectable: y0 does not see the mode at 0.3 1/s in x0"):
        refit(system, [0])
    still = replace(random_estimation(2, 2, 2), process=np.diag([1.0, 0.0]), A=np.diag([-1.0, -2.0]))
    with pytest.raises(EstimationError, match="a scaling of the states by deviation is singular: no noise moves x1"):
        program_of(still)
    with pytest.raises(EstimationError, match="the error is zero with all sensors"):
        Program(replace(still, process=np.zeros((2, 2))), np.ones(2))
    with pytest.raises(SdpError, match="alpha wants 0 or more and less than 1, got 1"):
        program_of(random_estimation(6, 3, 3)).solve(1.0, np.ones(3))
