"""Exhaust and rod as FMUs: equal to their source, swapped for twins with Python inside, in their pages' campaigns."""

from __future__ import annotations

import json
import re
import runpy
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from exhaust_runs import MASS, T_EXH, parameters
from fmpy.validation import validate_fmu
from scipy.integrate import solve_ivp

from fmus import derivatives
from fmus.component import StepError
from fmus.exhaust_path import Breathing, path_harmonics, path_response, sensor_response
from fmus.export import cached_fmu
from fmus.fmu import load_fmu
from fmus.jacobians import point
from fmus.model import FlatModel
from fmus.plants import exhaust_afr, rod
from harness.building import Export, build_model
from harness.campaign import read_campaign
from harness.cases import execute
from harness.record import read_signals

DOCS = Path(__file__).resolve().parent.parent / "docs"
PLANTS = [exhaust_afr.MODEL, rod.MODEL]


def scalars(signals):
    return [name for signal in signals for name in signal.scalar_names()]


def random_point(model, generator):
    """States, inputs and parameters off their starts, by a share of their size."""
    at = point(model)
    sizes = [np.repeat([s.nominal for s in group], [s.size for s in group]) for group in (model.states, model.inputs)]
    x = at.x + 0.2 * sizes[0] * generator.uniform(-1.0, 1.0, len(at.x))
    u = at.u + 0.3 * sizes[1] * generator.uniform(-1.0, 1.0, len(at.u))
    p = at.p * generator.uniform(0.97, 1.03, len(at.p))
    if model is exhaust_afr.MODEL:
        u[0] = generator.uniform(0.0, 400.0)
        p[[signal.name for signal in model.parameters].index("PI_lin")] = 0.985
    return at._replace(x=x, u=u, p=p)


@pytest.mark.parametrize("model", PLANTS, ids=lambda model: model.name)
@pytest.mark.parametrize("fmi", [2, 3])
def test_it_is_built_by_its_name_and_fmpys_validator_has_no_message(model, fmi, tmp_path: Path):
    path = build_model(model.name, Export(tmp_path / "plant.fmu", fmi))
    assert validate_fmu(str(path)) == []


@pytest.mark.parametrize("model", PLANTS, ids=lambda model: model.name)
@pytest.mark.parametrize("fmi", [2, 3])
def test_its_derivatives_and_outputs_are_those_of_the_python_source(model, fmi):
    generator = np.random.default_rng(6)
    names, ends = scalars(model.states), scalars(model.outputs)
    for _ in range(8):
        at = random_point(model, generator)
        dx, y = FlatModel(model).derivatives_and_outputs(0.0, list(at.x), [], list(at.u), list(at.p))
        starts = dict(zip(names + scalars(model.parameters), map(float, [*at.x, *at.p]), strict=True))
        component = load_fmu(cached_fmu(model, fmi), starts=starts)
        by_name = {variable.name: variable for variable in component.description.variables}
        asked = derivatives.Questioned(component, 0.0, at.u)
        got = asked.get([by_name[f"der({name})"] for name in names] + [by_name[name] for name in ends])
        component.close()
        # The same expressions by another pow and cos, in differences of up to 1e3 times what is left of them.
        np.testing.assert_allclose(got, np.array([*dx, *y], dtype=float), rtol=1e-11, atol=1e-12)


@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.parametrize("N", [800.0, 6000.0])
def test_the_exhaust_goes_the_way_of_its_source_under_a_solver_of_higher_order(fmi, N):
    omega, step = N * np.pi / 30.0, np.radians(6.0)
    flat, at = FlatModel(exhaust_afr.MODEL), point(exhaust_afr.MODEL)
    component = load_fmu(cached_fmu(exhaust_afr.MODEL, fmi))
    inputs = [np.array([k * step, omega, 16.0, 20.0, 23.0, 20.0, *[MASS] * 4, T_EXH]) for k in range(121)]
    component.start(0.0, inputs[0])
    x, worst = at.x, 0.0
    names = [signal.name for signal in component.outputs]
    for k in range(120):
        h = step / omega
        y = dict(zip(names, component.step(k * h, h, inputs[k]), strict=True))
        x = solve_ivp(
            lambda t, z, u=inputs[k]: flat.derivatives_and_outputs(t, list(z), [], list(u), list(at.p))[0],
            (0.0, h), x, method="DOP853", rtol=1e-10, atol=1e-14,
        ).y[:, -1]  # fmt: skip
        _, expected = flat.derivatives_and_outputs(0.0, list(x), [], list(inputs[k]), list(at.p))
        for name, value in zip(scalars(exhaust_afr.OUTPUTS), expected, strict=True):
            worst = max(worst, abs(y[name] - float(value)) / max(abs(float(value)), 1e-3))
    component.close()
    # RK4 in steps of half a cell's time at 6000 rpm, of a fourteenth at 800 rpm.
    assert worst < (1e-8 if N == 800.0 else 1e-4)


