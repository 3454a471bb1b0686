"""The selection of sensors that a campaign's report shows beside its results."""

from __future__ import annotations

from typing import Any

from fmus.component import ConfigurationError
from harness.campaign import Campaign
from harness.operating import Operation
from harness.reportsection import ReportedSelection
from harness.selecting import SHOWN, select
from harness.wishes import Wishes


def selection_content(asked: ReportedSelection, campaign: Campaign) -> dict[str, Any]:
    """What selection.json holds of what a campaign's report asks for, as `crankbench select --json` has it.

    Raises ConfigurationError: names that are not known, nothing that sees the states; at the key of the campaign.
    """
    wishes = Wishes(
        estimate=asked.estimate,
        most=asked.max_sensors,
        method=asked.method,
        sensors=asked.sensors,
        noise=[f"{name}={noise}" for name, noise in asked.noise.items()],
        period=str(asked.period),
        process=asked.process
        if isinstance(asked.process, float)
        else {name: str(value) for name, value in asked.process.items()},
        disturbances=[f"{name}={value}" for name, value in asked.disturbances.items()],
    )
    about = [f"{name}={value}" for name, value in asked.about.items()]
    operation = Operation(asked.target, asked.at, asked.parameter_set, asked.settle, about=about)
    others = [operation._replace(point=(*asked.at, place)) for place in asked.also_at]
    try:
        selected = select(operation, wishes, others, lambda what, done, total: None)
    except ConfigurationError as error:
        problems = [
            campaign.places.problem(f"report: selection: {one.message}", "report", "selection")
            for one in error.problems
        ]
        raise ConfigurationError(problems) from error
    return selected.to_json(SHOWN)
