"""Which location? From the signatures that hold, the plant's graph and its guards to one location."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fmus.hybrid import Automaton

NEVER = -1e30


class Graph(NamedTuple):
    """`classes` the signature class (from 0) of each location, `edges` (source, target) with locations from 1."""

    classes: tuple[int, ...]
    edges: tuple[tuple[int, int], ...]


class Memory(NamedTuple):
    """Current location, samples since it was taken (up to `settle`), and samples in which nothing fitted."""

    location: Any
    since: Any
    lost: Any


class Rules(NamedTuple):
    """How evidence is weighed: times in samples, `margin` in units of the scales.

    `settle`   after a change, no other is believed before the signatures have settled (the delay of Eq. 9)
    `margin`   how far beyond a guard the estimate must be to move while both signatures hold; infinite: never
    `patience` how long nothing may fit before every location is admitted, not only the successors
    """

    settle: Any
    margin: Any
    patience: Any


def graph_of(automaton: Automaton, classes: Sequence[Sequence[int]]) -> Graph:
    """The graph of an automaton whose locations are grouped into signature classes."""
    index = {number: j for j, members in enumerate(classes) for number in members}
    return Graph(
        tuple(index[number + 1] for number in range(len(automaton.locations))),
        tuple((edge.source, edge.target) for edge in automaton.transitions),
    )


def guard_planes(automaton: Automaton) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Normals (edges, n) and offsets (edges,) of the guards, such that normal . x + offset is a distance in scales."""
    sizes = [np.linalg.norm(edge.normal * automaton.scales) for edge in automaton.transitions]
    normals = [edge.normal / size for edge, size in zip(automaton.transitions, sizes, strict=True)]
    offsets = [edge.offset / size for edge, size in zip(automaton.transitions, sizes, strict=True)]
    n = len(automaton.states)
    return np.array(normals, dtype=float).reshape(-1, n), np.array(offsets, dtype=float)


def depth(graph: Graph, location: int, guards: Any) -> Any:
    """How far inside a location the estimate is: minus the largest guard that leads out of it; in scales."""
    leaving = [guards[k] for k, (source, _) in enumerate(graph.edges) if source == location]
    if not leaving:
        return 0.0
    largest = leaving[0]
    for value in leaving[1:]:
        largest = np.maximum(largest, value)
    return -largest


def identify(graph: Graph, memory: Memory, holds: Sequence[Any], guards: Any, rules: Rules) -> Memory:
    """The memory after one sample; `holds` (0 or 1) by signature class, `guards` (edges,) at the estimate.

    Nothing changes within `settle` of the last change. After that:
    1. The signature of the location no longer holds: move to the successor whose signature holds; of several to the one
       whose guard is most satisfied. None holds: stay, and count.
    2. It holds, and so does a successor's (the paper's first critical case; where both share a signature, its second):
       the guards decide. Move once the estimate is `margin` beyond the guard to that successor.
    3. Nothing has fitted for `patience` samples, or the initial location is unknown: of all locations whose signature
       holds take the one that the estimate lies deepest in.
    """
    location, since, lost = memory
    settled = since >= rules.settle
    searching = lost >= rules.patience
    chosen: Any = location
    fits: Any = 0.0
    for here in range(1, len(graph.classes) + 1):
        best, target = _best(graph, here, holds, guards, rules, searching)
        own = holds[graph.classes[here - 1]]
        is_here = np.abs(location - here) < 0.5
        found = best > NEVER / 2.0
        chosen = np.where(is_here, np.where(found, target, location), chosen)
        fits = np.where(is_here, np.where(found, 1.0, own), fits)
    chosen = np.where(settled, chosen, location)
    moved = np.abs(chosen - location) > 0.5
    return Memory(
        chosen,
        np.where(moved, 0.0, np.minimum(since + 1.0, rules.settle)),
        np.where(settled, np.where(fits > 0.5, 0.0, np.minimum(lost + 1.0, rules.patience)), lost),
    )


def _best(graph: Graph, here: int, holds: Sequence[Any], guards: Any, rules: Rules, searching: Any) -> tuple[Any, Any]:
    """Score and number of the best location to be in next when in `here`; the score is NEVER where none is better."""
    own = holds[graph.classes[here - 1]]
    best: Any = np.where(searching, np.where(own > 0.5, depth(graph, here, guards), NEVER), NEVER)
    target: Any = float(here)
    for there in range(1, len(graph.classes) + 1):
        if there == here:
            continue
        ways = [guards[k] for k, edge in enumerate(graph.edges) if edge == (here, there)]
        guard: Any = NEVER
        for way in ways:
            guard = np.maximum(guard, way)
        beyond = np.where(guard >= rules.margin, guard, NEVER)
        score = np.where(searching, depth(graph, there, guards), np.where(own > 0.5, beyond, guard))
        score = np.where(holds[graph.classes[there - 1]] > 0.5, score, NEVER)
        better = score > best
        best, target = np.where(better, score, best), np.where(better, float(there), target)
    return best, target
