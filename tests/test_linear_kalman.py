"""The linear Kalman filter: its gain against python-control, its FMU against an exponential, and what it refuses."""

from __future__ import annotations

import control
import numpy as np
import pytest
from filtered import CART, SPRING, SPRING_A, SPRING_C, TANKS, Filter
from scipy.linalg import expm

from fmus.component import ConfigurationError
from fmus.model import ModelError
from observers import linear_kalman

STRAYS = np.array([0.1, 0.3, 0.05])
NOISE = np.array([0.2, 0.1])
SETTING = {
    "plant": SPRING,
    "sensors": ["x", "gauge"],
    "noise": {"x": "20 cm", "gauge": "0.1 m/s"},
    "process": {"x": "0.1 m", "v": "0.3 m/s", "d": "0.05 m/s2"},
    "lasting": 0.5,
}


def values(model) -> dict[str, np.ndarray]:
    return {signal.name: np.asarray(signal.start) for signal in model.parameters}


@pytest.mark.parametrize(("seed", "n", "m"), [(1, 3, 1), (2, 5, 2), (3, 8, 4)])
def test_the_gain_is_that_of_python_control(seed, n, m):
    rng = np.random.default_rng(seed)
    A, C = rng.normal(size=(n, n)), rng.normal(size=(m, n))
    density, intensity = np.exp(rng.normal(size=n)), np.exp(rng.normal(size=m))
    L, X = linear_kalman.gain(A, C, density, intensity, [f"x{i}" for i in range(n)])
    wanted, covariance, _ = control.lqe(A, np.eye(n), C, np.diag(density), np.diag(intensity))
    # Two solvers of one equation, in other units: nine of sixteen digits.
    np.testing.assert_allclose(L, wanted, rtol=1e-7, atol=1e-9 * np.abs(wanted).max())
    np.testing.assert_allclose(X, covariance, rtol=1e-7, atol=1e-9 * np.abs(covariance).max())


def test_the_matrices_are_the_plants_and_the_noise_counts_for_as_long_as_it_lasts():
    model = linear_kalman.make(**SETTING)
    found = values(model)
    np.testing.assert_allclose(found["A"], SPRING_A)
    np.testing.assert_allclose(found["C"][-2:], SPRING_C)
    wanted, X, _ = control.lqe(SPRING_A, np.eye(3), SPRING_C, np.diag(STRAYS**2), np.diag(0.5 * NOISE**2))
    np.testing.assert_allclose(found["L"], wanted, rtol=1e-7)
    assert [found[f"std_{name}"] for name in ("x", "v", "d")] == pytest.approx(np.sqrt(np.diag(X)), rel=1e-7)


@pytest.mark.parametrize("fmi", [2, 3])
def test_its_fmu_is_the_linear_equation_of_deviations_exactly(fmi):
    about = {"x": "0.4 m", "v": "0.1 m/s", "gauge": "0.3 m/s", "push": "0.2 m/s2"}
    model = linear_kalman.make(**SETTING, at={"push": "0 m/s2"}, about=about, start={"x": "0.9 m"})
    found = values(model)
    h, A, L = 0.05, SPRING_A, found["L"]
    x_0, y_0 = np.array([0.4, 0.1, 0.0]), np.array([0.4, 0.3])
    block = np.zeros((6, 6))
    block[:3, :3], block[:3, 3:] = A - L @ SPRING_C, np.eye(3)
    transition = expm(block * h)
    x, observer = np.array([0.9, 0.1, 0.0]), Filter(model, h, fmi)
    for k in range(40):
        push, y = np.sin(0.3 * k), np.array([0.4 + 0.1 * np.cos(k), 0.3 - 0.05 * k])
        forced = np.array([0.0, push - 0.2, 0.0]) + L @ (y - y_0)
        x = x_0 + transition[:3, :3] @ (x - x_0) + transition[:3, 3:] @ forced
        shown = observer(push=push, x_measured=y[0], gauge_measured=y[1])
        # The solver is of fourth order in steps of a millisecond.
        assert [shown[name] for name in ("x", "v", "d")] == pytest.approx(x.tolist(), abs=1e-8)
        assert shown["innovation_x"] == pytest.approx(y[0] - x[0], abs=1e-8)


def test_a_reference_that_shows_what_it_is_about_is_left_where_it_is():
    # The model of the tanks rests at levels of 1 m; the reference of which the filter is about at others.
    about = {"upper": "1.3 m", "lower": "0.8 m", "outflow": "0.09 m/s"}
    model = linear_kalman.make(TANKS, ["outflow"], {"outflow": "0.01 m/s"}, 0.1, at={"q": "0.1 m/s"}, about=about)
    observer = Filter(model, 0.5)
    for _ in range(20):
        shown = observer(q=0.1, outflow_measured=0.09)
    assert [shown["upper"], shown["lower"], shown["outflow"]] == pytest.approx([1.3, 0.8, 0.09], rel=1e-12)


def test_without_sensors_it_is_the_linear_model_alone():
    model = linear_kalman.make(SPRING, [], {}, {"x": "0 m", "v": "0.3 m/s", "d": "0.05 m/s2"}, start={"x": "1 m"})
    assert "L" not in values(model)
    observer, x = Filter(model, 0.1), np.array([1.0, 0.0, 0.0])
    for _ in range(30):
        x = expm(0.1 * SPRING_A) @ x
        shown = observer(push=0.0)
    assert [shown[name] for name in ("x", "v", "d")] == pytest.approx(x.tolist(), abs=1e-7)


def test_all_that_is_wrong_is_told_at_once():
    with pytest.raises(ConfigurationError) as failure:
        linear_kalman.make(
            **SETTING | {"noise": {"x": "0 m", "gauge": "0.1 m/s"}, "lasting": 0.0}, about={"pushed": "1 m/s2"}
        )
    told = str(failure.value)
    assert "noise: x wants a standard deviation above 0" in told
    assert "lasting wants a value above 0 s" in told
    assert "'pushed'" in told and "push" in told


def test_what_does_not_die_out_and_is_not_seen_is_named():
    with pytest.raises(ConfigurationError, match=r"not detectable: the sensors do not see .*place"):
        linear_kalman.make(CART, ["speed"], {"speed": "0.1 m/s"}, {"place": "1 m", "speed": "1 m/s", "heat": "1 K"},
                           at={"place": "0 m"})  # fmt: skip


def test_of_two_modes_alike_that_one_sensor_sees_only_together_the_unseen_one_is_named():
    # Two integrators and their sum: either is seen, what they differ by is not.
    with pytest.raises(ModelError, match="not detectable: the sensors do not see the mode at 0 1/s in a, b"):
        linear_kalman.gain(np.zeros((2, 2)), np.array([[1.0, 1.0]]), np.ones(2), np.ones(1), ["a", "b"])
