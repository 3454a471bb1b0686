"""Filters on the turbocharged engine: by any set of its sensors, in a campaign, and with arguments that are wrong."""

from __future__ import annotations

import json
import re
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from engine_at_rest import settled
from filtered import Filter, TwinFilter
from scipy.integrate import solve_ivp

from fmus.component import ConfigurationError
from fmus.jacobians import Point, jacobians, point
from fmus.plants.turbo_si import MODEL
from fmus.sensing import with_sensors
from harness.campaign import read_campaign
from harness.cases import execute
from observers import constant_gain, ekf, model_alone, ukf
from observers.operating import OperatingPoints, Sought

PLANT = "fmus.plants.turbo_si"
H = 0.01
NOISE = {"p_im": "500 Pa", "T_im": "0.5 K", "p_em": "1 kPa"}
SETTING = {"plant": PLANT, "sensors": list(NOISE), "noise": NOISE, "process": "0.2 %", "sample_time": H}
FILTERS = {"ekf": ekf, "ukf": ukf}


@pytest.mark.parametrize("name", FILTERS)
def test_the_engines_filter_is_its_python_source(name):
    model = FILTERS[name].make(**SETTING, uncertainty="2 %", start={"p_im": "65 kPa"}, outputs=["cac_stroke"])
    estimator = Filter(model, H, **{"solver.tolerance": 1e-9})
    sensed = with_sensors(MODEL, list(NOISE))
    derivatives, scales = jacobians(sensed), np.array([signal.nominal for signal in sensed.states])
    p = point(sensed).p

    def flow(x, u, h):
        def at(z):
            return Point(z * scales, np.zeros(0), np.array(u[:6]), p)

        run = solve_ivp(
            lambda t, z: derivatives.values(at(z))[0] / scales, (0.0, h), x / scales, method="Radau",
            rtol=1e-11, atol=1e-11, jac=lambda t, z: derivatives.at(at(z)).A * scales / scales[:, None],
        )  # fmt: skip
        return run.y[:, -1] * scales

    twin = TwinFilter(model, H, flow)
    for k in range(1 if name == "ukf" else 3):  # the twin's solver takes its time with 28 points
        seen = {"alpha": 0.15 + 0.02 * k, "p_im_measured": 70e3, "T_im_measured": 301.0, "p_em_measured": 113e3}
        row, wanted = estimator(**seen), twin(**seen)
        for key, value in row.items():
            if key in wanted and not key.startswith(("innovation", "nis")):
                # RODAS4 at 1e-9 against Radau at 1e-11, of states scaled to one.
                assert value == pytest.approx(wanted[key], rel=1e-6), (k, key)
        assert row["nis"] == pytest.approx(wanted["nis"], rel=1e-3)
    estimator.component.close()


def test_with_each_further_sensor_every_state_is_known_better():
    # At rest, measured without an error, every filter is linearised at the same points: a covariance is then a matter
    # of the sensors alone, and a further one takes some of it away, or nothing.
    truth = settled({}).states | settled({}).outputs
    found = []
    for sensors, states in ((["W_af"], 13), (["W_af", "T_ic"], 14), (["W_af", "T_ic", "p_im"], 14)):
        model = ekf.make(PLANT, sensors, 0.01, "0.1 %", "5 %", sample_time=H)
        assert len(model.states) == states and len(model.inputs) == 6 + len(sensors)
        estimator = Filter(model, H)
        for _ in range(50):
            row = estimator(**{f"{name}_measured": truth[name] for name in sensors})
        found.append(np.array([row[f"std_{signal.name}"] for signal in MODEL.states]))
        estimator.component.close()
    for fewer, more in pairwise(found):
        assert np.all(more <= fewer * (1.0 + 1e-6)) and np.any(more < 0.99 * fewer)


@pytest.mark.parametrize("name", FILTERS)
def test_a_filter_takes_down_an_error_that_the_model_alone_keeps(name):
    # The turbocharger takes seconds to come to its speed.
    model = FILTERS[name].make(**SETTING, uncertainty="10 %", start={"omega_tc": "7000 rad/s"})
    free = Filter(model_alone.make(PLANT, start={"omega_tc": "7000 rad/s"}), H)
    estimator, truth = Filter(model, H), settled({}).states
    for _ in range(100):
        row, alone = estimator(**{f"{name}_measured": truth[name] for name in NOISE}), free()
    missed, kept = (abs(one["omega_tc"] - truth["omega_tc"]) for one in (row, alone))
    assert missed < 0.5 * kept
    estimator.component.close()
    free.component.close()


