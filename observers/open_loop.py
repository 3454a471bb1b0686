"""The plant's model run on its inputs alone, switching on its own guards: what is gained by measuring nothing."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

import numpy as np

from fmus.component import Signal
from fmus.hybrid import Automaton
from fmus.model import Model, Values
from observers.bank import Instant, Rule, bank_model, blind, nominal_automaton, read_values
from observers.identification import Graph, depth, graph_of, guard_planes


def make(
    plant: str,
    parameters: dict[str, Any] | None = None,
    parameter_set: str | None = None,
    start: dict[str, Any] | None = None,
    sample_time: Annotated[float, "s"] = 1e-3,
) -> Model:
    """x' = A_i x + B_i u + E_i in the location i that its own guards lead to.

    `plant` a module with MODEL and automaton(parameters); `parameters`, `parameter_set` and `start` by name.
    Raises ModelError: names or units that do not fit.
    """
    automaton = blind(nominal_automaton(plant, parameters, parameter_set))
    gains = [np.zeros((len(automaton.states), 0))] * len(automaton.locations)
    rule = guard_rule(automaton, start or {})
    return bank_model(
        "open_loop", "Model of the plant run on its inputs alone", automaton, gains, rule, start or {}, sample_time
    )


def guard_rule(automaton: Automaton, start: Mapping[str, Any]) -> Rule:
    """Follow the edge whose guard the estimate satisfies most; begin where the start values lie deepest."""
    graph = graph_of(automaton, [range(1, len(automaton.locations) + 1)])
    normals, offsets = guard_planes(automaton)

    def choose(instant: Instant, m: Values, u: Values, p: Values) -> dict[str, Any]:
        guards = p.guard_normal @ instant.estimate + p.guard_offset
        location: Any = m.location
        best: Any = 0.0
        for k, (source, target) in enumerate(graph.edges):
            follows = np.where(np.abs(m.location - source) < 0.5, guards[k], -1.0)
            location = np.where(follows >= best, float(target), location)
            best = np.maximum(best, follows)
        return {"location": location}

    return Rule(
        begin=deepest(automaton, graph, start),
        choose=choose,
        parameters=(
            Signal("guard_normal", "1", normals, "guards' normals, by edge", shape=normals.shape),
            Signal("guard_offset", "1", offsets, "guards' offsets, by edge", shape=offsets.shape),
        ),
    )


def deepest(automaton: Automaton, graph: Graph, start: Mapping[str, Any]) -> int:
    """Number of the location that the start values lie deepest in."""
    values = read_values(start, automaton.states, "state")
    x = np.array([values.get(signal.name, 0.0) for signal in automaton.states])
    normals, offsets = guard_planes(automaton)
    depths = [float(depth(graph, number, normals @ x + offsets)) for number in range(1, len(automaton.locations) + 1)]
    return int(np.argmax(depths)) + 1
