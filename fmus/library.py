"""The shared library of an FMU in this process: found with what it needs, its functions by name."""

from __future__ import annotations

import ctypes
import mmap
import os
import re
import shutil
import struct
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from fmus.component import ConfigurationError

# How dynamic linkers name a library that they cannot find.
_NOT_FOUND = (
    re.compile(r"^(?P<name>[^:/\s]+): cannot open shared object file"),
    re.compile(r"Error loading shared library (?P<name>[^:/\s]+): No such file"),
    re.compile(r"Library not loaded: (?:@\w+/|/)?(?:[^\s/]+/)*(?P<name>[^\s/]+)"),
)

# What every system with the GNU or musl C library has.
_ALWAYS = frozenset(
    f"lib{name}" for name in ("c.so.6", "m.so.6", "pthread.so.0", "dl.so.2", "rt.so.1", "gcc_s.so.1", "stdc++.so.6")
) | {"ld-linux-x86-64.so.2", "ld-linux-aarch64.so.1", "linux-vdso.so.1"}
_ELF64 = b"\x7fELF\x02\x01"
_DYNAMIC, _NEEDED, _DYNAMIC_STRINGS, _LOAD, _DYNAMIC_SYMBOLS = 2, 1, 5, 1, 11


class Library:
    """A loaded shared library whose functions of the standard have names that begin with `prefix`.

    Libraries that it needs and the system lacks are taken from the FMU's own folders where they are shipped there.

    Raises ConfigurationError: it cannot be loaded; the library that is missing is named.
    """

    def __init__(self, path: Path, prefix: str, folder: Path) -> None:
        self.path, self._prefix = path, prefix
        self._needed: list[ctypes.CDLL] = []
        self._functions: dict[str, Any] = {}
        self._library: ctypes.CDLL | None = self._load(folder)

    def function(self, name: str) -> Any:
        """The function called `prefix` + name, returning an int unless told otherwise.

        Raises ConfigurationError: the library lacks it.
        """
        if name not in self._functions:
            try:
                self._functions[name] = getattr(self._library, self._prefix + name)
            except AttributeError as error:
                raise ConfigurationError(
                    f"its library lacks a function of the standard: {self._prefix}{name}"
                ) from error
        return self._functions[name]

    def has(self, name: str) -> bool:
        """True when the library has the function called `prefix` + name."""
        return hasattr(self._library, self._prefix + name)

    def address(self, name: str) -> int:
        """The address of the function called `prefix` + name. Raises ConfigurationError: the library lacks it."""
        return ctypes.cast(self.function(name), ctypes.c_void_p).value or 0

    def release(self) -> None:
        """Let go of the library, which unloads it when nobody else holds it; may be called again."""
        library, self._library = self._library, None
        self._functions.clear()
        if library is not None:
            _unload(library)

    def _load(self, folder: Path) -> ctypes.CDLL:
        tried: set[str] = set()
        while True:
            try:
                return _open(self.path)
            except OSError as error:
                name = missing_library(str(error))
                shipped = next((path for path in sorted(folder.rglob(name)) if path.is_file()), None) if name else None
                if not name or shipped is None or name in tried:
                    raise ConfigurationError(_refusal(self.path, name, str(error))) from error
                tried.add(name)
                self._needed.append(_open_needed(shipped, folder, tried))


def missing_library(message: str) -> str:
    """The name of the library that a dynamic linker's message says is missing; empty where it says no such thing."""
    return next((match["name"] for pattern in _NOT_FOUND if (match := pattern.search(message))), "")


def _open_needed(path: Path, folder: Path, tried: set[str]) -> ctypes.CDLL:
    while True:
        try:
            return ctypes.CDLL(str(path), mode=ctypes.RTLD_GLOBAL)
        except OSError as error:
            name = missing_library(str(error))
            shipped = next((p for p in sorted(folder.rglob(name)) if p.is_file()), None) if name else None
            if not name or shipped is None or name in tried:
                raise ConfigurationError(_refusal(path, name, str(error))) from error
            tried.add(name)
            _open_needed(shipped, folder, tried)


