"""The arguments of the metrics as a campaign writes them, and the arrays they stand for."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from typing import Annotated, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, ConfigDict, Field, WithJsonSchema, model_validator

from fmus.component import Signal
from fmus.units import Unit, UnitError, parse_unit
from harness.quantity import Measure, Quantity, Strict, read_measure
from harness.validation import nearest_hint

Vector = NDArray[np.float64]
Pair = tuple[str, str]
_SIGNAL = re.compile(r"[A-Za-z_]\w*\.\S+$")


class Window(NamedTuple):
    """The rows of a record that a metric looks at: time (n,) [s] and the columns by name, in SI."""

    time: Vector
    column: Callable[[str], Vector]


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


_PAIR_SCHEMA = {"type": "array", "items": {"type": "string"}, "minItems": 2, "maxItems": 2}


def _short_form_too(*short: dict[str, Any]) -> ConfigDict:
    """Lets the JSON Schema allow the short forms beside the mapping."""

    def extend(schema: dict[str, Any]) -> None:
        long = dict(schema)
        schema.clear()
        schema["anyOf"] = [*short, long]

    return ConfigDict(json_schema_extra=extend)


class Arguments(Strict):
    """What a metric is given."""

    def names(self) -> list[str]:
        """The signals it looks at."""
        raise NotImplementedError

    def arrays(self, window: Window) -> tuple[Any, ...]:
        """What the function of the metric is called with."""
        raise NotImplementedError

    def unit(self, signals: Mapping[str, Signal]) -> str:
        """The declared unit of what is looked at."""
        return signals[self.names()[0]].unit

    def misfits(self, signals: Mapping[str, Signal]) -> list[str]:
        """What is wrong with the signals' names and units, in words."""
        unknown = [name for name in self.names() if name not in signals]
        return [f"no recorded signal is named '{name}'{nearest_hint(name, signals)}" for name in dict.fromkeys(unknown)]


def read_errors(raw: Any) -> Any:
    """[truth, estimate] or a list of such pairs, as the mapping {pairs: ...}."""
    if isinstance(raw, list):
        return {"pairs": [raw] if all(isinstance(item, str) for item in raw) else raw}
    return raw


class Errors(Arguments):
    """The error of [truth, estimate], or the norm over several pairs, each divided by its scale where scales are given.

    e = estimate - truth for one pair, e = sqrt(sum_i ((estimate_i - truth_i)/scale_i)^2) for several.
    """

    model_config = _short_form_too(_PAIR_SCHEMA, {"type": "array", "items": _PAIR_SCHEMA, "minItems": 1})

    pairs: list[Pair] = Field(min_length=1, description="[truth, estimate] each")
    scales: list[Quantity] | None = Field(None, description="one a pair: what each error is divided by")

    @model_validator(mode="before")
    @classmethod
    def _short_form(cls, raw: Any) -> Any:
        return read_errors(raw)

    @model_validator(mode="after")
    def _one_scale_a_pair(self) -> Errors:
        if self.scales is not None and len(self.scales) != len(self.pairs):
            raise ValueError(f"wants one scale a pair: {len(self.pairs)}, got {len(self.scales)}")
        if any(scale.value <= 0 for scale in self.scales or []):
            raise ValueError(f"scales want to be above 0, got {', '.join(map(str, self.scales or []))}")
        return self

    def names(self) -> list[str]:
        """All truths and estimates."""
        return [name for pair in self.pairs for name in pair]

    def norm(self, window: Window) -> Vector:
        """e by row, shape (n,)."""
        scales = [difference(scale) for scale in self.scales or []] or [1.0] * len(self.pairs)
        errors = [
            (window.column(estimate) - window.column(truth)) / scale
            for (truth, estimate), scale in zip(self.pairs, scales, strict=True)
        ]
        return errors[0] if len(errors) == 1 else np.sqrt(np.sum(np.square(errors), axis=0))

    def arrays(self, window: Window) -> tuple[Any, ...]:
        """(e,)."""
        return (self.norm(window),)

    def unit(self, signals: Mapping[str, Signal]) -> str:
        """That of the first truth, or 1 where scales are given."""
        return "1" if self.scales is not None else signals[self.pairs[0][0]].unit

    def misfits(self, signals: Mapping[str, Signal]) -> list[str]:
        """Also truths, estimates and scales of different dimensions."""
        messages = super().misfits(signals)
        if messages:
            return messages
        for index, (truth, estimate) in enumerate(self.pairs):
            wanted = signals[truth].unit
            if not _fits(signals[estimate].unit, wanted):
                messages.append(f"{estimate} wants {wanted} like {truth}, got {signals[estimate].unit}")
            if self.scales is not None and not _fits(self.scales[index].unit, wanted):
                messages.append(f"the scale of {truth} wants {wanted}, got {self.scales[index]}")
            if self.scales is None and not _fits(wanted, signals[self.pairs[0][0]].unit):
                messages.append(f"a norm over {self.pairs[0][0]} and {truth} wants scales: their units differ")
        return messages


