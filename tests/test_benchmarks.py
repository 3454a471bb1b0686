"""Do the benchmarks compare like with like, and tell what they found as promised?"""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from benchmarks import comparison, growth, periodic, real_time
from benchmarks.__main__ import PAGE, SEARCHES, write_results
from benchmarks.comparison import BARE, FMPY_CALLS, PEERS, SIMULATE_FMU, Comparison, beside_all, check_peer
from benchmarks.growth import Growth, line
from benchmarks.long_run import LongRun, long_run, measures_memory
from benchmarks.measure import Measure, in_turn
from benchmarks.optimal import best_of_each, draw_growth, growing, network, scipy_cost
from benchmarks.orders import jacobi
from benchmarks.page import replace_section, write_page
from benchmarks.peer_process import PeerProcess, Unavailable, task_of
from benchmarks.periodic import Costs
from benchmarks.real_time import RealTime, beside_the_engine
from benchmarks.serving import Recorded, Stopwatch
from benchmarks.setups import Setup, feedthroughs, oscillator, plant_and_observer

STEPS = 400
SETUPS = [lambda: plant_and_observer(8, STEPS), lambda: oscillator(STEPS), lambda: feedthroughs(STEPS)]


@pytest.mark.parametrize("setup", SETUPS)
def test_every_engine_steps_the_same_system(setup: Callable[[], Setup]):
    # beside_all raises where the rows of any engine are not what they ought to be.
    taken = beside_all(setup(), 1.0, 1)
    measured = {measure.peer_name for measure in taken.measures}
    whole = {SIMULATE_FMU} if taken.measures[0].name == "Van der Pol" else set()
    assert measured | set(taken.absent) == {BARE, FMPY_CALLS, *PEERS} | whole
    assert measured >= {BARE, FMPY_CALLS} | whole
    assert all(measure.ours > 0.0 and measure.peer > 0.0 for measure in taken.measures)
    assert len({measure.ours for measure in taken.measures}) == 1


def test_a_bare_loop_that_strays_by_one_bit_is_refused(monkeypatch: pytest.MonkeyPatch):
    timed = comparison.BareLoop.__call__

    def astray(self: comparison.BareLoop) -> float:
        seconds = timed(self)
        self.rows[-1, 1] = np.nextafter(self.rows[-1, 1], np.inf)
        return seconds

    monkeypatch.setattr(comparison.BareLoop, "__call__", astray)
    with pytest.raises(RuntimeError, match="the rows of bare C loop are not ours"):
        comparison.beside_bare_c(oscillator(STEPS), 1.0, 1)


def test_rows_of_a_peer_that_are_away_from_both_orders_are_refused():
    wanted = jacobi(feedthroughs(STEPS))
    places = list(range(wanted.passed.shape[1]))
    check_peer("ecos, CSV", Recorded(places, wanted.passed), wanted)
    check_peer("libcosim", Recorded(places[:3], wanted.stepped[-1:, :3]), wanted)
    with pytest.raises(RuntimeError, match="the rows of libcosim are"):
        check_peer("libcosim", Recorded(places, wanted.passed + 1e-6), wanted)


def test_what_is_wired_arrives_a_step_later_where_values_are_passed_on_after_the_steps():
    setup = feedthroughs(10)
    rows = jacobi(setup)
    first, second = [0, 1, 2], [4, 5, 6]
    assert rows.stepped[:, first[0]].tolist() == [1.0] * 5 + [2.0] * 5
    assert np.array_equal(rows.stepped[1:, second], rows.stepped[:-1, first])
    assert np.array_equal(rows.passed[:, second], rows.passed[:, first])


@pytest.mark.parametrize("module", ["benchmarks.ecos", "benchmarks.libcosim"])
def test_a_peer_in_its_own_process_records_every_step(module: str):
    try:
        peer = PeerProcess(module, oscillator(STEPS), "everything")
    except Unavailable as reason:
        pytest.skip(str(reason))
    with peer:
        assert peer() > 0.0
        recorded = peer.recorded()
    assert recorded.places == [0, 1] and recorded.rows.shape == (STEPS, 2)


