"""How fast and how cleanly a diagnosis follows the truth: the measures, and what a campaign gives them."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, Field, WithJsonSchema, model_validator

from fmus.component import Signal
from harness.arguments import NO_CRANK_ANGLE, PAIR_SCHEMA, Arguments, CrankRows, Pair, Result, expanded, short_form_too
from harness.percentile import percentile
from harness.quantity import Quantity
from harness.window import Window, degrees

Vector = NDArray[np.float64]
# What rows count as whose value is none of the classes named.
OTHER = "other"


class Matrix(NamedTuple):
    """`counts[i][j]`: how many rows had the true class `classes[i]` and the estimated class `classes[j]`."""

    classes: list[str]
    counts: list[list[int]]


def accuracy(truth: Vector, estimate: Vector) -> float:
    """Share of the rows where two discrete signals are equal, from 0 to 1; both (n,)."""
    return float(np.mean(truth == estimate)) if len(truth) else np.nan


def detection(
    time: Vector, truth: Vector, estimate: Vector, cycles: Vector | None = None
) -> Mapping[str, float | Vector]:
    """How fast and how cleanly a discrete estimate follows a discrete truth; all (n,).

    A change of the truth at row k to v is detected at the first row j >= k with estimate_j = v, before the truth
    changes again or the window ends: delay t_j - t_k [s]; otherwise it is missed and its delay is infinite. It is
    pending from k to j (to the end of that stretch where missed). A false alarm is a change of the estimate to a value
    other than the truth while no detection is pending. `delay_median` and `delay_p95` count missed changes; p95 is the
    smallest delay that at least 95 % of the changes do not exceed. `delay` holds all delays, `false_alarms_per_min` is
    over the length of the window, `accuracy` the share of equal rows. `cycles` (n,) counts the turns of the crankshaft
    in engine cycles, in which the delays are `delay_cycles`, with their median and p95.
    """
    changes = np.flatnonzero(np.diff(truth)) + 1
    ends = np.append(changes, len(truth))[1:]
    pending = np.zeros(len(truth), dtype=bool)
    found: list[int | None] = []
    for start, end in zip(changes, ends, strict=True):
        matches = np.flatnonzero(estimate[start:end] == truth[start])
        seen = int(start + matches[0]) if len(matches) else None
        found.append(seen)
        pending[start : end if seen is None else seen + 1] = True
    moves = np.flatnonzero(np.diff(estimate)) + 1
    alarms = np.count_nonzero((estimate[moves] != truth[moves]) & ~pending[moves])
    minutes = (time[-1] - time[0]) / 60.0 if len(time) > 1 else 0.0
    return {
        **_delays(changes, found, time, cycles),
        "changes": float(len(changes)),
        "false_alarms": float(alarms),
        "false_alarms_per_min": alarms / minutes if minutes > 0 else np.nan,
        "accuracy": accuracy(truth, estimate),
    }


def alarm(time: Vector, fault: Vector, raised: Vector, cycles: Vector | None) -> Mapping[str, float | Vector]:
    """How fast an alarm rises with a fault, and how often without one; all (n,), on where not 0.

    A fault is a stretch of rows with it on. Its delay is from its first row to the first of its rows with the alarm on
    [s]; with none it is missed and its delay is infinite. A fault or an alarm that is on at the first row starts there.
    A false alarm is an alarm that starts while no fault is on; `false_alarms_per_hour` and `false_alarms_per_cycle` are
    over the time and the engine cycles without a fault. `true_positive_rate` is the share of the rows with the fault
    on that have the alarm on, `false_positive_rate` that of the rows with the fault off. `delay_median` and `delay_p95`
    count missed faults; p95 is the smallest delay that at least 95 % of the faults do not exceed. `cycles` (n,) counts
    the turns of the crankshaft in engine cycles, in which the delays are `delay_cycles`, with their median and p95.
    """
    faulty, alarmed = fault != 0, raised != 0
    stretches = _stretches(faulty)
    found = [
        start + int(np.argmax(alarmed[start:end])) if alarmed[start:end].any() else None for start, end in stretches
    ]
    false = float(sum(not faulty[start] for start, _ in _stretches(alarmed)))
    faulty_rows, hits = np.count_nonzero(faulty), np.count_nonzero(alarmed & faulty)
    sound_rows = len(time) - faulty_rows
    hours = _outside(stretches, time) / 3600.0
    sound_cycles = _outside(stretches, cycles) if cycles is not None else 0.0
    return {
        **_delays([start for start, _ in stretches], found, time, cycles),
        "faults": float(len(stretches)),
        "false_alarms": false,
        "false_alarms_per_hour": false / hours if hours > 0 else np.nan,
        "false_alarms_per_cycle": false / sound_cycles if sound_cycles > 0 else np.nan,
        "true_positive_rate": hits / faulty_rows if faulty_rows else np.nan,
        "false_positive_rate": (np.count_nonzero(alarmed) - hits) / sound_rows if sound_rows else np.nan,
    }


def confusion(truth: Vector, estimate: Vector, classes: Mapping[str, float]) -> Mapping[str, float | Matrix]:
    """How often each class is taken for each other: rows counted by true and estimated class; truth and estimate (n,).

    With N_ij rows of the true class i estimated as j: `accuracy` sum_i N_ii/sum_ij N_ij, `recall_k` N_kk/sum_j N_kj
    (NaN where k is never true), `precision_k` N_kk/sum_i N_ik (NaN where k is never estimated). Rows with a value that
    is no class count as `other`, which is never right. Without classes they are the values found. The matrix N is kept
    with the case, and the report adds it up over the cases.
    """
    named = dict(classes) or {f"{value:g}": float(value) for value in np.union1d(truth, estimate)}
    size = len(named) + 1
    counted = np.bincount(_codes(truth, named) * size + _codes(estimate, named), minlength=size * size)
    counts = counted.reshape(size, size)
    right, true, seen = np.diag(counts)[:-1], counts.sum(axis=1), counts.sum(axis=0)
    found: dict[str, float | Matrix] = {"accuracy": right.sum() / len(truth) if len(truth) else np.nan}
    for index, name in enumerate(named):
        found[f"recall_{name}"] = right[index] / true[index] if true[index] else np.nan
        found[f"precision_{name}"] = right[index] / seen[index] if seen[index] else np.nan
    kept = size if true[-1] or seen[-1] else size - 1
    found["matrix"] = Matrix([*named, OTHER][:kept], counts[:kept, :kept].tolist())
    return found


def _delays(
    starts: Sequence[int] | NDArray[np.intp], found: Sequence[int | None], time: Vector, cycles: Vector | None
) -> dict[str, float | Vector]:
    """From the rows where something starts to those where it is found, None where never: in s, and in cycles."""
    told: dict[str, float | Vector] = {"missed": float(found.count(None))}
    for name, along in {"delay": time, "delay_cycles": cycles}.items():
        if along is not None:
            delays = np.array(
                [np.inf if row is None else along[row] - along[start] for start, row in zip(starts, found, strict=True)]
            )
            told[name] = delays
            told[f"{name}_median"] = float(np.median(delays)) if len(delays) else np.nan
            told[f"{name}_p95"] = percentile(delays, 95.0)
    return told


def _stretches(on: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """The first row of each stretch that is on, and the row after its last."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], on, [False]])))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


