"""Measures of the exported driveline: beside the same method written by hand in C, and beside PythonFMU in the loop."""

from __future__ import annotations

import ctypes
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.direct import DirectFmu
from benchmarks.inprocess import bare_library
from benchmarks.measure import Measure, side_by_side
from benchmarks.ours import OurLoop
from fmus.export import cached_fmu
from fmus.plants.driveline import MODEL
from fmus.toolchain import compile_shared

HERE = Path(__file__).parent
STEP = 1e-3  # s, the step of the exported RK4 too: one RK4 step a communication step
OUTPUTS = ("theta_e", "omega_c", "omega_p", "y")
PARAMETERS = ("tau", "J_e", "J_v", "B_e", "b_sm", "k", "k_1", "theta_e0", "theta_1")
# The trajectories of two programs with one method differ by rounding, and by where the bisections stop.
SAME = 1e-9


class _Driveline(ctypes.Structure):
    _fields_ = [
        *((name, ctypes.c_double) for name in (*PARAMETERS, "theta_e", "omega_c", "omega_p")),
        ("location", ctypes.c_int),
    ]


def beside_handwritten_c(steps: int = 20_000, rounds: int = 100) -> Measure:
    """The FMU's step, with its input set and its outputs got, beside the same step as one C function.

    The torque jumps between -10 and 10 N.m every second, so that crossings of both angles are located too.
    """
    bare = bare_library()
    by_hand = ctypes.CDLL(str(compile_shared((HERE / "driveline.c").read_text())))
    torque = np.where(np.arange(steps) * STEP % 2.0 < 1.0, -10.0, 10.0)
    rows = {"ours": np.zeros((steps, 5)), "peer": np.zeros((steps, 5))}
    fmu = DirectFmu(cached_fmu(MODEL), ("T_eng",), (*OUTPUTS, "location"))
    start = {signal.name: float(signal.start) for signal in MODEL.parameters}

    def ours() -> float:
        table = fmu.start().for_c()
        begin = time.process_time()
        status = bare.step_driveline_fmu(ctypes.byref(table), *_arguments(steps, torque, rows["ours"]))
        return _checked(status, begin, steps)

    def peer() -> float:
        state = _Driveline(**start, location=3)
        function = ctypes.cast(by_hand.driveline_step, ctypes.c_void_p)
        begin = time.process_time()
        status = bare.step_driveline_c(function, ctypes.byref(state), *_arguments(steps, torque, rows["peer"]))
        return _checked(status, begin, steps)

    times = side_by_side(ours, peer, rounds)
    fmu.close()
    _check_same("hand-written C", rows["ours"], rows["peer"])
    return Measure("exported FMU step", *times, "hand-written C, same RK4", 1.3)


def beside_pythonfmu(rounds: int = 20) -> Measure:
    """The driveline in the platform's step loop, as our native FMU and as an FMU that PythonFMU made."""
    with tempfile.TemporaryDirectory() as folder:
        twin = _build_twin(Path(folder))
        # PythonFMU declares no units.
        with _driven("fmus.plants.driveline", "N.m", 20_000) as ours, _driven(str(twin), "", 2_000) as peer:
            times = side_by_side(ours, peer, rounds)
            compared = min(len(ours.rows), len(peer.rows))
            _check_same("PythonFMU", ours.rows[:compared], peer.rows[:compared])
    return Measure("exported FMU in the loop", *times, "PythonFMU, same equations", 1 / 50)


def _driven(use: str, unit: str, steps: int) -> OurLoop:
    """The plant in the loop with the torque's step as its source; theta_e and omega_c are recorded."""
    jump = {"at": "0.5 s", "from": f"0 {unit}", "to": f"-10 {unit}"}
    parts = {
        "torque": {"use": "source", "unit": unit, "step": jump},
        "plant": {"use": use, "wires": {"T_eng": "torque"}},
    }
    return OurLoop(parts, STEP, steps, ["plant.theta_e", "plant.omega_c"])


def _build_twin(folder: Path) -> Path:
    source = HERE / "pythonfmu_twin.py"
    command = [sys.executable, "-m", "pythonfmu", "build", "-f", str(source), "-d", str(folder)]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return next(folder.glob("*.fmu"))


def _arguments(steps: int, torque: np.ndarray, rows: np.ndarray) -> tuple[object, ...]:
    pointers = (ctypes.c_void_p(torque.ctypes.data), ctypes.c_void_p(rows.ctypes.data))
    return (ctypes.c_int64(steps), ctypes.c_double(STEP), *pointers)


def _checked(status: int, begin: float, steps: int) -> float:
    elapsed = time.process_time() - begin
    if status:
        raise RuntimeError(f"a bare loop ended in the status {status}")
    return elapsed / steps


def _check_same(peer: str, ours: np.ndarray, theirs: np.ndarray) -> None:
    """Raises RuntimeError: ours and the peer did not compute the same trajectory, so their times say nothing."""
    scale = np.abs(ours).max(axis=0)
    apart = float((np.abs(ours - theirs).max(axis=0) / scale).max())
    if not apart < SAME:
        raise RuntimeError(f"{peer} is {apart:.3g} of a signal's size away from ours, wanted less than {SAME:g}")
