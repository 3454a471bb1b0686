"""Exported FMUs against the standard, their Python source, closed forms, scipy and other importers."""

from __future__ import annotations

import ctypes
import math
import re
import subprocess
import sys
import zipfile
from dataclasses import replace
from pathlib import Path

import fmpy
import numpy as np
import pytest
from fmpy import read_model_description
from fmpy.fmi2 import FMU2Model, FMU2Slave, fmi2OK
from fmpy.fmi3 import FMU3Model, FMU3Slave
from fmpy.validation import validate_fmu
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from fmus.component import Signal
from fmus.export import build_fmu, cached_fmu
from fmus.model import FlatModel, Model, ModelError
from fmus.plants.driveline import MODEL as DRIVELINE
from tests.models import BALL, BLOW_UP, EVERY_KIND, FILTER, LAG, RELAY, VAN_DER_POL, lag_solution

MODELS = [LAG, VAN_DER_POL, BALL, RELAY, BLOW_UP, FILTER, EVERY_KIND, DRIVELINE]


class Session:
    """One instance of an exported FMU, driven by FMPy's bindings of the C functions, nothing more."""

    def __init__(self, model: Model, folder: Path, fmi: int = 2, exchange: bool = False, **starts: float) -> None:
        path = build_fmu(model, folder / f"{model.name}-{fmi}-{len(list(folder.glob('*.fmu')))}.fmu", fmi)
        self.unpacked = folder / f"{path.stem}-unpacked"
        with zipfile.ZipFile(path) as archive:
            archive.extractall(self.unpacked)
        description = read_model_description(path)
        self.fmi = fmi
        self.vr = {variable.name: variable.valueReference for variable in description.modelVariables}
        kind = {(2, False): FMU2Slave, (2, True): FMU2Model, (3, False): FMU3Slave, (3, True): FMU3Model}[fmi, exchange]
        part = description.modelExchange if exchange else description.coSimulation
        guid = description.guid if fmi == 2 else description.instantiationToken
        self.fmu = kind(
            unzipDirectory=str(self.unpacked), modelIdentifier=part.modelIdentifier, instanceName="i", guid=guid
        )
        self.fmu.instantiate()
        for name, value in starts.items():
            self.set(name.replace("__", "."), value)
        if fmi == 2:
            self.fmu.setupExperiment(startTime=0.0)
            self.fmu.enterInitializationMode()
        else:
            self.fmu.enterInitializationMode(startTime=0.0)

    def begin(self) -> Session:
        self.fmu.exitInitializationMode()
        return self

    def set(self, name: str, value: float) -> None:
        real, integer = (
            (self.fmu.setReal, self.fmu.setInteger) if self.fmi == 2 else (self.fmu.setFloat64, self.fmu.setInt32)
        )
        (integer if name == "solver.method" else real)([self.vr[name]], [value])

    def get(self, name: str) -> float:
        return (self.fmu.getReal if self.fmi == 2 else self.fmu.getFloat64)([self.vr[name]])[0]

    def integer(self, name: str) -> int:
        return (self.fmu.getInteger if self.fmi == 2 else self.fmu.getInt32)([self.vr[name]])[0]

    def step(self, t: float, h: float) -> None:
        self.fmu.doStep(currentCommunicationPoint=t, communicationStepSize=h)

    def run(self, stop: float, steps: int) -> None:
        for k in range(steps):
            self.step(k * (stop / steps), stop / steps)


@pytest.mark.parametrize("model", MODELS, ids=lambda model: model.name)
@pytest.mark.parametrize("fmi", [2, 3])
def test_fmpys_validator_has_no_message(model: Model, fmi: int, tmp_path: Path) -> None:
    path = build_fmu(model, tmp_path / "m.fmu", fmi)
    assert validate_fmu(str(path)) == []


