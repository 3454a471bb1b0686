"""Windows in time and in crank angle: which rows, without copies, and with no column read that is not asked for."""

import tracemalloc
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from records import TIME, measured, on_crank, record

from fmus.component import Signal
from harness.definitions import Definition, measure
from harness.quantity import read_measure
from harness.record import Record, write_signals
from harness.signalsfile import GROUP
from harness.stored import StoredRecord
from harness.window import window


def rows(recorded, after=None, until=None, angle=None):
    """The numbers of the rows in a window."""
    edges = [read_measure(edge) if edge is not None else None for edge in (after, until)]
    return list(range(len(recorded.time)))[window(recorded, *edges, angle).rows]


ROWS_A_GROUP = GROUP.of(4)


def turning(crank):
    return on_crank({"plant.n": (np.arange(len(crank)), "1")}, crank)


@pytest.mark.parametrize(
    ("after", "until", "first", "last"),
    [
        (None, None, 0, 1000),
        ("0.3 s", "0.7 s", 300, 700),
        ("300 ms", "10 s", 300, 1000),
        ("-1 s", "0 s", 0, 0),
        ("300.5 ms", "699.5 ms", 301, 699),
    ],
)
def test_the_rows_of_a_window_in_time_include_its_ends(after, until, first, last):
    assert rows(record({"plant.n": (TIME, "1")}), after, until) == list(range(first, last + 1))


def test_a_window_outside_the_record_has_no_rows():
    assert rows(record({"plant.n": (TIME, "1")}), "2 s") == rows(record({"plant.n": (TIME, "1")}), None, "-1 s") == []


def test_a_window_may_start_at_a_crank_angle_and_end_at_a_time():
    recorded = turning(30.0 + 6.0 * np.arange(500))  # 1 ms a row
    assert rows(recorded, "1440 deg", "300 ms") == list(range(235, 301))
    assert rows(recorded, "4 rev", "1470 deg") == list(range(235, 241))
    assert rows(recorded, "1441 deg", "1469 deg") == list(range(236, 240))


def test_ends_belong_to_a_window_where_steps_of_a_tenth_of_a_degree_miss_them_by_rounding():
    crank = 0.1 * np.arange(200_000)
    assert rows(turning(crank), "7200.3 deg", "7200.7 deg") == list(range(72_003, 72_008))


@pytest.mark.parametrize("wrapped", [360.0, 720.0])
def test_a_wrapped_angle_counts_on_through_its_cycles(wrapped):
    crank = 100.0 + 9.0 * np.arange(1001)
    columns = {"plant.n": (TIME, "1"), "crank.angle": (np.radians(np.mod(crank, wrapped)), "rad")}
    assert rows(record(columns), "1440 deg", "2880 deg", "crank.angle") == list(range(149, 309))


def test_a_crank_angle_is_reached_once_where_the_crankshaft_turns_back():
    crank = np.concatenate([np.arange(0, 100.0), np.arange(100, 50, -1.0), np.arange(50, 200.0)])
    columns = {"plant.n": (np.arange(300), "1"), "crank.angle": (np.radians(crank), "rad")}
    recorded = record(columns, np.arange(300.0))
    assert rows(recorded, "90 deg", None, "crank.angle") == list(range(90, 300))
    # 120 deg is passed for good at row 220; turning back from 100 deg does not leave the window.
    assert rows(recorded, None, "120 deg", "crank.angle") == list(range(221))


def test_a_window_is_a_view_of_the_columns():
    recorded = record({"plant.n": (TIME, "1"), "plant.m": (TIME, "1")})
    looked_at = window(recorded, read_measure("0.3 s"), read_measure("0.7 s"), None)
    assert np.shares_memory(looked_at.time, recorded.time)
    assert np.shares_memory(looked_at.column("plant.m"), recorded.values)


