"""Loaded FMUs step as the standard, FMPy's calls and closed forms say."""

from __future__ import annotations

import ctypes
import json
import zipfile
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from third_party import reference_fmu, third_party_fmu

from fmus.component import DISCARD, ERROR, Component, ConfigurationError, StepError, Vector
from fmus.description import forget
from fmus.fmu import FmuComponent, describe, load_fmu
from fmus.toolchain import cache_folder, compile_shared, library_suffix, native_platform

MODELS = [(model, fmi) for model in ("VanDerPol", "Dahlquist", "BouncingBall", "Stair") for fmi in (2, 3)]
STEPS = {"VanDerPol": 0.05, "Dahlquist": 0.1, "BouncingBall": 0.01, "Stair": 0.2}


def starts_of(component: Component) -> Vector:
    return np.array([signal.start for signal in component.inputs], dtype=float)


def trajectory(component: FmuComponent, h: float, n: int, t0: float = 0.0) -> Vector:
    """Outputs at t0 + k h, k = 0..n, inputs held at their start values, shape (n + 1, n_outputs)."""
    u = starts_of(component)
    rows = [component.start(t0, u)]
    rows += [component.step(t0 + k * h, h, u) for k in range(n)]
    return np.array(rows)


def fmpy_trajectory(path: Path, names: list[str], h: float, n: int) -> Vector:
    """The same by FMPy's own calls, real and integer outputs."""
    from fmpy import extract, read_model_description
    from fmpy.fmi2 import FMU2Slave
    from fmpy.fmi3 import FMU3Slave

    read = read_model_description(path)
    arguments = {
        "guid": read.guid,
        "unzipDirectory": str(extract(path)),
        "modelIdentifier": read.coSimulation.modelIdentifier,
        "instanceName": "oracle",
    }
    variables = {variable.name: variable for variable in read.modelVariables}
    if read.fmiVersion == "2.0":
        fmu = FMU2Slave(**arguments)
        fmu.instantiate()
        fmu.setupExperiment(startTime=0.0)
        fmu.enterInitializationMode()
        getters = {"Real": fmu.getReal, "Integer": fmu.getInteger}
    else:
        fmu = FMU3Slave(**arguments)
        fmu.instantiate()
        fmu.enterInitializationMode(startTime=0.0)
        getters = {"Float64": fmu.getFloat64, "Int32": fmu.getInt32}
    fmu.exitInitializationMode()

    def row() -> list[float]:
        return [getters[variables[name].type]([variables[name].valueReference])[0] for name in names]

    rows = [row()]
    for k in range(n):
        fmu.doStep(k * h, h)
        rows.append(row())
    fmu.terminate()
    fmu.freeInstance()
    return np.array(rows, dtype=float)


@pytest.mark.parametrize(("model", "fmi"), MODELS)
def test_a_trajectory_equals_that_of_fmpys_calls_bit_for_bit(model: str, fmi: int):
    component = load_fmu(reference_fmu(model, fmi))
    ours = trajectory(component, STEPS[model], 40)
    names = [signal.name for signal in component.outputs]
    component.close()
    assert np.array_equal(ours, fmpy_trajectory(reference_fmu(model, fmi), names, STEPS[model], 40))


@pytest.mark.parametrize("fmi", [2, 3])
def test_the_dahlquist_fmu_decays_as_its_euler_steps_say(fmi: int):
    component = load_fmu(reference_fmu("Dahlquist", fmi), starts={"k": 2.0, "x": 3.0})
    x = trajectory(component, 0.1, 50)[:, 0]
    component.close()
    # The FMU makes one Euler step of 0.1 a communication step; 50 roundings of relative size 1e-16 each.
    assert np.allclose(x, 3.0 * (1 - 0.1 * 2.0) ** np.arange(51), rtol=1e-13, atol=0.0)


