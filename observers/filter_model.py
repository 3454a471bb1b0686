"""A Kalman filter on a plant's model as a Model: the mean is the plant's own state, the kernel samples."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fmus.component import Signal
from fmus.jacobians import Jacobians, Point, jacobians, point
from fmus.model import Kernel, Model, ModelError, Values, unknown
from fmus.units import difference_unit
from observers.given import Complaints, Given, measured_name, read_deviations
from observers.kalman import Gaussian, normalised_square
from observers.told import (
    INNOVATION_COVARIANCE,
    by_signal,
    deviation_signals,
    innovation_signals,
    matrix_signals,
    matrix_values,
    place_of,
    scalars,
)

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


class Sampled(NamedTuple):
    """What a sampling gives: the belief, and the innovation (m,) with the covariance (m, m) expected of it."""

    belief: Gaussian
    innovation: Array
    innovation_covariance: Array


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
        flat = [_flat(*pair) for pair in ((x, known.states), (m, known.discrete), (u, known.inputs))]
        now = Point(flat[0], flat[1], flat[2], _flat(p, known.parameters), t)
        h = float(p.sample_time) or float(x[SINCE])
        before = now._replace(x=np.array(m[BEFORE], dtype=float), t=t - h)
        prior = Gaussian(before.x / scales, np.array(m[COVARIANCE], dtype=float))
        measured = np.array([u[measured_name(name)] for name in given.sensors], dtype=float)
        variance = np.array([p[f"noise_{name}"] for name in given.sensors], dtype=float) ** 2
        density = np.array(scalars({s.name: p[f"process_{s.name}"] for s in known.states}, known.states), dtype=float)
        density = (density / scales) ** 2
        found = self.rule(Instant(given, self.jacobians, prior, before, now, h, measured, variance, density, p))
        mean, covariance = found.belief.mean * scales, found.belief.covariance
        deviations = np.sqrt(np.diag(covariance)) * scales
        whole = covariance * np.outer(scales, scales)
        return {
            **by_signal(mean, known.states),
            **({} if float(p.sample_time) else {SINCE: 0.0}),
            BEFORE: mean,
            COVARIANCE: covariance,
            **by_signal(deviations, given.plant_states, "std_"),
            **{f"innovation_{name}": v for name, v in zip(given.sensors, found.innovation, strict=True)},
            "nis": normalised_square(found.innovation, found.innovation_covariance),
            **matrix_values(INNOVATION_COVARIANCE, found.innovation_covariance),
            **matrix_values("covariance", whole[np.ix_(self.shown, self.shown)]),
        }


def _flat(values: Values, signals: Sequence[Signal]) -> Array:
    return np.array(scalars(values, signals), dtype=float)


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

    `rule` is what a sampling does, in NumPy; `NAME.c` beside this file does the same. `uncertainty` (n,) is that of the
    start, `shown` are the states whose covariance is told. `sample_time` [s] 0 samples at each step, however long.
    """
    known = given.model
    every_step = sample_time == 0.0
    since = (Signal(SINCE, "s", 0.0, "time since the last sampling", nominal=1e-2, local=True),) if every_step else ()
    discrete = (*known.discrete, *_discrete(given, uncertainty, shown))
    tuning = (*_tuning(given, sample_time), *parameters)

    def equations(t: Any, x: Values, m: Values, u: Values, p: Values) -> tuple[dict[str, Any], dict[str, Any]]:
        derivatives, outputs = given.equations(t, x, m, u, p)
        return (derivatives | {SINCE: 1.0} if every_step else derivatives), outputs

    return replace(
        known,
        name=name,
        description=description,
        role="observer",
        equations=equations,
        inputs=(*known.inputs, *given.measured),
        states=(*known.states, *since),
        outputs=given.outputs,
        parameters=(*known.parameters, *tuning),
        discrete=discrete,
        sample=Twin(given, shown, rule),
        sample_time="sample_time",
        kernel=Kernel(
            _source(name, given, shown, discrete, (*known.parameters, *tuning)), {"expected": given.expected}
        ),
    )


