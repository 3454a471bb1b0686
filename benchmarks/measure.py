"""One measure: the platform and its peer in turn, round by round, the fastest of each kept."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple


class Measure(NamedTuple):
    """Seconds for one step, ours and the peer's, and what their ratio is meant to be at most where that is promised.

    `unit` is s but for what is no time.
    """

    name: str
    ours: float
    peer: float
    peer_name: str
    target: float | None = None
    unit: str = "s"

    @property
    def ratio(self) -> float:
        """ours / peer."""
        return self.ours / self.peer


def in_turn(runs: Sequence[Callable[[], float]], rounds: int) -> list[float]:
    """The least of `rounds` times of each, taken in turn; each call returns the seconds that one step took.

    What else the machine does only ever adds to a time, so the least is the nearest to the time of the code itself.
    """
    times = [[run() for run in runs] for _ in range(rounds)]
    return [min(column) for column in zip(*times, strict=True)]


def side_by_side(ours: Callable[[], float], peer: Callable[[], float], rounds: int) -> tuple[float, float]:
    """The least of `rounds` times of ours and of one peer's, taken in turn."""
    least = in_turn((ours, peer), rounds)
    return least[0], least[1]
