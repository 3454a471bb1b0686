"""FMUs with Python inside: the same trajectory as the native export, and models that only they can hold."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from fmpy import read_model_description, simulate_fmu
from fmpy.validation import validate_fmu

from fmus.component import Signal
from fmus.description import describe
from fmus.export import build_fmu
from fmus.model import Model, ModelError
from fmus.plants.driveline import MODEL as DRIVELINE
from fmus.python_export import build_python_fmu

# math.* has no trace; such a model can only be exported with Python inside.
PENDULUM = Model(
    name="pendulum",
    description="theta'' = -g/l sin(theta)",
    equations=lambda t, x, m, u, p: ({"theta": x.omega, "omega": -9.81 / p.length * math.sin(x.theta)}, {}),
    states=(Signal("theta", "rad", 0.5), Signal("omega", "rad/s")),
    parameters=(Signal("length", "m", 1.0),),
)


def test_the_driveline_with_python_inside_follows_the_native_export(tmp_path: Path) -> None:
    python = build_python_fmu("fmus.plants.driveline", "MODEL", tmp_path / "python.fmu")
    native = build_fmu(DRIVELINE, tmp_path / "native.fmu")
    assert validate_fmu(str(python)) == []
    runs = [
        simulate_fmu(
            str(path),
            stop_time=0.3,
            output_interval=1e-3,
            start_values={"T_eng": -12.0, "k": 1550.0},
            output=["theta_e", "omega_c", "y", "location"],
        )
        for path in (python, native)
    ]
    for name in ("theta_e", "omega_c", "y"):
        # The same method and the same expressions; a C compiler may order a sum otherwise.
        np.testing.assert_allclose(runs[0][name], runs[1][name], rtol=1e-9, atol=1e-12)
    assert set(runs[1]["location"]) == {1, 2, 3}
    assert list(runs[0]["location"]) == list(runs[1]["location"])


def test_a_model_that_cannot_be_traced_runs_with_python_inside(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match=r"np\.sin for math\.sin"):
        build_fmu(PENDULUM, tmp_path / "native.fmu")
    path = build_python_fmu("tests.test_python_export", "PENDULUM", tmp_path / "p.fmu", overrides={"theta": 1e-3})
    result = simulate_fmu(str(path), stop_time=1.0, output_interval=1e-2, output=["theta"])
    exact = 1e-3 * np.cos(math.sqrt(9.81) * result["time"])
    # A small swing is a cosine up to theta^2/16 of its phase: 1e-7; RK4 at 1 ms adds 1e-13.
    np.testing.assert_allclose(result["theta"], exact, rtol=0, atol=1e-9)


def test_two_exports_of_one_model_keep_their_own_start_values_in_one_process(tmp_path: Path) -> None:
    for start in (1e-3, 2e-3):
        path = build_python_fmu("tests.test_python_export", "PENDULUM", tmp_path / "p.fmu", overrides={"theta": start})
        result = simulate_fmu(str(path), stop_time=0.01, output_interval=1e-2, output=["theta"])
        assert result["theta"][0] == start


def test_units_and_kinds_are_described_as_in_the_native_export(tmp_path: Path) -> None:
    python = read_model_description(build_python_fmu("fmus.plants.driveline", "MODEL", tmp_path / "python.fmu"))
    native = read_model_description(build_fmu(DRIVELINE, tmp_path / "native.fmu"))

    def listed(description: object) -> list[tuple[str, int, str, str | None]]:
        return [(v.name, v.valueReference, v.type, v.unit) for v in description.modelVariables]  # type: ignore[attr-defined]

    assert listed(python) == listed(native)
    assert python.modelExchange is None
    assert python.coSimulation.needsExecutionTool


def test_what_depends_on_what_is_described_as_in_the_native_export(tmp_path: Path) -> None:
    paths = [build_python_fmu("fmus.plants.driveline", "MODEL", tmp_path / "p.fmu")]
    paths.append(build_fmu(DRIVELINE, tmp_path / "native.fmu"))
    python, native = (describe(path).dependencies for path in paths)
    assert python == native and native
    untraced = build_python_fmu("tests.test_python_export", "PENDULUM", tmp_path / "pendulum.fmu")
    assert describe(untraced).dependencies == {"theta": frozenset({"theta"}), "omega": frozenset({"omega"})}


def test_a_start_value_of_no_variable_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="did you mean 'k_1'"):
        build_python_fmu("fmus.plants.driveline", "MODEL", tmp_path / "m.fmu", overrides={"k_2": 1.0})
    assert not (tmp_path / "m.fmu").exists()
