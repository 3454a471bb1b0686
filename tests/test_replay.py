"""A replay shows at each instant what was recorded then: sensors and observers cannot tell it from the plant."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import asammdf
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from crank_parts import SPEED
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from lawbook import Course, check_component
from oracle import run_plainly

from fmus.component import ConfigurationError, Signal, Vector
from harness.campaign import find_campaign, read_campaign
from harness.cases import Ended, execute
from harness.clock import CrankGrid
from harness.places import Places
from harness.points import Points
from harness.preflight import preflight
from harness.record import Record, read_signals, write_signals
from harness.replay import ReplayComponent, Replayed
from harness.run import run
from harness.scenario import Scenario
from harness.source import SourceComponent, Wave
from harness.system import System
from harness.wiring import wire

IN_TIME = {"time": {"step": "1 ms", "stop": "1 s"}}


def system(folder: Path, parts: dict[str, Any], clock: dict[str, Any] | None = None, **more: Any) -> System:
    """A system whose files are in a folder."""
    described = {"clock": clock or IN_TIME, "parts": parts, **more}
    return wire(Scenario.model_validate(described), Places(str(folder / "rig.yaml")))


def kept(folder: Path, times: Vector, **columns: tuple[str, str, Vector]) -> str:
    """A file as records have it, of columns as (unit, kind, values in SI)."""
    signals = tuple(Signal(name, unit, kind=kind) for name, (unit, kind, _) in columns.items())
    write_signals(
        Record(signals, times, np.column_stack([values for *_, values in columns.values()])), folder / "kept.parquet"
    )
    return "kept.parquet"


def problems(folder: Path, part: str, clock: str = "time: {step: 1 ms, stop: 1 s}") -> list[str]:
    """What is wrong with a campaign of one replay, as `line:column: message`."""
    file = folder / "rig.yaml"
    file.write_text(f"campaign: rig\nclock: {{{clock}}}\nparts:\n  rig: {part}\n")
    with pytest.raises(ConfigurationError) as error:
        preflight(read_campaign(file))
    return [str(problem).replace(f"{file}:", "") for problem in error.value.problems]


# A record in the place of its plant


@pytest.fixture(scope="module")
def live(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Record, dict[str, Any]]:
    """Folder, record and description of the built-in driveline with its observers and a noisy encoder."""
    case = next(case for case in read_campaign(find_campaign("driveline")).cases if case.experiment == "figure_6")
    described = case.scenario.model_dump(mode="json", by_alias=True)
    described["parts"]["encoder"]["noise"] = {"std": "0.5 rpm"}
    described["clock"]["time"] |= {"stop": "2.5 s", "start": "0.3 s"}
    folder = tmp_path_factory.mktemp("live")
    with wire(Scenario.model_validate(described), case.places) as wired:
        record = run(wired)
    assert record.outcome == "ok"
    write_signals(record, folder / "signals.parquet")
    return folder, record, described


@pytest.mark.parametrize("between", ["hold", "linear"])
def test_sensors_and_observers_give_the_same_bits_on_a_replay_as_on_the_plant(
    live: tuple[Path, Record, dict[str, Any]], between: str
):
    folder, record, described = live
    parts = dict(described["parts"])
    columns = {"y": "plant.y", "location": "plant.location", "omega_c": "plant.omega_c", "T_eng": "torque.value"}
    parts["plant"] = {"use": "replay", "file": "signals.parquet", "signals": columns, "between": between}
    parts["torque"] = {"use": "sensor", "of": "plant.T_eng"}
    with system(folder, parts, described["clock"], seed=described["seed"]) as wired:
        replayed = run(wired)
    assert replayed.outcome == "ok"
    assert replayed.time.tobytes() == record.time.tobytes()
    common = [name for name in replayed.names if name in record.names]
    assert {"encoder.value", "hybrid.omega_c", "luenberger.theta_e"} <= set(common) and len(common) > 20
    assert [name for name in common if replayed[name].tobytes() != record[name].tobytes()] == []
    units = {signal.name: (signal.unit, signal.kind) for signal in replayed.signals}
    assert (units["plant.y"], units["plant.location"]) == (("rpm", "real"), ("1", "integer"))


def test_a_plant_driven_by_a_recorded_input_runs_as_it_did(live: tuple[Path, Record, dict[str, Any]]):
    folder, record, described = live
    parts = {
        "bench": {"use": "replay", "file": "signals.parquet", "signals": {"T_eng": "torque.value"}},
        "plant": {**described["parts"]["plant"], "wires": {"T_eng": "bench.T_eng"}},
    }
    with system(folder, parts, described["clock"]) as wired:
        again = run(wired)
    assert again["plant.y"].tobytes() == record["plant.y"].tobytes()


# The laws of time


def test_a_row_has_what_was_recorded_at_its_own_instant(tmp_path: Path):
    times = np.array([0.0, 0.25, 0.5, 1.0])
    file = kept(
        tmp_path, times, x=("1", "real", np.array([1.0, 5.0, 3.0, 7.0])), on=("1", "boolean", np.array([0.0, 1, 1, 0]))
    )
    signals = {"held": "x", "joined": {"column": "x", "between": "linear"}, "on": "on"}
    clock = {"time": {"step": "0.125 s", "stop": "1 s"}}
    for between, columns in (
        ("hold", signals),
        ("linear", {"held": {"column": "x", "between": "hold"}, "joined": "x", "on": "on"}),
    ):
        with system(
            tmp_path, {"rig": {"use": "replay", "file": file, "signals": columns, "between": between}}, clock
        ) as wired:
            record = run(wired)
        assert record["rig.held"].tolist() == [1, 1, 5, 5, 3, 3, 3, 3, 7]
        assert record["rig.joined"].tolist() == [1, 3, 5, 4, 3, 4, 5, 6, 7]
        assert record["rig.on"].tolist() == [0, 0, 1, 1, 1, 1, 1, 1, 0]  # discrete: held whatever is between


def test_a_replay_may_be_held_or_repeated_where_it_ends(tmp_path: Path):
    (tmp_path / "measured.csv").write_text("time [s],x [m]\n0.2,1\n0.4,2\n0.6,9\n")
    rig = {"use": "replay", "file": "measured.csv", "signals": {"x": "x"}}
    clock = {"time": {"step": "0.1 s", "stop": "1 s"}}
    for ends, wanted in (("hold", [1, 1, 1, 1, 2, 2, 9, 9, 9, 9, 9]), ("repeat", [2, 2, 1, 1, 2, 2, 1, 1, 2, 2, 1])):
        with system(tmp_path, {"rig": {**rig, "ends": ends}}, clock) as wired:
            assert run(wired)["rig.x"].tolist() == wanted


@st.composite
def _described(draw: Callable[..., Any]) -> tuple[list[int], list[list[float]], dict[str, Any]]:
    rows = sorted(draw(st.sets(st.integers(-30, 60), min_size=2, max_size=15)))
    number = st.floats(-1e3, 1e3)
    values = [draw(st.lists(number, min_size=len(rows), max_size=len(rows))) for _ in range(2)]
    rig = {
        "between": draw(st.sampled_from(["hold", "linear"])),
        "ends": draw(st.sampled_from(["hold", "repeat"])),
        "signals": {"a": "a", "b": {"column": "b", "between": draw(st.sampled_from(["hold", "linear"]))}},
    }
    return rows, values, rig


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(described=_described())
def test_the_c_replay_matches_the_plain_python_oracle_bit_for_bit(
    tmp_path: Path, described: tuple[list[int], list[list[float]], dict[str, Any]]
):
    rows, values, rig = described
    fields = {"time": pa.array([0.7e-3 * row for row in rows]), "a": pa.array(values[0]), "b": pa.array(values[1])}
    pq.write_table(pa.table(fields), tmp_path / "kept.parquet")
    columns = {"a": {"column": "a", "unit": "1"}, "b": {**rig["signals"]["b"], "unit": "1"}}
    part = {**rig, "use": "replay", "file": "kept.parquet", "time_unit": "s", "signals": columns}
    parts = {"rig": part, "reader": {"use": "sensor", "of": "rig.a", "every": "3 ms"}}
    with system(tmp_path, parts, {"time": {"step": "1 ms", "stop": "40 ms"}}) as wired:
        record = run(wired)
        assert np.column_stack([record.time, record.values]).tobytes() == run_plainly(wired).tobytes()


def _component(clock: CrankGrid | None) -> ReplayComponent:
    times = np.arange(20.0) * (6.0 if clock else 0.01)
    values = np.sin(np.arange(20.0))
    axis = "deg" if clock else "s"
    return ReplayComponent(
        [
            Replayed(Signal("x", "m"), Points(times, values, "linear", "hold", 1e-9, axis)),
            Replayed(Signal("n", kind="integer"), Points(times, np.round(values), "hold", "repeat", 1e-9, axis)),
        ],
        clock,
    )


CRANK_GRID = CrankGrid(0.0, 1000, np.inf, 6.0, 1, 0.0, 120, (), 1.0)
MADE: dict[str, Callable[[], Any]] = {
    "over time": lambda: _component(None),
    "over crank angle": lambda: _component(CRANK_GRID),
    "points": lambda: SourceComponent("m", _component(None).points[0]),
    "chirp": lambda: SourceComponent("m", Wave("linear chirp", 1.0, 2.0, 3.0, 0.5, 0.1, 1.0, 4.0)),
    "logarithmic": lambda: SourceComponent("m", Wave("logarithmic chirp", 1.0, 2.0, 3.0, 0.5, 0.1, 1.0, 4.0)),
}


@pytest.mark.parametrize("made", MADE)
def test_replays_and_sources_keep_the_laws_of_a_component(made: str):
    check_component(MADE[made], Course(0.01))


# Over crank angle


def test_a_record_of_a_crank_clock_replays_over_its_crank_angles_bit_for_bit(tmp_path: Path):
    crank = {"step": "7 deg", "stop": "7000 deg", "speed": "engine.omega", "cycle": "700 deg", "origin": "14 deg"}
    engine = {"use": "crank_parts:ENGINE", "with": {"rate": "60 rad/s2", "omega": "900 rpm"}}
    noisy = {"use": "sensor", "of": "engine.omega", "noise": {"std": "1 rad/s"}}
    with system(tmp_path, {"engine": engine, "noisy": noisy}, {"crank": crank}) as wired:
        record = run(wired)
    write_signals(record, tmp_path / "signals.parquet")
    rig = {"use": "replay", "file": "signals.parquet", "signals": {"omega": "engine.omega", "theta": "engine.theta"}}
    for axis in ({"crank": "crank"}, {"time": "time"}):
        with system(tmp_path, {"engine": {**rig, **axis}, "noisy": noisy}, {"crank": crank}) as wired:
            again = run(wired)
            assert np.column_stack([again.time, again.values]).tobytes() == run_plainly(wired).tobytes()
        assert again.crank is not None and record.crank is not None
        assert again.crank.tobytes() == record.crank.tobytes() and again.time.tobytes() == record.time.tobytes()
        for name in ("engine.omega", "engine.theta", "noisy.value"):
            assert again[name].tobytes() == record[name].tobytes()


def test_one_recorded_cycle_may_be_repeated_over_crank_angle(tmp_path: Path):
    angles = np.arange(0, 721, 2)
    pressure = 1.0 + np.maximum(0.0, np.sin(np.radians(angles / 2.0)))
    rows = "".join(f"{angle},{p!r}\n" for angle, p in zip(angles.tolist(), pressure.tolist(), strict=True))
    (tmp_path / "cylinder.csv").write_text("angle [deg],pressure [bar]\n" + rows)
    parts = {
        "engine": {"use": "crank_parts:ENGINE"},
        "cylinder": {
            "use": "replay",
            "file": "cylinder.csv",
            "crank": "angle",
            "signals": {"p": "pressure"},
            "ends": "repeat",
        },
    }
    with system(tmp_path, parts, {"crank": {"step": "6 deg", "stop": "10 rev", "speed": "engine.omega"}}) as wired:
        record = run(wired)
    assert record.crank is not None
    wanted = pressure[(record.crank.astype(int) % 720) // 2] * 1e5
    assert np.array_equal(record["cylinder.p"], wanted)


def test_a_step_that_a_clock_repeats_to_steer_exactly_is_one_of_a_replay_over_crank_angle(tmp_path: Path):
    angles = np.arange(0.0, 3601.0, 6.0)
    (tmp_path / "kept.csv").write_text(
        "crank [deg],x [1]\n" + "".join(f"{a!r},{float(np.sin(a))!r}\n" for a in angles.tolist())
    )
    replay = {"use": "replay", "file": "kept.csv", "crank": "crank", "signals": {"x": "x"}}
    parts = {"x": replay, "engine": {"use": "crank_parts:ENGINE", "with": {"rate": "90 rad/s2"}}}
    clock = {"step": "6 deg", "stop": "10 rev", "speed": "engine.omega", "angle": "engine.theta", "steer": "exact"}
    with system(tmp_path, parts, {"crank": clock}) as wired:
        record = run(wired)
        assert np.column_stack([record.time, record.values]).tobytes() == run_plainly(wired).tobytes()
    assert record.outcome == "ok" and np.array_equal(record["x.x"], np.sin(angles))
    # Steered exactly: the engine is at the clock's angle, to a billionth of a turn.
    np.testing.assert_allclose(record["engine.theta"], np.radians(angles), rtol=0, atol=1e-8)


def test_what_ends_before_the_run_on_a_crank_clock_ends_it_with_an_error_that_says_what_there_is(tmp_path: Path):
    file = kept(tmp_path, np.array([0.0, 0.1]), omega=("rad/s", "real", np.array([SPEED, SPEED])))
    parts = {"engine": {"use": "replay", "file": file, "signals": {"omega": "omega"}}}
    with system(tmp_path, parts, {"crank": {"step": "6 deg", "stop": "10 rev", "speed": "engine.omega"}}) as wired:
        record = run(wired)
    assert (record.outcome, record.part) == ("error", "engine")
    assert record.message == "recorded is 0 s ... 0.1 s; `ends: hold` holds the nearest"
    # 6 deg at 1000 rpm are 1 ms.
    assert len(record.time) == 101 and record.failed_at == pytest.approx(0.101)
    source = {"use": "source", "unit": "1", "table": {"file": file, "value": "omega", "unit": "rad/s"}}
    parts = {"engine": {"use": "crank_parts:ENGINE"}, "source": {**source, "unit": "rad/s"}}
    with system(tmp_path, parts, {"crank": {"step": "6 deg", "stop": "10 rev", "speed": "engine.omega"}}) as wired:
        record = run(wired)
    assert (record.outcome, record.part) == ("error", "source")
    assert record.message.startswith("it has values at 0 s ... 0.1 s, none at 0.101")


# What is wrong


RIG = "{use: replay, file: measured.csv, signals: {x: %s}%s}"


@pytest.mark.parametrize(
    ("column", "more", "column_of_file", "said"),
    [
        ("speed", "", 55, "rig.signals.x.column: no column is named 'speed'; did you mean 'sped'?"),
        (
            "{column: x, unit: m}",
            "",
            73,
            "rig.signals.x.unit: the file says that 'x' is in N, the campaign that it is in m",
        ),
        ("{column: x, unti: m}", "", 67, "unknown key 'unti' in parts.rig.signals.x; did you mean 'unit'?"),
        ("{column: x, kind: boolean}", "", 64, "rig.signals.x.column wants 0 or 1, got 2 in row 2 of 'x'"),
        ("{column: z, kind: integer}", "", 64, "rig.signals.x.column wants a whole number, got 0.5 in row 2 of 'z'"),
        (
            "{column: n, between: linear, kind: integer}",
            "",
            76,
            "rig.signals.x.between wants hold for integer values, got linear",
        ),
        (
            "x",
            ", time: t",
            55,
            "rig.signals.x wants values at 0 s ... 1 s, but has them at 0 s ... 0.5 s; `ends: hold` holds the nearest",
        ),
        ("x", ", crank: t", 66, "rig.crank wants a crank clock, got one in time: leave it out"),
        ("x", ", crank: t, time: t", 8, "parts.rig wants one of time, crank, got both"),
        ("[x]", "", 55, "parts.rig.signals.x wants a mapping of keys to values, got ['x']"),
    ],
)
def test_what_is_wrong_with_a_replay_is_told_at_its_key(
    tmp_path: Path, column: str, more: str, column_of_file: int, said: str
):
    (tmp_path / "measured.csv").write_text("time [s],t [s],x [N],z [1],n [1],sped [m]\n0,0,1,0,0,0\n2,0.5,2,0.5,1,0\n")
    assert problems(tmp_path, RIG % (column, more)) == [f"4:{column_of_file}: {said}"]


def test_all_columns_and_keys_that_are_wrong_are_told_at_once(tmp_path: Path):
    (tmp_path / "measured.csv").write_text("time [s],x [N],y,zeds\n0,1,2,0\n3,1,2,0\n")
    part = "{use: replay, file: measured.csv, time: tme, signals: {x: y, a.b: x, z: zed}}"
    assert problems(tmp_path, part) == [
        "4:48: rig.time: no column is named 'tme'; did you mean 'time'?",
        "4:66: rig.signals.x.column wants a unit: the file does not say what 'y' is in; write `unit: ...`",
        "4:74: a signal's name wants letters, digits and _, got 'a.b'",
        "4:80: rig.signals.z.column: no column is named 'zed'; did you mean 'zeds'?",
    ]
    assert problems(tmp_path, "{use: replay, file: no.csv, signals: {x: y}}") == [
        f"4:28: rig.file wants a file, but there is none at {tmp_path / 'no.csv'}"
    ]
    assert problems(tmp_path, "{use: replay, file: measured.csv, signals: {}}") == [
        "4:8: parts.rig wants at least one of `signals`"
    ]


def test_a_part_with_signals_or_a_use_near_replay_is_read_as_one(tmp_path: Path):
    assert problems(tmp_path, "{use: repay, file: a.csv, signals: {x: y}}") == [
        "4:14: parts.rig.use wants 'replay', got 'repay'"
    ]
    assert problems(tmp_path, "{file: a.csv, signals: {x: y}}") == ["4:3: parts.rig wants the key 'use'"]


def test_an_observer_may_not_read_a_replay_without_a_sensor(tmp_path: Path):
    file = kept(tmp_path, np.array([0.0, 1.0]), y=("rpm", "real", np.ones(2)), loc=("1", "integer", np.ones(2)))
    parts = {
        "rig": {"use": "replay", "file": file, "signals": {"y": "y", "location": "loc"}},
        "observer": {
            "use": "loop_parts:estimator",
            "with": {"gain": "1 1/s"},
            "wires": {"y": "rig.y", "location": "rig.location"},
        },
    }
    with pytest.raises(ConfigurationError) as error:
        system(tmp_path, parts)
    assert [problem.message.split(":")[0] for problem in error.value.problems] == [
        "observer.y reads the truth, rig.y",
        "observer.location reads the truth, rig.location",
    ]


# The whole way


def crankbench(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "harness", "run", *arguments, "--jobs", "1"]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=300, check=False)


def executed(file: Path, folder: Path) -> list[bool]:
    """Whether each case of a campaign, all of which are accepted, was kept from an earlier run."""
    told: list[Ended] = []
    assert execute(read_campaign(file), folder, 1, told.append).accepted
    return [ended.reused for ended in told]


def one_record(folder: Path) -> Record:
    (file,) = folder.glob("cases/*/signals.parquet")
    return read_signals(file)


def test_the_replay_of_the_documentation_is_run_and_accepted(tmp_path: Path):
    text = (Path(__file__).parent.parent / "docs" / "campaign.md").read_text(encoding="utf-8")
    section = text[text.index("## Recorded data") :]
    yaml, csv = (re.search(rf"```{kind}\n(.*?)```", section, re.DOTALL) for kind in ("yaml", "csv"))
    assert yaml is not None and csv is not None
    (tmp_path / "bench.yaml").write_text(yaml[1])
    (tmp_path / "bench.csv").write_text(csv[1])
    ended = crankbench(tmp_path, "bench.yaml", "--out", "out")
    assert ended.returncode == 0, ended.stdout + ended.stderr
    assert (tmp_path / "out" / "report.html").is_file()
    record = one_record(tmp_path / "out")
    table = np.array([[float(cell) for cell in line.split(",")] for line in csv[1].splitlines()[1:]])
    np.testing.assert_allclose(
        record["rig.speed"], np.interp(record.time, table[:, 0], table[:, 1]) * np.pi / 30.0, rtol=1e-12
    )
    held = table[np.searchsorted(table[:, 0], record.time[:-1] + 1e-9, side="right") - 1, 2]
    np.testing.assert_allclose(record["torque.value"][1:], held, rtol=1e-12)


CAMPAIGN = """\
campaign: bench
clock: {time: {step: 10 ms, stop: 1 s}}
parts:
  rig: {use: replay, file: %s, signals: {n: {column: n, unit: rpm}, gear: gear}}
  encoder: {use: sensor, of: rig.n, noise: {std: 1 rpm}}