def _outside(stretches: list[tuple[int, int]], along: Vector) -> float:
    """How far `along` goes over the rows outside the stretches; a row stands for what lies between the last and it."""
    whole = float(along[-1] - along[0]) if len(along) else 0.0
    return whole - sum(float(along[end - 1] - along[max(start - 1, 0)]) for start, end in stretches)


def _codes(values: Vector, named: Mapping[str, float]) -> NDArray[np.intp]:
    """The number of each row's class; that of no class comes last."""
    codes = np.full(len(values), len(named), dtype=np.intp)
    for index, value in enumerate(named.values()):
        codes[values == value] = index
    return codes


class Discrete(Arguments):
    """[truth, estimate] of discrete signals."""

    model_config = short_form_too(PAIR_SCHEMA)

    pair: Pair = Field(description="[truth, estimate]")

    @model_validator(mode="before")
    @classmethod
    def _short_form(cls, raw: Any) -> Any:
        return {"pair": raw} if isinstance(raw, list) else raw

    def names(self) -> list[str]:
        """Truth and estimate."""
        return list(self.pair)

    def compared(self) -> list[Pair]:
        """The pair."""
        return [self.pair]

    def arrays(self, window: Window) -> tuple[Any, ...]:
        """(truth, estimate)."""
        return window.column(self.pair[0]), window.column(self.pair[1])


