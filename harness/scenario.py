"""What a scenario is made of: clock, parts, wires, seed. The schema of a campaign file's `parts` and `clock`."""

from __future__ import annotations

import difflib
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Discriminator, Field, Tag, model_validator

from fmus.description import Validation
from harness.quantity import Measure, Quantity, Strict
from harness.sourcepart import POINTS, POINTS_OF_A_FILE, SHAPES, FiledTable, ReplayPart, SourcePart, Table

VALIDATION_MEANS = "rules of the standard that FMUs break: refused (strict), tolerated and listed, or not looked for"


class TimeClock(Strict):
    """Fixed steps in time: t = start + k step, up to stop."""

    step: Quantity
    stop: Quantity
    start: Quantity = Measure(0.0, "s")


class CrankClock(Strict):
    """Fixed steps in crank angle: instant k is at origin + k step; its time follows from the engine's speed.

    One of `step` and `per_cycle` (steps in a cycle). Ends at the crank angle or at the time `stop`.
    """

    step: Quantity | None = Field(None, description="crank angle of a step, like 6 deg; it divides the cycle")
    per_cycle: int | None = Field(None, ge=1, description="steps in a cycle, instead of `step`")
    stop: Quantity = Field(description="the crank angle it ends at, like 100 rev, or the time, like 5 s")
    speed: str = Field(
        description="the signal that is the crankshaft's speed, as part.output: a step is step/speed long"
    )
    angle: str | None = Field(None, description="the signal that is the crankshaft's angle; the clock steers to it")
    steer: Literal["next", "exact"] = Field(
        "next", description="next: the angle missed in one step is made good in the next; exact: the step is repeated"
    )
    origin: Quantity = Field(Measure(0.0, "deg"), description="crank angle at the start")
    start: Quantity = Measure(0.0, "s")
    slowest: Quantity = Field(Measure(1.0, "rpm"), description="a speed below this ends the run as an error")
    cycle: Quantity = Field(Measure(720.0, "deg"), description="crank angle of an engine cycle")
    firing_order: list[int] = Field(default_factory=list, description="the cylinders as they fire, like [1, 3, 4, 2]")
    tdc: list[Quantity] = Field(
        default_factory=list,
        description="firing top dead centres in firing order; evenly spaced from 0 deg where absent",
    )

    @model_validator(mode="after")
    def _one_step(self) -> CrankClock:
        if (self.step is None) == (self.per_cycle is None):
            raise ValueError("a crank clock wants one of step, per_cycle")
        return self


class Clock(Strict):
    """The clock of a run: one of `time` and `crank`."""

    time: TimeClock | None = None
    crank: CrankClock | None = None

    @model_validator(mode="after")
    def _exactly_one(self) -> Clock:
        if (self.time is None) == (self.crank is None):
            raise ValueError("a clock wants one of time, crank")
        return self

    @property
    def start(self) -> Measure:
        """The time it starts at."""
        return (self.time or self.crank).start  # type: ignore[union-attr]


class Noise(Strict):
    """White Gaussian noise, drawn once a sample."""

    std: Quantity


FAULTS = ("bias", "gain", "drift", "stuck", "drop_out", "noise", "delay")
FROM_MEANS = "when it begins: a time, or on a crank clock a crank angle"
TO_MEANS = "when it has ended, in the same way; it stays where absent"


class Fault(Strict):
    """One fault, active for from <= t < to: exactly one of bias, gain, drift, stuck, drop_out, noise, delay."""

    bias: Quantity | None = Field(None, description="added to the reading")
    gain: float | None = Field(None, description="multiplies the reading")
    drift: Quantity | None = Field(
        None, description="added, per second since `from`: a unit of the signal, read per second"
    )
    stuck: Literal[True] | None = Field(None, description="holds the last reading before the fault")
    drop_out: float | None = Field(None, description="probability that a sample is lost and the last is held")
    noise: Quantity | None = Field(None, description="standard deviation added in quadrature")
    delay: Quantity | None = Field(None, description="the signal arrives late by this; until it does, the last is held")
    start: Quantity = Field(alias="from", description=FROM_MEANS)
    until: Quantity | None = Field(None, alias="to", description=TO_MEANS)
    code: int | None = Field(None, ge=1, description="what the fault signal shows; its place in the list where absent")

    @model_validator(mode="after")
    def _exactly_one(self) -> Fault:
        given = [name for name in FAULTS if getattr(self, name) is not None]
        if len(given) != 1:
            raise ValueError(f"a fault wants one of {', '.join(FAULTS)}, got {given or 'none'}")
        return self

    @property
    def kind(self) -> str:
        """Which of FAULTS it is."""
        return next(kind for kind in FAULTS if getattr(self, kind) is not None)


