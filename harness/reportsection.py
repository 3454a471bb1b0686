"""The schema of a campaign's `report`: what the report draws and compares with published values."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from pydantic import Field

from harness.places import KeyPath
from harness.quantity import Quantity, Strict


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
    metric: str | None = None
    experiment: str | None = None
    note: str = ""


class ReportSection(Strict):
    """What the report draws."""

    observers: dict[str, ReportedObserver] = Field(default_factory=dict)
    figures: list[Figure] = Field(default_factory=list)
    published: list[Published] = Field(default_factory=list)

    def references(self) -> Iterator[tuple[KeyPath, str, str]]:
        """(where, metric or experiment or part, name) for every name that must exist in the campaign."""
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
