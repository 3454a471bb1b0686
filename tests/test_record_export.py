"""Exported records hold the values of the record, in the units asked for, however many row groups there are."""

from __future__ import annotations

import csv
import json
import sys
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from fmus.component import ConfigurationError, Signal
from harness.cli import main
from harness.record import Record, write_signals
from harness.recordexport import Format, Units, export
from harness.signalsfile import GroupSize, si_unit
from harness.tablefile import open_table

SIGNALS = (
    Signal("plant.speed", "rpm", description="of the crankshaft"),
    Signal("plant.temperature", "degC"),
    Signal("plant.gear", "1", kind="integer"),
    Signal("plant.locked", "1", kind="boolean"),
    Signal("plant.odd", "furlong"),
)


def record(crank: bool = True) -> Record:
    """Fifty rows with numbers that need all their digits."""
    rng = np.random.default_rng(1)
    speed, temperature, odd = rng.normal(size=(3, 50)) * np.array([[1e-9], [300.0], [1e300]])
    values = np.column_stack((speed, temperature, np.arange(50) % 6 - 1, np.arange(50) % 2, odd))
    return Record(SIGNALS, np.arange(50) * 0.1, values, crank=np.arange(50) * 6.0 if crank else None)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A run folder with two records in row groups of 8."""
    for case in ("one", "two"):
        write_signals(record(), tmp_path / "cases" / case / "signals.parquet", GroupSize(0, 8))
    return tmp_path


def columns_of(file: Path) -> dict[str, np.ndarray]:
    with file.open(newline="") as stream:
        heading, *rows = csv.reader(stream)
    return dict(zip(heading, np.array(rows, dtype=float).T, strict=True))


def expected(units: Units) -> dict[str, np.ndarray]:
    """The columns by the heading of a CSV file; conversions written out."""
    whole = record()
    assert whole.crank is not None
    speed, temperature = whole["plant.speed"], whole["plant.temperature"]
    if units == "declared":
        shown = {
            "plant.speed [rpm]": speed / (2 * np.pi / 60),
            "plant.temperature [degC]": temperature - 273.15,
        }
    else:
        shown = {"plant.speed [rad/s]": speed, "plant.temperature [K]": temperature}
    return {
        "time [s]": whole.time,
        "crank [deg]": whole.crank,
        **shown,
        "plant.gear": whole["plant.gear"],
        "plant.locked": whole["plant.locked"],
        "plant.odd [furlong]": whole["plant.odd"],
    }


@pytest.mark.parametrize("units", ["declared", "si"])
def test_csv_reads_back_as_the_record(folder: Path, units: Units) -> None:
    (path,) = export(folder / "cases" / "one", "csv", None, units)
    assert path == folder / "cases" / "one" / "signals.csv"
    found = columns_of(path)
    assert list(found) == list(expected(units))
    for name, values in expected(units).items():
        if units == "si" or name in ("time [s]", "crank [deg]", "plant.odd [furlong]"):
            assert np.array_equal(found[name], values), name
        else:  # one rounding of a factor and one of a division apart
            np.testing.assert_allclose(found[name], values, rtol=1e-15, err_msg=name)
    assert path.read_text().splitlines()[1].split(",")[4:6] == ["-1", "0"]


@pytest.mark.parametrize("units", ["declared", "si"])
def test_mdf4_reads_back_as_the_record(folder: Path, units: Units) -> None:
    asammdf = pytest.importorskip("asammdf")
    (path,) = export(folder / "cases" / "one" / "signals.parquet", "mdf4", None, units)
    assert path == folder / "cases" / "one" / "signals.mf4"
    whole = expected(units)
    with asammdf.MDF(path) as file:
        assert file.version == "4.10"
        assert file.get("plant.speed").comment == "of the crankshaft"
        assert file.get("plant.gear").samples.dtype.kind == "i"
        for heading, values in whole.items():
            name, _, unit = heading.partition(" [")
            channel = file.get(name)
            np.testing.assert_allclose(channel.samples, values, rtol=1e-15 if units == "declared" else 0.0)
            assert np.array_equal(channel.timestamps, whole["time [s]"])
            assert channel.unit == (unit.rstrip("]") or "1")
    assert sorted(file.name for file in path.parent.iterdir()) == ["signals.mf4", "signals.parquet"]


def test_a_record_without_rows_is_a_file_without_rows(tmp_path: Path) -> None:
    write_signals(Record(SIGNALS[:1], np.empty(0), np.empty((0, 1)), "crash"), tmp_path / "signals.parquet")
    (path,) = export(tmp_path, "csv", None, "si")
    assert path.read_text() == "time [s],plant.speed [rad/s]\n"
    asammdf = pytest.importorskip("asammdf")
    (path,) = export(tmp_path, "mdf4", None, "si")
    with asammdf.MDF(path) as file:
        assert len(file.get("plant.speed").samples) == 0


@pytest.mark.parametrize("form", ["csv", "mdf4"])
def test_an_exported_record_comes_in_again_as_recorded_data(folder: Path, form: Format) -> None:
    pytest.importorskip("asammdf")
    (path,) = export(folder / "cases" / "one", form, None, "si")
    with closing(open_table(path)) as table:
        for signal in SIGNALS:
            column = table.column(signal.name)
            assert np.array_equal(column.values, record()[signal.name])
            assert np.array_equal(table.time(None, signal.name).values, record().time)
            assert column.unit in (si_unit(signal.unit), "")


def call(monkeypatch: pytest.MonkeyPatch, *arguments: object) -> int:
    monkeypatch.setattr(sys, "argv", ["crankbench", *map(str, arguments)])
    with pytest.raises(SystemExit) as ended:
        main()
    return int(ended.value.code or 0)


def test_all_records_of_a_run_folder_are_exported_to_files_named_by_their_cases(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert call(monkeypatch, "export", folder, "--to", "csv", "--out", folder / "csv") == 0
    wanted = [folder / "csv" / "one.csv", folder / "csv" / "two.csv"]
    assert capsys.readouterr().out.splitlines() == list(map(str, wanted))
    assert wanted[0].read_bytes() == wanted[1].read_bytes()
    assert call(monkeypatch, "export", folder, "--to", "csv", "--json") == 0
    assert [Path(name).name for name in json.loads(capsys.readouterr().out)["files"]] == ["signals.csv"] * 2
    single = folder / "mine.csv"
    assert call(monkeypatch, "export", folder / "cases" / "one", "--to", "csv", "--out", single) == 0
    assert single.read_bytes() == wanted[0].read_bytes()


def test_what_cannot_be_exported_is_said_and_nothing_is_written(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "text").write_text("no record")
    (folder / "empty").mkdir()
    before = sorted(folder.rglob("*"))
    for arguments, said in [
        ((folder / "nowhere", "--to", "csv"), "wants a run folder, a case's folder or a signals.parquet"),
        ((folder / "empty", "--to", "csv"), "holds no record"),
        ((folder / "text", "--to", "csv"), "wants to be a record in Parquet"),
        ((folder, "--to", "csv", "--out", folder / "all.csv"), "--out wants a folder for 2 records"),
        ((folder, "--to", "csv", "--out", folder / "text"), "--out wants a folder or a file that ends in .csv"),
        ((folder, "--to", "xlsx"), "'xlsx' is not one of 'csv', 'mdf4'"),
    ]:
        assert call(monkeypatch, "export", *arguments) == 2
        assert said in " ".join(capsys.readouterr().err.replace("\u2502", " ").split())
    assert sorted(folder.rglob("*")) == before


def test_mdf4_without_its_package_says_what_to_install(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "asammdf", None)
    with pytest.raises(ConfigurationError, match=r"pip install 'crankbench\[mdf\]'"):
        list(export(folder, "mdf4", None, "si"))
