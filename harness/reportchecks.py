"""Checks what the report asks for against the signals and units of a campaign once it is wired."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Protocol

from fmus.component import Problem, Signal
from harness.arguments import NO_CRANK_ANGLE, dimension
from harness.campaign import Campaign
from harness.definitions import Definition
from harness.ofobservers import of_observer
from harness.places import KeyPath
from harness.reportaxes import Power
from harness.validation import nearest_hint

Signals = Mapping[str, Mapping[str, Signal]]
Apart = Mapping[str, float | None]


# The values of a metric, by its kind, that are shares from 0 to 1 whatever they are measured on.
SHARES: Mapping[str, Sequence[str]] = {
    "accuracy": [""],
    "share_within": [""],
    "detection": ["accuracy"],
    "alarm": ["true_positive_rate", "false_positive_rate"],
}
# Of these the values of the signal tell, after the run.
OF_ONE_SIGNAL = ("final", "minimum", "maximum", "mean")


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


def histogram_problems(campaign: Campaign, signals: Signals, apart: Apart) -> Iterator[Problem]:
    """Errors of signals that are not recorded where their cases count, or of two dimensions; see `figure_problems`."""
    for index, histogram in enumerate(campaign.report.histograms):
        at: KeyPath = ("report", "histograms", index)
        for experiment, known in signals.items():
            if histogram.experiments and experiment not in histogram.experiments:
                continue
            wanted = ""
            for position, pair in enumerate(histogram.pairs):
                for side, name in enumerate(pair):
                    where = (*at, "pairs", position, side)
                    if name not in known:
                        message = f"report: no recorded signal is named '{name}'{nearest_hint(name, known)}"
                        yield campaign.places.problem(message, *where)
                    elif dimension(known[name].unit) != dimension(wanted := wanted or known[name].unit):
                        message = f"report: wants signals in {wanted} or alike, got {name} in {known[name].unit}"
                        yield campaign.places.problem(message, *where)
            if wanted and histogram.reach is not None and dimension(histogram.reach.unit) != dimension(wanted):
                yield campaign.places.problem(f"report: reach wants {wanted}, got {histogram.reach}", *at, "reach")
            yield from _angle_problems(campaign, at, histogram, known, apart[experiment])


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


def axis_metric_problems(campaign: Campaign, units: Mapping[str, str]) -> Iterator[Problem]:
    """Metrics of a curve that are not in one unit, and those of a power that are no shares."""
    parts = dict.fromkeys(part for case in campaign.cases for part in case.scenario.parts)
    for section, entries in campaign.report.against_axes().items():
        for index, asked in enumerate(entries):
            names = [name for name in map(asked.metric_of, asked.named(parts, units)) if name in units]
            for name in names:
                if isinstance(asked, Power):
                    message = _no_share(campaign.metrics, name, units[name])
                else:
                    message = _two_units(names[0], name, units)
                if message:
                    yield campaign.places.problem(f"report: {message}", "report", section, index, "metric")


def _two_units(first: str, name: str, units: Mapping[str, str]) -> str:
    one, other = units[first], units[name]
    return "" if one == other else f"wants one unit, got {first} in {one} and {name} in {other}"


def _no_share(metrics: Mapping[str, Definition], name: str, unit: str) -> str:
    """What is wrong with a metric as a share, as far as its kind and unit tell; empty where nothing is."""
    metric, _, value = name.partition(".")
    kind = metrics[metric].kind_name
    known = kind == "confusion" or value in SHARES.get(kind, ())
    if known or (kind in OF_ONE_SIGNAL and dimension(unit) == dimension("1")):
        return ""
    told = f"{', '.join(sorted({*SHARES, 'confusion'}))}, or {', '.join(OF_ONE_SIGNAL)} of a plain number"
    return f"wants a metric that is a share from 0 to 1, of {told}, got {name}, a {kind} in {unit}"


def ranking_problems(campaign: Campaign, units: Mapping[str, str]) -> Iterator[Problem]:
    """Metrics of a ranking, and those of a measure in it, that are not in the unit of the first."""
    for index, ranking in enumerate(campaign.report.rankings):
        at: KeyPath = ("report", "rankings", index)
        asked: list[tuple[KeyPath, list[str]]] = [(("metric",), list(map(ranking.metric_of, ranking.observers())))]
        for name, measure in ranking.measures.items():
            if measure.metric is not None:
                of_measure = [of_observer(measure.metric, observer) for observer in measure.named]
                asked.append((("measures", name, "metric"), of_measure))
        for key, metrics in asked:
            names = [metric for metric in metrics if metric in units]
            for metric in names:
                message = _two_units(names[0], metric, units)
                if message:
                    yield campaign.places.problem(f"report: a ranking {message}", *at, *key)
