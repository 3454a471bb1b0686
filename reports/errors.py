"""Pools all cases: the samples of estimation errors, and the rows of each true class by the class estimated."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from reports.definitions import definitions
from reports.folder import Case, Matrix, Run
from reports.signals import Columns, Vector, find_recorded, from_si

# Samples a histogram keeps of a truth and estimate; beyond it every n-th of a case is taken, and the report says so.
SAMPLES_KEPT = 500_000


class Pair(NamedTuple):
    """A truth and its estimate, compared from `after` [s] on."""

    truth: str
    estimate: str
    after: float


@dataclass(frozen=True)
class Errors:
    """Estimate minus truth over all samples of all cases, in `unit`; every `stride`-th sample."""

    pair: Pair
    unit: str
    values: Vector
    cases: int
    stride: int


@dataclass(frozen=True)
class Confusion:
    """How many samples had the true class `classes[i]` and the estimated `classes[j]`: `counts[i, j]`.

    `metric` is the one that counted them, empty where the signals of the cases were counted here.
    """

    pair: Pair
    classes: tuple[str, ...]
    counts: np.ndarray
    cases: int
    metric: str = ""

    @property
    def accuracy(self) -> float:
        """Share of the samples on the diagonal."""
        return float(np.trace(self.counts) / self.counts.sum()) if self.counts.sum() else float("nan")


def pairs(run: Run) -> list[Pair]:
    """Every truth and estimate that a metric compares, once, from the latest time any of its metrics starts.

    Without those that a metric counts a confusion of, and those of an alarm, which estimates no fault's size.
    """
    latest: dict[tuple[str, str], float] = {}
    counted = {pair for one in definitions(run).values() if one.kind in ("confusion", "alarm") for pair in one.pairs}
    for definition in definitions(run).values():
        for pair in definition.pairs if len(definition.pairs) == 1 else ():
            if pair not in counted:
                latest[pair] = max(latest.get(pair, definition.after), definition.after)
    return [Pair(truth, estimate, after) for (truth, estimate), after in latest.items()]


def pool(run: Run) -> tuple[list[Errors], list[Confusion]]:
    """Errors of the real pairs and confusion of the discrete ones, over every case that left a record.

    A case that failed counts up to its failure. Only the columns needed are read, each file once, in pieces.
    """
    wanted = pairs(run)
    names = {name for pair in wanted for name in (pair.truth, pair.estimate)}
    errors: dict[Pair, list[Vector]] = {pair: [] for pair in wanted}
    counts: dict[Pair, Counter[tuple[int, int]]] = {pair: Counter() for pair in wanted}
    cases: Counter[Pair] = Counter()
    units: dict[Pair, str] = {}
    stride = 1
    for case in run.cases:
        recorded = find_recorded(run, case, names)
        here = [pair for pair in wanted if {pair.truth, pair.estimate} <= recorded.signals.keys()]
        stride = max(stride, -(-recorded.rows * len(run.cases) // SAMPLES_KEPT))
        passed = dict.fromkeys(here, 0)
        for pair in here:
            cases[pair] += 1
            if not recorded.signals[pair.truth].discrete:
                units[pair] = recorded.signals[pair.truth].display_unit
                errors[pair].append(np.empty(0))
        for columns in recorded.pieces():
            for pair in here:
                truth, estimate = _compared(columns, pair)
                if recorded.signals[pair.truth].discrete:
                    counts[pair].update(_crossings(truth, estimate))
                else:
                    chosen = slice(-passed[pair] % stride, None, stride)
                    errors[pair].append(estimate[chosen] - truth[chosen])
                passed[pair] += len(truth)
    real = [
        Errors(pair, units[pair], _scaled(errors[pair], units[pair]), cases[pair], stride)
        for pair in wanted
        if pair in units
    ]
    return real, [_confusion(pair, counts[pair], cases[pair]) for pair in wanted if counts[pair]]


def declared_confusions(run: Run) -> list[Confusion]:
    """The matrices of each confusion metric, added up over the cases that have one."""
    found = []
    for name, definition in definitions(run).items():
        matrices = [case.matrices[name] for case in run.cases if name in case.matrices]
        if not matrices or not definition.pairs:
            continue
        classes = _in_order(matrices)
        counts = np.zeros((len(classes), len(classes)), dtype=int)
        for matrix in matrices:
            at = [classes.index(one) for one in matrix.classes]
            counts[np.ix_(at, at)] += np.array(matrix.counts, dtype=int)
        pair = Pair(*definition.pairs[0], definition.after)
        found.append(Confusion(pair, classes, counts, len(matrices), name))
    return found


def _in_order(matrices: Sequence[Matrix]) -> tuple[str, ...]:
    """All their classes: by value where they are numbers, else as declared; what is none of them last."""
    classes = dict.fromkeys(one for matrix in matrices for one in matrix.classes)
    try:
        return tuple(sorted(classes, key=float))
    except ValueError:
        return tuple(sorted(classes, key=lambda one: one == "other"))


def samples_of(run: Run, name: str, cases: Sequence[Case] | None = None) -> Vector:
    """The samples of that name pooled over the cases, shape (n,), as case.json gives them."""
    return np.array([value for case in (run.cases if cases is None else cases) for value in case.samples.get(name, ())])


def nearest_rank(values: Sequence[float] | np.ndarray, share: float) -> float:
    """The percentile by nearest rank; NaN of no values."""
    return float(np.quantile(values, share, method="inverted_cdf")) if len(values) else float("nan")


def _compared(columns: Columns, pair: Pair) -> tuple[Vector, Vector]:
    """Truth and estimate where they are compared: from some time on, where both are finite."""
    truth, estimate = columns.signals[pair.truth].values, columns.signals[pair.estimate].values
    rows = np.flatnonzero((columns.time >= pair.after) & np.isfinite(truth) & np.isfinite(estimate))
    return truth[rows], estimate[rows]


def _scaled(pieces: Sequence[Vector], unit: str) -> Vector:
    together = np.concatenate(pieces)
    return from_si(together, unit) - from_si(np.zeros(1), unit)


def _crossings(truth: Vector, estimate: Vector) -> Counter[tuple[int, int]]:
    pairs_seen, times = np.unique(np.rint(truth) + 1j * np.rint(estimate), return_counts=True)
    return Counter({(int(pair.real), int(pair.imag)): int(n) for pair, n in zip(pairs_seen, times, strict=True)})


def _confusion(pair: Pair, counted: Counter[tuple[int, int]], cases: int) -> Confusion:
    values = sorted({value for crossing in counted for value in crossing})
    counts = np.zeros((len(values), len(values)), dtype=int)
    for (true, seen), n in counted.items():
        counts[values.index(true), values.index(seen)] = n
    return Confusion(pair, tuple(map(str, values)), counts, cases)