def test_the_van_der_pol_fmu_follows_the_oscillator_to_the_order_of_its_step():
    component = load_fmu(reference_fmu("VanDerPol"), starts={"mu": 1.5})
    ours = trajectory(component, 0.01, 500)
    component.close()

    def rates(t: float, x: Vector) -> list[float]:
        return [x[1], 1.5 * (1 - x[0] ** 2) * x[1] - x[0]]

    truth = solve_ivp(rates, (0.0, 5.0), [2.0, 0.0], rtol=1e-10, atol=1e-12, t_eval=np.arange(501) * 0.01).y.T
    # Euler's method with h = 0.01 is wrong by about h times the slope (up to 4 here) after a few units of time.
    assert np.abs(ours - truth).max() < 0.15
    euler = [np.array([2.0, 0.0])]
    for _ in range(500):
        euler.append(euler[-1] + 0.01 * np.array(rates(0.0, euler[-1])))
    assert np.allclose(ours, euler, rtol=0.0, atol=1e-11)  # the same steps, rounded in another order


def test_the_bouncing_ball_falls_freely_until_it_bounces_at_its_restitution():
    component = load_fmu(reference_fmu("BouncingBall"), starts={"h": 2.0, "e": 0.5})
    h, v = trajectory(component, 0.01, 120).T
    component.close()
    bounce = int(np.argmax(v > 0))
    n = np.arange(bounce)
    assert np.allclose(v[:bounce], -9.81 * 0.01 * n, atol=1e-12)
    # Euler's fall lags or leads the parabola by g dt t / 2.
    assert np.abs(h[:bounce] - (2.0 - 9.81 * (0.01 * n) ** 2 / 2)).max() <= 9.81 * 0.01 * 0.65 / 2 + 1e-12
    assert v[bounce] == pytest.approx(-0.5 * v[bounce - 1], rel=0.04)  # one step of gravity lies between


@pytest.mark.parametrize("fmi", [2, 3])
def test_an_fmu_that_asks_to_end_ends_in_a_discard_that_says_when(fmi: int):
    component = load_fmu(reference_fmu("Stair", fmi), name="stair")
    counted = trajectory(component, 1.0, 8)[:, 0]
    assert np.array_equal(counted, np.arange(1, 10))
    with pytest.raises(StepError, match=r"asked to end at t = 9 s") as raised:
        component.step(8.0, 1.0, np.empty(0))
    assert (raised.value.status, raised.value.part, raised.value.time) == (DISCARD, "stair", 8.0)
    component.close()


@pytest.mark.parametrize("fmi", [2, 3])
def test_every_type_passes_from_input_to_output(fmi: int):
    component = load_fmu(reference_fmu("Feedthrough", fmi))
    given = starts_of(component)
    for i, signal in enumerate(component.inputs):
        if signal.kind == "boolean":
            given[i] = 1.0
        elif signal.name.startswith("Enumeration"):
            given[i] = 2.0
        else:
            given[i] = {"Float32": 0.375, "Float64": 0.1, "Int8": -128, "UInt8": 255, "UInt64": 2.0**53}.get(
                signal.name.split("_")[0], 77
            )
    component.start(0.0, starts_of(component))
    assert np.array_equal(component.step(0.0, 0.5, given), given)
    component.close()


def test_what_does_not_fit_an_integer_is_rounded_and_kept_in_range():
    component = load_fmu(reference_fmu("Feedthrough", 3))
    u = starts_of(component)
    names = [signal.name for signal in component.inputs]
    u[names.index("Int8_input")] = 300.0
    u[names.index("UInt16_input")] = -1.0
    u[names.index("Int32_input")] = 2.6
    u[names.index("Boolean_input")] = 0.5
    component.start(0.0, starts_of(component))
    y = dict(zip((signal.name for signal in component.outputs), component.step(0.0, 0.5, u), strict=True))
    assert (y["Int8_output"], y["UInt16_output"], y["Int32_output"], y["Boolean_output"]) == (127, 0, 3, 1)
    component.close()


def test_arrays_pass_as_scalars_in_row_major_order():
    rng = np.random.default_rng(3)
    a, b, c, d = matrices = rng.normal(size=(4, 3, 3))
    u, v = rng.normal(size=(2, 3))
    starts = {
        f"{name}[{i + 1},{j + 1}]": matrix[i, j]
        for name, matrix in zip("ABCD", matrices, strict=True)
        for i in range(3)
        for j in range(3)
    }
    component = load_fmu(reference_fmu("StateSpace", 3), starts=starts)
    assert [signal.name for signal in component.inputs] == ["u[1]", "u[2]", "u[3]"]
    y0 = component.start(0.0, u)
    h = 1e-3  # the step of the FMU's own solver
    y1, y2 = component.step(0.0, h, u), component.step(h, h, v)
    # x' = A x + B u by Euler steps from x = 0, y = C x + D u; some twenty roundings.
    x1 = h * b @ u
    x2 = x1 + h * (a @ x1 + b @ v)
    assert np.allclose([y0, y1, y2], [d @ u, c @ x1 + d @ u, c @ x2 + d @ v], rtol=1e-13, atol=1e-13)
    assert component.applied_starts["C[2,3]"] == c[1, 2]
    component.close()


