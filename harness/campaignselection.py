"""The selection of sensors that a campaign's report shows beside its results."""

from __future__ import annotations

from typing import Any

from fmus.component import ConfigurationError
from harness.campaign import Campaign
from harness.operating import Operation
from harness.selecting import SHOWN, select
from harness.wishes import Wishes


def selection_content(campaign: Campaign) -> dict[str, Any] | None:
    """What selection.json holds, as `crankbench select --json` has it; None where the campaign asks for none.

    Raises ConfigurationError: names that are not known, nothing that sees the states; at the key of the campaign.
    """
    asked = campaign.report.selection
    if asked is None:
        return None
    wishes = Wishes(
        estimate=asked.estimate,
        most=asked.max_sensors,
        method=asked.method,
        sensors=asked.sensors,
        noise=[f"{name}={noise}" for name, noise in asked.noise.items()],
        period=str(asked.period),
        process=asked.process,
    )
    others = [Operation(asked.target, (place,), asked.parameter_set) for place in asked.also_at]
    try:
        selected = select(
            Operation(asked.target, (), asked.parameter_set), wishes, others, lambda what, done, total: None
        )
    except ConfigurationError as error:
        problems = [
            campaign.places.problem(f"report: selection: {one.message}", "report", "selection")
            for one in error.problems
        ]
        raise ConfigurationError(problems) from error
    return selected.to_json(SHOWN)
