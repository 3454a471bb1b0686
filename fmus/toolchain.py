"""Turns C text into shared libraries: finds a compiler, cross-builds with zig, keeps results by content hash."""

from __future__ import annotations

import hashlib
import importlib.util
import os
import platform as machine
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Literal

from fmus.component import ConfigurationError

# Platforms by the folder names of FMI 2.0, with the target zig builds for. Linux binaries ask for glibc 2.17 or newer.
PLATFORMS: dict[str, str] = {
    "linux64": "x86_64-linux-gnu.2.17",
    "aarch64-linux": "aarch64-linux-gnu.2.17",
    "win64": "x86_64-windows-gnu",
    "darwin64": "x86_64-macos",
    "aarch64-darwin": "aarch64-macos",
}
# The folder names of FMI 3.0 for the same platforms.
FMI3_PLATFORMS: dict[str, str] = {
    "linux64": "x86_64-linux",
    "aarch64-linux": "aarch64-linux",
    "win64": "x86_64-windows",
    "darwin64": "x86_64-darwin",
    "aarch64-darwin": "aarch64-darwin",
}
# Contraction is off so that one source gives one trajectory on every processor; no function is expected to set errno.
FLAGS = ("-O2", "-std=c99", "-fno-math-errno", "-ffp-contract=off", "-fvisibility=hidden", "-DNDEBUG", "-shared")
_ZIG_FLAGS = ("-fno-sanitize=undefined", "-g0")
_INSTALL_ZIG = "install the one that comes as a Python package: pip install 'crankbench[zig]'"


@dataclass(frozen=True)
class Compiler:
    """A C compiler that answered: how it is called, what it calls itself, and whether it cross-builds (`zig`)."""

    command: tuple[str, ...]
    version: str
    kind: Literal["cc", "zig"]


class CompileError(ConfigurationError):
    """The compiler refused the source; the message is the compiler's."""


def find_compiler() -> Compiler:
    """The first that answers of: the CRANKBENCH_CC and CC environment variables, cc, gcc and clang on PATH, zig.

    `CRANKBENCH_CC=zig` asks for zig where there are others.

    Raises ConfigurationError: none answers, or the one that CRANKBENCH_CC names does not.
    """
    named = os.environ.get("CRANKBENCH_CC", "")
    for candidate in (named, os.environ.get("CC", ""), "cc", "gcc", "clang"):
        command = tuple(shlex.split(candidate, posix=os.name != "nt"))
        if command == ("zig",):
            return find_zig()
        path = shutil.which(command[0]) if command else None
        version = _version((path, *command[1:])) if path else ""
        if path and version:
            return Compiler((path, *command[1:]), version, "zig" if "zig" in Path(path).stem else "cc")
        if named:
            raise ConfigurationError(f"CRANKBENCH_CC names '{named}', which does not run: correct it or unset it")
    zig = _zig()
    if zig is None:
        raise ConfigurationError(f"no C compiler: cc, gcc and clang are not on PATH; {_INSTALL_ZIG}")
    return zig


def find_zig() -> Compiler:
    """The zig compiler, from the Python package `ziglang` or from PATH. Raises ConfigurationError: there is none."""
    zig = _zig()
    if zig is None:
        raise ConfigurationError(f"building for other platforms wants the zig compiler; {_INSTALL_ZIG}")
    return zig


def native_platform() -> str:
    """The name in PLATFORMS of the machine this runs on; `machine-system` where it is not among them."""
    processor = {"amd64": "x86_64", "arm64": "aarch64"}.get(machine.machine().lower(), machine.machine().lower())
    system = {"win32": "windows"}.get(sys.platform, sys.platform)
    name = f"{processor}-{system}"
    return next((fmi2 for fmi2, fmi3 in FMI3_PLATFORMS.items() if fmi3 == name), name)


def platform_name(name: str) -> str:
    """The name as PLATFORMS has it of a platform given as `native`, or by its FMI 2.0 or FMI 3.0 folder name.

    Raises ConfigurationError: it is none of these.
    """
    if name in ("native", native_platform()):
        return native_platform()
    for fmi2, fmi3 in FMI3_PLATFORMS.items():
        if name in (fmi2, fmi3):
            return fmi2
    raise ConfigurationError(f"no platform is named '{name}'; there are native, {', '.join(PLATFORMS)}")


def library_suffix(platform: str = "native") -> str:
    """The ending of a shared library on a platform: `.so`, `.dll` or `.dylib`."""
    name = platform_name(platform)
    if name.startswith("win") or name.endswith("-windows"):
        return ".dll"
    return ".dylib" if "darwin" in name else ".so"


def cache_folder() -> Path:
    """The folder that keeps what was built: CRANKBENCH_CACHE, else the user's cache folder for crankbench. It exists.

    Raises ConfigurationError: it cannot be made or written.
    """
    given = os.environ.get("CRANKBENCH_CACHE")
    folder = Path(given) if given else _user_cache() / "crankbench"
    remedy = "set CRANKBENCH_CACHE to a folder that can be written"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigurationError(f"cannot keep builds in {folder}: {error.strerror}; {remedy}") from error
    if not os.access(folder, os.W_OK):
        raise ConfigurationError(f"cannot keep builds in {folder}: it is read-only; {remedy}")
    return folder.absolute()


