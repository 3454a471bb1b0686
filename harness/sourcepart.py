"""What is known of a source and a replay: the schema of these parts of a campaign file."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import ConfigDict, Discriminator, Field, Tag, model_validator

from harness.quantity import Measure, Quantity, Strict


def _or_text(schema: dict[str, Any]) -> None:
    """Lets the JSON Schema of a mapping allow a text in its place."""
    long = dict(schema)
    schema.clear()
    schema["anyOf"] = [{"type": "string"}, long]


class Step(Strict):
    """Jumps from one value to another at a time: y(t) = to for t >= at."""

    at: Quantity
    start: Quantity = Field(alias="from")
    to: Quantity


class Ramp(Strict):
    """Linear between two times, constant outside."""

    at: Quantity
    until: Quantity
    start: Quantity = Field(alias="from")
    to: Quantity


class Sine(Strict):
    """mean + amplitude sin(2 pi frequency (t - t0) + phase)."""

    amplitude: Quantity
    frequency: Quantity
    mean: Quantity
    phase: Quantity = Measure(0.0, "rad")


class Chirp(Strict):
    """mean + amplitude sin(angle), whose frequency is swept from one to another for a while; constant outside.

    With x the time since `begin`, T the duration and f the frequencies, the angle is phase + 2 pi times

        f_from x + (f_to - f_from) x^2 / (2 T)                        for a linear sweep
        f_from T ((f_to/f_from)^(x/T) - 1) / ln(f_to/f_from)          for a logarithmic one
    """

    amplitude: Quantity
    start: Quantity = Field(alias="from", description="frequency at the begin")
    to: Quantity = Field(description="frequency at the end")
    duration: Quantity
    mean: Quantity
    begin: Quantity = Measure(0.0, "s")
    phase: Quantity = Measure(0.0, "rad")
    sweep: Literal["linear", "logarithmic"] = "linear"


BETWEEN_MEANS = "what is between two points: the first one, or a line"
ENDS_MEAN = "what is outside of the points: nothing, the nearest point, or all of them anew"
TIME_MEANS = "the column of the times; `time` where absent, of an MDF4 file the channel's own times"


class Table(Strict):
    """Points (time, value), held between points or joined by lines."""

    time: list[Quantity]
    value: list[Quantity]
    between: Literal["hold", "linear"] = Field("hold", description=BETWEEN_MEANS)
    ends: Literal["hold", "repeat", "error"] = Field("hold", description=ENDS_MEAN)


class FiledTable(Strict):
    """Points from two columns of a file, held between points or joined by lines."""

    file: str = Field(description="path of a .csv, .parquet or .mf4 from the campaign file")
    value: str = Field(description="the column of the values")
    time: str | None = Field(None, description=TIME_MEANS)
    time_unit: str | None = Field(None, description="unit of the times, where the file does not say")
    unit: str | None = Field(None, description="unit of the column, where the file does not say")
    between: Literal["hold", "linear"] = Field("hold", description=BETWEEN_MEANS)
    ends: Literal["error", "hold", "repeat"] = Field("error", description=ENDS_MEAN)


class Cycle(Strict):
    """The speed of a vehicle in a standard drive cycle, from one second to the next in lines; at rest outside."""

    name: Literal["WLTC", "UDDS", "HWFET", "US06"] = Field(description="WLTC is that of class 3b")
    begin: Quantity = Measure(0.0, "s")
    ends: Literal["hold", "repeat", "error"] = Field("hold", description=ENDS_MEAN)


# The tags of the two kinds of table.
POINTS, POINTS_OF_A_FILE = "<points>", "<points of a file>"


def table_kind(raw: Any) -> str:
    """Which kind of table is meant."""
    if isinstance(raw, dict):
        return POINTS_OF_A_FILE if "file" in raw or isinstance(raw.get("time"), str) else POINTS
    return POINTS_OF_A_FILE if isinstance(raw, FiledTable) else POINTS


SHAPES = ("constant", "step", "ramp", "sine", "chirp", "table", "cycle")


class SourcePart(Strict):
    """A known input: exactly one of constant, step, ramp, sine, chirp, table, cycle. Its output is named `value`."""

    use: Literal["source"]
    unit: str = Field(description="unit of the signal, like N.m")
    constant: Quantity | None = None
    step: Step | None = None
    ramp: Ramp | None = None
    sine: Sine | None = None
    chirp: Chirp | None = None
    table: (
        Annotated[
            Annotated[Table, Tag(POINTS)] | Annotated[FiledTable, Tag(POINTS_OF_A_FILE)], Discriminator(table_kind)
        ]
        | None
    ) = None
    cycle: Cycle | None = None

    @model_validator(mode="after")
    def _exactly_one(self) -> SourcePart:
        given = [name for name in SHAPES if getattr(self, name) is not None]
        if len(given) != 1:
            raise ValueError(f"a source wants one of {', '.join(SHAPES)}, got {given or 'none'}")
        return self


class ReplayedSignal(Strict):
    """A column of the file; its name alone says the same with nothing else to say."""

    model_config = ConfigDict(json_schema_extra=_or_text)

    column: str
    unit: str | None = Field(None, description="unit of the column, where the file does not say")
    between: Literal["hold", "linear"] | None = Field(None, description="that of the part where absent")
    kind: Literal["real", "integer", "boolean"] | None = Field(None, description="that of the file where absent")

    @model_validator(mode="before")
    @classmethod
    def _short_form(cls, raw: Any) -> Any:
        return {"column": raw} if isinstance(raw, str) else raw


class ReplayPart(Strict):
    """A recorded measurement in the place of a plant: at each instant its outputs are what was recorded then.

    `crank` in the place of `time` is for a crank clock: what was recorded at the clock's crank angle.
    """

    use: Literal["replay"]
    file: str = Field(description="path of a .csv, .parquet or .mf4 from the campaign file")
    signals: dict[str, ReplayedSignal] = Field(description="output: column")
    time: str | None = Field(None, description=TIME_MEANS)
    time_unit: str | None = Field(None, description="unit of the times, where the file does not say")
    crank: str | None = Field(None, description="the column of the crank angles")
    crank_unit: str | None = Field(None, description="unit of the crank angles, where the file does not say")
    between: Literal["hold", "linear"] = Field("hold", description=f"{BETWEEN_MEANS}; discrete signals are held")
    ends: Literal["error", "hold", "repeat"] = Field("error", description=ENDS_MEAN)

    @model_validator(mode="after")
    def _one_axis(self) -> ReplayPart:
        if not self.signals:
            raise ValueError("wants at least one of `signals`")
        if self.crank is not None and self.time is not None:
            raise ValueError("wants one of time, crank, got both")
        return self
