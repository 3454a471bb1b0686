"""An FMU of our own, loaded again: its units, its integer output and its parameters reach the bus as declared."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from fmus.component import Vector
from fmus.export import cached_fmu
from fmus.fmu import FmuComponent, load_fmu
from fmus.plants.driveline import MODEL

H, STEPS, TORQUE = 1e-3, 400, -60.0


@pytest.fixture(params=[2, 3])
def driveline(request: pytest.FixtureRequest) -> Iterator[FmuComponent]:
    component = load_fmu(cached_fmu(MODEL, fmi=request.param), starts={"theta_e": 0.03, "k": 1800.0}, name="plant")
    yield component
    component.close()


def trajectory(component: FmuComponent) -> dict[str, Vector]:
    u = np.array([TORQUE])
    rows = [component.start(0.0, u)]
    rows += [component.step(k * H, H, u) for k in range(STEPS)]
    return {signal.name: column for signal, column in zip(component.outputs, np.array(rows).T, strict=True)}


def test_the_measured_speed_is_on_the_bus_in_si_though_declared_in_rpm(driveline: FmuComponent):
    unit = {signal.name: signal.unit for signal in driveline.outputs}
    assert (unit["y"], unit["omega_c"]) == ("rpm", "rad/s")
    run = trajectory(driveline)
    assert np.ptp(run["y"]) > 1.0
    # The FMU turns rad/s into rpm and the loader turns it back: two roundings.
    assert np.allclose(run["y"], run["omega_c"], rtol=1e-15, atol=0.0)


def test_the_location_is_a_whole_number_that_follows_the_torsion(driveline: FmuComponent):
    kind = {signal.name: signal.kind for signal in driveline.outputs}
    assert kind["location"] == "integer"
    run = trajectory(driveline)
    assert run["theta_e"][0] == 0.03
    assert set(run["location"]) <= {1.0, 2.0, 3.0}
    assert len(set(run["location"])) > 1


def test_start_values_are_applied_and_the_others_are_those_of_the_model(driveline: FmuComponent):
    driveline.start(0.0, np.array([0.0]))
    applied = driveline.applied_starts
    assert (applied["theta_e"], applied["k"]) == (0.03, 1800.0)
    assert (applied["J_v"], applied["omega_c"], applied["solver.method"]) == (80.0, 0.0, 1.0)
    assert "T_eng" not in applied


def test_a_plant_without_feedthrough_is_loaded_as_one(driveline: FmuComponent):
    assert driveline.feedthrough == frozenset()


def test_both_versions_of_fmi_give_the_same_bits():
    runs = []
    for fmi in (2, 3):
        component = load_fmu(cached_fmu(MODEL, fmi=fmi))
        runs.append(trajectory(component))
        component.close()
    assert runs[0].keys() == runs[1].keys()
    assert all(np.array_equal(runs[0][name], runs[1][name]) for name in runs[0])