def test_a_peer_that_cannot_be_loaded_says_why(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "lacking.py").write_text(
        "from benchmarks.serving import serve\n"
        "def load(recording):\n    raise OSError('libtbb.so.12: cannot open shared object file')\n"
        "serve(load)\n"
    )
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}:{Path(__file__).parents[1]}")
    with pytest.raises(Unavailable, match=r"libtbb\.so\.12: cannot open shared object file"):
        PeerProcess("lacking", oscillator(STEPS), "nothing")
    monkeypatch.setattr(comparison, "PEERS", {"lacking": ("lacking", "nothing", False)})
    assert beside_all(oscillator(STEPS), 1.0, 1).absent == {"lacking": "libtbb.so.12: cannot open shared object file"}


def test_a_peer_that_dies_is_an_error_with_its_last_words(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "dying.py").write_text(
        "import sys\nfrom benchmarks.serving import serve\n"
        "def load(recording):\n    return lambda task: sys.exit('of a mismatch')\n"
        "serve(load)\n"
    )
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}:{Path(__file__).parents[1]}")
    last_words = pytest.raises(RuntimeError, match="dying ended with 1:\nof a mismatch")
    with PeerProcess("dying", oscillator(STEPS), "nothing") as peer, last_words:
        peer()


def test_the_time_a_peer_waits_for_the_machine_does_not_count():
    watch = Stopwatch()
    time.sleep(0.2)
    assert 0.0 <= watch.seconds() < 0.1


def test_the_fastest_of_interleaved_rounds_counts():
    turns: list[str] = []
    times = iter([3.0, 30.0, 1.0, 20.0, 2.0, 10.0])

    def taking_turns(name: str) -> Callable[[], float]:
        return lambda: turns.append(name) or next(times)  # type: ignore[func-returns-value]

    assert in_turn((taking_turns("ours"), taking_turns("peer")), 3) == [1.0, 10.0]
    assert turns == ["ours", "peer"] * 3


def test_the_line_through_points_is_that_of_least_squares():
    exact = line((1, 2, 4), (5.0, 7.0, 11.0))
    assert exact == pytest.approx((2.0, 3.0, 1.0))
    # By hand: means 1 and 4/3, slope (1/3 + 2/3) / 2; squares about the mean 2/3, of which 2 slope^2 is explained.
    bent = line((0, 1, 2), (1.0, 1.0, 2.0))
    assert bent == pytest.approx((0.5, 5.0 / 6.0, 0.75))


@pytest.mark.parametrize("grow", [growth.with_parts, growth.with_signals])
def test_growth_is_measured_on_equal_rows(grow: Callable[..., Growth]):
    found = grow((1, 3), steps=50, rounds=1)
    assert found.counts == (1, 3) and min(*found.ours, *found.bare) > 0.0


def test_growth_with_steps_is_that_of_whole_runs():
    found = growth.with_steps((200, 20_000), rounds=1)
    assert 10.0 < found.bare[1] / found.bare[0] < 1000.0  # 100 but for what else the machine does


@pytest.mark.skipif(not measures_memory(), reason="this system does not tell the peak of a process at its end")
def test_the_long_run_counts_every_row_and_sees_the_memory_of_the_worker():
    found = long_run(2_000)
    assert found.steps == 2_000 and found.columns == 12
    # A worker with NumPy, SciPy and pyarrow holds tens of megabytes; the one that looks on holds fewer than twenty.
    assert 30e6 < found.largest < 1e9
    assert found.record > 2_000 * found.columns


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux tells of processes that nobody waited for")
def test_the_peak_counts_a_process_that_nobody_waited_for():
    holding = "import time; held = bytearray(200_000_000); print(flush=True); time.sleep(1.0)"
    starting = (
        "import subprocess, sys, time\n"
        f"held = subprocess.Popen([sys.executable, '-c', {holding!r}], stdout=subprocess.PIPE)\n"
        "held.stdout.readline()\n"
        "time.sleep(0.5)\n"
    )
    command = [sys.executable, "-m", "benchmarks.peak", sys.executable, "-c", starting]
    seen = json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
    assert seen["code"] == 0 and seen["seconds"] > 0.5
    assert 200e6 < seen["largest"] < 300e6 and 200e6 < seen["together"] < 300e6


def test_a_measure_that_nobody_knows_is_refused_with_those_there_are():
    command = [sys.executable, "-m", "benchmarks", "--only", "van-der-poll"]
    ended = subprocess.run(command, capture_output=True, text=True, check=False, env={**os.environ, "COLUMNS": "300"})
    assert ended.returncode == 2
    assert "no measure is named 'van-der-poll'; there are export, set-up, light, plant-and-observer" in ended.stderr


