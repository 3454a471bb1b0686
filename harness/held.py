"""Puts values by for wires that carry the instant before although their source is stepped earlier; see parts.c."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence

from fmus.component import Native, Reversal, Role, Signal, Vector
from harness.native import native_reversal, native_step


class HeldComponent:
    """Its outputs are its inputs, one by one. Stepped before others, it shows them values of k-1 at k."""

    role: Role = "controller"

    def __init__(self, carried: Sequence[Signal]) -> None:
        self.inputs: Sequence[Signal] = tuple(carried)
        self.outputs: Sequence[Signal] = tuple(carried)
        self.feedthrough = frozenset((signal.name, signal.name) for signal in carried)
        self._count = ctypes.c_int64(len(carried))

    def start(self, t0: float, u: Vector) -> Vector:
        """The values on the wires at the start: those declared, since nothing is initialised before it."""
        return u.copy()

    def step(self, t: float, h: float, u: Vector) -> Vector:
        """The values on the wires."""
        return u.copy()

    def native(self) -> Native:
        """The step in C."""
        return native_step("crankbench_held_step", self._count)

    def reversal(self) -> Reversal:
        """Keeping and going back in C, which do nothing: what it shows is on the bus."""
        return native_reversal("crankbench_stateless_keep", "crankbench_stateless_keep", self._count)

    def close(self) -> None:
        """Nothing is held beyond the values."""
