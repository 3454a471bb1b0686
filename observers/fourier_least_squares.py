"""The baseline of periodic-input observers: Fourier coefficients of y by least squares, over the system's response.

Recursive least squares with forgetting, which is the Kalman filter of constant coefficients that loses a share of what
it knows by the angle. With phi = (1, 2 cos w0 alpha, -2 sin w0 alpha, ...) and lambda = mu^(delta/T0),

    K = P phi/(lambda + phi' P phi),   theta+ = theta + K (y - phi' theta),   P+ = (P - K phi' P)/lambda,

theta = (c_0, Re c_1, Im c_1, ...) of y. Those of w are theirs over C (i k w0 - A)^-1 A0 at the present speed. What y
does beside repeating, the plant's own free response, is error to it; a time-varying speed changes y's coefficients,
which an observer of w sees through. In return it begins with all the gain that the first samples allow.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from fmus.component import Signal
from fmus.model import Model, Values
from observers.given import Complaints, read_list, read_quantity
from observers.periodic import PeriodicSystem, internal_model, responses, summed
from observers.periodic_design import FASTEST, SLOWEST, moving_gain
from observers.periodic_input import read_system, told
from observers.periodic_response import Pair, check_resolved, product, resolver, turns_of
from observers.periodic_settings import Setting, read_choice, read_number, read_setting, require_seen
from observers.periodic_told import told_signals, told_values

Array = NDArray[np.float64]

# Variance of each coefficient before the first sample, of one of the noise: it knows nothing.
UNKNOWN = 1e6


def make(
    multiplier: float,
    time_constants: Any = None,
    A: Any = None,
    A0: Any = None,
    C: Any = None,
    per: str = "s",
    period: str = "720 deg",
    harmonics: int = 3,
    step: str = "6 deg",
    speed: Any = "[600, 6000] rpm",
    delay: str = "0 s",
    unit: str = "1",
) -> Model:
    """Least squares that forget all but the share `multiplier` of what they knew over a period.

    The system is a row of lags with `time_constants`, from w to the sensor, or A (n, n), A0 (n, 1), C (1, n) `per` s or
    rad. The other arguments, the inputs and the outputs are those of observers.lag_inversion, without states.

    Raises ConfigurationError with all that is wrong.
    """
    found = Complaints()
    setting = read_setting(period, harmonics, step, speed, 3, found)
    mu = read_number(multiplier, "multiplier", found, 0.0)
    if not FASTEST <= mu <= SLOWEST:
        found.add(f"multiplier wants a value from {FASTEST:g} to {SLOWEST:g} a period, got {multiplier}")
    waits = found.collect(read_quantity, delay, "s", "delay")
    word = read_choice(per, "per", ("s", "rad"), found)
    if (time_constants is None) == (A is None and A0 is None and C is None):
        found.add("wants time_constants, or A, A0 and C")
        found.end()
    if time_constants is not None:
        taus = found.collect(read_list, time_constants, "s", "time_constants") or []
        if not taus or min(taus) <= 0.0:
            found.add(f"time_constants wants times above 0 s, like [25, 20] ms; got {time_constants}")
            found.end()
        system = lag_row(np.array(taus), setting)
    else:
        system = read_system(A, A0, C, setting, word, found)
    found.end()
    if system.A0.shape[1] != 1 or len(system.C) != 1:
        found.add(f"wants one input and one output, got A0 with {system.A0.shape[1]} and C with {len(system.C)}")
        found.end()
    ends = sorted({setting.low, setting.high})
    require_seen(system, ends, "fourier_least_squares", told, found)
    found.end()
    found.collect(check_resolved, system, ends)
    found.end()
    assert waits is not None, "complaints were none"
    return _model(system, setting, mu, waits, unit)


def lag_row(taus: Array, setting: Setting) -> PeriodicSystem:
    """Lags in a row, the first driven by w and the last shown."""
    A = np.diag(-1.0 / taus) + np.diag(1.0 / taus[1:], -1)
    A0, C = np.zeros((len(taus), 1)), np.zeros((1, len(taus)))
    A0[0, 0], C[0, -1] = 1.0 / taus[0], 1.0
    return PeriodicSystem(A, A0, C, setting.period, setting.harmonics)


def noise_gain(system: PeriodicSystem, setting: Setting, multiplier: float) -> float:
    """Largest variance of w by that of white noise on y, stationary, over the nodes of the speed."""
    n, worst = len(system.A), 0.0
    for omega in setting.speeds:
        step = setting.sampling.angle(omega)
        turned = expm(internal_model(system, omega)[n:, n:] * step)
        row = np.array([[1.0] + [2.0, 0.0] * system.harmonics])
        K = moving_gain(turned, row, float(np.sqrt(multiplier ** (step / system.period))), omega)
        moved = (np.eye(len(turned)) - K @ row) @ turned
        inverse = 1.0 / (system.C @ responses(system, omega))[:, 0, 0]
        shown = np.array([1.0 * inverse[0].real, *(v for g in inverse[1:] for v in (2.0 * g.real, -2.0 * g.imag))])
        worst = max(worst, float(shown @ summed(moved, K @ K.T) @ shown))
    return worst


def _model(system: PeriodicSystem, setting: Setting, multiplier: float, delay: float, unit: str) -> Model:
    h = setting.harmonics
    size = 2 * h + 1
    resolve = resolver(system)
    upper = [(i, j) for i in range(size) for j in range(i, size)]
    place = {pair: number for number, pair in enumerate(upper)}
    w = (Signal("w", unit, 0.0, "what drives the system"),)

    def sample(t: Any, x: Values, m: Values, u: Values, p: Values) -> dict[str, Any]:
        first = m.begun < 0.5
        before = np.where(first, u.angle, m.angle_before)
        delta = np.maximum(u.angle - before, 0.0) * (math.pi / 180.0)
        omega = np.minimum(np.maximum(u.omega, p.omega_low), p.omega_high)
        turning = turns_of(system.order * u.angle * (math.pi / 180.0), h)
        kept = np.exp(np.log(p.forgetting) * delta / system.period)
        phi: list[Any] = [1.0]
        for cosine, sine in turning[1:]:
            phi += [2.0 * cosine, -2.0 * sine]
        P = [[m.covariance[place[min(i, j), max(i, j)]] for j in range(size)] for i in range(size)]
        seen = [sum(P[i][j] * phi[j] for j in range(size)) for i in range(size)]
        total = kept + sum(a * b for a, b in zip(phi, seen, strict=True))
        innovation = u.y - sum(m.coefficients[i] * phi[i] for i in range(size))
        theta = [m.coefficients[i] + seen[i] / total * innovation for i in range(size)]
        covariance = [(P[i][j] - seen[i] * seen[j] / total) / kept for i, j in upper]
        X = resolve(omega)
        shift = turns_of(system.order * omega * p.delay, h)
        found: list[list[Pair]] = []
        for k in range(h + 1):
            of_y = (theta[0], 0.0) if k == 0 else (theta[2 * k - 1], theta[2 * k])
            re, im = _response(system.C[0], X[k])
            power = re * re + im * im
            found.append([product(product(of_y, (re / power, -im / power)), shift[k])])
        return {
            "angle_before": u.angle,
            "begun": 1.0,
            "coefficients": _array(theta),
            "covariance": _array(covariance),
            "innovation": innovation,
            **told_values(w, found, turning),
        }

    start = [UNKNOWN if i == j else 0.0 for i, j in upper]
    return Model(
        name="fourier_least_squares",
        description=f"Recursive least squares of {h} harmonics, over the response of {len(system.A)} states",
        role="observer",
        equations=lambda t, x, m, u, p: ({}, {}),
        inputs=(
            Signal("y", unit, 0.0, "what the system shows"),
            Signal("angle", "deg", 0.0, "crank angle, counted on"),
            Signal("omega", "rad/s", math.sqrt(setting.low * setting.high), "speed of the crankshaft", setting.high),
        ),
        discrete=(
            *told_signals(w, [0.0], h),
            Signal("innovation", unit, 0.0, "y, measured less expected"),
            Signal("multiplier", "1", multiplier, "share of what it knew that is left after a period"),
            Signal(
                "variance_gain", "1", noise_gain(system, setting, multiplier), "variance of w by that of noise on y"
            ),
            Signal("angle_before", "deg", 0.0, "angle at the last sampling", local=True),
            Signal("begun", "1", 0.0, "1 after the first sampling", local=True),
            Signal("coefficients", "1", 0.0, "coefficients of y", shape=(size,), local=True),
            Signal("covariance", "1", start, "upper half of P", shape=(len(upper),), local=True),
        ),
        parameters=(
            Signal("sample_time", "s", 0.0, "0: each step of the part"),
            Signal("forgetting", "1", multiplier, "share of what it knew that is left after a period"),
            Signal("delay", "s", delay, "transport from w to what drives the system"),
            Signal("omega_low", "rad/s", setting.low, "lowest speed it was made for; slower counts as that"),
            Signal("omega_high", "rad/s", setting.high, "highest speed it was made for; faster counts as that"),
        ),
        sample=sample,
        sample_time="sample_time",
    )


def _response(row: Array, X: Any) -> Pair:
    """C X_k as a pair."""
    re: Any = 0.0
    im: Any = 0.0
    for c, ((a, b),) in zip(row.tolist(), X, strict=True):
        if c != 0.0:
            re, im = re + c * a, im + c * b
    return re, im


def _array(values: list[Any]) -> Any:
    array = np.empty(len(values), dtype=object)
    array[:] = values
    return array.astype(float) if all(isinstance(value, (int, float)) for value in values) else array
