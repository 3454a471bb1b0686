"""`crankbench noise`: from a recorded cycle to the noise that selections and observers take."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from ruamel.yaml import YAML

from fmus.component import Signal
from fmus.plants.turbo_si_egr import ACCURACIES, LAGS, STATES
from fmus.units import parse_unit
from harness.campaign import read_campaign
from harness.cases import execute
from harness.operating import Operation, operate
from harness.record import Record, write_signals
from harness.recordedstates import columns, read_course
from observers import constant_gain

PAGE = Path(__file__).resolve().parent.parent / "docs" / "noise.md"
PLACES = {s.name: i for i, s in enumerate(STATES)}
SCALE = np.array([parse_unit(s.unit).factor for s in STATES])


def block() -> str:
    """The campaign of docs/noise.md."""
    return PAGE.read_text(encoding="utf-8").split("```yaml\n")[1].split("```")[0]


@pytest.fixture(scope="module")
def cycle(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run folder of the documented campaign."""
    folder = tmp_path_factory.mktemp("noise")
    file = folder / "cycle.yaml"
    file.write_text(block())
    result = execute(read_campaign(file), folder / "run", 1, lambda told: None, "kept")
    assert result.accepted
    return folder / "run"


def linear_record(path: Path, disturbance: np.ndarray, h: float, leave: tuple[str, ...] = ()) -> np.ndarray:
    """A record in which the model's own linear equations are disturbed; gives the disturbances, x' in SI (k, n).

    States go a random way, and the disturbance of each row is what is left; so it is known beforehand.
    """
    generator = np.random.default_rng(4)
    space = operate(Operation("turbo_si_egr", settled=True)).space
    k, n = len(disturbance), len(STATES)
    time = h * np.arange(k)
    u = np.tile(space.u0, (k, 1))
    u[:, -1] += 5.0 * np.sin(3.0 * time)
    F = np.linalg.inv(np.eye(n) - 0.5 * h * space.A)
    x = np.empty((k, n))
    x[0] = space.x0
    for j in range(k - 1):  # by the trapezoidal rule, which residuals take, so that nothing is left but rounding
        before = space.rates + space.A @ (x[j] - space.x0) + space.B @ (u[j] - space.u0)
        known = space.rates + space.B @ (u[j + 1] - space.u0)
        middle = 0.5 * (before + known) + disturbance[j]
        x[j + 1] = space.x0 + F @ (x[j] - space.x0 + h * middle)
    del generator
    signals = [Signal(f"engine.{s.name}", s.unit) for s in (*space.states, *space.inputs)]
    kept = [i for i, s in enumerate(signals) if s.name.partition(".")[2] not in leave]
    values = np.hstack([x, u])[:, kept]
    write_signals(Record(tuple(signals[i] for i in kept), time, values), path)
    return disturbance


def disturbances(k: int) -> np.ndarray:
    """Normal, skewed and uniform ones on three states, nothing on the others, in SI a second."""
    generator = np.random.default_rng(1)
    found = np.zeros((k, len(STATES)))
    found[:, PLACES["p_im"]] = 2000.0 * generator.normal(size=k)
    found[:, PLACES["omega_tc"]] = 300.0 * generator.exponential(size=k)
    found[:, PLACES["F_im"]] = 0.01 * generator.uniform(-1.0, 1.0, size=k)
    return found


