"""The schema of a campaign file: one scenario, what varies in it, what is measured and what is demanded."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import BeforeValidator, Field, WithJsonSchema

from fmus.description import Validation
from harness.definitions import Definition
from harness.reportsection import ReportSection
from harness.scenario import VALIDATION_MEANS, Clock, Measure, Part, Quantity, Strict


class Experiment(Strict):
    """A named variant of the campaign: parts, overrides and axes of its own."""

    description: str = ""
    parts: dict[str, Part] = Field(default_factory=dict, description="added to the campaign's, or in their place")
    overrides: dict[str, Any] = Field(default_factory=dict, alias="set", description="path: value")
    vary: dict[str, Any] = Field(default_factory=dict, description="path, or paths: values")


class Limits(Strict):
    """How long things may take; no part of what a case gives."""

    case: Quantity = Field(Measure(10.0, "min"), description="wall time of one case")


def read_demand(raw: Any) -> Any:
    """A criterion's text, or {experiment: text}."""
    texts = raw.values() if isinstance(raw, dict) else [raw]
    if not all(isinstance(text, str) for text in texts):
        raise ValueError(f"wants 'metric < bound' or {{experiment: 'metric < bound'}}, got {raw!r}")
    return raw


Demand = Annotated[
    Any,
    BeforeValidator(read_demand),
    WithJsonSchema({"anyOf": [{"type": "string"}, {"type": "object", "additionalProperties": {"type": "string"}}]}),
]


class CampaignFile(Strict):
    """A campaign file: one scenario, what varies in it, what is measured and what is demanded."""

    campaign: str = Field(pattern=r"^[A-Za-z0-9][\w.-]*$", description="name")
    description: str = Field("", description="one line")
    clock: Clock
    seed: int = Field(0, ge=0)
    parts: dict[str, Part] = Field(min_length=1)
    record: list[str] | None = Field(None, description="signals to record, as part or part.output; all where absent")
    validation: Validation = Field("warn", description=VALIDATION_MEANS)
    vary: dict[str, Any] = Field(default_factory=dict, description="path, or paths: list of values or 1..20")
    experiments: dict[str, Experiment] = Field(default_factory=dict)
    metrics: dict[str, Definition] = Field(default_factory=dict)
    accept: list[Demand] = Field(default_factory=list, description="what must hold of the metrics")
    report: ReportSection = ReportSection()
    limits: Limits = Field(default_factory=lambda: Limits.model_validate({}))