def block(page: str, language: str) -> str:
    """The block of a language in a page of docs/."""
    (text,) = re.findall(rf"```{language}\n(.*?)```", (DOCS / page).read_text(encoding="utf-8"), re.DOTALL)
    return str(text)


def records(page: str, folder: Path, *overrides: str):
    """What the cases of a page's campaign recorded, by label, all of them fine and accepted."""
    file = folder / "page.yaml"
    file.write_text(block(page, "yaml"))
    result = execute(read_campaign(file, list(overrides)), folder / "run", 1, lambda told: None, "kept")
    assert set(result.outcomes.values()) == {"ok"} and result.accepted
    return {
        json.loads((case / "case.json").read_text())["label"]: (
            read_signals(case / "signals.parquet"),
            json.loads((case / "case.json").read_text())["metrics"],
        )
        for case in (folder / "run" / "cases").iterdir()
    }


def test_the_documented_campaign_of_one_rich_cylinder_runs_from_800_to_6000_rpm(tmp_path: Path):
    found = records("exhaust_afr.md", tmp_path)
    assert len(found) == 5
    for record, _ in found.values():
        omega = record["speed.value"][-1]
        rows = -np.arange(120, 0, -1)
        angle = 4.0 * np.pi / 120.0 * rows
        w, shown = (
            np.mean(record[f"plant.{name}"][rows] * np.exp(-0.5j * angle)) for name in ("afr_turbine", "afr_sensor")
        )
        # 160 rev are whole cycles. Sources hold the angle of a step's beginning, half a step late.
        p = parameters()
        G = path_harmonics(1, omega, np.full(4, MASS), T_EXH, p)[0, 1] * np.exp(-0.5j * np.radians(3.0))
        expected = -4.0 * G * np.exp(0.5j * np.radians(6.0))
        # No small deviation: its square counts, 10 % in the amplitude; in the phase less.
        assert abs(w) == pytest.approx(abs(expected), rel=0.15)
        assert abs(np.angle(w / expected)) < np.radians(6.0)
        # The lags are linear whatever comes.
        assert shown / w == pytest.approx(sensor_response(0.5, omega, p), rel=1e-5)


def test_the_documented_campaign_of_one_rod_has_its_closed_response_at_both_speeds(tmp_path: Path):
    found = records("rod.md", tmp_path)
    assert len(found) == 2
    for label, (_, metrics) in found.items():
        order = 5.0 if "1500 rpm" in label else 2.5
        values = {name: value["value"] for name, value in metrics.items()}
        H = rod.rod_response(2.0, SimpleNamespace(xi=0.15, order=order))
        assert values["rod"] / values["cylinders"] == pytest.approx(abs(H), rel=3e-3)


@pytest.mark.parametrize(("page", "name", "short"), [("exhaust_afr.md", "exhaust_afr", "4"), ("rod.md", "rod", "6")])
def test_a_twin_with_python_inside_in_its_place_gives_the_same_rows(page, name, short, tmp_path, crankbench):
    twin = tmp_path / f"{name}.fmu"
    code, _, said = crankbench("build", name, "--python", "--out", twin)
    assert code == 0, said
    rows = []
    for use in (f"fmus.plants.{name}", str(twin)):
        file = tmp_path / "swap.yaml"
        text = block(page, "yaml").replace(f"use: fmus.plants.{name}", f"use: {use}")
        text = re.sub(r"(?ms)^(vary|metrics|accept):.*", "", text).replace("0.4 s, from", "0.1 s, from")
        file.write_text(text)
        campaign = read_campaign(file, [f"clock.crank.stop={short} rev"])
        folder = tmp_path / ("twin" if use.endswith(".fmu") else "native")
        result = execute(campaign, folder, 1, lambda told: None, "kept")
        assert set(result.outcomes.values()) == {"ok"}
        (case,) = (folder / "cases").iterdir()
        rows.append(read_signals(case / "signals.parquet"))
    shown = [signal.name for signal in rows[0].signals]
    assert f"plant.{'afr_sensor' if name == 'exhaust_afr' else 'omega_rod'}" in shown
    for one in shown:
        # The same method and expressions; NumPy's and C's pow and cos may differ in the last bit.
        np.testing.assert_allclose(rows[0][one], rows[1][one], rtol=1e-9, atol=1e-12, err_msg=one)


