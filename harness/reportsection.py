"""The schema of a campaign's `report`: what the report draws and compares with published values."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, Any

from pydantic import Field, model_validator

from harness.ofobservers import Pattern, of_observer
from harness.places import KeyPath
from harness.quantity import Measure, Quantity, Strict
from harness.reportaxes import Better, Curve, Power
from harness.reportfigures import Figure, Histogram
from selection.methods import Method


class ReportedObserver(Strict):
    """How the report calls an observer, and the metrics that are its own."""

    title: str = ""
    metrics: list[str] = Field(default_factory=list)


class Published(Strict):
    """A value or a statement from the paper beside ours."""

    what: str
    published: Any
    ours: Any = Field(None, description="what stands beside it where no metric does")
    metric: str | None = None
    experiment: str | None = None
    holds: str | None = Field(None, description="the statement as a criterion, which is judged but never fails the run")
    note: str = ""


# Of fewer observers a rank correlation says nothing.
FEWEST_RANKED = 3


class RankedMeasure(Strict):
    """What a measure says of each observer: values known before the run, or the medians of another metric."""

    title: str = ""
    better: Better = Field("lower", description="which values are the better ones")
    values: dict[str, float | None] = Field(
        default_factory=dict, description="by observer; null: it has none, and ranks behind all others"
    )
    metric: Pattern | None = Field(None, description="instead of values: another metric of each of the observers")
    observers: list[str] = Field(default_factory=list, description="of the metric: whose")

    @model_validator(mode="after")
    def _comparable(self) -> RankedMeasure:
        if bool(self.values) == (self.metric is not None) or (self.observers and self.metric is None):
            raise ValueError("wants values by observer, or a metric with observers")
        if len(set(self.named)) < FEWEST_RANKED:
            raise ValueError(f"wants values of {FEWEST_RANKED} observers or more, got {len(set(self.named))}")
        for observer, value in self.values.items():
            if value is not None and not math.isfinite(value):
                raise ValueError(f"wants a finite value of {observer}, or null for none, got {value}")
        return self

    @property
    def named(self) -> list[str]:
        """Everyone it says something of."""
        return list(dict.fromkeys([*self.values, *self.observers]))


class Ranking(Strict):
    """A question: does a measure put the observers in the order that a metric puts them in?

    Answered by Spearman's rank correlation of the measure with the observers' medians of the metric over the cases.
    """

    title: str
    metric: Pattern = Field(description="each observer's metric, like rmse_{observer}")
    better: Better = Field("lower", description="which values of the metric are the better ones")
    experiments: list[str] = Field(default_factory=list, description="whose cases count; all where absent")
    measures: dict[str, RankedMeasure] = Field(min_length=1)
    resamples: int = Field(2000, ge=100, le=100_000, description="of the bootstrap that gives the interval")
    seed: int = Field(0, ge=0, description="of the bootstrap")
    note: str = ""

    def metric_of(self, observer: str) -> str:
        """The metric of an observer."""
        return of_observer(self.metric, observer)

    def observers(self) -> list[str]:
        """Everyone that a measure says something of."""
        return list(dict.fromkeys(observer for measure in self.measures.values() for observer in measure.named))


class ReportedSelection(Strict):
    """A selection of sensors to show: what `crankbench select` gives of a model with the same words."""

    target: str = Field(description="a plant's name, module, or module:name")
    parameter_set: str | None = Field(None, alias="set", description="a named parameter set of the model")
    at: list[str] = Field(default_factory=list, description="the point, like N=3200 rpm")
    settle: bool = Field(False, description="whether the model comes to rest from the point first")
    about: dict[str, Quantity] = Field(
        default_factory=dict, description="what a reference shows at the point, which then counts as rest"
    )
    estimate: list[str] = Field(min_length=1, description="the states to estimate")
    max_sensors: int = Field(3, ge=1)
    method: Method = "structural"
    sensors: list[str] = Field(default_factory=list, description="states and outputs that may be measured")
    noise: dict[str, Quantity] = Field(default_factory=dict, description="standard deviations of samples, by sensor")
    period: Quantity = Field(Measure(10.0, "ms"), description="time between samples")
    process: Annotated[float, Field(ge=0.0)] | dict[str, Quantity] = Field(
        0.01, description="what disturbs each state, of its size in a second; or by state a deviation after a second"
    )
    disturbances: dict[str, Quantity] = Field(
        default_factory=dict, description="what disturbs single states instead: deviation after a second, by state"
    )
    also_at: list[str] = Field(default_factory=list, description="points to show the structure at, too")


class ReportSection(Strict):
    """What the report draws."""

    observers: dict[str, ReportedObserver] = Field(default_factory=dict)
    figures: list[Figure] = Field(default_factory=list)
    histograms: list[Histogram] = Field(default_factory=list)
    published: list[Published] = Field(default_factory=list)
    curves: list[Curve] = Field(default_factory=list)
    powers: list[Power] = Field(default_factory=list)
    rankings: list[Ranking] = Field(default_factory=list)
    selection: ReportedSelection | None = None

    def against_axes(self) -> Mapping[str, Sequence[Curve | Power]]:
        """What is drawn against axes of the campaign, by the key it stands under."""
        return {"curves": self.curves, "powers": self.powers}

    def references(self) -> Iterator[tuple[KeyPath, str, str]]:
        """(where, kind, name) of every name that must exist in the campaign: a metric, experiment, part or value.

        Of the kind `pattern` some part must have a metric named so.
        """
        for part, observer in self.observers.items():
            yield ("observers", part), "part", part
            for index, metric in enumerate(observer.metrics):
                yield ("observers", part, "metrics", index), "metric", metric
        for index, figure in enumerate(self.figures):
            if figure.experiment is not None:
                yield ("figures", index, "experiment"), "experiment", figure.experiment
        for index, histogram in enumerate(self.histograms):
            for position, experiment in enumerate(histogram.experiments):
                yield ("histograms", index, "experiments", position), "experiment", experiment
        for index, entry in enumerate(self.published):
            if entry.metric is not None:
                yield ("published", index, "metric"), "metric", entry.metric
            if entry.experiment is not None:
                yield ("published", index, "experiment"), "experiment", entry.experiment
        for section, entries in self.against_axes().items():
            for index, asked in enumerate(entries):
                for position, experiment in enumerate(asked.experiments):
                    yield (section, index, "experiments", position), "experiment", experiment
                for position, named in enumerate(asked.observers):
                    yield (section, index, "observers", position), "part", named
                    yield (section, index, "observers", position), "value", asked.metric_of(named)
                if not asked.observers:
                    yield (section, index, "metric"), "pattern", asked.metric
        for index, ranking in enumerate(self.rankings):
            for position, experiment in enumerate(ranking.experiments):
                yield ("rankings", index, "experiments", position), "experiment", experiment
            for name, measure in ranking.measures.items():
                for position, ranked in enumerate(measure.named):
                    below = ("observers", position) if measure.observers else ("values", ranked)
                    path: KeyPath = ("rankings", index, "measures", name, *below)
                    yield path, "part", ranked
                    yield path, "value", ranking.metric_of(ranked)
                    if measure.metric is not None:
                        yield path, "value", of_observer(measure.metric, ranked)
