"""Filters on a plant's model as FMUs: equal to textbooks, to their source and to their own statistics."""

from __future__ import annotations

import json

import numpy as np
import pytest
from filtered import CART, SPRING, SPRING_A, SPRING_C, TANKS, Filter, TwinFilter
from fmpy.validation import validate_fmu
from models import BLOW_UP
from scipy.integrate import solve_ivp
from scipy.linalg import expm, solve_discrete_are
from scipy.stats import chi2

from fmus.component import ConfigurationError, Signal, StepError
from fmus.export import cached_fmu
from fmus.jacobians import Point, jacobians
from fmus.model import Model
from fmus.plants.driveline import MODEL as DRIVELINE
from fmus.tracing import trace
from harness.campaign import read_campaign
from harness.cases import execute
from observers import constant_gain, ekf, model_alone, ukf

H = 0.1
START = {"x": "0.3 m", "v": "-0.1 m/s", "d": "0.05 m/s2"}
X0 = np.array([0.3, -0.1, 0.05])
DEVIATION = np.array([0.2, 0.3, 0.1])
STRAYS = np.array([0.0, 0.3, 0.05])
NOISE = np.array([0.2, 0.1])
SETTING = {
    "plant": SPRING,
    "sensors": ["x", "gauge"],
    "noise": {"x": "0.2 m", "gauge": "0.1 m/s"},
    "process": {"x": "0 m", "v": "30 cm/s", "d": "0.05 m/s2"},
    "start": START,
    "sample_time": H,
}
UNCERTAIN = {"uncertainty": {"x": "20 cm", "v": "0.3 m/s", "d": "0.1 m/s2"}, "covariance": ["x", "v", "d"]}
FILTERS = {"ekf": ekf, "ukf": ukf}


def van_loan(h: float = H) -> tuple[np.ndarray, np.ndarray]:
    block = np.zeros((6, 6))
    block[:3, :3], block[:3, 3:], block[3:, 3:] = -SPRING_A, np.diag(STRAYS**2), SPRING_A.T
    found = expm(block * h)
    return found[3:, 3:].T, found[3:, 3:].T @ found[:3, 3:]


PHI, Q = van_loan()
R = np.diag(NOISE**2)


