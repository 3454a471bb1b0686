"""The engines that step a set-up in this process: the bare C loop, FMPy's calls, and its simulate_fmu."""

from __future__ import annotations

import ctypes
import time
from pathlib import Path

import numpy as np
from fmpy import simulate_fmu
from fmpy.model_description import read_model_description
from fmpy.simulation import instantiate_fmu

from benchmarks.direct import Fmu
from benchmarks.ours import OurLoop
from benchmarks.setups import RPM, Setup
from fmus.archive import unpack
from fmus.toolchain import compile_shared


def bare_library() -> ctypes.CDLL:
    """The loops of bare.c."""
    return ctypes.CDLL(str(compile_shared((Path(__file__).parent / "bare.c").read_text())))


class BareLoop:
    """A set-up in C with order, places and units written into it; each call returns the seconds that one step took.

    It calls the functions of the same FMUs, and the same step functions of source and sensor, whose work is not the
    loop's. It gets outputs right into its rows and looks at statuses once an instant. It times no part and does not
    look for what is not finite. `rows` are those of the last call, as ours has them.
    """

    def __init__(self, setup: Setup, ours: OurLoop) -> None:
        self._setup, self._ours = setup, ours
        self._fmus = setup.direct()
        self._run = getattr(bare_library(), setup.bare)
        self.rows = np.zeros_like(ours.rows)

    def __call__(self) -> float:
        """From the first instant to the last, parts started and rows allocated before."""
        steps = self._setup.steps
        tables = (Fmu * len(self._fmus))(*(fmu.start(self._setup.before).for_c() for fmu in self._fmus))
        natives = self._ours.natives(self._setup.natives)
        numbers = (ctypes.c_int64(steps), ctypes.c_double(self._setup.step), ctypes.c_double(RPM))
        rows = ctypes.c_void_p(self.rows.ctypes.data)
        begin = time.process_time()
        status = self._run(tables, natives, *numbers, rows)
        elapsed = time.process_time() - begin
        if status:
            raise RuntimeError(f"the bare loop ended in the status {status}")
        return elapsed / steps

    def close(self) -> None:
        """Let go of the FMUs."""
        for fmu in self._fmus:
            fmu.close()


class FmpyCalls:
    """A set-up in Python with FMPy's calls, order and units written into it; each call returns seconds a step.

    `rows` are those of the last call, as ours has them.
    """

    def __init__(self, setup: Setup, columns: int) -> None:
        self._setup = setup
        self._fmus = setup.direct()
        self.rows = np.zeros((setup.steps, columns))

    def __call__(self) -> float:
        """From the first instant to the last, FMUs started and rows allocated before."""
        driving = self._setup.driving()
        fmus = [fmu.start(self._setup.before) for fmu in self._fmus]
        begin = time.process_time()
        self._setup.through_fmpy(fmus, driving, self._setup.step, self.rows)
        return (time.process_time() - begin) / self._setup.steps

    def close(self) -> None:
        """Let go of the FMUs."""
        for fmu in self._fmus:
            fmu.close()


class SimulateFmu:
    """FMPy's simulate_fmu over a set-up of one FMU that nothing drives, unpacked, read and loaded before.

    `rows` are those of the last call, as ours has them.
    """

    def __init__(self, setup: Setup) -> None:
        ((part, path),) = setup.fmus.items()
        self._setup = setup
        self._outputs = [name.removeprefix(f"{part}.") for name in setup.recorded]
        self._folder = str(unpack(path).folder)
        self._description = read_model_description(self._folder)
        self._instance = instantiate_fmu(self._folder, self._description, "CoSimulation")
        self.rows = np.empty(0)

    def __call__(self) -> float:
        """A whole call, of which the set-up is no great part."""
        self._instance.reset()
        steps, step = self._setup.steps, self._setup.step
        begin = time.process_time()
        result = simulate_fmu(
            self._folder,
            stop_time=steps * step,
            output_interval=step,
            output=self._outputs,
            model_description=self._description,
            fmu_instance=self._instance,
            terminate=False,
            validate=False,
        )
        elapsed = time.process_time() - begin
        self.rows = np.column_stack([result[name] for name in self._outputs])[1:]
        return elapsed / steps

    def close(self) -> None:
        """Let go of the FMU."""
        self._instance.freeInstance()