class Told:
    """A record that says which columns were read."""

    def __init__(self, whole: Record) -> None:
        self.whole, self.read = whole, []
        self.signals = whole.signals

    @property
    def time(self):
        self.read.append("time")
        return self.whole.time

    @property
    def crank(self):
        self.read.append("crank")
        return self.whole.crank

    def __getitem__(self, name):
        self.read.append(name)
        return self.whole[name].copy()

    def pieces(self, names):
        self.read += names
        return self.whole.pieces(names)


@pytest.mark.parametrize(
    ("definition", "wanted"),
    [
        ({"rmse": ["plant.x", "observer.x"]}, {"plant.x", "observer.x"}),
        ({"rmse": ["plant.x", "observer.x"], "after": "0.1 s"}, {"time", "plant.x", "observer.x"}),
        ({"mean": "plant.x", "until": "720 deg"}, {"crank", "plant.x"}),
        ({"harmonic": {"signal": "plant.x", "per_cycle": 2}}, {"crank", "plant.x"}),
        ({"detection": ["plant.x", "observer.x"]}, {"time", "plant.x", "observer.x"}),
    ],
)
def test_only_the_columns_that_a_metric_needs_are_read(definition, wanted):
    columns = {name: (np.arange(1001.0), "1") for name in ("plant.x", "observer.x", "plant.other")}
    told = Told(record(columns, crank=6.0 * np.arange(1001)))
    measured(definition, told)
    assert set(told.read) == wanted


def stored(path: Path, count: int) -> StoredRecord:
    """A file with plant.x = 0, observer.x = 2 and another column, of `count` rows in row groups."""
    schema = pa.schema([pa.field(name, pa.float64()) for name in ("time", "plant.x", "observer.x", "plant.other")])
    with pq.ParquetWriter(path, schema) as file:
        for first in range(0, count, ROWS_A_GROUP):
            time = 1e-3 * np.arange(first, min(first + ROWS_A_GROUP, count))
            columns = [time, np.zeros(len(time)), np.full(len(time), 2.0), time]
            file.write_table(pa.Table.from_arrays([pa.array(column) for column in columns], schema=schema))
    return StoredRecord(path)


@pytest.mark.parametrize(("window", "arrays"), [({}, 3), ({"after": "10 s"}, 3)])
def test_an_rmse_of_a_stored_record_holds_no_more_than_three_columns_at_a_time(tmp_path, window, arrays):
    count = 10 * ROWS_A_GROUP
    recorded = stored(tmp_path / "signals.parquet", count)
    definition = {"m": Definition.model_validate({"rmse": ["plant.x", "observer.x"], **window})}
    measure(definition, recorded, "")
    tracemalloc.start()
    values = measure(definition, recorded, "").values
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert values["m"].value == 2.0
    # Truth, estimate and their difference; a column is unpacked outside of Python's memory, a row group at a time.
    assert peak < (arrays + 0.1) * 8 * count


def test_a_stored_record_gives_what_was_written_column_by_column(tmp_path):
    signals = (Signal("plant.x", "rpm", description="speed"), Signal("plant.x.y", "degC", kind="integer"))
    values = np.random.default_rng(1).normal(size=(1001, 2))
    write_signals(Record(signals, TIME, values), tmp_path / "signals.parquet")
    recorded = StoredRecord(tmp_path / "signals.parquet")
    assert recorded.signals == signals
    assert recorded.crank is None
    assert np.array_equal(recorded.time, TIME)
    assert np.array_equal(np.column_stack([recorded["plant.x"], recorded["plant.x.y"]]), values)
    with pytest.raises(KeyError, match=r"did you mean 'plant\.x'"):
        recorded["plant.z"]


def test_a_record_in_memory_and_the_same_on_disk_are_measured_alike(tmp_path):
    columns = {name: (np.random.default_rng(n).normal(size=1001), "rpm") for n, name in enumerate(("a.x", "b.x"))}
    whole = record(columns)
    write_signals(whole, tmp_path / "signals.parquet")
    for definition in ({"rmse": ["a.x", "b.x"], "after": "0.25 s"}, {"bias": ["a.x", "b.x"]}, {"maximum": "b.x"}):
        assert measured(definition, whole) == measured(definition, StoredRecord(tmp_path / "signals.parquet"))
