"""The key of a case: a hash of all that determines its bytes."""

from __future__ import annotations

import ast
import hashlib
import importlib.util
import json
import re
from collections.abc import Iterable
from functools import cache
from importlib import metadata
from importlib.machinery import PathFinder
from pathlib import Path

from fmus.toolchain import find_compiler, native_platform
from harness.cycles import cycles_version
from harness.scenario import ModelPart, Part, Scenario
from harness.sourcepart import FiledTable, ReplayPart, SourcePart

ROOT = Path(__file__).resolve().parent.parent
# Modules that every case passes through, besides its parts' own; C sources of these packages go along.
COMMON = ("harness.run", "harness.wiring", "harness.record", "fmus.export", "fmus.fmu")
_MODULE = re.compile(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)+$")
NATIVE_FOLDERS = ("fmus", "harness")


def case_key(scenario: Scenario, experiment: str, folder: Path) -> str:
    """First 16 hex digits of the sha256 over the scenario, its experiment, the parts' content and the tools' versions.

    The content of a part is its FMU file, or its module with everything that imports from the same packages; of a
    source or replay it is the file it is read from, or the package its drive cycle comes from.
    `folder` is where relative paths start. Metrics are no part of it: they are measured again from the record.
    """
    written = scenario.model_dump(mode="json", by_alias=True)
    for part in written["parts"].values():
        if part["use"].endswith(".fmu"):
            part["use"] = Path(part["use"]).name  # its content counts, not where it lies
        for named in (part, part.get("table") or {}):
            if "file" in named:
                named["file"] = Path(named["file"]).name
    content = {
        "scenario": written,
        "experiment": experiment,
        "parts": {name: _content(part, folder) for name, part in scenario.parts.items()},
        "common": _sources_digest(COMMON),
        "versions": _versions(),
    }
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]


def _content(part: Part, folder: Path) -> str:
    """What a part is besides what the scenario says of it."""
    if isinstance(part, ReplayPart):
        return _file_content(folder / part.file)
    if isinstance(part, SourcePart):
        if isinstance(part.table, FiledTable):
            return _file_content(folder / part.table.file)
        return cycles_version() if part.cycle is not None else ""
    if not isinstance(part, ModelPart):
        return ""
    if part.use.endswith(".fmu"):
        return _file_content(folder / part.use)
    modules = [part.use.partition(":")[0], *filter(_source, _names_in(part.settings))]
    return _sources_digest(tuple(modules))


def _file_content(path: Path) -> str:
    """The digest of a file, and the version of what reads it where that is no package of every case."""
    if not path.is_file():
        return "missing"
    reader = f" asammdf {_version('asammdf')}" if path.suffix.lower() == ".mf4" else ""
    return _file_digest(path, path.stat().st_mtime_ns) + reader


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "missing"


def _names_in(settings: object) -> list[str]:
    """The texts in a part's settings that read like a module's name: an observer may be made from its plant."""
    if isinstance(settings, dict):
        return [name for value in settings.values() for name in _names_in(value)]
    return [settings] if isinstance(settings, str) and _MODULE.match(settings) else []


@cache
def _versions() -> dict[str, str]:
    """What else the numbers of a record may depend on: the packages that compute, the C compiler and the platform."""
    packages = {name: metadata.version(name) for name in ("crankbench", "casadi", "fmpy", "numpy", "scipy", "pyarrow")}
    return {**packages, "compiler": find_compiler().version, "platform": native_platform()}


@cache
def _file_digest(path: Path, modified: int) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


@cache
def _sources_digest(modules: tuple[str, ...]) -> str:
    """Sha256 over the modules' sources, those they import from their own packages or ours, and all C sources."""
    files = _closure(modules)
    natives = sorted(
        path for folder in NATIVE_FOLDERS for suffix in ("*.c", "*.h") for path in (ROOT / folder).rglob(suffix)
    )
    digest = hashlib.sha256()
    for name, path in [*files, *((str(path.relative_to(ROOT)), path) for path in natives)]:
        digest.update(name.encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()


def _closure(modules: Iterable[str]) -> list[tuple[str, Path]]:
    """(module name, source file) of the modules and of all they import, within the packages they belong to."""
    waiting = list(modules)
    packages = {"fmus", "harness", "observers", "selection"} | {name.partition(".")[0] for name in waiting}
    found: dict[str, Path] = {}
    while waiting:
        name = waiting.pop()
        path = None if name in found else _source(name)
        if path is None:
            continue
        found[name] = path
        inside = [*_imports(path, name), name.rpartition(".")[0]]
        waiting += [other for other in inside if other.partition(".")[0] in packages]
    return sorted(found.items())


@cache
def _source(name: str) -> Path | None:
    """The Python source of a module, found without importing it; None where there is none."""
    head, *rest = name.split(".")
    try:
        spec = importlib.util.find_spec(head)
    except ValueError:
        return None
    full = head
    for step in rest:
        if spec is None or spec.submodule_search_locations is None:
            return None
        full = f"{full}.{step}"
        spec = PathFinder.find_spec(full, spec.submodule_search_locations)
    origin = spec.origin if spec is not None else None
    return Path(origin) if origin is not None and origin.endswith(".py") else None


@cache
def _imports(path: Path, module: str) -> tuple[str, ...]:
    """The modules that a source file imports, `from x import y` as both x and x.y."""
    try:
        tree = ast.parse(path.read_bytes())
    except SyntaxError:
        return ()
    names: list[str] = []
    package = module if path.name == "__init__.py" else module.rpartition(".")[0]
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                parents = package.split(".")[: len(package.split(".")) - node.level + 1]
                base = ".".join([*parents, base] if base else parents)
            names += [base, *(f"{base}.{alias.name}" for alias in node.names)]
    return tuple(names)


def forget_sources() -> None:
    """Read all sources anew: a process reads each once otherwise."""
    for cached in (_source, _imports, _sources_digest):
        cached.cache_clear()
