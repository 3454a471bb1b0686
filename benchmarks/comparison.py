"""Measures of one set-up with every engine: ours, bare C, FMPy, ecos and libcosim, in turn, their rows checked."""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import ExitStack
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks.inprocess import BareLoop, FmpyCalls, SimulateFmu
from benchmarks.measure import Measure, in_turn
from benchmarks.orders import Jacobi, jacobi
from benchmarks.ours import OurLoop
from benchmarks.peer_process import PeerProcess, Unavailable
from benchmarks.serving import Recorded
from benchmarks.setups import Setup

BARE = "bare C loop"
FMPY_CALLS = "FMPy's calls"
SIMULATE_FMU = "FMPy's simulate_fmu"
# The module that runs a peer, what it records, and whether it is kept to one core; in the order of the table.
PEERS = {
    "ecos, nothing recorded": ("benchmarks.ecos", "nothing", False),
    "ecos, CSV": ("benchmarks.ecos", "everything", False),
    "libcosim on one core, nothing recorded": ("benchmarks.libcosim", "nothing", True),
    "libcosim on one core, time series": ("benchmarks.libcosim", "everything", True),
    "libcosim, nothing recorded": ("benchmarks.libcosim", "nothing", False),
}
# ecos adds up the time and libcosim counts it in nanoseconds and passes the difference of two times as the step: both
# are a rounding away from k h, which moves a located event by as much, and the plant by some 1e-13 of its size.
SAME = 1e-9
DIGITS = 5.1e-7  # ecos writes six decimals
FAST = 10  # ours and bare C have so many turns where the others, which take longer, have one


class Comparison(NamedTuple):
    """The measures of ours beside each peer, and why the other peers could not be measured, by name."""

    measures: list[Measure]
    absent: dict[str, str]


def beside_bare_c(setup: Setup, target: float, rounds: int) -> Measure:
    """Ours beside the bare C loop alone. Raises RuntimeError: their rows are not equal bit for bit."""
    with OurLoop(setup.parts, setup.step, setup.steps) as ours, ExitStack() as closing:
        bare = BareLoop(setup, ours)
        closing.callback(bare.close)
        least = in_turn((ours, bare), rounds)
        check_equal(BARE, ours.rows, bare.rows)
    return Measure(setup.name, least[0], least[1], BARE, target)


def beside_all(setup: Setup, target: float, rounds: int) -> Comparison:
    """Ours beside every engine that can be had here.

    Raises RuntimeError: the rows of bare C or FMPy are not ours bit for bit; or those of ecos or libcosim, which pass
    values on after all FMUs were stepped, are not what FMPy's calls give in that order.
    """
    with OurLoop(setup.parts, setup.step, setup.steps) as ours, ExitStack() as closing:
        bare, calls = BareLoop(setup, ours), FmpyCalls(setup, ours.rows.shape[1])
        engines: dict[str, Callable[[], float]] = {FMPY_CALLS: calls}
        closing.callback(bare.close)
        closing.callback(calls.close)
        whole = SimulateFmu(setup) if len(setup.fmus) == 1 and not setup.driven else None
        if whole is not None:
            engines[SIMULATE_FMU] = whole
            closing.callback(whole.close)
        peers, absent = _start_peers(setup, closing)
        engines |= peers
        least = in_turn((ours, bare) * FAST + tuple(engines.values()), rounds)
        check_equal(BARE, ours.rows, bare.rows)
        check_equal(FMPY_CALLS, ours.rows, calls.rows)
        if whole is not None:
            check_equal(SIMULATE_FMU, ours.rows[:, 1:], whole.rows)
        wanted = jacobi(setup)
        for name, peer in peers.items():
            check_peer(name, peer.recorded(), wanted)
    our_least, bare_least = min(least[0 : 2 * FAST : 2]), min(least[1 : 2 * FAST : 2])
    measures = [Measure(setup.name, our_least, bare_least, BARE, target)]
    measures += [
        Measure(setup.name, our_least, time, name) for name, time in zip(engines, least[2 * FAST :], strict=True)
    ]
    return Comparison(measures, absent)


def _start_peers(setup: Setup, closing: ExitStack) -> tuple[dict[str, PeerProcess], dict[str, str]]:
    peers: dict[str, PeerProcess] = {}
    absent: dict[str, str] = {}
    for name, (module, recording, one_core) in PEERS.items():
        try:
            if one_core and not hasattr(os, "sched_setaffinity"):
                raise Unavailable("this system cannot keep a process to one core")
            cores = [max(os.sched_getaffinity(0))] if one_core else []
            peers[name] = closing.enter_context(PeerProcess(module, setup, recording, cores))
        except Unavailable as reason:
            absent[name] = str(reason)
    return peers, absent


def check_equal(peer: str, ours: NDArray[np.float64], theirs: NDArray[np.float64]) -> None:
    """Raises RuntimeError: the rows are not equal bit for bit, so that the times of the peer say nothing."""
    if not np.array_equal(ours, theirs):
        apart = float(np.abs(ours - theirs).max())
        raise RuntimeError(f"the rows of {peer} are not ours: {apart:.3g} apart, so their times say nothing")


def check_peer(peer: str, recorded: Recorded, wanted: Jacobi) -> None:
    """Raises RuntimeError: what the peer recorded is not what one of the two orders gives.

    A peer that records nothing shows its last row, or has another of its kind that records to speak for it.
    """
    if not len(recorded.rows):
        return
    scale = np.maximum(np.abs(wanted.passed).max(axis=0), np.finfo(float).tiny)[recorded.places]
    allowed = SAME * scale + (DIGITS if peer.endswith("CSV") else 0.0)
    apart = [
        float((np.abs(rows[-len(recorded.rows) :, recorded.places] - recorded.rows) / allowed).max()) for rows in wanted
    ]
    if not min(apart) <= 1.0:
        raise RuntimeError(f"the rows of {peer} are {min(apart):.3g} times what is allowed away from those expected")
