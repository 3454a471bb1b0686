"""FMUs that come as C sources: built for this platform by the project's compiler, once, into the cache."""

from __future__ import annotations

import hashlib
import importlib.util
import os
import re
import shlex
import subprocess
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from fmus.component import ConfigurationError
from fmus.toolchain import CompileError, Compiler, cache_folder, find_compiler, library_suffix

if TYPE_CHECKING:
    from fmus.description import FmuDescription

# As fmus.toolchain has them, but for C of any year, and with names left open that the sources do not export.
_FLAGS = ("-O2", "-std=gnu11", "-fno-math-errno", "-ffp-contract=off", "-DNDEBUG", "-w")
_STANDARD = re.compile(r"C(89|90|95|99|11|17|18|23)?$")
_NAME = re.compile(r"[A-Za-z_]\w*$")


@dataclass(frozen=True)
class SourceSet:
    """Files that are compiled in one way; paths are relative to the FMU's folder `sources`."""

    files: tuple[str, ...]
    definitions: tuple[tuple[str, str], ...] = ()
    includes: tuple[str, ...] = ()
    language: str = ""


@dataclass(frozen=True)
class Build:
    """What an FMU says of how one of its libraries is built."""

    identifier: str
    sets: tuple[SourceSet, ...]
    libraries: tuple[str, ...] = ()

    def refusal(self, folder: Path) -> str:
        """Why it cannot be built here from the sources in the FMU at `folder`; empty where nothing is known."""
        if self.libraries:
            return f"its sources want the libraries {', '.join(self.libraries)}, which are not linked"
        for part in self.sets:
            if part.language and not _STANDARD.match(part.language):
                return f"its sources are in {part.language}; C is built"
            for file in part.files:
                path = _inside(folder, file)
                if path is None or not path.is_file():
                    return f"its sources lack the file {file}"
                if path.suffix.lower() != ".c":
                    return f"its source {file} is no C; C is built"
            for name, _ in part.definitions:
                if not _NAME.match(name):
                    return f"its build description defines {name!r}, which is no name"
        if not any(part.files for part in self.sets):
            return "its sources do not say which files to build"
        try:
            find_compiler()
        except ConfigurationError as error:
            return f"it comes as sources, and there is {error}"
        return ""


def built_library(description: FmuDescription) -> Path:
    """The library built from the FMU's sources; from the cache where the same FMU was built before.

    Raises ConfigurationError: it has no sources that can be built; CompileError: the compiler refused them.
    """
    build = description.build
    if build is None:
        raise ConfigurationError("it has neither a library for this platform nor sources")
    refusal = build.refusal(description.folder)
    if refusal:
        raise ConfigurationError(refusal)
    compiler = find_compiler()
    key = "\n".join([description.sha256, repr(build), description.fmi_version, compiler.version, *_FLAGS])
    digest = hashlib.sha256(key.encode()).hexdigest()
    library = cache_folder() / "libraries" / f"{digest}{library_suffix()}"
    if library.exists():
        return library
    library.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=library.parent, prefix="build-", ignore_cleanup_errors=True) as scratch:
        made = _make(compiler, build, description, Path(scratch))
        try:
            os.replace(made, library)
        except PermissionError:  # Windows: another process has it in use, so the same is already there
            if not library.exists():
                raise
    return library


def _make(compiler: Compiler, build: Build, description: FmuDescription, scratch: Path) -> Path:
    """Each file to an object, all objects to one library, in the folder `scratch`."""
    objects: list[str] = []
    pic = () if library_suffix() == ".dll" else ("-fPIC",)
    for part in build.sets:
        options = [*_FLAGS, *pic, *_definitions(part, description), *_includes(part, description.folder)]
        for file in part.files:
            objects.append(f"unit{len(objects)}.o")
            path = _inside(description.folder, file)
            _run([*compiler.command, *options, "-c", str(path), "-o", objects[-1]], scratch)
    library = f"library{library_suffix()}"
    _run([*compiler.command, "-shared", *objects, "-o", library, *(("-lm",) if pic else ())], scratch)
    return scratch / library


def _definitions(part: SourceSet, description: FmuDescription) -> list[str]:
    """What the build description defines; and of FMI 1 and 2 the names that functions have in a shared library."""
    given = [f"-D{name}={value}" if value else f"-D{name}" for name, value in part.definitions]
    if description.fmi_version.startswith("1"):
        return [*given, f"-DMODEL_IDENTIFIER={description.model_identifier}"]
    return [*given, "-DFMI2_OVERRIDE_FUNCTION_PREFIX", "-DFMI3_OVERRIDE_FUNCTION_PREFIX"]


def _includes(part: SourceSet, folder: Path) -> list[str]:
    """The folder of the sources, what the description adds, and last the headers of the standards from FMPy."""
    places = [folder / "sources"]
    places += [path for name in part.includes if (path := _inside(folder, name)) is not None]
    found = importlib.util.find_spec("fmpy")
    if found is not None and found.origin is not None:
        places.append(Path(found.origin).parent / "c-code")
    return [f"-I{place}" for place in places]


def _inside(folder: Path, name: str) -> Path | None:
    """The place of a source; None where its name leads out of the FMU."""
    path = (folder / "sources" / name.replace("\\", "/")).resolve()
    return path if path.is_relative_to(folder.resolve()) else None


def _run(command: Sequence[str], folder: Path) -> None:
    result = subprocess.run(
        command,
        cwd=folder,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        errors="replace",
        check=False,
    )
    if result.returncode:
        raise CompileError(f"building its sources: {shlex.join(command)} ended so:\n{result.stdout.strip()}")