def _open(path: Path) -> ctypes.CDLL:
    if sys.platform == "win32":  # what lies beside the library is looked for there first
        return ctypes.CDLL(str(path), winmode=0x00000008)
    return ctypes.CDLL(str(path), mode=os.RTLD_NOW | os.RTLD_LOCAL)


def _unload(library: ctypes.CDLL) -> None:
    if sys.platform == "win32":
        kernel = ctypes.WinDLL("kernel32")
        kernel.FreeLibrary.argtypes = (ctypes.c_void_p,)
        kernel.FreeLibrary(library._handle)
    else:
        from _ctypes import dlclose

        dlclose(library._handle)


def _refusal(path: Path, name: str, message: str) -> str:
    if name:
        return f"its library {path.name} wants the shared library {name}, which is neither installed nor shipped in it"
    if "undefined symbol" in message:
        return f"its library {path.name} wants a function that no library gives: {message.split(': ')[-1]}"
    return f"its library {path.name} cannot be loaded: {message}"


def missing_libraries(path: Path, folder: Path) -> list[str]:
    """Names of the libraries that an ELF library wants, and that are neither installed nor in the FMU's `folder`.

    The system is asked by `ldd`, which runs nothing of the library, and only where more than the C library is wanted.
    Empty where the system has no such tool, or another kind of library.
    """
    tool = shutil.which("ldd")
    if sys.platform != "linux" or tool is None or _ALWAYS.issuperset(wanted_libraries(path)):
        return []
    try:
        result = subprocess.run(
            [tool, str(path)], stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=20, check=False
        )
    except (OSError, subprocess.TimeoutExpired):
        return []
    lines = (line.strip() for line in result.stdout.splitlines())
    names = [line.split(" => ")[0] for line in lines if line.endswith("=> not found")]
    return [name for name in dict.fromkeys(names) if not any(place.is_file() for place in folder.rglob(name))]


def wanted_libraries(path: Path) -> list[str]:
    """The libraries that a 64-bit ELF library names as needed, in its order; empty for any other file."""
    with _mapped(path) as data:
        try:
            if data[:6] != _ELF64:
                return []
            (headers,) = struct.unpack_from("<Q", data, 32)
            size, count = struct.unpack_from("<HH", data, 54)
            segments = [struct.unpack_from("<IIQQQQ", data, headers + i * size) for i in range(count)]
            loads = [(address, offset, length) for kind, _, offset, address, _, length in segments if kind == _LOAD]
            dynamic = next((offset, length) for kind, _, offset, _, _, length in segments if kind == _DYNAMIC)
            entries = [struct.unpack_from("<qQ", data, dynamic[0] + i) for i in range(0, dynamic[1], 16)]
            strings = next(value for tag, value in entries if tag == _DYNAMIC_STRINGS)
            begin = next(strings - a + offset for a, offset, length in loads if a <= strings < a + length)
            return [_text(data, begin + value) for tag, value in entries if tag == _NEEDED]
        except (struct.error, StopIteration, ValueError):
            return []


def exported_names(path: Path) -> frozenset[str]:
    """The names that a 64-bit ELF library gives to others; empty where they cannot be read."""
    with _mapped(path) as data:
        try:
            if data[:6] != _ELF64:
                return frozenset()
            (table,) = struct.unpack_from("<Q", data, 40)
            size, count = struct.unpack_from("<HH", data, 58)
            sections = [struct.unpack_from("<IIQQQQIIQQ", data, table + i * size) for i in range(count)]
            _, _, _, _, begin, length, link, _, _, entry = next(s for s in sections if s[1] == _DYNAMIC_SYMBOLS)
            strings = sections[link][4]
            symbols = (struct.unpack_from("<IBBH", data, place) for place in range(begin, begin + length, entry))
            return frozenset(_text(data, strings + name) for name, info, _, home in symbols if home and info >> 4)
        except (struct.error, StopIteration, ValueError, IndexError):
            return frozenset()


@contextmanager
def _mapped(path: Path) -> Iterator[mmap.mmap | bytes]:
    with path.open("rb") as file:
        if not path.stat().st_size:
            yield b""
            return
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            yield data


def _text(data: mmap.mmap | bytes, place: int) -> str:
    end = data.find(b"\0", place)
    return data[place:end].decode(errors="replace")
