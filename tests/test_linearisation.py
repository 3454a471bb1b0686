"""Models and FMUs made linear: closed forms, agreement between the rungs, and what is said where none holds."""

from __future__ import annotations

import json
import re
import zipfile
from pathlib import Path

import numpy as np
import pytest
from deceiver import deceiver
from exchange_fmu import exchange_fmu
from hypothesis import given, settings
from hypothesis import strategies as st
from models import BALL, FILTER, LAG, VAN_DER_POL
from third_party import OPENMODELICA, reference_fmu, third_party_fmu

from fmus.component import ConfigurationError, Signal
from fmus.differences import Range, differences
from fmus.exchangefmu import ExchangeFmu
from fmus.export import cached_fmu
from fmus.initialfmu import InitialFmu
from fmus.linearfmu import linear_fmu
from fmus.linearmodel import LinearModel
from fmus.model import Model, ModelError
from fmus.plants import driveline, turbo_si
from fmus.rungs import Source
from fmus.statespace import AT_REST, StateSpace, at, imbalance, linearised, scales, settle
from fmus.steady import SteadyError
from harness.operating import Operation, operate


def space_of(model: Model, **values: float) -> StateSpace:
    """The model at its start values but these, SI."""
    system = LinearModel(model)
    return linearised(system, at(system.states, values), at(system.inputs, values))


def near(found: np.ndarray, wanted: object, **tolerances: float) -> bool:
    return found == pytest.approx(np.asarray(wanted, dtype=float), **tolerances)


def fmu_space(source: Source, settled: bool = False) -> StateSpace:
    system = linear_fmu(source)
    x, u = at(system.states, {}), at(system.inputs, source.starts_of(system.inputs))
    space = linearised(system, settle(system, x, u) if settled else x, u)
    system.close()
    return space


def cosimulation_only(path: Path, folder: Path) -> Path:
    """The FMU without Model Exchange in its description."""
    made = folder / f"alone_{path.name}"
    with zipfile.ZipFile(path) as old, zipfile.ZipFile(made, "w") as new:
        for entry in old.infolist():
            content = old.read(entry)
            if entry.filename == "modelDescription.xml":
                content, count = re.subn(rb"<ModelExchange[^>]*?(/>|>.*?</ModelExchange>)", b"", content, flags=re.S)
                assert count == 1
            new.writestr(entry, content)
    return made


def test_the_driveline_is_the_matrices_of_its_equations_in_si_units():
    p = {signal.name: float(signal.start) for signal in driveline.PARAMETERS}
    # At the start the torsion is 0.025 rad, beyond the angle at which the elasticity jumps: location 3, slope k_1.
    A, B, C, D = matrices(p, p["k_1"])
    space = space_of(driveline.MODEL)
    for found, wanted in zip((space.A, space.B, space.C, space.D), (A, B, C, D), strict=True):
        assert found == pytest.approx(wanted, rel=1e-14, abs=0)
    assert [s.name for s in space.states] == ["theta_e", "omega_c", "omega_p"]
    assert [s.name for s in space.outputs] == ["theta_e", "omega_c", "omega_p", "y"]


def matrices(p: dict[str, float], k: float) -> tuple[np.ndarray, ...]:
    tau, J_e, J_v, B_e, b = (p[name] for name in ("tau", "J_e", "J_v", "B_e", "b_sm"))
    A = np.array(
        [
            [0.0, tau, -1.0],
            [-tau * k / J_e, -(B_e + tau**2 * b) / J_e, tau * b / J_e],
            [k / J_v, tau * b / J_v, -b / J_v],
        ]
    )
    # y is in rpm, and in rad/s here: just omega_c.
    return A, np.array([[0.0], [1.0 / J_e], [0.0]]), np.vstack([np.eye(3), [0, 1, 0]]), np.zeros((4, 1))


def test_the_slope_is_that_of_the_location_that_the_point_lies_in():
    p = {signal.name: float(signal.start) for signal in driveline.PARAMETERS}
    for torsion, slope in ((0.0, "k_1"), (-0.02, "k"), (-0.045, "k_1")):
        assert near(space_of(driveline.MODEL, theta_e=torsion).A, matrices(p, p[slope])[0], rel=1e-14)


