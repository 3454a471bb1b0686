"""The unscented Kalman filter on a plant's model, with whatever sensors it is given."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any, NamedTuple

import numpy as np
from scipy.integrate import solve_ivp

from fmus.component import Signal
from fmus.model import Model, ModelError
from observers.filter_model import Array, Instant, Sampled, filter_model, read_shown, read_uncertainty
from observers.given import Complaints, read_given, require_sensors
from observers.kalman import NEGLIGIBLE, Gaussian, discretise, solve_gain

# Of the twin's integration, relative and in nominal values: far below what the FMU's solver is asked for.
TWIN_TOLERANCE = 1e-11


def make(
    plant: str | Model,
    sensors: list[str],
    noise: dict[str, Any] | str | float,
    process: dict[str, Any] | str | float,
    uncertainty: dict[str, Any] | str | float,
    start: dict[str, Any] | None = None,
    parameters: dict[str, Any] | None = None,
    parameter_set: str | None = None,
    lags: dict[str, Any] | None = None,
    outputs: list[str] | None = None,
    covariance: list[str] | None = None,
    spread: float = 3.0**0.5,
    sample_time: Annotated[float, "s"] = 1e-3,
) -> Model:
    """The continuous-discrete unscented Kalman filter with 2n + 1 points, each brought along by the FMU's own solver.

    `spread` c is how many standard deviations the points lie away; weights and equations as in `predict` and `correct`.
    Arguments as in docs/observers.md. Raises ConfigurationError with all that is wrong with them.
    """
    found = Complaints()
    require_sensors(sensors, found)
    given = read_given(
        plant, sensors, noise, process, found,
        parameters=parameters, parameter_set=parameter_set, start=start, lags=lags, outputs=outputs,
    )  # fmt: skip
    deviations = read_uncertainty(uncertainty, given, found)
    shown = read_shown(covariance or [], given, found)
    if not spread > 0.0:
        found.add(f"spread wants a number above 0, got {spread:g}")
    found.end()
    description = f"Unscented Kalman filter on {given.model.name} with {', '.join(sensors)}"
    far = Signal("spread", "1", spread, "distance of the sigma points, in standard deviations", minimum=1e-6)
    return filter_model("ukf", description, given, deviations, shown, _sample, sample_time, [far])


class Unscented(NamedTuple):
    """The belief after a measurement, the innovation (m,) and the covariance (m, m) it was given."""

    belief: Gaussian
    innovation: Array
    innovation_covariance: Array


def sigma_offsets(covariance: Array, spread: float) -> Array:
    """The 2n points around the mean: +c and -c times the columns of L, P = L L', shape (2n, n)."""
    root = covariance_root(covariance).T
    return spread * np.vstack([root, -root])


def predict(central: Array, points: Array, noise: Array, spread: float) -> Gaussian:
    """The belief from where the mean came to, `central` (n,), and where the 2n points did, (2n, n).

    With weights w = 1/(2 c^2) of the points, 1 - n/c^2 of the centre, and d_i the points less the centre:

        x- = centre + w sum d_i,   P- = w sum d_i d_i' + Q

    The mean is that of Julier and Uhlmann (Proc. IEEE 92(3), 2004, Eq. 12, n + kappa = c^2). The covariance is taken
    about the centre, as they propose there for a negative kappa: it is positive semidefinite with every c, at the price
    of (x- - centre)(x- - centre)' too much. At c^2 = 3, which gives Gaussian fourth moments along each axis, kappa is
    negative from four states on.
    """
    offsets = points - central
    w = 0.5 / spread**2
    return Gaussian(central + w * offsets.sum(axis=0), w * offsets.T @ offsets + noise)


def correct(prior: Gaussian, measure: Callable[[Array], Array], y: Array, variance: Array, spread: float) -> Unscented:
    """The belief after y = h(x) + v, v of variance `variance` (m,), from points drawn anew; `measure` is h.

    With d_i the offsets of the points, e_i = h(x + d_i) - h(x) and w as in `predict`:

        y- = h(x) + w sum e_i,   S = w sum e_i e_i' + R,   K = w sum d_i e_i' S^-1,   x+ = x + K (y - y-)
        P+ = w sum (d_i - K e_i)(d_i - K e_i)' + K R K'

    The last equals P - K S K' and is positive semidefinite whatever rounding did. Raises SingularInnovation.
    """
    offsets = sigma_offsets(prior.covariance, spread)
    w = 0.5 / spread**2
    expected = measure(prior.mean)
    seen = np.array([measure(prior.mean + offset) - expected for offset in offsets])
    innovation = y - expected - w * seen.sum(axis=0)
    S = w * seen.T @ seen + np.diag(variance)
    gain = solve_gain(w * offsets.T @ seen, S)
    left = offsets - seen @ gain.T
    covariance = w * left.T @ left + gain * variance @ gain.T
    return Unscented(Gaussian(prior.mean + gain @ innovation, covariance), innovation, S)


def covariance_root(covariance: Array) -> Array:
    """L (n, n) lower triangular, P = L L', of a positive semidefinite P: where a pivot is zero but for rounding, so is
    its column. Raises ModelError: P is not."""
    n = len(covariance)
    L = np.zeros((n, n))
    for j in range(n):
        pivot = covariance[j, j] - L[j, :j] @ L[j, :j]
        rounding = NEGLIGIBLE * covariance[j, j]
        if not pivot >= -rounding:
            raise ModelError(f"the covariance is not positive semidefinite, at state {j + 1}")
        if pivot > rounding:
            L[j, j] = np.sqrt(pivot)
            L[j + 1 :, j] = (covariance[j + 1 :, j] - L[j + 1 :, :j] @ L[j, :j]) / L[j, j]
    return L


def _sample(instant: Instant) -> Sampled:
    prior, spread, scales = instant.prior, float(instant.p.spread), instant.given.scales
    A = 0.5 * (instant.A(instant.before) + instant.A(instant.now))
    noise = discretise(A, instant.density, instant.h).noise
    points = np.array([_flow(instant, prior.mean + d) for d in sigma_offsets(prior.covariance, spread)])
    predicted = predict(instant.now.x / scales, points, noise, spread)
    found = correct(predicted, lambda z: instant.expected(instant.at(z)), instant.measured, instant.variance, spread)
    return Sampled(*found)


def _flow(instant: Instant, z: Array) -> Array:
    """Where the model goes from z over the interval. Raises ModelError: it has events, which only the FMU locates."""
    model, scales = instant.given.model, instant.given.scales
    if model.indicator_names:
        raise ModelError(f"{model.name} has events: its unscented filter runs as an FMU only")

    def at(t: float, z: Array) -> Any:
        return instant.now._replace(x=z * scales, t=t)

    run = solve_ivp(
        lambda t, z: instant.jacobians.values(at(t, z))[0] / scales,
        (instant.before.t, instant.now.t), z, method="Radau", rtol=TWIN_TOLERANCE, atol=TWIN_TOLERANCE,
        jac=lambda t, z: instant.jacobians.at(at(t, z)).A * scales / scales[:, None],
    )  # fmt: skip
    return np.asarray(run.y[:, -1])