def compile_shared(source: str, *, includes: Sequence[Path] = (), platform: str = "native") -> Path:
    """The shared library built from one C translation unit, from the cache where the same was built before.

    The key is a hash of the source, the .c and .h files under `includes`, the flags, the compiler and the platform; the
    bytes of the result depend on nothing else, not on where the source or the cache lies. `native` is built by
    `find_compiler`; a platform by name is built by zig, so that it runs on old systems too, or by the native compiler
    where there is no zig and it is this machine's. Several processes may build the same at once.

    Raises CompileError: the compiler refused; ConfigurationError: no compiler, or an unknown platform.
    """
    name = platform_name(platform)
    compiler = _compiler_for(platform, name)
    headers = _headers(includes)
    arguments = _arguments(compiler, name, len(includes))
    suffix = library_suffix(name)
    digest = _digest(
        [
            name,
            *compiler.command[1:],
            *arguments,
            compiler.version,
            source,
            *(part for pair in headers for part in pair),
        ]
    )
    library = cache_folder() / "libraries" / f"{digest}{suffix}"
    if library.exists():
        return library
    library.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=library.parent, prefix="build-", ignore_cleanup_errors=True) as building:
        _compile(compiler, arguments, source, headers, Path(building), suffix)
        _keep(Path(building) / f"unit{suffix}", library)
    return library


def _compiler_for(asked: str, name: str) -> Compiler:
    if asked == "native":
        return find_compiler()
    if name == native_platform():
        return _zig() or find_compiler()
    return find_zig()


def _arguments(compiler: Compiler, name: str, include_count: int) -> tuple[str, ...]:
    """All that is passed to the compiler but the compiler itself, relative to the folder it builds in."""
    suffix = library_suffix(name)
    windows = suffix == ".dll"
    target = PLATFORMS.get(name, "")
    if name == native_platform() and "linux" in target and machine.libc_ver()[0] != "glibc":
        target = target.split("-gnu")[0] + "-musl"
    return (
        *(("-target", target) if compiler.kind == "zig" and target else ()),
        *FLAGS,
        *(_ZIG_FLAGS if compiler.kind == "zig" else ()),
        *(("-s",) if windows else ("-fPIC",)),  # unstripped, a DLL holds an identity that changes with the folder
        *(f"-Iinclude{i}" for i in range(include_count)),
        "unit.c",
        "-o",
        f"unit{suffix}",
        *(() if windows else ("-lm",)),
    )


def _compile(
    compiler: Compiler, arguments: Sequence[str], source: str, headers: list[tuple[str, str]], folder: Path, suffix: str
) -> None:
    for name, text in [("unit.c", source), *headers]:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8", newline="\n")
    result = subprocess.run(
        [*compiler.command, *arguments],
        cwd=folder,
        env=_zig_environment() if compiler.kind == "zig" else None,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        errors="replace",
        check=False,
    )
    if result.returncode or not (folder / f"unit{suffix}").exists():
        called = shlex.join([*compiler.command, *arguments])
        raise CompileError(f"{called} ended with status {result.returncode}:\n{result.stdout.strip()}")


def _keep(built: Path, library: Path) -> None:
    """Moves a finished library to its place: whoever sees the name sees all of it."""
    with built.open("rb+") as file:
        os.fsync(file.fileno())
    try:
        built.replace(library)
    except PermissionError:  # Windows refuses to replace a library in use: then the same bytes are already there
        if not library.exists():
            raise


def _headers(includes: Sequence[Path]) -> list[tuple[str, str]]:
    """Relative name and text of every .c and .h file under the folders, in a fixed order."""
    found = []
    for i, folder in enumerate(includes):
        if not folder.is_dir():
            raise ConfigurationError(f"no folder of headers at {folder}")
        files = sorted(path for path in folder.rglob("*") if path.suffix in (".c", ".h"))
        found += [(f"include{i}/{p.relative_to(folder).as_posix()}", p.read_text(encoding="utf-8")) for p in files]
    return found


def _digest(parts: Sequence[str]) -> str:
    digest = hashlib.sha256()
    for part in parts:
        data = part.encode()
        digest.update(len(data).to_bytes(8, "big"))
        digest.update(data)
    return digest.hexdigest()


def _zig() -> Compiler | None:
    found = shutil.which("zig")
    commands = [(sys.executable, "-m", "ziglang")] if importlib.util.find_spec("ziglang") else []
    for command in [*commands, *([(found,)] if found else [])]:
        version = _version(command, "version")
        if version:
            return Compiler((*command, "cc"), f"zig {version}", "zig")
    return None


@cache
def _version(command: tuple[str, ...], question: str = "--version") -> str:
    """What the compiler answers about itself; empty where it does not run."""
    try:
        result = subprocess.run(
            [*command, question], stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=60, check=False
        )
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return result.stdout.strip() if result.returncode == 0 else ""


def _user_cache() -> Path:
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local")
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")


def _zig_environment() -> dict[str, str]:
    """The environment for zig, whose own cache goes under ours where its usual place cannot be written."""
    environment = dict(os.environ)
    if "ZIG_GLOBAL_CACHE_DIR" not in environment:
        usual = _user_cache()
        nearest = next(folder for folder in (usual, *usual.parents) if os.path.exists(folder))
        if not os.access(nearest, os.W_OK):
            environment["ZIG_GLOBAL_CACHE_DIR"] = str(cache_folder() / "zig")
    return environment
