"""Ranks the sets of sensors that a user asks about: reads the wishes, evaluates, and says it as JSON has it."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING, Any

import numpy as np

from fmus.component import ConfigurationError
from fmus.model import ModelError
from fmus.statespace import StateSpace, scales
from harness.operating import Operation, operate
from harness.selectionsystem import is_moving, moving, plant_of, refuse_unrest, sensor_told, system_told, within_budget
from harness.wishes import MEASURES, Choice, Wishes, understand
from selection.methods import ByIndex
from selection.observability import Measured, Options, observe
from selection.ranking import Asked, Ranked, Told, as_json, evaluate, rank, sets_within
from selection.structure import Structure, distances, structurally_observable

if TYPE_CHECKING:
    from harness.optimising import Optimised

# Sets up to which Gramian and Kalman error are taken without being asked for, about a quarter of a minute.
FEW_SETS = 10_000
# Sensors up to which the index of every pair is given.
FEW_SENSORS = 60
# States up to which the theorem on structural observability is asked of each sensor, a tenth of a second each.
FEW_STATES = 100
SHOWN = 20


@dataclass(frozen=True)
class Selected:
    """A selection: all sets, best first, and everything else as `crankbench select --json` prints it."""

    rows: Sequence[Ranked]
    names: Sequence[str]
    wanted: Sequence[str]
    sizes: Sequence[float]
    about: Mapping[str, Any]

    def sets(self, most: int | None = None) -> list[dict[str, Any]]:
        """The best so many sets, or all."""
        return [as_json(row, self.names, self.wanted, self.sizes) for row in self.rows[:most]]

    def to_json(self, most: int | None) -> dict[str, Any]:
        """The selection with its best so many sets, or all."""
        sets = self.sets(most)
        head = {key: self.about[key] for key in ("estimate", "method")}
        return {**head, "sets": sets, "shown": len(sets), **self.about}


def select(operation: Operation, wishes: Wishes, others: Sequence[Operation], tell: Told) -> Selected | Optimised:
    """All sets that the wishes allow, ranked; `others` are points whose structures are shown beside.

    Raises ConfigurationError: names that are not known, a point that is no equilibrium, nothing that sees the states.
    """
    operating = operate(operation)
    choice = understand(operating, wishes)
    space = operating.space
    refuse_unrest(space, wishes)
    if wishes.method == "h2" or wishes.method == "optimal":
        from harness.optimising import optimise

        return optimise(operation, space, choice, wishes, tell)
    structure = operating.structure()
    notes: list[str] = []
    names = tuple(signal.name for signal in choice.signals)
    measured = Measured(space, names, choice.lags, structure, operating.model)
    sets = within_budget(sets_within(len(names), choice.limits), choice, wishes)
    measures = _measures(wishes, space, len(sets), notes)
    asked = Asked(
        choice.wanted,
        sets,
        wishes.method,
        Options(seed=wishes.seed, tolerance=wishes.tolerance, threads=wishes.threads),
        choice.costs,
        plant_of(space, choice) if measures else None,
        frozenset(measures),
    )
    try:
        rows, seen = evaluate(measured, asked, tell)
        pairs, sees = _pairs(measured, asked), _sees(measured, asked)
    except (ValueError, ArithmeticError, ModelError) as error:
        raise ConfigurationError(f"{operation.target}: {error}") from error
    ranked = rank(rows, wishes.by)
    wanted = [space.states[j] for j in choice.wanted]
    if not any(row.index for row in ranked):
        raise ConfigurationError(_unseen(ranked, names, [s.name for s in wanted]))
    about = {
        **system_told(operation, space, choice, wishes),
        "considered": len(ranked),
        "counts": _counts(ranked),
        "by": list(wishes.by),
        "evidence": seen.evidence,
        "sensors": [
            _sensor(i, measured, choice, {space.states[j].name: rho for j, rho in sees[i].items()})
            for i in range(len(names))
        ],
        "sees_by": _sees_by(asked.method),
        "pairs": pairs,
        "structure": _structures(measured, structure, operation, others),
        "measures": sorted(measures),
        "notes": notes,
    }
    return Selected(ranked, names, [s.name for s in wanted], [float(z) for z in scales(wanted)], about)


def _measures(wishes: Wishes, space: StateSpace, count: int, notes: list[str]) -> set[str]:
    """The measures to take; those asked for or, of few sets, all, where the point is an equilibrium."""
    asked = set(MEASURES if wishes.measures is None else wishes.measures)
    if asked and is_moving(space):
        notes.append(
            f"no {' and '.join(sorted(asked))}: the point is no equilibrium, {moving(space)}; --settle finds one"
        )
        return set()
    if wishes.measures is None and count > FEW_SETS:
        notes.append(f"no {' and '.join(sorted(asked))} of {count} sets unless asked for: --measures gramian,kalman")
        return set()
    return asked


def _pairs(measured: Measured, asked: Asked) -> list[list[int | None]] | None:
    """The index of every pair, and on the diagonal of every single sensor; None where there are too many."""
    count = len(measured.sensors)
    if count > FEW_SENSORS:
        return None
    sets = [*((i,) for i in range(count)), *combinations(range(count), 2)]
    index = observe(measured, asked.wanted, sets, asked.method, asked.options).index
    found: list[list[int | None]] = [[None] * count for _ in range(count)]
    for members, value in zip(sets, index, strict=True):
        found[members[0]][members[-1]] = found[members[-1]][members[0]] = int(value) or None
    return found


def _sees_by(method: ByIndex) -> ByIndex:
    """The method by which is told what each sensor sees: that of the selection where it knows each state."""
    return "structural" if method == "numerical" else method


def _sees(measured: Measured, asked: Asked) -> list[dict[int, int]]:
    """By sensor, the index of each state that it sees alone."""
    singles = [(i,) for i in range(len(measured.sensors))]
    states = observe(measured, asked.wanted, singles, _sees_by(asked.method), asked.options).states
    assert states is not None
    return [{j: int(rho) for j, rho in enumerate(row) if rho} for row in states]


def _sensor(place: int, measured: Measured, choice: Choice, sees: Mapping[str, int]) -> dict[str, Any]:
    n = len(measured.space.states)
    gradients = np.concatenate([measured.structure.C, np.eye(n, dtype=bool)])
    row = gradients[[measured.places[place]]]
    (far,) = distances(measured.structure.A, row, [measured.lags[place]])
    return {
        **sensor_told(choice, place),
        "sees": sees,
        "reaches": {state.name: int(k) for state, k in zip(measured.space.states, far, strict=True) if k >= 0},
        "structurally_observable": structurally_observable(measured.structure.A, row) if n <= FEW_STATES else None,
    }


def _counts(rows: Sequence[Ranked]) -> dict[str, dict[str, int]]:
    """By number of sensors, how many sets have each index; `never` for those that do not see the estimate."""
    sizes: dict[int, Counter[int | None]] = {}
    for row in rows:
        sizes.setdefault(len(row.sensors), Counter())[row.index] += 1
    return {
        str(size): {
            ("never" if k is None else str(k)): counter[k] for k in sorted(counter, key=lambda k: k or math.inf)
        }
        for size, counter in sorted(sizes.items())
    }


def _structures(
    measured: Measured, structure: Structure, operation: Operation, others: Sequence[Operation]
) -> dict[str, Any]:
    """The structure at the point and at others, as rows of 0 and 1; rows of C are those of the sensors."""

    def matrices(found: Structure) -> dict[str, Any]:
        every = np.concatenate([found.C, np.eye(len(found.A), dtype=bool)])
        return {"A": found.A.astype(int), "C": every[measured.places].astype(int)}

    more = [{"at": " ".join(other.point), **matrices(operate(other).structure())} for other in others]
    return {"source": structure.source, "at": " ".join(operation.point), **matrices(structure), "others": more}


def _unseen(rows: Sequence[Ranked], names: Sequence[str], wanted: Sequence[str]) -> str:
    """What no set sees: of the set that leaves the fewest states in the dark."""
    best = min(rows, key=lambda row: (len(row.hidden), row.sensors))
    hidden = [name for name in wanted if name in best.hidden] or list(wanted)
    told = f"no set of these sensors sees {', '.join(hidden)} of the estimate: "
    told += f"{', '.join(names[m] for m in best.sensors)} leaves {', '.join(best.hidden)} unseen"
    return f"{told}; allow more sensors, or others"
