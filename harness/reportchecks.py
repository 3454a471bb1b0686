"""Checks what the report asks for against the signals and units of a campaign once it is wired."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Protocol

from fmus.component import Problem, Signal
from harness.arguments import NO_CRANK_ANGLE, dimension
from harness.campaign import Campaign
from harness.places import KeyPath
from harness.validation import nearest_hint

Signals = Mapping[str, Mapping[str, Signal]]
Apart = Mapping[str, float | None]


class OverAngle(Protocol):
    """Something drawn from records that may want the crank angle of their rows."""

    @property
    def angle(self) -> str | None:
        """The signal that holds it."""

    @property
    def wants_crank(self) -> bool:
        """True where it is needed."""


def figure_problems(campaign: Campaign, signals: Signals, apart: Apart) -> Iterator[Problem]:
    """Traces of signals that are not recorded in the experiment drawn, and crank angles that nobody gives.

    `signals` that are recorded, and the crank angle from row to row [deg], None on a time clock, by experiment.
    """
    for index, figure in enumerate(campaign.report.figures):
        at: KeyPath = ("report", "figures", index)
        experiment = figure.experiment or next(iter(signals), "")
        known = signals.get(experiment)
        if known is None:
            continue
        for panel, traces in enumerate(figure.traces):
            for position, trace in enumerate(traces):
                if trace not in known:
                    message = f"report: no recorded signal is named '{trace}'{nearest_hint(trace, known)}"
                    yield campaign.places.problem(message, *at, "traces", panel, position)
        yield from _angle_problems(campaign, at, figure, known, apart[experiment])


def _angle_problems(
    campaign: Campaign, at: KeyPath, drawn: OverAngle, known: Mapping[str, Signal], apart: float | None
) -> Iterator[Problem]:
    angle = drawn.angle
    if angle is not None and angle not in known:
        message = f"report: no recorded signal is named '{angle}'{nearest_hint(angle, known)}"
        yield campaign.places.problem(message, *at, "angle")
    elif angle is not None and dimension(known[angle].unit) != dimension("rad"):
        message = f"report: angle wants a signal in rad, got {angle} in {known[angle].unit}"
        yield campaign.places.problem(message, *at, "angle")
    elif angle is None and drawn.wants_crank and apart is None:
        key = "over" if getattr(drawn, "over", "time") != "time" else "from"
        yield campaign.places.problem(f"report: {key} {NO_CRANK_ANGLE}", *at, key)


def ranking_problems(campaign: Campaign, units: Mapping[str, str]) -> Iterator[Problem]:
    """Metrics of a ranking that are not in the unit of its first."""
    for index, ranking in enumerate(campaign.report.rankings):
        names = [name for name in map(ranking.metric_of, ranking.observers()) if name in units]
        for name in names:
            if units[name] != units[names[0]]:
                message = (
                    f"report: a ranking wants one unit, got {names[0]} in {units[names[0]]} and {name} in {units[name]}"
                )
                yield campaign.places.problem(message, "report", "rankings", index, "metric")
