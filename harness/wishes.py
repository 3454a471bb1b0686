"""What a user asks of a selection of sensors, and what that means for a system: places and numbers in SI."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import NamedTuple

import numpy as np

from fmus.component import ConfigurationError, Problem, Signal, Vector
from fmus.model import unknown
from fmus.sensing import TEMPERATURE_LAG
from fmus.statespace import scales
from fmus.units import UnitError, parse_unit
from harness.operating import Operating
from harness.quantity import read_measure
from selection.methods import BY_ERROR, Method, Scaling
from selection.ranking import KEYS, MOST_SETS, Limits, count_sets

MEASURES = ("gramian", "kalman")
# Without a data sheet: a sensor's noise, of the nominal value of what it measures.
NOISE = 0.01


@dataclass(frozen=True)
class Wishes:
    """What a user asks of a selection, as it is written on the command line.

    Names are those of sensors, which go by what they measure, or patterns like `T_*`, but for `estimate`: states.
    `process` is one share of the states' sizes, or by state a deviation over the root of a second, which is what
    `crankbench noise` writes.
    """

    estimate: Sequence[str] = ()
    most: int = 3
    method: Method = "structural"
    sensors: Sequence[str] = ()
    must: Sequence[str] = ()
    forbid: Sequence[str] = ()
    cost: Sequence[str] = ()
    lag: Sequence[str] = ()
    noise: Sequence[str] = ()
    measures: Sequence[str] | None = None
    by: Sequence[str] = ("index", "error", "cost")
    period: str = "10 ms"
    process: float | Mapping[str, str] = 0.01
    tolerance: float | None = None
    seed: int = 0
    threads: int = 1
    budget: float = math.inf
    disturbances: Sequence[str] = ()
    scaling: Scaling = "deviation"


class Choice(NamedTuple):
    """The wishes as they were understood: places of wanted states and sensors, and what each sensor is.

    `process` (n,) is what disturbs each state, of its size in a second.
    """

    wanted: tuple[int, ...]
    signals: tuple[Signal, ...]
    lags: tuple[float, ...]
    noise: Vector
    costs: tuple[float, ...]
    limits: Limits
    period: float
    process: Vector


def understand(operating: Operating, wishes: Wishes) -> Choice:
    """The wishes as places and numbers. Raises ConfigurationError with every problem found."""
    problems: list[Problem] = []
    space = operating.space
    signals = _sensors(operating, wishes.sensors, problems)
    names = [signal.name for signal in signals]
    states = [signal.name for signal in space.states]
    wanted = _places(wishes.estimate, states, "--estimate", "state", problems) or tuple(range(len(states)))
    must = _places(wishes.must, names, "--must", "sensor", problems)
    forbid = _places(wishes.forbid, names, "--forbid", "sensor", problems)
    for both in sorted(set(must) & set(forbid)):
        problems.append(Problem(f"--must and --forbid both name {names[both]}"))
    if wishes.most < 1:
        problems.append(Problem(f"--max-sensors wants 1 or more, got {wishes.most}"))
    elif len(must) > wishes.most:
        problems.append(Problem(f"--max-sensors wants {len(must)} or more to hold all of --must, got {wishes.most}"))
    elif not problems:
        limits = Limits(wishes.most, frozenset(must), frozenset(forbid))
        count = count_sets(len(names), limits)
        most = math.inf if wishes.method in BY_ERROR else MOST_SETS
        if not 0 < count <= most:
            hint = "lower --max-sensors, or narrow by --must and --forbid" if count else "there is no sensor left"
            problems.append(Problem(f"that makes {count} sets, wants 1 to {MOST_SETS}: {hint}"))
    kelvin = parse_unit("K")
    lags = [TEMPERATURE_LAG if parse_unit(s.unit).same_dimension(kelvin) and s.unit else 0.0 for s in signals]
    noise = [NOISE * abs(s.nominal) * parse_unit(s.unit).factor for s in signals]
    for place, value in _numbers(wishes.lag, names, ["s"] * len(names), "--lag", problems):
        lags[place] = value
    for place, value in _numbers(wishes.noise, names, [s.unit for s in signals], "--noise", problems):
        noise[place] = value
    costs = [1.0] * len(names)
    for place, value in _numbers(wishes.cost, names, [""] * len(names), "--cost", problems):
        costs[place] = value
    for name, tau, deviation in zip(names, lags, noise, strict=True):
        if tau < 0.0:
            problems.append(Problem(f"--lag {name}: wants 0 s or more, got {tau:g} s"))
        if deviation <= 0.0:
            problems.append(Problem(f"--noise {name}: wants more than 0, got {deviation:g}"))
    period = _quantity(wishes.period, "s", "--period", problems)
    process = _process(wishes.process, space.states, problems)
    disturbances = wishes.disturbances, states, [s.unit for s in space.states], "--disturbance", problems, "state"
    for place, value in _numbers(*disturbances):
        if not 0.0 <= value < math.inf:
            problems.append(Problem(f"--disturbance {states[place]}: wants 0 or more, got {value:g}"))
        process[place] = value / scales(space.states)[place]
    _check_words(wishes, problems)
    if problems:
        raise ConfigurationError(problems)
    limits = Limits(wishes.most, frozenset(must), frozenset(forbid))
    return Choice(wanted, tuple(signals), tuple(lags), np.array(noise), tuple(costs), limits, period, process)


def _process(asked: float | Mapping[str, str], states: Sequence[Signal], problems: list[Problem]) -> Vector:
    """The process noise of each state, (n,), in units of the states' sizes."""
    if isinstance(asked, (int, float)):
        if not asked >= 0.0:
            problems.append(Problem(f"--process wants 0 or more, got {asked:g}"))
        return np.full(len(states), float(asked))
    names = [s.name for s in states]
    found = np.zeros(len(names))
    missing = [name for name in names if name not in asked]
    if missing:
        problems.append(Problem(f"--process has no noise of {', '.join(missing)}; add it to the file's process"))
    for name, text in asked.items():
        if name not in names:
            problems.append(Problem(f"--process {name}: {unknown(name, names, 'state')}"))
            continue
        place = names.index(name)
        value = _quantity(str(text), states[place].unit, f"--process {name}", problems)
        if value < 0.0:
            problems.append(Problem(f"--process {name} wants 0 or more, got {text}"))
        found[place] = value
    return found / scales(states)


