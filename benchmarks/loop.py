"""Measures of the step loop: beside a bare C loop over the same FMUs, and beside FMPy's calls."""

from __future__ import annotations

import ctypes
import time

import numpy as np

from benchmarks.direct import DirectFmu, Fmu
from benchmarks.exported import OUTPUTS, STEP, bare_library
from benchmarks.measure import Measure, side_by_side
from benchmarks.ours import OurLoop
from fmus.export import cached_fmu
from fmus.plants import driveline
from fmus.units import parse_unit
from harness.run import run
from observers import luenberger

ESTIMATES = ("theta_e", "omega_c", "omega_p")
TORQUE = -10.0  # N.m
JUMP = 2000  # the step from which the torque acts
DEMANDS = {"delay": "10 ms", "dwell": "100 ms", "rate": "5 1/s"}
RPM = parse_unit("rpm").factor


def plant_and_two_native_parts(steps: int) -> OurLoop:
    """Source, driveline, identity sensor and observer; all their signals are recorded."""
    step = {"at": f"{JUMP * STEP} s", "from": "0 N.m", "to": f"{TORQUE} N.m"}
    parts = {
        "torque": {"use": "source", "unit": "N.m", "step": step},
        "plant": {"use": "fmus.plants.driveline", "wires": {"T_eng": "torque"}},
        "encoder": {"use": "sensor", "of": "plant.y"},
        "observer": {
            "use": "observers.luenberger",
            "with": {"plant": "fmus.plants.driveline", "location": 2, **DEMANDS},
            "wires": {"T_eng": "torque", "y": "encoder"},
        },
    }
    return OurLoop(parts, STEP, steps)


def beside_bare_c(steps: int = 20_000, rounds: int = 100) -> Measure:
    """The loop from its first instant to its last, parts started and rows allocated, beside a C loop of fixed places.

    The peer calls the functions of the same two FMUs, and the same step functions of the source and the sensor, whose
    work is not the loop's. It has order, places and units written into it, no table; it gets outputs right into its
    rows, and looks at statuses once an instant. It times no part and does not look for what is not finite.

    Raises RuntimeError: the rows of the two are not equal bit for bit.
    """
    fmus = _direct_fmus()
    bare = bare_library()
    with plant_and_two_native_parts(steps) as ours:
        peer_rows = np.empty_like(ours.rows)

        def peer() -> float:
            tables = (Fmu * 2)(*(fmu.start().for_c() for fmu in fmus))
            natives = ours.natives(("torque", "encoder"))
            numbers = (ctypes.c_int64(steps), ctypes.c_double(STEP), ctypes.c_double(RPM))
            rows = ctypes.c_void_p(peer_rows.ctypes.data)
            begin = time.process_time()
            status = bare.run_luenberger(tables, natives, *numbers, rows)
            elapsed = time.process_time() - begin
            if status:
                raise RuntimeError(f"the bare loop ended in the status {status}")
            return elapsed / steps

        times = side_by_side(ours, peer, rounds)
        check_equal("the bare loop", ours.rows, peer_rows)
    for fmu in fmus:
        fmu.close()
    return Measure("loop, plant and two native parts", *times, "bare C loop, same parts", 1.15)


def beside_fmpy(steps: int = 10_000, rounds: int = 5) -> Measure:
    """A whole run, start and allocation included, beside a Python loop that makes the same calls through FMPy.

    Raises RuntimeError: the rows of the two are not equal bit for bit.
    """
    plant, observer = _direct_fmus()
    with plant_and_two_native_parts(steps) as loop:
        rows = {"ours": loop.rows, "peer": np.empty_like(loop.rows)}

        def ours() -> float:
            begin = time.process_time()
            record = run(loop.system)
            elapsed = time.process_time() - begin
            if record.outcome != "ok":
                raise RuntimeError(f"{record.outcome}: {record.message}")
            rows["ours"] = record.values[1:]
            return elapsed / steps

        def peer() -> float:
            begin = time.process_time()
            _step_through_fmpy(plant.start(), observer.start(), rows["peer"])
            return (time.process_time() - begin) / steps

        times = side_by_side(ours, peer, rounds)
    check_equal("the loop through FMPy", rows["ours"], rows["peer"])
    plant.close()
    observer.close()
    return Measure("loop, plant and two native parts", *times, "FMPy's calls, same FMUs", 1 / 10)


def _direct_fmus() -> tuple[DirectFmu, DirectFmu]:
    plant = DirectFmu(cached_fmu(driveline.MODEL), ("T_eng",), (*OUTPUTS, "location"))
    observer = luenberger.make("fmus.plants.driveline", location=2, delay=10e-3, dwell=0.1, rate=5.0)
    return plant, DirectFmu(cached_fmu(observer), ("y", "T_eng"), (*ESTIMATES, "location"))


def _step_through_fmpy(plant: DirectFmu, observer: DirectFmu, rows: np.ndarray) -> None:
    for k in range(len(rows)):
        t = k * STEP
        torque = TORQUE if k >= JUMP else 0.0
        plant.slave.setReal(plant.reals_in, [torque])
        plant.slave.doStep(t, STEP)
        theta_e, omega_c, omega_p, y = plant.slave.getReal(plant.reals)
        (location,) = plant.slave.getInteger(plant.integers)
        y = RPM * y
        observer.slave.setReal(observer.reals_in, [y / RPM, torque])
        observer.slave.doStep(t, STEP)
        estimates = observer.slave.getReal(observer.reals)
        (found,) = observer.slave.getInteger(observer.integers)
        rows[k] = torque, theta_e, omega_c, omega_p, y, location, y, *estimates, found


def check_equal(peer: str, ours: np.ndarray, theirs: np.ndarray) -> None:
    """Raises RuntimeError: the rows are not equal bit for bit, so that the times of a peer say nothing."""
    if not np.array_equal(ours, theirs):
        apart = float(np.abs(ours - theirs).max())
        raise RuntimeError(f"the rows of {peer} are not ours: {apart:.3g} apart, so their times say nothing")
