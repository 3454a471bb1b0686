"""What metrics are given: errors, bounds and signals as a campaign writes them, and the arrays they stand for."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field, model_validator

from fmus.component import Signal
from fmus.units import Unit, UnitError, parse_unit
from harness.quantity import Measure, Quantity, Strict
from harness.validation import nearest_hint
from harness.window import Window

Vector = NDArray[np.float64]
Pair = tuple[str, str]
NO_CRANK_ANGLE = (
    "wants the crank angle of the rows, which a record on a time clock does not have: "
    "name the signal that holds it, `angle: part.signal`"
)


class Result(NamedTuple):
    """What one value of a metric is: `error` (a difference), `signal` (with its offset), `count`, or a fixed unit."""

    of: str
    sampled: bool = False

    @property
    def own_unit(self) -> str:
        """The unit of the values as they are computed, where it is not that of a signal."""
        return "1" if self.of == "count" else self.of


PAIR_SCHEMA = {"type": "array", "items": {"type": "string"}, "minItems": 2, "maxItems": 2}


def short_form_too(*short: dict[str, Any]) -> ConfigDict:
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

    def compared(self) -> list[Pair]:
        """The [truth, estimate] among them."""
        return []

    def results(self, offered: Mapping[str, Result]) -> Mapping[str, Result]:
        """What it gives of the values that its kind offers."""
        return offered

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

    def crank_misfits(self, rows: CrankRows) -> list[str]:
        """What is wrong between it and how the crank angle of the rows is known, in words."""
        return []


class CrankRows(NamedTuple):
    """How the crank angle of the rows is known: `apart` [deg] from row to row of a crank clock, else a signal."""

    apart: float | None = None
    angle: str | None = None

    @property
    def unknown(self) -> bool:
        """True where nothing gives the crank angle."""
        return self.apart is None and self.angle is None


def expanded(offered: Mapping[str, Result], placeholder: str, names: Iterable[str]) -> dict[str, Result]:
    """The results with `{placeholder}` in a suffix replaced by each of the names."""
    mark = f"{{{placeholder}}}"
    return {
        suffix.replace(mark, name): result
        for suffix, result in offered.items()
        for name in (names if mark in suffix else [""])
    }


def read_errors(raw: Any) -> Any:
    """[truth, estimate] or a list of such pairs, as the mapping {pairs: ...}."""
    if isinstance(raw, list):
        return {"pairs": [raw] if all(isinstance(item, str) for item in raw) else raw}
    return raw


class Errors(Arguments):
    """The error of [truth, estimate], or the norm over several pairs, each divided by its scale where scales are given.

    e = estimate - truth for one pair, e = sqrt(sum_i ((estimate_i - truth_i)/scale_i)^2) for several.
    """

    model_config = short_form_too(PAIR_SCHEMA, {"type": "array", "items": PAIR_SCHEMA, "minItems": 1})

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

    def compared(self) -> list[Pair]:
        """All of them."""
        return self.pairs

    def norm(self, window: Window) -> Vector:
        """e by row, shape (n,)."""
        scales = [difference(scale) for scale in self.scales or []] or [1.0] * len(self.pairs)
        errors = (scaled_error(pair, scale, window) for pair, scale in zip(self.pairs, scales, strict=True))
        total = next(errors)
        if len(self.pairs) == 1:
            return total
        total *= total
        for error in errors:
            error *= error
            total += error
        return np.sqrt(total, out=total)

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
            if not fits(signals[estimate].unit, wanted):
                messages.append(f"{estimate} wants {wanted} like {truth}, got {signals[estimate].unit}")
            if self.scales is not None and not fits(self.scales[index].unit, wanted):
                messages.append(f"the scale of {truth} wants {wanted}, got {self.scales[index]}")
            if self.scales is None and not fits(wanted, signals[self.pairs[0][0]].unit):
                messages.append(f"a norm over {self.pairs[0][0]} and {truth} wants scales: their units differ")
        return messages


class SignedError(Errors):
    """The error of one pair [truth, estimate], with its sign."""

    @model_validator(mode="after")
    def _one_pair(self) -> SignedError:
        if len(self.pairs) != 1:
            raise ValueError(f"wants one pair [truth, estimate], got {len(self.pairs)}")
        return self


class One(Arguments):
    """One signal."""

    model_config = short_form_too({"type": "string"})

    signal: str = Field(description="its name, as part.output")

    @model_validator(mode="before")
    @classmethod
    def _short_form(cls, raw: Any) -> Any:
        return {"signal": raw} if isinstance(raw, str) else raw

    def names(self) -> list[str]:
        """The signal."""
        return [self.signal]

    def arrays(self, window: Window) -> tuple[Any, ...]:
        """(signal,)."""
        return (window.column(self.signal),)


class OneInTime(One):
    """One signal, and the time of each row."""

    def arrays(self, window: Window) -> tuple[Any, ...]:
        """(time, signal)."""
        return window.time, window.column(self.signal)


class Several(Arguments):
    """Two signals or more, of one dimension."""

    model_config = short_form_too({"type": "array", "items": {"type": "string"}, "minItems": 2})

    signals: list[str] = Field(min_length=2, description="their names, as part.output")

    @model_validator(mode="before")
    @classmethod
    def _short_form(cls, raw: Any) -> Any:
        return {"signals": raw} if isinstance(raw, list) else raw

    def names(self) -> list[str]:
        """The signals."""
        return list(self.signals)

    def arrays(self, window: Window) -> tuple[Any, ...]:
        """The signals, each (n,)."""
        return tuple(window.column(name) for name in self.signals)

    def unit(self, signals: Mapping[str, Signal]) -> str:
        """That of the first."""
        return signals[self.signals[0]].unit

    def misfits(self, signals: Mapping[str, Signal]) -> list[str]:
        """Also signals of another dimension than the first."""
        messages = super().misfits(signals)
        if messages:
            return messages
        first, *others = self.signals
        wanted = signals[first].unit
        return [
            f"{name} wants {wanted} like {first}, got {signals[name].unit}"
            for name in others
            if not fits(signals[name].unit, wanted)
        ]


def scaled_error(pair: Pair, scale: float, window: Window) -> Vector:
    """(estimate - truth)/scale by row, shape (n,), an array of its own."""
    truth, estimate = pair
    error = window.difference(estimate, truth)
    if scale != 1.0:
        error /= scale
    return error


def difference(measure: Measure) -> float:
    """A measure as a difference in SI: without the offset of its unit."""
    return measure.value * parse_unit(measure.unit).factor


def fits(unit: str, wanted: str) -> bool:
    """True where a value in `unit` can be one in `wanted`; a unit that nobody knows counts as none."""
    return dimension(unit) == dimension(wanted)


def dimension(unit: str) -> tuple[int, ...]:
    """The exponents of the base units; none where nobody knows the unit."""
    try:
        return parse_unit(unit).exponents
    except UnitError:
        return Unit().exponents
