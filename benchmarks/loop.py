"""Measures of the step loop: beside a bare C loop over the same FMUs, and beside FMPy's calls."""

from __future__ import annotations

import ctypes
import time

import numpy as np

from benchmarks.direct import DirectFmu
from benchmarks.exported import OUTPUTS, STEP, bare_library
from benchmarks.measure import Measure, side_by_side
from fmus.export import cached_fmu
from fmus.plants import driveline
from fmus.units import parse_unit
from harness.run import StartedSystem, run
from harness.scenario import Scenario
from harness.wiring import System, wire
from observers import luenberger

ESTIMATES = ("theta_e", "omega_c", "omega_p")
TORQUE = -10.0  # N.m
JUMP = 2000  # the step from which the torque acts
DEMANDS = {"delay": "10 ms", "dwell": "100 ms", "rate": "5 1/s"}
RPM = parse_unit("rpm").factor
COLUMNS = 11
ROW = 1 + COLUMNS  # time and signals


def plant_and_two_native_parts(steps: int) -> System:
    """Source, driveline, identity sensor and observer; all their signals are recorded."""
    scenario = Scenario.model_validate(
        {
            "clock": {"time": {"step": f"{STEP} s", "stop": f"{steps * STEP} s"}},
            "parts": {
                "torque": {
                    "use": "source",
                    "unit": "N.m",
                    "step": {"at": f"{JUMP * STEP} s", "from": "0 N.m", "to": f"{TORQUE} N.m"},
                },
                "plant": {"use": "fmus.plants.driveline", "wires": {"T_eng": "torque"}},
                "encoder": {"use": "sensor", "of": "plant.y"},
                "observer": {
                    "use": "observers.luenberger",
                    "with": {"plant": "fmus.plants.driveline", "location": 2, **DEMANDS},
                    "wires": {"T_eng": "torque", "y": "encoder"},
                },
            },
        }
    )
    return wire(scenario)


def beside_bare_c(steps: int = 20_000, rounds: int = 100) -> Measure:
    """The loop from its first instant to its last, parts started and rows allocated, beside a C loop of fixed places.

    The peer calls the functions of the same two FMUs, and the same step functions of the source and the sensor, whose
    work is not the loop's. It has order, places and units written into it, no table; it gets outputs right into its
    rows, and looks at statuses once an instant. It times no part and does not look for what is not finite.

    Raises RuntimeError: the rows of the two are not equal bit for bit.
    """
    ours_rows, peer_rows = np.empty((steps, ROW)), np.empty((steps, ROW))
    plant, observer = _direct_fmus()
    bare = bare_library()
    with plant_and_two_native_parts(steps) as system:

        def ours() -> float:
            started = StartedSystem(system)
            begin = time.process_time()
            reached = started.advance(0, steps, ours_rows)
            elapsed = time.process_time() - begin
            if reached != steps:
                raise RuntimeError(f"the loop ended at instant {reached}: {started.failure}")
            return elapsed / steps

        def peer() -> float:
            tables = (plant.start().for_c(), observer.start().for_c())
            StartedSystem(system)  # starts source and sensor anew
            steps_of = {slot.name: slot.component.native() for slot in system.parts}
            natives = [ctypes.c_void_p(number) for name in ("torque", "encoder") for number in steps_of[name] or ()]
            numbers = (ctypes.c_int64(steps), ctypes.c_double(STEP), ctypes.c_double(RPM))
            rows = ctypes.c_void_p(peer_rows.ctypes.data)
            begin = time.process_time()
            status = bare.run_bare(*(ctypes.byref(table) for table in tables), *natives, *numbers, rows)
            elapsed = time.process_time() - begin
            if status:
                raise RuntimeError(f"the bare loop ended in the status {status}")
            return elapsed / steps

        times = side_by_side(ours, peer, rounds)
    _check_equal("the bare loop", ours_rows, peer_rows)
    plant.close()
    observer.close()
    return Measure("loop, plant and two native parts", *times, "bare C loop, same parts", 1.15)


def beside_fmpy(steps: int = 10_000, rounds: int = 5) -> Measure:
    """A whole run, start and allocation included, beside a Python loop that makes the same calls through FMPy.

    Raises RuntimeError: the rows of the two are not equal bit for bit.
    """
    rows = {"ours": np.empty(0), "peer": np.empty((steps, COLUMNS))}
    plant, observer = _direct_fmus()
    with plant_and_two_native_parts(steps) as system:

        def ours() -> float:
            begin = time.process_time()
            record = run(system)
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
    _check_equal("the loop through FMPy", rows["ours"], rows["peer"])
    plant.close()
    observer.close()
    return Measure("loop, plant and two native parts", *times, "FMPy's calls, same FMUs", 1 / 10)


def _direct_fmus() -> tuple[DirectFmu, DirectFmu]:
    plant = DirectFmu(cached_fmu(driveline.MODEL), ("T_eng",), OUTPUTS, ("location",))
    observer = luenberger.make("fmus.plants.driveline", location=2, delay=10e-3, dwell=0.1, rate=5.0)
    return plant, DirectFmu(cached_fmu(observer), ("y", "T_eng"), ESTIMATES, ("location",))


def _step_through_fmpy(plant: DirectFmu, observer: DirectFmu, rows: np.ndarray) -> None:
    for k in range(len(rows)):
        t = k * STEP
        torque = TORQUE if k >= JUMP else 0.0
        plant.slave.setReal(plant.inputs, [torque])
        plant.slave.doStep(t, STEP)
        theta_e, omega_c, omega_p, y = plant.slave.getReal(plant.outputs)
        (location,) = plant.slave.getInteger(plant.integers)
        y = RPM * y
        observer.slave.setReal(observer.inputs, [y / RPM, torque])
        observer.slave.doStep(t, STEP)
        estimates = observer.slave.getReal(observer.outputs)
        (found,) = observer.slave.getInteger(observer.integers)
        rows[k] = torque, theta_e, omega_c, omega_p, y, location, y, *estimates, found


def _check_equal(peer: str, ours: np.ndarray, theirs: np.ndarray) -> None:
    if not np.array_equal(ours, theirs):
        apart = float(np.abs(ours - theirs).max())
        raise RuntimeError(f"the rows of {peer} are not ours: {apart:.3g} apart, so their times say nothing")
