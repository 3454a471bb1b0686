"""Unpack FMU archives once, within limits, into a cache named by their content."""

from __future__ import annotations

import errno
import hashlib
import os
import re
import shutil
import stat
import struct
import tempfile
import time
import zipfile
import zlib
from pathlib import Path
from typing import NamedTuple

from fmus.component import ConfigurationError
from fmus.toolchain import cache_folder

_CHUNK = 1 << 20
_DRIVE = re.compile(r"[A-Za-z]:")
_ENCRYPTED = 0x1
# The standards allow these; others may ask for gigabytes before they give a byte.
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
_ABANDONED = 3600.0  # s: a folder that was begun longer ago belongs to a process that was killed


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
    folder, is a link, is encrypted or packed by a method that the standards do not allow, or a limit is passed.
    """
    path = Path(path)
    if not path.is_file():
        raise ConfigurationError(f"{path}: wants an FMU file, found {'a folder' if path.is_dir() else 'nothing'} there")
    sha256 = _sha256(path)
    shelf = shelf_folder()
    folder = shelf / sha256
    if not folder.is_dir():
        shelf.mkdir(parents=True, exist_ok=True)
        _sweep(shelf)
        partial = Path(tempfile.mkdtemp(prefix=f".{sha256[:16]}-", dir=shelf))
        try:
            _extract(path, partial, limits)
            _settle(partial, folder)
        finally:
            shutil.rmtree(partial, ignore_errors=True)
    return Unpacked(folder, sha256)


def shelf_folder() -> Path:
    """Where unpacked archives stand; it need not exist."""
    return cache_folder() / "unpacked"


def empty_shelf() -> int:
    """Remove every unpacked archive and return how many there were; what is being unpacked meanwhile is unpacked again.

    Raises ConfigurationError: the cache cannot be written.
    """
    shelf = shelf_folder()
    if not shelf.is_dir():
        return 0
    count = sum(not folder.name.startswith(".") for folder in shelf.iterdir())
    with tempfile.TemporaryDirectory(prefix="removed-", dir=shelf.parent, ignore_cleanup_errors=True) as rubbish:
        os.rename(shelf, Path(rubbish) / "unpacked")
    return count


def _sweep(shelf: Path) -> None:
    """Remove what killed processes left."""
    for folder in shelf.glob(".*"):
        try:
            if time.time() - folder.stat().st_mtime > _ABANDONED:
                shutil.rmtree(folder, ignore_errors=True)
        except FileNotFoundError:
            continue


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
                if not parts or entry.filename[-1] in "/\\":
                    folder.joinpath(*parts).mkdir(parents=True, exist_ok=True)
                else:
                    left -= _copy(path, archive, entry, folder.joinpath(*parts), left)
    except (FileExistsError, NotADirectoryError, IsADirectoryError) as error:
        raise _refused(path, f"has two entries for one place: {_inside(error.filename, folder)}") from error
    except UnicodeError as error:
        raise _refused(path, f"has an entry whose name cannot be read: {error}") from error
    except (zipfile.BadZipFile, zlib.error, EOFError, struct.error, ValueError, OverflowError) as error:
        raise _refused(path, f"is no intact zip archive: {error}") from error
    except (NotImplementedError, RuntimeError) as error:
        raise _refused(path, f"is packed in a way that cannot be read: {error}") from error
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENAMETOOLONG, errno.EILSEQ):
            raise
        raise _refused(path, f"is no intact zip archive: {error.strerror}") from error


def _inside(place: str | None, folder: Path) -> str:
    return Path(place).relative_to(folder).as_posix() if place else "its top"


def _allowed_bytes(path: Path, limits: Limits) -> int:
    by_ratio = max(limits.ratio_from, int(limits.ratio * path.stat().st_size))
    return min(limits.bytes, by_ratio)


def _parts(path: Path, entry: zipfile.ZipInfo) -> list[str]:
    """The path of an entry inside the folder; backslashes separate too, `.` is skipped."""
    name = entry.filename.replace("\\", "/")
    parts = [part for part in name.split("/") if part not in ("", ".")]
    if name.startswith("/") or ".." in parts or any(_DRIVE.match(part) for part in parts):
        raise _refused(path, f"has the entry '{entry.filename}', which leads outside of it")
    kind = stat.S_IFMT(entry.external_attr >> 16)
    if kind not in (0, stat.S_IFREG, stat.S_IFDIR):
        what = "a link" if kind == stat.S_IFLNK else "neither a file nor a folder"
        raise _refused(path, f"has the entry '{entry.filename}', which is {what}")
    if entry.flag_bits & _ENCRYPTED:
        raise _refused(path, f"has the entry '{entry.filename}', which is encrypted")
    if entry.compress_type not in _METHODS:
        raise _refused(
            path, f"has the entry '{entry.filename}', packed by the method {entry.compress_type}, not deflate"
        )
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