@pytest.mark.parametrize("fmi", [2, 3])
def test_every_function_of_the_standard_is_in_the_binary(fmi: int, tmp_path: Path) -> None:
    header = (Path(fmpy.__file__).parent / "c-code" / f"fmi{fmi}FunctionTypes.h").read_text()
    names = set(re.findall(rf"(fmi{fmi}\w+)TYPE\b", header))
    assert len(names) > 30
    library = ctypes.CDLL(str(next((Session(LAG, tmp_path, fmi).unpacked / "binaries").rglob("lag.*"))))
    assert {name for name in names if not hasattr(library, name)} == set()


def test_the_same_model_gives_the_same_bytes(tmp_path: Path) -> None:
    first, second = (build_fmu(LAG, tmp_path / name).read_bytes() for name in ("a.fmu", "b.fmu"))
    assert first == second
    assert cached_fmu(LAG).read_bytes() == first


@pytest.mark.parametrize("fmi", [2, 3])
def test_rk4_converges_with_order_four(fmi: int, tmp_path: Path) -> None:
    errors = []
    for step in (0.1, 0.05, 0.025):
        session = Session(LAG, tmp_path, fmi, solver__step=step).begin()
        session.run(2.0, 2)
        errors.append(abs(session.get("x") - lag_solution(2.0)))
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    # Halving the step divides the error of a method of order 4 by 16, but for higher terms (a h = 0.2).
    assert np.all(np.abs(orders - 4.0) < 0.3), (errors, orders)


def test_rodas4_converges_with_order_four_on_a_problem_that_depends_on_time(tmp_path: Path) -> None:
    errors = []
    for step in (0.2, 0.1, 0.05):
        session = Session(LAG, tmp_path, solver__method=2, solver__step=step).begin()
        session.run(2.0, 2)
        errors.append(abs(session.get("x") - lag_solution(2.0)))
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert np.all(np.abs(orders - 4.0) < 0.5), (errors, orders)


def test_rodas4_converges_with_order_four_on_a_nonlinear_problem(tmp_path: Path) -> None:
    def rhs(t: float, x: np.ndarray) -> list[float]:
        return [x[1], (1.0 - x[0] ** 2) * x[1] - x[0]]

    exact = solve_ivp(rhs, (0.0, 2.0), [2.0, 0.0], method="DOP853", rtol=1e-13, atol=1e-14).y[:, -1]
    errors = []
    for step in (0.025, 0.0125, 0.00625):
        session = Session(VAN_DER_POL, tmp_path, solver__method=2, solver__step=step).begin()
        session.run(2.0, 1)
        errors.append(np.hypot(session.get("x") - exact[0], session.get("v") - exact[1]))
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    # The terms of order 4 and 5 have opposite signs here, so the order is approached from below.
    assert np.all(np.abs(orders - 4.0) < 0.4), (errors, orders)


def test_rodas4_converges_with_order_four_where_its_factorisation_swaps_rows_again_and_again(tmp_path: Path) -> None:
    # States of sizes from 1e-3 to 1e5: the largest elements of a column lie off the diagonal.
    size = np.array([1.0, 1e5, 1e-3, 1e2, 1e4])
    decay = -np.eye(5) + 0.8 * np.random.default_rng(3).normal(size=(5, 5))
    matrix = size[:, None] * decay / size
    model = Model(
        name="scales",
        description="x' = A x with states of very different sizes",
        equations=lambda t, x, m, u, p: ({"x": matrix @ x.x}, {}),
        states=(Signal("x", shape=(5,), start=tuple(size)),),
        solver_method="rodas4",
    )
    stop = 0.4
    exact = expm(decay * stop) @ np.ones(5)
    errors = []
    for step in (0.2, 0.1, 0.05):
        session = Session(model, tmp_path, solver__step=step).begin()
        session.run(stop, 1)
        got = np.array([session.get(f"x[{i}]") for i in range(1, 6)]) / size
        errors.append(np.abs(got - exact).max())
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert np.all(np.abs(orders - 4.0) < 0.5), (errors, orders)