def test_all_seventeen_sensors_make_a_filter_of_nineteen_states():
    sensors = [signal.name for signal in MODEL.states] + ["W_af", "W_comp", "W_ic", "W_th"]
    model = ekf.make(PLANT, sensors, 0.01, "0.1 %", "5 %", sample_time=H)
    estimator = Filter(model, H)
    truth = settled({}).states | settled({}).outputs
    row = estimator(**{f"{name}_measured": truth[name] for name in sensors})
    assert len(model.states) == 19
    # Nothing was wrong at the start, and so nothing moves: the start values have nine digits.
    assert row["cac_stroke"] == pytest.approx(truth["cac_stroke"], rel=1e-6)
    assert row["nis"] < 1e-6
    estimator.component.close()


def test_an_operating_point_is_sought_by_the_input_that_brings_the_engine_there():
    sensed = with_sensors(MODEL, ["p_im"])
    derivatives = jacobians(sensed)
    alpha = next(signal for signal in MODEL.inputs if signal.name == "alpha")
    found = OperatingPoints(derivatives).at({"N": 3000.0}, Sought(alpha, "p_im_sensor", 6e4))
    dx, y = derivatives.values(found)
    # xtol of 1e-10 of the opening, at 1e6 Pa for an opening of one.
    assert y[-1] == pytest.approx(6e4, abs=1e-2)
    scales = np.array([signal.nominal for signal in MODEL.states])
    assert np.abs(dx / scales).max() < 1e-6
    assert 0.0 < found.u[1] < 0.3


def test_a_gain_scheduled_by_a_sensor_goes_by_what_it_shows():
    grid = {"p_im": {"values": "[50, 80] kPa", "by": "alpha"}}
    model = constant_gain.make(**SETTING, grid=grid)
    table = next(np.array(signal.start) for signal in model.parameters if signal.name == "gain_table")
    at_half = Filter(model, H)
    estimate = at_half(p_im_measured=65e3, T_im_measured=301.0, p_em_measured=114e3)
    alone = Filter(model_alone.make(PLANT), H)()
    innovation = np.array([estimate[f"innovation_{name}"] for name in NOISE])
    moved = np.array([estimate[s.name] - alone[s.name] for s in MODEL.states])
    expected = (0.5 * (table[0] + table[1]) @ innovation)[:13]
    # Pressures of 1e5 Pa and temperatures of 1e3 K, of which differences are taken.
    np.testing.assert_allclose(moved, expected, rtol=1e-6, atol=1e-8 * 1e5)
    at_half.component.close()


def test_the_example_of_the_page_runs_and_its_criteria_hold(tmp_path):
    page = (Path(__file__).parent.parent / "docs" / "observers.md").read_text(encoding="utf-8")
    (text,) = re.findall(r"```yaml\n(campaign: .*?)```", page, re.S)
    file = tmp_path / "tip_in.yaml"
    file.write_text(text)
    summary = execute(read_campaign(file), tmp_path / "run", 1, lambda ended: None)
    criteria = json.loads((tmp_path / "run" / "acceptance.json").read_text())
    assert len(criteria) == 6 and all(one["passed"] for one in criteria), (criteria, summary)


def complaints(make, **changed):
    with pytest.raises(ConfigurationError) as caught:
        make(**{**SETTING, **changed})
    return [problem.message for problem in caught.value.problems]


def test_all_that_is_wrong_with_a_filters_arguments_is_told_at_once():
    told = complaints(
        ekf.make,
        sensors=["p_im", "T_i"],
        noise={"p_im": "5 K"},
        process={"p_imm": "1 kPa"},
        uncertainty={"others": "5 kPa", "p_im": "-1 kPa"},
        start={"T_im": "60 kPa"},
        parameters={"V_imm": "2 L"},
        parameter_set="C",
        outputs=["cac"],
        covariance=["p_x"],
        lags={"p_em": "1 s"},
    )
    wanted = [
        "no parameter set of turbo_si is named 'C'; did you mean 'B'",
        "no parameter of turbo_si is named 'V_imm'; did you mean 'V_im'",
        "T_im wants K, got 60 kPa",
        "no sensor is named 'p_em'",
        "a sensor on T_i: no scalar state or output is named 'T_i'; did you mean 'T_i",
        "outputs: no output of turbo_si is named 'cac'; did you mean 'cac_",
        "noise: p_im wants Pa, got 5 K",
        "process: no state is named 'p_imm'; did you mean 'p_im'",
        "process wants a standard deviation of p_af, T_af",
        "uncertainty: others wants 1, got 5 kPa",
        "uncertainty: p_im wants 0 Pa or more, got -1000",
        "covariance: no state is named 'p_x'",
    ]
    for text in wanted:
        assert any(text in message for message in told), (text, told)


