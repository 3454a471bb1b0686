"""The crank-resolved engine: what is conserved, its FMU beside its source, its means, and its page."""

from __future__ import annotations

import ast
import json
import re
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from cycle_runs import Run, inputs, settled
from fmpy.validation import validate_fmu
from scipy.integrate import simpson

from benchmarks.gas_exchange_figures import draw
from fmus import derivatives
from fmus.export import cached_fmu
from fmus.fmu import load_fmu
from fmus.jacobians import point
from fmus.model import FlatModel
from fmus.plants.gas_exchange import MODEL
from fmus.working_cycle.engine_signals import AVERAGED, CELLS, FIRING, OUTPUTS, PARAMETERS, STATES
from fmus.working_cycle.mixture import AF_STOICHIOMETRIC, enthalpy
from harness.building import Export, build_model
from harness.campaign import read_campaign
from harness.cases import execute
from harness.record import read_signals

ROOT = Path(__file__).resolve().parent.parent
PAGE = ROOT / "docs" / "gas_exchange.md"
CYCLE = 120.0 / 3200.0  # s
OFF = {"wastegate": 14.0, "egr_valve": 18.0, "N": 3000.0}
NAMES = [scalar for signal in STATES for scalar in signal.scalar_names()]
FLAT = FlatModel(MODEL)
# Every state is inside the FMU but these, and what they depend on is all of it.
RATES = ("der(theta)", "der(mass_net)", "der(burnt_net)", "der(energy_net)")
SIZES = {scalar: signal.nominal for signal in OUTPUTS for scalar in signal.scalar_names()} | {"der(energy_net)": 1e5}


@cache
def fresh() -> Run:
    """Two cycles of the transient that a step of the inputs makes, in rows of 0.25 deg."""
    return Run(MODEL, OFF).on(OFF, 0.25 / 6.0 / OFF["N"], 2 * 2880)


def states_of(run_at: dict[str, float]) -> np.ndarray:
    """Flat states by name, those not named at their starts."""
    starts = dict(zip(NAMES, point(MODEL).x, strict=True))
    return np.array([run_at.get(name, starts[name]) for name in NAMES])


def evaluated(x: np.ndarray, values: dict[str, float]) -> tuple[dict[str, float], dict[str, float]]:
    """Derivatives and outputs by name, by the Python source."""
    at = point(MODEL)
    u = [values.get(signal.name, float(signal.start)) for signal in MODEL.inputs]
    dx, y = FLAT.derivatives_and_outputs(0.0, list(x), list(at.m), u, list(at.p))
    names = [scalar for signal in OUTPUTS for scalar in signal.scalar_names()]
    return dict(zip(NAMES, map(float, dx), strict=True)), dict(zip(names, map(float, y), strict=True))


def disturbed(count: int) -> list[np.ndarray]:
    """States away from the steady cycle, at any crank angle: pressures that drive flows both ways."""
    generator = np.random.default_rng(5)
    found = []
    for _ in range(count):
        x = states_of({"theta": generator.uniform(0.0, 4.0 * np.pi)})
        for place in (*CELLS, "run", "cyl"):
            fill, heat = generator.uniform(0.6, 1.5, 2)
            for j, name in enumerate(NAMES):
                letter, _, rest = name.partition("_")
                if letter in ("m", "U", "b") and rest.partition("[")[0] == place:
                    x[j] *= fill * (heat if letter == "U" and x[j] > 0.0 else 1.0)
        x[NAMES.index("W_c")] = generator.uniform(-0.05, 0.15)
        found.append(x)
    return found


def stored(dx: dict[str, float], letter: str) -> float:
    return sum(value for name, value in dx.items() if name.startswith(f"{letter}_"))


