"""The hybrid observer of ECC 2001: a location observer from residuals, a continuous observer that follows it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any

import numpy as np

from fmus.component import Signal
from fmus.hybrid import Automaton
from fmus.model import Model, ModelError, Values
from observers.affine import advance, fastest_poles, sample_observer
from observers.bank import (
    Instant,
    Rule,
    bank_model,
    measured_names,
    nominal_automaton,
    read_thresholds,
    read_values,
    sampled_signals,
    sampled_values,
)
from observers.convergence import Bound, design_gains, error_bound
from observers.identification import Memory, Rules, graph_of, guard_planes, identify
from observers.open_loop import deepest
from observers.residuals import Signature, design_signatures, persist, residual, within


def make(
    plant: str,
    threshold: dict[str, Any] | str,
    delay: Annotated[float, "s"],
    dwell: Annotated[float, "s"],
    rate: Annotated[float, "1/s"],
    bounds: dict[str, Any],
    entry_error: float = 1.0,
    margin: float = 0.0,
    persistence: int = 1,
    patience: Annotated[float, "s"] = 0.5,
    initial_location: int = 0,
    parameters: dict[str, Any] | None = None,
    parameter_set: str | None = None,
    start: dict[str, Any] | None = None,
    guard_speed: Annotated[float, "1/s"] = np.inf,
    sample_time: Annotated[float, "s"] = 1e-3,
) -> Model:
    """Location observer (6)-(9), identification by graph and guards, continuous observer (15) by Proposition 3.3.1.

    `plant` a module with MODEL and automaton(parameters); `parameters`, `parameter_set`, `start` describe what the
    observer believes. `threshold` eps of (8), one quantity or one by output. `delay` Delta and `entry_error` Z0
    (in the states' scales) of (9). `dwell` D and `rate` mu of Proposition 3.3.1, and `bounds` on |x| and |u| by name.
    `margin`, `patience` and `persistence` as in observers.identification and observers.residuals; `initial_location` 0
    is unknown. `guard_speed` bounds how fast the plant crosses a guard, in scales per second; only M_0_sharp uses it.

    Outputs besides the estimates: `location`; r_j in the unit of y and sigma_j by signature class, named after the
    class's last location; M_0 (Eq. 20 as published), M_0_corrected, M_0_peak and M_0_sharp in units
    of the scales (observers.convergence.Bound).

    Raises ModelError: demands that contradict each other or that no gains meet, unknown names, wrong units.
    """
    automaton = nominal_automaton(plant, parameters, parameter_set)
    limits = read_thresholds(threshold, automaton)
    fastest = fastest_poles(sample_time)
    signatures = design_signatures(automaton, delay, limits, entry_error, fastest)
    gains = design_gains(automaton, rate, dwell, delay, fastest)
    largest = read_bounds(bounds, automaton)
    n = len(automaton.states)
    bound = error_bound(automaton, gains, largest[:n], largest[n:], rate, dwell, delay, guard_speed)
    if not 0 <= initial_location <= len(automaton.locations):
        raise ModelError(f"initial_location wants 0 (unknown) to {len(automaton.locations)}, got {initial_location}")
    settle = float(np.ceil(delay / sample_time))
    rules = Rules(settle, margin, float(np.ceil(patience / sample_time)))
    rule = signature_rule(automaton, signatures, limits, rules, persistence, initial_location, start or {}, sample_time)
    rule = rule._replace(discrete=(*rule.discrete, *_bound_signals(bound)))
    return bank_model(
        "hybrid", "Hybrid observer: residuals locate, a switched Luenberger observer estimates",
        automaton, gains, rule, start or {}, sample_time,
    )  # fmt: skip


def read_bounds(bounds: dict[str, Any], automaton: Automaton) -> tuple[float, ...]:
    """Largest |x| (n,), then |u| (m,), in their units. Raises ModelError: one is missing, or of another dimension."""
    signals = (*automaton.states, *automaton.inputs)
    values = read_values(bounds, signals, "state or input")
    missing = [signal.name for signal in signals if signal.name not in values]
    if missing:
        raise ModelError(f"bounds want the largest deviation of {', '.join(missing)} too")
    return tuple(values[signal.name] for signal in signals)


def _bound_signals(bound: Bound) -> tuple[Signal, ...]:
    return (
        Signal("M_0", "1", bound.published, "Eq. 20 as published, in units of the scales"),
        Signal("M_0_corrected", "1", bound.ball, "Eq. 20 with the factor n k(F) kept, when a location is found"),
        Signal("M_0_peak", "1", bound.peak, "what the error stays under at all times, once within M_0_corrected"),
        Signal("M_0_sharp", "1", bound.sharp_peak, "the same with the matrix exponentials themselves, at all times"),
    )


def signature_rule(
    automaton: Automaton,
    signatures: Sequence[Signature],
    limits: tuple[float, ...],
    rules: Rules,
    persistence: int,
    initial_location: int,
    start: dict[str, Any],
    sample_time: float,
) -> Rule:
    """The location observer: generators, decisions and identification, as a rule of the bank."""
    graph = graph_of(automaton, [signature.locations for signature in signatures])
    normals, offsets = guard_planes(automaton)
    generators = [sample_observer(one.location, one.gain, sample_time) for one in signatures]
    outputs = np.stack([one.location.C for one in signatures])
    names = [str(one.locations[-1]) for one in signatures]
    states, measured = [signal.name for signal in automaton.states], measured_names(automaton)
    begun = read_values(start, automaton.states, "state")
    z_start = np.array([begun.get(state, 0.0) for state in states])
    ends = [""] if len(measured) == 1 else [f"_{name}" for name in measured]

    def choose(instant: Instant, m: Values, u: Values, p: Values) -> dict[str, Any]:
        updated: dict[str, Any] = {}
        holds = []
        for j, generator in enumerate(sampled_values("generator", p, len(names), len(measured))):
            z = advance(generator, m[f"z_{names[j]}"], instant.u, instant.before, instant.now)
            r = residual(p.generator_output[j], z, instant.now)
            seen = within(r, p.threshold)
            sigma, doubted = persist(m[f"sigma_{names[j]}"], m[f"doubted_{names[j]}"], seen, p.persistence)
            holds.append(sigma)
            updated |= {f"z_{names[j]}": z, f"sigma_{names[j]}": sigma, f"doubted_{names[j]}": doubted}
            updated |= {f"r_{names[j]}{end}": value for end, value in zip(ends, r, strict=True)}
        guards = p.guard_normal @ instant.estimate + p.guard_offset
        memory = Memory(m.location, m.since, m.lost)
        memory = identify(graph, memory, holds, guards, Rules(p.settle, p.margin, p.patience))
        return updated | memory._asdict()

    discrete: list[Signal] = []
    for name in names:
        discrete += [
            *(
                Signal(f"r_{name}{end}", signal.unit, 0.0, f"residual of signature {name}", nominal=signal.nominal)
                for end, signal in zip(ends, automaton.outputs, strict=True)
            ),
            Signal(f"sigma_{name}", "1", 1, f"1 while signature {name} holds", kind="boolean"),
            Signal(f"z_{name}", "1", z_start, "generator state", shape=(len(states),), local=True),
            Signal(f"doubted_{name}", "1", 0, "samples against the decision", kind="integer", local=True),
        ]
    lost = rules.patience if initial_location == 0 else 0.0
    return Rule(
        begin=initial_location or deepest(automaton, graph, start),
        choose=choose,
        discrete=(
            *discrete,
            Signal("since", "1", 0.0, "samples since the last change, up to settle", local=True),
            Signal("lost", "1", lost, "samples in which nothing fitted", local=True),
        ),
        parameters=(
            *sampled_signals("generator", generators),
            Signal("generator_output", "1", outputs, "C by signature", shape=outputs.shape),
            Signal("threshold", "1", limits, "eps by output, in its unit", shape=(len(limits),)),
            Signal("persistence", "1", float(persistence), "samples in a row that turn a decision"),
            Signal("guard_normal", "1", normals, "guards' normals, by edge", shape=normals.shape),
            Signal("guard_offset", "1", offsets, "guards' offsets, by edge", shape=offsets.shape),
            Signal("settle", "1", rules.settle, "samples after a change without another"),
            Signal("margin", "1", rules.margin, "distance beyond a guard, in scales"),
            Signal("patience", "1", rules.patience, "samples without a fit before all locations are admitted"),
        ),
    )
