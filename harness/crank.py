"""The crank part: crank angle, cycle and the phase of each cylinder as signals. The arithmetic is in crank.c."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence

import numpy as np

from fmus.component import Native, Reversal, Role, Signal, StepError, Vector
from harness.clock import CrankGrid, Grid, degrees, read_tdc
from harness.findings import Findings
from harness.native import address, call, native_reversal, native_step
from harness.scenario import CrankPart


class _Crank(ctypes.Structure):
    _fields_ = [
        *((name, ctypes.c_int64) for name in ("k", "kept")),
        *((name, ctypes.c_double) for name in ("numerator", "denominator", "origin")),
        *((name, ctypes.c_int64) for name in ("measures", "residual")),
        ("cycle", ctypes.c_double),
        ("cylinders", ctypes.c_int64),
        ("tdc", ctypes.c_void_p),
    ]


class CrankComponent:
    """Angle, cycle, phase within the cycle; with a firing order the cylinder that fired last, and each one's phase.

    Counted along the clock's grid, or read off an angle `of`. `phase_i` is the angle since the firing top dead centre
    of cylinder i. On a crank clock that steers, `residual` is how far the plant's angle is ahead of the clock's.
    `tdc` are the firing top dead centres by cylinder [deg]; `cycle` [deg].
    """

    feedthrough: frozenset[tuple[str, str]]

    def __init__(self, grid: CrankGrid | None, measured: Signal | None, cycle: float, tdc: Sequence[float]) -> None:
        self.role: Role = "source" if measured is None or grid is not None else "sensor"
        self.inputs: Sequence[Signal] = () if measured is None else (Signal("of", measured.unit, measured.start),)
        angle = "deg"
        outputs = [
            Signal("angle", angle, description="crank angle since the origin"),
            Signal("cycle", kind="integer", description="engine cycles completed"),
            Signal("phase", angle, description="crank angle within the cycle"),
        ]
        if tdc:
            outputs.append(Signal("cylinder", kind="integer", description="the cylinder that fired last"))
            outputs += [
                Signal(f"phase_{i}", angle, description=f"crank angle since cylinder {i} was at firing top dead centre")
                for i in range(1, len(tdc) + 1)
            ]
        if grid is not None and measured is not None:
            outputs.append(Signal("residual", angle, description="the plant's angle minus the clock's"))
        self.outputs: Sequence[Signal] = tuple(outputs)
        self.feedthrough = frozenset((signal.name, "of") for signal in outputs if self.inputs)
        self.grid, self.cycle, self.tdc = grid, cycle, np.array(tdc, dtype=float)
        self._measures = measured is not None and grid is None
        self._state: _Crank | None = None

    def start(self, t0: float, u: Vector) -> Vector:
        """The outputs at the start, shape (n_outputs,)."""
        grid = self.grid
        self._state = _Crank(
            numerator=grid.numerator if grid else 0.0,
            denominator=float(grid.denominator) if grid else 1.0,
            origin=grid.origin if grid else 0.0,
            measures=self._measures,
            residual=self.outputs[-1].name == "residual",
            cycle=self.cycle,
            cylinders=len(self.tdc),
            tdc=address(self.tdc),
        )
        return call("crankbench_crank_start", self._state, t0, u=u, outputs=len(self.outputs))[1]

    def step(self, t: float, h: float, u: Vector) -> Vector:
        """The outputs at the next instant, shape (n_outputs,)."""
        return call("crankbench_crank_step", self._started(), t, h, u=u, outputs=len(self.outputs))[1]

    def native(self) -> Native:
        """The step in C."""
        return native_step("crankbench_crank_step", self._started())

    def reversal(self) -> Reversal:
        """Keeping and going back in C: what is counted."""
        return native_reversal("crankbench_crank_keep", "crankbench_crank_restore", self._started())

    def close(self) -> None:
        """Forget the state: it wants a start before the next step."""
        self._state = None

    def _started(self) -> _Crank:
        if self._state is None:
            raise StepError("the crank wants a start before it is stepped")
        return self._state


def build_crank(spec: CrankPart, measured: Signal | None, grid: Grid, found: Findings) -> CrankComponent:
    """The crank a scenario describes; what is wrong with it goes to `found`."""
    if isinstance(grid, CrankGrid):
        for key in ("cycle", "firing_order", "tdc"):
            if getattr(spec, key):
                found.at(key).add("wants to stand at the crank clock, which knows the engine")
        return CrankComponent(grid, measured, grid.cycle * grid.degrees, grid.tdc)
    cycle = degrees(spec.cycle, found.at("cycle")) if spec.cycle else 720.0
    if not cycle > 0.0:
        found.at("cycle").add(f"wants a crank angle above 0 deg, got {spec.cycle}")
        cycle = 720.0
    return CrankComponent(None, measured, cycle, read_tdc(spec.firing_order, spec.tdc, cycle, found))
