"""Records are written while runs go on: the rows of every fate, the same bytes each time, and nothing half done."""

from __future__ import annotations

import errno
import json
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from harness import cases
from harness.campaign import Campaign, read_campaign
from harness.cases import Result, Underway, execute
from harness.record import Record, read_signals, write_signals
from harness.run import run
from harness.signalsfile import GROUP, GroupSize, SignalsFile
from harness.stored import StoredRecord
from harness.wiring import wire
from harness.worker import Limits, Worker

# 201 rows in row groups of 16: twelve of them, and one of 9.
SMALL = GroupSize(bytes=0, rows=16)
CAMPAIGN = """\
campaign: streamed
clock: CLOCK
seed: 5
parts:
  plant: {use: fateful_parts}
  gauge: {use: sensor, of: plant.omega, noise: {std: 1 rad/s}}
vary: {"plant.fate, plant.nth": [CASES]}
metrics: {error: {rmse: [plant.omega, gauge.value]}}
limits: {case: 60 s, step: 2 s}
"""
TIME = "{time: {step: 1 ms, stop: 0.2 s}}"
CRANK = "{crank: {step: 6 deg, stop: STOP, speed: plant.omega}}"


@pytest.fixture(autouse=True)
def small_rooms(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cases, "GROUP", SMALL)


def campaign(folder: Path, fates: str = "[none, 0]", *overrides: str, clock: str = TIME) -> Campaign:
    file = folder / "streamed.yaml"
    file.write_text(CAMPAIGN.replace("CLOCK", clock).replace("CASES", fates))
    return read_campaign(file, overrides)


def execute_all(asked: Campaign, folder: Path, jobs: int = 1, **rest: Any) -> Result:
    return execute(asked, folder, jobs, lambda ended: None, **rest)


def whole(asked: Campaign) -> Record:
    """The record of the first case, run in this process."""
    with wire(asked.cases[0].scenario, asked.cases[0].places) as system:
        return run(system)


def stored(folder: Path, asked: Campaign, case: int = 0) -> Path:
    return folder / "cases" / asked.cases[case].key / "signals.parquet"


def told(folder: Path, asked: Campaign, case: int = 0) -> dict[str, Any]:
    content: dict[str, Any] = json.loads(stored(folder, asked, case).with_name("case.json").read_text())
    return content


def group_sizes(path: Path) -> list[int]:
    metadata = pq.read_metadata(path)
    return [metadata.row_group(number).num_rows for number in range(metadata.num_row_groups)]


def holds_rows(path: Path, record: Record, count: int) -> bool:
    """Whether a file has the first rows of a record, all columns, bit for bit."""
    found = read_signals(path)
    same_crank = found.crank is None if record.crank is None else np.array_equal(found.crank, record.crank[:count])
    same = np.array_equal(found.time, record.time[:count]) and np.array_equal(found.values, record.values[:count])
    return bool(same and same_crank and found.names == record.names)


THIRD = "record={signals: [plant, gauge], every: 3}"