def test_a_start_forgets_all_that_went_before():
    component = load_fmu(reference_fmu("VanDerPol"))
    first = trajectory(component, 0.01, 30)
    assert np.array_equal(trajectory(component, 0.01, 30), first)
    assert np.array_equal(trajectory(component, 0.01, 30, t0=100.0), first)
    component.close()


def test_start_values_are_all_set_and_told():
    component = load_fmu(reference_fmu("BouncingBall"), starts={"e": 0.9})
    assert component.applied_starts == {}
    component.start(0.0, np.empty(0))
    assert component.applied_starts == {"h": 1.0, "v": 0.0, "g": -9.81, "e": 0.9}
    component.close()


def test_wrong_start_values_are_all_told_at_once():
    with pytest.raises(ConfigurationError) as raised:
        load_fmu(reference_fmu("BouncingBall"), starts={"e0": 0.6, "e": 0.4, "v_min": 1.0}, name="ball")
    told = str(raised.value).splitlines()
    assert len(told) == 3
    assert "no variable of ball is named 'e0'; did you mean 'e'?" in told[0]
    assert "ball.e wants 0.5 to 1, got 0.4" in told[1]
    assert "ball.v_min cannot be set" in told[2]


def test_the_native_step_is_the_step():
    component = load_fmu(reference_fmu("VanDerPol"))
    stepped = trajectory(component, 0.01, 50)
    y = component.start(0.0, np.empty(0))
    native = component.native()
    step = ctypes.CFUNCTYPE(
        ctypes.c_int, ctypes.c_void_p, ctypes.c_double, ctypes.c_double, ctypes.c_void_p, ctypes.c_void_p
    )(native.step)
    for k in range(50):
        assert step(native.self, k * 0.01, 0.01, None, y.ctypes.data) == 0
        assert np.array_equal(y, stepped[k + 1])
    component.close()
    assert step(native.self, 0.5, 0.01, None, y.ctypes.data) == ERROR


def test_outputs_left_out_are_not_fetched():
    component = load_fmu(reference_fmu("VanDerPol"))
    both = trajectory(component, 0.01, 20)
    component.select_outputs(["x1"])
    assert [signal.name for signal in component.outputs] == ["x1"]
    assert np.array_equal(trajectory(component, 0.01, 20), both[:, 1:])
    with pytest.raises(ConfigurationError, match="did you mean 'x0'"):
        component.select_outputs(["x00"])
    component.close()


def test_a_held_input_keeps_the_value_it_had_at_the_start():
    component = load_fmu(reference_fmu("Feedthrough", 3))
    component.hold_inputs(["Float64_continuous_input", "Int8_input"])
    names = [signal.name for signal in component.inputs]
    u = starts_of(component)
    u[names.index("Float64_continuous_input")], u[names.index("Int8_input")] = 1.5, 7.0
    component.start(0.0, u)
    y = dict(zip((s.name for s in component.outputs), component.step(0.0, 0.5, u + 1.0), strict=True))
    assert (y["Float64_continuous_output"], y["Int8_output"]) == (1.5, 7.0)
    assert (y["Float64_discrete_output"], y["Int32_output"]) == (1.0, 1.0)
    component.close()


def test_feedthrough_is_what_the_model_structure_declares():
    assert load_fmu(reference_fmu("VanDerPol")).feedthrough == frozenset()
    feedthrough = load_fmu(reference_fmu("Feedthrough", 3)).feedthrough
    assert ("Int8_output", "Int8_input") in feedthrough
    assert ("Int8_output", "Int16_input") not in feedthrough
    undeclared = load_fmu(reference_fmu("StateSpace", 3)).feedthrough
    assert undeclared == {(f"y[{i}]", f"u[{j}]") for i in (1, 2, 3) for j in (1, 2, 3)}


