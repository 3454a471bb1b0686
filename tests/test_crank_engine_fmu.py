"""The engine resolved in crank angle as an FMU: equal to its source, converging, on a crank clock, in a campaign."""

from __future__ import annotations

import re
import runpy
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from crank_course import CYLINDERS, RPM, SETS, Course, course, fuelled, vector
from fmpy.validation import validate_fmu
from model_twin import ModelTwin

from fmus import derivatives
from fmus.export import cached_fmu
from fmus.fmu import FmuComponent, load_fmu
from fmus.jacobians import jacobians, point
from fmus.model import FlatModel
from fmus.plants.crank_engine import MODEL
from fmus.units import parse_unit
from harness.building import Export, build_model
from harness.campaign import read_campaign
from harness.cases import execute
from harness.record import read_signals

PAGE = Path(__file__).resolve().parent.parent / "docs" / "crank_engine.md"
STATE_NAMES = [signal.name for signal in MODEL.states]
OUTPUT_NAMES = [signal.name for signal in MODEL.outputs]
SIGNALS = {signal.name: signal for signal in (*MODEL.states, *MODEL.discrete, *MODEL.outputs)}


@pytest.mark.parametrize("fmi", [2, 3])
def test_it_is_built_by_its_name_and_fmpys_validator_has_no_message(fmi, tmp_path: Path):
    path = build_model(MODEL.name, Export(tmp_path / "engine.fmu", fmi, parameter_set="si"))
    assert validate_fmu(str(path)) == []


def random_values(count: int) -> list[dict[str, float]]:
    """States all over the cycle, valves open and shut, gas going both ways, burning and not, by name."""
    generator, found = np.random.default_rng(5), []
    for _ in range(count):
        theta = generator.uniform(0.0, 40.0)
        values = {"theta": theta, "omega_e": generator.uniform(20.0, 700.0), "hold": generator.uniform(-100.0, 200.0)}
        for i in CYLINDERS:
            phi = theta - {1: 0.0, 3: 1.0, 4: 2.0, 2: 3.0}[i] * np.pi
            mass, share = generator.uniform(1e-5, 1e-3), generator.uniform(0.0, 0.09)
            values |= {
                f"cycle_{i}": np.floor((phi + 2.0 * np.pi) / (4.0 * np.pi)),
                f"U_{i}": generator.uniform(5.0, 900.0),
                f"m_{i}": mass,
                f"fuel_{i}": share * mass,
                f"burnt_{i}": 0.5 * share * mass,
                f"port_{i}": generator.uniform(0.0, 1e-6),
                f"share_{i}": generator.choice([0.0, share]),
            }
        found.append(values)
    return found


def at_rest(values: dict[str, float], parameter_set: str | None, fmi: int = 2) -> FmuComponent:
    """The FMU that starts from states and discrete states in declared units."""
    given = {**(MODEL.parameter_sets[parameter_set] if parameter_set else {}), **values}
    units = {signal.name: signal.unit for signal in (*MODEL.parameters, *MODEL.states, *MODEL.discrete)}
    si = {name: parse_unit(units[name]).to_si(float(value)) for name, value in given.items()}
    return load_fmu(cached_fmu(MODEL, fmi), starts=si)


@pytest.mark.parametrize("parameter_set", SETS)
@pytest.mark.parametrize("fmi", [2, 3])
def test_its_derivatives_and_outputs_are_those_of_the_python_source(fmi, parameter_set):
    for values in random_values(4):
        # Past no angle, so that initialisation changes nothing.
        values |= {f"stage_{i}": 2.0 for i in CYLINDERS}
        at = point(MODEL, {**values, **fuelled(2e-5)}, parameter_set)
        dx, y = FlatModel(MODEL).derivatives_and_outputs(0.0, list(at.x), list(at.m), list(at.u), list(at.p))
        component = at_rest(values, parameter_set, fmi)
        asked = derivatives.Questioned(component, 0.0, vector(fuelled(2e-5)))
        by_name = {variable.name: variable for variable in component.description.variables}
        got = asked.get([by_name[f"der({name})"] for name in STATE_NAMES] + [by_name[name] for name in OUTPUT_NAMES])
        component.close()
        expected = np.array([*dx, *y], dtype=float)
        # The same expressions by another pow and sqrt; powers of 1e5 W and torques of 1e4 N.m may nearly cancel.
        nominal = np.array([SIGNALS[name].nominal for name in STATE_NAMES + OUTPUT_NAMES])
        np.testing.assert_allclose(got / nominal, expected / nominal, rtol=1e-12, atol=1e-11)