class Textbook:
    """The Kalman filter of SPRING with the push held at zero, in the short form with inverses."""

    def __init__(self) -> None:
        self.x, self.P = X0, np.diag(DEVIATION**2)

    def __call__(self, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        x, P = PHI @ self.x, PHI @ self.P @ PHI.T + Q
        S = SPRING_C @ P @ SPRING_C.T + R
        K = P @ SPRING_C.T @ np.linalg.inv(S)
        v = y - SPRING_C @ x
        self.x, self.P = x + K @ v, P - K @ SPRING_C @ P
        return v, S


def truth(generator: np.random.Generator, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """States and measurements of a linear-Gaussian run of SPRING, (steps, 3) and (steps, 2)."""
    x = X0 + DEVIATION * generator.normal(size=3)
    root = np.linalg.cholesky(Q + 1e-18 * np.eye(3))
    states, seen = [], []
    for _ in range(steps):
        x = PHI @ x + root @ generator.normal(size=3)
        states.append(x)
        seen.append(SPRING_C @ x + NOISE * generator.normal(size=2))
    return np.array(states), np.array(seen)


def means(row: dict[str, float]) -> np.ndarray:
    return np.array([row[name] for name in "xvd"])


def covariance(row: dict[str, float]) -> np.ndarray:
    return np.array([[row[f"covariance[{i},{j}]"] for j in (1, 2, 3)] for i in (1, 2, 3)])


@pytest.mark.parametrize("name", FILTERS)
def test_on_a_linear_model_a_filter_is_the_textbooks(name):
    model = FILTERS[name].make(**SETTING, **UNCERTAIN)
    estimator, textbook = Filter(model, H), Textbook()
    _, seen = truth(np.random.default_rng(11), 80)
    for y in seen:
        row = estimator(x_measured=y[0], gauge_measured=y[1])
        v, S = textbook(y)
        # RK4 at 1 ms is right to 1e-13 a step; the rest is the order of sums, over 80 steps of a filter that forgets.
        np.testing.assert_allclose(means(row), textbook.x, rtol=1e-9, atol=1e-10)
        np.testing.assert_allclose(covariance(row), textbook.P, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose([row[f"std_{s}"] for s in "xvd"], np.sqrt(np.diag(textbook.P)), rtol=1e-9)
        np.testing.assert_allclose([row["innovation_x"], row["innovation_gauge"]], v, rtol=1e-8, atol=1e-9)
        np.testing.assert_allclose([row[f"innovation_covariance[{i},2]"] for i in (1, 2)], S[:, 1], rtol=1e-9)
        assert row["nis"] == pytest.approx(v @ np.linalg.inv(S) @ v, rel=1e-7, abs=1e-12)
        # The plant's own output functions on the estimate.
        assert row["gauge"] == row["v"] + 0.5 * row["d"] and row["energy"] == 0.5 * row["v"] ** 2
    estimator.component.close()


def test_on_a_linear_model_the_constant_gain_is_where_the_other_filters_come_to():
    before = solve_discrete_are(PHI.T, SPRING_C.T, Q, R)
    S = SPRING_C @ before @ SPRING_C.T + R
    K = before @ SPRING_C.T @ np.linalg.inv(S)
    model = constant_gain.make(**SETTING)
    table = {signal.name: np.array(signal.start) for signal in model.parameters}
    np.testing.assert_allclose(table["gain_table"][0], K, rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(table["deviation_table"][0], np.sqrt(np.diag(before - K @ SPRING_C @ before)), rtol=1e-8)
    estimator, x = Filter(model, H), X0
    textbook = Textbook()
    _, seen = truth(np.random.default_rng(12), 400)
    for y in seen:
        row = estimator(x_measured=y[0], gauge_measured=y[1])
        prior = PHI @ x
        v = y - SPRING_C @ prior
        x = prior + K @ v
        textbook(y)
        np.testing.assert_allclose(means(row), x, rtol=1e-8, atol=1e-9)
        assert row["nis"] == pytest.approx(v @ np.linalg.inv(S) @ v, rel=1e-7, abs=1e-12)
    # After forty seconds, four time constants of the slowest error, the time-varying filter is there.
    np.testing.assert_allclose(means(row), textbook.x, rtol=1e-3, atol=1e-5)
    assert row["std_d"] == pytest.approx(np.sqrt(textbook.P[2, 2]), rel=1e-4)
    estimator.component.close()


RUNS, STEPS = 60, 40


def statistics(name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """NEES (runs, steps), NIS (runs, steps) and whitened innovations (runs, steps, 2)."""
    estimator = Filter(FILTERS[name].make(**SETTING, **UNCERTAIN), H)
    nees, nis, white = (np.zeros((RUNS, STEPS)), np.zeros((RUNS, STEPS)), np.zeros((RUNS, STEPS, 2)))
    for run in range(RUNS):
        states, seen = truth(np.random.default_rng([5, run]), STEPS)
        estimator.start()
        for k, (x, y) in enumerate(zip(states, seen, strict=True)):
            row = estimator(x_measured=y[0], gauge_measured=y[1])
            error = means(row) - x
            nees[run, k], nis[run, k] = error @ np.linalg.solve(covariance(row), error), row["nis"]
            S = [[row[f"innovation_covariance[{i},{j}]"] for j in (1, 2)] for i in (1, 2)]
            white[run, k] = np.linalg.solve(np.linalg.cholesky(S), [row["innovation_x"], row["innovation_gauge"]])
    estimator.component.close()
    return nees, nis, white


@pytest.mark.parametrize("name", FILTERS)
def test_errors_and_innovations_are_as_large_as_the_filter_says_and_innovations_are_white(name):
    nees, nis, white = statistics(name)

    def inside(squares: np.ndarray, freedom: int) -> bool:
        # Between the quantiles of 0.05 % and 99.95 %: a filter that is right fails once in a thousand seeds.
        low, high = chi2.ppf([5e-4, 1 - 5e-4], freedom * squares.size) / squares.size
        return bool(low < squares.mean() < high)

    for k in (0, 5, 20, STEPS - 1):  # independent between runs, not along one
        assert inside(nees[:, k], 3), k
    assert inside(nis, 2)
    for lag in range(1, 6):
        pairs = white[:, lag:] * white[:, :-lag]
        # Products of independent standard normals: mean 0, variance 1.
        assert np.all(np.abs(pairs.mean(axis=(0, 1))) < 3.9 / np.sqrt(pairs[..., 0].size)), lag


def test_a_filter_that_believes_a_noise_ten_times_too_small_is_found_out():
    # The bounds above are tight enough to see it.
    model = ekf.make(**{**SETTING, "noise": {"x": "2 cm", "gauge": "1 cm/s"}}, **UNCERTAIN)
    estimator = Filter(model, H)
    _, seen = truth(np.random.default_rng(7), STEPS)
    nis = [estimator(x_measured=y[0], gauge_measured=y[1])["nis"] for y in seen]
    assert np.mean(nis) > chi2.ppf(0.9999, 2 * STEPS) / STEPS
    estimator.component.close()


def flow_of(model: Model, plant: Model, parameters: int):
    """The plant's states over a step by scipy; a time since the last sampling grows by itself."""
    derivatives = jacobians(plant)
    n = sum(signal.size for signal in plant.states)
    p = np.concatenate([signal.scalar_starts() for signal in model.parameters])[:parameters]
    u_size = len(plant.inputs)

    def flow(x, u, h):
        run = solve_ivp(
            lambda t, z: derivatives.values(Point(z, np.zeros(0), np.array(u[:u_size]), p))[0],
            (0.0, h), x[:n], method="Radau", rtol=1e-12, atol=1e-14,
        )  # fmt: skip
        return np.concatenate([run.y[:, -1], x[n:] + h])

    return flow


TANK_SETTING = {
    "plant": TANKS,
    "sensors": ["outflow", "lower"],
    "noise": {"outflow": "2 mm/s", "lower": "2 cm"},
    "process": "1 %",
    "start": {"upper": "0.6 m"},
    "outputs": ["outflow"],
}


@pytest.mark.parametrize("sample_time", [0.5, 0.0])
@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.parametrize("name", FILTERS)
def test_a_filters_fmu_is_its_python_source(name, fmi, sample_time):
    setting = {**TANK_SETTING, "uncertainty": "30 %", "covariance": ["lower", "upper"], "sample_time": sample_time}
    model = FILTERS[name].make(**setting)
    estimator, twin = Filter(model, 0.5, fmi), TwinFilter(model, 0.5, flow_of(model, TANKS, 1))
    generator = np.random.default_rng(3)
    for k in range(30):
        seen = {
            "q": 0.1 + 0.05 * np.sin(k),
            "outflow_measured": 0.09 + 0.002 * generator.normal(),
            "lower_measured": 0.9 + 0.02 * generator.normal(),
        }
        row, wanted = estimator(**seen), twin(**seen)
        for key, value in row.items():
            if key != "outflow":
                # RK4 in steps of 1 ms against Radau at 1e-12.
                assert value == pytest.approx(wanted[key], rel=1e-8, abs=1e-10), (k, key)
    estimator.component.close()


def test_the_constant_gains_fmu_is_its_python_source_bit_for_bit():
    grid = {"lower": {"values": "[20, 100, 200] cm", "by": "q"}}
    model = constant_gain.make(**TANK_SETTING, grid=grid, sample_time=0.5)
    sample, flat = trace(model).sample, TwinFilter(model, 0.5, lambda x, u, h: x)
    generator = np.random.default_rng(4)
    for _ in range(20):
        seen = {"q": 0.1, "outflow_measured": generator.uniform(), "lower_measured": generator.uniform(0.0, 1.5)}
        u = [seen[signal.name] for signal in model.inputs]
        x, m = sample(0.5, flat.x, flat.m, u, flat.p)
        row = flat(**seen)
        np.testing.assert_array_equal(np.concatenate([x.full().ravel(), m.full().ravel()]), list(row.values()))


@pytest.mark.parametrize("name", FILTERS)
def test_a_filter_that_samples_at_each_step_is_one_of_that_sample_time(name):
    setting = {**SETTING, **UNCERTAIN}
    timed = Filter(FILTERS[name].make(**setting), H)
    stepped = Filter(FILTERS[name].make(**{**setting, "sample_time": 0.0}), H)
    _, seen = truth(np.random.default_rng(9), 20)
    for y in seen:
        row = timed(x_measured=y[0], gauge_measured=y[1])
        other = stepped(x_measured=y[0], gauge_measured=y[1])
        # The time since the last sampling is integrated: a rounding away from the step.
        assert other == pytest.approx(row, rel=1e-11, abs=1e-13)
    timed.component.close()
    stepped.component.close()


@pytest.mark.parametrize("name", FILTERS)
def test_a_filter_that_samples_at_each_step_takes_steps_of_any_length(name):
    component = Filter(FILTERS[name].make(**{**SETTING, **UNCERTAIN, "sample_time": 0.0}), H).component
    outputs = [signal.name for signal in component.outputs]
    x, P, t = X0, np.diag(DEVIATION**2), 0.0
    component.start(0.0, np.zeros(3))
    generator = np.random.default_rng(13)
    for h in (0.1, 0.02, 0.3, 0.1, 0.05):
        y = generator.normal(size=2)
        row = dict(zip(outputs, component.step(t, h, np.array([0.0, *y])), strict=True))
        t += h
        transition, noise = van_loan(h)
        x, P = transition @ x, transition @ P @ transition.T + noise
        S = SPRING_C @ P @ SPRING_C.T + R
        K = P @ SPRING_C.T @ np.linalg.inv(S)
        x, P = x + K @ (y - SPRING_C @ x), P - K @ SPRING_C @ P
        np.testing.assert_allclose(means(row), x, rtol=1e-9, atol=1e-10)
        np.testing.assert_allclose(covariance(row), P, rtol=1e-9, atol=1e-12)
    component.close()


def test_a_model_with_arrays_is_filtered_as_the_same_one_in_scalars():
    paired = Model(
        name="paired",
        description="SPRING with its first two states as an array",
        equations=lambda t, x, m, u, p: (
            {"s": np.array([x.s[1], -4.0 * x.s[0] - 0.5 * x.s[1] + x.d]), "d": -0.1 * x.d},
            {"place": x.s[0], "gauge": x.s[1] + 0.5 * x.d},
        ),
        states=(Signal("s", "m", (0.3, -0.1), shape=(2,), nominal=1.0), Signal("d", "m", 0.05, nominal=0.1)),
        outputs=(Signal("place", "m"), Signal("gauge", "m")),
    )
    sensors, noise = ["place", "gauge"], {"place": "0.2 m", "gauge": "0.1 m"}
    process, uncertainty = {"s": "0.1 m", "d": "0.05 m"}, {"s": "0.2 m", "d": "0.1 m"}
    one = Filter(ekf.make(paired, sensors, noise, process, uncertainty, covariance=["d", "s[2]"], sample_time=H), H)
    scalars = {
        **SETTING,
        "process": {"x": "0.1 m", "v": "0.1 m/s", "d": "0.05 m/s2"},
        "uncertainty": {"x": "0.2 m", "v": "0.2 m/s", "d": "0.1 m/s2"},
    }
    other = Filter(ekf.make(**scalars, covariance=["d", "v"]), H)
    _, seen = truth(np.random.default_rng(2), 10)
    for y in seen:
        row = one(place_measured=y[0], gauge_measured=y[1])
        wanted = other(x_measured=y[0], gauge_measured=y[1])
        for name, same in (("s[1]", "x"), ("s[2]", "v"), ("d", "d"), ("std_s[2]", "std_v"), ("covariance[1,2]",) * 2):
            # Other nominal values, in which the matrices count.
            assert row[name] == pytest.approx(wanted[same], rel=1e-10, abs=1e-13), name
    one.component.close()
    other.component.close()


CRANKED = """\
campaign: cranked
description: a filter on a clock in crank angle while the engine speeds up, and one on its own time
clock: {crank: {step: 6 deg, stop: 40 rev, speed: engine}}
seed: 3
parts:
  engine: {use: source, unit: rpm, ramp: {at: 0.2 s, until: 1 s, from: 1500 rpm, to: 3000 rpm}}
  torque: {use: source, unit: N.m, step: {at: 0.3 s, from: 0 N.m, to: -3 N.m}}
  plant: {use: fmus.plants.driveline, wires: {T_eng: torque}}
  encoder: {use: sensor, of: plant.y, noise: {std: 0.5 rpm}}
  each:
    use: observers.ekf
    with: &filter
      plant: fmus.plants.driveline
      sensors: [y]
      noise: {y: 0.5 rpm}
      process: 1 %
      uncertainty: 50 %
      start: {theta_e: 2 mrad}
    wires: &wires {T_eng: torque, y_measured: encoder}
  timed: {use: observers.ekf, every: 2 ms, with: *filter, wires: *wires}
metrics:
  error_each: {rmse: [plant.theta_e, each.theta_e], after: 0.2 s, unit: mrad}
  error_timed: {rmse: [plant.theta_e, timed.theta_e], after: 0.2 s, unit: mrad}
  nis_each: {nis: {innovations: [each.innovation_y], variance: ["each.innovation_covariance[1,1]"]}}
accept:
  - error_each < 2 mrad
  - error_timed < 2 mrad
  - nis_each.within > 90 %
"""


def test_filters_run_on_a_crank_clock_and_on_a_time_of_their_own(tmp_path):
    # 2 mrad is what they start wrong by.
    file = tmp_path / "cranked.yaml"
    file.write_text(CRANKED)
    execute(read_campaign(file), tmp_path / "run", 1, lambda ended: None)
    criteria = json.loads((tmp_path / "run" / "acceptance.json").read_text())
    assert len(criteria) == 3 and all(one["passed"] for one in criteria), criteria


@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.parametrize("name", FILTERS)
def test_a_filters_fmu_passes_the_strict_validation(name, fmi):
    model = FILTERS[name].make(**SETTING, **UNCERTAIN)
    assert validate_fmu(str(cached_fmu(model, fmi))) == []


def test_what_is_not_seen_is_told_by_a_deviation_that_grows_as_it_must():
    # Only the speed is measured: the place is as uncertain as all that came of the speed's errors, and never less.
    model = ekf.make(
        CART, ["speed"], {"speed": "0.1 m/s"}, {"place": "0 m", "speed": "0.2 m/s", "heat": "0 K"},
        {"place": "1 m", "speed": "0.5 m/s", "heat": "2 K"}, covariance=["place", "speed"], sample_time=H,
    )  # fmt: skip
    estimator = Filter(model, H)
    transition = np.array([[1.0, H], [0.0, 1.0]])
    noise = 0.04 * np.array([[H**3 / 3, H**2 / 2], [H**2 / 2, H]])  # of a double integrator
    P, C = np.diag([1.0, 0.25]), np.array([[0.0, 1.0]])
    deviations = []
    for _ in range(200):
        row = estimator(speed_measured=0.0)
        P = transition @ P @ transition.T + noise
        P = P - P @ C.T @ C @ P / (P[1, 1] + 0.01)
        assert row["std_place"] == pytest.approx(np.sqrt(P[0, 0]), rel=1e-9)
        deviations.append(row["std_place"])
    assert np.all(np.diff(deviations[20:]) > 0.0) and deviations[-1] > 1.0
    # An unseen temperature that decays with its own time constant: 2 K e^{-t/10 s}, in kelvin, not in degrees.
    assert row["std_heat"] == pytest.approx(2.0 * np.exp(-2.0), rel=1e-9)
    unit = next(signal.unit for signal in model.discrete if signal.name == "std_heat")
    assert unit == "K"
    estimator.component.close()


def test_a_constant_gain_refuses_what_its_sensors_do_not_see():
    with pytest.raises(ConfigurationError, match="not detectable: the sensors do not see the mode at 0 1/s in place"):
        constant_gain.make(CART, ["speed"], {"speed": "0.1 m/s"}, "10 %", at={"place": "0 m"}, sample_time=H)


@pytest.mark.parametrize("name", FILTERS)
def test_two_perfect_sensors_of_one_thing_end_the_run_and_are_named(name):
    twice = Model(
        name="twice",
        description="one state that two outputs show",
        equations=lambda t, x, m, u, p: ({"a": -x.a, "b": -x.b}, {"one": x.a, "other": 2.0 * x.a}),
        states=(Signal("a", "m"), Signal("b", "m")),
        outputs=(Signal("one", "m"), Signal("other", "m")),
    )
    model = FILTERS[name].make(twice, ["one", "other"], {"one": "0 m", "other": "0 m"}, "1 %", "10 %", sample_time=H)
    estimator = Filter(model, H)
    wanted = "the innovation covariance is singular at t = 0.1.* what 'other_measured' shows is known without it"
    with pytest.raises(StepError, match=wanted):
        estimator(one_measured=0.1, other_measured=0.2)
    estimator.component.close()


@pytest.mark.parametrize("name", FILTERS)
def test_a_measurement_that_is_no_number_ends_the_run_and_is_named(name):
    estimator = Filter(FILTERS[name].make(**SETTING, **UNCERTAIN), H)
    with pytest.raises(StepError, match=r"'gauge_measured' less what is expected of it is nan at t = 0\.1 s"):
        estimator(x_measured=0.0, gauge_measured=np.nan)
    estimator.component.close()


def test_a_sigma_point_that_the_model_cannot_bring_along_ends_the_run():
    # x' = x^2 from 2 reaches infinity at 0.5 s, from 2 + sqrt(3) at 0.27 s.
    model = ukf.make(BLOW_UP, ["x"], 0.1, 0.0, 1.0, sample_time=0.3)
    estimator = Filter(model, 0.3)
    with pytest.raises(
        StepError, match=r"the sigma point that is off by 1\.73205 in 'x' could not be brought to t = 0\.3 s"
    ):
        estimator(x_measured=2.0)
    estimator.component.close()
    followed = Filter(ekf.make(BLOW_UP, ["x"], 0.1, 0.0, 1.0, sample_time=0.3), 0.3)
    assert np.isfinite(followed(x_measured=5.0)["x"])
    followed.component.close()


def test_what_is_measured_steps_before_the_filter():
    # Every estimate depends at once on every measurement, so a sensor's value of this instant is what is filtered.
    for model in (ekf.make(**SETTING, **UNCERTAIN), constant_gain.make(**SETTING)):
        component = Filter(model, H).component
        assert {("x", "x_measured"), ("d", "gauge_measured"), ("energy", "x_measured")} <= component.feedthrough
        assert ("innovation_x", "x_measured") in component.feedthrough
        component.close()


def test_a_model_alone_is_the_plant_itself():
    alone, plant = (
        Filter(model_alone.make(DRIVELINE, start={"theta_e": "5 mrad"}), 1e-3),
        Filter(DRIVELINE, 1e-3, theta_e=5e-3),
    )
    for k in range(400):
        torque = -20.0 if k > 50 else 0.0
        assert alone(T_eng=torque) == plant(T_eng=torque)
    assert {alone()["location"]} <= {1.0, 2.0, 3.0}
    alone.component.close()
    plant.component.close()


@pytest.mark.parametrize("name", FILTERS)
def test_a_plant_with_events_is_followed_through_them(name):
    model = FILTERS[name].make(
        "fmus.plants.driveline", ["y"], {"y": "0.5 rpm"}, {"others": 0.01}, {"others": 0.5},
        start={"theta_e": "5 mrad"}, sample_time=1e-3,
    )  # fmt: skip
    estimator, plant = Filter(model, 1e-3), Filter(DRIVELINE, 1e-3)
    alone = Filter(model_alone.make("fmus.plants.driveline", start={"theta_e": "5 mrad"}), 1e-3)
    places, errors, open_errors = set(), [], []
    for k in range(1500):
        torque = -20.0 if k > 200 else 0.0
        true = plant(T_eng=torque)
        row, free = estimator(T_eng=torque, y_measured=true["y"]), alone(T_eng=torque)
        places.add(true["location"])
        errors.append(row["theta_e"] - true["theta_e"])
        open_errors.append(free["theta_e"] - true["theta_e"])
    assert len(places) > 1
    rms, open_rms = (float(np.sqrt(np.mean(np.square(e)))) for e in (errors, open_errors))
    assert rms < 0.5 * open_rms
    for part in (estimator, plant, alone):
        part.component.close()
