"""How large an estimation error is and how it decays: the measures, and what a campaign gives them."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, Field, PlainSerializer, WithJsonSchema, model_validator

from fmus.component import Signal
from harness.arguments import Arguments, Errors, Pair, SignedError, difference, fits
from harness.quantity import Measure, Quantity, read_measure
from harness.window import Window

Vector = NDArray[np.float64]
NORMALISERS = ("range", "mean", "std")
_SIGNAL = re.compile(r"[A-Za-z_]\w*\.\S+$")


def rmse(error: Vector) -> float:
    """Root of the mean square of an error or error norm: sqrt(mean(e^2)); error (n,), in its unit, NaN where n = 0."""
    return float(np.sqrt(np.dot(error, error) / len(error))) if len(error) else np.nan


def max_error(error: Vector) -> float:
    """Largest magnitude of an error or error norm: max |e|; error (n,), in its unit, NaN where n = 0."""
    return float(np.max(np.abs(error))) if len(error) else np.nan


def bias(error: Vector) -> float:
    """Mean of estimate minus truth: mean(e); error (n,), in its unit, NaN where n = 0."""
    return float(np.mean(error)) if len(error) else np.nan


def nrmse(error: Vector, truth: Vector, by: str | float) -> float:
    """RMSE over a stated normaliser: sqrt(mean(e^2))/d, a share.

    d is of the truth in the window: `range` max - min, `mean` |mean|, `std` sqrt(mean((x - mean)^2)), or a value given;
    all in SI, a temperature in K. Error and truth (n,); NaN where n = 0 or d = 0.
    """
    if not len(error):
        return np.nan
    if isinstance(by, str):
        spread = {"range": lambda: np.ptp(truth), "mean": lambda: abs(np.mean(truth)), "std": lambda: np.std(truth)}
        by = float(spread[by]())
    return rmse(error) / by if by > 0 else np.nan


def share_within(error: Vector, bound: Vector | float) -> float:
    """Share of the rows where |e| <= bound, from 0 to 1; error (n,), bound (n,) or one value. A NaN is not within."""
    return float(np.mean(np.abs(error) <= bound)) if len(error) else np.nan


def settling(time: Vector, error: Vector, bound: Vector | float, since: float) -> float:
    """Time from the start of the window until |e| <= bound at every later row [s]; infinite where it never settles.

    t_j - t_0 with the first row j from which on |e| <= bound to the end of the window, and t_0 the instant `since` at
    which the window starts; time and error (n,), bound (n,) or one value. A NaN is not within. NaN where n = 0.
    """
    if not len(error):
        return np.nan
    outside = np.flatnonzero(~(np.abs(error) <= bound))
    first = int(outside[-1]) + 1 if len(outside) else 0
    return float(time[first] - since) if first < len(time) else np.inf


def convergence_rate(time: Vector, error: Vector, demanded: float) -> Mapping[str, float]:
    """The rate at which an error norm decays: minus the slope of the least-squares line through (t, ln |e|) [1/s].

    `ratio` is the rate over the demanded one. Rows with e = 0 have no logarithm and are left out; time and error (n,).
    NaN where fewer than two rows remain.
    """
    rows = np.abs(error) > 0
    if np.count_nonzero(rows) < 2:
        return {"": np.nan, "ratio": np.nan}
    centred = time[rows] - np.mean(time[rows])
    slope = np.sum(centred * np.log(np.abs(error[rows]))) / np.sum(centred**2)
    return {"": float(-slope), "ratio": float(-slope / demanded)}


def read_bound(raw: Any) -> Measure | str:
    """A signal's name as `part.signal`, or a number with a unit."""
    return raw if isinstance(raw, str) and _SIGNAL.match(raw) else read_measure(raw)


Bound = Annotated[
    Any,
    BeforeValidator(read_bound),
    WithJsonSchema(
        {"type": ["string", "number"], "description": "number with a unit, or a signal that holds the bound"}
    ),
]


def read_normaliser(raw: Any) -> Measure | str:
    """One of NORMALISERS, or a number with a unit above 0."""
    if raw in NORMALISERS:
        return str(raw)
    try:
        measure = read_measure(raw)
    except ValueError:
        raise ValueError(f"wants {', '.join(NORMALISERS)} or a value with its unit, got {raw!r}") from None
    if difference(measure) <= 0:
        raise ValueError(f"wants a value above 0, got {measure}")
    return measure


