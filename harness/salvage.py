"""Keeps what is left of a case whose worker did not come back: the rows up to the fault, where it was and why."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from fmus.component import ConfigurationError
from fmus.whereabouts import Whereabouts
from harness.campaign import Case
from harness.clock import CrankGrid
from harness.record import Record
from harness.runfolder import signals_path, write_case, write_failure
from harness.stream import Intake, Told
from harness.worker import Outcome

# So much of what was printed last goes into the log of the case [characters].
LAST_WORDS = 2000


def keep_failure(folder: Path, case: Case, outcome: Outcome, intake: Intake) -> None:
    """Write the case.json of a call that gave no result, and the signals up to the fault where there are any."""
    if outcome.place is not None and isinstance(outcome.told, Told):
        record = _salvaged(outcome, outcome.place, outcome.told, intake)
        if not intake.complete:
            signals_path(folder, case.key).unlink(missing_ok=True)
        write_case(folder, case, record, record, {})
    elif outcome.place is not None:
        began = case.scenario.clock.start.si("s")
        text = outcome.message + _where(outcome.stage)
        write_failure(folder, case, outcome.kind, text, _output(outcome), outcome.part, began)
    elif isinstance(outcome.error, ConfigurationError):
        write_failure(folder, case, "error", str(outcome.error))
    else:
        trace = {"category": "trace", "text": outcome.message}
        write_failure(folder, case, "error", f"{type(outcome.error).__name__}: {outcome.error}", [trace])


def _salvaged(outcome: Outcome, place: Whereabouts, told: Told, intake: Intake) -> Record:
    """The record of a lost worker, whose rows are kept where the disk takes them.

    An instant or part out of range is the fault's own doing, and not believed.
    """
    grid, order = told.grid, told.record.order
    instants = place.instant if 0 < place.instant <= grid.steps + 1 else 0
    rows = (instants - 1) // told.every + 1 if instants else 0
    if rows != intake.believed(told, rows):
        rows = intake.believed(told, rows)
        instants = (rows - 1) * told.every + 1 if rows else 0
    part = outcome.part
    if outcome.stage == "step" and instants:
        part = order[place.number] if 0 <= place.number < len(order) else ""
    kept = "; all its rows are kept" if instants == grid.steps + 1 else ""
    try:
        intake.salvage(told, rows)
    except OSError as error:
        kept = f"; its rows could not be kept: {error}"
    if isinstance(grid, CrankGrid):
        failed_at = intake.last if rows else grid.start
    else:
        reached = min(instants, grid.steps) if outcome.stage == "step" else max(instants - 1, 0)
        failed_at = grid.start + reached * grid.step
    return replace(
        told.record,
        outcome=outcome.kind,
        part=part,
        failed_at=failed_at,
        message=outcome.message + _where(outcome.stage) + kept,
        log=tuple(_output(outcome)),
        wall={"total": outcome.seconds},
    )


def _where(stage: str) -> str:
    """What was being done, as the end of a message."""
    return {"": "", "wiring": " while the case was wired", "writing": " while the case was written"}.get(
        stage, f", in {stage}"
    )


def _output(outcome: Outcome) -> list[dict[str, Any]]:
    """What was printed last, as an entry of the log."""
    if not outcome.output:
        return []
    return [{"part": outcome.part, "category": "output", "text": outcome.output[-LAST_WORDS:]}]
