"""An FMU called directly: through FMPy, or by a bare loop in C that is given its functions' addresses."""

from __future__ import annotations

import ctypes
import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Self

from fmpy import extract
from fmpy.fmi2 import FMU2Slave
from fmpy.model_description import read_model_description


class Fmu(ctypes.Structure):
    """What bare.c knows of an FMU."""

    _fields_ = [
        *((name, ctypes.c_void_p) for name in ("instance", "set_real", "do_step", "get_real", "get_integer")),
        *((name, ctypes.POINTER(ctypes.c_uint32)) for name in ("inputs", "outputs", "integers")),
        *((name, ctypes.c_size_t) for name in ("n_inputs", "n_outputs", "n_integers")),
    ]


class DirectFmu:
    """An FMI 2.0 Co-Simulation FMU, unpacked and loaded; `slave` is FMPy's, the references are by name."""

    def __init__(self, path: Path, inputs: Sequence[str], outputs: Sequence[str], integers: Sequence[str] = ()) -> None:
        self._folder = tempfile.mkdtemp()
        extract(str(path), self._folder)
        description = read_model_description(str(path))
        reference = {variable.name: variable.valueReference for variable in description.modelVariables}
        self.inputs, self.outputs, self.integers = (
            [reference[name] for name in names] for names in (inputs, outputs, integers)
        )
        self.slave = FMU2Slave(
            guid=description.guid,
            unzipDirectory=self._folder,
            modelIdentifier=description.coSimulation.modelIdentifier,
            instanceName=description.modelName,
        )
        self._running = False

    def start(self) -> Self:
        """A fresh instance, initialised at 0 s with the FMU's own start values."""
        self._free()
        self.slave.instantiate()
        self.slave.setupExperiment(startTime=0.0)
        self.slave.enterInitializationMode()
        self.slave.exitInitializationMode()
        self._running = True
        return self

    def for_c(self) -> Fmu:
        """The running instance as bare.c takes it; valid until the next start."""

        def address(name: str) -> Any:
            return ctypes.cast(getattr(self.slave.dll, name), ctypes.c_void_p)

        def references(values: Sequence[int]) -> Any:
            return (ctypes.c_uint32 * len(values))(*values)

        return Fmu(
            self.slave.component,
            *(address(name) for name in ("fmi2SetReal", "fmi2DoStep", "fmi2GetReal", "fmi2GetInteger")),
            *(references(values) for values in (self.inputs, self.outputs, self.integers)),
            *(len(values) for values in (self.inputs, self.outputs, self.integers)),
        )

    def close(self) -> None:
        """Free the instance, unload the library and remove what was unpacked."""
        self._free()
        self.slave.freeLibrary()
        shutil.rmtree(self._folder)

    def _free(self) -> None:
        if self._running:
            self.slave.terminate()
            # FMPy's freeInstance unloads the library too, which is wanted again at the next start.
            self.slave.fmi2FreeInstance(self.slave.component)
            self._running = False
