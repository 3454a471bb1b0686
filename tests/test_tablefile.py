"""Columns come out of CSV, Parquet and MDF4 files as they went in; what is wrong with one is told with its row."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import asammdf
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fmus.component import Signal, Vector
from fmus.units import UnitError
from harness.record import Record, write_signals
from harness.recording import converted, settle_unit
from harness.tablefile import TableError, open_table

NUMBERS = st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=1, max_size=20)


def csv_file(folder: Path, text: str, encoding: str = "utf-8") -> Path:
    path = folder / "measured.csv"
    path.write_bytes(text.encode(encoding))
    return path


def parquet_file(folder: Path, columns: dict[str, object], metadata: dict[str, dict[str, str]] | None = None) -> Path:
    arrays = {name: pa.array(values) for name, values in columns.items()}
    fields = [pa.field(name, array.type, metadata=(metadata or {}).get(name)) for name, array in arrays.items()]
    pq.write_table(pa.Table.from_arrays(list(arrays.values()), schema=pa.schema(fields)), folder / "measured.parquet")
    return folder / "measured.parquet"


def mdf_file(folder: Path, *groups: Sequence[asammdf.Signal]) -> Path:
    path = folder / "measured.mf4"
    with asammdf.MDF(version="4.10") as file:
        for signals in groups:
            file.append(list(signals))
        file.save(path, overwrite=True)
    return path


def channel(name: str, values: object, times: Vector, unit: str = "", **more: object) -> asammdf.Signal:
    return asammdf.Signal(samples=np.asarray(values), timestamps=times, name=name, unit=unit, **more)


@settings(max_examples=50, deadline=None)
@given(numbers=NUMBERS)
def test_numbers_come_back_bit_for_bit_from_every_format(
    tmp_path_factory: pytest.TempPathFactory, numbers: list[float]
):
    folder = tmp_path_factory.mktemp("formats")
    times = np.arange(len(numbers)) * 0.1
    rows = "".join(f"{time!r},{value!r}\n" for time, value in zip(times.tolist(), numbers, strict=True))
    files = [
        csv_file(folder, "time,value\n" + rows),
        parquet_file(folder, {"time": times, "value": numbers}),
        mdf_file(folder, [channel("value", numbers, times)]),
    ]
    for file in files:
        table = open_table(file)
        assert table.column("value").values.tobytes() == np.array(numbers).tobytes(), file
        assert table.time(None, "value").values.tobytes() == times.tobytes(), file
        table.close()


# CSV


def test_a_heading_of_a_csv_file_may_name_the_unit(tmp_path: Path):
    heading = '"time [s]", speed [rpm] ,x[1],"torque, at the shaft [N.m]"\n'
    table = open_table(csv_file(tmp_path, f"\ufeff{heading}0,1,2,3\r\n\n1, 4 ,5,6\n\n"))
    names = ["time", "speed", "x[1]", "torque, at the shaft"]
    assert [table.column(name).unit for name in names] == ["s", "rpm", "", "N.m"]
    assert [table.column(name).values.tolist() for name in names] == [[0, 1], [1, 4], [2, 5], [3, 6]]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("time,v\ns,rpm\n0,1\n", "wants numbers, but row 1 of 'v' is 'rpm'; a unit goes into the heading"),
        ("time,v\n0,1\n\n1,0x10\n", "wants numbers, but row 2 of 'v' is '0x10'"),
        ("time,v\n0,1\n1,1_0\n", "wants numbers, but row 2 of 'v' is '1_0'"),
        ("time,v\n0,1\n1\n", "wants 2 columns in measured.csv, but row 2 has 1"),
        ("time,v\n0,1\n1,2,3\n", "wants 2 columns in measured.csv, but row 2 has 3"),
        ("time,v,v\n0,1,2\n", "wants one column 'v', but there are 2"),
        ("time,w\n0,1\n", "no column is named 'v'; did you mean 'w'?"),
        ("", "no column is named 'v'"),
    ],
)
def test_what_is_wrong_with_a_csv_file_is_told_with_the_row(tmp_path: Path, text: str, said: str):
    with pytest.raises(TableError) as error:
        open_table(csv_file(tmp_path, text), ["time", "v"]).column("v")
    assert str(error.value).startswith(said)


@pytest.mark.parametrize(
    ("text", "encoding", "said"),
    [
        ("time;v\n0;1\n", "utf-8", "wants commas between the columns of measured.csv, got 'time;v'"),
        ("time,v [°C]\n0,1\n", "latin-1", "wants comma-separated values in UTF-8, but measured.csv is not"),
    ],
)
def test_another_dialect_of_csv_is_refused_by_its_heading(tmp_path: Path, text: str, encoding: str, said: str):
    with pytest.raises(TableError, match=said):
        open_table(csv_file(tmp_path, text, encoding))


def test_a_column_of_text_in_a_csv_file_does_not_stand_in_the_way_of_others(tmp_path: Path):
    table = open_table(csv_file(tmp_path, "time,note,v\n0,start,1\n1,,\n"), ["time", "note", "v"])
    assert table.column("v").values.tolist()[0] == 1.0
    assert np.isnan(table.column("v").values[1])
    with pytest.raises(TableError, match="row 1 of 'note' is 'start'"):
        table.column("note")


# Parquet


def test_a_column_of_a_record_brings_its_units_and_its_kind(tmp_path: Path):
    signals = (Signal("plant.y", "rpm"), Signal("plant.location", kind="integer"), Signal("plant.raw", ""))
    record = Record(signals, np.array([0.0, 0.1]), np.array([[np.pi, 1.0, 2.0], [-0.0, 2.0, 3.0]]))
    write_signals(record, tmp_path / "signals.parquet")
    table = open_table(tmp_path / "signals.parquet")
    found = [table.column(signal.name) for signal in signals]
    assert [(column.unit, column.shown, column.kind) for column in found] == [
        ("rad/s", "rpm", "real"),
        ("1", "1", "integer"),
        ("", "", "real"),  # the unit of this one nobody ever declared
    ]
    assert np.column_stack([column.values for column in found]).tobytes() == record.values.tobytes()
    assert table.time(None, "plant.y").unit == "s"


def test_kinds_follow_the_types_of_parquet_and_what_has_no_value_is_no_number(tmp_path: Path):
    columns = {"n": [1, None, 3], "on": [True, False, None], "v": [0.5, None, 1.5], "text": ["a", "b", "c"]}
    table = open_table(parquet_file(tmp_path, columns, {"v": {"unit": "bar"}}))
    assert [table.column(name).kind for name in ("n", "on", "v")] == ["integer", "boolean", "real"]
    assert [table.column(name).unit for name in ("n", "on", "v")] == ["", "", "bar"]
    for name, wanted in (("n", [1, np.nan, 3]), ("on", [1, 0, np.nan]), ("v", [0.5, np.nan, 1.5])):
        np.testing.assert_array_equal(table.column(name).values, wanted)
    with pytest.raises(TableError, match="wants numbers, but 'text' holds values of the type string"):
        table.column("text")
    with pytest.raises(TableError, match="no column is named 'w'; did you mean 'v'"):
        table.column("w")


# MDF4


def test_a_channel_has_the_times_of_its_own_group(tmp_path: Path):
    fast, slow = np.arange(5) * 0.1, np.arange(3) * 1.0
    words = {
        f"{kind}_{i}": i if kind == "val" else word
        for i, word in enumerate((b"off", b"on"))
        for kind in ("val", "text")
    }
    path = mdf_file(
        tmp_path,
        [
            channel("n", np.arange(5, dtype="i2"), fast, "1/min", conversion={"a": 0.25, "b": 0.0}),
            channel("gear", np.array([1, 2, 2, 3, 3], dtype="u1"), fast),
            channel("state", np.array([0, 1, 1, 0, 0], dtype="u1"), fast, conversion={**words, "default": b"?"}),
            channel("p", np.arange(5.0), fast, "bar", invalidation_bits=np.array([0, 1, 0, 0, 1], dtype=bool)),
        ],
        [channel("T", [20.0, 21.0, 22.0], slow, "degC")],
    )
    table = open_table(path)
    assert [table.column(name).values.tolist() for name in ("n", "gear", "state", "p", "T")] == [
        [0.0, 0.25, 0.5, 0.75, 1.0],
        [1, 2, 2, 3, 3],
        [0, 1, 1, 0, 0],  # the numbers that the words stand for
        [0, 2, 3],  # invalid samples are none
        [20, 21, 22],
    ]
    assert [table.column(name).kind for name in ("n", "gear", "state", "p")] == ["real", "integer", "integer", "real"]
    assert [table.column(name).unit for name in ("n", "gear", "p", "T")] == ["1/min", "", "bar", "degC"]
    assert [table.time(None, name).values.tolist() for name in ("gear", "p", "T")] == [
        fast.tolist(),
        fast[[0, 2, 3]].tolist(),
        slow.tolist(),
    ]
    assert table.time(None, "T").unit == "s"
    assert table.time("gear", "n").values.tolist() == [1, 2, 2, 3, 3]
    with pytest.raises(TableError, match="no channel beside 'n' is named 'T'"):
        table.time("T", "n")
    table.close()


def test_a_channel_that_is_not_one_column_of_numbers_is_refused(tmp_path: Path):
    times = np.arange(2.0)
    words = channel("words", np.array([b"a", b"b"]), times, encoding="utf-8")
    path = mdf_file(tmp_path, [channel("v", times, times), words], [channel("v", times, times)])
    table = open_table(path)
    for name, said in (
        ("v", "wants one channel 'v', but the groups 0, 1 have one each"),
        ("words", "wants numbers, but channel 'words' holds values of the type"),
        ("word", "no channel is named 'word'; did you mean 'words'?"),
    ):
        with pytest.raises(TableError, match=said):
            table.column(name)
    table.close()


# Files


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("no.csv", None, "wants a file, but there is none at"),
        ("measured.xlsx", b"", "wants a file that ends in .csv, .parquet or .mf4, got measured.xlsx"),
        ("measured.parquet", b"PAR1", "measured.parquet is no Parquet file"),
        ("measured.mf4", b"time,v\n", "measured.mf4 is no MDF4 file, or a damaged one"),
    ],
)
def test_a_file_that_cannot_be_opened_is_told(tmp_path: Path, name: str, content: bytes | None, said: str):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(TableError) as error:
        open_table(tmp_path / name)
    assert str(error.value).startswith(said)


def test_without_asammdf_it_is_said_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path = mdf_file(tmp_path, [channel("v", np.arange(2.0), np.arange(2.0))])
    monkeypatch.setitem(sys.modules, "asammdf", None)
    with pytest.raises(TableError, match=r"wants the package asammdf: pip install 'crankbench\[mdf\]'"):
        open_table(path)


def test_neither_pandas_nor_asammdf_is_imported_before_it_is_needed(tmp_path: Path):
    times = np.arange(3.0)
    files = [
        csv_file(tmp_path, "time,v\n0,1\n1,\n"),
        parquet_file(tmp_path, {"time": times.tolist(), "v": [1.0, None, 2.0]}),
        mdf_file(tmp_path, [channel("v", times, times)]),
    ]
    code = (
        "import sys, harness.wiring; from pathlib import Path; from harness.tablefile import open_table\n"
        "def heavy(): return [name for name in ('pandas', 'asammdf') if name in sys.modules]\n"
        f"for name in {[str(file) for file in files]!r}:\n"
        "    open_table(Path(name)).column('v'); print(Path(name).suffix, *heavy())\n"
    )
    printed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert printed.splitlines() == [".csv", ".parquet", ".mf4 pandas asammdf"]


# Units


@pytest.mark.parametrize(
    ("said", "given", "settled"),
    [
        ("rpm", None, "rpm"),
        ("", "rpm", "rpm"),
        ("U/min", "rpm", "rpm"),  # unknown: the campaign says it
        ("1/min", "rpm", "rpm"),  # of what, only the campaign says
        ("N.m", "N.m/rad", "N.m/rad"),
        ("bar", "hPa", None),
        ("rad/s", "rpm", None),
        ("degC", "K", None),
        ("N.m", "N", None),
        ("", None, None),
        ("U/min", None, None),
        ("rpm", "furlong", None),
    ],
)
def test_file_and_campaign_settle_the_unit_of_a_column_or_contradict_each_other(
    said: str, given: str | None, settled: str | None
):
    if settled is not None:
        assert settle_unit(said, given, "speed") == settled
        return
    with pytest.raises(UnitError) as error:
        settle_unit(said, given, "speed")
    named = [unit for unit in (said, given) if unit and given != "furlong"] or ["speed" if given is None else "furlong"]
    assert all(unit in str(error.value) for unit in named)


def test_a_conversion_is_that_of_the_unit_and_none_keeps_every_bit():
    values = np.array([-0.0, 1.0, 1e-300, 3.3])
    assert converted(values, "rad/s").tobytes() == values.tobytes()
    assert converted(values, "deg", "deg").tobytes() == values.tobytes()
    np.testing.assert_allclose(converted(values, "rpm"), values * 2.0 * np.pi / 60.0, rtol=1e-15)
    np.testing.assert_allclose(converted(values, "degC"), values + 273.15, rtol=1e-15)
    np.testing.assert_allclose(converted(values, "rev", "deg"), values * 360.0, rtol=1e-15)