class SignedError(Errors):
    """The error of one pair [truth, estimate], with its sign."""

    @model_validator(mode="after")
    def _one_pair(self) -> SignedError:
        if len(self.pairs) != 1:
            raise ValueError(f"wants one pair [truth, estimate], got {len(self.pairs)}")
        return self


class Within(Arguments):
    """An error and the bound it is to stay within."""

    error: Errors
    bound: Bound

    def names(self) -> list[str]:
        """The pairs' signals and the bound's, where it is one."""
        return self.error.names() + ([self.bound] if isinstance(self.bound, str) else [])

    def arrays(self, window: Window) -> tuple[Any, ...]:
        """(e, bound by row)."""
        if isinstance(self.bound, str):
            return self.error.norm(window), window.column(self.bound)
        return self.error.norm(window), np.full(len(window.time), difference(self.bound))

    def misfits(self, signals: Mapping[str, Signal]) -> list[str]:
        """Also a bound of another dimension than the error."""
        messages = super().misfits(signals) or self.error.misfits(signals)
        if messages:
            return messages
        wanted = self.error.unit(signals)
        got = signals[self.bound].unit if isinstance(self.bound, str) else self.bound.unit
        return [] if _fits(got, wanted) else [f"the bound wants {wanted}, got {self.bound} {got}".rstrip()]


class Convergence(Arguments):
    """An error and the decay rate demanded of it."""

    error: Errors
    demanded: Quantity

    @model_validator(mode="after")
    def _a_rate(self) -> Convergence:
        if self.demanded.si("1/s") <= 0:
            raise ValueError(f"demanded wants a rate above 0 1/s, got {self.demanded}")
        return self

    def names(self) -> list[str]:
        """The pairs' signals."""
        return self.error.names()

    def arrays(self, window: Window) -> tuple[Any, ...]:
        """(time, e, demanded rate)."""
        return window.time, self.error.norm(window), self.demanded.si("1/s")

    def misfits(self, signals: Mapping[str, Signal]) -> list[str]:
        """Those of the error."""
        return self.error.misfits(signals)


class Discrete(Arguments):
    """[truth, estimate] of discrete signals."""

    model_config = _short_form_too(_PAIR_SCHEMA)

    pair: Pair

    @model_validator(mode="before")
    @classmethod
    def _short_form(cls, raw: Any) -> Any:
        return {"pair": raw} if isinstance(raw, list) else raw

    def names(self) -> list[str]:
        """Truth and estimate."""
        return list(self.pair)

    def arrays(self, window: Window) -> tuple[Any, ...]:
        """(time, truth, estimate)."""
        return window.time, window.column(self.pair[0]), window.column(self.pair[1])


class One(Arguments):
    """One signal."""

    model_config = _short_form_too({"type": "string"})

    signal: str

    @model_validator(mode="before")
    @classmethod
    def _short_form(cls, raw: Any) -> Any:
        return {"signal": raw} if isinstance(raw, str) else raw

    def names(self) -> list[str]:
        """The signal."""
        return [self.signal]

    def arrays(self, window: Window) -> tuple[Any, ...]:
        """(time, signal)."""
        return window.time, window.column(self.signal)


def difference(measure: Measure) -> float:
    """A measure as a difference in SI: without the offset of its unit."""
    return measure.value * parse_unit(measure.unit).factor


def _fits(unit: str, wanted: str) -> bool:
    return _parsed(unit).same_dimension(_parsed(wanted))


def _parsed(unit: str) -> Unit:
    try:
        return parse_unit(unit)
    except UnitError:
        return Unit()
