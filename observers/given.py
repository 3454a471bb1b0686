"""What an estimator on a plant's model is given: the plant with its sensors, what it believes, how sure it is."""

from __future__ import annotations

import importlib
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from fmus.component import ConfigurationError, Problem, Signal
from fmus.model import Model, ModelError, Values, unknown
from fmus.sensing import sensor_name, with_sensors
from fmus.units import Unit, UnitError, parse_quantity, parse_unit

Array = NDArray[np.float64]

Found = TypeVar("Found")

OTHERS = "others"
LAGGED = "_lagged"  # how fmus.sensing ends the names of a sensor's own states
_LIST = re.compile(r"\s*\[(?P<numbers>[^\]]*)\]\s*(?P<unit>.*)$")


@dataclass(frozen=True)
class Given:
    """A plant as an estimator knows it.

    `model` has the plant's states first, then one for each sensor that lags; the starts of states and parameters are
    what the estimator believes. `plant_states` are the plant's own. `noise` (m,) are the sensors' standard deviations
    in their units; `process` (n,) what each state strays in a second by itself, a standard deviation in its unit.
    """

    model: Model
    sensors: tuple[str, ...]
    plant_states: tuple[Signal, ...]
    outputs: tuple[Signal, ...]
    noise: Array
    process: Array

    @property
    def scales(self) -> Array:
        """Nominal values of the states, (n,), in their units."""
        return np.array([signal.nominal for signal in self.model.states for _ in range(signal.size)])

    @property
    def measured(self) -> tuple[Signal, ...]:
        """The inputs that carry the measurements."""
        signals = {signal.name: signal for signal in self.model.outputs}
        return tuple(
            replace(signals[sensor_name(name)], name=measured_name(name), description=f"measured {name}", local=False)
            for name in self.sensors
        )

    def expected(self, t: Any, x: Values, m: Values, u: Values, p: Values) -> dict[str, Any]:
        """h(x): what each sensor is expected to show, by sensor."""
        _, outputs = self.model.equations(t, x, m, u, p)
        return {name: outputs[sensor_name(name)] for name in self.sensors}

    def equations(self, t: Any, x: Values, m: Values, u: Values, p: Values) -> tuple[dict[str, Any], dict[str, Any]]:
        """The plant's and the sensors' derivatives, and of the outputs those that were chosen."""
        derivatives, outputs = self.model.equations(t, x, m, u, p)
        return dict(derivatives), {signal.name: outputs[signal.name] for signal in self.outputs}


def measured_name(sensor: str) -> str:
    """The input that carries what the sensor on a signal shows."""
    return f"{sensor}_measured"


class Complaints:
    """What is wrong with the arguments, all of it."""

    def __init__(self) -> None:
        self.messages: list[str] = []

    def add(self, message: str) -> None:
        """One more."""
        self.messages.append(message)

    def collect(self, read: Callable[..., Found], *arguments: Any) -> Found | None:
        """What `read` returns of the arguments; None where it raised a ModelError, which is kept."""
        try:
            return read(*arguments)
        except ModelError as error:
            self.add(str(error))
            return None

    def end(self) -> None:
        """Raises ConfigurationError: something is wrong."""
        if self.messages:
            raise ConfigurationError([Problem(message) for message in self.messages])