def test_a_driveline_settles_where_its_torques_balance_in_the_location_it_ends_in():
    system = LinearModel(driveline.MODEL)
    x = settle(system, at(system.states, {}), np.array([-10.0]))
    p = {signal.name: float(signal.start) for signal in driveline.PARAMETERS}
    # At rest: tau omega_c = omega_p, the shaft's torque is 0, so T_eng = B_e omega_c.
    omega = -10.0 / p["B_e"]
    assert x == pytest.approx([0.0, omega, p["tau"] * omega], abs=1e-9 * abs(omega))


def test_time_varying_inputs_feed_through_and_parameters_are_those_given():
    space = space_of(LAG)
    assert (space.A, space.B, space.C.tolist(), space.D.tolist()) == (-2.0, 1.0, [[1.0], [2.0]], [[0.0], [3.0]])
    given = LinearModel(LAG, {"a": 7.0})
    assert linearised(given, np.array([1.0]), np.array([0.0])).A == -7.0


@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.parametrize("model", [turbo_si.MODEL, driveline.MODEL], ids=lambda model: model.name)
def test_an_exported_model_has_the_matrices_of_its_source_by_directional_derivatives(model: Model, fmi: int):
    ours, theirs = space_of(model), fmu_space(Source(cached_fmu(model, fmi), {}))
    assert (ours.rung, theirs.rung) == ("exact", "directional")
    assert [s.name for s in theirs.outputs] == [s.name for s in ours.outputs]
    assert theirs.x0 == pytest.approx(ours.x0, rel=1e-15) and theirs.y0 == pytest.approx(ours.y0, rel=1e-14)
    for found, wanted in zip((theirs.A, theirs.B, theirs.C, theirs.D), (ours.A, ours.B, ours.C, ours.D), strict=True):
        # C and Python round the same formulas in another order.
        assert found == pytest.approx(wanted, rel=1e-12, abs=1e-13 * np.abs(wanted).max())
    assert theirs.rates == pytest.approx(ours.rates, abs=1e-9 * float((np.abs(ours.A) @ scales(ours.states)).max()))


@pytest.mark.parametrize("fmi", [2, 3])
def test_an_fmu_settles_where_its_source_does(fmi: int):
    system = LinearModel(turbo_si.MODEL)
    u = at(system.inputs, {"alpha": 0.3})
    wanted = settle(system, at(system.states, {}), u)
    space = fmu_space(Source(cached_fmu(turbo_si.MODEL, fmi), {"alpha": 0.3}), settled=True)
    assert space.x0 == pytest.approx(wanted, rel=1e-9)
    assert imbalance(space.A, space.rates, scales(space.states)).max() <= AT_REST


@pytest.mark.parametrize("fmi", [2, 3])
def test_cosimulation_alone_is_made_linear_in_initialisation_and_agrees_with_model_exchange(tmp_path: Path, fmi: int):
    both = cached_fmu(driveline.MODEL, fmi)
    alone = linear_fmu(Source(cosimulation_only(both, tmp_path), {}))
    assert isinstance(alone, InitialFmu) and isinstance(linear_fmu(Source(both, {})), ExchangeFmu)
    x, u = at(alone.states, {}), at(alone.inputs, {})
    found, wanted = linearised(alone, x, u), fmu_space(Source(both, {}))
    alone.close()
    assert found.rung == "directional"
    for one, other in zip((found.A, found.B, found.C, found.D), (wanted.A, wanted.B, wanted.C, wanted.D), strict=True):
        assert one == pytest.approx(other, rel=1e-14)


@pytest.mark.parametrize("fmi", [2, 3])
def test_reference_fmus_are_what_their_equations_say(fmi: int):
    # x0' = x1, x1' = mu (1 - x0^2) x1 - x0 at (2, 0) with mu = 1.
    oscillator = fmu_space(Source(reference_fmu("VanDerPol", fmi), {}))
    assert oscillator.rung == "directional"
    assert near(oscillator.A, np.array([[0.0, 1.0], [-1.0, -3.0]]), abs=1e-12)
    # x' = -k x: no derivatives are declared.
    decay = fmu_space(Source(reference_fmu("Dahlquist", fmi), {}))
    assert decay.rung == "differences" and "does not declare" in decay.evidence
    assert near(decay.A, np.array([[-1.0]]), abs=1e-12)


def test_differences_of_another_tools_fmu_are_its_equations():
    # m = 1 kg, c = 10000 N/m, d = 10 N.s/m; y = -s_rel.
    space = fmu_space(Source(third_party_fmu("Mass_Damper.fmu", OPENMODELICA), {}))
    assert space.rung == "differences"
    assert [s.name for s in space.states] == ["damper.s_rel", "damper.v_rel"]
    assert near(space.A, np.array([[0.0, 1.0], [-1e4, -10.0]]), abs=1e-6)
    assert near(space.C, np.array([[-1.0, 0.0]]), abs=1e-10)