@pytest.mark.parametrize("make", [ekf.make, ukf.make, constant_gain.make])
def test_a_noise_that_is_missing_is_named(make):
    more = {} if make is constant_gain.make else {"uncertainty": "1 %"}
    told = complaints(make, noise={"p_im": "500 Pa"}, **more)
    assert told == ["noise wants a standard deviation of T_im, p_em too, or `others`, a share of the nominal value"]


def test_what_is_wrong_with_a_grid_is_named():
    assert complaints(constant_gain.make, grid={"Nn": [1]})[0].startswith("grid: no input or sensor is named 'Nn'")
    assert "ascending" in complaints(constant_gain.make, grid={"N": "[3000, 2000] rpm"})[0]
    assert complaints(constant_gain.make, grid={"N": "[3000] kPa"}) == ["grid: N wants rpm, got 3000 kPa"]
    assert "is measured and wants `p_im: {values" in complaints(constant_gain.make, grid={"p_im": "[50] kPa"})[0]
    unset = {"p_im": {"values": "[50] kPa", "by": "alpa"}}
    assert complaints(constant_gain.make, grid=unset) == ["grid: p_im: no input is named 'alpa'; did you mean 'alpha'?"]
    twice = {"alpha": [0.1], "p_im": {"values": "[50] kPa", "by": "alpha"}}
    assert "an input of its own" in complaints(constant_gain.make, grid=twice)[0]
    far = {"N": "[2000] rpm", "p_im": {"values": "[900] kPa", "by": "alpha"}}
    (told,) = complaints(constant_gain.make, grid=far)
    assert told.startswith("at N = 2000 rpm, p_im = 900000 Pa: wants one value of alpha that settles p_im_sensor")
    assert "there is none, it settles at" in told


def test_a_node_at_which_the_plant_does_not_settle_is_named():
    told = complaints(constant_gain.make, grid={"alpha": [0.1, 0.2]}, parameters={"V_im": "0 L"})
    assert len(told) == 2
    assert told[0].startswith("at alpha = 0.1 1: turbo_si cannot start here: the derivative of p_im")
    assert told[1].startswith("at alpha = 0.2 1: turbo_si")


def test_a_stationary_gain_wants_noise_on_every_sensor_and_a_sample_time():
    told = complaints(constant_gain.make, noise={**NOISE, "p_em": "0 Pa"}, sample_time=0.0)
    assert told == [
        "noise: p_em wants a standard deviation above 0 for a stationary gain",
        "sample_time wants a value above 0 s, which the gains hold for, got 0",
    ]


def test_a_plant_that_is_none_is_refused():
    for plant, message in [
        ("fmus.plants.turbo", "plant wants a module, got 'fmus.plants.turbo'"),
        ("fmus.gas", "plant wants a module with a Model, got 'fmus.gas', which has no MODEL"),
        ("fmus.plants.turbo_si:MODLE", "which has no MODLE"),
        (constant_gain.make(**SETTING), "plant wants a model in continuous time: constant_gain is sampled"),
    ]:
        (told,) = complaints(ekf.make, plant=plant, uncertainty=0.1)
        assert message in told


def test_problems_of_a_filter_are_told_where_its_settings_stand(tmp_path):
    page = (Path(__file__).parent.parent / "docs" / "observers.md").read_text(encoding="utf-8")
    (text,) = re.findall(r"```yaml\n(campaign: .*?)```", page, re.S)
    file = tmp_path / "wrong.yaml"
    file.write_text(
        text.replace(
            "sensors: [p_im, T_im, p_em]\n      noise: {p_im: 500 Pa",
            "sensors: [p_im, T_im, p_em]\n      noise: {p_im: 500 N",
            1,
        )
    )
    with pytest.raises(ConfigurationError) as caught:
        read = read_campaign(file)
        execute(read, tmp_path / "run", 1, lambda ended: None)
    problem = caught.value.problems[0]
    assert "noise: p_im wants Pa, got 500 N" in problem.message
    assert problem.file.endswith("wrong.yaml") and problem.line > 20