def test_mass_burnt_mass_and_energy_are_conserved_whichever_way_the_gas_flows():
    backwards = set()
    for x in disturbed(60):
        dx, y = evaluated(x, {"egr_valve": 30.0})
        backwards |= {name for name, value in y.items() if name.startswith("W_") and value < 0.0}
        # What crosses the boundary, from the outputs alone. At lambda 1 air and fuel burn at 14.6 to 1.
        air, tail = y["W_a_inst"], y["W_tail_inst"]
        fuel = stored(dx, "m") - air + tail
        entering = air * (0.0 if air >= 0.0 else y["F_mix_inst"]) - tail * (y["F_tail_inst"] if tail >= 0.0 else 0.0)
        scale = 1e-12 * max(abs(value) for name, value in y.items() if name.startswith("W_"))
        assert fuel >= -scale
        assert stored(dx, "b") == pytest.approx(entering + (1.0 + AF_STOICHIOMETRIC) * fuel, abs=20.0 * scale)
        assert dx["mass_net"] == pytest.approx(stored(dx, "m"), abs=scale)
        assert dx["burnt_net"] == pytest.approx(stored(dx, "b"), abs=scale)
        # Terms of up to 1 MW: 1e-12 of them.
        assert dx["energy_net"] == pytest.approx(stored(dx, "U") + dx["K_tc"], rel=1e-9, abs=1e-6)
    found = {f"W_{name}_inst" for name in ("a", "mix", "cac", "throttle", "egr", "wg", "tail", "turbine", "cyl", "exh")}
    assert backwards >= found


def test_over_cycles_what_is_stored_is_what_came_to_rounding():
    run = fresh()
    for name, through in (("mass", 0.09 * 0.08), ("burnt", 0.09 * 0.08), ("energy", 2.6e5 * 0.08)):
        imbalance = run[f"{name}_stored"] - run[f"{name}_net"]
        # 3000 steps of four stages, rounded at 1e-16 of what is stored or went through.
        assert np.abs(imbalance - imbalance[0]).max() < 1e-12 * max(through, run[f"{name}_stored"].max())


def test_the_recorded_flows_integrate_to_what_is_stored():
    run = fresh()
    h = 0.25 / 6.0 / OFF["N"]
    came = simpson(run["W_a_inst"] - run["W_tail_inst"], dx=h)
    burnt_left = simpson(run["W_tail_inst"] * run["F_tail_inst"], dx=h)
    grown = {name: run[f"{name}_stored"][-1] - run[f"{name}_stored"][0] for name in ("mass", "burnt")}
    fuel = (grown["burnt"] + burnt_left) / (1.0 + AF_STOICHIOMETRIC)
    through = simpson(run["W_a_inst"], dx=h)
    # Simpson's rule over 0.25 deg, in pulsating flows with kinks.
    assert grown["mass"] == pytest.approx(came + fuel, abs=1e-6 * through)


def test_in_the_steady_cycle_energy_goes_where_it_should():
    y = settled()
    fuel = y["W_a"] / AF_STOICHIOMETRIC
    heat = 0.96 * 44e6 * fuel
    indicated = y["IMEP"] * 4 * 0.25 * np.pi * 0.0825**2 * 0.0928 * 3200.0 / 120.0
    # Net indicated efficiency of stoichiometric engines of a compression ratio near 10: 0.35 to 0.42.
    assert 0.33 < indicated / (44e6 * fuel) < 0.43
    # Enthalpy of the exhaust in its manifold is 30 to 45 % of the fuel's (Heywood, Table 12.1: 34 to 45 % for SI).
    exhaust = (y["W_a"] + y["W_egr"] + fuel) * enthalpy(y["T_em"], 1.0)
    assert 0.30 < exhaust / heat < 0.50


def test_it_starts_in_its_steady_cycle():
    run = Run(MODEL, {}).on({}, CYCLE, 2)
    for signal in AVERAGED:
        before, _, after = run[signal.name]
        # The solver's steps fall elsewhere in the cycle than they did when it was found: as in the test of the step.
        assert after == pytest.approx(before, rel=1e-5), signal.name
    run.close()