@pytest.mark.parametrize("fmi", [1, 2])
def test_model_exchange_of_either_version_names_its_states(tmp_path: Path, fmi: int):
    # x' = u, r' = -sign; of five outputs two are the states, the others count and stay as they are.
    space = fmu_space(Source(exchange_fmu(tmp_path, fmi), {}))
    assert [s.name for s in space.states] == ["x", "r"]
    assert space.A.tolist() == [[0.0, 0.0], [0.0, 0.0]] and near(space.B, [[1.0], [0.0]], abs=1e-12)
    assert near(space.C, np.vstack([np.eye(2), np.zeros((3, 2))]), abs=1e-12)


def test_states_that_are_an_array_are_its_scalars():
    # Reference FMU: x' = A x + B u, y = C x + D u with matrices that start as identities.
    space = fmu_space(Source(reference_fmu("StateSpace", 3), {}))
    assert [s.name for s in space.states] == ["x[1]", "x[2]", "x[3]"]
    for found in (space.A, space.B, space.C, space.D):
        assert near(found, np.eye(3), abs=1e-10)


def test_an_fmu_begins_where_its_initialisation_puts_it():
    space = fmu_space(Source(third_party_fmu("MassSpringSystem.fmu", OPENMODELICA), {}))
    assert len(space.states) == 4
    assert space.x0.tolist() == [1.0, 0.0, 0.0, 1.0]
    assert near(space.A, [[0, 0, -2, 1], [0, 0, 1, -2], [1, 0, 0, 0], [0, 1, 0, 0]], abs=1e-8)


def test_derivatives_that_are_wrong_are_not_believed(monkeypatch: pytest.MonkeyPatch):
    source = Source(cached_fmu(driveline.MODEL), {})
    honest = fmu_space(source)
    column = ExchangeFmu._column
    monkeypatch.setattr(
        ExchangeFmu, "_column", lambda self, *asked: {k: 1.01 * v for k, v in column(self, *asked).items()}
    )
    lying = fmu_space(source)
    assert (honest.rung, lying.rung) == ("directional", "differences")
    assert near(lying.A, honest.A, rel=1e-9, abs=1e-9)
    assert "its directional derivative d y / d omega_c is 1.01, by differences 1" in lying.evidence


def test_cosimulation_alone_with_wrong_derivatives_is_refused_with_each_rung_and_its_reason(tmp_path: Path):
    assert near(fmu_space(Source(deceiver(tmp_path, "NONE"), {})).A, [[-1.0]], rel=1e-12)
    with pytest.raises(ConfigurationError) as refused:
        fmu_space(Source(deceiver(tmp_path, "DERIVES_WRONGLY"), {}))
    assert "directional: its directional derivative d y / d x is 2.02, by differences 2." in str(refused.value)
    assert "differences: of derivatives of Model Exchange, which it does not offer" in str(refused.value)


def test_cosimulation_alone_without_derivatives_is_refused(tmp_path: Path):
    with pytest.raises(ConfigurationError, match="directional: it does not declare directional derivatives"):
        fmu_space(Source(deceiver(tmp_path, "NONE", declared=False), {}))


def test_an_fmu_without_states_is_refused():
    with pytest.raises(ConfigurationError, match="it has no continuous states"):
        fmu_space(Source(reference_fmu("Stair", 2), {}))


def test_a_model_without_continuous_states_is_refused():
    with pytest.raises(ModelError, match="filter wants continuous states to be made linear, it has none"):
        LinearModel(FILTER)


def test_a_point_at_which_an_event_moves_a_state_is_refused():
    system = LinearModel(BALL)
    with pytest.raises(ModelError, match="ball: an event at this point changes its states"):
        linearised(system, np.array([-0.1, -1.0]), np.empty(0))


def test_a_derivative_that_is_not_finite_is_named():
    root = Model(
        name="root",
        description="x' = -sqrt(x), without a slope at 0",
        equations=lambda t, x, m, u, p: ({"x": -np.sqrt(x.x)}, {}),
        states=(Signal("x", start=0.0),),
    )
    with pytest.raises(ModelError, match=r"root: d der\(x\) / d x is -inf at this point"):
        space_of(root)


