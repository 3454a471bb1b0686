"""One observer a location and a rule that picks: the frame all observers of hybrid plants share."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fmus.component import Signal
from fmus.hybrid import Automaton
from fmus.model import Model, ModelError, Values, unknown
from fmus.units import UnitError, parse_quantity, parse_unit
from observers.affine import Sampled, advance, sample_observer

Array = NDArray[np.float64]


class Instant(NamedTuple):
    """What a rule sees at a sample: estimate x(k|k) (n,), u over (k-1, k] (m,), y(k-1) and y(k) (p,)."""

    estimate: Any
    u: Any
    before: Any
    now: Any


class Rule(NamedTuple):
    """How the location is chosen, and what that needs besides estimate, u and y.

    `choose(instant, m, u, p)` returns the new `location` and the rule's own discrete states. `begin` is the location at
    the start.
    """

    begin: int
    choose: Callable[[Instant, Values, Values, Values], Mapping[str, Any]]
    inputs: tuple[Signal, ...] = ()
    discrete: tuple[Signal, ...] = ()
    parameters: tuple[Signal, ...] = ()


def nominal_automaton(plant: str, parameters: Mapping[str, Any] | None, parameter_set: str | None) -> Automaton:
    """The automaton of the plant module `plant`, which has MODEL and automaton(parameters).

    The values are the model's defaults, then those of its `parameter_set`, then `parameters` (texts with units).

    Raises ModelError: no such module, set or parameter, or a value of another dimension.
    """
    try:
        module = importlib.import_module(plant)
    except ModuleNotFoundError as error:
        raise ModelError(f"plant wants a module, got '{plant}': {error}") from error
    if not hasattr(module, "automaton") or not hasattr(module, "MODEL"):
        raise ModelError(f"plant wants a module with MODEL and automaton(parameters), got '{plant}', which lacks one")
    model: Model = module.MODEL
    values = {signal.name: float(signal.start) for signal in model.parameters}
    if parameter_set is not None:
        if parameter_set not in model.parameter_sets:
            raise ModelError(unknown(parameter_set, model.parameter_sets, f"parameter set of {plant}"))
        values |= model.parameter_sets[parameter_set]
    values |= read_values(parameters or {}, model.parameters, "parameter")
    return _automaton(plant, tuple(sorted(values.items())))


@lru_cache(maxsize=64)
def _automaton(plant: str, values: tuple[tuple[str, float], ...]) -> Automaton:
    """One object a set of values, so that the designs made for it can be kept."""
    automaton: Automaton = importlib.import_module(plant).automaton(dict(values))
    return automaton


def read_values(given: Mapping[str, Any], signals: Sequence[Signal], kind: str) -> dict[str, float]:
    """Texts like `1500 N.m/rad` (or numbers, where the unit is 1) by name, in the units of `signals`.

    Raises ModelError: a name that is none of the signals', or a value of another dimension.
    """
    units = {signal.name: signal.unit for signal in signals}
    values = {}
    for name, raw in given.items():
        if name not in units:
            raise ModelError(unknown(name, units, kind))
        values[name] = read_value(raw, units[name], name)
    return values


def read_value(raw: Any, wanted: str, name: str) -> float:
    """`raw`, a text with a unit or a number without, in the unit `wanted`. Raises ModelError: another dimension."""
    try:
        number, unit = parse_quantity(str(raw))
        source, target = parse_unit(unit), parse_unit(wanted)
    except UnitError as error:
        raise ModelError(f"{name}: {error}") from error
    if not source.same_dimension(target):
        raise ModelError(f"{name} wants {wanted}, got {raw}")
    return target.from_si(source.to_si(number))


def read_thresholds(threshold: dict[str, Any] | str, automaton: Automaton) -> tuple[float, ...]:
    """eps (p,) in the outputs' units. Raises ModelError: one is missing or of another dimension."""
    if isinstance(threshold, dict):
        values = read_values(threshold, automaton.outputs, "output")
        missing = [signal.name for signal in automaton.outputs if signal.name not in values]
        if missing:
            raise ModelError(f"threshold wants a value for {', '.join(missing)}")
        return tuple(values[signal.name] for signal in automaton.outputs)
    return tuple(read_value(threshold, signal.unit, "threshold") for signal in automaton.outputs)


def blind(automaton: Automaton) -> Automaton:
    """The same plant with nothing measured."""
    n = len(automaton.states)
    return replace(
        automaton,
        outputs=(),
        locations=tuple(replace(location, C=np.zeros((0, n))) for location in automaton.locations),
    )