def test_a_closed_fmu_may_be_closed_again_but_not_stepped():
    component = load_fmu(reference_fmu("Dahlquist"))
    component.start(0.0, np.empty(0))
    component.close()
    component.close()
    with pytest.raises(StepError, match="no instance"):
        component.step(0.0, 0.1, np.empty(0))
    with pytest.raises(StepError, match="closed"):
        component.start(0.0, np.empty(0))


def test_two_components_of_one_fmu_do_not_know_of_each_other():
    slow, fast = (load_fmu(reference_fmu("Dahlquist"), starts={"k": k}) for k in (1.0, 3.0))
    u = np.empty(0)
    slow.start(0.0, u), fast.start(0.0, u)
    for k in range(10):
        x, z = slow.step(k * 0.1, 0.1, u), fast.step(k * 0.1, 0.1, u)
    slow.close()
    assert fast.step(1.0, 0.1, u)[0] == pytest.approx(0.7**11, rel=1e-13)  # 11 roundings
    assert (x[0], z[0]) == (pytest.approx(0.9**10, rel=1e-13), pytest.approx(0.7**10, rel=1e-13))
    fast.close()


def test_a_description_has_the_shape_that_inspect_prints():
    described = json.loads(json.dumps(describe(reference_fmu("BouncingBall")).to_json(), allow_nan=False))
    assert described["fmi_version"] == "2.0"
    assert described["kinds"] == ["cs", "me"]
    assert described["tool"].startswith("Reference FMUs")
    assert {"linux64", "win64", "darwin64", "c-code"} <= set(described["platforms"])
    assert described["runnable"] is True and described["reasons"] == []
    assert described["capabilities"]["canGetAndSetFMUstate"] is True
    height = next(variable for variable in described["variables"] if variable["name"] == "h")
    expected = {"causality": "output", "variability": "continuous", "type": "Real", "unit": "m", "start": 1.0}
    assert {key: height[key] for key in expected} == expected


def test_a_missing_binary_is_a_reason_and_a_refusal():
    path = third_party_fmu("CoupledClutches_CS_win64.fmu")
    if native_platform() == "win64":
        path = third_party_fmu("CoupledClutches_CS_linux64.fmu")
    description = describe(path)
    assert not description.runnable
    assert description.reasons[0].startswith(f"it has no binary for {native_platform()}; it has ")
    with pytest.raises(ConfigurationError, match="no binary"):
        load_fmu(path)


@pytest.mark.parametrize("fmi", [2, 3])
def test_an_fmus_complaint_reaches_the_error_and_the_log(fmi: int, capfd: pytest.CaptureFixture[str]):
    component = load_fmu(reference_fmu("Dahlquist", fmi), name="plant")
    component.start(5.0, np.empty(0))
    with pytest.raises(StepError, match=r"plant at t = 5 s: error: doing the step: Communication step size") as raised:
        component.step(5.0, -0.1, np.empty(0))
    assert raised.value.status == ERROR
    assert [(message.time, message.status) for message in component.log] == [(5.0, ERROR)]
    component.close()
    assert capfd.readouterr() == ("", "")


@pytest.mark.skipif(native_platform() != "linux64", reason="names are read of ELF files alone")
def test_a_binary_that_lacks_functions_is_a_reason_that_names_them(tmp_path: Path):
    library = compile_shared('__attribute__((visibility("default"))) int fmi2Instantiate(void) { return 0; }')
    path = tmp_path / "lacking.fmu"
    with zipfile.ZipFile(reference_fmu("Dahlquist")) as source, zipfile.ZipFile(path, "w") as target:
        target.writestr("modelDescription.xml", source.read("modelDescription.xml"))
        target.write(library, f"binaries/{native_platform()}/Dahlquist{library_suffix()}")
    (reason,) = describe(path).reasons
    assert reason.startswith("its binary lacks functions of the standard: fmi2SetupExperiment, ")
    assert "fmi2Instantiate" not in reason


def test_what_a_description_says_is_the_same_when_it_was_kept():
    path = reference_fmu("StateSpace", 3)
    describe(path)
    forget()
    kept = describe(path)
    forget()
    for file in (cache_folder() / "descriptions").glob(f"{kept.sha256}-*"):
        file.unlink()
    assert describe(path) == kept
