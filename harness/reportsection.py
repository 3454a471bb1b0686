"""The schema of a campaign's `report`: what the report draws and compares with published values."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, model_validator

from harness.places import KeyPath
from harness.quantity import Measure, Quantity, Strict
from selection.methods import Method


class ReportedObserver(Strict):
    """How the report calls an observer, and the metrics that are its own."""

    title: str = ""
    metrics: list[str] = Field(default_factory=list)


class Figure(Strict):
    """Signals over time, one panel a list of signals."""

    title: str
    experiment: str | None = Field(None, description="its first case is drawn; the campaign's first where absent")
    traces: list[list[str]] = Field(min_length=1, description="one list of signals a panel")
    lines: dict[str, str] = Field(default_factory=dict, description="value with unit: name of a horizontal line")
    unit: str | None = None
    start: Quantity | None = Field(None, alias="from", description="the time the figure begins at")
    until: Quantity | None = Field(None, alias="to", description="the time it ends at")


class Published(Strict):
    """A value from the paper beside ours."""

    what: str
    published: Any
    ours: Any = Field(None, description="what stands beside it where no metric does")
    metric: str | None = None
    experiment: str | None = None
    note: str = ""


Better = Literal["lower", "higher"]
OBSERVER = "{observer}"
# Of fewer observers a rank correlation says nothing.
FEWEST_RANKED = 3


def read_pattern(text: str) -> str:
    """The name of a metric with `{observer}` in the place of each observer's name."""
    if text.count(OBSERVER) != 1 or set("{}") & set(text.replace(OBSERVER, "")):
        raise ValueError(f"wants the name of a metric with {OBSERVER} in it once, got '{text}'")
    return text


class RankedMeasure(Strict):
    """What a measure says of each observer, known before the run."""

    title: str = ""
    better: Better = Field("lower", description="which values are the better ones")
    values: dict[str, float | None] = Field(description="by observer; null: it has none, and ranks behind all others")

    @model_validator(mode="after")
    def _comparable(self) -> RankedMeasure:
        if len(self.values) < FEWEST_RANKED:
            raise ValueError(f"wants values of {FEWEST_RANKED} observers or more, got {len(self.values)}")
        for observer, value in self.values.items():
            if value is not None and not math.isfinite(value):
                raise ValueError(f"wants a finite value of {observer}, or null for none, got {value}")
        return self


class Ranking(Strict):
    """A question: does a measure, known before the run, put the observers in the order that a metric puts them in?

    Answered by Spearman's rank correlation of the measure with the observers' medians of the metric over the cases.
    """

    title: str
    metric: Annotated[str, AfterValidator(read_pattern)] = Field(
        description="each observer's metric, like rmse_{observer}"
    )
    better: Better = Field("lower", description="which values of the metric are the better ones")
    experiments: list[str] = Field(default_factory=list, description="whose cases count; all where absent")
    measures: dict[str, RankedMeasure] = Field(min_length=1)
    resamples: int = Field(2000, ge=100, le=100_000, description="of the bootstrap that gives the interval")
    seed: int = Field(0, ge=0, description="of the bootstrap")
    note: str = ""

    def metric_of(self, observer: str) -> str:
        """The metric of an observer."""
        return self.metric.replace(OBSERVER, observer)

    def observers(self) -> list[str]:
        """Everyone that a measure says something of."""
        return list(dict.fromkeys(observer for measure in self.measures.values() for observer in measure.values))


class ReportedSelection(Strict):
    """A selection of sensors to show: what `crankbench select` gives of a model with the same words."""

    target: str = Field(description="a plant's name, module, or module:name")
    parameter_set: str | None = Field(None, alias="set", description="a named parameter set of the model")
    estimate: list[str] = Field(min_length=1, description="the states to estimate")
    max_sensors: int = Field(3, ge=1)
    method: Method = "structural"
    sensors: list[str] = Field(default_factory=list, description="states and outputs that may be measured")
    noise: dict[str, Quantity] = Field(default_factory=dict, description="standard deviations of samples, by sensor")
    period: Quantity = Field(Measure(10.0, "ms"), description="time between samples")
    process: float = Field(0.01, ge=0.0, description="what disturbs each state, of its size in a second")
    disturbances: dict[str, Quantity] = Field(
        default_factory=dict, description="what disturbs single states instead: deviation after a second, by state"
    )
    also_at: list[str] = Field(default_factory=list, description="points to show the structure at, too")


class ReportSection(Strict):
    """What the report draws."""

    observers: dict[str, ReportedObserver] = Field(default_factory=dict)
    figures: list[Figure] = Field(default_factory=list)
    published: list[Published] = Field(default_factory=list)
    rankings: list[Ranking] = Field(default_factory=list)
    selection: ReportedSelection | None = None

    def references(self) -> Iterator[tuple[KeyPath, str, str]]:
        """(where, metric or experiment or part or value, name) for every name that must exist in the campaign."""
        for part, observer in self.observers.items():
            yield ("observers", part), "part", part
            for index, metric in enumerate(observer.metrics):
                yield ("observers", part, "metrics", index), "metric", metric
        for index, figure in enumerate(self.figures):
            if figure.experiment is not None:
                yield ("figures", index, "experiment"), "experiment", figure.experiment
        for index, entry in enumerate(self.published):
            if entry.metric is not None:
                yield ("published", index, "metric"), "metric", entry.metric
            if entry.experiment is not None:
                yield ("published", index, "experiment"), "experiment", entry.experiment
        for index, ranking in enumerate(self.rankings):
            for position, experiment in enumerate(ranking.experiments):
                yield ("rankings", index, "experiments", position), "experiment", experiment
            for name, measure in ranking.measures.items():
                for ranked in measure.values:
                    path = ("rankings", index, "measures", name, "values", ranked)
                    yield path, "part", ranked
                    yield path, "value", ranking.metric_of(ranked)