def test_rodas4_with_error_control_solves_a_stiff_oscillator_to_its_tolerance(tmp_path: Path) -> None:
    mu, stop = 1000.0, 500.0

    def rhs(t: float, x: np.ndarray) -> list[float]:
        return [x[1], mu * (1.0 - x[0] ** 2) * x[1] - x[0]]

    def jac(t: float, x: np.ndarray) -> list[list[float]]:
        return [[0.0, 1.0], [-2.0 * mu * x[0] * x[1] - 1.0, mu * (1.0 - x[0] ** 2)]]

    exact = solve_ivp(rhs, (0.0, stop), [2.0, 0.0], method="Radau", jac=jac, rtol=1e-11, atol=1e-13).y[:, -1]
    session = Session(VAN_DER_POL, tmp_path, mu=mu, solver__method=2, solver__step=1e-3, solver__tolerance=1e-8)
    session.begin().run(stop, 5)
    # The problem's slow branch contracts, so the global error stays near the tolerance; a factor 100 is allowed.
    assert session.get("x") == pytest.approx(exact[0], rel=1e-6)
    assert session.get("v") == pytest.approx(exact[1], rel=1e-6)


def driveline_by_scipy(torque: float, times: np.ndarray) -> np.ndarray:
    """Torsion of the driveline for a constant torque: its own Python source, its branches joined at their guards."""
    flat = FlatModel(DRIVELINE)
    p = [float(signal.start) for signal in DRIVELINE.parameters]

    def rhs(t: float, x: np.ndarray) -> list[float]:
        z = flat.indicators(t, list(x), [2.0], [torque], p)
        location = 1.0 + (z[0] > 0) + (z[1] > 0)
        return flat.derivatives_and_outputs(t, list(x), [location], [torque], p)[0]

    # The torque is continuous, so an error-controlled method may step across the kink: it only shortens its step.
    solution = solve_ivp(rhs, (0.0, times[-1]), [0.0, 0.0, 0.0], method="DOP853", rtol=1e-11, atol=1e-13, t_eval=times)
    return solution.y


@pytest.mark.parametrize("fmi", [2, 3])
def test_the_driveline_fmu_matches_its_source_under_scipy(fmi: int, tmp_path: Path) -> None:
    session = Session(DRIVELINE, tmp_path, fmi, T_eng=-10.0).begin()
    times = np.arange(1, 1001) * 1e-3
    rows = []
    for k in range(1000):
        session.step(k * 1e-3, 1e-3)
        rows.append([session.get(name) for name in ("theta_e", "omega_c", "omega_p")])
    exact = driveline_by_scipy(-10.0, times).T
    # RK4 at 1 ms: h^4 |x^(5)| is about (0.024)^4 of the signal; scipy's tolerance adds less than 1e-9.
    scale = np.abs(exact).max(axis=0)
    np.testing.assert_allclose(np.array(rows) / scale, exact / scale, rtol=0, atol=2e-6)


def test_model_exchange_gives_the_derivatives_of_the_python_source(tmp_path: Path) -> None:
    flat = FlatModel(DRIVELINE)
    p = [float(signal.start) for signal in DRIVELINE.parameters]
    for fmi in (2, 3):
        session = Session(DRIVELINE, tmp_path, fmi, exchange=True, T_eng=3.0, theta_e=-0.02, omega_c=2.0).begin()
        expected, outputs = flat.derivatives_and_outputs(0.0, [-0.02, 2.0, 0.0], [2.0], [3.0], p)
        got = [session.get(f"der({name})") for name in ("theta_e", "omega_c", "omega_p")]
        assert session.integer("location") == 2
        # The same expressions, but a compiler may order a sum otherwise than NumPy: a few units in the last place.
        np.testing.assert_allclose(got, expected, rtol=1e-14)
        assert session.get("y") == pytest.approx(outputs[0], rel=1e-14)


def central_difference(session: Session, known: str, unknowns: list[str], h: float) -> np.ndarray:
    values = []
    start = session.get(known)
    for sign in (1, -1):
        session.set(known, start + sign * h)
        values.append(np.array([session.get(name) for name in unknowns]))
    session.set(known, start)
    return (values[0] - values[1]) / (2 * h)


