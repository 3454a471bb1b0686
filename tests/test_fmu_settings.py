"""What stands under `with` of an FMU reaches it: sizes of arrays, text, tunables, the solver of Model Exchange."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from third_party import reference_fmu

from fmus.component import ConfigurationError
from fmus.fmu import FmuComponent, load_fmu
from harness.findings import Findings
from harness.places import Places
from harness.resolve import resolve
from harness.scenario import ModelPart


def resolved(folder: Path, fmu: Path, **part: Any) -> FmuComponent:
    """The FMU as a part of a campaign. Raises ConfigurationError with what was found wrong."""
    path = shutil.copy(fmu, folder / "part.fmu")
    found = Findings(Places(), ("parts", "part"))
    made = resolve(ModelPart.model_validate({"use": str(path), **part}), "part", 0.1, found)
    if found.problems:
        raise ConfigurationError(found.problems)
    assert made is not None and isinstance(made.component, FmuComponent)
    return made.component


def test_structural_parameters_size_the_arrays_that_hang_on_them():
    rng = np.random.default_rng(5)
    a, b, c, d = rng.normal(size=(4, 2, 2))
    starts = {"m": 2.0, "n": 2.0, "r": 2.0}
    for name, matrix in zip("ABCD", (a, b, c, d), strict=True):
        starts |= {f"{name}[{i + 1},{j + 1}]": matrix[i, j] for i in range(2) for j in range(2)}
    component = load_fmu(reference_fmu("StateSpace", 3), starts=starts)
    assert [signal.name for signal in component.inputs] == ["u[1]", "u[2]"]
    assert [signal.name for signal in component.outputs] == ["y[1]", "y[2]"]
    u = rng.normal(size=2)
    y0 = component.start(0.0, u)
    h = 1e-3  # the step of the FMU's own solver
    y1 = component.step(0.0, h, u)
    # An Euler step from x = 0; some ten roundings.
    assert np.allclose([y0, y1], [d @ u, c @ (h * b @ u) + d @ u], rtol=1e-13, atol=1e-13)
    assert component.applied_starts["m"] == 2.0
    component.close()


def test_a_state_space_sized_anew_runs_by_model_exchange_too():
    starts = {"m": 1.0, "n": 1.0, "r": 1.0, "A[1,1]": -2.0, "B[1,1]": 1.0, "C[1,1]": 1.0, "D[1,1]": 0.0}
    component = load_fmu(reference_fmu("StateSpace", 3), starts=starts, kind="me")
    component.start(0.0, np.zeros(1))
    x = [component.step(k * 0.1, 0.1, np.array([6.0]))[0] for k in range(10)]
    component.close()
    # x' = -2 x + 6 from 0: 3 (1 - exp(-2 t)); a tolerance of 1e-6 of the nominal 1 in each of some 30 steps.
    assert np.allclose(x, 3.0 * (1 - np.exp(-0.2 * np.arange(1, 11))), atol=1e-4)


def test_a_campaign_sizes_arrays_before_it_fills_them(tmp_path: Path):
    settings = {"A": [[1, 0], [0, 1]], "m": 2, "n": 2, "r": 2, "B": 0, "C": 0, "D": [[1, 2], [3, 4]]}
    component = resolved(tmp_path, reference_fmu("StateSpace", 3), **{"with": settings})
    assert np.array_equal(component.start(0.0, np.array([1.0, 1.0])), [3.0, 7.0])
    component.close()
    with pytest.raises(ConfigurationError, match=r"D wants 4 values, shape \(2, 2\), got 9"):
        resolved(tmp_path, reference_fmu("StateSpace", 3), **{"with": {**settings, "D": [[1, 2, 3]] * 3}})
    with pytest.raises(ConfigurationError, match=r"m wants a whole number"):
        resolved(tmp_path, reference_fmu("StateSpace", 3), **{"with": {"m": 2.5}})


@pytest.mark.parametrize("fmi", [2, 3])
def test_text_and_tunable_parameters_are_set(tmp_path: Path, fmi: int):
    text, tunable = "String_input", "Float64_tunable_parameter"
    component = resolved(tmp_path, reference_fmu("Feedthrough", fmi), **{"with": {text: "a b", tunable: 0.25}})
    component.start(0.0, np.array([float(signal.start) for signal in component.inputs]))
    assert component.applied_starts[text] == "a b"
    assert component.applied_starts[tunable] == 0.25
    component.close()
    with pytest.raises(ConfigurationError, match=f"{text} wants text, got 3"):
        resolved(tmp_path, reference_fmu("Feedthrough", fmi), **{"with": {text: 3}})


def test_what_cannot_be_set_is_refused_with_the_reason(tmp_path: Path):
    with pytest.raises(ConfigurationError) as raised:
        resolved(
            tmp_path, reference_fmu("BouncingBall", 3), **{"with": {"g": "-1 m/s2", "v_min": 3, "time": 1, "hh": 2}}
        )
    told = "\n".join(str(problem) for problem in raised.value.problems)
    assert "v_min cannot be set: it is constant" in told.replace(": cannot", " cannot")
    assert "time cannot be set: its causality is independent" in told.replace(": cannot", " cannot")
    assert "no parameter or start value is named 'hh'" in told


def test_the_solver_of_model_exchange_is_set_from_the_campaign(tmp_path: Path):
    settings = {"solver.method": "adams", "solver.tolerance": 1e-9, "solver.step": "1 ms"}
    component = resolved(tmp_path, reference_fmu("Dahlquist"), kind="me", **{"with": settings})
    component.start(0.0, np.zeros(0))
    x = component.step(0.0, 0.1, np.zeros(0))[0]
    assert component.slave.exchange is not None and component.slave.exchange.steps >= 100
    assert x == pytest.approx(np.exp(-0.1), abs=1e-8)
    component.close()
    wrong = {"solver.method": "euler", "solver.stp": 1, "k": "2 m"}
    with pytest.raises(ConfigurationError) as raised:
        resolved(tmp_path, reference_fmu("Dahlquist"), kind="me", **{"with": wrong})
    told = "\n".join(str(problem) for problem in raised.value.problems)
    assert "solver.method wants one of adams, bdf, got 'euler'" in told
    assert "did you mean 'solver.step'?" in told and "got 2 m" in told
    with pytest.raises(ConfigurationError, match=r"no parameter or start value is named 'solver.method'"):
        resolved(tmp_path, reference_fmu("Dahlquist"), **{"with": settings})
