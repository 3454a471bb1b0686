"""The order of the parts in a step, and the wires that are held because of it."""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Mapping, Sequence
from typing import Literal, NamedTuple


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

    def __init__(self, wires: Sequence[Wire], remedies: str = "") -> None:
        self.wires = tuple(wires)
        super().__init__(
            f"algebraic loop: {cycle_text(wires)}; {remedies}break it with `delay: 1` on one of the wires, "
            "or a part whose output does not depend directly on its input"
        )


class Cluster(NamedTuple):
    """Parts that are stepped together, in their order: an algebraic loop, closed by its `torn` wires, or plants that
    take smaller steps together, which has none. `cycle` is one cycle of the loop."""

    parts: tuple[str, ...]
    torn: tuple[Wire, ...] = ()
    cycle: tuple[Wire, ...] = ()


class Order(NamedTuple):
    """The parts in the order they are stepped; those of a cluster stand side by side."""

    parts: tuple[str, ...]
    clusters: tuple[Cluster, ...] = ()


def cycle_text(wires: Iterable[Wire]) -> str:
    """The wires of a cycle, as messages have them."""
    return ", ".join(map(str, wires))


def order_parts(
    parts: Mapping[str, bool], wires: Iterable[Wire], loops: Literal["refused", "solved"] = "refused"
) -> Order:
    """The order in which every direct wire comes from a part already stepped.

    `parts`: names as declared, and whether each is a sensor. As long as there is a cycle, the wires that enter one of
    its parts from within it are cut where they are not direct: at the first part whose wires from the cycle are all
    such, else at the first that has one. Sensors come last in this choice, since a sensor cut off measures a step late.
    Then the parts follow each other as declared wherever the remaining wires leave it open. Late wires leave it open.
    A cycle of direct wires is an algebraic loop. Where loops are to be solved it becomes a cluster, torn where few
    signals enter a part.

    Raises AlgebraicLoop: a cycle of direct wires that is not to be solved.
    """
    remaining = [wire for wire in wires if not wire.late]
    clusters: list[Cluster] = []
    while True:
        cycles = [group for group in _connected(parts, remaining) if _inside(group, remaining)]
        if not cycles:
            return _with_clusters(parts, remaining, clusters)
        for group in cycles:
            inside = _inside(group, remaining)
            dropped = _cut(sorted(group, key=lambda part: (parts[part], list(parts).index(part))), inside)
            if not dropped:
                if loops == "refused":
                    remedy = "let it be solved by `coupling: {solve: newton}` at the head of the file, or "
                    raise AlgebraicLoop(_cycle(inside), remedy)
                members = [part for part in parts if part in group]
                torn = _torn(members, inside)
                left = [wire for wire in inside if wire not in torn]
                clusters.append(Cluster(_sorted(members, left), tuple(torn), tuple(_cycle(inside))))
                dropped = frozenset(torn)
            remaining = [wire for wire in remaining if wire not in dropped]


def order_together(
    parts: Mapping[str, bool],
    wires: Sequence[Wire],
    together: Sequence[frozenset[str]],
    loops: Literal["refused", "solved"],
) -> Order:
    """As `order_parts`, with each of the groups `together` a cluster of its own, without an algebraic loop in it.

    Raises AlgebraicLoop: as `order_parts`, or one among parts of a group.
    """
    if not together:
        return order_parts(parts, wires, loops)
    stands_for = {
        part: next((min(group, key=list(parts).index) for group in together if part in group), part) for part in parts
    }
    nodes = {node: parts[node] for node in dict.fromkeys(stands_for.values())}
    outer = [
        wire._replace(source=stands_for[wire.source], part=stands_for[wire.part])
        for wire in wires
        if stands_for[wire.source] != stands_for[wire.part] or wire.source == wire.part
    ]
    whole = order_parts(nodes, outer, loops)
    clusters, order = list(whole.clusters), list(whole.parts)
    for group in together:
        node = min(group, key=list(parts).index)
        if any(node in cluster.parts for cluster in whole.clusters):
            raise AlgebraicLoop(next(cluster.torn for cluster in whole.clusters if node in cluster.parts))
        inside = [wire for wire in wires if wire.source in group and wire.part in group]
        members = order_parts({part: parts[part] for part in parts if part in group}, inside, "refused").parts
        clusters.append(Cluster(members))
        order[order.index(node) : order.index(node) + 1] = members
    return Order(tuple(order), tuple(clusters))


def connected(parts: Iterable[str], wires: Iterable[Wire]) -> list[frozenset[str]]:
    """The groups of two parts or more that all reach each other along the wires, late ones too."""
    return [group for group in _connected(parts, wires) if len(group) > 1]


def held_wires(order: Sequence[str], wires: Iterable[Wire]) -> tuple[Wire, ...]:
    """The wires that carry the value at k-1: late ones, and those whose part is stepped before, or is, their source."""
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


def _torn(group: Sequence[str], inside: Sequence[Wire]) -> list[Wire]:
    """Wires without which the group has no cycle: those into one part after another, the fewest signals first."""
    torn: list[Wire] = []
    rest = list(inside)
    while True:
        cycles = [knot for knot in _connected(group, rest) if _inside(knot, rest)]
        if not cycles:
            return torn
        knot = _inside(cycles[0], rest)

        def cost(part: str, knot: Sequence[Wire] = knot) -> tuple[int, int]:
            left = [wire for wire in knot if wire.part != part]
            still = sum(len(one) for one in _connected(group, left) if _inside(one, left))
            return still, len({(wire.source, wire.output) for wire in knot if wire.part == part})

        part = min((part for part in group if part in cycles[0]), key=cost)
        torn += [wire for wire in knot if wire.part == part]
        rest = [wire for wire in rest if wire not in torn]


def _with_clusters(parts: Iterable[str], wires: Sequence[Wire], clusters: Sequence[Cluster]) -> Order:
    """The order of parts among whose remaining wires there is no cycle, each cluster in one piece."""
    node = {part: next((one.parts[0] for one in clusters if part in one.parts), part) for part in parts}
    first = dict.fromkeys(node.values())
    outer = [wire._replace(source=node[wire.source], part=node[wire.part]) for wire in wires]
    members = {one.parts[0]: one.parts for one in clusters}
    order = _sorted(first, [wire for wire in outer if wire.source != wire.part])
    return Order(tuple(part for one in order for part in members.get(one, (one,))), tuple(clusters))


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
