"""The schema of what a report draws against axes of the campaign: curves of a metric, and powers of detection."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Literal

from pydantic import BeforeValidator, Field, WithJsonSchema, model_validator

from fmus.units import UnitError
from harness.ofobservers import OfObservers
from harness.places import KeyPath
from harness.quantity import Measure, Quantity

Better = Literal["lower", "higher"]


class AgainstAxis(OfObservers):
    """A metric of several observers against an axis of the campaign, over the cases of some experiments."""

    title: str
    against: str = Field(description="the axis below: a path that the campaign varies, its values numbers")
    experiments: list[str] = Field(
        default_factory=list, description="whose cases count; all that vary the axes where absent"
    )
    note: str = ""

    def axes(self) -> Iterator[tuple[KeyPath, str, Literal["numbers", "any"]]]:
        """(where, path, what its values must be) of every axis that each of its cases varies."""
        yield ("against",), self.against, "numbers"


class Curve(AgainstAxis):
    """The median of each observer's metric over the cases, with what the middle 90 % of them are between."""

    panels: str | None = Field(None, description="another axis: a panel for each of its values")
    better: Better = Field("lower", description="which values are the better ones: a failed case counts as the worst")

    def axes(self) -> Iterator[tuple[KeyPath, str, Literal["numbers", "any"]]]:
        """Also that of the panels."""
        yield from super().axes()
        if self.panels is not None:
            yield ("panels",), self.panels, "any"


class Power(AgainstAxis):
    """The smallest magnitude from which on each observer finds what there is to find, in so many of the cases."""

    magnitudes: Annotated[
        list[str],
        BeforeValidator(lambda raw: [raw] if isinstance(raw, str) else raw),
        WithJsonSchema({"anyOf": [{"type": "string"}, {"type": "array", "items": {"type": "string"}, "minItems": 1}]}),
    ] = Field(
        alias="magnitude",
        min_length=1,
        description="the axis whose absolute value is found; of several the largest of those that a case varies",
    )
    hit: float = Field(1.0, gt=0.0, le=1.0, description="the metric, a share, from which on a case counts as found")
    share: Quantity = Field(Measure(95.0, "%"), description="of the cases that are to be found")
    confidence: Quantity = Field(Measure(95.0, "%"), description="of the interval of the share")

    @model_validator(mode="after")
    def _shares(self) -> Power:
        for name, share in {"share": self.share, "confidence": self.confidence}.items():
            try:
                inside = 0.0 < share.si("1") < 1.0 or (name == "share" and share.si("1") == 1.0)
            except UnitError:
                inside = False
            if not inside:
                raise ValueError(f"{name} wants a share below 100 %, like 95 %, got {share}")
        return self
