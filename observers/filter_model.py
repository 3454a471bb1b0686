"""A Kalman filter on a plant's model as a Model: the mean is the plant's own state, the kernel samples."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fmus.component import Signal
from fmus.jacobians import Jacobians, Point, jacobians
from fmus.model import Kernel, Model, Values, unknown
from observers.given import Complaints, Given, difference_unit, measured_name, product_unit, read_deviations
from observers.kalman import Gaussian, normalised_square

Array = NDArray[np.float64]

SOURCES = Path(__file__).parent
BEFORE, COVARIANCE, SINCE = "estimate_before", "scaled_covariance", "since_sample"


@dataclass(frozen=True)
class Instant:
    """A sampling instant: the belief at the one before, where the model brought its mean, and the measurements.

    Means and covariances count in nominal values; `before` and `now` hold the same inputs, parameters and discrete
    states.
    """

    given: Given
    jacobians: Jacobians
    prior: Gaussian
    before: Point
    now: Point
    h: float
    measured: Array
    variance: Array
    density: Array
    p: Values

    def A(self, at: Point) -> Array:
        """The Jacobian of the scaled states' derivatives, 1/s, (n, n)."""
        scales = self.given.scales
        return self.jacobians.at(at).A * scales / scales[:, None]

    def expected(self, at: Point) -> Array:
        """h(x), (m,)."""
        return self.jacobians.values(at)[1][-len(self.measured) :]

    def C(self, at: Point) -> Array:
        """dh/dz, (m, n)."""
        return self.jacobians.at(at).C[-len(self.measured) :] * self.given.scales

    def at(self, z: Array) -> Point:
        """The present point with other states."""
        return self.now._replace(x=z * self.given.scales)


class Sampled:
    """What a sampling gives: the belief, and the innovation with the covariance expected of it."""

    def __init__(self, belief: Gaussian, innovation: Array, innovation_covariance: Array) -> None:
        self.belief, self.innovation, self.innovation_covariance = belief, innovation, innovation_covariance


@dataclass(frozen=True)
class Twin:
    """The `sample` of a filter's model in NumPy."""

    given: Given
    shown: tuple[int, ...]
    rule: Callable[[Instant], Sampled]

    @cached_property
    def jacobians(self) -> Jacobians:
        """Those of the plant with its sensors; traced when first asked for."""
        return jacobians(self.given.model)

    def __call__(self, t: Any, x: Values, m: Values, u: Values, p: Values) -> Mapping[str, Any]:
        """x+ and m+ by name."""
        given, scales = self.given, self.given.scales
        known = given.model
        mean = _flat(x, known.states)
        now = Point(mean, _flat(m, known.discrete), _flat(u, known.inputs), _flat(p, known.parameters), t)
        h = float(p.sample_time) or float(x[SINCE])
        before = now._replace(x=_flat(m, [Signal(BEFORE, shape=(len(mean),))]), t=t - h)
        deviations = np.array([p[f"noise_{name}"] for name in given.sensors], dtype=float)
        strays = np.concatenate([np.ravel(p[f"process_{signal.name}"]) for signal in known.states]) / scales
        prior = Gaussian(before.x / scales, np.array(m[COVARIANCE], dtype=float))
        measured = np.array([u[measured_name(name)] for name in given.sensors], dtype=float)
        found = self.rule(Instant(given, self.jacobians, prior, before, now, h, measured, deviations**2, strays**2, p))
        belief, S = found.belief, found.innovation_covariance
        after = belief.mean * scales
        deviations = np.sqrt(np.diag(belief.covariance)) * scales
        values: dict[str, Any] = {BEFORE: after, COVARIANCE: belief.covariance}
        values |= _by_signal(after, known.states)
        values |= {f"std_{name}": value for name, value in _by_signal(deviations, given.plant_states).items()}
        values |= {f"innovation_{name}": v for name, v in zip(given.sensors, found.innovation, strict=True)}
        values |= _elements("innovation_covariance", S)
        values |= {"nis": normalised_square(found.innovation, S)}
        if self.shown:
            part = np.ix_(self.shown, self.shown)
            values |= _elements("covariance", (belief.covariance * np.outer(scales, scales))[part])
        if not float(p.sample_time):
            values[SINCE] = 0.0
        return values


