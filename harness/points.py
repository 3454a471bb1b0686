"""Points in time, held or joined by lines, as points.c looks them up."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from harness.clock import CrankGrid, Grid
from harness.findings import Findings
from harness.native import address

Between = Literal["hold", "linear"]
Ends = Literal["error", "hold", "repeat"]
# In the order of points.c.
BETWEEN: tuple[Between, ...] = ("hold", "linear")
ENDS: tuple[Ends, ...] = ("error", "hold", "repeat")


class Horizon(NamedTuple):
    """When a run starts, when its last step begins, and when it stops [s], as far as that is known before it.

    Two times nearer than `edge` [s] are one.
    """

    start: float
    last: float
    stop: float
    edge: float


def horizon(grid: Grid) -> Horizon:
    """The horizon of a clock. When one in crank angle stops, or steps, follows from the run: there it is the start."""
    if isinstance(grid, CrankGrid):
        return Horizon(grid.start, grid.start, grid.start, 1e-9)
    last, stop = (grid.start + steps * grid.step for steps in (max(grid.steps - 1, 0), grid.steps))
    return Horizon(grid.start, last, stop, 1e-6 * grid.step)


class PointsState(ctypes.Structure):
    """The points as C sees them, and where its last search ended."""

    _fields_ = [
        ("count", ctypes.c_int64),
        *((name, ctypes.c_void_p) for name in ("times", "values")),
        *((name, ctypes.c_int64) for name in ("between", "ends")),
        ("edge", ctypes.c_double),
        ("cursor", ctypes.c_int64),
    ]


@dataclass(frozen=True, eq=False)
class Points:
    """Ascending `times` and `values` in SI, both of shape (n,), n > 0, finite but for a first time of -inf.

    Between two points the first one holds, or a line joins them; a time nearer to a point than `edge` is at it. Outside
    of the points `ends` says what holds: nothing (an error), the nearest point, or the points anew, the last one at the
    time of the first, whose value stands for both. `axis` is what the times are in: s, or deg of the crankshaft.
    """

    times: NDArray[np.float64]
    values: NDArray[np.float64]
    between: Between = "hold"
    ends: Ends = "hold"
    edge: float = 0.0
    axis: str = "s"

    def state(self) -> PointsState:
        """The points for C, which reads these arrays; the caller keeps them alive."""
        between, ends = BETWEEN.index(self.between), ENDS.index(self.ends)
        return PointsState(len(self.times), address(self.times), address(self.values), between, ends, self.edge, 0)

    @property
    def span(self) -> str:
        """Where the first and the last point are, for messages."""
        return f"{self.times[0]:.9g} {self.axis} ... {self.times[-1]:.9g} {self.axis}"


def point(value: float) -> Points:
    """One value for ever."""
    return Points(np.zeros(1), np.array([value]))


def check_reach(points: Points, first: float, last: float, found: Findings) -> None:
    """Tells where points that are looked at from `first` to `last` have no value there, or cannot be repeated."""
    reached = points.times[0] - points.edge <= first and last <= points.times[-1] + points.edge
    if points.ends == "error" and not reached:
        asked = f"wants values at {first:.9g} {points.axis} ... {last:.9g} {points.axis}"
        found.add(f"{asked}, but has them at {points.span}; `ends: hold` holds the nearest")
    if points.ends == "repeat" and len(points.times) == 1:
        found.add("wants two points or more to repeat, got one")