MEASURES = [Measure("loop", 1e-6, 2e-6, "peer", 1.0), Measure("memory", 3.0, 4.0, "limit", None, "B")]


def test_results_are_a_list_of_entries_as_promised(tmp_path: Path):
    path = tmp_path / "results.json"
    write_results(MEASURES, path)
    assert json.loads(path.read_text()) == [
        {"name": "loop", "ours": 1e-6, "peer": 2e-6, "peer_name": "peer", "ratio": 0.5, "unit": "s"},
        {"name": "memory", "ours": 3.0, "peer": 4.0, "peer_name": "limit", "ratio": 0.75, "unit": "B"},
    ]
    assert list(tmp_path.iterdir()) == [path]


def test_the_page_is_written_between_its_marks_and_again_the_same(tmp_path: Path):
    page = tmp_path / "speed.md"
    page.write_text(PAGE.read_text(encoding="utf-8"), encoding="utf-8")
    names = ("plant and observer", "Van der Pol")
    compared = [
        Comparison(
            [Measure(name, 2e-6, 1e-6, BARE, 1.0), Measure(name, 2e-6, 36.4e-6, FMPY_CALLS)], {"ecos, CSV": "no"}
        )
        for name in names
    ]
    grown = [
        Growth("parts", (1, 64), (1e-7, 6.4e-6), (1e-7, 6.4e-6)),
        Growth("signals", (1, 1000), (1e-7, 1e-6), (1e-7, 1e-6)),
        Growth("steps", (10, 1000), (1e-4, 1e-2), (1e-4, 1e-2)),
    ]
    long = LongRun(10_000_000, 12.4, 123_000_000, 0, 400_000_000, 12)
    write_page(page, compared, grown, long)
    text = page.read_text(encoding="utf-8")
    assert "| bare C loop | 1.00 (1.00) | 1.00 (1.00) |" in text
    assert "| crankbench, everything recorded | 2.00 (2.00) | 2.00 (2.00) |" in text
    assert "| FMPy's calls | 36.4 (36) | 36.4 (36) |" in text
    assert "ecos, CSV: not measured here, no" in text
    assert "| parts | 1, 64 | 100 ns | 100 ns | 1.00 | 1.00000 |" in text
    assert "10,000,000 steps, 12 columns recorded in each: 12 s from the command to its end, 123 MB" in text
    drawings = {path.name: path.read_bytes() for path in (tmp_path / "speed").iterdir()}
    assert drawings.keys() == {"parts.svg", "signals.svg", "steps.svg"}
    assert all(len(drawn) < 60_000 for drawn in drawings.values())
    write_page(page, compared, grown, long)
    assert page.read_text(encoding="utf-8") == text
    assert {path.name: path.read_bytes() for path in (tmp_path / "speed").iterdir()} == drawings


COSTS = Costs(
    [Measure("periodic-input observer, h = 1", 1e-7, 1e-5, "Eq. 4 in NumPy")] * 5,
    [Measure("periodic-input observer, n = 2", 2e-7, 1e-5, "Eq. 4 in NumPy")] * 5,
    [Measure("periodic-input observers, 4 lags in a row", 5e-7, 5e-5, "Eq. 4 in NumPy")] * 5,
    ((10, 30, 70, 150, 310), (10, 20, 30, 40, 60), (5, 10, 20, 40, 80)),
)


def test_what_periodic_observers_cost_is_written_where_it_was_measured(tmp_path: Path):
    page = tmp_path / "speed.md"
    page.write_text(PAGE.read_text(encoding="utf-8"), encoding="utf-8")
    write_page(page, [], [], None, COSTS)
    text = page.read_text(encoding="utf-8")
    assert "| h = 1 | 0.100 us | 10.0 us | 100 | 10 |" in text
    assert "| 4 lags in a row | 0.500 us | 50.0 us | 100 | 20 |" in text
    assert "Operations grow by 10 a harmonic (R² 1.00000) from 1 to 31, 10 a state" in text