def _flat(values: Values, signals: Sequence[Signal]) -> Array:
    return np.array([v for signal in signals for v in np.ravel(values[signal.name])], dtype=float)


def _by_signal(flat: Array, signals: Sequence[Signal]) -> dict[str, Any]:
    found, place = {}, 0
    for signal in signals:
        found[signal.name] = flat[place : place + signal.size].reshape(signal.shape)
        place += signal.size
    return found


def _elements(name: str, matrix: Array) -> dict[str, float]:
    return {f"{name}[{i + 1},{j + 1}]": float(matrix[i, j]) for i, j in np.ndindex(*matrix.shape)}


def read_uncertainty(raw: Mapping[str, Any] | str | float, given: Given, found: Complaints) -> Array:
    """Standard deviations (n,) of the start values; a sensor's lag has its signal's, and its nominal otherwise."""
    plant = given.plant_states
    slow = given.model.states[len(plant) :]
    values = read_deviations(raw, plant, "uncertainty", "state", found, optional=slow)
    names = [name for signal in given.model.states for name in signal.scalar_names()]
    for i in np.flatnonzero(np.isnan(values)):
        source = names[i].removesuffix("_lagged")
        values[i] = values[names.index(source)] if source in names[:i] else abs(given.scales[i])
    return values


def read_shown(names: Sequence[str], given: Given, found: Complaints) -> tuple[int, ...]:
    """Which of the plant's scalar states have their joint covariance shown."""
    known = [name for signal in given.plant_states for name in signal.scalar_names()]
    for name in names:
        if name not in known:
            found.add(f"covariance: {unknown(name, known, 'state')}")
    return tuple(known.index(name) for name in names if name in known)


def filter_model(
    name: str,
    description: str,
    given: Given,
    uncertainty: Array,
    shown: tuple[int, ...],
    rule: Callable[[Instant], Sampled],
    sample_time: float,
    parameters: Sequence[Signal] = (),
) -> Model:
    """The filter: between two samplings the mean follows the plant's equations by the FMU's own solver.

    `rule` is what a sampling does, in NumPy; `NAME.c` beside this file does the same. `sample_time` [s] 0 samples at
    each step, however long it was.
    """
    known = given.model
    every_step = sample_time == 0.0
    since = (Signal(SINCE, "s", 0.0, "time since the last sampling", nominal=1e-2, local=True),) if every_step else ()
    discrete = (*known.discrete, *_discrete(given, uncertainty, shown))
    parameters = (
        *known.parameters,
        Signal("sample_time", "s", sample_time, "time from sampling to sampling, 0 for each step"),
        *(
            Signal(f"noise_{name}", difference_unit(s.unit), float(v), f"standard deviation of {s.description}")
            for name, s, v in zip(given.sensors, given.measured, given.noise, strict=True)
        ),
        *(
            replace(s, name=f"process_{s.name}", unit=difference_unit(s.unit), start=v, minimum=0.0, maximum=np.inf,
                    local=False, description=f"what {s.name} strays in a second, standard deviation")
            for s, v in zip(known.states, _by_signal(given.process, known.states).values(), strict=True)
        ),
        *parameters,
    )  # fmt: skip

    def equations(t: Any, x: Values, m: Values, u: Values, p: Values) -> tuple[dict[str, Any], dict[str, Any]]:
        derivatives, outputs = given.equations(t, x, m, u, p)
        return (derivatives | {SINCE: 1.0} if every_step else derivatives), outputs

    sizes = {
        "N": len(given.scales), "M": len(given.sensors), "K": len(shown),
        "STD": sum(signal.size for signal in given.plant_states),
        "MEASURED": sum(signal.size for signal in known.inputs),
    }  # fmt: skip
    return replace(
        known,
        name=name,
        description=description,
        role="observer",
        equations=equations,
        inputs=(*known.inputs, *given.measured),
        states=(*known.states, *since),
        outputs=given.outputs,
        parameters=parameters,
        discrete=discrete,
        sample=Twin(given, shown, rule),
        sample_time="sample_time",
        kernel=Kernel(_source(name, sizes, shown, discrete, parameters, given), {"expected": given.expected}),
    )


