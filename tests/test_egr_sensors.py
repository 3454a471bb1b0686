"""The campaign egr-sensors: its numbers against what computes them, program against Riccati, a short run, the whole."""

from __future__ import annotations

import csv
import importlib.util
from functools import cache
from statistics import median

import numpy as np
import pytest
from ruamel.yaml import YAML
from scipy.stats import spearmanr

from fmus.plants import turbo_si_egr
from fmus.plants.turbo_si_egr_reference import FITTED, STEADY
from fmus.statespace import StateSpace, scales
from fmus.units import parse_quantity, parse_unit
from fmus.working_cycle.rest import MEANS
from harness.campaign import find_campaign, read_campaign
from harness.campaigns import egr_cycle, egr_noise, egr_sensors
from harness.cases import execute
from harness.operating import operate
from harness.places import read_yaml, read_yaml_file
from observers import linear_kalman
from reports.folder import read_run
from reports.html import write_report
from reports.rankings import read_rankings
from selection.estimation import Estimation, estimation_of
from selection.h2 import refit
from selection.measures import Noise, plant
from selection.riccati import Costs, best_filter

FILE = find_campaign("egr-sensors")
SENSORS = turbo_si_egr.SENSORS
SETS = [members for members in egr_noise.SETS if members]


@cache
def document():
    return read_yaml_file(FILE)[0]


def si(text: str, unit: str) -> float:
    number, written = parse_quantity(text)
    assert parse_unit(written).same_dimension(parse_unit(unit))
    return parse_unit(written).to_si(number)


@cache
def space() -> StateSpace:
    return operate(egr_noise.OPERATION).space


@cache
def estimation(kind: str = "kf") -> Estimation:
    """The 20 states at the named point with the noise that the campaign's filters have."""
    given = document()["parts"][f"{kind}_EGR_DP_MAFa_MAFh_MAF"]["with"]
    sizes, names = scales(space().states), [s.name for s in space().states]
    process = np.array([si(str(given["process"][s.name]), s.unit) for s in space().states]) / sizes
    noise = np.array([si(given["noise"][name], "kg/s") for name in SENSORS])
    gradients = np.array([space().output_row(name) for name in SENSORS])
    made = plant(space().A, gradients, np.zeros(4), sizes, Noise(noise, 1.0, process))
    return estimation_of(made, [names.index("F_im")], names, SENSORS)


def places(members) -> tuple[int, ...]:
    return tuple(SENSORS.index(name) for name in members)


def differences(one, other, path=""):
    """Where two documents differ; numbers may by 1 %: of runs on another processor the last digits are others."""
    if isinstance(one, dict) and isinstance(other, dict):
        for key in one.keys() | other.keys():
            yield from differences(one.get(key), other.get(key), f"{path}.{key}")
    elif isinstance(one, list) and isinstance(other, list) and len(one) == len(other):
        for index, (a, b) in enumerate(zip(one, other, strict=True)):
            yield from differences(a, b, f"{path}[{index}]")
    elif isinstance(one, (int, float)) and isinstance(other, (int, float)):
        if abs(one - other) > 1e-2 * abs(other):
            yield f"{path}: {one} and {other}"
    elif one != other and not _near(one, other):
        yield f"{path}: {one!r} and {other!r}"


def _near(one, other) -> bool:
    """Whether two quantities of one unit are within 1 %."""
    first, second = str(one).split(" ", 1), str(other).split(" ", 1)
    try:
        return first[1:] == second[1:] and abs(float(first[0]) - float(second[0])) <= 1e-2 * abs(float(second[0]))
    except ValueError:
        return False


@pytest.mark.slow
def test_the_file_is_what_the_script_writes():
    written, _ = read_yaml("\n".join(egr_sensors.campaign(egr_noise.estimated())), "egr-sensors.yaml")
    assert list(differences(document(), written)) == []


def test_without_l1_norm_the_program_is_the_riccati_equation_for_all_sets_of_the_20_states():
    system = estimation()
    assert len(system.A) == 20
    system = system.moved()  # without the three actuators, which no noise reaches
    assert len(system.A) == 17
    for members in SETS:
        found = refit(system, places(members))
        assert found.status == "optimal"
        assert found.trace == pytest.approx(best_filter(system, places(members)).trace, rel=1e-4)


@pytest.mark.parametrize("kind", ["kf", "kd"])
def test_the_expected_errors_in_the_file_are_those_that_the_filters_expect(kind):
    costs = Costs(estimation(kind).moved())
    ranking = document()["report"]["rankings"][list(egr_noise.FAMILIES).index(kind)]
    expected = ranking["measures"][f"{egr_noise.FAMILIES[kind].by}_all"]["values"]
    (size,) = (s.nominal for s in turbo_si_egr.MODEL.states if s.name == "F_im")
    for members in egr_noise.SETS:
        part = egr_noise.named(kind, members)
        # Written with six digits, of a noise written with four.
        assert expected[part] == pytest.approx(100.0 * size * np.sqrt(costs.cost(places(members))), rel=1e-3)