def test_an_observer_in_numpy_tells_what_its_fmu_tells(monkeypatch: pytest.MonkeyPatch):
    for name in ("HARMONICS", "STATES", "STAGES"):
        monkeypatch.setattr(periodic, name, (1, 2))
    found = periodic.beside_numpy(rounds=1)
    assert len(found.measures) == 6 and all(one.ours > 0.0 for one in found.measures)
    assert all(two > one for one, two in found.operations)
    with pytest.raises(RuntimeError, match=r"h = 1: the w of Eq\. 4 in NumPy is .* of its size away from ours"):
        periodic._check("h = 1", np.array([1.0, 2.0]), [1.0, 2.001])


def test_a_case_that_keeps_the_engines_time_is_measured_over_the_speed():
    found = beside_the_engine((1500, 6000), cycles=40, rounds=1)
    assert found.speeds == (1500, 6000) and all(one.ours > 0.0 for one in found.measures)
    # 6 deg are a sixtieth of a turn, of 40 ms and of 10 ms.
    assert [one.peer for one in found.measures] == pytest.approx([40e-3 / 60.0, 10e-3 / 60.0])
    assert sum(found.shares.values()) == pytest.approx(1.0) and found.shares["engine"] > 0.3


def test_a_case_out_of_time_or_with_an_observer_that_is_not_right_is_refused():
    names = ["exhaust.afr_turbine", "designed.w", "uego.value"]
    turn = np.sin(np.arange(241.0))
    # Two cycles at 6000 rpm take 40 ms; the sensor shows half of the swing.
    rows = np.column_stack([np.linspace(0.0, 40e-3, 241), turn, 0.95 * turn, 0.5 * turn])
    real_time._check(6000, rows, names)
    rows[:, 2] = 0.8 * turn
    with pytest.raises(RuntimeError, match="at 6000 rpm w wants to be five times as near to the truth as the sensor"):
        real_time._check(6000, rows, names)
    rows[:, 0] *= 1.1
    with pytest.raises(RuntimeError, match=r"240 steps at 6000 rpm want 0\.04 s of the engine, got 0\.044 s"):
        real_time._check(6000, rows, names)


def test_how_real_time_is_kept_is_written_where_it_was_measured(tmp_path: Path):
    page = tmp_path / "speed.md"
    page.write_text(PAGE.read_text(encoding="utf-8"), encoding="utf-8")
    kept = RealTime((6000,), [Measure("imbalance", 2e-5, 1e-3 / 6.0, "the engine", 1.0)], {"engine": 0.7, "rest": 0.3})
    write_page(page, [], [], None, None, kept)
    text = page.read_text(encoding="utf-8")
    assert "| 6,000 rpm | 20.0 us | 167 us | 8.3 |" in text
    assert "At 6,000 rpm the parts share their time so: engine 70 %, rest 30 %." in text


def test_a_page_without_marks_is_refused():
    with pytest.raises(ValueError, match="there is no '<!-- growth -->'"):
        replace_section("<!-- growth --> but no end", "growth", "x")


def test_the_pictures_of_the_page_exist():
    drawn = PAGE.with_suffix("")
    assert {path.name for path in drawn.iterdir()} == {"parts.svg", "signals.svg", "steps.svg"}


def test_a_task_names_every_signal_with_its_reference():
    task = task_of(feedthroughs(STEPS))
    assert task["wires"][2] == (
        ("first", "Int32_output", "integer", 20),
        ("second", "Int32_input", "integer", 19),
    )
    assert [signal.kind for signal in task["driven"]] == ["real", "real", "integer", "boolean"]


def test_the_search_and_its_growth_are_measured_and_drawn_the_same_each_time(tmp_path: Path):
    grown = growing(((6, 4), (8, 5)))
    assert all(0.0 < seconds < 60.0 for column in grown[1:] for seconds in column)
    assert [measure.name for measure in grown.measures()] == [
        "best 3 of 4 sensors, 6 states",
        "best 3 of 5 sensors, 8 states",
    ]
    unended = grown._replace(search=(math.nan, 1.0), program=(1.0, math.nan))
    assert len(unended.measures()) == 1
    for name in ("one.svg", "two.svg"):
        draw_growth(unended, tmp_path / name)
    assert (tmp_path / "one.svg").read_bytes() == (tmp_path / "two.svg").read_bytes()
    assert SEARCHES.is_file()


def test_the_peer_of_the_search_is_scipys_solver_on_the_same_system():
    system = network(6, 4)
    costs, found = best_of_each(system, 3)
    assert all(one.proven for one in found)
    assert scipy_cost(system, found[2].sensors) == pytest.approx(costs.cost(found[2].sensors), rel=1e-8)