def _tuning(given: Given, sample_time: float) -> list[Signal]:
    """The parameters of a filter that are not the plant's."""
    process = by_signal(given.process, given.model.states)
    return [
        Signal("sample_time", "s", sample_time, "time from sampling to sampling, 0 for each step"),
        *(
            Signal(f"noise_{name}", difference_unit(s.unit), float(v), f"standard deviation of {s.description}")
            for name, s, v in zip(given.sensors, given.measured, given.noise, strict=True)
        ),
        *(
            Signal(
                f"process_{s.name}",
                difference_unit(s.unit),
                process[s.name],
                f"standard deviation of what {s.name} strays in a second",
                shape=s.shape,
            )
            for s in given.model.states
        ),
    ]


def _discrete(given: Given, uncertainty: Array, shown: tuple[int, ...]) -> list[Signal]:
    """What a sampling leaves; kalman.c counts on the order within each group."""
    known, scales = given.model, given.scales
    n = len(scales)
    units = [signal.unit for signal in known.states for _ in range(signal.size)]
    start = np.concatenate([signal.scalar_starts() for signal in known.states])
    whole = np.diag(uncertainty**2)
    return [
        Signal(BEFORE, "1", start, "estimate at the last sampling", shape=(n,), local=True),
        Signal(
            COVARIANCE, "1", whole / np.outer(scales, scales), "covariance in nominal values", shape=(n, n), local=True
        ),
        *deviation_signals(given, uncertainty),
        *innovation_signals(given, _first_innovation(given, uncertainty)),
        *matrix_signals("covariance", [units[i] for i in shown], whole[np.ix_(shown, shown)]),
    ]


def _first_innovation(given: Given, uncertainty: Array) -> Array:
    """C P C' + R (m, m) at the start. Raises ModelError: the model has no finite derivatives there."""
    linear = jacobians(given.model).at(point(given.model))
    C = linear.C[-len(given.sensors) :] * uncertainty
    if not (np.isfinite(C).all() and np.isfinite(linear.A).all()):
        raise ModelError(f"{given.model.name} has no finite derivatives at its start values")
    return np.asarray(C @ C.T + np.diag(given.noise**2), dtype=np.float64)


def _source(
    name: str, given: Given, shown: Sequence[int], discrete: Sequence[Signal], parameters: Sequence[Signal]
) -> str:
    """The kernel: sizes and places, then kalman.c and NAME.c."""
    known, sensor = given.model, given.sensors[0]
    defined = {
        "N": len(given.scales),
        "M": len(given.sensors),
        "K": len(shown),
        "STD": sum(signal.size for signal in given.plant_states),
        "MEASURED": sum(signal.size for signal in known.inputs),
        "AT_BEFORE": place_of(discrete, BEFORE),
        "AT_COVARIANCE": place_of(discrete, COVARIANCE),
        "AT_STD": place_of(discrete, f"std_{given.plant_states[0].name}"),
        "AT_INNOVATION": place_of(discrete, f"innovation_{sensor}"),
        "AT_NIS": place_of(discrete, "nis"),
        "AT_INNOVATION_COVARIANCE": place_of(discrete, f"{INNOVATION_COVARIANCE}[1,1]"),
        "AT_SHOWN": sum(signal.size for signal in discrete) - len(shown) ** 2,
        "AT_NOISE": place_of(parameters, f"noise_{sensor}"),
        "AT_PROCESS": place_of(parameters, f"process_{known.states[0].name}"),
        "AT_MORE": place_of(parameters, f"process_{known.states[-1].name}") + known.states[-1].size,
    }
    lines = [f"#define {key} {value}" for key, value in defined.items()]
    lines.append(f"static const int shown[K + 1] = {{{', '.join(str(i) for i in (*shown, 0))}}};")
    return "\n".join([*lines, (SOURCES / "kalman.c").read_text(), (SOURCES / f"{name}.c").read_text()])
