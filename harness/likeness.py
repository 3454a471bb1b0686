"""Proposes which variable of an FMU each signal of a model is, by name, unit and causality."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from difflib import SequenceMatcher
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment

from fmus.component import ConfigurationError, Signal
from fmus.description import FmuDescription
from fmus.model import Model
from fmus.units import Unit, parse_unit
from fmus.variable import Variable
from harness.building import find_model
from harness.fmutext import table

# A pair whose names are less alike than this is none.
ALIKE = 0.7
# One good match is better than two middling ones: what is made largest is the sum of the scores to this power.
_DISTINCTION = 4
# What a pair is worth of what its names are where a unit is not declared, and where the FMU keeps the variable inside.
_UNIT_UNKNOWN, _INSIDE = 0.9, 0.95
# The causalities that a signal may have in an FMU, the usual one first.
_CAUSALITIES = {"input": ("input",), "state": ("output", "local"), "output": ("output", "local")}


@dataclass(frozen=True)
class Match:
    """A signal of the model, its role and unit, and the FMU's variable for it; `score` is 1 where all agrees."""

    signal: str
    role: str
    unit: str
    variable: str
    causality: str
    variable_unit: str
    score: float


@dataclass(frozen=True)
class Unmatched:
    """A signal of the model with no variable, the one of the nearest name, and why it is not that."""

    signal: str
    role: str
    unit: str
    nearest: str
    why: str


@dataclass(frozen=True)
class Likeness:
    """The proposal: matches in the model's order, signals without one, and inputs and outputs of the FMU left over."""

    model: str
    matched: tuple[Match, ...]
    unmatched: tuple[Unmatched, ...]
    left_over: tuple[str, ...]

    def to_json(self) -> dict[str, Any]:
        """As `crankbench inspect --like --json` has it under `like`."""
        return asdict(self)


def find_likeness(description: FmuDescription, name: str) -> Likeness:
    """The proposal for the model called `name`. Raises ConfigurationError: there is no such Model."""
    model, _ = find_model(name)
    if not isinstance(model, Model):
        raise ConfigurationError(f"--like wants a Model, like turbo_si_egr, got the function {name}")
    return likeness(model, description.variables)


def likeness(model: Model, variables: Sequence[Variable]) -> Likeness:
    """Each scalar input, state and output of the model with at most one variable, the best of all such pairings.

    A pair scores what its names have in common, from 0 to 1, less where a unit is unknown or the variable is local; it
    is none where the dimensions differ, an input stands against an output, or the names score below `ALIKE`.
    """
    signals = [
        (signal, role)
        for role, group in (("input", model.inputs), ("state", model.states), ("output", model.outputs))
        for signal in group
        if not signal.shape
    ]
    offered = [v for v in variables if v.causality in ("input", "output", "local") and v.on_bus and not v.shape]
    offered = [v for v in offered if not v.name.startswith("der(")]
    scores = np.array([[_score(signal, role, v) for v in offered] for signal, role in signals])
    scores = scores.reshape(len(signals), len(offered))
    pairs = zip(*linear_sum_assignment(scores**_DISTINCTION, maximize=True), strict=True)
    chosen = {int(i): int(j) for i, j in pairs if scores[i, j] > 0.0}
    matched = tuple(_match(*signals[i], offered[j], float(scores[i, j])) for i, j in sorted(chosen.items()))
    taken = {match.variable: match.signal for match in matched}
    unmatched = tuple(
        _unmatched(signal, role, offered, taken) for i, (signal, role) in enumerate(signals) if i not in chosen
    )
    left = tuple(v.name for v in offered if v.causality != "local" and v.name not in taken)
    return Likeness(model.name, matched, unmatched, left)


def likeness_lines(found: Likeness) -> list[str]:
    """The proposal as text."""
    head = (f"{found.model}", "is", "unit", "variable", "causality", "unit", "score")
    rows = [
        [m.signal, m.role, m.unit, m.variable, m.causality, m.variable_unit, f"{m.score:.2f}"] for m in found.matched
    ]
    lines = [*table(head, rows)]
    lines += [f"no match for the {u.role} {u.signal} [{u.unit}]: {u.why}" for u in found.unmatched]
    return [*lines, f"left over of the FMU: {', '.join(found.left_over) or 'none'}"]


def name_score(one: str, other: str) -> float:
    """How much two names have in common, 0 to 1: equal words score 1, else the letters in common, of words or at all.

    Of a name with dots, what follows the last counts as a name, too, for a little less.
    """
    whole = _plain_score(one, other)
    short = [name.rpartition(".")[2] for name in (one, other)]
    return whole if [one, other] == short else max(whole, 0.98 * _plain_score(*short))


def _plain_score(one: str, other: str) -> float:
    first, second = _words(one), _words(other)
    if first == second:
        return 1.0
    joined = "".join(first), "".join(second)
    common = sum(map(len, set(first) & set(second)))
    by_words = 2.0 * common / sum(map(len, joined))
    by_letters = SequenceMatcher(None, joined[0], joined[1], autojunk=False).ratio()
    # Order and doubled words are lost on the first, borders of words on the second: neither is quite equality.
    return 0.99 * max(by_words, by_letters)


def _words(name: str) -> list[str]:
    """A name's words in small letters: `pIntake_Manifold1` is p, intake, manifold, 1."""
    return [word.lower() for word in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+", name)]


def _score(signal: Signal, role: str, variable: Variable) -> float:
    usual = _CAUSALITIES[role]
    if variable.causality not in usual:
        return 0.0
    unit = _unit(signal)
    if variable.quantity is not None and unit is not None and not variable.quantity.same_dimension(unit):
        return 0.0
    score = name_score(signal.name, variable.name)
    if score < ALIKE:
        return 0.0
    known = 1.0 if variable.quantity is not None and unit is not None else _UNIT_UNKNOWN
    return score * known * (1.0 if variable.causality == usual[0] else _INSIDE)


def _unit(signal: Signal) -> Unit | None:
    return parse_unit(signal.unit) if signal.unit else None


def _match(signal: Signal, role: str, variable: Variable, score: float) -> Match:
    return Match(signal.name, role, signal.unit, variable.name, variable.causality, variable.unit, score)


def _unmatched(signal: Signal, role: str, offered: Sequence[Variable], taken: dict[str, str]) -> Unmatched:
    by_name = [(name_score(signal.name, v.name), v) for v in offered]
    score, nearest = max(by_name, key=lambda pair: pair[0], default=(0.0, None))
    if nearest is None or score < ALIKE:
        return Unmatched(signal.name, role, signal.unit, "", "no variable has a name like it")
    unit = _unit(signal)
    if nearest.causality not in _CAUSALITIES[role]:
        why = f"{nearest.name} is its {nearest.causality}"
    elif nearest.quantity is not None and unit is not None and not nearest.quantity.same_dimension(unit):
        why = f"{nearest.name} is in {nearest.unit or '1'}"
    else:
        why = f"{nearest.name} is taken by {taken[nearest.name]}" if nearest.name in taken else f"near {nearest.name}"
    return Unmatched(signal.name, role, signal.unit, nearest.name, why)
