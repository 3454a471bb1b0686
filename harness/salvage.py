"""Keeps what is left of a case whose worker did not come back: the rows up to the fault, where it was and why."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from fmus.component import ConfigurationError
from fmus.whereabouts import Whereabouts
from harness.campaign import Case
from harness.record import Record
from harness.runfolder import case_folder, write_case, write_failure
from harness.system import TimeGrid
from harness.worker import Outcome, Worker

# So much of what was printed last goes into the log of the case [characters].
LAST_WORDS = 2000


@dataclass(frozen=True)
class Told:
    """What a worker tells of a case before it can be lost: its record but for the rows, and its instants."""

    record: Record
    grid: TimeGrid


def keep_failure(folder: Path, case: Case, outcome: Outcome, worker: Worker) -> None:
    """Write the case.json of a call that gave no result, and the signals up to the fault where there are any."""
    for unfinished in case_folder(folder, case.key).glob(".*"):
        unfinished.unlink()
    if outcome.place is not None and isinstance(outcome.told, Told):
        write_case(folder, case, _salvaged(outcome, outcome.place, outcome.told, worker), {})
    elif outcome.place is not None:
        began = case.scenario.clock.time.start.si("s")
        text = outcome.message + _where(outcome.stage)
        write_failure(folder, case, outcome.kind, text, _output(outcome), outcome.part, began)
    elif isinstance(outcome.error, ConfigurationError):
        write_failure(folder, case, "error", str(outcome.error))
    else:
        trace = {"category": "trace", "text": outcome.message}
        write_failure(folder, case, "error", f"{type(outcome.error).__name__}: {outcome.error}", [trace])


def _salvaged(outcome: Outcome, place: Whereabouts, told: Told, worker: Worker) -> Record:
    """The record of a lost worker. An instant or part out of range is the fault's own doing, and not believed."""
    grid, order = told.grid, told.record.order
    count = place.instant if 0 < place.instant <= grid.steps + 1 else 0
    part, instant = outcome.part, max(count - 1, 0)
    if outcome.stage == "step" and count:
        part, instant = order[place.number] if 0 <= place.number < len(order) else "", min(count, grid.steps)
    complete = "; all its rows are kept" if count == grid.steps + 1 else ""
    return replace(
        told.record,
        time=grid.instants(count),
        values=worker.rows(count, len(told.record.signals)),
        outcome=outcome.kind,
        part=part,
        failed_at=grid.start + instant * grid.step,
        message=outcome.message + _where(outcome.stage) + complete,
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
