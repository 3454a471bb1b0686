"""The order of the parts in a step, and the wires that are held because of it."""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple


class Wire(NamedTuple):
    """One output into one input. `direct`: an output of the part it enters depends directly on it.

    `late`: it always carries the value of the instant before, whatever the order.
    """

    source: str
    output: str
    part: str
    input: str
    direct: bool
    late: bool = False

    def __str__(self) -> str:
        return f"{self.source}.{self.output} -> {self.part}.{self.input}"


class AlgebraicLoop(ValueError):
    """Parts that each want the others' outputs of the same instant. `wires` is the cycle."""

    def __init__(self, wires: Sequence[Wire]) -> None:
        self.wires = tuple(wires)
        super().__init__(
            f"algebraic loop: {', '.join(map(str, wires))}; break it with `delay: 1` on one of the wires, "
            "or a part whose output does not depend directly on its input"
        )


def order_parts(parts: Mapping[str, bool], wires: Iterable[Wire]) -> tuple[str, ...]:
    """The order in which every direct wire comes from a part already stepped.

    `parts`: names as declared, and whether each is a sensor. As long as there is a cycle, the wires that enter one of
    its parts from within it are cut where they are not direct: at the first part whose wires from the cycle are all
    such, else at the first that has one. Sensors come last in this choice, since a sensor cut off measures a step late.
    Then the parts follow each other as declared wherever the remaining wires leave it open. Late wires leave it open.

    Raises AlgebraicLoop: a cycle of direct wires.
    """
    remaining = [wire for wire in wires if not wire.late]
    while True:
        cycles = [group for group in _connected(parts, remaining) if _inside(group, remaining)]
        if not cycles:
            return _sorted(parts, remaining)
        for group in cycles:
            inside = _inside(group, remaining)
            cut = _cut(sorted(group, key=lambda part: (parts[part], list(parts).index(part))), inside)
            if not cut:
                raise AlgebraicLoop(_cycle(inside))
            remaining = [wire for wire in remaining if wire not in cut]


def held_wires(order: Sequence[str], wires: Iterable[Wire]) -> tuple[Wire, ...]:
    """The late wires, and those whose part is stepped before, or is, the part they come from: it sees the value at k-1."""
    return tuple(wire for wire in wires if wire.late or not _earlier(order, wire))


def copied_wires(order: Sequence[str], wires: Iterable[Wire]) -> tuple[Wire, ...]:
    """The late wires whose source is stepped earlier: the value at k-1 has to be put by for them."""
    return tuple(wire for wire in wires if wire.late and _earlier(order, wire))


def _earlier(order: Sequence[str], wire: Wire) -> bool:
    return order.index(wire.source) < order.index(wire.part)


def _inside(group: frozenset[str], wires: Iterable[Wire]) -> list[Wire]:
    return [wire for wire in wires if wire.source in group and wire.part in group]


def _cut(group: Sequence[str], inside: Sequence[Wire]) -> frozenset[Wire]:
    """The wires to cut in one cycle; none where all are direct."""
    entering = {part: [wire for wire in inside if wire.part == part] for part in group}
    for part in group:
        if not any(wire.direct for wire in entering[part]):
            return frozenset(entering[part])
    for part in group:
        held = frozenset(wire for wire in entering[part] if not wire.direct)
        if held:
            return held
    return frozenset()


def _connected(parts: Iterable[str], wires: Iterable[Wire]) -> list[frozenset[str]]:
    """The strongly connected groups: those of parts that can all reach each other along the wires."""
    following: dict[str, set[str]] = {part: set() for part in parts}
    for wire in wires:
        following[wire.source].add(wire.part)
    reached = {part: _reached(part, following) for part in following}
    groups = {frozenset({part, *(other for other in reached[part] if part in reached[other])}) for part in following}
    return sorted(groups, key=lambda group: min(list(following).index(part) for part in group))


def _reached(part: str, following: Mapping[str, set[str]]) -> set[str]:
    reached: set[str] = set()
    open_ends = [part]
    while open_ends:
        for other in following[open_ends.pop()] - reached:
            reached.add(other)
            open_ends.append(other)
    return reached


def _sorted(parts: Iterable[str], wires: Iterable[Wire]) -> tuple[str, ...]:
    names = list(parts)
    index = {part: i for i, part in enumerate(names)}
    waits: dict[str, set[str]] = {part: set() for part in names}
    for wire in wires:
        waits[wire.part].add(wire.source)
    ready = [index[part] for part in names if not waits[part]]
    order: list[str] = []
    while ready:
        part = names[heapq.heappop(ready)]
        order.append(part)
        for other in names:
            if part in waits[other]:
                waits[other].remove(part)
                if not waits[other]:
                    heapq.heappush(ready, index[other])
    return tuple(order)


def _cycle(inside: Sequence[Wire]) -> list[Wire]:
    """One cycle of wires, of a group in which every part has a wire from within."""
    entering = {wire.part: wire for wire in reversed(inside)}
    path: list[Wire] = []
    part = inside[0].part
    while part not in [wire.part for wire in path]:
        path.append(entering[part])
        part = entering[part].source
    begin = [wire.part for wire in path].index(part)
    return path[begin:][::-1]
