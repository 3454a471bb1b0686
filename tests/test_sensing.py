"""A model with sensors measures what it is asked to, with a lag of its own where that is slow."""

from __future__ import annotations

import numpy as np
import pytest

from fmus.component import Signal
from fmus.export import cached_fmu
from fmus.fmu import load_fmu
from fmus.jacobians import jacobians, point
from fmus.model import Model, ModelError
from fmus.plants.driveline import MODEL as DRIVELINE
from fmus.plants.turbo_si import MODEL as ENGINE
from fmus.sensing import sensor_name, with_sensors

OVEN = Model(
    name="oven",
    description="an oven that is heated",
    equations=lambda t, x, m, u, p: (
        {"T": u.heat - p.loss * (x.T - 293.0)},
        {"excess": x.T - 293.0, "heating": 2.0 * u.heat},
    ),
    inputs=(Signal("heat", "K/s", 0.0),),
    states=(Signal("T", "K", 300.0, "inside", nominal=300.0),),
    outputs=(Signal("excess", "K", 7.0), Signal("heating", "K/s")),
    parameters=(Signal("loss", "1/s", 0.0),),
    parameter_sets={"leaky": {"loss": 1.0}},
)


def test_every_sensor_is_an_output_and_every_temperature_has_one_more_state():
    model = with_sensors(OVEN, ["heating", "T", "excess"])
    assert [s.name for s in model.outputs] == ["excess", "heating", "heating_sensor", "T_sensor", "excess_sensor"]
    assert [(s.name, s.unit, float(s.start), s.local) for s in model.states[1:]] == [
        ("T_lagged", "K", 300.0, True),
        ("excess_lagged", "K", 7.0, True),
    ]
    assert [(s.name, s.unit, s.start) for s in model.parameters[1:]] == [("tau_T", "s", 3.0), ("tau_excess", "s", 3.0)]
    assert model.parameter_sets == OVEN.parameter_sets


def test_a_slow_sensor_follows_by_its_time_constant():
    found = jacobians(with_sensors(OVEN, ["T", "heating"], {"T": 2.5}))
    at = point(found.model, {"T": 320.0, "T_lagged": 310.0, "heat": 4.0})
    dx, y = found.values(at)
    assert list(dx) == [4.0, (320.0 - 310.0) / 2.5]
    assert list(y) == [27.0, 8.0, 310.0, 8.0]


def test_a_lag_may_be_given_to_any_sensor_and_taken_from_any():
    model = with_sensors(OVEN, ["T", "heating"], {"T": 0.0, "heating": 0.1})
    assert [signal.name for signal in model.states] == ["T", "heating_lagged"]
    dx, y = jacobians(model).values(point(model, {"heat": 1.0}))
    assert list(dx) == [1.0, (2.0 - 0.0) / 0.1] and list(y)[-2:] == [300.0, 0.0]


def test_the_exported_sensor_lags_by_the_closed_form():
    # T rises at 2 K/s, so the sensor's lag is 2 tau (1 - exp(-t/tau)).
    model = with_sensors(OVEN, ["T"])
    component = load_fmu(cached_fmu(model), starts={"tau_T": 1.5})
    component.start(0.0, np.array([2.0]))
    for k in range(200):
        y = component.step(k * 0.01, 0.01, np.array([2.0]))
    values = dict(zip([signal.name for signal in component.outputs], y, strict=True))
    assert set(values) == {"T", "excess", "heating", "T_sensor"}
    lag = 2.0 * 1.5 * (1.0 - np.exp(-2.0 / 1.5))
    # RK4 at 1 ms, and 600 K that are subtracted: 1e-12 K.
    assert values["T"] - values["T_sensor"] == pytest.approx(lag, abs=1e-10)
    component.close()


def test_all_seventeen_sensors_of_the_paper_add_six_states_to_the_engine():
    flows = ["W_af", "W_comp", "W_ic", "W_th"]
    sensors = [signal.name for signal in ENGINE.states] + flows
    model = with_sensors(ENGINE, sensors)
    assert len(sensors) == 17 and len(model.states) == 13 + 6
    linear = jacobians(model).at(point(model, {"lambda": 0.95}))
    C = linear.C[-17:]
    engine = jacobians(ENGINE).at(point(ENGINE, {"lambda": 0.95}))
    names = [signal.name for signal in model.states]
    for row, sensor in zip(C, sensors, strict=True):
        seen = [names[i] for i in np.flatnonzero(row)]
        if sensor in flows:
            continue
        assert seen == [f"{sensor}_lagged" if sensor.startswith("T_") else sensor], sensor
    np.testing.assert_array_equal(C[13:, :13], engine.C[:4])
    np.testing.assert_array_equal(linear.A[:13, :13], engine.A)
    assert not linear.A[:13, 13:].any()
    lags = linear.A[13:]
    np.testing.assert_array_equal(lags[:, 13:], -np.eye(6) / 3.0)
    assert [names[np.flatnonzero(row)[0]] for row in lags] == [s for s in sensors if s.startswith("T_")]


def test_events_and_discrete_states_stay_as_they_are():
    model = with_sensors(DRIVELINE, ["y", "omega_p"])
    component, plain = (load_fmu(cached_fmu(one)) for one in (model, DRIVELINE))
    component.start(0.0, np.array([-10.0]))
    plain.start(0.0, np.array([-10.0]))
    visited = set()
    for k in range(500):
        y, expected = (one.step(k * 1e-3, 1e-3, np.array([-10.0])) for one in (component, plain))
        values = dict(zip([signal.name for signal in component.outputs], y, strict=True))
        others = dict(zip([signal.name for signal in plain.outputs], expected, strict=True))
        visited.add(others["location"])
        assert {name: values[name] for name in others} == others
        assert values[sensor_name("omega_p")] == values["omega_p"]
    assert visited == {1.0, 2.0, 3.0}
    component.close()
    plain.close()


@pytest.mark.parametrize(
    ("sensors", "lags", "message"),
    [
        (["exces"], {}, "oven: a sensor on exces: no scalar state or output is named 'exces'; did you mean 'excess'"),
        (["T", "T"], {}, "oven: a sensor on T is asked for twice"),
        (["T"], {"excess": 1.0}, "oven: a lag of excess: no sensor is named 'excess'; did you mean 'T'"),
        (["T"], {"T": -1.0}, "oven: the sensor on T wants a lag of 0 s or more, got -1 s"),
    ],
)
def test_what_is_wrong_with_a_sensor_is_named(sensors, lags, message):
    with pytest.raises(ModelError, match=message):
        with_sensors(OVEN, sensors, lags)


def test_a_model_with_sensors_takes_no_second_set_of_them():
    with pytest.raises(ModelError, match="'T_lagged' is declared twice"):
        with_sensors(with_sensors(OVEN, ["T"]), ["T"])