def test_the_filters_gain_is_that_of_the_selection():
    given = dict(document()["parts"]["kf_EGR_DP_MAFa"]["with"])
    model = linear_kalman.make(**given | {"lasting": 1.0})
    found = {signal.name: np.asarray(signal.start) for signal in model.parameters}
    system = estimation().moved()
    kept = [[s.name for s in model.states].index(name) for name in system.states]
    sizes = scales(space().states)[kept]
    wanted = best_filter(system, places(("EGR_DP", "MAFa"))).gain
    # Gains in units of the states' sizes over those of the sensors' noise, here and there.
    noise = np.array([si(given["noise"][name], "kg/s") for name in ("EGR_DP", "MAFa")])
    ours = found["L"][kept] / sizes[:, None] * noise
    np.testing.assert_allclose(ours, wanted, rtol=1e-5, atol=1e-6 * np.abs(wanted).max())


def test_the_set_reference_is_where_no_step_of_a_parameter_brings_the_model_nearer():
    spec = importlib.util.spec_from_file_location("fit", FILE.parents[2] / "docs" / "turbo_si_egr" / "fit.py")
    fit = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(fit)
    resting = fit.Resting(STEADY)
    wanted = np.array([[one[name] for name in fit.COMPARED] for one in STEADY])
    left = np.log(resting(FITTED) / wanted)
    assert np.sqrt(np.mean(left**2)) < 0.05
    # At the least the gradient is zero: a step of 2 % takes off no more than what the tolerance of the fit and the
    # steps of its differences, both 1e-6 to 1e-3, leave.
    least = float(np.sum(left**2))
    for name in ("C_c", "C_egr", "k_1", "eta_t_max", "Psi_max"):
        for share in (0.98, 1.02):
            moved = np.log(resting(FITTED | {name: FITTED[name] * share}) / wanted)
            assert float(np.sum(moved**2)) > least * (1.0 - 1e-3)


def test_the_reference_point_is_where_the_plant_starts():
    shown = [name for name in STEADY[0] if name in MEANS]
    assert "F_im" in shown and "W_egr" in shown
    # Both are the steady cycle, found by two runs.
    assert [STEADY[0][name] for name in shown] == pytest.approx([MEANS[name] for name in shown], rel=1e-3)


def test_the_cycle_is_that_of_the_text():
    assert min(egr_cycle.SPEED.values()) == 2400 and max(egr_cycle.SPEED.values()) == 4000
    for points in (egr_cycle.SPEED, egr_cycle.WASTEGATE, egr_cycle.EGR_VALVE):
        assert list(points) == sorted(points) and next(iter(points)) == 0.0 and list(points)[-1] == 30.0


def test_every_set_has_a_linear_filter_of_each_noise_on_the_same_sensors():
    parts = document()["parts"]
    for kind in egr_noise.FAMILIES:
        for members in egr_noise.SETS:
            part = parts[egr_noise.named(kind, members)]
            assert part["with"]["sensors"] == list(members)
            wired = {key for key in part["wires"] if key.endswith("_measured")}
            assert wired == {f"{name}_measured" for name in members}


def shortened(tmp_path):
    """The campaign with four filters, one case and 5 s."""
    content = document()
    kept = ["kf_none", "kf_EGR_DP", "kf_MAFa", "kf_EGR_DP_MAFa"]
    parts = {
        n: part for n, part in content["parts"].items() if n in kept or not n.startswith(("kf_", "kd_", "own_", "ekf_"))
    }
    ranking = content["report"]["rankings"][0]
    values = {key: ranking["measures"]["published_all"]["values"][key] for key in kept}
    short = {
        "campaign": "egr-sensors-short",
        "clock": {"crank": {**content["clock"]["crank"], "stop": "5 s"}},
        "parts": parts,
        "record": ["plant.F_im", "plant.egr_ratio", "model.F_im", *(f"{name}.F_im" for name in kept)],
        "metrics": {f"rmse_{name}": content["metrics"][f"rmse_{name}"] for name in ("model", *kept)},
        "accept": ["rmse_kf_EGR_DP_MAFa < 5 %", "rmse_model < 5 %"],
        "report": {
            "rankings": [{**ranking, "experiments": [], "measures": {"expected": {"values": values}}, "resamples": 100}]
        },
    }
    path = tmp_path / "short.yaml"
    with path.open("w") as stream:
        YAML(typ="safe").dump(short, stream)
    return read_campaign(path)


def test_a_short_run_ends_well_and_ranks_its_sets(tmp_path):
    result = execute(shortened(tmp_path), tmp_path / "run", 1, lambda ended: None)
    assert set(result.outcomes.values()) == {"ok"}
    assert all(verdict.passed for verdict in result.verdicts)
    (ranking,) = read_rankings(read_run(tmp_path / "run"))
    assert len(ranking.medians) == 4


@pytest.mark.campaign
def test_the_whole_campaign_meets_its_criteria_and_its_report_says_what_is_there(tmp_path):
    result = execute(read_campaign(FILE), tmp_path, 2, lambda ended: None)
    assert set(result.outcomes.values()) == {"ok"}
    assert all(verdict.passed for verdict in result.verdicts)
    run = read_run(tmp_path)
    page = write_report(tmp_path).read_text(encoding="utf-8")
    with (tmp_path / "metrics.csv").open() as stream:
        rows = [row for row in csv.DictReader(stream) if row["experiment"] == "cycle"]
    for ranking in read_rankings(run):
        for measure in ranking.measures:
            medians = [
                median(float(row["value"]) for row in rows if row["metric"] == f"rmse_{observer}")
                for observer in measure.values
            ]
            wanted = spearmanr(list(measure.values.values()), medians).statistic
            # Sums of at most sixteen products in another order.
            assert measure.correlation == pytest.approx(wanted, abs=1e-12)
    assert "EGR-DP + MAFa" in page
