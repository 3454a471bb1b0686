"""Looks at what crankbench needs of the machine: a compiler, the packages, a cache that can be written."""

from __future__ import annotations

import os
import platform
from importlib.metadata import version
from typing import Any

from fmus.archive import empty_shelf
from fmus.component import ConfigurationError
from fmus.toolchain import cache_folder, find_compiler, find_zig, native_platform
from harness.runfolder import VERSIONED, commit


def remove_unpacked() -> int:
    """Remove the unpacked FMUs from the cache and return how many there were. Raises ConfigurationError."""
    return empty_shelf()


def examine() -> dict[str, Any]:
    """What was found, by name; `problems` holds what stands in the way, in words."""
    problems: list[str] = []
    found: dict[str, Any] = {"compiler": None, "zig": None, "cache": None}
    try:
        compiler = find_compiler()
        found["compiler"] = f"{' '.join(compiler.command)} ({compiler.version.splitlines()[0]})"
    except ConfigurationError as error:
        problems.append(str(error))
    try:
        found["zig"] = find_zig().version
    except ConfigurationError:
        found["zig"] = "not installed; only needed to build for other platforms"
    try:
        folder = cache_folder()
        size = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
        found["cache"] = {"folder": str(folder), "megabytes": round(size / 1e6, 1)}
    except ConfigurationError as error:
        problems.append(str(error))
    return {
        **found,
        "platform": native_platform(),
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "versions": {name: version(name) for name in VERSIONED},
        "commit": commit(),
        "problems": problems,
    }