def test_what_never_rests_is_named_with_its_residual():
    system = LinearModel(VAN_DER_POL)
    assert settle(system, np.zeros(2), np.empty(0)).tolist() == [0.0, 0.0], "at rest already, though it is not stable"
    with pytest.raises(SteadyError, match="van_der_pol"):
        settle(system, np.array([2.0, 0.0]), np.empty(0))


def test_imbalance_is_rates_over_what_the_sizes_of_states_could_do():
    A = np.array([[2.0, -1.0], [0.0, 0.0]])
    assert imbalance(A, np.array([0.3, 0.0]), np.array([1.0, 10.0])).tolist() == [0.3 / 12.0, 0.0]
    assert imbalance(A, np.array([0.0, 1.0]), np.ones(2)).tolist() == [0.0, np.inf]


@settings(deadline=None, max_examples=100)
@given(st.floats(0.2, 3.0), st.floats(-2.0, 2.0), st.sampled_from(["inside", "at the top", "at the bottom"]))
def test_differences_of_smooth_functions_are_as_good_as_they_say(x, y, place):
    def function(z):
        return np.array([np.exp(z[0]) * z[1], np.sin(z[0] * z[1]), z[0] ** 3])

    wide = Range(1.0, -np.inf, np.inf)
    span = {"inside": wide, "at the top": Range(1.0, -np.inf, x), "at the bottom": Range(1.0, x, np.inf)}[place]
    found, errors = differences(function, np.array([x, y]), [span, wide])
    wanted = np.array([[np.exp(x) * y, np.exp(x)], [y * np.cos(x * y), x * np.cos(x * y)], [3 * x**2, 0.0]])
    # Nine halvings of 1 % leave some ten digits of a central quotient and some eight of a one-sided one.
    assert np.abs(found - wanted).max() < (1e-9 if place == "inside" else 1e-7) * max(1.0, np.abs(wanted).max())
    assert (errors[:, 1] < 1e-8).all()


def test_a_variable_without_room_has_no_difference():
    _, errors = differences(lambda z: z, np.array([1.0]), [Range(1.0, 1.0, 1.0)])
    assert errors.tolist() == [[np.inf]]


def test_the_json_of_the_command_has_the_shape_that_scripts_rely_on(crankbench):
    code, out, _ = crankbench("linearise", "driveline", "--at", "theta_e=-0.02 rad,k=2000 N.m/rad", "--json")
    found = json.loads(out)
    assert code == 0 and {"rung", "states", "inputs", "outputs", "A", "B", "C", "D", "point", "error"} <= set(found)
    assert found["rung"] == "exact" and found["states"] == ["theta_e", "omega_c", "omega_p"]
    assert found["point"] == {"theta_e": -0.02, "omega_c": 0.0, "omega_p": 0.0, "T_eng": 0.0}
    assert np.array(found["A"]).shape == (3, 3) and found["A"][2][0] == pytest.approx(2000.0 / 80.0)
    assert found["units"]["y"] == "rad/s" and 0.0 < found["error"] < 1e-15


def test_the_command_takes_units_sets_and_several_points_and_settles(crankbench):
    code, out, _ = crankbench(
        "linearise", "turbo_si", "--set", "B", "--at", "N=3000 rpm", "--at", "alpha=0.4", "--settle"
    )
    assert code == 0 and "rest   an equilibrium" in out
    assert "N = 314.159 rad/s, alpha = 0.4" in out
    code, out, _ = crankbench("linearise", "turbo_si", "--at", "alpha=0.4")
    assert code == 0 and "rest   no equilibrium: p_im changes by" in out


def test_a_vendors_fmu_is_made_linear_in_a_process_of_its_own(crankbench, tmp_path: Path):
    path = deceiver(tmp_path, "HANGS_IN_INSTANTIATE")
    with pytest.raises(ConfigurationError, match="timeout while it was doing instantiate"):
        operate(Operation(str(path), seconds=2.0))


def test_every_wrong_setting_is_named_at_once(crankbench):
    code, _, err = crankbench("linearise", "driveline", "--at", "thetae=1 rad,k=3 s", "--at", "J_e=1 kg.m2,tau=x")
    assert code == 2
    assert err.splitlines() == [
        "--at thetae=1 rad: thetae: no parameter or start value is named 'thetae'; did you mean 'theta_e'?",
        "--at k=3 s: k wants N.m/rad, got 3 s",
        "--at tau=x: tau: 'x' wants a number with a unit, like '1 ms'",
    ]
    code, _, err = crankbench("linearise", "driveline", "--at", "tau")
    assert (code, err) == (2, "--at tau: wants name=value, like N='2000 rpm'\n")