class DiscreteInTime(Discrete):
    """[truth, estimate] of discrete signals, and what an engine cycle is where delays are to be told in cycles, too."""

    cycle: Quantity | None = Field(None, description="crank angle of an engine cycle, like 720 deg")

    @model_validator(mode="after")
    def _a_cycle(self) -> DiscreteInTime:
        if self.cycle is not None and degrees(self.cycle) <= 0:
            raise ValueError(f"cycle wants a crank angle above 0 deg, got {self.cycle}")
        return self

    def results(self, offered: Mapping[str, Result]) -> Mapping[str, Result]:
        """What is told in cycles only where a cycle is given."""
        return {name: one for name, one in offered.items() if self.cycle or "cycle" not in name}

    def arrays(self, window: Window) -> tuple[Any, ...]:
        """(time, truth, estimate, turns in cycles or None)."""
        cycles = window.crank / degrees(self.cycle) if self.cycle else None
        return window.time, *super().arrays(window), cycles

    def crank_misfits(self, rows: CrankRows) -> list[str]:
        """A cycle where the rows have no crank angle."""
        return [f"cycle {NO_CRANK_ANGLE}"] if self.cycle and rows.unknown else []


class Alarm(DiscreteInTime):
    """[fault, alarm], both on where not 0, and what an engine cycle is where they are to be told in cycles, too."""

    pair: Pair = Field(description="[fault, alarm]")


def read_classes(raw: Any) -> Any:
    """Names and values as they are; of a list of whole numbers each its own name."""
    if not isinstance(raw, list):
        return raw
    if any(isinstance(value, bool) or not isinstance(value, int) or value < 0 for value in raw):
        raise ValueError(f"wants whole numbers from 0 on, or names for them like {{closed: -1}}, got {raw!r}")
    return {str(value): value for value in raw}


Classes = Annotated[
    dict[str, int],
    BeforeValidator(read_classes),
    WithJsonSchema(
        {
            "anyOf": [
                {"type": "array", "items": {"type": "integer", "minimum": 0}},
                {"type": "object", "additionalProperties": {"type": "integer"}},
            ]
        }
    ),
]


class Confused(Discrete):
    """[truth, estimate] of discrete signals, and the classes that their values stand for."""

    classes: Classes = Field(
        default_factory=dict, description="name: value, or a list of values; those found where absent"
    )

    @model_validator(mode="after")
    def _nameable(self) -> Confused:
        for name in self.classes:
            if not re.fullmatch(r"\w+", name) or name == OTHER:
                raise ValueError(f"classes: a name wants letters, digits and _, and not '{OTHER}', got '{name}'")
        if len(set(self.classes.values())) < len(self.classes):
            raise ValueError(f"classes want a value each, got {list(self.classes.values())}")
        return self

    def results(self, offered: Mapping[str, Result]) -> Mapping[str, Result]:
        """One recall and one precision a named class."""
        return expanded(offered, "class", self.classes)

    def arrays(self, window: Window) -> tuple[Any, ...]:
        """(truth, estimate, classes)."""
        return *super().arrays(window), {name: float(value) for name, value in self.classes.items()}

    def misfits(self, signals: Mapping[str, Signal]) -> list[str]:
        """Also real signals whose classes are not named."""
        messages = super().misfits(signals)
        real = [name for name in self.pair if not messages and signals[name].kind == "real"]
        if real and not self.classes:
            example = "`classes: {sound: 0, faulty: 1}`"
            messages.append(f"{real[0]} is real: a confusion of it wants its classes, like {example}")
        return messages
