"""What the report says of all cases together, computed once at the end of a run and kept in its folder."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from harness.campaign import Campaign
from harness.criteria import Criterion, Judged, judge
from harness.curves import curves_content
from harness.definitions import results
from harness.runfolder import write_json

FILES = ("curves.json", "powers.json", "rankings.json", "statements.json")


def write_reported(folder: Path, campaign: Campaign, cases: Sequence[Judged], units: Mapping[str, str]) -> None:
    """Write each of the FILES that the campaign's report asks for; `units` are those of the metrics' values."""
    report = campaign.report
    if campaign.statements:
        write_json(folder / "statements.json", statements_content(campaign.statements, cases, units))
    parts = dict.fromkeys(part for case in campaign.cases for part in case.scenario.parts)
    values = results(campaign.metrics)
    if report.curves:
        observers = [curve.named(parts, values) for curve in report.curves]
        write_json(folder / "curves.json", curves_content(report.curves, cases, observers, units))
    if report.powers:
        from harness.powers import powers_content  # as below

        observers = [power.named(parts, values) for power in report.powers]
        write_json(folder / "powers.json", powers_content(report.powers, cases, observers))
    if report.rankings:
        from harness.rankings import rankings_content  # with what it imports, every worker would pay for it

        write_json(folder / "rankings.json", rankings_content(report.rankings, cases, units))


def statements_content(
    statements: Mapping[int, Criterion], cases: Sequence[Judged], units: Mapping[str, str]
) -> list[dict[str, Any]]:
    """What statements.json holds: of each published entry with a `holds` its number, both sides' values and whether."""
    verdicts = {index: asdict(judge(criterion, cases, units)) for index, criterion in statements.items()}
    return [{"entry": index, "holds": verdict.pop("passed"), **verdict} for index, verdict in verdicts.items()]
