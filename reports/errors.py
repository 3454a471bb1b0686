"""Pools the samples of all cases: estimation errors for histograms, true against estimated locations for confusion."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from reports.folder import Case, Run
from reports.signals import Vector, from_si, read_recorded
from reports.standing import definitions

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
    """How many samples had true location `values[i]` and estimate `values[j]`: `counts[i, j]`."""

    pair: Pair
    values: tuple[int, ...]
    counts: np.ndarray
    cases: int

    @property
    def accuracy(self) -> float:
        """Share of the samples on the diagonal."""
        return float(np.trace(self.counts) / self.counts.sum()) if self.counts.sum() else float("nan")


def pairs(run: Run) -> list[Pair]:
    """Every truth and estimate that a metric compares, once, from the latest time any of its metrics starts."""
    latest: dict[tuple[str, str], float] = {}
    for definition in definitions(run).values():
        if len(definition.signals) == 2:
            truth, estimate = definition.signals
            latest[truth, estimate] = max(latest.get((truth, estimate), definition.after), definition.after)
    return [Pair(truth, estimate, after) for (truth, estimate), after in latest.items()]


def pool(run: Run) -> tuple[list[Errors], list[Confusion]]:
    """Errors of the real pairs and confusion of the discrete ones, over every case that left a record.

    A case that failed counts up to its failure. Only the columns needed are read, each file once.
    """
    wanted = pairs(run)
    names = {name for pair in wanted for name in (pair.truth, pair.estimate)}
    errors: dict[Pair, list[Vector]] = {pair: [] for pair in wanted}
    counts: dict[Pair, Counter[tuple[int, int]]] = {pair: Counter() for pair in wanted}
    cases: Counter[Pair] = Counter()
    units: dict[Pair, str] = {}
    stride = 1
    for case in run.cases:
        columns = read_recorded(run, case, names)
        here = [pair for pair in wanted if {pair.truth, pair.estimate} <= columns.signals.keys()]
        stride = max(stride, -(-len(columns.time) * len(run.cases) // SAMPLES_KEPT))
        for pair in here:
            truth, estimate = (
                columns.signals[pair.truth],
                columns.signals[pair.estimate],
            )
            rows = np.flatnonzero(
                (columns.time >= pair.after) & np.isfinite(truth.values) & np.isfinite(estimate.values)
            )
            cases[pair] += 1
            if truth.discrete:
                counts[pair].update(_crossings(truth.values[rows], estimate.values[rows]))
            else:
                units[pair] = truth.display_unit
                errors[pair].append((estimate.values - truth.values)[rows[::stride]])
    real = [
        Errors(pair, units[pair], _scaled(errors[pair], units[pair]), cases[pair], stride)
        for pair in wanted
        if pair in units
    ]
    return real, [_confusion(pair, counts[pair], cases[pair]) for pair in wanted if counts[pair]]


def samples_of(run: Run, name: str, cases: Sequence[Case] | None = None) -> Vector:
    """The samples of that name pooled over the cases, shape (n,), as case.json gives them."""
    return np.array([value for case in (run.cases if cases is None else cases) for value in case.samples.get(name, ())])


def _scaled(pieces: Sequence[Vector], unit: str) -> Vector:
    together = np.concatenate(pieces)
    return from_si(together, unit) - from_si(np.zeros(1), unit)


def _crossings(truth: Vector, estimate: Vector) -> Counter[tuple[int, int]]:
    pairs_seen, times = np.unique(np.rint(truth) + 1j * np.rint(estimate), return_counts=True)
    return Counter({(int(pair.real), int(pair.imag)): int(n) for pair, n in zip(pairs_seen, times, strict=True)})


def _confusion(pair: Pair, counted: Counter[tuple[int, int]], cases: int) -> Confusion:
    values = tuple(sorted({value for crossing in counted for value in crossing}))
    counts = np.zeros((len(values), len(values)), dtype=int)
    for (true, seen), n in counted.items():
        counts[values.index(true), values.index(seen)] = n
    return Confusion(pair, values, counts, cases)
