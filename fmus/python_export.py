"""Export a model that cannot be traced into C: an FMU with Python inside, packed by PythonFMU."""

from __future__ import annotations

import importlib
import importlib.util
import os
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Mapping
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

from fmus.codegen import token
from fmus.component import ConfigurationError
from fmus.interface import Interface, declared_interface, with_starts
from fmus.interface import interface as traced_interface
from fmus.manifest import python_description
from fmus.model import Model
from fmus.tracing import TraceError, trace
from fmus.whole import write_whole

_SCRIPT = '''"""The slave of {name}: its equations are imported from the installed packages."""
from fmus.interface import with_starts
from fmus.python_slave import ModelSlave
from {module} import {attribute} as MODEL


class {identifier}(ModelSlave):
    model = MODEL

    def __init__(self, **options):
        super().__init__(**options)
        for variable, value in {starts!r}.items():
            self.values[self._reference(variable)] = value
'''


def build_python_fmu(
    module: str, attribute: str, path: Path | str, overrides: Mapping[str, float] | None = None
) -> Path:
    """The FMU (2.0, Co-Simulation) at `path` of the Model that an importable module holds.

    It runs where PythonFMU's loader finds a Python with this package and that module.
    `overrides` replaces start values by the name of the scalar, in declared units.

    Raises ConfigurationError: PythonFMU is not installed; ModelError: an override names no variable.
    """
    if importlib.util.find_spec("pythonfmu") is None:
        raise ConfigurationError("an FMU with Python inside wants PythonFMU: pip install pythonfmu")
    from fmus.export import model_identifier

    model: Model = getattr(importlib.import_module(module), attribute)
    identifier = model_identifier(model.name)
    starts = dict(overrides or {})
    interface = with_starts(_interface(model), starts)
    script = _SCRIPT.format(name=model.name, module=module, attribute=attribute, identifier=identifier, starts=starts)
    path = Path(path)
    with tempfile.TemporaryDirectory() as folder:
        # Python knows a module by its name: two FMUs in one process must not share it unless they are the same.
        source = Path(folder) / f"{identifier}_{token(script)[1:9]}.py"
        source.write_text(script)
        packed = _pack(source, module)
        described = python_description(interface, identifier, token(script), version("crankbench"))
        replaced = Path(folder) / "described.fmu"
        with zipfile.ZipFile(packed) as old, zipfile.ZipFile(replaced, "w", zipfile.ZIP_DEFLATED) as new:
            for entry in old.infolist():
                content = old.read(entry)
                new.writestr(entry.filename, described if entry.filename == "modelDescription.xml" else content)
        write_whole(path, replaced.read_bytes())
    return path


def _pack(source: Path, module: str) -> Path:
    """The FMU that PythonFMU packs of a script, in a process of its own: it imports the script to read its variables.

    Raises ConfigurationError: PythonFMU refused; the message is its own.
    """
    command = [sys.executable, "-m", "pythonfmu", "build", "-f", str(source), "-d", str(source.parent)]
    # The packages and the module are found where this process found them, and nothing else that it gathered since.
    found = [_folder_of(name.partition(".")[0]) for name in (__name__, module)]
    paths = os.pathsep.join([*dict.fromkeys(found), os.environ.get("PYTHONPATH", "")]).rstrip(os.pathsep)
    done = subprocess.run(command, env={**os.environ, "PYTHONPATH": paths}, capture_output=True, text=True, check=False)
    made = next(iter(sorted(source.parent.glob("*.fmu"))), None)
    if done.returncode or made is None:
        raise ConfigurationError(f"PythonFMU cannot pack {module}: {done.stderr.strip() or done.stdout.strip()}")
    return made


def _folder_of(name: str) -> str:
    """The folder that a module or package of that name lies in."""
    spec = importlib.util.find_spec(name)
    if spec is None:
        raise ConfigurationError(f"no module is named '{name}'")
    if spec.submodule_search_locations:
        return str(Path(next(iter(spec.submodule_search_locations))).resolve().parent)
    return str(Path(spec.origin or "").resolve().parent)


def _interface(model: Model) -> Interface:
    """The variables as declared, with what each depends on as far as that can be known.

    Of a model that cannot be traced, only that a state depends on no input at once.
    """
    declared = declared_interface(model)
    try:
        known = [variable.dependencies for variable in traced_interface(trace(model)).variables]
    except TraceError:
        states = set(declared.block("X"))
        known = [(reference,) if reference in states else None for reference in range(len(declared.variables))]
    variables = (replace(v, dependencies=found) for v, found in zip(declared.variables, known, strict=True))
    return replace(declared, variables=tuple(variables))