def read_given(
    plant: str | Model,
    sensors: Sequence[str],
    noise: Mapping[str, Any] | str | float,
    process: Mapping[str, Any] | str | float,
    found: Complaints,
    *,
    parameters: Mapping[str, Any] | None = None,
    parameter_set: str | None = None,
    start: Mapping[str, Any] | None = None,
    lags: Mapping[str, Any] | None = None,
    outputs: Sequence[str] | None = None,
) -> Given:
    """The plant with its sensors, and what is believed of it, from texts with units.

    `plant` is a module with a MODEL, `module:NAME`, or a Model. `outputs` are names of the plant's outputs, all of them
    where None.

    Raises ConfigurationError: there is no such plant; everything else that is wrong is left with `found`, and the
    Given is then of no use.
    """
    bare = plant_model(plant)
    believed = read_believed(bare, parameters, parameter_set, start or {}, found)
    constants = read_values(lags or {}, [Signal(name, "s") for name in sensors], "sensor", found)
    model = found.collect(with_sensors, believed, list(sensors), constants) or believed
    slow = model.states[len(bare.states) :]
    known = {signal.name: signal for signal in (*believed.states, *believed.outputs)}
    on = [known[name] for name in sensors if name in known]
    strays = read_deviations(process, bare.states, "process", "state", found, optional=slow)
    return Given(
        model=_start_lags(model, slow, start or {}, found),
        sensors=tuple(sensors),
        plant_states=bare.states,
        outputs=tuple(read_outputs(bare, outputs, found)),
        noise=read_deviations(noise, on, "noise", "sensor", found),
        process=np.nan_to_num(strays),
    )


def require_sensors(sensors: Sequence[str], found: Complaints) -> None:
    """A complaint where there are no sensors to correct by."""
    if not sensors:
        found.add("sensors wants one signal or more; without any there is observers.model_alone")


def plant_model(plant: str | Model) -> Model:
    """The Model of a plant. Raises ConfigurationError: there is none, or it is one that an estimator cannot run."""
    if isinstance(plant, Model):
        model = plant
    else:
        name, _, attribute = plant.partition(":")
        try:
            module = importlib.import_module(name)
        except ModuleNotFoundError as error:
            raise ConfigurationError(f"plant wants a module, got '{plant}': {error}") from error
        named = getattr(module, attribute or "MODEL", None)
        if not isinstance(named, Model):
            lacking = attribute or "MODEL"
            raise ConfigurationError(f"plant wants a module with a Model, got '{plant}', which has no {lacking}")
        model = named
    if model.sample is not None:
        raise ConfigurationError(f"plant wants a model in continuous time: {model.name} is sampled")
    if not model.states:
        raise ConfigurationError(f"plant wants a model with states to estimate: {model.name} has none")
    return model


def read_believed(
    model: Model,
    parameters: Mapping[str, Any] | None,
    parameter_set: str | None,
    start: Mapping[str, Any],
    found: Complaints,
) -> Model:
    """The plant's model with parameters and starts as the estimator believes them; it has no parameter sets left."""
    values: dict[str, Any] = {}
    if parameter_set is not None:
        if parameter_set in model.parameter_sets:
            values |= model.parameter_sets[parameter_set]
        else:
            sets = model.parameter_sets
            found.add(unknown(parameter_set, sets, f"parameter set of {model.name}"))
    values |= read_values(parameters or {}, model.parameters, f"parameter of {model.name}", found)
    states = (*model.states, *model.discrete)
    own = {key: raw for key, raw in start.items() if not key.endswith(LAGGED)}
    starts = read_values(own, states, f"state of {model.name}", found)
    return replace(
        model,
        parameters=tuple(replace(s, start=values.get(s.name, s.start)) for s in model.parameters),
        states=tuple(replace(s, start=starts.get(s.name, s.start)) for s in model.states),
        discrete=tuple(replace(s, start=starts.get(s.name, s.start)) for s in model.discrete),
        parameter_sets={},
    )


def _start_lags(model: Model, slow: Sequence[Signal], start: Mapping[str, Any], found: Complaints) -> Model:
    """The lags of the sensors begin where their signals do, unless `start` names them."""
    names = {signal.name for signal in slow}
    values = read_values({key: raw for key, raw in start.items() if key in names}, slow, "state", found)
    for key in start:
        if key.endswith(LAGGED) and key not in names:
            found.add(unknown(key, [*names, *(signal.name for signal in model.states)], f"state of {model.name}"))
    return replace(model, states=tuple(replace(s, start=values.get(s.name, s.start)) for s in model.states))