@pytest.mark.parametrize("fmi", [2, pytest.param(3, marks=pytest.mark.slow)])
def test_it_is_built_by_its_name_and_fmpys_validator_has_no_message(fmi, tmp_path: Path):
    assert validate_fmu(str(build_model("gas_exchange", Export(tmp_path / "engine.fmu", fmi)))) == []


@pytest.mark.parametrize("fmi", [2, pytest.param(3, marks=pytest.mark.slow)])
def test_its_derivatives_and_outputs_are_those_of_the_python_source(fmi):
    shown = [*(scalar for signal in OUTPUTS for scalar in signal.scalar_names()), *RATES]
    for theta in (0.3, 2.0, 5.5, 8.0, 11.7):  # rad: with every other state as at the start, far from a steady cycle
        component = load_fmu(cached_fmu(MODEL, fmi), starts={"theta": theta})
        by_name = {variable.name: variable for variable in component.description.variables}
        asked = derivatives.Questioned(component, 0.0, inputs(MODEL, OFF))
        got = dict(zip(shown, asked.get([by_name[name] for name in shown]), strict=True))
        component.close()
        dx, y = evaluated(states_of({"theta": theta}), OFF)
        wanted = y | {f"der({name})": value for name, value in dx.items()}
        for name in shown:
            # The same operations with another pow and exp: 1e-15 each, and q - P of the orifices loses three digits.
            assert got[name] == pytest.approx(wanted[name], rel=1e-10, abs=1e-10 * SIZES.get(name, 1.0)), name


def test_it_goes_the_way_of_its_source_step_by_step():
    """RK4 in Python over 30 deg, with the exhaust of one cylinder and the fire of another on the way."""
    at, h, steps = point(MODEL), MODEL.solver_step, 52
    u = [OFF.get(signal.name, float(signal.start)) for signal in MODEL.inputs]

    def rates(x: np.ndarray) -> np.ndarray:
        return np.array(FLAT.derivatives_and_outputs(0.0, list(x), list(at.m), u, list(at.p))[0], dtype=float)

    x = at.x.copy()
    for _ in range(steps):
        k1 = rates(x)
        k2 = rates(x + 0.5 * h * k1)
        k3 = rates(x + 0.5 * h * k2)
        x = x + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + rates(x + h * k3))
    _, wanted = evaluated(x, OFF)
    run = Run(MODEL, OFF).on(OFF, steps * h, 1)
    for name in ("p_im_inst", "p_em_inst", "F_im_inst", "W_egr_inst", "p_cyl[1]", "T_cyl[3]", "energy_stored"):
        # Rounding of 52 steps whose rates cancel to a thousandth of their terms.
        assert run[name][-1] == pytest.approx(wanted[name], rel=1e-10), name
    run.close()


def test_the_internal_step_is_short_enough():
    values = {"wastegate": 14.0, "egr_valve": 20.0}
    runs = [Run(MODEL, values, **{"solver.step": step}).on(values, CYCLE / 120, 480) for step in (3e-6, 30e-6)]
    instants = [f"{name}_inst" for name in ("p_im", "p_em", "F_im", "W_egr", "omega_tc")]
    for name in (*instants, "p_cyl[1]", "p_im", "F_im", "IMEP"):
        fine, default = (run[name] for run in runs)
        # Kinks where flows turn leave first order: 1e-5 at 20 us, twice that at 40.
        assert np.abs(fine - default).max() < 5e-5 * np.abs(fine).max(), name
    for run in runs:
        run.close()


