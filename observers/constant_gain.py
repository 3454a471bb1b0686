"""A Kalman filter with a gain made beforehand: that of one operating point, or interpolated over a grid of them."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Annotated, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fmus.component import Signal
from fmus.jacobians import Jacobians, Point, jacobians, point
from fmus.model import Model, ModelError, Values, unknown
from fmus.steady import SteadyError, steady_state
from observers.given import (
    Complaints,
    Given,
    difference_unit,
    measured_name,
    product_unit,
    read_given,
    read_list,
    read_values,
)
from observers.stationary import Stationary, stationary

Array = NDArray[np.float64]


class Axis(NamedTuple):
    """One axis of a grid: the input of the observer that it is read from, and the nodes, ascending, in its unit."""

    input: Signal
    nodes: Array


def make(
    plant: str | Model,
    sensors: list[str],
    noise: dict[str, Any],
    process: dict[str, Any] | str | float,
    at: dict[str, Any] | None = None,
    grid: dict[str, Any] | None = None,
    start: dict[str, Any] | None = None,
    parameters: dict[str, Any] | None = None,
    parameter_set: str | None = None,
    lags: dict[str, Any] | None = None,
    outputs: list[str] | None = None,
    sample_time: Annotated[float, "s"] = 1e-3,
) -> Model:
    """x' = f(x, u) between samplings, at each of them x+ = x- + K (y - h(x-)), K by the stationary Riccati equation.

    `at` gives the inputs of the operating point, where the plant is let settle; where it names states, too, these are
    taken as they are and nothing settles. `grid` gives nodes by input, over which K is interpolated linearly, held
    outside. Arguments as in docs/observers.md.

    Raises ConfigurationError with all that is wrong: arguments, points that do not settle, modes that are not seen.
    """
    found = Complaints()
    given = read_given(
        plant, sensors, noise, process, found,
        parameters=parameters, parameter_set=parameter_set, start=start, lags=lags, outputs=outputs,
    )  # fmt: skip
    model = given.model
    for name, deviation in zip(given.sensors, given.noise, strict=False):
        if deviation == 0.0:
            found.add(f"noise: {name} wants a standard deviation above 0 for a stationary gain")
    if not sample_time > 0.0:
        found.add(f"sample_time wants a value above 0 s, which the gains hold for, got {sample_time:g}")
    axes = _read_axes(grid or {}, given, found)
    values = read_values(at or {}, (*model.inputs, *model.states, *model.discrete), "input or state", found)
    found.end()
    designed = _design(given, axes, values, sample_time, found)
    found.end()
    return _model(given, axes, designed, sample_time)


def _read_axes(grid: Mapping[str, Any], given: Given, found: Complaints) -> list[Axis]:
    known = {signal.name: signal for signal in given.model.inputs if not signal.shape}
    axes = []
    for name, raw in grid.items():
        if name not in known:
            found.add(f"grid: {unknown(name, known, 'input')}")
            continue
        nodes = found.collect(read_list, raw, known[name].unit, f"grid: {name}")
        if nodes is None:
            continue
        if any(b <= a for a, b in itertools.pairwise(nodes)):
            found.add(f"grid: {name} wants its values ascending, got {raw}")
        axes.append(Axis(known[name], np.array(nodes)))
    return axes


def _design(
    given: Given, axes: Sequence[Axis], values: Mapping[str, float], h: float, found: Complaints
) -> list[Stationary]:
    """The filter at rest at each node, the last axis fastest, in the states' and sensors' units."""
    derivatives = jacobians(given.model)
    designed = []
    for nodes in itertools.product(*(axis.nodes for axis in axes)):
        here = {axis.input.name: float(node) for axis, node in zip(axes, nodes, strict=True)}
        try:
            designed.append(_stationary(given, derivatives, _point(given, derivatives, {**values, **here}), h))
        except (ModelError, SteadyError) as error:
            place = ", ".join(f"{axis.input.name} = {here[axis.input.name]:g} {axis.input.unit}" for axis in axes)
            found.add(f"at {place}: {error}" if axes else str(error))
    return designed


def _point(given: Given, derivatives: Jacobians, values: Mapping[str, float]) -> Point:
    """Where the plant settles with these inputs; with states among the values, the point that they name."""
    start = point(given.model, values)
    if any(signal.name in values for signal in given.model.states):
        return start
    return steady_state(derivatives, start).point


def _stationary(given: Given, derivatives: Jacobians, at: Point, h: float) -> Stationary:
    scales, m = given.scales, len(given.sensors)
    linear = derivatives.at(at)
    states = [name for signal in given.model.states for name in signal.scalar_names()]
    found = stationary(
        linear.A * scales / scales[:, None],
        linear.C[-m:] * scales,
        (given.process / scales) ** 2,
        given.noise**2,
        h,
        states,
    )
    return Stationary(
        found.gain * scales[:, None], found.before * np.outer(scales, scales), found.after * np.outer(scales, scales),
        found.innovation_covariance,
    )  # fmt: skip


def weights(axes: Sequence[tuple[Any, Any]]) -> list[Any]:
    """The weights of the nodes for multilinear interpolation, the last axis fastest; held outside of the grid.

    `axes` are pairs of a value and the nodes; of one axis with nodes g the weight of g_k at v is
    min((v - g_{k-1})/(g_k - g_{k-1}), (g_{k+1} - v)/(g_{k+1} - g_k)), not below 0, with v kept within the nodes. For
    floats and symbols alike.
    """
    products: list[Any] = [1.0]
    for value, nodes in axes:
        v = np.minimum(np.maximum(value, nodes[0]), nodes[-1])
        own: list[Any] = []
        for k in range(len(nodes)):
            weight: Any = 1.0
            if k > 0:
                weight = (v - nodes[k - 1]) / (nodes[k] - nodes[k - 1])
            if k + 1 < len(nodes):
                falling = (nodes[k + 1] - v) / (nodes[k + 1] - nodes[k])
                weight = falling if k == 0 else np.minimum(weight, falling)
            own.append(np.maximum(weight, 0.0))
        products = [outer * inner for outer in products for inner in own]
    return products


def _model(given: Given, axes: Sequence[Axis], designed: Sequence[Stationary], sample_time: float) -> Model:
    known, n, m = given.model, len(given.scales), len(given.sensors)
    nodes = len(designed)
    gains = np.array([one.gain for one in designed])
    plant = [name for signal in given.plant_states for name in signal.scalar_names()]
    deviations = np.array([np.sqrt(np.diag(one.after))[: len(plant)] for one in designed])
    expected = np.array([one.innovation_covariance for one in designed])
    units = [difference_unit(signal.unit) for signal in given.measured]
    entries = [(i, j) for i in range(m) for j in range(m)]

    def sample(t: Any, x: Values, m_: Values, u: Values, p: Values) -> dict[str, Any]:
        share = weights([(u[axis.input.name], p[f"grid_{axis.input.name}"]) for axis in axes])
        seen = given.expected(t, x, m_, u, p)
        innovation = [u[measured_name(name)] - seen[name] for name in given.sensors]

        def here(table: Any, *place: int) -> Any:
            return sum(
                (w * table[(k, *place)] for k, w in enumerate(share[1:], 1)), start=share[0] * table[(0, *place)]
            )

        S = [[here(p.innovation_table, i, j) for j in range(m)] for i in range(m)]
        after: dict[str, Any] = {}
        row = 0
        for signal in known.states:
            flat = [
                old + sum(here(p.gain, row + k, j) * innovation[j] for j in range(m))
                for k, old in enumerate(np.ravel(np.asarray(x[signal.name], dtype=object)))
            ]
            row += signal.size
            after[signal.name] = flat[0] if not signal.shape else _shaped(flat, signal.shape)
        row = 0
        for signal in given.plant_states:
            flat = [here(p.deviation_table, row + k) for k in range(signal.size)]
            row += signal.size
            after[f"std_{signal.name}"] = flat[0] if not signal.shape else _shaped(flat, signal.shape)
        after |= {f"innovation_{name}": v for name, v in zip(given.sensors, innovation, strict=True)}
        after |= {f"innovation_covariance[{i + 1},{j + 1}]": S[i][j] for i, j in entries}
        return after | {"nis": _normalised_square(innovation, S)}

    return replace(
        known,
        name="constant_gain",
        description=f"Kalman filter with {'a constant gain' if not axes else 'a scheduled gain'} on {known.name}",
        role="observer",
        equations=given.equations,
        inputs=(*known.inputs, *given.measured),
        outputs=given.outputs,
        discrete=(
            *known.discrete,
            *(
                replace(s, name=f"std_{s.name}", unit=difference_unit(s.unit), minimum=0.0, maximum=np.inf, local=False,
                        start=0.0, description=f"standard deviation of {s.name} at rest")
                for s in given.plant_states
            ),
            *(
                Signal(f"innovation_{name}", unit, 0.0, f"{name}, measured less expected")
                for name, unit in zip(given.sensors, units, strict=True)
            ),
            Signal("nis", "1", 0.0, "innovation squared, normalised by its covariance"),
            *(Signal(f"innovation_covariance[{i + 1},{j + 1}]", product_unit(units[i], units[j])) for i, j in entries),
        ),
        parameters=(
            *known.parameters,
            Signal("sample_time", "s", sample_time, "time from sampling to sampling, which the gains hold for"),
            *(
                replace(a.input, name=f"grid_{a.input.name}", start=a.nodes, shape=(len(a.nodes),), description="nodes")
                for a in axes
            ),
            Signal("gain", "1", gains, "gains by node, state, sensor, in their units", shape=(nodes, n, m)),
            Signal("deviation_table", "1", deviations, "standard deviations at rest", shape=deviations.shape),
            Signal("innovation_table", "1", expected, "covariance of the innovation at rest", shape=(nodes, m, m)),
        ),
        sample=sample,
        sample_time="sample_time",
    )  # fmt: skip


def _shaped(flat: Sequence[Any], shape: tuple[int, ...]) -> Any:
    array = np.empty(len(flat), dtype=object)
    array[:] = flat
    return array.reshape(shape)


def _normalised_square(innovation: Sequence[Any], S: Sequence[Sequence[Any]]) -> Any:
    """v' S^-1 v by S = L D L', for floats and symbols alike."""
    factors: list[list[Any]] = []
    pivots: list[Any] = []
    left: list[Any] = []
    total: Any = 0.0
    for i in range(len(innovation)):
        row: list[Any] = []
        for j in range(i):
            row.append((S[i][j] - sum(row[k] * pivots[k] * factors[j][k] for k in range(j))) / pivots[j])
        factors.append(row)
        pivots.append(S[i][i] - sum(row[k] * row[k] * pivots[k] for k in range(i)))
        left.append(innovation[i] - sum(row[k] * left[k] for k in range(i)))
        total = total + left[i] * left[i] / pivots[i]
    return total