def read_outputs(model: Model, names: Sequence[str] | None, found: Complaints) -> Iterable[Signal]:
    """The outputs of a plant by name, all of them where None."""
    known = {signal.name: signal for signal in model.outputs}
    for name in known if names is None else names:
        if name in known:
            yield known[name]
        else:
            found.add(f"outputs: {unknown(name, known, f'output of {model.name}')}")


def read_values(raw: Mapping[str, Any], signals: Iterable[Signal], kind: str, found: Complaints) -> dict[str, float]:
    """Values by name of `signals`, in their units, from quantities like `60 kPa`."""
    known = {signal.name: signal for signal in signals}
    values = {}
    for name, text in raw.items():
        if name not in known:
            found.add(unknown(name, known, kind))
            continue
        number = found.collect(read_quantity, text, known[name].unit, name)
        if number is not None:
            values[name] = number
    return values


def read_quantity(raw: Any, unit: str, name: str) -> float:
    """A quantity in `unit`. Raises ModelError: it is none, or of another dimension."""
    number, source, target = _parsed(raw, unit, name)
    return target.from_si(source.to_si(number))


def read_difference(raw: Any, unit: str, name: str) -> float:
    """A difference of quantities in `unit`, where an offset counts for nothing. Raises ModelError, as above."""
    number, source, target = _parsed(raw, unit, name)
    return number * source.factor / target.factor


def _parsed(raw: Any, unit: str, name: str) -> tuple[float, Unit, Unit]:
    try:
        number, written = parse_quantity(str(raw))
        source, target = parse_unit(written), parse_unit(unit)
    except UnitError as error:
        raise ModelError(f"{name}: {error}") from error
    if not source.same_dimension(target):
        raise ModelError(f"{name} wants {unit}, got {raw}")
    return number, source, target


def read_list(raw: Any, unit: str, name: str) -> list[float]:
    """Quantities in `unit` from `[1, 2] kPa` or a list. Raises ModelError: one is none, or of another dimension."""
    match = _LIST.match(raw) if isinstance(raw, str) else None
    items = [f"{number} {match['unit']}" for number in match["numbers"].split(",")] if match else raw
    if isinstance(items, (str, Mapping)) or not isinstance(items, Iterable):
        items = [items]
    return [read_quantity(item, unit, name) for item in items]


def read_deviations(
    raw: Mapping[str, Any] | str | float,
    signals: Sequence[Signal],
    what: str,
    kind: str,
    found: Complaints,
    optional: Sequence[Signal] = (),
) -> Array:
    """Standard deviations (n,) of the scalars of `signals`, then of `optional`, in their units.

    `raw` gives one by name. Those of `signals` left out are `others`, a share of the nominal value, and so are all
    where `raw` is a number; those of `optional` are NaN.
    """
    given = dict(raw) if isinstance(raw, Mapping) else {OTHERS: raw}
    share = found.collect(read_difference, given[OTHERS], "1", f"{what}: {OTHERS}") if OTHERS in given else None
    known = {signal.name: signal for signal in (*signals, *optional)}
    for name in given:
        if name not in known and name != OTHERS:
            found.add(f"{what}: {unknown(name, known, kind)}")
    missing = [signal.name for signal in signals if signal.name not in given]
    if missing and OTHERS not in given:
        told = f"a standard deviation of {', '.join(missing)} too, or `{OTHERS}`, a share of the nominal value"
        found.add(f"{what} wants {told}")
    values: list[float] = []
    for signal in known.values():
        number: float | None = np.nan
        if signal.name in given:
            number = found.collect(read_difference, given[signal.name], signal.unit, f"{what}: {signal.name}")
        elif signal in signals:
            number = None if share is None else share * abs(signal.nominal)
        if number is not None and number < 0.0:
            found.add(f"{what}: {signal.name} wants 0 {signal.unit} or more, got {number:g}")
        values += [np.nan if number is None else number] * signal.size
    return np.array(values)