def _discrete(given: Given, uncertainty: Array, shown: tuple[int, ...]) -> list[Signal]:
    """What a sampling leaves, in the order that kalman.c counts on within each group."""
    known, scales = given.model, given.scales
    n, states = len(scales), [(s.name, s.unit) for s in known.states for _ in range(s.size)]
    start = np.concatenate([signal.scalar_starts() for signal in known.states])
    covariance = np.diag((uncertainty / scales) ** 2)
    deviations = _by_signal(uncertainty, known.states)
    innovations = [(name, difference_unit(s.unit)) for name, s in zip(given.sensors, given.measured, strict=True)]
    return [
        Signal(BEFORE, "1", start, "estimate at the last sampling", shape=(n,), local=True),
        Signal(COVARIANCE, "1", covariance, "covariance in nominal values", shape=(n, n), local=True),
        *(
            replace(s, name=f"std_{s.name}", unit=difference_unit(s.unit), start=deviations[s.name], minimum=0.0,
                    maximum=np.inf, description=f"standard deviation of {s.name}", local=False)
            for s in given.plant_states
        ),
        *(Signal(f"innovation_{name}", unit, 0.0, f"{name}, measured less expected") for name, unit in innovations),
        Signal("nis", "1", 0.0, "innovation squared, normalised by its covariance"),
        *_matrix("innovation_covariance", [unit for _, unit in innovations], np.zeros((len(innovations),) * 2)),
        *_matrix(
            "covariance", [states[i][1] for i in shown], (covariance * np.outer(scales, scales))[np.ix_(shown, shown)]
        ),
    ]  # fmt: skip


def _matrix(name: str, units: Sequence[str], start: Array) -> list[Signal]:
    """A scalar for each element, since each has a unit of its own."""
    return [
        Signal(f"{name}[{i + 1},{j + 1}]", product_unit(units[i], units[j]), float(start[i, j]))
        for i, j in np.ndindex(*start.shape)
    ]


def _source(
    name: str,
    sizes: Mapping[str, int],
    shown: Sequence[int],
    discrete: Sequence[Signal],
    parameters: Sequence[Signal],
    given: Given,
) -> str:
    """The kernel: sizes and places, then kalman.c and NAME.c."""
    firsts = {
        "AT_BEFORE": (discrete, BEFORE),
        "AT_COVARIANCE": (discrete, COVARIANCE),
        "AT_STD": (discrete, f"std_{given.plant_states[0].name}"),
        "AT_INNOVATION": (discrete, f"innovation_{given.sensors[0]}"),
        "AT_NIS": (discrete, "nis"),
        "AT_INNOVATION_COVARIANCE": (discrete, "innovation_covariance[1,1]"),
        "AT_SHOWN": (discrete, "covariance[1,1]"),
        "AT_NOISE": (parameters, f"noise_{given.sensors[0]}"),
        "AT_PROCESS": (parameters, f"process_{given.model.states[0].name}"),
        "AT_SPREAD": (parameters, "spread"),
    }
    places = {key: _place(signals, first) for key, (signals, first) in firsts.items()}
    lines = [f"#define {key} {value}" for key, value in {**sizes, **places}.items()]
    numbers = ", ".join(str(i) for i in (*shown, 0))
    lines.append(f"static const int shown[K + 1] = {{{numbers}}};")
    return "\n".join([*lines, (SOURCES / "kalman.c").read_text(), (SOURCES / f"{name}.c").read_text()])


def _place(signals: Sequence[Signal], name: str) -> int:
    """Where the first scalar of a signal stands; 0 where there is none such, which nothing then asks for."""
    place = 0
    for signal in signals:
        if signal.name == name:
            return place
        place += signal.size
    return 0
