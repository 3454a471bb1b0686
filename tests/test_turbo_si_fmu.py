"""The turbocharged engine as an FMU: equal to its source, its solver fit for it, in a campaign of its own."""

from __future__ import annotations

import json
import re
import runpy
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from engine_at_rest import ENGINE, INPUT_NAMES, NOMINAL, OPERATION, OUTPUT_NAMES, SETS, STATE_NAMES, settled
from fmpy.validation import validate_fmu
from scipy.integrate import solve_ivp

from fmus import derivatives
from fmus.component import StepError
from fmus.export import cached_fmu
from fmus.fmu import load_fmu
from fmus.jacobians import Point, point
from fmus.model import FlatModel
from fmus.plants import turbo_si_speed
from fmus.plants.turbo_si import MODEL, PARAMETERS, STATES
from fmus.units import parse_unit
from harness.building import Export, build_model
from harness.campaign import read_campaign
from harness.cases import execute
from harness.record import read_signals

PAGE = Path(__file__).resolve().parent.parent / "docs" / "turbo_si.md"
TIP_IN = np.array([2000.0, 1.0, 0.95, 0.0, 101300.0, 298.0])
TIP_OUT = np.array([2000.0, 0.08, 1.0, 0.5, 101300.0, 298.0])


def si(u: np.ndarray) -> np.ndarray:
    """Inputs as the bus has them: N in rad/s."""
    return u * np.array([np.pi / 30.0, 1.0, 1.0, 1.0, 1.0, 1.0])


def off_equilibrium(values: dict[str, float], parameter_set: str | None) -> Point:
    at = settled(values, parameter_set).point
    return at._replace(x=at.x * (1.0 + 1e-2 * np.random.default_rng(2).normal(size=13)))


def starts_in_si(at: Point) -> dict[str, float]:
    """States and parameters of a point by name, as `load_fmu` wants them."""
    signals = [*STATES, *PARAMETERS]
    return {
        signal.name: parse_unit(signal.unit).to_si(float(value))
        for signal, value in zip(signals, [*at.x, *at.p], strict=True)
    }


def by_scipy(x: np.ndarray, u: np.ndarray, stop: float, rows: int) -> np.ndarray:
    """States at `rows` instants up to `stop` [s] from x under inputs held, at a tolerance near rounding."""
    held = point(MODEL)._replace(u=u)
    run = solve_ivp(
        lambda t, z: ENGINE.values(held._replace(x=z * NOMINAL))[0] / NOMINAL,
        (0.0, stop),
        x / NOMINAL,
        method="Radau",
        rtol=1e-10,
        atol=1e-12,
        t_eval=np.linspace(0.0, stop, rows + 1)[1:],
        jac=lambda t, z: ENGINE.at(held._replace(x=z * NOMINAL)).A * NOMINAL / NOMINAL[:, None],
    )
    return np.array(run.y.T * NOMINAL)


@cache
def tip_in_and_out() -> np.ndarray:
    """States every 0.1 s with the throttle open for 1 s and then nearly shut."""
    start = point(MODEL).x
    opened = by_scipy(start, TIP_IN, 1.0, 10)
    return np.vstack([start, opened, by_scipy(opened[-1], TIP_OUT, 1.0, 10)])


def simulate(fmi: int = 2, h: float = 0.1, **solver: float) -> np.ndarray:
    """The same by the exported FMU in communication steps of h [s]."""
    component = load_fmu(cached_fmu(MODEL, fmi), starts={f"solver.{name}": value for name, value in solver.items()})
    outputs = [signal.name for signal in component.outputs]
    places = [outputs.index(name) for name in STATE_NAMES]
    rows, each = [component.start(0.0, si(TIP_IN))[places]], round(0.1 / h)
    try:
        for k in range(20 * each):
            y = component.step(k * h, h, si(TIP_IN if k < 10 * each else TIP_OUT))
            if (k + 1) % each == 0:
                rows.append(y[places])
    finally:
        component.close()
    return np.array(rows)


@pytest.mark.parametrize("model", [MODEL, turbo_si_speed.MODEL], ids=lambda model: model.name)
@pytest.mark.parametrize("fmi", [2, 3])
def test_it_is_built_by_its_name_and_fmpys_validator_has_no_message(model, fmi, tmp_path: Path):
    path = build_model(model.name, Export(tmp_path / "engine.fmu", fmi))
    assert validate_fmu(str(path)) == []


@pytest.mark.parametrize("parameter_set", SETS)
@pytest.mark.parametrize("fmi", [2, 3])
def test_its_derivatives_and_outputs_are_those_of_the_python_source(fmi, parameter_set):
    for values in OPERATION:
        at = off_equilibrium(values, parameter_set)
        dx, y = FlatModel(MODEL).derivatives_and_outputs(0.0, list(at.x), [], list(at.u), list(at.p))
        component = load_fmu(cached_fmu(MODEL, fmi), starts=starts_in_si(at))
        by_name = {variable.name: variable for variable in component.description.variables}
        asked = derivatives.Questioned(component, 0.0, si(at.u))
        got = asked.get([by_name[f"der({name})"] for name in STATE_NAMES] + [by_name[name] for name in OUTPUT_NAMES])
        component.close()
        # The same expressions by another pow and sqrt, 1e-15 of them, in differences to what rounding of the states
        # would leave: 1e-15 |A| x.
        linear = ENGINE.at(at)
        rounding = 1e-14 * np.abs(np.vstack([linear.A, linear.C])) @ at.x
        assert (np.abs(got - np.array([*dx, *y], dtype=float)) <= 1e-13 * np.abs(got) + rounding).all()


