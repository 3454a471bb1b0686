"""The stationary Kalman filter of a plant made linear at a point: an observer of deviations in continuous time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_continuous_are, solve_continuous_lyapunov

from fmus.component import Signal
from fmus.jacobians import Linear, Point, jacobians
from fmus.model import Model, ModelError, Values
from fmus.sensing import sensor_name
from fmus.steady import SteadyError
from observers.given import Complaints, Given, measured_name, read_given, read_values
from observers.modes import growing_modes, unseen_by_name
from observers.operating import OperatingPoints
from observers.told import by_signal, scalars

Array = NDArray[np.float64]

# Of the terms of the Riccati equation, how much may be left over.
LEFT_OVER = 1e-7


def make(
    plant: str | Model,
    sensors: list[str],
    noise: dict[str, Any] | str | float,
    process: dict[str, Any] | str | float,
    at: dict[str, Any] | None = None,
    about: dict[str, Any] | None = None,
    start: dict[str, Any] | None = None,
    parameters: dict[str, Any] | None = None,
    parameter_set: str | None = None,
    lags: dict[str, Any] | None = None,
    outputs: list[str] | None = None,
    lasting: Annotated[float, "s"] = 1.0,
) -> Model:
    """dx^' = A dx^ + B du + L (dy - C dx^ - D du), L = X C' R^-1 by the Riccati equation of `gain`.

    Source: Zhang et al., H2 sensor selection and observer design, Front. Mech. Eng. 2021, Eq. 19 and 20. A to D are the
    plant's derivatives at the point `at`, as in constant_gain. Deviations are from there, but of what `about` names,
    states, outputs and inputs, from the values that it gives: those of a reference at the same point, which the model
    rests elsewhere. With no sensors it is the linear model alone. `noise` is the error of a sensor that stays for
    `lasting` [s], so that white noise of the intensity noise^2 lasting stands for it: R.

    Other arguments as in docs/observers.md. Raises ConfigurationError with all that is wrong: arguments, a point that
    does not settle, modes that are neither seen nor die out.
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
    if not lasting > 0.0:
        found.add(f"lasting wants a value above 0 s, got {lasting:g}")
    values = read_values(at or {}, (*model.inputs, *model.states, *model.discrete), "input or state", found)
    shown = (*model.states, *model.inputs, *model.outputs)
    origin = read_values(about or {}, shown, "state, input or output", found)
    begins = read_values(start or {}, model.states, "state", found)
    found.end()
    derivatives = jacobians(model)
    try:
        here = OperatingPoints(derivatives).at(values)
        linear = derivatives.at(here)
        scales, m = given.scales, len(given.sensors)
        scaled = linear.A * scales / scales[:, None], linear.C[linear.C.shape[0] - m :] * scales
        names = [name for signal in model.states for name in signal.scalar_names()]
        L, X = gain(*scaled, (given.process / scales) ** 2, given.noise**2 * lasting, names)
    except (ModelError, SteadyError) as error:
        found.add(str(error))
    found.end()
    return _model(given, linear, here, L * scales[:, None], np.sqrt(np.diag(X)) * scales, origin, begins)


def gain(A: Array, C: Array, density: Array, intensity: Array, states: list[str]) -> tuple[Array, Array]:
    """The gain L (n, m) of the best filter at rest and the covariance X (n, n) of its error:

        A X + X A' - X C' R^-1 C X + diag(`density`) = 0,   L = X C' R^-1,   R = diag(`intensity`)

    for x' = A x + w, y = C x + v with white w of spectral density `density` (n,) and v of `intensity` (m,). Without
    sensors X is that of the model alone. `states` names the states, for messages.

    Raises ModelError: a mode that does not die out is not seen, or there is no stabilising solution.
    """
    unseen = unseen_by_name(A, C, states)
    if unseen:
        raise ModelError(f"not detectable: the sensors do not see {unseen}")
    rows = C / np.sqrt(intensity)[:, None]
    # In units of what the noise makes of each state, where that is bounded, the solver keeps the most digits.
    sizes = np.ones(len(A))
    if not growing_modes(A):
        alone = np.asarray(solve_continuous_lyapunov(A, -np.diag(density)), dtype=np.float64)
        if not len(C):
            return np.zeros((len(A), 0)), alone
        variances = np.diag(alone)
        sizes = np.sqrt(np.where(variances > 0.0, variances, 1.0))
    L, X = _solved(A * sizes / sizes[:, None], rows * sizes, np.diag(density / sizes**2))
    return L * sizes[:, None] / np.sqrt(intensity), X * np.outer(sizes, sizes)


