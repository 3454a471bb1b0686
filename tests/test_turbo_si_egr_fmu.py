"""The engine with low-pressure EGR as an FMU: equal to its source, and made linear by its directional derivatives."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from fmpy.validation import validate_fmu
from scipy.integrate import solve_ivp

from fmus import derivatives
from fmus.export import cached_fmu
from fmus.fmu import load_fmu
from fmus.jacobians import Point, jacobians, point
from fmus.model import FlatModel
from fmus.plants.turbo_si_egr import INPUTS, MODEL, OUTPUTS, STATES
from fmus.steady import steady_state
from fmus.units import parse_unit
from harness.building import Export, build_model
from harness.operating import Operation, operate

ENGINE = jacobians(MODEL)
STATE_NAMES = [signal.name for signal in STATES]
NOMINAL = np.array([signal.nominal for signal in STATES])
# Points of the paper's cycle, and with two cylinders shut off.
OPERATION = [{}, {"N": 4000.0, "wastegate": 10.0, "egr_valve": 20.0}, {"N": 2400.0, "n_firing": 2.0, "throttle": 40.0}]


def in_si(signals: tuple, values: np.ndarray) -> np.ndarray:
    return np.array([parse_unit(s.unit).to_si(float(v)) for s, v in zip(signals, values, strict=True)])


def off_equilibrium(values: dict[str, float]) -> Point:
    rest = steady_state(ENGINE, point(MODEL, values)).point
    return rest._replace(x=rest.x * (1.0 + 1e-2 * np.random.default_rng(2).normal(size=20)))


@pytest.mark.parametrize("fmi", [2, 3])
def test_it_is_built_by_its_name_and_fmpys_validator_has_no_message(fmi, tmp_path: Path):
    assert validate_fmu(str(build_model("turbo_si_egr", Export(tmp_path / "engine.fmu", fmi)))) == []


@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.parametrize("values", OPERATION, ids=str)
def test_its_derivatives_and_outputs_are_those_of_the_python_source(fmi, values):
    at = off_equilibrium(values)
    dx, y = FlatModel(MODEL).derivatives_and_outputs(0.0, list(at.x), [], list(at.u), list(at.p))
    starts = dict(zip(STATE_NAMES, in_si(STATES, at.x), strict=True))
    component = load_fmu(cached_fmu(MODEL, fmi), starts=starts)
    by_name = {variable.name: variable for variable in component.description.variables}
    asked = derivatives.Questioned(component, 0.0, in_si(INPUTS, at.u))
    got = asked.get([*(by_name[f"der({name})"] for name in STATE_NAMES), *(by_name[s.name] for s in OUTPUTS)])
    component.close()
    # The same expressions by another pow and sqrt, 1e-15 of them, and by units of degrees and millimetres, in
    # differences to what rounding of the states would leave: 1e-14 |A| x.
    linear = ENGINE.at(at)
    rounding = 1e-14 * np.abs(np.vstack([linear.A, linear.C])) @ np.abs(at.x)
    expected = np.array([*dx, *y], dtype=float)
    assert (np.abs(got - expected) <= 1e-13 * np.abs(expected) + rounding).all()


def test_its_directional_derivatives_are_the_models_exact_ones(tmp_path: Path):
    path = build_model("turbo_si_egr", Export(tmp_path / "engine.fmu"))
    point = ["N=3200 rpm,throttle=60 deg,wastegate=11.6 mm,egr_valve=10 deg"]
    fmu = operate(Operation(str(path), point, settled=True)).space
    model = operate(Operation("turbo_si_egr", point, settled=True)).space
    assert fmu.rung == "directional" and model.rung == "exact"
    order = [[s.name for s in fmu.states].index(s.name) for s in model.states]
    rows = [[s.name for s in fmu.outputs].index(s.name) for s in model.outputs]
    inputs = [[s.name for s in fmu.inputs].index(s.name) for s in model.inputs]
    np.testing.assert_allclose(fmu.x0[order], model.x0, rtol=1e-7, atol=1e-9)
    for name, found in {
        "A": fmu.A[np.ix_(order, order)], "B": fmu.B[np.ix_(order, inputs)],
        "C": fmu.C[np.ix_(rows, order)], "D": fmu.D[np.ix_(rows, inputs)],
    }.items():  # fmt: skip
        # The FMU settles by itself, to 1e-9 of its states; the entries move by no more than that times their slopes.
        expected = getattr(model, name)
        rows_size = np.abs(expected).max(axis=1, keepdims=True)
        assert (np.abs(found - expected) <= 1e-6 * rows_size + 1e-12).all(), name


def test_it_goes_the_way_of_its_source_when_valves_and_speed_step():
    start, moved = point(MODEL), {"throttle": 35.0, "wastegate": 14.0, "egr_valve": 20.0, "N": 2600.0, "n_firing": 3.0}
    u = np.array([moved.get(signal.name, float(signal.start)) for signal in INPUTS])
    at = start._replace(u=u)
    run = solve_ivp(
        lambda t, z: ENGINE.values(at._replace(x=z * NOMINAL))[0] / NOMINAL, (0.0, 1.0), start.x / NOMINAL,
        method="Radau", rtol=1e-9, atol=1e-11, t_eval=np.linspace(0.1, 1.0, 10),
    )  # fmt: skip
    component = load_fmu(cached_fmu(MODEL))
    places = [[signal.name for signal in component.outputs].index(name) for name in STATE_NAMES]
    component.start(0.0, in_si(INPUTS, u))
    rows = [component.step(k * 0.1, 0.1, in_si(INPUTS, u))[places] for k in range(10)]
    component.close()
    expected = np.array([in_si(STATES, x) for x in run.y.T * NOMINAL])
    sizes = in_si(STATES, NOMINAL)
    # The default tolerance is 1e-6 a step, and the engine contracts, so that errors do not pile up.
    assert (np.abs(np.array(rows) - expected) / sizes).max() < 2e-5
