"""The schema of what a report draws from records: signals over time or crank angle, histograms of errors."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from fmus.units import UnitError
from harness.arguments import Pair
from harness.quantity import Quantity, Strict
from harness.window import degrees, is_angle

Over = Literal["time", "crank", "cycles", "cycle"]


class Stretch(Strict):
    """The rows that are drawn: from one time or crank angle to another, ends included."""

    start: Quantity | None = Field(None, alias="from", description="the time or crank angle it begins at")
    until: Quantity | None = Field(None, alias="to", description="the time or crank angle it ends at")

    @model_validator(mode="after")
    def _ends(self) -> Stretch:
        for name, end in {"from": self.start, "to": self.until}.items():
            if end is not None and not is_angle(end):
                try:
                    end.si("s")
                except UnitError:
                    raise ValueError(
                        f"{name} wants a time or a crank angle, like 0.5 s or 720 deg, got {end}"
                    ) from None
        return self

    @property
    def by_angle(self) -> bool:
        """True where an end is a crank angle."""
        return any(end is not None and is_angle(end) for end in (self.start, self.until))


class Figure(Stretch):
    """Signals over time or crank angle, one panel a list of signals; or of some cycles laid over each other."""

    title: str
    experiment: str | None = Field(None, description="its first case is drawn; the campaign's first where absent")
    traces: list[list[str]] = Field(min_length=1, description="one list of signals a panel")
    lines: dict[str, str] = Field(default_factory=dict, description="value with unit: name of a horizontal line")
    unit: str | None = None
    over: Over = Field(
        "time", description="crank: angle; cycles: the same, counted in cycles; cycle: cycles laid over each other"
    )
    last: int | None = Field(
        None, ge=1, le=100, description="over cycle: how many whole cycles, the last ones; one, or all from..to"
    )
    angle: str | None = Field(None, description="signal that holds the crank angle, where the clock is one of time")
    cycle: Quantity | None = Field(None, description="crank angle of a cycle, where neither clock nor part says so")

    @model_validator(mode="after")
    def _over_crank(self) -> Figure:
        if self.last is not None and self.over != "cycle":
            raise ValueError(f"last wants `over: cycle`, got over: {self.over}")
        if self.cycle is not None and not degrees(self.cycle) > 0.0:
            raise ValueError(f"cycle wants a crank angle above 0 deg, got {self.cycle}")
        return self

    @property
    def wants_crank(self) -> bool:
        """True where the crank angle of the rows is needed."""
        return self.over != "time" or self.by_angle


class Histogram(Stretch):
    """How the errors of several estimates are distributed: a panel each, the same bins in all of them."""

    title: str
    experiments: list[str] = Field(default_factory=list, description="whose cases count; all where absent")
    pairs: list[Pair] = Field(min_length=1, description="[truth, estimate] each")
    bins: int = Field(60, ge=2, le=1000)
    reach: Quantity | None = Field(
        None,
        description="bins lie from minus this to this, the outermost hold the rest; the largest error where absent",
    )
    scale: Literal["linear", "log"] = Field("linear", description="of the share of the rows")
    unit: str | None = None
    angle: str | None = Field(None, description="signal that holds the crank angle, where the clock is one of time")

    @model_validator(mode="after")
    def _bins(self) -> Histogram:
        if self.reach is not None and not self.reach.value > 0.0:
            raise ValueError(f"reach wants a value above 0, got {self.reach}")
        return self

    @property
    def wants_crank(self) -> bool:
        """True where the crank angle of the rows is needed."""
        return self.by_angle
