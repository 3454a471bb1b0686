"""Ranks sets of sensors by the error of the best filter: the optimum of each size, or what the H2 program chooses."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from fmus.component import ConfigurationError
from fmus.statespace import StateSpace, scales
from harness.operating import Operation
from harness.selectionsystem import plant_of, sensor_told, system_told, within_budget
from harness.wishes import Choice, Wishes
from selection.bestsets import Best, best_sets, gap
from selection.estimation import Estimation, EstimationError, estimation_of, refuse_unsound, unseen_by
from selection.h2 import SdpError, Solution
from selection.optimal import Terms, worst_loss
from selection.ranking import Told, count_sets, sets_within
from selection.riccati import Costs
from selection.tradeoff import MOST_ALPHAS, Tradeoff, Tried, trade

# Sets up to which every one is solved for, a fraction of a millisecond each up to so many states and with their cube
# from there; of more the best of each size are shown.
FEW_SETS, FEW_STATES = 10_000, 30
KEYS = ("error", "cost")


@dataclass(frozen=True)
class Optimised:
    """A selection by error: the sets that the method gives, best first, all sets where they are few, and the rest."""

    rows: Sequence[Mapping[str, Any]]
    every: Sequence[Mapping[str, Any]]
    about: Mapping[str, Any]

    def sets(self, most: int | None = None) -> list[Mapping[str, Any]]:
        """The best so many of those that the method gives, or all sets."""
        return list(self.every if most is None else self.rows[:most])

    def to_json(self, most: int | None) -> dict[str, Any]:
        """The selection with its best so many sets, or all."""
        sets = self.sets(most)
        head = {key: self.about[key] for key in ("estimate", "method")}
        return {**head, "sets": sets, "shown": len(sets), **self.about}


def optimise(operation: Operation, space: StateSpace, choice: Choice, wishes: Wishes, tell: Told) -> Optimised:
    """The selection by error that the wishes ask for, at an equilibrium.

    Raises ConfigurationError: the estimation has no answer, and why; no set is within the budget; the solver of the
    semidefinite program fails, in its words.
    """
    names = [signal.name for signal in choice.signals]
    states = [state.name for state in space.states]
    whole = estimation_of(plant_of(space, choice), choice.wanted, states, names)
    system = whole.moved()
    try:
        refuse_unsound(system)
        return _optimised(operation, space, choice, wishes, whole, system, tell)
    except (EstimationError, SdpError) as error:
        raise ConfigurationError(f"{operation.target}: {error}") from error


def _optimised(
    operation: Operation,
    space: StateSpace,
    choice: Choice,
    wishes: Wishes,
    whole: Estimation,
    system: Estimation,
    tell: Told,
) -> Optimised:
    limits, names = choice.limits, system.sensors
    terms = Terms(np.array(choice.costs), limits.must, limits.forbid, wishes.budget)
    sizes = range(max(1, len(limits.must)), min(limits.most, len(limits.must) + len(terms.free)) + 1)
    costs = Costs(system)
    best = {one.size: one for one in best_sets(system, costs, terms, sizes, tell=tell)}
    if all(one.optimum.sensors is None for one in best.values()):
        raise ConfigurationError(f"{operation.target}: {_no_set(system, terms, max(sizes))}")
    table = _Table(system, costs, space, choice, best)
    notes = _notes(whole, system)
    swept = _swept(system, wishes, terms, sizes, tell) if wishes.method == "h2" else None
    considered = count_sets(len(names), limits)
    every: list[dict[str, Any]] = []
    if considered <= FEW_SETS * min(1.0, FEW_STATES / len(system.A)) ** 3:
        sets = within_budget(sets_within(len(names), limits), choice, wishes)
        for done, members in enumerate(sets):
            every.append(table.row(members))
            tell("every set", done + 1, len(sets))
    if swept is not None:
        chosen = {one.sensors: one for one in swept.chosen if terms.allow(one.sensors)}
        notes += _swept_notes(swept, names, terms)
        rows = [{**table.row(m), **_solved(one.alphas, one.solution, one.why)} for m, one in chosen.items()]
        every = [row for row in every if tuple(row["sensors"]) not in {tuple(r["sensors"]) for r in rows}] + rows
    else:
        shown = {m for one in best.values() for m in _sets_of(one)}
        rows = every or [table.row(members) for members in sorted(shown)]
        if not every:
            notes.append(f"the best, the safest and the greedy set of each size of {considered} sets, not all of them")
    none, everything = costs.variances(()), costs.variances([*sorted(limits.must), *terms.free])
    about = {
        **system_told(operation, space, choice, wishes),
        "considered": considered,
        "by": [key for key in wishes.by if key in KEYS] or ["error"],
        "sensors": [sensor_told(choice, place) for place in range(len(names))],
        "without_sensors": table.error(none),
        "with_all_sensors": table.error(everything),
        "by_size": [table.size(best[size]) for size in sizes],
        "curve": [] if swept is None else [_point(one, swept, names) for one in swept.tried],
        "scaling": wishes.scaling if swept is not None else None,
        "solves": costs.solves,
        "notes": notes,
    }
    by = about["by"]
    return Optimised(_ranked(rows, by), _ranked(every or rows, by), about)


def _swept(system: Estimation, wishes: Wishes, terms: Terms, sizes: Sequence[int], tell: Told) -> Tradeoff:
    def hear(done: int) -> None:
        tell("values of alpha", done, MOST_ALPHAS)

    return trade(system, wishes.scaling, sizes, sorted(terms.must), sorted(terms.forbid), hear)


@dataclass(frozen=True)
class _Table:
    """Rows about sets: what each costs, how large the errors are, and how far it is from the best of its size."""

    system: Estimation
    costs: Costs
    space: StateSpace
    choice: Choice
    best: Mapping[int, Best]

    def row(self, members: Sequence[int]) -> dict[str, Any]:
        """A set as `crankbench select --json` prints it; what a method does not give is null."""
        variances = self.costs.variances(members)
        lost_cost, lost = worst_loss(self.costs, members)
        known = variances is not None
        best = self.best[len(members)].optimum
        return {
            "sensors": self.names(members),
            "index": None,
            "cost": math.fsum(self.choice.costs[m] for m in members),
            "error": self.error(variances),
            "errors": self._errors(variances),
            "trace": float(variances.sum()) if variances is not None else None,
            "gap": gap(float(variances.sum()), best) if variances is not None else None,
            "error_after_loss": self._of_cost(lost_cost),
            "lost": self.system.sensors[lost],
            "why": "" if known else f"undetectable: it does not see {unseen_by(self.system, members)}",
            "trace_T": None,
            "alphas": [],
            "status": None,
            "residuals": None,
        }

    def size(self, one: Best) -> dict[str, Any]:
        """The best set of a size, with the proof, the greedy set and the safest beside it."""
        optimum, found = one.optimum, one.filter
        told: dict[str, Any] = {
            "size": one.size,
            "sensors": self.names(optimum.sensors) if optimum.sensors else None,
            "trace": optimum.cost if optimum.sensors else None,
            "error": self._of_cost(optimum.cost),
            "proof": {"bound": optimum.bound, "branches": optimum.branches, "proven": optimum.proven},
            "certificate": None,
            "greedy": None,
            "safest": None,
        }
        if found is not None:
            told["certificate"] = {
                "trace": found.trace,
                "trace_of_error_system": found.trace_again,
                "residual": found.left_over,
                "slowest_decay": found.decay,
            }
        if one.grown is not None and optimum.sensors:
            told["greedy"] = {
                "sensors": self.names(one.grown.sensors),
                "gap": gap(one.grown.cost, optimum),
                "guaranteed_gap": one.grown.cost / one.grown.guarantee - 1.0 if one.grown.guarantee > 0.0 else None,
            }
        if one.safest is not None and one.safest.sensors:
            told["safest"] = {
                "sensors": self.names(one.safest.sensors),
                "error": self.error(self.costs.variances(one.safest.sensors)),
                "error_after_loss": self._of_cost(one.safest.cost),
                "proof": {
                    "bound": one.safest.bound,
                    "branches": one.safest.branches,
                    "proven": one.safest.proven,
                },
            }
        return told

    def names(self, members: Iterable[int]) -> list[str]:
        """Sensors by name."""
        return [self.system.sensors[m] for m in members]

    def error(self, variances: Any) -> float | None:
        """The root mean square of the errors over the states' sizes; None where they grow without bound."""
        return None if variances is None else float(np.sqrt(np.mean(variances)))

    def _of_cost(self, cost: float) -> float | None:
        return math.sqrt(cost / len(self.choice.wanted)) if math.isfinite(cost) else None

    def _errors(self, variances: Any) -> dict[str, float] | None:
        """Expected root mean square errors in SI by state."""
        if variances is None:
            return None
        wanted = [self.space.states[j] for j in self.choice.wanted]
        roots = np.sqrt(np.maximum(variances, 0.0)) * scales(wanted)
        return {state.name: float(root) for state, root in zip(wanted, roots, strict=True)}


