"""Wires the first case of each experiment, so that what is wrong with a campaign is said before anything is written."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

from fmus.component import ConfigurationError, Problem, Signal
from fmus.fmu import FmuComponent
from harness.campaign import Campaign, Case
from harness.crankrows import rows_apart
from harness.criteria import bound_misfit
from harness.definitions import misfits, results, shown_unit
from harness.references import place_at
from harness.reportchecks import axis_metric_problems, figure_problems, histogram_problems, ranking_problems
from harness.system import System
from harness.wiring import wire

# How many cases of an experiment are tried until one can be wired without dying of it.
ATTEMPTS = 3


@dataclass(frozen=True)
class Readiness:
    """What is known of a campaign once it is wired: the units that its metrics' values are shown in."""

    units: Mapping[str, str]


def recorded_signals(case: Case) -> list[Signal]:
    """The signals that the record of a case will have, once its FMUs proved to work. Raises ConfigurationError."""
    with wire(case.scenario, case.places) as system:
        _prove(system, case)
        return [system.bus[place] for place in system.recorded]


def _prove(system: System, case: Case) -> None:
    """Whether every FMU gives an instance."""
    problems = []
    for name, component in system.components.items():
        if isinstance(component, FmuComponent):
            try:
                component.prove()
            except ConfigurationError as error:
                problems += [case.places.problem(str(one), "parts", name, "use") for one in error.problems]
    if problems:
        raise ConfigurationError(problems)


def preflight(campaign: Campaign, look: Callable[[Case], list[Signal] | None] = recorded_signals) -> Readiness:
    """Wire the first case of each experiment and check metrics, criteria and figures against its signals.

    `look` wires a case and gives the signals it records, None where the case dies of that: then the next one is taken,
    and of an experiment whose first ATTEMPTS cases all die nothing is said.

    Raises ConfigurationError: every problem of every experiment, each once.
    """
    problems: list[Problem] = []
    units: dict[str, str] = {}
    signals: dict[str, Mapping[str, Signal]] = {}
    apart: dict[str, float | None] = {}
    for experiment, cases in first_cases(campaign).items():
        try:
            recorded = next((found for found in map(look, cases) if found is not None), None)
        except ConfigurationError as error:
            problems += error.problems
            continue
        if recorded is None:
            continue
        signals[experiment] = {signal.name: signal for signal in recorded}
        apart[experiment] = rows_apart(cases[0].scenario)
        for name, definition in campaign.metrics.items():
            if definition.covers(experiment):
                found = misfits(name, definition, signals[experiment], campaign.places, apart[experiment])
                problems += found
                if not found:
                    units |= _units(campaign, name, signals[experiment])
    problems += _criterion_problems(campaign, units)
    problems += figure_problems(campaign, signals, apart)
    problems += histogram_problems(campaign, signals, apart)
    problems += axis_metric_problems(campaign, units)
    problems += ranking_problems(campaign, units)
    if problems:
        raise ConfigurationError(sorted(dict.fromkeys(problems), key=lambda one: (one.file, one.line, one.column)))
    return Readiness(units)


def first_cases(campaign: Campaign) -> dict[str, list[Case]]:
    """The first ATTEMPTS cases of each experiment."""
    first: dict[str, list[Case]] = {}
    for case in campaign.cases:
        if len(first.setdefault(case.experiment, [])) < ATTEMPTS:
            first[case.experiment].append(case)
    return first


def _units(campaign: Campaign, name: str, signals: Mapping[str, Signal]) -> dict[str, str]:
    values = results({name: campaign.metrics[name]})
    return {value: shown_unit(campaign.metrics[name], result, signals) for value, (_, result) in values.items()}


def _criterion_problems(campaign: Campaign, units: Mapping[str, str]) -> Iterator[Problem]:
    accepted = [
        ("accept", criterion, ("accept", index, criterion.experiment))
        for index, criterion in enumerate(campaign.criteria)
    ]
    stated = [
        ("holds", criterion, ("report", "published", index, "holds"))
        for index, criterion in campaign.statements.items()
    ]
    for section, criterion, where in [*accepted, *stated]:
        sides = [side.metric for side in (criterion.left, criterion.right) if side.metric]
        message = bound_misfit(criterion, units) if all(metric in units for metric in sides) else ""
        if message:
            yield place_at(f"{section}: {message}", campaign.places.of(where), 0)