AT_MEANS = "crank events to be stepped at: tdc (each firing top dead centre), cycle, or angles within the cycle"
At = Literal["tdc", "cycle"] | list[Quantity] | None


class SensorPart(Strict):
    """Measures one signal. Its output is named `value`; with nothing but `of` it is the identity sensor.

    With faults it has a second output `fault`: the code of the fault that acts, 0 where none does.

    Applied in this order: lag, delay, gain, bias, faults, noise, drop-out, quantisation, limits.
    """

    use: Literal["sensor"]
    of: str = Field(description="the signal measured, as part.output")
    lag: Quantity | None = Field(None, description="time constant of a first-order lag")
    delay: Quantity | None = Field(None, description="dead time, linear between samples")
    gain: float = 1.0
    bias: Quantity | None = None
    noise: Noise | None = None
    drop_out: float = Field(0.0, ge=0.0, le=1.0, description="probability that a sample is lost and the last is held")
    quantise: Quantity | None = Field(None, description="resolution: readings are rounded to multiples of it")
    limits: tuple[Quantity, Quantity] | None = Field(None, description="readings are clipped to this range")
    faults: list[Fault] = Field(default_factory=list)
    every: Quantity | None = Field(None, description="from sample to sample; a multiple of the clock's step")
    at: At = Field(None, description=AT_MEANS)


class CrankPart(Strict):
    """Tells crank angle, cycle and the phase of each cylinder: of a crank clock, or of a measured angle `of`.

    On a crank clock `cycle`, `firing_order` and `tdc` stand at the clock.
    """

    use: Literal["crank"]
    of: str | None = Field(None, description="the signal that is the crankshaft's angle; on a crank clock its own")
    cycle: Quantity | None = Field(None, description="crank angle of an engine cycle; 720 deg where absent")
    firing_order: list[int] = Field(default_factory=list, description="the cylinders as they fire")
    tdc: list[Quantity] = Field(default_factory=list, description="firing top dead centres in firing order")


class WireSpec(Strict):
    """A wire with more to say than where it comes from."""

    source: str = Field(alias="from", description="part or part.output")
    delay: Literal[0, 1] = Field(0, description="1: always the value of the instant before")
    faults: list[Fault] = Field([], description="what is wrong on the way; a part named PART__INPUT stands there then")


def read_wire(raw: Any) -> Any:
    """`part.output` as the mapping {from: part.output}."""
    if not isinstance(raw, (str, dict, WireSpec)):
        raise ValueError(f"wants part.output, or {{from: part.output, delay: 1}}, got {raw!r}")
    return {"from": raw} if isinstance(raw, str) else raw


WiredFrom = Annotated[
    WireSpec,
    BeforeValidator(read_wire, json_schema_input_type=str | WireSpec),
]


class SwapPart(Strict):
    """Two signals that change places: what reads either of them reads the other for from <= t < to.

    Its outputs `first` and `second` are what the readers of the first and of the second signal are given, `fault` is
    `code` while they are swapped, 0 else.
    """

    use: Literal["swap"]
    between: tuple[str, str] = Field(description="the two signals, as part or part.output")
    start: Quantity = Field(alias="from", description=FROM_MEANS)
    until: Quantity | None = Field(None, alias="to", description=TO_MEANS)
    code: int = Field(1, ge=1, description="what the fault signal shows")


class ModelPart(Strict):
    """A plant, observer or controller: an FMU, or a module that holds a MODEL or a `make`."""

    use: str = Field(
        description="a module like observers.hybrid, or the path of an .fmu from the campaign file",
        json_schema_extra={"not": {"enum": ["source", "sensor", "crank", "swap", "replay"]}},
    )
    parameter_set: str | None = Field(None, alias="set", description="a named parameter set of the model")
    settings: dict[str, Any] = Field(
        default_factory=dict, alias="with", description="parameters and start values by name"
    )
    wires: dict[str, WiredFrom] = Field(
        default_factory=dict,
        description="input: part or part.output, or {from: part.output, delay: 1, faults: [...]}",
    )
    every: Quantity | None = Field(
        None,
        description="step of this part: a multiple of the clock's; on a crank clock an angle, or a time of its own",
    )
    at: At = Field(None, description=AT_MEANS)
    role: Literal["plant", "observer", "controller"] | None = Field(
        None, description="what an .fmu stands for; a plant where absent. An observer may not read a plant unmeasured"
    )
    kind: Literal["cs", "me"] | None = Field(
        None, description="how an .fmu that offers both is run: Co-Simulation or Model Exchange; cs where absent"
    )
    units: dict[str, str] = Field(
        default_factory=dict, description="variable: unit, for variables of an .fmu that declare none"
    )