def _sets_of(one: Best) -> list[tuple[int, ...]]:
    found = [one.optimum.sensors, one.safest and one.safest.sensors, one.grown and one.grown.sensors]
    return [members for members in found if members]


def _solved(alphas: Sequence[float], solution: Solution | None, why: str) -> dict[str, Any]:
    """What the program says of a set that it chose: trace(T) with alpha = 0 on its rows, status and residuals."""
    if solution is None:
        return {"alphas": list(alphas), "status": "failed", "why": why}
    return {
        "alphas": list(alphas),
        "trace_T": solution.trace,
        "status": solution.status,
        "residuals": solution.residuals._asdict(),
    }


def _point(one: Tried, swept: Tradeoff, names: Sequence[str]) -> dict[str, Any]:
    """One alpha of the trade-off curve; null and the solver's words where it failed."""
    relaxed = one.relaxed
    told: dict[str, Any] = {"alpha": one.alpha, "sensors": None, "number": None, "trace_T": None, "why": one.why}
    if relaxed is None or one.sensors is None:
        return {**told, "used": None, "rounds": None, "status": "failed", "residuals": None}
    used = {names[m]: float(value) for m, value in zip(swept.allowed, relaxed.counted, strict=True)}
    return {
        **told,
        "sensors": [names[m] for m in one.sensors],
        "number": float(relaxed.counted.sum()),
        "trace_T": relaxed.solution.trace,
        "used": used,
        "rounds": relaxed.rounds,
        "status": relaxed.solution.status,
        "residuals": relaxed.solution.residuals._asdict(),
    }


