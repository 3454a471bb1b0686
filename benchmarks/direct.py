"""An FMU called directly: through FMPy, or by a bare loop in C that is given its functions' addresses."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Self

from fmpy.fmi2 import FMU2Slave
from fmpy.model_description import read_model_description

from fmus.archive import unpack

FUNCTIONS = ("DoStep", "SetReal", "SetInteger", "SetBoolean", "GetReal", "GetInteger", "GetBoolean")
REFERENCES = ("reals_in", "integers_in", "booleans_in", "reals", "integers", "booleans")


class Fmu(ctypes.Structure):
    """What bare.c knows of an FMU."""

    _fields_ = [
        *((name, ctypes.c_void_p) for name in ("instance", *FUNCTIONS)),
        *((name, ctypes.POINTER(ctypes.c_uint32)) for name in REFERENCES),
        *((f"n_{name}", ctypes.c_size_t) for name in REFERENCES),
    ]


class DirectFmu:
    """An FMI 2.0 Co-Simulation FMU, loaded from the folder that ours is loaded from; `slave` is FMPy's.

    The value references of the inputs and outputs named stand in `reals_in` and so on, by type, in the order given;
    enumerations are among the integers. `variables` are all there are, as FMPy describes them, by name.
    """

    def __init__(self, path: Path, inputs: Sequence[str], outputs: Sequence[str]) -> None:
        folder = str(unpack(path).folder)
        description = read_model_description(folder)
        self.variables = {variable.name: variable for variable in description.modelVariables}

        def references(names: Sequence[str], *types: str) -> list[int]:
            found = [self.variables[name] for name in names]
            return [variable.valueReference for variable in found if variable.type in types]

        self.reals_in, self.reals = references(inputs, "Real"), references(outputs, "Real")
        self.integers_in = references(inputs, "Integer", "Enumeration")
        self.integers = references(outputs, "Integer", "Enumeration")
        self.booleans_in, self.booleans = references(inputs, "Boolean"), references(outputs, "Boolean")
        self.slave = FMU2Slave(
            guid=description.guid,
            unzipDirectory=folder,
            modelIdentifier=description.coSimulation.modelIdentifier,
            instanceName=description.modelName,
        )
        self._running = False

    def start(self, value: float = 0.0) -> Self:
        """A fresh instance, initialised at 0 s with all inputs at a value and the FMU's own start values."""
        self._free()
        self.slave.instantiate()
        self.slave.setupExperiment(startTime=0.0)
        self.slave.enterInitializationMode()
        self.set(
            [value] * len(self.reals_in), [int(value)] * len(self.integers_in), [bool(value)] * len(self.booleans_in)
        )
        self.slave.exitInitializationMode()
        self._running = True
        return self

    def set(self, reals: Sequence[float], integers: Sequence[int] = (), booleans: Sequence[bool] = ()) -> None:
        """Set the inputs, those of each type in one call."""
        if reals:
            self.slave.setReal(self.reals_in, reals)
        if integers:
            self.slave.setInteger(self.integers_in, integers)
        if booleans:
            self.slave.setBoolean(self.booleans_in, booleans)

    def for_c(self) -> Fmu:
        """The running instance as bare.c takes it; valid until the next start."""

        def address(name: str) -> Any:
            return ctypes.cast(getattr(self.slave.dll, f"fmi2{name}"), ctypes.c_void_p)

        lists = [getattr(self, name) for name in REFERENCES]
        return Fmu(
            self.slave.component,
            *(address(name) for name in FUNCTIONS),
            *((ctypes.c_uint32 * len(references))(*references) for references in lists),
            *(len(references) for references in lists),
        )

    def close(self) -> None:
        """Free the instance and let go of the library."""
        self._free()
        self.slave.freeLibrary()

    def _free(self) -> None:
        if self._running:
            self.slave.terminate()
            # FMPy's freeInstance unloads the library too, which is wanted again at the next start.
            self.slave.fmi2FreeInstance(self.slave.component)
            self._running = False