def test_its_directional_derivatives_match_differences_of_its_values():
    for values in random_values(3):
        values |= {f"stage_{i}": 2.0 for i in CYLINDERS}
        component = at_rest(values, None)
        asked = derivatives.Questioned(component, 0.0, vector(fuelled(2e-5)))
        found = derivatives.compare(asked, derivatives.pairs(component.description))
        component.close()
        worst = max(found, key=lambda one: one.off if np.isfinite(one.off) else np.inf)
        # Central differences over 1e-5 of a value.
        assert worst.off * derivatives.TOLERANCE < 1e-5, worst


def test_every_derivative_is_finite_in_every_state():
    engine = jacobians(MODEL)
    for parameter_set in SETS:
        for values in random_values(20):
            linear = engine.at(point(MODEL, values, parameter_set))
            assert all(np.isfinite(matrix).all() for matrix in (linear.A, linear.B, linear.C, linear.D))


@pytest.mark.parametrize("parameter_set", SETS)
def test_it_goes_the_way_of_its_python_source_through_every_kind_of_event(parameter_set):
    u, h, longest = fuelled((2e-5, 2.1e-5, 2.2e-5, 2.3e-5), offset_2=0.1), 1e-3, 2e-4
    twin = ModelTwin(MODEL, u, parameter_set)
    rows = [twin.values()]
    for _ in range(40):
        twin.step(h, longest)
        rows.append(twin.values())
    run = course(u, 40 * h, h, {"solver.step": longest}, parameter_set)
    stages = [(row[f"stage_{i}"], after[f"stage_{i}"]) for row, after in pairwise(rows) for i in CYLINDERS]
    assert {(0.0, 1.0), (1.0, 2.0), (2.0, 0.0)} <= set(stages)
    for name in set(run) - {"time"}:
        expected = np.array([row[name] for row in rows])
        # Rounding grows from some 1e-16 a step by no more than a hundred in half a cycle.
        scale = np.abs(expected).max()
        np.testing.assert_allclose(run[name], expected, rtol=1e-10, atol=1e-12 * scale + 1e-30, err_msg=name)


def largest_error(run: Course, reference: Course, name: str) -> float:
    return float(np.abs(run[name] - reference[name]).max() / np.abs(reference[name]).max())


def test_while_every_valve_is_shut_it_converges_with_the_order_of_rk4():
    # One revolution without combustion, valves that never open, walls that take heat.
    still = {"A_int": 0.0, "A_exh": 0.0, "omega_e": 157.0}
    runs = {
        step: course(fuelled(0.0), 0.04, 2e-3, {**still, **{f"burn_{i}": 0.0 for i in CYLINDERS}, "solver.step": step})
        for step in (2e-3, 1e-3, 5e-4, 2.5e-4, 1e-5)
    }
    errors = [largest_error(runs[step], runs[1e-5], "U_1") for step in (2e-3, 1e-3, 5e-4, 2.5e-4)]
    orders = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    assert orders[-1] == pytest.approx(4.0, abs=0.4), (errors, orders)