def test_disturbances_put_in_come_out_with_their_moments_and_by_the_papers_rules(tmp_path: Path, crankbench):
    path = tmp_path / "signals.parquet"
    put = linear_record(path, disturbances(2000), 1e-3)[:-1]
    code, out, err = crankbench("noise", path, "--model", "turbo_si_egr", "--settle", "--json")
    assert code == 0, err
    found = json.loads(out)
    rows = {row["name"]: row for row in found["states"]}
    for name, rule in (("p_im", "symmetric"), ("omega_tc", "less"), ("F_im", "symmetric, flat")):
        column = put[:, PLACES[name]]
        # What is recorded in double precision, in differences of 1e-3: 1e-16 x/h, of 1e5 Pa a hundredth of a Pa/s.
        assert rows[name]["mean"] == pytest.approx(column.mean(), rel=1e-4, abs=1e-4 * column.std())
        assert rows[name]["deviation"] == pytest.approx(column.std(), rel=1e-6)
        assert rows[name]["rule"] == rule
    assert rows["omega_tc"]["process"] == pytest.approx(
        abs(put[:, PLACES["omega_tc"]].std() - put[:, PLACES["omega_tc"]].mean()), rel=1e-3
    )
    assert rows["p_im"]["process"] == rows["p_im"]["deviation"]
    assert rows["F_im"]["process"] == pytest.approx(-rows["F_im"]["kurtosis"] * rows["F_im"]["deviation"])
    # White from interval to interval: the density is the deviation times the root of the interval, 15 % by its width.
    assert rows["p_im"]["density"] == pytest.approx(rows["p_im"]["deviation"] * np.sqrt(1e-3), rel=0.15)
    assert rows["p_boost"]["deviation"] < 1e-3 * rows["p_im"]["deviation"]
    assert all(rows[name]["process"] == 0.0 and "a lag" in rows[name]["why"] for name in LAGS)


def test_residuals_are_about_what_the_record_is_said_to_rest_at(tmp_path: Path, crankbench):
    path = tmp_path / "signals.parquet"
    linear_record(path, disturbances(500), 1e-3)
    space = operate(Operation("turbo_si_egr", settled=True)).space
    asked = ("noise", path, "--model", "turbo_si_egr", "--settle", "--json")
    moved = space.x0[PLACES["p_im"]] + 1000.0
    found = []
    for more in ((), ("--about", f"p_im={moved:.10g} Pa,N=3200 rpm")):
        code, out, err = crankbench(*asked, *more)
        assert code == 0, err
        found.append({row["name"]: row for row in json.loads(out)["states"]})
    for name in ("p_im", "T_im", "p_em"):
        # r = x' - A (x - x_0) - B (u - u_0): 1000 Pa more of x_0 add 1000 Pa of that column of A to all residuals.
        shift = 1000.0 * space.A[PLACES[name], PLACES["p_im"]]
        assert found[1][name]["mean"] - found[0][name]["mean"] == pytest.approx(shift, rel=1e-4)
        assert found[1][name]["deviation"] == pytest.approx(
            found[0][name]["deviation"], rel=1e-4, abs=1e-6 * abs(shift)
        )


def test_what_is_not_recorded_is_said_and_lags_of_actuators_follow_their_commands(tmp_path: Path, crankbench):
    path = tmp_path / "signals.parquet"
    left = ("F_t", "throttle_position", "wastegate_position", "egr_position", "EVC", "MAF")
    linear_record(path, disturbances(50), 1e-3, left)
    code, out, err = crankbench("noise", path, "--model", "turbo_si_egr", "--settle", "--json")
    assert code == 0, err
    found = json.loads(out)
    rows = {row["name"]: row for row in found["states"]}
    assert rows["F_t"]["process"] is None and rows["F_t"]["why"] == "F_t is not recorded"
    assert rows["F_egr"]["process"] is None and rows["F_egr"]["why"] == "it depends on F_t, not recorded"
    assert found["held"] == ["EVC"]
    assert {"throttle_position", "wastegate_position", "egr_position"} <= set(found["followed"])
    assert "F_t" not in found["process"] and any("no process noise of F_t" in note for note in found["notes"])
    # A selection cannot go by it, and says so.
    code, _, err = crankbench("noise", path, "--model", "turbo_si_egr", "--settle", "--out", tmp_path / "noise.json")
    code, _, err = crankbench("select", "turbo_si_egr", "--settle", "--process", tmp_path / "noise.json")
    assert code == 2 and "--process has no noise of F_t, F_egr" in err


def test_a_state_that_follows_its_command_is_the_lag_of_it(tmp_path: Path):
    # Commands that ramp, positions left out: the lag's closed form is u - tau s + tau s exp(-t/tau).
    space = operate(Operation("turbo_si_egr", settled=True)).space
    time = 1e-2 * np.arange(101)
    u = np.tile(space.u0, (101, 1))
    place = [s.name for s in space.inputs].index("egr_valve")
    u[:, place] += 0.2 * time
    signals = tuple(Signal(f"engine.{s.name}", s.unit) for s in space.inputs)
    path = tmp_path / "signals.parquet"
    write_signals(Record(signals, time, u), path)
    course = read_course(path, space, columns(space, path, {}, "engine"), LAGS, (), (0.0, np.inf))
    expected = u[:, place] - 0.05 * 0.2 * (1.0 - np.exp(-time / 0.05))
    np.testing.assert_allclose(course.x[:, PLACES["egr_position"]], expected, rtol=1e-12)
    assert course.followed == ("throttle_position", "egr_position", "wastegate_position")