record: [rig, encoder]
metrics:
  error: {rmse: [rig.n, encoder.value], unit: rpm}
accept:
  - error < 1.5 rpm
"""


def test_a_measurement_gives_the_same_bytes_from_every_format_and_is_kept_until_it_changes(tmp_path: Path):
    times, speed, gear = np.arange(101) * 0.01, np.linspace(800.0, 2000.0, 101), np.arange(101) // 40
    fields = [pa.field("time", pa.float64(), metadata={"unit": "s"}), pa.field("n", pa.float64())]
    fields.append(pa.field("gear", pa.int64(), metadata={"unit": "1"}))
    table = pa.Table.from_arrays([pa.array(times), pa.array(speed), pa.array(gear)], schema=pa.schema(fields))
    pq.write_table(table, tmp_path / "bench.parquet")
    with asammdf.MDF(version="4.10") as file:
        group = [("n", speed, "1/min"), ("gear", gear.astype("u1"), "1")]
        file.append([asammdf.Signal(samples=v, timestamps=times, name=name, unit=unit) for name, v, unit in group])
        file.save(tmp_path / "bench.mf4")
    rows = zip(times.tolist(), speed.tolist(), gear.tolist(), strict=True)
    (tmp_path / "bench.csv").write_text("time [s],n,gear [1]\n" + "".join(f"{t!r},{n!r},{g}\n" for t, n, g in rows))
    records = []
    for suffix in ("parquet", "mf4", "csv"):
        text = CAMPAIGN % f"bench.{suffix}"
        if suffix == "csv":
            text = text.replace("gear: gear", "gear: {column: gear, kind: integer}")
        (tmp_path / "bench.yaml").write_text(text)
        assert executed(tmp_path / "bench.yaml", tmp_path / suffix) == [False]
        records.append(next((tmp_path / suffix).glob("cases/*/signals.parquet")).read_bytes())
    assert records[0] == records[1] == records[2]
    assert one_record(tmp_path / "csv").signals[1].kind == "integer"
    assert executed(tmp_path / "bench.yaml", tmp_path / "csv") == [True]
    (tmp_path / "bench.csv").write_text((tmp_path / "bench.csv").read_text().replace("0.5,1400.0,1", "0.5,1401.0,1"))
    assert executed(tmp_path / "bench.yaml", tmp_path / "csv") == [False]
    cases = json.loads((tmp_path / "csv" / "campaign.json").read_text())["cases"]
    record = read_signals(tmp_path / "csv" / "cases" / cases[0]["key"] / "signals.parquet")
    assert record["rig.n"][50] == pytest.approx(1401.0 * np.pi / 30.0, rel=1e-15)