@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.parametrize("model", [LAG, VAN_DER_POL, DRIVELINE], ids=lambda model: model.name)
def test_directional_and_adjoint_derivatives_match_finite_differences(model: Model, fmi: int, tmp_path: Path) -> None:
    session = Session(model, tmp_path, fmi, exchange=True)  # in initialisation mode states, too, may be set
    unknowns = [f"der({signal.name})" for signal in model.states] + [signal.name for signal in model.outputs]
    knowns = [signal.name for signal in model.states + model.inputs + model.parameters]
    jacobian = np.empty((len(unknowns), len(knowns)))
    for j, known in enumerate(knowns):
        scale = max(1e-3, abs(session.get(known)))
        finite = central_difference(session, known, unknowns, 1e-4 * scale)
        references = [session.vr[name] for name in unknowns], [session.vr[known]]
        get = session.fmu.getDirectionalDerivative
        jacobian[:, j] = get(*references, [1.0])
        # Central differences err by h^2 = 1e-8 of the third derivative, and by rounding: 1e-16 / 1e-4 of a term that
        # may be 1e3 times the derivative.
        size = 1e-8 * max(1.0, np.abs(finite).max()) + 1e-7 * np.abs(finite)
        assert np.all(np.abs(jacobian[:, j] - finite) <= size), (known, jacobian[:, j], finite)
    if fmi == 3:
        for i, unknown in enumerate(unknowns):
            references = [session.vr[unknown]], [session.vr[name] for name in knowns]
            row = session.fmu.getAdjointDerivative(*references, [1.0], nSensitivity=len(knowns))
            np.testing.assert_allclose(row, jacobian[i], rtol=1e-13, atol=1e-15 * np.abs(jacobian[i]).max())


def test_events_are_located_where_a_bouncing_ball_meets_the_ground(tmp_path: Path) -> None:
    g, e = 9.81, 0.7
    first = math.sqrt(2.0 / g)
    impacts = [first]
    for n in range(1, 6):
        impacts.append(impacts[-1] + 2.0 * first * e**n)
    t = 0.5 * (impacts[4] + impacts[5])
    since = t - impacts[4]
    v = e**5 * math.sqrt(2.0 * g)
    for method in (1, 2):
        session = Session(BALL, tmp_path, solver__method=method, solver__step=0.01).begin()
        session.run(t, 3)
        assert session.integer("bounces") == 5
        # Both methods integrate a parabola exactly; each impact is located to 1e-13 of the step.
        assert session.get("height") == pytest.approx(v * since - 0.5 * g * since**2, abs=1e-11)
        assert session.get("v") == pytest.approx(v - g * since, abs=1e-10)


def test_at_a_zero_of_the_indicator_its_direction_decides_the_mode(tmp_path: Path) -> None:
    for start_speed, location in ((8.0, 3), (-8.0, 2)):
        # theta_e begins exactly on the upper angle; tau omega_c - omega_p is the torsion's speed.
        session = Session(DRIVELINE, tmp_path, theta_e=0.015 - 0.025, omega_c=start_speed).begin()
        assert session.integer("location") == location