def test_the_documented_cycle_gives_noise_that_selections_take_and_observers_too(
    cycle: Path, tmp_path: Path, crankbench
):
    file = tmp_path / "noise.json"
    asked = ("noise", cycle, "--model", "turbo_si_egr", "--part", "engine", "--after", "3.3 s")
    code, out, err = crankbench(*asked, "--map", "EGR_DP=egr_dp.value", "--out", file)
    assert code == 0, err
    found = json.loads(file.read_text())
    assert found["map"]["EGR_DP"] == "egr_dp.value" and found["map"]["N"] == "N.value" and found["held"] == []
    # Section 3.3: accuracy times the largest deviation from the point.
    for row in found["sensors"]:
        assert row["noise"] == pytest.approx(ACCURACIES[row["name"]] * row["largest"], rel=1e-12)
    (line,) = [line for line in out.splitlines() if line.startswith("process: ")]
    written = YAML(typ="safe").load(line)["process"]
    assert {name: str(value) for name, value in written.items()} == found["process"]

    usual = ("select", "turbo_si_egr", "--estimate", "F_im", "--max-sensors", "1", "--by", "error", "--json")
    code, out, err = crankbench(*usual, "--process", file, "--noise", file)
    assert code == 0, err
    selected = json.loads(out)
    assert selected["process"] == found["process"]
    noise = {sensor["name"]: sensor["noise"] for sensor in selected["sensors"]}
    assert noise == pytest.approx({row["name"]: row["noise"] for row in found["sensors"]}, rel=1e-5)
    other = json.loads(crankbench(*usual)[1])
    assert selected["sets"][0]["error"] != other["sets"][0]["error"]

    model = constant_gain.make(
        plant="fmus.plants.turbo_si_egr", sensors=["EGR_DP"], noise={"EGR_DP": found["noise"]["EGR_DP"]},
        process=found["process"], outputs=["W_cyl"], sample_time=0.01,
    )  # fmt: skip
    assert model.role == "observer" and "EGR_DP_measured" in {s.name for s in model.inputs}


def test_the_likelihood_takes_the_sensors_readings_and_says_what_they_do_not_tell(cycle: Path, crankbench):
    asked = ["noise", cycle, "--model", "turbo_si_egr", "--part", "engine", "--after", "3.3 s", "--json"]
    asked += ["--average", "50 ms", "--by", "likelihood", "--map", "EGR_DP=egr_dp.value"]
    code, out, err = crankbench(*asked)
    assert code == 0, err
    found = json.loads(out)
    rows = {row["name"]: row for row in found["states"]}
    assert found["interval"] == pytest.approx(0.05) and np.isfinite(found["log_likelihood"])
    # Burnt gas reaches the air path's sensors through the fuel's mass alone: nothing is known of its noise.
    untold = rows["F_boost"]
    assert untold["likelihood_error"] is None or untold["likelihood_error"] > 1.0
    assert untold["process"] == untold["density"]
    assert any("do not tell of the noise of F_boost" in note for note in found["notes"])
    told = [row for row in rows.values() if row["likelihood_error"] is not None and row["likelihood_error"] < 1.0]
    assert told and all(row["process"] == row["likelihood"] for row in told)


