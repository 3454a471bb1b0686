"""Standard drive cycles, read from the data of the package fastsim without importing it."""

from __future__ import annotations

from importlib import metadata
from pathlib import Path

from harness.tablefile import TableError, Vector, open_table

PACKAGE = "fastsim"
_FOLDER = "fastsim/resources/cycles"
_FILES = {"WLTC": "wltc_3b.csv", "UDDS": "udds.csv", "HWFET": "hwfet.csv", "US06": "us06.csv"}
# It wants a NumPy older than FMPy does: no extra can bring it, and nothing of it is run.
_INSTALL = "pip install --no-deps 'fastsim<3'"


def read_cycle(name: str) -> tuple[Vector, Vector]:
    """Times [s] and speeds [m/s] of a cycle by name, both of shape (n,).

    WLTC is that of class 3b, UN GTR 15 annex 1; UDDS, HWFET and US06 are EPA's, 40 CFR parts 86 and 600.

    Raises TableError: the package is not installed, or it is one without the cycle.
    """
    path = _located(name)
    if path is None:
        raise TableError(f"wants the data of the package {PACKAGE} 2, which is not installed: {_INSTALL}")
    table = open_table(path, ("cycSecs", "cycMps"))
    return table.column("cycSecs").values, table.column("cycMps").values


def cycles_version() -> str:
    """The package that the cycles come from and its version; empty where it is not installed."""
    try:
        return f"{PACKAGE} {metadata.version(PACKAGE)}"
    except metadata.PackageNotFoundError:
        return ""


def _located(name: str) -> Path | None:
    try:
        path = Path(str(metadata.distribution(PACKAGE).locate_file(f"{_FOLDER}/{_FILES[name]}")))
    except metadata.PackageNotFoundError:
        return None
    return path if path.is_file() else None
