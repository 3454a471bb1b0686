"""A plant in Python that goes round a circle until, at one of its steps, it meets its fate."""

from __future__ import annotations

import os
import signal
import time

import numpy as np

from fmus.component import Native, Role, Signal, Vector
from fmus.whereabouts import here

SPEED = 100.0  # rad/s


class Fateful:
    """A shaft at constant speed, with its angle and the number of its steps."""

    role: Role = "plant"
    inputs = ()
    outputs = (Signal("omega", "rad/s", SPEED), Signal("theta", "rad"), Signal("steps", kind="integer"))
    feedthrough = frozenset[tuple[int, int]]()

    def __init__(self, fate: str, nth: int) -> None:
        self._fate, self._nth = fate, nth

    def start(self, t0: float, u: Vector) -> Vector:
        """At rest no step was made."""
        self._steps = 0
        return np.array([SPEED, 0.0, 0.0])

    def step(self, t: float, h: float, u: Vector) -> Vector:
        """One step further, or not."""
        self._steps += 1
        if self._steps == self._nth:
            self._meet()
        return np.array([SPEED, SPEED * (t + h), self._steps])

    def _meet(self) -> None:
        if self._fate == "kill":
            os.kill(os.getpid(), signal.SIGKILL)
        if self._fate == "lie":
            here().instant += 50
            os.kill(os.getpid(), signal.SIGKILL)
        if self._fate == "exit":
            os._exit(7)
        if self._fate == "hang":
            time.sleep(60)
        if self._fate == "raise":
            raise ZeroDivisionError("no torque")

    def close(self) -> None:
        """A crash after the last step."""
        if self._fate == "crash at the end":
            os.kill(os.getpid(), signal.SIGSEGV)

    def native(self) -> Native | None:
        """None: it is Python."""
        return None


def make(fate: str = "none", nth: int = 0) -> Fateful:
    """A plant that meets its fate in its nth step."""
    return Fateful(fate, nth)
