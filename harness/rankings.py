"""Does a measure rank the observers as a metric does? Spearman's correlation over a campaign's cases, and how sure."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import rankdata

from harness.criteria import Judged
from harness.ofobservers import of_observer
from harness.record import COMPLETE
from harness.reportaxes import Better
from harness.reportsection import RankedMeasure, Ranking

Array = NDArray[np.float64]
# The share of the resamples that an interval holds.
LEVEL = 0.95

Answer = Literal["agrees", "open", "opposes", "undefined"]


class Correlation(NamedTuple):
    """Spearman's rank correlation, its interval, and how many resamples the interval comes from; NaN where undefined.

    It is 1 where the measure puts the observers in the very order of the metric, the best first in both.
    """

    value: float
    lower: float
    upper: float
    resamples: int

    @property
    def answer(self) -> Answer:
        """What the interval says: above zero, below zero, or both are possible."""
        if math.isnan(self.value) or math.isnan(self.lower):
            return "undefined"
        return "agrees" if self.lower > 0.0 else "opposes" if self.upper < 0.0 else "open"


NO_CORRELATION = Correlation(math.nan, math.nan, math.nan, 0)


def spearman(one: Array, other: Array) -> Array:
    """Spearman's rank correlation along the last axis, (..., n) and (..., n) to (...); NaN where one side is all ties.

    rho = sum (r - r_mean)(s - s_mean)/sqrt(sum (r - r_mean)^2 sum (s - s_mean)^2), r and s the ranks, ties averaged.
    Infinite values rank beyond all others.
    """
    r, s = (rankdata(values, axis=-1) for values in (one, other))
    r, s = (ranks - ranks.mean(axis=-1, keepdims=True) for ranks in (r, s))
    spread = np.sqrt((r**2).sum(axis=-1) * (s**2).sum(axis=-1))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.where(spread > 0.0, (r * s).sum(axis=-1) / spread, np.nan))


def median_cost(costs: Array) -> Array:
    """The median over the cases of each observer, (observers, cases) to (observers,).

    A failed case is infinite and so is a median between one and another; a case without the metric is NaN and not
    counted; NaN where there is none at all.
    """
    if not np.isnan(costs).any():
        return np.asarray(np.median(costs, axis=1))
    found = np.full(len(costs), np.nan)
    for i, row in enumerate(costs):
        known = row[~np.isnan(row)]
        if len(known):
            found[i] = np.median(known)
    return found


def correlate(measure: Array, costs: Array, resamples: int, seed: int) -> Correlation:
    """The rank correlation of `measure` (n,), less is better, with the median of `costs` (n, cases), less is better.

    A measure (n, cases) that is a metric itself counts by its median, too. The interval holds the middle 95 % of
    resamples (Efron's percentile interval) in which both the observers and the cases are drawn anew with replacement:
    another choice of sets, and other noise and engines. Observers share their cases, so a case is drawn for all of
    them. Resamples in which a side is all ties have no correlation and are left out.
    """
    known = measure if measure.ndim == 1 else median_cost(measure)
    value = float(spearman(known, median_cost(costs))) if len(measure) > 1 else math.nan
    if math.isnan(value):
        return NO_CORRELATION
    draw = np.random.default_rng(seed)
    observers, cases = costs.shape
    chosen = draw.integers(observers, size=(resamples, observers))
    drawn = [draw.integers(cases, size=cases) for _ in range(resamples)]
    medians = np.array([median_cost(costs[:, rows]) for rows in drawn])
    measured = np.array([measure if measure.ndim == 1 else median_cost(measure[:, rows]) for rows in drawn])
    ranked, resampled = (np.take_along_axis(values, chosen, axis=1) for values in (measured, medians))
    # Where no case of an observer has the metric among those drawn, that resample says nothing of it.
    whole = ~(np.isnan(resampled) | np.isnan(ranked)).any(axis=1)
    found = spearman(ranked[whole], resampled[whole])
    found = found[~np.isnan(found)]
    if not len(found):
        return Correlation(value, math.nan, math.nan, 0)
    tail = 50.0 * (1.0 - LEVEL)
    lower, upper = np.percentile(found, [tail, 100.0 - tail])
    return Correlation(value, float(lower), float(upper), len(found))


def rankings_content(
    rankings: Sequence[Ranking], cases: Sequence[Judged], units: Mapping[str, str]
) -> list[dict[str, Any]]:
    """What rankings.json holds: of each ranking the observers' medians, of each measure its correlation with them."""
    return [_ranking(ranking, cases, units) for ranking in rankings]


def _ranking(ranking: Ranking, cases: Sequence[Judged], units: Mapping[str, str]) -> dict[str, Any]:
    covered = [case for case in cases if not ranking.experiments or case.experiment in ranking.experiments]
    observers = ranking.observers()
    unit = units.get(ranking.metric_of(observers[0]), "1")
    costs = {name: _costs(ranking.metric_of(name), ranking.better, covered) for name in observers}
    sign = _sign(ranking.better)
    medians = {name: float(sign * median_cost(row[None, :])[0]) for name, row in costs.items()}
    return {
        "title": ranking.title,
        "metric": ranking.metric,
        "better": ranking.better,
        "unit": unit,
        "experiments": ranking.experiments,
        "cases": len(covered),
        "failed": sum(case.outcome not in COMPLETE for case in covered),
        "resamples": ranking.resamples,
        "seed": ranking.seed,
        "level": LEVEL,
        "note": ranking.note,
        "medians": medians,
        "measures": [
            _measure(name, measure, ranking, costs, _measured(measure, covered), units)
            for name, measure in ranking.measures.items()
        ],
    }


def _measure(
    name: str,
    measure: RankedMeasure,
    ranking: Ranking,
    costs: Mapping[str, Array],
    measured: Mapping[str, Array],
    units: Mapping[str, str],
) -> dict[str, Any]:
    """One measure; of it count the observers for which it and the metric were measured in some case."""
    least = {one: float(median_cost(measured[one].reshape(1, -1))[0]) for one in measure.named}
    known = [one for one in measure.named if not (np.isnan(costs[one]).all() or math.isnan(least[one]))]
    ranked, rows = (np.array([of[one] for one in known]) for of in (measured, costs))
    found = correlate(ranked, rows, ranking.resamples, ranking.seed) if known else NO_CORRELATION
    unit = "1" if measure.metric is None else units.get(of_observer(measure.metric, measure.named[0]), "1")
    return {
        "name": name,
        "title": measure.title or name,
        "metric": measure.metric or "",
        "unit": unit,
        "better": measure.better,
        "values": {one: _value(measure, one, least[one]) for one in known},
        "correlation": found.value,
        "lower": found.lower,
        "upper": found.upper,
        "resamples": found.resamples,
        "answer": found.answer,
    }


def _measured(measure: RankedMeasure, cases: Sequence[Judged]) -> dict[str, Array]:
    """What a measure says of each observer so that less is better: a number, or one a case where it is a metric."""
    if measure.metric is None:
        sign = _sign(measure.better)
        return {one: np.array(_worst_if_none(value, sign)) for one, value in measure.values.items()}
    return {one: _costs(of_observer(measure.metric, one), measure.better, cases) for one in measure.named}


def _value(measure: RankedMeasure, observer: str, least: float) -> float | None:
    """The value to show: as declared, or the median of the metric."""
    return measure.values[observer] if measure.metric is None else _sign(measure.better) * least


def _costs(metric: str, better: Better, cases: Sequence[Judged]) -> Array:
    """A metric by case so that less is better."""
    found = np.full(len(cases), np.nan)
    for i, case in enumerate(cases):
        if case.outcome not in COMPLETE:
            found[i] = np.inf
        elif metric in case.metrics:
            found[i] = _sign(better) * case.metrics[metric].value
    return found


def _sign(better: Better) -> float:
    return 1.0 if better == "lower" else -1.0


def _worst_if_none(value: float | None, sign: float) -> float:
    return math.inf if value is None else sign * value
