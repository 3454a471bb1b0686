"""A campaign's metrics by name: what each is measured on, in which window and unit, and its values for a record."""

from __future__ import annotations

import hashlib
import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from pydantic import Field, create_model, model_validator

from fmus.component import Problem, Signal
from fmus.units import parse_unit
from harness.arguments import NO_CRANK_ANGLE, Arguments, CrankRows, Result, dimension
from harness.diagnosismetrics import Matrix
from harness.metrics import KINDS, Kind
from harness.places import Places
from harness.quantity import Quantity, Strict
from harness.validation import nearest_hint
from harness.window import Recorded, is_angle, window

# What a value of signals, or of a difference of them, is called by its result.
OF_SIGNALS = ("error", "signal")
# What the values depend on beside the functions of the kinds.
MEASURING = [f"harness.{name}" for name in ("arguments", "crankrows", "metrics", "percentile", "window")]


class Value(NamedTuple):
    """One value of a metric in the unit it is shown in."""

    value: float
    unit: str


class Measured(NamedTuple):
    """What the metrics of a record gave: values by name, samples of those that have them, matrices by metric."""

    values: dict[str, Value]
    samples: dict[str, list[float]]
    matrices: dict[str, Matrix]


class Options(Strict):
    """What every metric may say: its window, its unit and the experiments it is measured in."""

    description: str = ""
    after: Quantity | None = Field(None, description="rows before this time or crank angle are left out")
    until: Quantity | None = Field(None, description="rows after this time or crank angle are left out")
    angle: str | None = Field(None, description="signal that holds the crank angle, where the clock is one of time")
    unit: str | None = Field(None, description="unit to show the values in; of a detection, its delays")
    only: list[str] | None = Field(None, description="experiments to measure it in; all where absent")

    @model_validator(mode="after")
    def _one_kind(self) -> Options:
        given = [kind for kind in KINDS if getattr(self, kind, None) is not None]
        if len(given) != 1:
            raise ValueError(f"wants one of {', '.join(KINDS)}, got {' and '.join(given) or 'none'}")
        for name in ("after", "until"):
            edge = getattr(self, name)
            if edge is not None and not (is_angle(edge) or dimension(edge.unit) == dimension("s")):
                raise ValueError(f"{name} wants a time or a crank angle, like 0.5 s or 720 deg, got {edge}")
        if self.unit is not None:
            parse_unit(self.unit)
        return self

    @property
    def kind_name(self) -> str:
        """What kind of measure it is."""
        return next(kind for kind in KINDS if getattr(self, kind, None) is not None)

    @property
    def kind(self) -> Kind:
        """The kind of measure."""
        return KINDS[self.kind_name]

    @property
    def arguments(self) -> Arguments:
        """What it is measured on."""
        found: Arguments = getattr(self, self.kind_name)
        return found

    @property
    def results(self) -> Mapping[str, Result]:
        """What its values are, by suffix."""
        return self.arguments.results(self.kind.results)

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
        for suffix, result in definition.results.items()
    }


def value_part(definitions: Mapping[str, Definition], value: str) -> str:
    """The part that a value speaks of: that of the estimate where there is one, else of the signal."""
    arguments = definitions[results(definitions)[value][0]].arguments
    compared = arguments.compared()
    return (compared[0][1] if compared else arguments.names()[0]).partition(".")[0]


def shown_unit(definition: Definition, result: Result, signals: Mapping[str, Signal]) -> str:
    """The unit that a value is shown in: `unit` where it speaks of such values, else its own.

    It speaks of those in the unit of the signals where the metric has such, else of those of its dimension, but counts.
    """
    own = definition.arguments.unit(signals) if result.of in OF_SIGNALS else result.own_unit
    of_signals = any(one.of in OF_SIGNALS for one in definition.kind.results.values())
    spoken_of = result.of in OF_SIGNALS if of_signals else result.of != "count"
    if definition.unit is not None and spoken_of and parse_unit(definition.unit).same_dimension(parse_unit(own)):
        return definition.unit
    return own