def test_the_means_are_those_of_the_recorded_instants_over_the_last_two_turns():
    run = fresh()
    theta = run["theta"]
    for end in (4.0, 5.0, 6.0, 8.0):  # segments of 180 deg since the start
        row = int(np.searchsorted(theta, end * np.pi - 1e-6))
        window = slice(row - 2880, row + 1)
        for signal in AVERAGED:
            instants = run[f"{signal.name}_inst"][window]
            mean = simpson(instants, dx=1.0) / (len(instants) - 1)
            # The means end 0.01 deg before the segment, and Simpson's rule meets kinks.
            assert run[signal.name][row] == pytest.approx(mean, rel=2e-5), signal.name
    held = run["F_im"][(theta > 6.01 * np.pi) & (theta < 6.99 * np.pi)]
    assert np.ptp(held) == 0.0


def test_imep_is_the_area_of_the_indicator_diagram():
    run = fresh()
    theta = run["theta"][-2881:]
    phi = theta - FIRING[0]
    bore, stroke, rod = 0.0825, 0.0928, 0.144
    r, beta = 0.5 * stroke, np.arcsin(0.5 * stroke / rod * np.sin(phi))
    slope = 0.25 * np.pi * bore**2 * r * np.sin(phi + beta) / np.cos(beta)
    area = simpson(run["p_cyl[1]"][-2881:] * slope, x=theta)
    displaced = 0.25 * np.pi * bore**2 * stroke
    # One cylinder's diagram beside the mean of four, while the charge falls by some per mille a cycle.
    assert run["IMEP"][-1] == pytest.approx(area / displaced, rel=5e-3)


def test_cylinders_fire_1_3_4_2():
    run = fresh()
    peaks = {i: run["theta"][1 + np.argmax(run[f"p_cyl[{i}]"][1:2881])] * 180.0 / np.pi for i in range(1, 5)}
    order = sorted(peaks, key=lambda i: peaks[i])
    assert order == [1, 3, 4, 2]
    # Half burnt at 8 deg: the peak is some 12 to 18 deg after top dead centre (Heywood 9.2.1: about 16 deg).
    assert all(8.0 < peaks[i] - 180.0 * k < 22.0 for k, i in enumerate(order))


def test_the_documented_campaign_on_a_crank_clock_runs_and_accepts(tmp_path: Path):
    (text,) = re.findall(r"```yaml\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    file = tmp_path / "egr-step.yaml"
    file.write_text(text)
    result = execute(read_campaign(file), tmp_path / "run", 1, lambda told: None, "kept")
    assert result.accepted, result.outcomes
    (folder,) = (tmp_path / "run" / "cases").iterdir()
    record = read_signals(folder / "signals.parquet")
    assert json.loads((folder / "case.json").read_text())["outcome"] == "ok"
    # The clock steers to the plant's angle: what a step misses while the speed changes is made good.
    assert np.abs(record["plant.theta"] - np.radians(record.crank)).max() < 1e-3


def test_the_page_names_every_parameter_and_every_output():
    text = PAGE.read_text(encoding="utf-8")
    words = set(re.findall(r"\w+", text))
    assert [signal.name for signal in PARAMETERS if signal.name not in words] == []
    assert [s.name for s in OUTPUTS if s.name not in words and s.name.removesuffix("_inst") not in words] == []


@pytest.mark.slow
def test_the_figures_of_the_page_are_drawn_by_its_command(tmp_path: Path):
    drawn = {path.name for path in draw(tmp_path, points=2)}
    shown = set(re.findall(r"\(gas_exchange/(\w+\.svg)\)", PAGE.read_text(encoding="utf-8")))
    kept = {path.name for path in (PAGE.parent / "gas_exchange").glob("*.svg")}
    assert drawn == shown == kept


def test_it_shares_nothing_with_the_models_in_mean_values():
    files = [ROOT / "fmus" / "plants" / "gas_exchange.py", *(ROOT / "fmus" / "working_cycle").glob("*.py")]
    allowed = {"fmus.component", "fmus.model", "fmus.working_cycle"}
    for path in files:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            module = node.module if isinstance(node, ast.ImportFrom) else None
            if module and module.startswith("fmus"):
                assert module in allowed or module.startswith("fmus.working_cycle."), f"{path.name} imports {module}"
