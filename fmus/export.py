"""Export a model as a native FMU: no Python inside, FMI 2.0 or 3.0, Model Exchange and Co-Simulation."""

from __future__ import annotations

import io
import re
import zipfile
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path

from fmus.codegen import RUNTIME, model_source, token
from fmus.component import ConfigurationError
from fmus.interface import Interface, interface
from fmus.manifest import build_description, fmi2_description, fmi3_description
from fmus.model import Model
from fmus.toolchain import FMI3_PLATFORMS, PLATFORMS, cache_folder, compile_shared, library_suffix, platform_name
from fmus.tracing import trace
from fmus.whole import write_whole

_EPOCH = (1980, 1, 1, 0, 0, 0)  # the earliest time a zip can hold: the same model gives the same bytes


def build_fmu(
    model: Model,
    path: Path | str,
    fmi: int = 2,
    platforms: Sequence[str] = ("native",),
    overrides: Mapping[str, float] | None = None,
) -> Path:
    """The FMU of `model` at `path`, with a binary for each platform and the sources.

    `fmi` is 2 or 3. `platforms` are names of `toolchain.PLATFORMS`, `native` or `all`. `overrides`
    replaces start values by the name of the scalar, in declared units.

    Raises ModelError: the model cannot be traced; ConfigurationError: unknown FMI version or
    platform, no compiler, or the compiler refused.
    """
    if fmi not in (2, 3):
        raise ConfigurationError(f"fmi wants 2 or 3, got {fmi}")
    path = Path(path)
    content = _archive(model, fmi, _platforms(platforms), overrides or {})
    write_whole(path, content)
    return path


def cached_fmu(model: Model, fmi: int = 2) -> Path:
    """The FMU of `model` for this machine, built once for each content and kept in the cache.

    Raises as `build_fmu`.
    """
    source, description, _, _ = _texts(model, fmi, {})
    key = token(source + description).strip("{}")
    path = cache_folder() / "fmus" / f"{model.name}-{key}-fmi{fmi}.fmu"
    if not path.exists():
        build_fmu(model, path, fmi)
    return path


def model_identifier(name: str) -> str:
    """The name as a C identifier, which is what FMI wants of a model identifier."""
    cleaned = re.sub(r"\W", "_", name, flags=re.ASCII)
    return cleaned if re.match(r"[A-Za-z_]", cleaned) else f"_{cleaned}"


def _platforms(wanted: Sequence[str]) -> list[str]:
    names = []
    for name in wanted:
        names += list(PLATFORMS) if name == "all" else [name]
    resolved: dict[str, str] = {}
    for name in names:
        folder = platform_name(name)
        if folder not in resolved or name == "native":
            resolved[folder] = name
    return list(resolved.values())


def _texts(model: Model, fmi: int, overrides: Mapping[str, float]) -> tuple[str, str, str, Interface]:
    traced = trace(model)
    found = interface(traced, overrides)
    source, guid = model_source(traced, found, fmi)
    identifier = model_identifier(model.name)
    describe = fmi2_description if fmi == 2 else fmi3_description
    return source, describe(found, identifier, guid, version("crankbench")), identifier, found


def _archive(model: Model, fmi: int, platforms: Sequence[str], overrides: Mapping[str, float]) -> bytes:
    source, description, identifier, _ = _texts(model, fmi, overrides)
    files = {"modelDescription.xml": description.encode(), "sources/model.c": source.encode()}
    for runtime in sorted(RUNTIME.glob("*.[ch]")):
        if runtime.name not in ("fmi2.c", "fmi3.c") or runtime.name == f"fmi{fmi}.c":
            files[f"sources/{runtime.name}"] = runtime.read_bytes()
    if fmi == 3:
        files["sources/buildDescription.xml"] = build_description(identifier).encode()
    for platform in platforms:
        library = compile_shared(source, includes=[RUNTIME], platform=platform)
        name = platform_name(platform)
        folder = name if fmi == 2 else FMI3_PLATFORMS.get(name, name)
        files[f"binaries/{folder}/{identifier}{library_suffix(name)}"] = library.read_bytes()
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            entry = zipfile.ZipInfo(name, _EPOCH)
            entry.compress_type = zipfile.ZIP_DEFLATED
            entry.external_attr = (0o755 if name.startswith("binaries/") else 0o644) << 16
            archive.writestr(entry, content)
    return buffer.getvalue()