def _notes(whole: Estimation, system: Estimation) -> list[str]:
    still = [state for state in whole.states if state not in system.states]
    return [f"no noise moves {', '.join(still)}: left out, a filter knows them without error"] if still else []


def _swept_notes(swept: Tradeoff, names: Sequence[str], terms: Terms) -> list[str]:
    notes = []
    if swept.missing:
        notes.append(f"no alpha tried gave {', '.join(map(str, swept.missing))} sensors")
    failed = [f"{one.alpha:.3g}" for one in swept.tried if one.relaxed is None]
    if failed:
        notes.append(f"the solver failed at alpha {', '.join(failed)}; see the curve for its words")
    unsettled = [f"{one.alpha:.3g}" for one in swept.tried if one.relaxed and not one.relaxed.settled]
    if unsettled:
        notes.append(f"the weights did not settle at alpha {', '.join(unsettled)}")
    for one in swept.chosen:
        if not terms.allow(one.sensors):
            notes.append(
                f"the program chose {' '.join(names[m] for m in one.sensors)}, which the budget does not allow"
            )
    return notes


def _no_set(system: Estimation, terms: Terms, most: int) -> str:
    allowed = [*sorted(terms.must), *terms.free]
    unseen = unseen_by(system, allowed)
    if unseen:
        return f"undetectable: all sensors allowed together do not see {unseen}"
    return f"no set of at most {most} sensors within the budget sees every mode that does not die out"


def _ranked(rows: Iterable[Mapping[str, Any]], by: Sequence[str]) -> list[Mapping[str, Any]]:
    def key(row: Mapping[str, Any]) -> tuple[Any, ...]:
        measured = [math.inf if row[name] is None else row[name] for name in dict.fromkeys((*by, "error", "cost"))]
        return (*measured, len(row["sensors"]), row["sensors"])

    return sorted(rows, key=key)