def test_chattering_is_an_error_that_says_so(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    session = Session(RELAY, tmp_path).begin()
    with pytest.raises(Exception, match="status 3"):
        session.step(0.0, 1.0)
    assert "chattering" in capfd.readouterr().out


def test_a_state_that_is_not_finite_is_an_error_that_names_it(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    session = Session(BLOW_UP, tmp_path).begin()
    with pytest.raises(Exception, match="status 3"):
        session.run(1.0, 10)
    assert "'x' is not finite at t = 0.5" in capfd.readouterr().out


def test_a_fatal_blow_up_under_error_control_names_the_tolerance(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    session = Session(BLOW_UP, tmp_path, solver__method=2, solver__tolerance=1e-6).begin()
    with pytest.raises(Exception, match="status 3"):
        session.step(0.0, 1.0)
    assert "solver.tolerance" in capfd.readouterr().out


@pytest.mark.parametrize("fmi", [2, 3])
def test_a_serialised_state_continues_bit_for_bit_in_another_instance(fmi: int, tmp_path: Path) -> None:
    session = Session(DRIVELINE, tmp_path, fmi, T_eng=-10.0).begin()
    session.run(0.1, 100)
    state = session.fmu.getFMUState() if fmi == 3 else session.fmu.getFMUstate()
    data = (session.fmu.serializeFMUState if fmi == 3 else session.fmu.serializeFMUstate)(state)

    def onward(other: Session) -> list[float]:
        values = []
        for k in range(100, 400):
            other.step(k * 1e-3, 1e-3)
            values += [other.get("theta_e"), other.get("omega_c"), other.integer("location")]
        return values

    expected = onward(session)
    fresh = Session(DRIVELINE, tmp_path, fmi).begin()
    if fmi == 3:
        fresh.fmu.setFMUState(fresh.fmu.deserializeFMUState(data))
    else:
        fresh.fmu.setFMUstate(fresh.fmu.deSerializeFMUstate(data))
    assert onward(fresh) == expected
    (session.fmu.setFMUState if fmi == 3 else session.fmu.setFMUstate)(state)
    assert onward(session) == expected


CONTINUE = """
import sys
from pathlib import Path
from fmpy.fmi2 import FMU2Slave
unpacked, guid, data = sys.argv[1:4]
fmu = FMU2Slave(unzipDirectory=unpacked, modelIdentifier="driveline", instanceName="j", guid=guid)
fmu.instantiate()
fmu.setFMUstate(fmu.deSerializeFMUstate(Path(data).read_bytes()))
for k in range(100, 300):
    fmu.doStep(currentCommunicationPoint=k * 1e-3, communicationStepSize=1e-3)
print(fmu.getReal([1])[0].hex())
"""


def test_a_serialised_state_continues_bit_for_bit_in_a_new_process(tmp_path: Path) -> None:
    session = Session(DRIVELINE, tmp_path, T_eng=-10.0).begin()
    session.run(0.1, 100)
    (tmp_path / "state").write_bytes(session.fmu.serializeFMUstate(session.fmu.getFMUstate()))
    arguments = [str(session.unpacked), session.fmu.guid, str(tmp_path / "state")]
    printed = subprocess.run([sys.executable, "-c", CONTINUE, *arguments], capture_output=True, text=True, check=True)
    for k in range(100, 300):
        session.step(k * 1e-3, 1e-3)
    assert printed.stdout.strip() == session.get("theta_e").hex()


def test_a_state_of_another_model_is_refused(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    session, other = Session(LAG, tmp_path).begin(), Session(BALL, tmp_path).begin()
    data = session.fmu.serializeFMUstate(session.fmu.getFMUstate())
    with pytest.raises(Exception, match="status 3"):
        other.fmu.deSerializeFMUstate(data)
    assert "not a state of this model" in capfd.readouterr().out


def test_reset_restores_every_start_value(tmp_path: Path) -> None:
    session = Session(DRIVELINE, tmp_path, T_eng=-10.0, k=2000.0).begin()
    session.run(0.2, 100)
    session.fmu.reset()
    session.fmu.setupExperiment(startTime=0.0)
    session.fmu.enterInitializationMode()
    session.fmu.exitInitializationMode()
    assert [session.get(name) for name in ("theta_e", "omega_c", "T_eng", "k")] == [0.0, 0.0, 0.0, 1500.0]


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda s: s.step(0.0, 0.1), "fmi2DoStep may not be called in the state 'initialization mode'"),
        (lambda s: (s.begin(), s.step(0.0, 0.0)), "wants a step above zero"),
        (lambda s: (s.begin(), s.step(0.5, 0.1)), "wants to begin at t = 0 s, got 0.5 s"),
        (lambda s: (s.begin(), s.set("x", 1.0)), "'x' may not be set in the state 'step mode'"),
        (lambda s: s.set("y", 1.0), "'y' may not be set"),
        (lambda s: s.fmu.setReal([10_000], [1.0]), "no variable has the value reference 10000"),
        (lambda s: s.fmu.setInteger([s.vr["x"]], [1]), "'x' is of type real"),
        (lambda s: s.set("solver.step", 0.0), "'solver.step' wants a step above zero"),
        (lambda s: s.set("solver.method", 3), "wants 1 (RK4) or 2 (RODAS4), got 3"),
        (lambda s: s.fmu.getDirectionalDerivative([s.vr["x"]], [s.vr["y"]], [1.0]), "no derivative with respect to"),
    ],
)
def test_a_wrong_call_is_an_error_that_names_it(
    call: object, message: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    session = Session(LAG, tmp_path)
    with pytest.raises(Exception, match="status 3"):
        call(session)  # type: ignore[operator]
    assert message in capfd.readouterr().out


def test_a_wrong_token_is_refused(tmp_path: Path) -> None:
    session = Session(LAG, tmp_path)
    wrong = FMU2Slave(
        unzipDirectory=str(session.unpacked), modelIdentifier="lag", instanceName="i", guid="{not this one}"
    )
    with pytest.raises(Exception, match="instantiate"):
        wrong.instantiate()


def test_a_sampled_model_updates_at_the_end_of_the_step_with_its_inputs(tmp_path: Path) -> None:
    for fmi in (2, 3):
        session = Session(FILTER, tmp_path, fmi).begin()
        z = np.array([1.0, -1.0])
        A, L = np.array([[0.9, 0.1], [0.0, 0.8]]), np.array([0.5, 0.25])
        assert [session.get(f"estimate[{i}]") for i in (1, 2)] == [1.0, -1.0]
        for k in range(20):
            y = math.sin(k)
            session.set("y", y)
            session.step(k * 0.01, 0.01)
            z = A @ z + L * y
            got = [session.get(f"estimate[{i}]") for i in (1, 2)]
            np.testing.assert_allclose(got, z, rtol=1e-14, atol=1e-15)  # sums of terms up to 1


def test_a_sampled_model_keeps_its_period_within_and_across_longer_and_shorter_steps(tmp_path: Path) -> None:
    session = Session(FILTER, tmp_path).begin()
    session.set("y", 1.0)
    z, A, L = np.array([1.0, -1.0]), np.array([[0.9, 0.1], [0.0, 0.8]]), np.array([0.5, 0.25])
    t = 0.0
    for h, samples in ((0.035, 3), (0.004, 0), (0.001, 1), (0.0599, 5), (0.0001, 1)):
        session.step(t, h)
        t += h
        for _ in range(samples):
            z = A @ z + L
        np.testing.assert_allclose(session.get("estimate[1]"), z[0], rtol=1e-14, err_msg=f"t = {t}")


def test_fmi3_event_mode_returns_early_at_the_event_and_goes_on(tmp_path: Path) -> None:
    path = build_fmu(BALL, tmp_path / "ball.fmu", 3)
    with zipfile.ZipFile(path) as archive:
        archive.extractall(tmp_path / "ball")
    description = read_model_description(path)
    vr = {variable.name: variable.valueReference for variable in description.modelVariables}
    fmu = FMU3Slave(
        unzipDirectory=str(tmp_path / "ball"),
        modelIdentifier="ball",
        instanceName="i",
        guid=description.instantiationToken,
    )
    fmu.instantiate(eventModeUsed=True, earlyReturnAllowed=True)
    fmu.enterInitializationMode(startTime=0.0)
    fmu.exitInitializationMode()
    fmu.updateDiscreteStates()
    fmu.enterStepMode()
    needed, terminate, early, last = fmu.doStep(currentCommunicationPoint=0.0, communicationStepSize=1.0)
    assert (needed, terminate, early) == (True, False, True)
    assert last == pytest.approx(math.sqrt(2.0 / 9.81), abs=1e-12)
    assert fmu.getInt32([vr["bounces"]]) == [0]
    fmu.enterEventMode()
    fmu.updateDiscreteStates()
    fmu.enterStepMode()
    assert fmu.getInt32([vr["bounces"]]) == [1]
    assert fmu.getFloat64([vr["v"]])[0] == pytest.approx(0.7 * math.sqrt(2.0 * 9.81), rel=1e-12)
    needed, terminate, early, last = fmu.doStep(currentCommunicationPoint=last, communicationStepSize=0.1)
    assert (needed, early) == (False, False)


def test_every_kind_of_variable_passes_in_and_out(tmp_path: Path) -> None:
    session = Session(EVERY_KIND, tmp_path).begin()
    session.fmu.setInteger([session.vr["count"]], [3])
    session.set("gain", 4.0)
    session.step(0.0, 0.1)
    assert session.get("sum") == 5.0
    assert session.fmu.getBoolean([session.vr["positive"]]) == [True]
    assert session.fmu.getInteger([session.vr["doubled"]]) == [6]


def test_units_are_declared_with_their_factor_to_si(tmp_path: Path) -> None:
    description = read_model_description(build_fmu(DRIVELINE, tmp_path / "d.fmu"))
    units = {unit.name: unit.baseUnit for unit in description.unitDefinitions}
    assert (units["rpm"].rad, units["rpm"].s) == (1, -1)
    assert units["rpm"].factor == pytest.approx(2 * math.pi / 60, rel=1e-15)
    assert (units["N.m/rad"].kg, units["N.m/rad"].m, units["N.m/rad"].s, units["N.m/rad"].rad) == (1, 2, -2, -1)


def test_dependencies_tell_feedthrough_and_what_sampling_passes_on(tmp_path: Path) -> None:
    def of(model: Model) -> dict[str, list[str]]:
        description = read_model_description(build_fmu(model, tmp_path / f"{model.name}.fmu"))
        return {u.variable.name: [d.name for d in u.dependencies] for u in description.outputs}

    assert of(LAG) == {"x": ["x"], "y": ["x", "u"]}
    assert of(DRIVELINE)["y"] == ["omega_c"]
    assert of(FILTER) == {"estimate[1]": ["y"], "estimate[2]": ["y"]}


def test_start_values_can_be_replaced_at_the_build(tmp_path: Path) -> None:
    path = build_fmu(LAG, tmp_path / "m.fmu", overrides={"a": 5.0})
    assert {v.name: v.start for v in read_model_description(path).modelVariables}["a"] == "5.0"
    with pytest.raises(ModelError, match="did you mean 'a'"):
        build_fmu(LAG, tmp_path / "n.fmu", overrides={"aa": 5.0})
    assert not (tmp_path / "n.fmu").exists()


@pytest.mark.parametrize(
    ("expression", "message"),
    [
        (lambda x: math.sin(x), r"np\.sin for math\.sin"),
        (lambda x: 1.0 if x > 0 else 0.0, r"np\.where"),
        (lambda x: max(x, 0.0), r"np\.maximum"),
        (lambda x: np.fft.fft([x, x])[0], "cannot be traced"),
        (lambda x: "three", "wants a number or a symbol"),
    ],
)
def test_what_cannot_be_traced_is_refused_with_a_remedy(expression: object, message: str, tmp_path: Path) -> None:
    model = replace(
        VAN_DER_POL,
        equations=lambda t, x, m, u, p: ({"x": expression(x.v), "v": 0.0}, {}),  # type: ignore[operator]
    )
    with pytest.raises(ModelError, match=message):
        build_fmu(model, tmp_path / "m.fmu")
    assert not (tmp_path / "m.fmu").exists()


def test_a_model_that_contradicts_its_declarations_is_refused(tmp_path: Path) -> None:
    missing = replace(LAG, equations=lambda t, x, m, u, p: ({}, {"y": 0.0}))
    with pytest.raises(ModelError, match="no derivative of the state 'x'"):
        build_fmu(missing, tmp_path / "m.fmu")
    misspelt = replace(LAG, equations=lambda t, x, m, u, p: ({"x": p.b}, {"y": 0.0}))
    with pytest.raises(ModelError, match="no parameter is named 'b'; did you mean 'a'"):
        build_fmu(misspelt, tmp_path / "m.fmu")
    in_milliseconds = (*FILTER.parameters[:2], Signal("period", "ms", 10.0))
    with pytest.raises(ModelError, match="'period' is the sample time and wants to be a scalar in s"):
        replace(FILTER, parameters=in_milliseconds)
    with pytest.raises(ModelError, match="'x' is declared twice"):
        replace(LAG, parameters=(Signal("x"),))


def test_fmpy_and_libcosim_simulate_the_export_to_the_same_trajectory(tmp_path: Path) -> None:
    pytest.importorskip("libcosimpy", reason="libcosim has wheels for Linux on x86_64 only")
    path = build_fmu(DRIVELINE, tmp_path / "driveline.fmu")
    result = fmpy.simulate_fmu(
        str(path), stop_time=1.0, output_interval=1e-3, start_values={"T_eng": -10.0}, output=["theta_e", "location"]
    )
    vr = {v.name: v.valueReference for v in read_model_description(path).modelVariables}
    code = LIBCOSIM.format(path=str(path), torque=vr["T_eng"], torsion=vr["theta_e"], location=vr["location"])
    printed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    rows = [line.split()[1:] for line in printed.splitlines() if line.startswith("row")]
    torsion = np.array([float(row[0]) for row in rows])
    # The same binary; the importers add up time in their own ways (libcosim in nanoseconds), which moves t by 1 ulp.
    np.testing.assert_allclose(torsion, result["theta_e"][100::100], rtol=0, atol=1e-12)
    assert [int(row[1]) for row in rows] == list(result["location"][100::100])


LIBCOSIM = """
from libcosimpy.CosimExecution import CosimExecution
from libcosimpy.CosimObserver import CosimObserver
from libcosimpy.CosimSlave import CosimLocalSlave
execution = CosimExecution.from_step_size(step_size=1_000_000)
slave = CosimLocalSlave(fmu_path={path!r}, instance_name="plant")
index = execution.add_local_slave(local_slave=slave)
observer = CosimObserver.create_last_value()
execution.add_observer(observer)
execution.real_initial_value(index, {torque}, -10.0)
for tenth in range(1, 11):
    execution.simulate_until(tenth * 100_000_000)
    print("row", observer.last_real_values(index, [{torsion}])[0], observer.last_integer_values(index, [{location}])[0])
"""


def test_the_sources_in_the_fmu_build_to_the_same_model(tmp_path: Path) -> None:
    from fmus.toolchain import compile_shared

    for fmi in (2, 3):
        session = Session(LAG, tmp_path, fmi)
        sources = session.unpacked / "sources"
        library = compile_shared((sources / "model.c").read_text(), includes=[sources])
        assert hasattr(ctypes.CDLL(str(library)), f"fmi{fmi}DoStep")


def test_the_example_of_the_documentation_drains_by_torricellis_law(tmp_path: Path) -> None:
    text = (Path(__file__).parents[1] / "docs" / "models.md").read_text()
    scope: dict[str, Model] = {}
    exec(re.search(r"```python\n(.*?)```", text, re.S)[1], scope)  # type: ignore[index]
    session = Session(scope["TANK"], tmp_path).begin()
    session.run(10.0, 10)
    # sqrt(h) falls linearly, by c / (2 area) a second: h is a parabola, which RK4 follows up to rounding.
    assert session.get("h") == pytest.approx((1.0 - 0.1 / 4.0 * 10.0) ** 2, rel=1e-12)
    assert session.get("level") == pytest.approx(100.0 * session.get("h"), rel=1e-15)


def test_status_ok_is_what_fmpy_calls_ok() -> None:
    assert fmi2OK == 0
