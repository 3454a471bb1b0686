"""One measure: the platform and its peer in turn, round by round, the fastest of each kept."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple


class Measure(NamedTuple):
    """Seconds for one step, ours and the peer's, and what their ratio is meant to be at most."""

    name: str
    ours: float
    peer: float
    peer_name: str
    target: float

    @property
    def ratio(self) -> float:
        """ours / peer."""
        return self.ours / self.peer


def side_by_side(ours: Callable[[], float], peer: Callable[[], float], rounds: int) -> tuple[float, float]:
    """The least of `rounds` times of each, taken in turn; each call returns the seconds that one step took.

    What else the machine does only ever adds to a time, so the least is the nearest to the time of the code itself.
    """
    times = [(ours(), peer()) for _ in range(rounds)]
    return min(time for time, _ in times), min(time for _, time in times)