# The tags of the kinds of part, in the words that error messages use.
SOURCE, SENSOR, CRANK, SWAP = "<a source>", "<a sensor>", "<a crank>", "<a swap>"
REPLAY, MODEL = "<a replay>", "<a model>"
PART_KINDS: dict[str, type[Strict]] = {
    SOURCE: SourcePart,
    SENSOR: SensorPart,
    CRANK: CrankPart,
    SWAP: SwapPart,
    REPLAY: ReplayPart,
    MODEL: ModelPart,
}
TAGGED: dict[str, type[Strict]] = {**PART_KINDS, POINTS: Table, POINTS_OF_A_FILE: FiledTable}


def part_kind(raw: Any) -> str:
    """Which of PART_KINDS a part is meant to be: by `use`, or by its other keys where `use` says nothing."""
    for tag, schema in PART_KINDS.items():
        if isinstance(raw, schema):
            return tag
    if not isinstance(raw, dict):
        return MODEL
    use = raw.get("use")
    words = {"source": SOURCE, "sensor": SENSOR, "crank": CRANK, "swap": SWAP, "replay": REPLAY}
    if isinstance(use, str):
        plain = "." not in use and ":" not in use
        nearest = difflib.get_close_matches(use, words, n=1, cutoff=0.7) if plain else []
        return words[nearest[0]] if nearest else MODEL
    if "of" in raw:
        return SENSOR
    if "between" in raw:
        return SWAP
    if "signals" in raw:
        return REPLAY
    return SOURCE if set(SHAPES) & raw.keys() else MODEL


Part = Annotated[
    Annotated[SourcePart, Tag(SOURCE)]
    | Annotated[SensorPart, Tag(SENSOR)]
    | Annotated[CrankPart, Tag(CRANK)]
    | Annotated[SwapPart, Tag(SWAP)]
    | Annotated[ReplayPart, Tag(REPLAY)]
    | Annotated[ModelPart, Tag(MODEL)],
    Discriminator(part_kind),
]


class Coupling(Strict):
    """How plants and controllers that feed each other are stepped, and algebraic loops solved.

    gauss-seidel: each sees what was stepped before it at the same instant. jacobi: each sees the others' values of the
    instant before. `solve` is for loops of direct feed-through, which are refused without it; their parts are to be
    ones that can be taken back. `tolerance` is relative to a signal's value or its nominal value, the larger.
    """

    method: Literal["gauss-seidel", "jacobi"] = "gauss-seidel"
    solve: Literal["fixed-point", "newton"] | None = None
    tolerance: float = Field(1e-9, gt=0.0)
    relaxation: float = Field(1.0, gt=0.0, le=2.0, description="share of the step that a fixed-point iteration takes")
    iterations: int = Field(50, ge=1, description="most iterations at an instant; more is an error")
    error: float | None = Field(
        None, gt=0.0, description="plants that feed each other take smaller steps, halved until their error is below"
    )


class Kept(Strict):
    """What of a run is recorded."""

    signals: list[str] | None = Field(None, description="as part or part.output; all where absent")
    every: int = Field(1, ge=1, description="one instant in so many")


def read_kept(raw: Any) -> Any:
    """A list of signals as the mapping {signals: ...}."""
    return {"signals": raw} if isinstance(raw, list) else raw


Record = Annotated[Kept, BeforeValidator(read_kept, json_schema_input_type=list[str] | Kept)]
RECORD_MEANS = "signals to record, as part or part.output, or {signals, every}; all of every instant where absent"


class Scenario(Strict):
    """One run: everything that determines its bytes besides the parts' own content."""

    clock: Clock
    parts: dict[str, Part]
    seed: int = Field(0, ge=0)
    record: Record = Field(default_factory=lambda: Kept.model_validate({}), description=RECORD_MEANS)
    coupling: Coupling = Field(default_factory=lambda: Coupling.model_validate({}))
    validation: Validation = Field("warn", description=VALIDATION_MEANS)