@pytest.mark.parametrize("parameter_set", SETS)
def test_its_directional_derivatives_match_differences_of_its_values(parameter_set):
    for values in OPERATION:
        at = off_equilibrium(values, parameter_set)
        component = load_fmu(cached_fmu(MODEL), starts=starts_in_si(at))
        asked = derivatives.Questioned(component, 0.0, si(at.u))
        found = derivatives.compare(asked, derivatives.pairs(component.description))
        component.close()
        assert len(found) == (13 + len(OUTPUT_NAMES)) * (13 + len(INPUT_NAMES))
        worst = max(found, key=lambda one: one.off)
        # Central differences over 1e-5 of a value are good to 1e-10 of it; where an opening is shut there is one side,
        # good to 1e-5 at best.
        assert worst.off * derivatives.TOLERANCE < 1e-5, worst


@pytest.mark.parametrize(("fmi", "h"), [(2, 0.1), (3, 0.1), (2, 1e-3)])
def test_it_goes_the_way_of_its_source_through_a_tip_in_and_a_tip_out(fmi, h):
    difference = np.abs(simulate(fmi, h) - tip_in_and_out()) / NOMINAL
    # The default tolerance is 1e-6 a step, and the engine contracts, so that errors do not pile up; ten for the kinks.
    assert difference.max() < 1e-5


def test_it_goes_the_way_of_its_source_from_where_everything_flows_backwards():
    # The turbocharger nearly at rest, and every pressure above the one before it.
    x = np.array([1.1e5, 320.0, 1.4e5, 340.0, 1.5e5, 330.0, 1.7e5, 310.0, 0.9e5, 900.0, 0.95e5, 800.0, 300.0])
    u = np.array([900.0, 0.3, 1.0, 0.5, 101300.0, 298.0])
    at = point(MODEL)._replace(x=x, u=u)
    flows = dict(zip(OUTPUT_NAMES, ENGINE.values(at)[1], strict=True))
    assert all(flows[name] < 0.0 for name in ("W_af", "W_comp", "W_ic", "W_th", "W_turbine", "W_wg", "W_es"))
    component = load_fmu(cached_fmu(MODEL), starts=starts_in_si(at))
    outputs = [signal.name for signal in component.outputs]
    component.start(0.0, si(u))
    rows = [component.step(k * 0.02, 0.02, si(u))[[outputs.index(name) for name in STATE_NAMES]] for k in range(25)]
    component.close()
    expected = by_scipy(x, u, 0.5, 25)
    # All seven flows turn round on the way, each a kink.
    assert (np.abs(np.array(rows) - expected) / NOMINAL).max() < 1e-5
    assert all(ENGINE.values(at._replace(x=expected[-1]))[1][:10] > 0.0)


def test_the_fastest_time_constant_is_too_short_for_rk4_at_a_millisecond_but_not_for_rodas4():
    A = ENGINE.at(settled({"alpha": 1.0}).point).A
    # RK4 is stable up to 2.785 over the rate.
    assert 0.15e-3 < 2.785 / np.abs(np.linalg.eigvals(A).real).max() < 0.25e-3
    with pytest.raises(StepError, match="is not finite"):
        simulate(method=1, step=1e-3)
    # h^4 of RK4 at half its stable step, and the kinks.
    assert (np.abs(simulate(method=1, step=1e-4) - tip_in_and_out()) / NOMINAL).max() < 1e-5
    loose = np.abs(simulate(tolerance=1e-4) - tip_in_and_out()) / NOMINAL
    assert loose.max() < 1e-3


def block(language: str) -> str:
    """The block of a language in docs/turbo_si.md."""
    (text,) = re.findall(rf"```{language}\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    return str(text)


def test_the_documented_campaign_of_tip_in_and_tip_out_runs_all_three_sets_to_their_equilibria(tmp_path: Path):
    file = tmp_path / "tip.yaml"
    file.write_text(block("yaml"))
    result = execute(read_campaign(file), tmp_path / "run", 1, lambda told: None, "kept")
    assert result.outcomes == {"A": "ok", "A_realistic": "ok", "B": "ok"} and result.accepted
    inputs = {"N": 2000.0, "alpha": 0.15, "lambda": 0.95, "u_wg": 0.2}
    for folder in (tmp_path / "run" / "cases").iterdir():
        record = read_signals(folder / "signals.parquet")
        label = json.loads((folder / "case.json").read_text())["label"]
        boost = record["plant.p_ic"]
        # The throttle opens: charged, and the turbocharger takes its time. It shuts: everything comes to rest.
        assert boost.max() > 1.02 * boost[0]
        rest = settled(inputs, None if label == "A" else label).states
        for name, value in rest.items():
            # 34 s are ten of the slowest time constants, 3 s: 5e-5 of a change by half is left.
            assert record[f"plant.{name}"][-1] == pytest.approx(value, rel=1e-4), (label, name)


def test_the_documented_way_to_equilibria_and_sensors_works(capsys: pytest.CaptureFixture[str]):
    exec(block("python"), {})
    first, second = capsys.readouterr().out.splitlines()
    lagged, sensed, residual, worst = first.split()
    assert lagged == sensed and float(residual) < 1e-9 and worst in {*STATE_NAMES, "T_im_lagged"}
    assert second.startswith("(14, 14) (19, 14) ")


def test_the_figures_of_the_document_are_drawn_by_its_command(tmp_path: Path):
    script = runpy.run_path(str(PAGE.parent / "turbo_si" / "draw.py"))
    drawn = {path.name for path in script["draw"](tmp_path, speeds=(2000.0,))}
    shown = set(re.findall(r"\(turbo_si/(\w+\.svg)\)", PAGE.read_text(encoding="utf-8")))
    kept = {path.name for path in (PAGE.parent / "turbo_si").glob("*.svg")}
    assert drawn == shown == kept
