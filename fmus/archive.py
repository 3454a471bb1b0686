"""Unpack FMU archives once, within limits, into a cache named by their content."""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import stat
import tempfile
import zipfile
import zlib
from pathlib import Path
from typing import NamedTuple

from fmus.component import ConfigurationError
from fmus.toolchain import cache_folder

_CHUNK = 1 << 20
_DRIVE = re.compile(r"[A-Za-z]:")


class Limits(NamedTuple):
    """How large an unpacked archive may be; the ratio counts only above `ratio_from` bytes, since tables pack well."""

    bytes: int = 4 << 30
    entries: int = 50_000
    ratio: float = 200.0
    ratio_from: int = 64 << 20


class Unpacked(NamedTuple):
    """The folder of an unpacked FMU and the SHA-256 of the archive it came from."""

    folder: Path
    sha256: str


def unpack(path: str | Path, limits: Limits = Limits()) -> Unpacked:  # noqa: B008 - a NamedTuple does not change
    """The unpacked contents of the FMU at `path`, read-only by agreement and shared by all who use it.

    An archive met before, under any name, is not unpacked again. Processes may call this at the same time: each
    unpacks into a folder of its own, the first to rename it wins.

    Raises ConfigurationError: there is no such file, it is no zip archive or a damaged one, an entry leads outside the
    folder, or a limit is passed.
    """
    path = Path(path)
    if not path.is_file():
        raise ConfigurationError(f"{path}: wants an FMU file, found {'a folder' if path.is_dir() else 'nothing'} there")
    sha256 = _sha256(path)
    shelf = cache_folder() / "unpacked"
    folder = shelf / sha256
    if not folder.is_dir():
        shelf.mkdir(parents=True, exist_ok=True)
        partial = Path(tempfile.mkdtemp(prefix=f".{sha256[:16]}-", dir=shelf))
        try:
            _extract(path, partial, limits)
            _settle(partial, folder)
        finally:
            shutil.rmtree(partial, ignore_errors=True)
    return Unpacked(folder, sha256)


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _settle(partial: Path, folder: Path) -> None:
    try:
        os.rename(partial, folder)
    except OSError:
        if not folder.is_dir():
            raise


def _extract(path: Path, folder: Path, limits: Limits) -> None:
    try:
        with zipfile.ZipFile(path) as archive:
            entries = archive.infolist()
            if len(entries) > limits.entries:
                raise _refused(path, f"has {len(entries)} entries, at most {limits.entries} are taken")
            left = _allowed_bytes(path, limits)
            for entry in entries:
                parts = _parts(path, entry)
                if entry.is_dir() or not parts:
                    folder.joinpath(*parts).mkdir(parents=True, exist_ok=True)
                else:
                    left -= _copy(path, archive, entry, folder.joinpath(*parts), left)
    except (zipfile.BadZipFile, zlib.error, EOFError) as error:
        raise _refused(path, f"is no intact zip archive: {error}") from error
    except (NotImplementedError, RuntimeError) as error:
        raise _refused(path, f"is packed in a way that cannot be read: {error}") from error
    except (FileExistsError, NotADirectoryError) as error:
        raise _refused(path, f"has two entries for one place: {error.filename}") from error


def _allowed_bytes(path: Path, limits: Limits) -> int:
    by_ratio = max(limits.ratio_from, int(limits.ratio * path.stat().st_size))
    return min(limits.bytes, by_ratio)


def _parts(path: Path, entry: zipfile.ZipInfo) -> list[str]:
    """The path of an entry inside the folder; backslashes separate too, `.` is skipped."""
    name = entry.filename.replace("\\", "/")
    parts = [part for part in name.split("/") if part not in ("", ".")]
    if name.startswith("/") or _DRIVE.match(name) or ".." in parts:
        raise _refused(path, f"has the entry '{entry.filename}', which leads outside of it")
    if stat.S_ISLNK(entry.external_attr >> 16):
        raise _refused(path, f"has the entry '{entry.filename}', which is a link")
    return parts


def _copy(path: Path, archive: zipfile.ZipFile, entry: zipfile.ZipInfo, target: Path, left: int) -> int:
    """Write one entry and return its true size: what the archive says of sizes is not believed."""
    target.parent.mkdir(parents=True, exist_ok=True)
    written = 0
    with archive.open(entry) as source, target.open("xb") as file:
        while chunk := source.read(_CHUNK):
            written += len(chunk)
            if written > left:
                raise _refused(path, "unpacks to more bytes than are taken from an archive of its size")
            file.write(chunk)
    return written


def _refused(path: Path, why: str) -> ConfigurationError:
    return ConfigurationError(f"{path}: {why}")