def misfits(
    name: str, definition: Definition, signals: Mapping[str, Signal], places: Places, apart: float | None = None
) -> list[Problem]:
    """What is wrong with a metric, once the signals it can look at are known.

    `apart` [deg] is the crank angle from row to row, None on a time clock.
    """
    messages = definition.arguments.misfits(signals) + _crank_misfits(definition, signals, apart)
    if not messages and definition.unit is not None:
        shown = [shown_unit(definition, result, signals) for result in definition.kind.results.values()]
        if definition.unit not in shown:
            messages = [f"unit wants {shown[0]} or alike, got {definition.unit}"]
    return [places.problem(f"metrics.{name}: {message}", "metrics", name) for message in messages]


def _crank_misfits(definition: Definition, signals: Mapping[str, Signal], apart: float | None) -> list[str]:
    angle = definition.angle
    if angle is not None and angle not in signals:
        return [f"angle: no recorded signal is named '{angle}'{nearest_hint(angle, signals)}"]
    if angle is not None and dimension(signals[angle].unit) != dimension("rad"):
        return [f"angle wants a signal in rad, got {angle} in {signals[angle].unit}"]
    rows = CrankRows(apart, angle)
    edges = {name: getattr(definition, name) for name in ("after", "until")}
    found = [f"{name} {edge} {NO_CRANK_ANGLE}" for name, edge in edges.items() if edge and is_angle(edge)]
    return (found if rows.unknown else []) + definition.arguments.crank_misfits(rows)


def measure(definitions: Mapping[str, Definition], record: Recorded, experiment: str) -> Measured:
    """The values of the metrics of one complete record in shown units, with their samples and matrices.

    They are taken over the rows that were recorded: of a record with one instant in ten, over those.
    """
    signals = {signal.name: signal for signal in record.signals}
    measured = Measured({}, {}, {})
    for metric, definition in definitions.items():
        if not definition.covers(experiment):
            continue
        rows = window(record, definition.after, definition.until, definition.angle)
        outcome = definition.kind.function(*definition.arguments.arrays(rows))
        found = outcome if isinstance(outcome, Mapping) else {"": outcome}
        for suffix, result in definition.results.items():
            unit = shown_unit(definition, result, signals)
            shown = _shown(found[suffix], result, unit)
            if result.sampled:
                measured.samples[value_name(metric, suffix)] = [float(sample) for sample in np.atleast_1d(shown)]
            else:
                measured.values[value_name(metric, suffix)] = Value(float(shown), unit)
        if isinstance(matrix := found.get("matrix"), Matrix):
            measured.matrices[metric] = matrix
    return measured


def digest(definitions: Mapping[str, Definition]) -> str:
    """Sha256 of the definitions and of the code that measures them: where it differs, metrics are measured again."""
    text = json.dumps(written(definitions), sort_keys=True)
    modules = {kind.function.__module__ for kind in KINDS.values()} | {__name__, *MEASURING}
    sources = [Path(str(sys.modules[name].__file__)) for name in sorted(modules)]
    return hashlib.sha256(text.encode() + b"".join(source.read_bytes() for source in sources)).hexdigest()


def meanings(definitions: Mapping[str, Definition]) -> dict[str, dict[str, Any]]:
    """What campaign.json says of each metric beside its definition: kind, version, meaning, and what is compared."""
    return {
        name: {
            "kind": definition.kind_name,
            "version": definition.kind.version,
            "meaning": definition.kind.meaning,
            "compares": [list(pair) for pair in definition.arguments.compared()],
        }
        for name, definition in definitions.items()
    }


def written(definitions: Mapping[str, Definition]) -> dict[str, Any]:
    """The definitions as plain data, each with its meaning."""
    told = meanings(definitions)
    return {
        name: definition.model_dump(mode="json", by_alias=True, exclude_none=True, exclude_defaults=True) | told[name]
        for name, definition in definitions.items()
    }


def _shown(value: Any, result: Result, unit: str) -> Any:
    shown = parse_unit(unit)
    if result.of == "signal":
        return (np.asarray(value) - shown.offset) / shown.factor
    if result.of == "error":
        return np.asarray(value) / shown.factor
    return np.asarray(value) * (parse_unit(result.own_unit).factor / shown.factor)
