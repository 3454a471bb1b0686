"""A campaign's metrics by name: what each is measured on, in which window and unit, and its values for a record."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from pydantic import Field, create_model, model_validator

from fmus.component import Problem, Signal
from fmus.units import parse_unit
from harness.arguments import Arguments, Window
from harness.metrics import KINDS, Kind, Result
from harness.places import Places
from harness.quantity import Quantity, Strict
from harness.record import Record

# Rows are counted as inside a window when they miss its ends by less than this, relative to the time.
ROUNDING = 1e-9


class Value(NamedTuple):
    """One value of a metric in the unit it is shown in."""

    value: float
    unit: str


class Options(Strict):
    """What every metric may say: its window, its unit and the experiments it is measured in."""

    description: str = ""
    after: Quantity | None = Field(None, description="rows before this time are left out")
    until: Quantity | None = Field(None, description="rows after this time are left out")
    unit: str | None = Field(None, description="unit to show the values in; of a detection, its delays")
    only: list[str] | None = Field(None, description="experiments to measure it in; all where absent")

    @model_validator(mode="after")
    def _one_kind(self) -> Options:
        given = [kind for kind in KINDS if getattr(self, kind, None) is not None]
        if len(given) != 1:
            raise ValueError(f"wants one of {', '.join(KINDS)}, got {' and '.join(given) or 'none'}")
        for name in ("after", "until"):
            if getattr(self, name) is not None:
                getattr(self, name).si("s")
        if self.unit is not None:
            parse_unit(self.unit)
        return self

    @property
    def kind(self) -> Kind:
        """The kind of measure."""
        return next(KINDS[kind] for kind in KINDS if getattr(self, kind, None) is not None)

    @property
    def arguments(self) -> Arguments:
        """What it is measured on."""
        found: Arguments = next(getattr(self, kind) for kind in KINDS if getattr(self, kind, None) is not None)
        return found

    def covers(self, experiment: str) -> bool:
        """True where it is measured in this experiment."""
        return self.only is None or experiment in self.only


if TYPE_CHECKING:
    Definition = Options
else:
    _KIND_FIELDS = {
        name: (kind.arguments | None, Field(None, description=(kind.function.__doc__ or "").split("\n")[0]))
        for name, kind in KINDS.items()
    }
    Definition = create_model(
        "Definition", __base__=Options, __doc__="One metric.", __module__=__name__, **_KIND_FIELDS
    )


def value_name(metric: str, suffix: str) -> str:
    """`located.delay_p95` of a metric `located` with several values, `rmse_theta` of one with a single value."""
    return f"{metric}.{suffix}" if suffix else metric


def results(definitions: Mapping[str, Definition]) -> dict[str, tuple[str, Result]]:
    """Every value the metrics give, by its name: the metric and what it is."""
    return {
        value_name(metric, suffix): (metric, result)
        for metric, definition in definitions.items()
        for suffix, result in definition.kind.results.items()
    }


def value_part(definitions: Mapping[str, Definition], value: str) -> str:
    """The part that a value speaks of: that of the estimate where there is one, else of the signal."""
    names = definitions[results(definitions)[value][0]].arguments.names()
    return names[min(1, len(names) - 1)].partition(".")[0]


def shown_unit(definition: Definition, result: Result, signals: Mapping[str, Signal]) -> str:
    """The unit that a value is shown in: `unit` where it has that dimension, else its own."""
    own = definition.arguments.unit(signals) if result.of in ("error", "signal") else result.of
    if definition.unit is not None and parse_unit(definition.unit).same_dimension(parse_unit(own)):
        return definition.unit
    return own


def misfits(name: str, definition: Definition, signals: Mapping[str, Signal], places: Places) -> list[Problem]:
    """What is wrong with a metric, once the signals it can look at are known."""
    messages = definition.arguments.misfits(signals)
    if not messages and definition.unit is not None:
        shown = [shown_unit(definition, result, signals) for result in definition.kind.results.values()]
        if definition.unit not in shown:
            messages = [f"unit wants {shown[0]} or alike, got {definition.unit}"]
    return [places.problem(f"metrics.{name}: {message}", "metrics", name) for message in messages]


def measure(
    definitions: Mapping[str, Definition], record: Record, experiment: str
) -> tuple[dict[str, Value], dict[str, list[float]]]:
    """The values of the metrics of one complete record, and the samples of those that have them, in shown units."""
    signals = {signal.name: signal for signal in record.signals}
    values: dict[str, Value] = {}
    samples: dict[str, list[float]] = {}
    for metric, definition in definitions.items():
        if not definition.covers(experiment):
            continue
        kind = definition.kind
        outcome = kind.function(*definition.arguments.arrays(_window(definition, record)))
        found = outcome if isinstance(outcome, Mapping) else {"": outcome}
        for suffix, result in kind.results.items():
            unit = shown_unit(definition, result, signals)
            shown = _shown(found[suffix], result, unit)
            if result.sampled:
                samples[value_name(metric, suffix)] = [float(sample) for sample in np.atleast_1d(shown)]
            else:
                values[value_name(metric, suffix)] = Value(float(shown), unit)
    return values, samples


def digest(definitions: Mapping[str, Definition]) -> str:
    """Sha256 of the definitions and of the code that measures them: where it differs, metrics are measured again."""
    text = json.dumps(written(definitions), sort_keys=True)
    sources = [Path(__file__), *(Path(__file__).with_name(name) for name in ("metrics.py", "arguments.py"))]
    return hashlib.sha256(text.encode() + b"".join(source.read_bytes() for source in sources)).hexdigest()


def written(definitions: Mapping[str, Definition]) -> dict[str, Any]:
    """The definitions as plain data, as campaign.json keeps them, each with its meaning."""
    return {
        name: definition.model_dump(mode="json", by_alias=True, exclude_none=True, exclude_defaults=True)
        | {"meaning": " ".join((definition.kind.function.__doc__ or "").split())}
        for name, definition in definitions.items()
    }


def _window(definition: Definition, record: Record) -> Window:
    time = record.time
    rows = np.ones(len(time), dtype=bool)
    if definition.after is not None:
        after = definition.after.si("s")
        rows &= time >= after - ROUNDING * max(1.0, abs(after))
    if definition.until is not None:
        until = definition.until.si("s")
        rows &= time <= until + ROUNDING * max(1.0, abs(until))
    return Window(time[rows], lambda name: record[name][rows])


def _shown(value: Any, result: Result, unit: str) -> Any:
    shown = parse_unit(unit)
    if result.of == "signal":
        return (np.asarray(value) - shown.offset) / shown.factor
    if result.of == "error":
        return np.asarray(value) / shown.factor
    return np.asarray(value) * (parse_unit(result.of).factor / shown.factor)
