"""A Kalman filter with a gain made beforehand: that of one operating point, or interpolated over a grid of them."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Annotated, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fmus.component import Signal
from fmus.jacobians import Jacobians, Point, jacobians
from fmus.model import Model, ModelError, Values, unknown
from fmus.sensing import sensor_name
from fmus.steady import SteadyError
from observers.given import Complaints, Given, measured_name, read_given, read_list, read_values, require_sensors
from observers.operating import OperatingPoints, Sought
from observers.stationary import Stationary, stationary
from observers.told import (
    INNOVATION_COVARIANCE,
    by_signal,
    deviation_signals,
    innovation_signals,
    matrix_values,
    scalars,
)

Array = NDArray[np.float64]


class Axis(NamedTuple):
    """One axis of a grid: what it is called, the input of the observer it is read from, and the nodes, ascending.

    An axis along a measured signal has `by`, the plant's input that is set so that the signal settles at a node.
    """

    name: str
    input: Signal
    nodes: Array
    by: Signal | None = None


def make(
    plant: str | Model,
    sensors: list[str],
    noise: dict[str, Any] | str | float,
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
    taken as they are and nothing settles. `grid` gives nodes by input, over which K is interpolated linearly and held
    outside; or by sensor, as `{values: [...], by: input}`. Arguments as in docs/observers.md.

    Raises ConfigurationError with all that is wrong: arguments, points that do not settle, modes that are not seen.
    """
    found = Complaints()
    require_sensors(sensors, found)
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
    inputs = {signal.name: signal for signal in given.model.inputs if not signal.shape}
    measured = dict(zip(given.sensors, given.measured, strict=True))
    axes = []
    for name, raw in grid.items():
        signal, by = inputs.get(name) or measured.get(name), None
        if signal is None:
            found.add(f"grid: {unknown(name, [*inputs, *measured], 'input or sensor')}")
            continue
        if name in measured:
            if not isinstance(raw, Mapping) or set(raw) != {"values", "by"}:
                told = f"`{name}: {{values: [...], by: input}}`, by which input the plant is brought there"
                found.add(f"grid: {name} is measured and wants {told}")
                continue
            by = inputs.get(str(raw["by"]))
            if by is None:
                found.add(f"grid: {name}: {unknown(str(raw['by']), inputs, 'input')}")
                continue
            raw = raw["values"]
        nodes = found.collect(read_list, raw, signal.unit, f"grid: {name}")
        if nodes is not None and any(b <= a for a, b in itertools.pairwise(nodes)):
            found.add(f"grid: {name} wants its values ascending, got {raw}")
        axes.append(Axis(name, signal, np.array(nodes or []), by))
    moved = [axis.by.name if axis.by else axis.name for axis in axes]
    if len(set(moved)) < len(moved):
        found.add(f"grid: each axis wants an input of its own, got {', '.join(moved)}")
    if sum(axis.by is not None for axis in axes) > 1:
        found.add("grid: one axis at most may be a measured signal")
    return axes


def _design(
    given: Given, axes: Sequence[Axis], values: Mapping[str, float], h: float, found: Complaints
) -> list[Stationary]:
    """The filter at rest at each node, the last axis fastest, in the states' and sensors' units."""
    derivatives = jacobians(given.model)
    points = OperatingPoints(derivatives)
    designed = []
    for nodes in itertools.product(*(axis.nodes.tolist() for axis in axes)):
        here, sought = dict(values), None
        for axis, node in zip(axes, nodes, strict=True):
            if axis.by is None:
                here[axis.name] = node
            else:
                sought = Sought(axis.by, sensor_name(axis.name), node)
        try:
            designed.append(_stationary(given, derivatives, points.at(here, sought), h))
        except (ModelError, SteadyError) as error:
            place = ", ".join(f"{a.name} = {node:g} {a.input.unit}" for a, node in zip(axes, nodes, strict=True))
            found.add(f"at {place}: {error}" if axes else str(error))
    return designed


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
    known, m = given.model, len(given.sensors)
    gains = np.array([one.gain for one in designed])
    count = sum(signal.size for signal in given.plant_states)
    deviations = np.array([np.sqrt(np.diag(one.after))[:count] for one in designed])
    expected = np.array([one.innovation_covariance for one in designed])

    def sample(t: Any, x: Values, m_: Values, u: Values, p: Values) -> dict[str, Any]:
        share = weights([(u[axis.input.name], p[f"grid_{axis.name}"]) for axis in axes])

        def here(table: Any, *place: int) -> Any:
            return sum(w * table[(k, *place)] for k, w in enumerate(share))

        seen = given.expected(t, x, m_, u, p)
        innovation = [u[measured_name(name)] - seen[name] for name in given.sensors]
        S = [[here(p.innovation_table, i, j) for j in range(m)] for i in range(m)]
        moved = [
            old + sum(here(p.gain_table, i, j) * innovation[j] for j in range(m))
            for i, old in enumerate(scalars(x, known.states))
        ]
        return {
            **by_signal(moved, known.states),
            **by_signal([here(p.deviation_table, i) for i in range(count)], given.plant_states, "std_"),
            **{f"innovation_{name}": v for name, v in zip(given.sensors, innovation, strict=True)},
            "nis": _normalised_square(innovation, S),
            **matrix_values(INNOVATION_COVARIANCE, S),
        }

    return replace(
        known,
        name="constant_gain",
        description=f"Kalman filter with {'a scheduled' if axes else 'a constant'} gain on {known.name}",
        role="observer",
        equations=given.equations,
        inputs=(*known.inputs, *given.measured),
        outputs=given.outputs,
        discrete=(*known.discrete, *deviation_signals(given, deviations[0]), *innovation_signals(given, expected[0])),
        parameters=(
            *known.parameters,
            Signal("sample_time", "s", sample_time, "time from sampling to sampling, which the gains hold for"),
            *(Signal(f"grid_{a.name}", a.input.unit, a.nodes, "nodes", shape=a.nodes.shape) for a in axes),
            Signal("gain_table", "1", gains, "gains by node, state, sensor, in their units", shape=gains.shape),
            Signal("deviation_table", "1", deviations, "deviations at rest by node, state", shape=deviations.shape),
            Signal("innovation_table", "1", expected, "innovation covariance at rest by node", shape=expected.shape),
        ),
        sample=sample,
        sample_time="sample_time",
    )


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