@pytest.mark.parametrize(
    ("parameter_set", "rpm", "bound"), [(None, 1500.0, 2e-5), ("si", 1500.0, 2e-5), (None, 6000.0, 2e-4)]
)
def test_with_steps_of_six_degrees_the_default_steps_inside_have_converged(parameter_set, rpm, bound):
    h = 1.0 / rpm
    names = ("p_1", "imep_1", "m_exh_1", "afr_1", "T_1", "omega_e")

    def errors(step: float) -> dict[str, float]:
        run = course(fuelled(2e-5, rpm), 480 * h, h, {"omega_e": rpm * RPM, "solver.step": step}, parameter_set)
        return {name: largest_error(run, reference, name) for name in names}

    reference = course(fuelled(2e-5, rpm), 480 * h, h, {"omega_e": rpm * RPM, "solver.step": 2e-6}, parameter_set)
    default, finer, finest = (
        errors(MODEL.solver_step),
        errors(0.25 * MODEL.solver_step),
        errors(MODEL.solver_step / 16.0),
    )
    for name in names:
        # Valves that leave their seats and flows that turn round are kinks: between order 2 and 4, once it is fine.
        assert default[name] < bound, (name, default)
        assert finest[name] < default[name] / 25.0 and finer[name] < default[name], (name, default, finer, finest)


CLOCK = """
campaign: sweep
clock: {crank: {step: 6 deg, stop: 12 s, speed: engine.omega_e, angle: engine.theta, firing_order: [1, 3, 4, 2]}}
parts:
  fuel: {use: source, unit: kg, constant: 0.00002 kg}
  exact: {use: source, unit: "1", constant: 0}
  demand: {use: source, unit: rad/s, ramp: {at: 1 s, until: 11 s, from: 800 rpm, to: 6000 rpm}}
  engine:
    use: fmus.plants.crank_engine
    with: {omega_e: 800 rpm}
    wires:
      {m_f_1: fuel, m_f_2: fuel, m_f_3: fuel, m_f_4: fuel, speed_demand: demand,
       offset_1: exact, offset_2: exact, offset_3: exact, offset_4: exact}
  crank: {use: crank, of: engine.theta}
experiments:
  hcci: {}
  si: {set: {engine.set: si}}
metrics:
  cycles: {final: crank.cycle}
accept:
  - cycles > 250
"""


def test_a_crank_clock_steers_to_it_from_800_to_6000_rpm_in_both_sets(tmp_path: Path):
    file = tmp_path / "sweep.yaml"
    file.write_text(CLOCK)
    result = execute(read_campaign(file), tmp_path / "run", 1, lambda told: None, "kept")
    assert result.outcomes == {"hcci": "ok", "si": "ok"} and result.accepted
    for folder in (tmp_path / "run" / "cases").iterdir():
        record = read_signals(folder / "signals.parquet")
        speed, residual = record["engine.omega_e"], record["crank.residual"]
        assert speed[:200].min() < 850.0 * RPM and speed.max() > 5900.0 * RPM
        # What the speed changes within 6 degrees: at 800 rpm it swings by a sixth. It never adds up.
        assert np.abs(residual).max() < 0.5 * np.pi / 180.0
        assert np.abs(residual[-1000:]).max() < 0.02 * np.pi / 180.0


def block() -> str:
    """The campaign in docs/crank_engine.md."""
    (text,) = re.findall(r"```yaml\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    return str(text)


def test_the_documented_campaign_finds_the_quarter_more(tmp_path: Path):
    file = tmp_path / "quarter.yaml"
    file.write_text(block())
    result = execute(read_campaign(file), tmp_path / "run", 1, lambda told: None, "kept")
    assert set(result.outcomes.values()) == {"ok"} and result.accepted


def test_the_figures_of_the_document_are_drawn_by_its_command(tmp_path: Path):
    script = runpy.run_path(str(PAGE.parent / "crank_engine" / "draw.py"))
    drawn = {path.name for path in script["draw"](tmp_path, seconds=0.6)}
    shown = set(re.findall(r"\(crank_engine/(\w+\.svg)\)", PAGE.read_text(encoding="utf-8")))
    kept = {path.name for path in (PAGE.parent / "crank_engine").glob("*.svg")}
    assert drawn == shown == kept
