"""Names the metrics of several observers at once: a metric with `{observer}` in the place of each one's name."""

from __future__ import annotations

from collections.abc import Collection
from typing import Annotated

from pydantic import AfterValidator, Field

from harness.quantity import Strict

OBSERVER = "{observer}"


def read_pattern(text: str) -> str:
    """The name of a metric with `{observer}` in the place of each observer's name."""
    if text.count(OBSERVER) != 1 or set("{}") & set(text.replace(OBSERVER, "")):
        raise ValueError(f"wants the name of a metric with {OBSERVER} in it once, got '{text}'")
    return text


Pattern = Annotated[str, AfterValidator(read_pattern)]


def of_observer(pattern: str, observer: str) -> str:
    """The metric of an observer."""
    return pattern.replace(OBSERVER, observer)


class OfObservers(Strict):
    """A metric of several observers."""

    metric: Pattern = Field(description="each observer's metric, like rmse_{observer}")
    observers: list[str] = Field(default_factory=list, description="whose; of all parts that have it where absent")

    def metric_of(self, observer: str) -> str:
        """The metric of an observer."""
        return of_observer(self.metric, observer)

    def named(self, parts: Collection[str], values: Collection[str]) -> list[str]:
        """The observers: those named, else the parts that have the metric."""
        return self.observers or [part for part in parts if self.metric_of(part) in values]