def test_averaging_over_a_cycle_takes_out_what_repeats_in_it(tmp_path: Path, crankbench):
    # A ripple of the firing frequency on p_im, as a crank-resolved reference has: at rows it is all, at cycles nothing.
    space = operate(Operation("turbo_si_egr", settled=True)).space
    k, h = 1201, 1e-3
    time = h * np.arange(k)
    x = np.tile(space.x0, (k, 1))
    x[:, PLACES["p_im"]] += 2000.0 * np.sin(2.0 * np.pi * time / 0.04)
    signals = tuple(Signal(f"engine.{s.name}", s.unit) for s in (*space.states, *space.inputs))
    path = tmp_path / "signals.parquet"
    crank = np.rad2deg(space.u0[-1]) * time
    write_signals(Record(signals, time, np.hstack([x, np.tile(space.u0, (k, 1))]), crank=crank), path)
    deviations = {}
    for average in ((), ("--average", "40 ms"), ("--average", "768 deg")):
        code, out, err = crankbench("noise", path, "--model", "turbo_si_egr", "--settle", "--json", *average)
        assert code == 0, err
        deviations[average] = {row["name"]: row["deviation"] for row in json.loads(out)["states"]}["p_im"]
    # 768 degrees at 3200 rpm are 40 ms. A whole period has no mean, but for the rounding of rows to marks.
    assert deviations[()] > 1e5
    assert deviations["--average", "40 ms"] < 1e-6 * deviations[()]
    assert deviations["--average", "768 deg"] < 1e-6 * deviations[()]


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (("--map", "p_boots=engine.p_im"), "--map p_boots: no signal is named 'p_boots'; did you mean 'p_boost'?"),
        (("--map", "p_boost=engine.p_bost"), "--map p_boost: no recorded signal is named 'engine.p_bost'"),
        (("--map", "p_boost"), "--map p_boost: wants signal=recorded, or a file of crankbench inspect --like"),
        (("--map", "p_boost=engine.T_im"), "p_boost wants Pa, engine.T_im is in K"),
        (("--accuracy", "MAFx=3 %"), "--accuracy MAFx=3 %: no sensor is named 'MAFx'"),
        (("--accuracy", "MAF=3 kg"), "--accuracy MAF: wants 1, got 3 kg"),
        (("--lags", "speed"), "--lags speed: no state is named 'speed'"),
        (("--sensors", "W_e"), "--sensors W_e: no state or output is named 'W_e'"),
        (("--after", "3 kg"), "--after: wants s, got 3 kg"),
        (("--after", "100 s"), "wants three rows or more from 100 s on, has 0"),
        (("--average", "720 deg"), "--average of a crank angle wants a record on a crank clock"),
        (("--average", "11 s"), "--average leaves 1 intervals of the record, wants two or more"),
        (("--kurtosis", "1"), "--kurtosis less than 0, got 0.5 and 1"),
        (("--out", "noise.txt"), "--out wants a file that ends in .json, got noise.txt"),
    ],
)
def test_what_does_not_fit_is_said(cycle: Path, crankbench, more, said):
    code, _, err = crankbench("noise", cycle, "--model", "turbo_si_egr", "--part", "engine", *more)
    assert code == 2 and said in err


def test_a_record_that_is_not_there_and_noise_that_is_no_file_are_said(tmp_path: Path, crankbench):
    code, _, err = crankbench("noise", tmp_path / "none", "--model", "turbo_si_egr")
    assert code == 2 and f"no record at {tmp_path / 'none'}" in err
    code, _, err = crankbench("select", "turbo_si_egr", "--process", tmp_path / "none.json")
    assert code == 2 and "--process wants a file of crankbench noise, there is no" in err
    (tmp_path / "other.json").write_text("{}")
    code, _, err = crankbench("select", "turbo_si_egr", "--noise", tmp_path / "other.json")
    assert code == 2 and "has no 'noise' by name; crankbench noise --out writes one" in err
    (tmp_path / "cut.json").write_text('{"process": {')
    code, _, err = crankbench("select", "turbo_si_egr", "--process", tmp_path / "cut.json")
    assert code == 2 and "cut.json wants what crankbench noise --out writes, got no JSON: " in err
    code, _, err = crankbench("select", "turbo_si_egr", "--process", "much")
    assert code == 2 and "--process wants a share of the states' sizes, like 0.01, or a file that ends in .json" in err


def test_a_name_that_two_parts_have_is_asked_about(tmp_path: Path, crankbench):
    signals = (Signal("one.p_boost", "Pa"), Signal("other.p_boost", "Pa"))
    path = tmp_path / "signals.parquet"
    write_signals(Record(signals, np.arange(4.0), np.ones((4, 2))), path)
    code, _, err = crankbench("noise", path, "--model", "turbo_si_egr")
    assert code == 2 and "p_boost is recorded as one.p_boost and other.p_boost: say which by --part or --map" in err