def _check_words(wishes: Wishes, problems: list[Problem]) -> None:
    for word in wishes.by:
        if word not in KEYS:
            problems.append(Problem(f"--by {word}: {unknown(word, KEYS, 'measure')}"))
    for word in wishes.measures or ():
        if word not in MEASURES:
            problems.append(Problem(f"--measures {word}: {unknown(word, MEASURES, 'measure')}"))
    if not wishes.budget >= 0.0:
        problems.append(Problem(f"--budget wants 0 or more, got {wishes.budget:g}"))
    if wishes.tolerance is not None and not 0.0 < wishes.tolerance < 1.0:
        problems.append(Problem(f"--tolerance wants a number between 0 and 1, got {wishes.tolerance:g}"))


def _sensors(operating: Operating, asked: Sequence[str], problems: list[Problem]) -> list[Signal]:
    """The signals that may be measured: those asked for, else those the model declares, else all states and outputs."""
    space = operating.space
    known = {signal.name: signal for signal in (*space.states, *space.outputs)}
    if not asked:
        return [known[name] for name in operating.sensors or known]
    return [
        known[list(known)[place]] for place in _places(asked, list(known), "--sensors", "state or output", problems)
    ]


def _places(
    asked: Iterable[str], names: Sequence[str], option: str, kind: str, problems: list[Problem]
) -> tuple[int, ...]:
    """The places of the names that are asked for or fit a pattern, each once; a problem for each that is none."""
    found: dict[int, None] = {}
    for text in asked:
        fitting = _fitting(text, names)
        if not fitting:
            problems.append(Problem(f"{option} {text}: {unknown(text, names, kind)}"))
        found.update(dict.fromkeys(fitting))
    return tuple(found)


def _fitting(text: str, names: Sequence[str]) -> list[int]:
    """The place of the name itself, else those of the names that fit it as a pattern."""
    if text in names:
        return [names.index(text)]
    return [i for i, name in enumerate(names) if fnmatchcase(name, text)] if any(c in text for c in "*?") else []


def _numbers(
    asked: Iterable[str],
    names: Sequence[str],
    units: Sequence[str],
    option: str,
    problems: list[Problem],
    kind: str = "sensor",
) -> list[tuple[int, float]]:
    """Places and values in SI of settings like `T_*=3 s`, as differences: 1 degC is 1 K."""
    found = []
    for text in asked:
        name, equals, value = (part.strip() for part in text.partition("="))
        if not equals or not name or not value:
            problems.append(Problem(f"{option} {text}: wants {kind}=value"))
            continue
        places = _fitting(name, names)
        if not places:
            problems.append(Problem(f"{option} {text}: {unknown(name, names, kind)}"))
        found += [(place, _quantity(value, units[place], f"{option} {text}", problems)) for place in places]
    return found


def _quantity(text: str, unit: str, option: str, problems: list[Problem]) -> float:
    try:
        measure = read_measure(text)
        measure.si(unit)
        return parse_unit(measure.unit).factor * measure.value
    except (ValueError, UnitError) as error:
        problems.append(Problem(f"{option}: {error}"))
        return math.nan