Normaliser = Annotated[
    Any,
    BeforeValidator(read_normaliser),
    PlainSerializer(str),
    WithJsonSchema(
        {
            "anyOf": [{"enum": list(NORMALISERS)}, {"type": ["string", "number"]}],
            "description": "what the RMSE is divided by: range, mean or std of the truth, or a value with its unit",
        }
    ),
]


class Normalised(Arguments):
    """An error of one pair, and what its RMSE is divided by."""

    error: SignedError = Field(description="[truth, estimate]")
    by: Normaliser

    @model_validator(mode="after")
    def _one_divisor(self) -> Normalised:
        if self.error.scales is not None:
            raise ValueError("wants an error without scales: it is divided by what `by` says")
        return self

    def names(self) -> list[str]:
        """Truth and estimate."""
        return self.error.names()

    def compared(self) -> list[Pair]:
        """The pair."""
        return self.error.compared()

    def arrays(self, window: Window) -> tuple[Any, ...]:
        """(e, truth, by)."""
        by = difference(self.by) if isinstance(self.by, Measure) else self.by
        return self.error.norm(window), window.column(self.names()[0]), by

    def misfits(self, signals: Mapping[str, Signal]) -> list[str]:
        """Also a value to divide by of another dimension than the error."""
        messages = self.error.misfits(signals)
        wanted = self.error.unit(signals) if not messages else ""
        if not messages and isinstance(self.by, Measure) and not fits(self.by.unit, wanted):
            messages.append(f"by wants {wanted}, got {self.by}")
        return messages


class Within(Arguments):
    """An error and the bound it is to stay within."""

    error: Errors = Field(description="[truth, estimate], or {pairs, scales}")
    bound: Bound

    def names(self) -> list[str]:
        """The pairs' signals and the bound's, where it is one."""
        return self.error.names() + ([self.bound] if isinstance(self.bound, str) else [])

    def compared(self) -> list[Pair]:
        """The pairs."""
        return self.error.compared()

    def arrays(self, window: Window) -> tuple[Any, ...]:
        """(e, bound by row or for all)."""
        bound = window.column(self.bound) if isinstance(self.bound, str) else difference(self.bound)
        return self.error.norm(window), bound

    def misfits(self, signals: Mapping[str, Signal]) -> list[str]:
        """Also a bound of another dimension than the error."""
        messages = super().misfits(signals) or self.error.misfits(signals)
        if messages:
            return messages
        wanted = self.error.unit(signals)
        if isinstance(self.bound, str):
            unit, got = signals[self.bound].unit, f"{self.bound} in {signals[self.bound].unit}"
        else:
            unit, got = self.bound.unit, str(self.bound)
        return [] if fits(unit, wanted) else [f"the bound wants {wanted}, got {got}"]


class Settling(Within):
    """An error and the bound it is to stay within for good."""

    def arrays(self, window: Window) -> tuple[Any, ...]:
        """(time, e, bound by row or for all, start of the window)."""
        return window.time, *super().arrays(window), window.since


class Convergence(Arguments):
    """An error and the decay rate demanded of it."""

    error: Errors = Field(description="[truth, estimate], or {pairs, scales}")
    demanded: Quantity = Field(description="a rate, like 5 1/s")

    @model_validator(mode="after")
    def _a_rate(self) -> Convergence:
        if self.demanded.si("1/s") <= 0:
            raise ValueError(f"demanded wants a rate above 0 1/s, got {self.demanded}")
        return self

    def names(self) -> list[str]:
        """The pairs' signals."""
        return self.error.names()

    def compared(self) -> list[Pair]:
        """The pairs."""
        return self.error.compared()

    def arrays(self, window: Window) -> tuple[Any, ...]:
        """(time, e, demanded rate)."""
        return window.time, self.error.norm(window), self.demanded.si("1/s")

    def misfits(self, signals: Mapping[str, Signal]) -> list[str]:
        """Those of the error."""
        return self.error.misfits(signals)