def test_the_documented_way_to_the_path_works(capsys: pytest.CaptureFixture[str]):
    exec(block("exhaust_afr.md", "python"), {})
    closed, periodic, lags = map(float, capsys.readouterr().out.split())
    assert closed == pytest.approx(0.0791, abs=5e-5) and periodic == pytest.approx(0.0788, abs=5e-5)
    assert lags == pytest.approx(0.2437, abs=5e-5)


def table(page: str, heading: str) -> list[list[str]]:
    """The cells of the table of a page whose first row begins with a heading, without that row and the rule below."""
    lines = (DOCS / page).read_text(encoding="utf-8").splitlines()
    first = next(i for i, line in enumerate(lines) if line.startswith(f"| {heading} |"))
    rows = []
    for line in lines[first:]:
        if not line.startswith("|"):
            break
        rows.append([cell.strip() for cell in line.strip("|").split("|")])
    return [rows[0], *rows[2:]]


def test_the_numbers_of_the_page_on_the_exhaust_are_those_of_the_functions():
    p = parameters()
    for N, per_cycle, plant, periodic, closed, lags, shown in table("exhaust_afr.md", "N [rpm]")[1:]:
        omega, k = float(N) * np.pi / 30.0, int(per_cycle)
        w = path_harmonics(k, omega, np.full(4, MASS), T_EXH, p)[0, k]
        by_sensor = sensor_response(0.5 * k, omega, p)
        simple = path_response(0.5 * k, Breathing(omega, MASS, T_EXH), p)
        for cell, expected in ((plant, w), (periodic, w), (closed, simple), (lags, by_sensor), (shown, w * by_sensor)):
            gain, late = map(float, cell.split(", "))
            digits = len(cell.split(",")[0].partition(".")[2])
            # Rounded as printed, half a unit, and a tenth of a degree for a sum of rounded ones.
            assert gain == pytest.approx(abs(expected), abs=0.51 * 10.0**-digits), (N, k, cell)
            assert abs(np.angle(expected * np.exp(1j * np.radians(late)))) < np.radians(0.11), (N, k, cell)


def test_the_numbers_of_the_page_on_the_rod_are_those_of_its_response():
    orders, gains, phases = ([float(cell) for cell in row[1:]] for row in table("rod.md", "k per revolution"))
    H = rod.rod_response(np.array(orders), SimpleNamespace(xi=0.15, order=5.0))
    np.testing.assert_allclose(gains, abs(H), atol=5.1e-4)
    np.testing.assert_allclose(phases, np.degrees(np.angle(H)), atol=0.051)


def test_the_figure_of_the_page_is_drawn_by_its_command(tmp_path: Path):
    script = runpy.run_path(str(DOCS / "exhaust_afr" / "draw.py"))
    drawn = {path.name for path in script["draw"](tmp_path, speeds=(1000.0, 3000.0))}
    shown = set(re.findall(r"\(exhaust_afr/(\w+\.svg)\)", (DOCS / "exhaust_afr.md").read_text(encoding="utf-8")))
    kept = {path.name for path in (DOCS / "exhaust_afr").glob("*.svg")}
    assert drawn == shown == kept


def test_the_solvers_step_is_short_enough_up_to_twice_the_flow_of_the_fastest_course():
    model, step = exhaust_afr.MODEL, np.radians(6.0)
    for scale, expected in ((2.0, True), (6.0, False)):
        omega, mass = 200.0 * np.pi, MASS * scale
        component = load_fmu(cached_fmu(model))
        component.start(0.0, point(model).u)
        shown = [signal.name for signal in component.outputs].index("afr_turbine")
        found = []
        try:
            for k in range(1200):
                u = np.array([k * step, omega, 16.0, 20.0, 20.0, 20.0, *[mass] * 4, T_EXH])
                found.append(component.step(k * step / omega, step / omega, u)[shown])
        except StepError:
            found.append(np.inf)
        component.close()
        assert (min(found) >= 16.0 and max(found) <= 20.0 + 1e-9) == expected
