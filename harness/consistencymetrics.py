"""Whether an estimator knows how wrong it is: NEES and NIS against the chi-square law, and what they are given."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator, model_validator

from fmus.component import Signal
from harness.arguments import Arguments, Pair, dimension, fits
from harness.quantity import Measure, Quantity
from harness.window import Window

Vector = NDArray[np.float64]


def nees(errors: Sequence[Vector], covariance: Sequence[Sequence[Vector]], confidence: float) -> Mapping[str, float]:
    """Mean normalised estimation error squared: mean(e' P^-1 e), e estimate minus truth, P the estimator's covariance.

    For an estimator that is consistent, each row follows the chi-square law with as many degrees of freedom as states
    d, of mean d. `ratio` is the mean over d, `within` the share of the rows in the two-sided interval of the law at
    the stated confidence, `lower` and `upper` the interval of the mean of as many independent rows. The errors of one
    run are correlated over time: compare `lower` and `upper` with a NEES only where its rows are independent. Rows that
    repeat the one before in all signals are held samples and left out; `samples` are the rest. `indefinite` counts the
    rows whose P is not positive definite: they are not within, and make the mean NaN. All signals (n,). Bar-Shalom, Li,
    Kirubarajan, Estimation with Applications to Tracking and Navigation (2001), section 5.4.
    """
    from scipy.special import chdtri  # a fifth of a second to import, which every worker would pay

    d = len(errors)
    new = _new_samples([*errors, *(column for row in covariance for column in row)])
    squared, definite = _normalised_square(errors, covariance)
    squared[~definite] = np.nan
    samples = squared[new]
    count = len(samples)
    tails = (1.0 + confidence) / 2.0, (1.0 - confidence) / 2.0  # chdtri takes the share above
    low, high = (float(chdtri(d, tail)) for tail in tails)
    mean = float(np.mean(samples)) if count else np.nan
    bounds = [float(chdtri(d * count, tail)) / count if count else np.nan for tail in tails]
    return {
        "": mean,
        "ratio": mean / d,
        "within": float(np.mean((samples >= low) & (samples <= high))) if count else np.nan,
        "lower": bounds[0],
        "upper": bounds[1],
        "samples": float(count),
        "indefinite": float(np.count_nonzero(~definite[new])),
    }


def nis(
    innovations: Sequence[Vector], covariance: Sequence[Sequence[Vector]], confidence: float
) -> Mapping[str, float]:
    """Mean normalised innovation squared: mean(v' S^-1 v), v the innovation, S the covariance the estimator gives it.

    As `nees`, with the number of innovations for that of states. The innovations of a consistent estimator are white,
    so that the mean over the samples of one run is to lie between `lower` and `upper` at the stated confidence.
    """
    return nees(innovations, covariance, confidence)


def _normalised_square(
    errors: Sequence[Vector], covariance: Sequence[Sequence[Vector]]
) -> tuple[Vector, NDArray[np.bool_]]:
    """e' P^-1 e by row, and whether P is positive definite: by P = L D L', e' P^-1 e = sum_j (L^-1 e)_j^2/D_j.

    `covariance` holds the lower triangle by rows, or rows of one variance each where P is diagonal.
    """
    squared = np.zeros(len(errors[0]))
    definite = np.ones(len(squared), dtype=bool)
    solved: list[Vector] = []
    pivots: list[Vector] = []
    factors: list[list[Vector]] = []
    diagonal = all(len(row) == 1 for row in covariance)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        for i, (error, row) in enumerate(zip(errors, covariance, strict=True)):
            residual, pivot, scaled = error, row[-1], list(row[:-1])
            factors.append([])
            for j in range(0 if diagonal else i):
                for k in range(j):
                    scaled[j] = scaled[j] - factors[j][k] * scaled[k]
                factor = scaled[j] / pivots[j]
                pivot, residual = pivot - factor * scaled[j], residual - factor * solved[j]
                factors[i].append(factor)
            definite &= pivot > 0
            squared += residual * residual / pivot
            solved.append(residual)
            pivots.append(pivot)
    return squared, definite


def _new_samples(columns: Sequence[Vector]) -> NDArray[np.bool_]:
    """The rows that differ from the one before in any column; the first is new."""
    new = np.zeros(len(columns[0]), dtype=bool)
    new[:1] = True
    for column in columns:
        new[1:] |= column[1:] != column[:-1]
    return new


class Consistency(Arguments):
    """What an estimator says of its own error: a covariance, or the variance or standard deviation of each."""

    covariance: list[list[str]] | str | None = Field(
        None, description="rows of signals, symmetric, or the name of an array with the elements [1,1] ... [n,n]"
    )
    variance: list[str] | None = Field(None, description="a signal for each: a diagonal covariance")
    std: list[str] | None = Field(None, description="a signal for each: the roots of a diagonal covariance")
    confidence: Quantity = Field(Measure(95.0, "%"), description="of the chi-square intervals")

    @field_validator("confidence")
    @classmethod
    def _a_share(cls, confidence: Measure) -> Measure:
        if not 0.0 < confidence.si("1") < 1.0:
            raise ValueError(f"wants a share between 0 and 100 %, got {confidence}")
        return confidence

    @model_validator(mode="after")
    def _one_shape(self) -> Consistency:
        given = [name for name in ("covariance", "variance", "std") if getattr(self, name) is not None]
        if len(given) != 1:
            raise ValueError(f"wants one of covariance, variance, std, got {' and '.join(given) or 'none'}")
        size, name = len(self.judged()), given[0]
        value = getattr(self, name)
        if not isinstance(value, str) and len(value) != size:
            raise ValueError(f"{name} wants {size} {'rows' if name == 'covariance' else 'signals'}, got {len(value)}")
        if isinstance(value, list) and name == "covariance" and any(len(row) != size for row in value):
            raise ValueError(f"covariance wants {size} signals a row, got {', '.join(str(len(row)) for row in value)}")
        return self

    def judged(self) -> list[tuple[str, ...]]:
        """The signals of each error or innovation."""
        raise NotImplementedError

    def error(self, window: Window, signals: tuple[str, ...]) -> Vector:
        """An error or innovation by row, shape (n,)."""
        return window.column(signals[0]) if len(signals) == 1 else window.column(signals[1]) - window.column(signals[0])

    def spreads(self) -> list[list[str]]:
        """The lower triangle of the covariance by rows; one variance or standard deviation a row where diagonal."""
        size = len(self.judged())
        if isinstance(self.covariance, str):
            return [[f"{self.covariance}[{i},{j}]" for j in range(1, i + 1)] for i in range(1, size + 1)]
        if self.covariance is not None:
            return [row[: i + 1] for i, row in enumerate(self.covariance)]
        return [[name] for name in self.variance or self.std or []]

    def names(self) -> list[str]:
        """The errors' or innovations' signals, then the covariance's."""
        upper = [name for row in self.covariance for name in row] if isinstance(self.covariance, list) else []
        lower = [name for row in self.spreads() for name in row]
        return [name for signals in self.judged() for name in signals] + list(dict.fromkeys([*lower, *upper]))

    def arrays(self, window: Window) -> tuple[Any, ...]:
        """(errors, lower triangle of the covariance by rows, confidence)."""
        spreads = [[window.column(name) for name in row] for row in self.spreads()]
        if self.std is not None:
            spreads = [[row[0] * row[0]] for row in spreads]
        return [self.error(window, signals) for signals in self.judged()], spreads, self.confidence.si("1")

    def misfits(self, signals: Mapping[str, Signal]) -> list[str]:
        """Also covariances of another dimension than the products of the errors, or not symmetric."""
        messages = super().misfits(signals)
        if messages:
            return messages
        own = [signals[judged[0]].unit for judged in self.judged()]
        for i, row in enumerate(self.spreads()):
            for j, name in enumerate(row, start=i + 1 - len(row)):
                wanted = own[i] if self.std is not None else f"{own[i]}*{own[j]}"
                squared = np.add(dimension(own[i]), dimension(own[j]) if self.std is None else 0)
                if not np.array_equal(dimension(signals[name].unit), squared):
                    messages.append(f"{name} wants {wanted}, got {signals[name].unit}")
        return messages


class Nees(Consistency):
    """Pairs [truth, estimate] and what the estimator says of its error."""

    pairs: list[Pair] = Field(min_length=1, description="[truth, estimate] each")

    def judged(self) -> list[tuple[str, ...]]:
        """The pairs."""
        return list(self.pairs)

    def compared(self) -> list[Pair]:
        """The pairs."""
        return self.pairs

    def misfits(self, signals: Mapping[str, Signal]) -> list[str]:
        """Also truths and estimates of different dimensions."""
        messages = super().misfits(signals)
        if any(name not in signals for name in self.names()):
            return messages
        for truth, estimate in self.pairs:
            if not fits(signals[estimate].unit, signals[truth].unit):
                messages.append(f"{estimate} wants {signals[truth].unit} like {truth}, got {signals[estimate].unit}")
        return messages


class Nis(Consistency):
    """Innovations and the covariance that the estimator gives them."""

    innovations: list[str] = Field(min_length=1, description="measured less expected, a signal each")

    def judged(self) -> list[tuple[str, ...]]:
        """The innovations."""
        return [(name,) for name in self.innovations]