@pytest.mark.parametrize(
    ("clock", "overrides"),
    [
        (TIME, []),
        (TIME, [THIRD]),
        (CRANK.replace("STOP", "7 rev"), []),
        (CRANK.replace("STOP", "7 rev"), [THIRD]),
        (CRANK.replace("STOP", "0.4 s"), []),
    ],
    ids=["time", "time, decimated", "crank", "crank, decimated", "crank up to a time"],
)
def test_a_streamed_record_is_the_record_in_full_row_groups_and_a_last_one(
    tmp_path: Path, clock: str, overrides: list[str]
) -> None:
    asked = campaign(tmp_path, "[none, 0]", *overrides, clock=clock)
    result = execute_all(asked, tmp_path / "run")
    record = whole(asked)
    assert list(result.outcomes.values()) == [record.outcome] == ["ok"]
    path, rows = stored(tmp_path / "run", asked), len(record.time)
    assert rows > 3 * SMALL.rows
    assert holds_rows(path, record, rows)
    assert group_sizes(path) == [SMALL.rows] * (rows // SMALL.rows) + [rows % SMALL.rows] * (rows % SMALL.rows > 0)
    write_signals(record, tmp_path / "at_once.parquet", SMALL)
    assert path.read_bytes() == (tmp_path / "at_once.parquet").read_bytes()


@pytest.mark.parametrize("steps", [14, 15, 16, 30, 31, 32, 47])
def test_a_record_that_ends_where_a_room_does_has_no_row_more_or_less(tmp_path: Path, steps: int) -> None:
    asked = campaign(tmp_path, clock=TIME.replace("0.2 s", f"{steps} ms"))
    execute_all(asked, tmp_path / "run")
    path = stored(tmp_path / "run", asked)
    assert holds_rows(path, whole(asked), steps + 1)
    assert sum(group_sizes(path)) == steps + 1 and min(group_sizes(path)) > 0


def test_metrics_of_a_streamed_record_are_those_of_the_record(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = campaign(tmp_path)
    execute_all(asked, tmp_path / "streamed")
    monkeypatch.setattr(cases, "GROUP", GROUP)
    execute_all(asked, tmp_path / "at_once")
    assert group_sizes(stored(tmp_path / "at_once", asked)) == [201]
    assert (tmp_path / "streamed" / "metrics.csv").read_bytes() == (tmp_path / "at_once" / "metrics.csv").read_bytes()


def test_serial_parallel_and_resumed_streams_give_the_same_bytes(tmp_path: Path) -> None:
    asked = campaign(tmp_path, "[none, 1], [none, 2], [none, 3]")
    for name, jobs in (("serial", 1), ("parallel", 2), ("resumed", 2)):
        execute_all(asked, tmp_path / name, jobs)
    again = stored(tmp_path / "resumed", asked, 1)
    again.with_name("case.json").unlink()
    again.write_bytes(again.read_bytes()[:5000])
    again.with_name(".signals.parquet.left").write_bytes(b"of a campaign that was killed")
    execute_all(asked, tmp_path / "resumed", 2)
    for case in range(3):
        found = {stored(tmp_path / name, asked, case).read_bytes() for name in ("serial", "parallel", "resumed")}
        assert len(found) == 1
    assert list((tmp_path / "resumed").rglob(".*")) == []


@pytest.mark.parametrize("at", [1, 15, 16, 17, 32, 33, 40, 48, 49, 200])
@pytest.mark.parametrize(
    ("fate", "outcome", "said"),
    [
        ("kill", "crash", "the signal SIGKILL, in step"),
        ("exit", "crash", "exit code 7, in step"),
        ("raise", "error", "no torque"),
    ],
)
def test_every_row_up_to_a_fault_is_kept(tmp_path: Path, fate: str, outcome: str, said: str, at: int) -> None:
    asked = campaign(tmp_path, f"[none, 0], [{fate}, {at}]")
    execute_all(asked, tmp_path / "run")
    path = stored(tmp_path / "run", asked, 1)
    found = told(tmp_path / "run", asked, 1)
    assert (found["outcome"], found["part"]) == (outcome, "plant")
    assert said in found["message"]
    assert found["failed_at"] == pytest.approx(at * 1e-3, rel=1e-12)
    assert holds_rows(path, whole(asked), at)
    assert all(size == SMALL.rows for size in group_sizes(path)[:-1])
    assert list((tmp_path / "run").rglob(".*")) == []


@pytest.mark.parametrize(("at", "kept"), [(5, 0), (40, 32)])
def test_rows_that_a_lost_worker_cannot_have_written_are_not_believed(tmp_path: Path, at: int, kept: int) -> None:
    asked = campaign(tmp_path, f"[none, 0], [lie, {at}]")
    execute_all(asked, tmp_path / "run")
    assert told(tmp_path / "run", asked, 1)["outcome"] == "crash"
    assert holds_rows(stored(tmp_path / "run", asked, 1), whole(asked), kept)


@pytest.mark.parametrize("clock", [TIME, CRANK.replace("STOP", "0.4 s")])
def test_every_row_before_a_hang_is_kept(tmp_path: Path, clock: str) -> None:
    asked = campaign(tmp_path, "[none, 0], [hang, 40]", clock=clock)
    execute_all(asked, tmp_path / "run", 2)
    found = told(tmp_path / "run", asked, 1)
    assert (found["outcome"], found["part"]) == ("timeout", "plant")
    assert "within its limit of 2 s" in found["message"]
    assert holds_rows(stored(tmp_path / "run", asked, 1), whole(asked), 40)


def test_a_crash_after_the_last_row_keeps_all_of_them(tmp_path: Path) -> None:
    asked = campaign(tmp_path, "[none, 0], [crash at the end, 0]")
    execute_all(asked, tmp_path / "run")
    found = told(tmp_path / "run", asked, 1)
    assert found["outcome"] == "crash" and "all its rows are kept" in found["message"]
    assert stored(tmp_path / "run", asked, 1).read_bytes() == stored(tmp_path / "run", asked, 0).read_bytes()


def test_a_decimated_record_on_a_crank_clock_keeps_the_rows_before_a_crash(tmp_path: Path) -> None:
    asked = campaign(tmp_path, "[none, 0], [kill, 200]", THIRD, clock=CRANK.replace("STOP", "7 rev"))
    execute_all(asked, tmp_path / "run")
    assert holds_rows(stored(tmp_path / "run", asked, 1), whole(asked), 199 // 3 + 1)
    assert told(tmp_path / "run", asked, 1)["failed_at"] == whole(asked).time[199 // 3]


def slowly(seconds: float) -> Callable[..., None]:
    """`SignalsFile.add`, on a slow disk."""
    add = SignalsFile.add

    def slow(self: SignalsFile, *rows: Any) -> None:
        time.sleep(seconds)
        add(self, *rows)

    return slow


def test_a_run_waits_for_a_slow_disk_and_loses_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    written, ahead = 0, 0
    slow = slowly(0.4)

    def count(self: SignalsFile, rows: Any, crank: Any = None) -> None:
        nonlocal written
        slow(self, rows, crank)
        written += len(rows)

    def look(underway: Underway) -> None:
        nonlocal ahead
        ahead = max(ahead, underway.instant - written)

    monkeypatch.setattr(SignalsFile, "add", count)
    # Each wait is longer than a step may take.
    asked = campaign(tmp_path, "[none, 0]", "limits.step=0.3 s")
    result = execute_all(asked, tmp_path / "run", underway=look)
    assert list(result.outcomes.values()) == ["ok"]
    assert holds_rows(stored(tmp_path / "run", asked), whole(asked), 201)
    assert SMALL.rows < ahead <= 2 * SMALL.rows + 1


@pytest.mark.parametrize("group", [0, 2, 12])
def test_a_disk_that_is_full_is_an_outcome_and_leaves_no_half_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, group: int
) -> None:
    add, calls = SignalsFile.add, []

    def full(self: SignalsFile, *rows: Any) -> None:
        calls.append(rows)
        if len(calls) == group + 1:
            raise OSError(errno.ENOSPC, "No space left on device")
        add(self, *rows)

    monkeypatch.setattr(SignalsFile, "add", full)
    asked = campaign(tmp_path, "[none, 1], [none, 2]")
    result = execute_all(asked, tmp_path / "run")
    assert list(result.outcomes.values()) == ["error", "ok"]
    found, path = told(tmp_path / "run", asked), stored(tmp_path / "run", asked)
    assert found["message"] == f"OSError: [Errno {errno.ENOSPC}] No space left on device: '{path}'"
    assert [file.name for file in path.parent.iterdir()] == ["case.json"]
    assert holds_rows(stored(tmp_path / "run", asked, 1), whole(asked), 201)


def test_rows_that_a_full_disk_cannot_take_from_a_lost_worker_are_missed_in_its_message(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(self: SignalsFile, *rows: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(SignalsFile, "add", full)
    asked = campaign(tmp_path, "[kill, 10]")
    execute_all(asked, tmp_path / "run")
    found = told(tmp_path / "run", asked)
    assert (found["outcome"], found["part"]) == ("crash", "plant")
    assert "its rows could not be kept: [Errno 28] No space left on device" in found["message"]
    assert [file.name for file in stored(tmp_path / "run", asked).parent.iterdir()] == ["case.json"]


# Rows of a million steps, noise that hardly packs: 32 MB.
LONG = """\
campaign: long
clock: {time: {step: 1 ms, stop: STOP}}
parts:
  torque: {use: source, unit: N.m, sine: {amplitude: 100 N.m, frequency: 0.2 Hz, mean: 0 N.m}}
  plant: {use: fmus.plants.driveline, wires: {T_eng: torque}}
  encoder: {use: sensor, of: plant.y, noise: {std: 0.5 rpm}}
  crankshaft: {use: sensor, of: plant.omega_c, noise: {std: 0.5 rpm}}
  pulley: {use: sensor, of: plant.omega_p, noise: {std: 0.5 rpm}}
  engine: {use: sensor, of: torque, noise: {std: 1 N.m}}
metrics:
  encoder_error: {rmse: [plant.y, encoder.value], unit: rpm}
  crankshaft_error: {rmse: [plant.omega_c, crankshaft.value], after: 1 s, unit: rpm}
  pulley_error: {max_error: [plant.omega_p, pulley.value], after: 1 s, until: 900 s}
report:
  figures: [{title: Speeds, traces: [[plant.y, encoder.value], [plant.omega_p, pulley.value]]}]
"""


def long_run(folder: Path, seconds: int) -> list[str]:
    file = folder / "long.yaml"
    file.write_text(LONG.replace("STOP", f"{seconds} s"))
    return [sys.executable, "-m", "harness", "run", str(file), "--out", str(folder / "run"), "--jobs", "1"]


@pytest.mark.skipif(sys.platform != "linux", reason="memory that processes share counts as a file elsewhere")
def test_a_file_that_cannot_grow_ends_its_case_with_the_reason(tmp_path: Path) -> None:
    def limited() -> None:
        # The two rooms of shared memory, 16 MiB, count as a file too.
        resource.setrlimit(resource.RLIMIT_FSIZE, (20 * 2**20, 20 * 2**20))

    ended = subprocess.run(
        long_run(tmp_path, 1000), preexec_fn=limited, capture_output=True, text=True, timeout=120, check=False
    )
    assert ended.returncode == 1, ended.stderr
    assert "[1/1] as declared  error: OSError: [Errno 27] File too large" in ended.stdout
    (folder,) = (tmp_path / "run" / "cases").iterdir()
    assert [file.name for file in folder.iterdir()] == ["case.json"]


def test_an_interrupt_during_a_stream_leaves_no_half_file(tmp_path: Path) -> None:
    with subprocess.Popen(long_run(tmp_path, 20_000), stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        until = time.monotonic() + 60
        while not list(tmp_path.glob("run/cases/*/.signals.parquet.*")) and time.monotonic() < until:
            time.sleep(0.01)
        assert list(tmp_path.glob("run/cases/*/.signals.parquet.*"))
        process.send_signal(signal.SIGINT)
        process.wait(30)
    assert process.returncode == 130
    assert list(tmp_path.glob("run/cases/*/*")) == []
    assert (tmp_path / "run" / "campaign.json").is_file()


def peaks(command: list[str]) -> tuple[float, float]:
    """The most memory that was resident [MB], shared memory included, in a command and in any process it started."""
    peak: dict[int, float] = {}
    with subprocess.Popen(command, stdout=subprocess.DEVNULL) as process:
        while process.poll() is None:
            for pid in (process.pid, *descendants(process.pid)):
                try:
                    status = Path(f"/proc/{pid}/status").read_text()
                except OSError:
                    continue
                for line in status.splitlines():
                    if line.startswith("VmHWM"):
                        peak[pid] = max(peak.get(pid, 0.0), int(line.split()[1]) * 1024 / 1e6)
            time.sleep(0.02)
    assert process.returncode == 0
    parent = peak.pop(process.pid)
    return parent, max(peak.values())


def descendants(pid: int) -> list[int]:
    try:
        tasks = Path(f"/proc/{pid}/task").glob("*/children")
        children = [int(child) for file in tasks for child in file.read_text().split()]
    except OSError:
        return []
    return children + [further for child in children for further in descendants(child)]


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
@pytest.mark.parametrize(
    ("steps", "most_in_parent", "most_in_worker"),
    [
        # A metric holds four columns of 8 MB each; Python and its packages take 140 MB, with those for figures 270. The
        # whole record would be 88 MB more.
        (1_000_000, 350.0, 230.0),
        pytest.param(10_000_000, 500.0, 500.0, marks=pytest.mark.slow),
    ],
)
def test_memory_stays_small_in_worker_and_parent_report_included(
    tmp_path: Path, steps: int, most_in_parent: float, most_in_worker: float
) -> None:
    parent, worker = peaks(long_run(tmp_path, steps // 1000))
    (path,) = tmp_path.glob("run/cases/*/signals.parquet")
    assert pq.read_metadata(path).num_rows == steps + 1
    assert (tmp_path / "run" / "report.html").is_file()
    assert parent < most_in_parent and worker < most_in_worker, (parent, worker)


# Worker and parent


def ask_for(value: int) -> int:
    from harness import workplace

    for number in range(value):
        workplace.ask(number)
    return sum(workplace.answer() for _ in range(value))


def ask_and_fail() -> None:
    from harness import workplace

    workplace.ask(1)
    raise ValueError("did not wait for the answer")


class Doubling:
    """Answers with twice the number, and refuses 3."""

    def answer(self, told: Any, asked: int) -> int:
        if asked == 3:
            raise OSError(errno.ENOSPC, "no room for 3")
        return 2 * asked

    def look(self, told: Any, place: Any) -> None:
        pass


def test_a_worker_gets_answers_in_order_refusals_as_errors_and_no_answer_to_another_call() -> None:
    worker = Worker()
    try:
        assert worker.call(ask_for, 3, limits=Limits(), caller=Doubling()).value == 0 + 2 + 4
        refused = worker.call(ask_for, 4, limits=Limits(), caller=Doubling())
        assert (refused.kind, type(refused.error)) == ("error", OSError) and "no room for 3" in str(refused.error)
        assert worker.call(ask_and_fail, limits=Limits(), caller=Doubling()).kind == "error"
        last = worker.call(ask_for, 2, limits=Limits(), caller=Doubling())
        assert (last.value, last.first) == (2, False)
    finally:
        worker.close()


def test_row_groups_have_about_8_mib_whatever_the_run_and_never_few_rows() -> None:
    assert GROUP.of(12) * 12 * 8 == pytest.approx(8 * 2**20, rel=1e-4)
    assert GROUP.of(2) == 2**19
    assert GROUP.of(5000) == 16_384


def test_a_stored_record_gives_the_columns_of_the_record_it_was(tmp_path: Path) -> None:
    record = whole(campaign(tmp_path, clock=CRANK.replace("STOP", "7 rev")))
    write_signals(record, tmp_path / "signals.parquet", SMALL)
    found = StoredRecord(tmp_path / "signals.parquet")
    assert np.array_equal(found.time, record.time)
    assert found.crank is not None and np.array_equal(found.crank, record.crank)  # type: ignore[arg-type]
    for signal_ in record.signals:
        assert np.array_equal(found[signal_.name], record[signal_.name])
    with pytest.raises(KeyError, match=r"did you mean 'plant\.theta'"):
        found["plant.thetta"]
