"""The extended Kalman filter on a plant's model, with whatever sensors it is given."""

from __future__ import annotations

from typing import Annotated, Any

from fmus.model import Model
from observers.filter_model import Array, Instant, Sampled, filter_model, read_shown, read_uncertainty
from observers.given import Complaints, read_given, require_sensors
from observers.kalman import Gaussian, correct, discretise, predict_covariance


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
    sample_time: Annotated[float, "s"] = 1e-3,
) -> Model:
    """The continuous-discrete extended Kalman filter: x' = f(x, u) between samplings, at each of them

        P- = Phi P Phi' + Q,   Phi, Q of the mean of df/dx at the two ends of the interval (kalman.discretise)
        x+ = x- + K (y - h(x-)),   P+ in Joseph's form (kalman.correct).

    The mean is brought along by the FMU's solver, which for a stiff plant is the L-stable RODAS4. Arguments as in
    docs/observers.md. Raises ConfigurationError with all that is wrong with them.
    """
    found = Complaints()
    require_sensors(sensors, found)
    given = read_given(
        plant, sensors, noise, process, found,
        parameters=parameters, parameter_set=parameter_set, start=start, lags=lags, outputs=outputs,
    )  # fmt: skip
    deviations = read_uncertainty(uncertainty, given, found)
    shown = read_shown(covariance or [], given, found)
    found.end()
    description = f"Extended Kalman filter on {given.model.name} with {', '.join(sensors)}"
    return filter_model("ekf", description, given, deviations, shown, _sample, sample_time)


def predict(prior: Array, A_begin: Array, A_end: Array, density: Array, h: float) -> Array:
    """P- (n, n) after h [s], the model linearised by the mean of its Jacobians (n, n) at the two ends.

    For x' = A(t) x the mean is the first term of Magnus' series by the trapezoidal rule: Phi is right up to h^3.
    """
    return predict_covariance(prior, discretise(0.5 * (A_begin + A_end), density, h))


def _sample(instant: Instant) -> Sampled:
    before, now = instant.before, instant.now
    covariance = predict(instant.prior.covariance, instant.A(before), instant.A(now), instant.density, instant.h)
    innovation = instant.measured - instant.expected(now)
    mean = now.x / instant.given.scales
    found = correct(Gaussian(mean, covariance), innovation, instant.C(now), instant.variance)
    return Sampled(found.belief, innovation, found.innovation_covariance)
