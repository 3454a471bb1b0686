"""Archives are unpacked once, whole or not at all, and never outside their folder."""

from __future__ import annotations

import os
import stat
import subprocess
import sys
import zipfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from third_party import reference_fmu

from fmus.archive import Limits, unpack
from fmus.component import ConfigurationError
from fmus.fmu import describe
from harness.doctor import remove_unpacked


@pytest.fixture(scope="module")
def dahlquist() -> Path:
    """A Reference FMU out of the common cache, which it is fetched into before a test has one of its own."""
    return reference_fmu("Dahlquist")


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cache of its own for each test."""
    monkeypatch.setenv("CRANKBENCH_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def archive(path: Path, entries: dict[str, bytes]) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        for name, content in entries.items():
            file.writestr(zipfile.ZipInfo(name), content, zipfile.ZIP_DEFLATED)
    return path


def test_the_same_content_is_unpacked_once_whatever_its_name(tmp_path: Path):
    first = unpack(archive(tmp_path / "a.fmu", {"x/y.txt": b"1"}))
    assert (first.folder / "x" / "y.txt").read_bytes() == b"1"
    (first.folder / "mark").touch()
    second = unpack(archive(tmp_path / "b.fmu", {"x/y.txt": b"1"}))
    assert second == first and (second.folder / "mark").exists()
    assert unpack(archive(tmp_path / "c.fmu", {"x/y.txt": b"2"})).folder != first.folder


def test_many_may_unpack_the_same_archive_at_once(tmp_path: Path, cache: Path):
    path = archive(tmp_path / "a.fmu", {f"{k}.txt": bytes(1000) for k in range(50)})
    with ThreadPoolExecutor(8) as pool:
        found = set(pool.map(lambda _: unpack(path), range(16)))
    (unpacked,) = found
    assert len(list(unpacked.folder.iterdir())) == 50
    assert [folder.name for folder in (cache / "unpacked").iterdir()] == [unpacked.sha256]


def test_many_processes_may_unpack_the_same_archive_at_once(tmp_path: Path, cache: Path):
    path = archive(tmp_path / "a.fmu", {f"{k}.txt": bytes(1000) for k in range(200)})
    program = f"from fmus.archive import unpack; print(len(list(unpack({str(path)!r}).folder.iterdir())))"
    command = [sys.executable, "-c", program]
    processes = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(6)]
    assert [process.communicate()[0].strip() for process in processes] == ["200"] * 6
    assert [folder.name for folder in (cache / "unpacked").iterdir()] == [unpack(path).sha256]


def test_the_cache_is_emptied_of_unpacked_archives_and_filled_again(tmp_path: Path, cache: Path):
    path = archive(tmp_path / "a.fmu", {"x": b"1"})
    folder = unpack(path).folder
    (cache / "libraries").mkdir()
    command = [sys.executable, "-m", "harness", "doctor", "--clean"]
    said = subprocess.run(command, capture_output=True, text=True, check=False).stdout
    assert "1 unpacked FMUs" in said
    assert [entry.name for entry in cache.iterdir()] == ["libraries"]
    assert remove_unpacked() == 0
    assert unpack(path).folder == folder and (folder / "x").read_bytes() == b"1"


def test_what_a_killed_process_left_is_swept_away_and_what_another_is_at_is_not(tmp_path: Path, cache: Path):
    left, busy = cache / "unpacked" / ".left-1", cache / "unpacked" / ".busy-1"
    left.mkdir(parents=True), busy.mkdir()
    os.utime(left, (0, 0))
    unpack(archive(tmp_path / "a.fmu", {"x": b"1"}))
    assert busy.is_dir() and not left.exists()


def test_backslashes_and_dots_in_names_are_folders_as_meant(tmp_path: Path):
    folder = unpack(
        archive(
            tmp_path / "a.fmu", {"d\\": b"", "./binaries\\linux64\\m.so": b"1", ".\\b/./c": b"2", "d\\e": b"", "": b""}
        )
    ).folder
    assert (folder / "binaries" / "linux64" / "m.so").read_bytes() == b"1"
    assert (folder / "b" / "c").read_bytes() == b"2"
    assert (folder / "d" / "e").is_file()


@pytest.mark.parametrize(
    "name", ["../evil", "a/../../evil", "..\\evil", "/evil", "\\evil", "C:\\evil", "c:evil", "a/.."]
)
def test_an_entry_that_leads_outside_is_refused_and_nothing_is_kept(tmp_path: Path, cache: Path, name: str):
    with pytest.raises(ConfigurationError, match="leads outside"):
        unpack(archive(tmp_path / "a.fmu", {"fine": b"", name: b"evil"}))
    assert not any((cache / "unpacked").iterdir())
    assert not list(tmp_path.rglob("evil"))


def test_a_link_is_refused(tmp_path: Path):
    link = zipfile.ZipInfo("link")
    link.external_attr = (stat.S_IFLNK | 0o777) << 16
    with zipfile.ZipFile(tmp_path / "a.fmu", "w") as file:
        file.writestr(link, "/etc/passwd")
    with pytest.raises(ConfigurationError, match="is a link"):
        unpack(tmp_path / "a.fmu")


def test_a_device_is_refused(tmp_path: Path):
    device = zipfile.ZipInfo("device")
    device.external_attr = (stat.S_IFCHR | 0o666) << 16
    with zipfile.ZipFile(tmp_path / "a.fmu", "w") as file:
        file.writestr(device, "")
    with pytest.raises(ConfigurationError, match="neither a file nor a folder"):
        unpack(tmp_path / "a.fmu")


def test_an_encrypted_entry_is_refused(tmp_path: Path):
    content = bytearray(archive(tmp_path / "a.fmu", {"x": b"1"}).read_bytes())
    for signature, offset in ((b"PK\1\2", 8), (b"PK\3\4", 6)):
        content[content.index(signature) + offset] |= 1
    (tmp_path / "a.fmu").write_bytes(content)
    with pytest.raises(ConfigurationError, match="'x', which is encrypted"):
        unpack(tmp_path / "a.fmu")


def test_a_method_of_packing_that_the_standards_do_not_allow_is_refused(tmp_path: Path):
    with zipfile.ZipFile(tmp_path / "a.fmu", "w", zipfile.ZIP_LZMA) as file:
        file.writestr("x", bytes(1000))
    with pytest.raises(ConfigurationError, match="not deflate"):
        unpack(tmp_path / "a.fmu")


def test_a_name_too_long_for_a_file_is_refused(tmp_path: Path, cache: Path):
    with pytest.raises(ConfigurationError, match="no intact zip archive"):
        unpack(archive(tmp_path / "a.fmu", {"x" * 5000: b""}))
    assert not any((cache / "unpacked").iterdir())


@pytest.mark.parametrize(
    ("limits", "told"),
    [
        (Limits(bytes=1 << 20), "more bytes"),
        (Limits(ratio=10.0, ratio_from=1 << 20), "more bytes"),
        (Limits(entries=2), "3 entries, at most 2"),
    ],
)
def test_more_than_the_limits_is_refused(tmp_path: Path, cache: Path, limits: Limits, told: str):
    path = archive(tmp_path / "bomb.fmu", {str(k): bytes(1 << 20) for k in range(3)})
    with pytest.raises(ConfigurationError, match=told):
        unpack(path, limits)
    assert not any((cache / "unpacked").iterdir())
    unpack(path)


def test_two_entries_for_one_place_are_refused(tmp_path: Path):
    with pytest.raises(ConfigurationError, match="two entries for one place"):
        unpack(archive(tmp_path / "a.fmu", {"x": b"1", "./x": b"2"}))
    with pytest.raises(ConfigurationError, match="two entries for one place"):
        unpack(archive(tmp_path / "b.fmu", {"x": b"1", "x/y": b"2"}))


def test_what_is_no_archive_or_a_damaged_one_is_told(tmp_path: Path):
    with pytest.raises(ConfigurationError, match="found nothing there"):
        unpack(tmp_path / "missing.fmu")
    (tmp_path / "text.fmu").write_text("hello")
    with pytest.raises(ConfigurationError, match="no intact zip archive"):
        unpack(tmp_path / "text.fmu")
    noise = bytes((k * k * 2654435761 >> 7) & 255 for k in range(20_000))
    damaged = bytearray(archive(tmp_path / "whole.fmu", {"noise": noise}).read_bytes())
    damaged[2000:2100] = bytes(100)
    (tmp_path / "damaged.fmu").write_bytes(damaged)
    with pytest.raises(ConfigurationError, match="no intact zip archive"):
        unpack(tmp_path / "damaged.fmu")


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (None, "wants a modelDescription.xml"),
        (b"<fmiModelDescription", "is not XML"),
        (
            b'<!DOCTYPE x [<!ENTITY a "b">]><fmiModelDescription fmiVersion="2.0">&a;</fmiModelDescription>',
            "is refused",
        ),
        (b'<fmiModelDescription fmiVersion="9.0"/>', "wants an fmiVersion of 1.0, 2.0 or 3.0"),
    ],
)
def test_a_model_description_that_cannot_be_read_is_told(tmp_path: Path, content: bytes | None, told: str):
    entries = {"readme": b""} if content is None else {"modelDescription.xml": content}
    with pytest.raises(ConfigurationError, match=told):
        describe(archive(tmp_path / "a.fmu", entries))


def test_rules_broken_by_a_model_description_are_cautions(tmp_path: Path, dahlquist: Path):
    entries = {}
    with zipfile.ZipFile(dahlquist) as source:
        for name in source.namelist():
            if not name.endswith("/"):
                entries[name] = source.read(name)
    xml = entries["modelDescription.xml"]
    entries["modelDescription.xml"] = xml.replace(b'modelName="Dahlquist"', b'modelName="Dahlquist" colour="red"', 1)
    assert entries["modelDescription.xml"] != xml
    description = describe(archive(tmp_path / "a.fmu", entries))
    assert description.runnable
    assert any("colour" in caution for caution in description.cautions)