def measured_names(automaton: Automaton) -> list[str]:
    """Names of the inputs that carry y: the plant's own, with `_measured` where a state has that name."""
    states = {signal.name for signal in automaton.states}
    return [f"{signal.name}_measured" if signal.name in states else signal.name for signal in automaton.outputs]


def sampled_signals(prefix: str, sampled: Sequence[Sampled]) -> tuple[Signal, ...]:
    """Parameters `prefix_state` ... that hold several observers' matrices, observer first."""
    stacked = {name: np.stack([getattr(one, name) for one in sampled]) for name in Sampled._fields}
    return tuple(
        Signal(f"{prefix}_{name}", "1", start=value, shape=value.shape, description=f"{name} matrices, sampled")
        for name, value in stacked.items()
        if value.size
    )


def sampled_values(prefix: str, p: Values, count: int, outputs: int) -> list[Sampled]:
    """The observers that `sampled_signals` declared."""
    nothing = np.zeros((count, p[f"{prefix}_state"].shape[1], 0))
    fields = {
        name: nothing if name in ("before", "now") and not outputs else p[f"{prefix}_{name}"]
        for name in Sampled._fields
    }
    return [Sampled(**{name: value[k] for name, value in fields.items()}) for k in range(count)]


def pick(location: Any, choices: Sequence[Any]) -> Any:
    """The choice (arrays of one shape) that belongs to `location`, counted from 1."""
    picked = list(choices[-1])
    for number in range(len(choices) - 1, 0, -1):
        picked = [np.where(location < number + 0.5, a, b) for a, b in zip(choices[number - 1], picked, strict=True)]
    return vector(picked)


def vector(values: Sequence[Any]) -> Any:
    """Scalars, numbers or symbols, as an array (n,)."""
    scalars = [value.item() if isinstance(value, np.ndarray) else value for value in values]
    array = np.empty(len(scalars), dtype=object)
    array[:] = scalars
    return array.astype(float) if all(isinstance(value, (int, float)) for value in scalars) else array


def bank_model(
    name: str,
    description: str,
    automaton: Automaton,
    gains: Sequence[Array],
    rule: Rule,
    start: Mapping[str, Any],
    sample_time: float,
) -> Model:
    """A sampled observer: the observer of the current location runs over (k-1, k], then the rule picks at k.

    Its outputs are the states' estimates under the plant's names, and `location`. Its step must be `sample_time` [s]:
    the matrices hold for that. `gains` (n, p) one a location; `start` texts by state name, 0 where absent.

    Raises ModelError: a start value of no state, or a sample time that is not positive.
    """
    if not sample_time > 0.0:
        raise ModelError(f"sample_time wants a value above 0 s, got {sample_time:g}")
    begin = read_values(start, automaton.states, "state")
    states = [signal.name for signal in automaton.states]
    measured, commanded = measured_names(automaton), [signal.name for signal in automaton.inputs]
    count, outputs = len(automaton.locations), len(automaton.outputs)
    sampled = [sample_observer(loc, gain, sample_time) for loc, gain in zip(automaton.locations, gains, strict=True)]

    def sample(t: Any, x: Values, m: Values, u: Values, p: Values) -> dict[str, Any]:
        estimate = vector([m[state] for state in states])
        instant = Instant(
            estimate,
            vector([u[command] for command in commanded]),
            vector([m[f"{output}_before"] for output in measured]),
            vector([u[output] for output in measured]),
        )
        observers = sampled_values("observer", p, count, outputs)
        moved = [advance(one, estimate, instant.u, instant.before, instant.now) for one in observers]
        estimate = pick(m.location, moved)
        chosen = rule.choose(instant._replace(estimate=estimate), m, u, p)
        remembered = {f"{output}_before": u[output] for output in measured}
        return dict(zip(states, estimate, strict=True)) | remembered | dict(chosen)

    return Model(
        name=name,
        description=description,
        role="observer",
        equations=lambda t, x, m, u, p: ({}, {}),
        inputs=(
            *(replace(signal, name=input_name) for signal, input_name in zip(automaton.outputs, measured, strict=True)),
            *automaton.inputs,
            *rule.inputs,
        ),
        discrete=(
            *(replace(signal, start=begin.get(signal.name, 0.0)) for signal in automaton.states),
            Signal("location", "1", rule.begin, "estimated location", minimum=1, maximum=count, kind="integer"),
            *(
                replace(signal, name=f"{input_name}_before", local=True, description="y at the last sample")
                for signal, input_name in zip(automaton.outputs, measured, strict=True)
            ),
            *rule.discrete,
        ),
        parameters=(
            Signal("sample_time", "s", sample_time, "step the matrices are made for"),
            *sampled_signals("observer", sampled),
            *rule.parameters,
        ),
        sample=sample,
        sample_time="sample_time",
    )
