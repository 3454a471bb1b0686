"""A record survives its files unchanged, and its files are the same bytes every time."""

import numpy as np
import pyarrow.parquet as pq
import pytest

from fmus.component import Signal
from fmus.whole import write_whole
from harness.record import Record, read_signals, write_signals


def record() -> Record:
    """Three instants of two signals, one of them an integer."""
    signals = (Signal("plant.y", "rpm", description="wheel speed"), Signal("plant.location", "1", kind="integer"))
    return Record(signals, np.array([0.0, 0.1, 0.2]), np.array([[1.0, 1], [np.pi, 2], [-0.0, 2]]))


def test_a_record_read_back_equals_the_record_written(tmp_path):
    write_signals(record(), tmp_path / "signals.parquet")
    back = read_signals(tmp_path / "signals.parquet")
    assert back.names == ["plant.y", "plant.location"]
    assert back.time.tobytes() == record().time.tobytes()
    assert back.values.tobytes() == record().values.tobytes()
    assert [(signal.unit, signal.kind, signal.description) for signal in back.signals] == [
        ("rpm", "real", "wheel speed"),
        ("1", "integer", ""),
    ]


def test_columns_carry_the_si_unit_and_the_declared_unit(tmp_path):
    write_signals(record(), tmp_path / "signals.parquet")
    metadata = pq.read_schema(tmp_path / "signals.parquet").field("plant.y").metadata
    assert (metadata[b"unit"], metadata[b"display_unit"]) == (b"rad/s", b"rpm")


def test_the_same_record_gives_the_same_bytes(tmp_path):
    write_signals(record(), tmp_path / "a.parquet")
    write_signals(record(), tmp_path / "b.parquet")
    assert (tmp_path / "a.parquet").read_bytes() == (tmp_path / "b.parquet").read_bytes()


def test_a_record_without_rows_is_kept(tmp_path):
    empty = Record(record().signals, np.zeros(0), np.zeros((0, 2)), "crash", "plant", 0.0, "died")
    write_signals(empty, tmp_path / "signals.parquet")
    assert read_signals(tmp_path / "signals.parquet").values.shape == (0, 2)


def test_only_the_named_columns_are_read(tmp_path):
    write_signals(record(), tmp_path / "signals.parquet")
    assert read_signals(tmp_path / "signals.parquet", ["plant.location"]).names == ["plant.location"]


def test_a_failed_write_leaves_the_old_file_and_no_other(tmp_path):
    path = tmp_path / "case.json"
    write_whole(path, "old")
    with pytest.raises(UnicodeEncodeError):
        write_whole(path, "\ud800")
    assert [file.name for file in tmp_path.iterdir()] == ["case.json"]
    assert path.read_text() == "old"


def test_an_unknown_signal_names_the_nearest():
    with pytest.raises(KeyError, match=r"did you mean 'plant\.y'"):
        record()["plant.x"]


def test_an_unknown_outcome_is_refused():
    with pytest.raises(ValueError, match="outcome wants one of ok"):
        Record((), np.zeros(0), np.zeros((0, 0)), "fine")
