"""The schema of a campaign file: one scenario, what varies in it, what is measured and what is demanded."""

from __future__ import annotations

import re
from typing import Annotated, Any, NamedTuple

from pydantic import BeforeValidator, Field, PlainSerializer, WithJsonSchema

from fmus.description import Validation
from harness.definitions import Definition
from harness.quantity import Measure, Quantity, Strict
from harness.reportsection import ReportSection
from harness.scenario import RECORD_MEANS, VALIDATION_MEANS, Clock, Coupling, Kept, Part, Record
from harness.worker import Limits as WorkerLimits

MEMORY_UNITS = {"kB": 1e3, "MB": 1e6, "GB": 1e9, "TB": 1e12, "KiB": 2.0**10, "MiB": 2.0**20, "GiB": 2.0**30}


class Experiment(Strict):
    """A named variant of the campaign: parts, overrides and axes of its own."""

    description: str = ""
    parts: dict[str, Part] = Field(default_factory=dict, description="added to the campaign's, or in their place")
    overrides: dict[str, Any] = Field(default_factory=dict, alias="set", description="path: value")
    vary: dict[str, Any] = Field(default_factory=dict, description="path, or paths: values")


class Memory(NamedTuple):
    """An amount of memory as written: a number and its unit."""

    value: float
    unit: str

    @property
    def size(self) -> float:
        """The amount in bytes."""
        return self.value * MEMORY_UNITS[self.unit]

    def __str__(self) -> str:
        return f"{self.value:g} {self.unit}"


def read_memory(raw: Any) -> Memory:
    """A Memory from `4 GiB` or `512 MB`."""
    if isinstance(raw, Memory):
        return raw
    match = re.fullmatch(r"\s*([\d.]+)\s*([A-Za-z]+)\s*", raw) if isinstance(raw, str) else None
    try:
        found = Memory(float(match[1]), match[2]) if match else None
    except ValueError:
        found = None
    if found is None or found.unit not in MEMORY_UNITS or found.value <= 0.0:
        raise ValueError(f"wants an amount like '4 GiB', in {', '.join(MEMORY_UNITS)}, got {raw!r}")
    return found


class Limits(Strict):
    """What a case may take of time and memory; no part of what a case gives."""

    case: Quantity = Field(Measure(10.0, "min"), description="wall time of one case")
    step: Quantity = Field(
        Measure(30.0, "s"), description="wall time of one step of a part, and of each of its other calls"
    )
    memory: Annotated[
        Memory,
        BeforeValidator(read_memory),
        PlainSerializer(str),
        WithJsonSchema({"type": "string", "description": "memory of the process of a case, like '4 GiB'"}),
    ] = Memory(4.0, "GiB")

    def for_worker(self) -> WorkerLimits:
        """The same in seconds and bytes. Raises UnitError."""
        return WorkerLimits(self.case.si("s"), self.step.si("s"), self.memory.size)


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
    record: Record = Field(default_factory=lambda: Kept.model_validate({}), description=RECORD_MEANS)
    coupling: Coupling = Field(default_factory=lambda: Coupling.model_validate({}))
    validation: Validation = Field("warn", description=VALIDATION_MEANS)
    vary: dict[str, Any] = Field(default_factory=dict, description="path, or paths: list of values or 1..20")
    experiments: dict[str, Experiment] = Field(default_factory=dict)
    metrics: dict[str, Definition] = Field(default_factory=dict)
    accept: list[Demand] = Field(default_factory=list, description="what must hold of the metrics")
    report: ReportSection = ReportSection()
    limits: Limits = Field(default_factory=lambda: Limits.model_validate({}))