def _solved(A: Array, rows: Array, Q: Array) -> tuple[Array, Array]:
    """L and X for sensors of the intensity 1. Raises ModelError: there is no stabilising solution."""
    try:
        found = np.asarray(solve_continuous_are(A.T, rows.T, Q, np.eye(len(rows))), dtype=np.float64)
    except (np.linalg.LinAlgError, ValueError) as error:
        raise ModelError(f"the Riccati equation has no stabilising solution: {error}") from error
    X = 0.5 * (found + found.T)
    M = rows.T @ rows
    left = A @ X + X @ A.T - X @ M @ X + Q
    if not np.abs(left).max() <= LEFT_OVER * max(np.abs(A @ X).max(), np.abs(Q).max()):
        raise ModelError(f"the Riccati equation is left with {np.abs(left).max():.1e}")
    L = X @ rows.T
    slowest = float(np.linalg.eigvals(A - L @ rows).real.max())
    if not slowest < 0.0:
        raise ModelError(f"with the gain found errors grow by {slowest:.3g} a second")
    return L, X


def _model(
    given: Given,
    linear: Linear,
    here: Point,
    L: Array,
    deviation: Array,
    origin: Mapping[str, float],
    begins: Mapping[str, float],
) -> Model:
    known, m = given.model, len(given.sensors)
    names = [name for signal in known.states for name in signal.scalar_names()]
    x0 = np.array([origin.get(name, v) for name, v in zip(names, here.x, strict=True)])
    u0 = np.array([origin.get(s.name, v) for s, v in zip(known.inputs, here.u, strict=True)])
    # What a sensor shows is what it measures.
    sources = [*(s.name for s in known.outputs[: len(known.outputs) - m]), *given.sensors]
    y0 = np.array([origin.get(name, v) for name, v in zip(sources, linear.y, strict=True)])
    count = len(known.outputs)
    places = {signal.name: i for i, signal in enumerate(known.outputs)}
    spread = by_signal(deviation, known.states)

    def equations(t: Any, x: Values, m_: Values, u: Values, p: Values) -> tuple[dict[str, Any], dict[str, Any]]:
        dx = np.array(scalars(x, known.states)) - p.x_0
        du = np.array(scalars(u, known.inputs)) - p.u_0
        y = p.y_0 + p.C @ dx + p.D @ du
        seen = [u[measured_name(name)] - y[count - m + j] for j, name in enumerate(given.sensors)]
        rates = p.A @ dx + p.B @ du
        if m:
            rates = rates + p.L @ np.array(seen)
        outputs = {signal.name: y[places[signal.name]] for signal in given.outputs}
        outputs |= {f"innovation_{name}": v for name, v in zip(given.sensors, seen, strict=True)}
        return by_signal(rates, known.states), outputs

    def matrix(name: str, value: Array, description: str) -> Signal:
        return Signal(name, "1", value, description, shape=value.shape)

    first = dict(zip(places, y0.tolist(), strict=True))
    return Model(
        name="linear_kalman",
        description=f"Linear Kalman filter on {known.name} with {', '.join(given.sensors) or 'no sensor'}",
        role="observer",
        equations=equations,
        inputs=(
            *(replace(s, start=float(v)) for s, v in zip(known.inputs, u0, strict=True)),
            *(replace(s, start=first[sensor_name(n)]) for s, n in zip(given.measured, given.sensors, strict=True)),
        ),
        states=tuple(
            replace(s, start=begins.get(s.name, v), minimum=-np.inf, maximum=np.inf)
            for s, v in zip(known.states, by_signal(x0, known.states).values(), strict=True)
        ),
        outputs=(
            *(replace(s, start=first[s.name], minimum=-np.inf, maximum=np.inf) for s in given.outputs),
            *(
                replace(s, name=f"innovation_{n}", start=0.0, description=f"{n}, measured less expected")
                for s, n in zip(given.measured, given.sensors, strict=True)
            ),
        ),
        parameters=(
            matrix("A", linear.A, "derivatives by states, in their units"),
            matrix("B", linear.B, "derivatives by inputs"),
            matrix("C", linear.C, "outputs by states, sensors last"),
            matrix("D", linear.D, "outputs by inputs"),
            *([matrix("L", L, "gain by state and sensor")] if m else []),
            matrix("x_0", x0, "states that deviations are from"),
            matrix("u_0", u0, "inputs that deviations are from"),
            matrix("y_0", y0, "outputs that deviations are from"),
            *(
                Signal(f"std_{s.name}", s.unit, spread[s.name], f"expected error of {s.name}", shape=s.shape)
                for s in given.plant_states
            ),
        ),
        solver_method=known.solver_method,
        solver_step=known.solver_step,
        solver_tolerance=known.solver_tolerance,
    )
