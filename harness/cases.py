"""Executes the cases of a campaign, each in a worker process, keeps what finishes and judges the whole."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from fmus.component import Signal
from fmus.whereabouts import Whereabouts, doing
from fmus.whole import write_whole
from harness import workplace
from harness.campaign import Campaign, Case
from harness.clock import Grid
from harness.crew import Crew
from harness.criteria import Verdict, judge
from harness.definitions import Definition, digest
from harness.native import settle
from harness.preflight import preflight, recorded_signals
from harness.record import COMPLETE, write_signals
from harness.reported import FILES, write_reported
from harness.run import run
from harness.runfolder import (
    UNFINISHED,
    case_folder,
    judged,
    measure_again,
    read_case,
    signals_path,
    write_acceptance,
    write_campaign,
    write_case,
    write_json,
    write_metrics,
)
from harness.salvage import keep_failure
from harness.signalsfile import GROUP, GroupSize
from harness.stored import StoredRecord
from harness.stream import Ending, Full, Intake, Streamed, Told
from harness.window import Recorded
from harness.wiring import wire
from harness.worker import Outcome, Worker
from harness.workplace import condition

# A worker is replaced after this many cases, so that what a component leaks does not pile up.
CASES_A_WORKER = 200


@dataclass(frozen=True)
class Ended:
    """One case that came to an end: the how-manieth of how many, and how."""

    case: Case
    outcome: str
    message: str
    done: int
    total: int
    reused: bool


@dataclass(frozen=True)
class Underway:
    """One case of `total` that is being run: its rows before `instant` of `grid` are complete."""

    case: Case
    instant: int
    grid: Grid
    total: int

    @property
    def share(self) -> float | None:
        """How much of it is done, from 0 to 1; None where nobody knows when it will end."""
        return None if self.grid.endless else min(max(self.instant - 1, 0) / max(self.grid.steps, 1), 1.0)


@dataclass(frozen=True)
class Result:
    """How a campaign ended."""

    folder: Path
    outcomes: Mapping[str, str]
    verdicts: Sequence[Verdict]

    @property
    def accepted(self) -> bool:
        """True where every case ran to its end and every criterion passed."""
        return all(outcome in COMPLETE for outcome in self.outcomes.values()) and all(
            verdict.passed for verdict in self.verdicts
        )


def execute(
    campaign: Campaign,
    folder: Path,
    jobs: int,
    tell: Callable[[Ended], None],
    finished: Literal["kept", "run again"] = "kept",
    underway: Callable[[Underway], None] = lambda case: None,
) -> Result:
    """Run the cases, `jobs` at a time, and write the run folder; what became of the cases `finished` earlier is said.

    `tell` hears of every case as it ends; `underway` many times a second of each that runs, from a thread of its own
    for each of the `jobs`. Raises ConfigurationError before anything is written; KeyboardInterrupt
    passes through with the finished cases kept.
    """
    with Crew(jobs) as crew:
        return _execute(campaign, folder, crew, tell, finished, underway)


def _execute(
    campaign: Campaign,
    folder: Path,
    crew: Crew,
    tell: Callable[[Ended], None],
    finished: Literal["kept", "run again"],
    underway: Callable[[Underway], None],
) -> Result:
    def look(case: Case) -> list[Signal] | None:
        (worker,) = crew.workers[:1]
        outcome = worker.call(survey, case, limits=campaign.limits)
        if outcome.error is not None:
            outcome.error.add_note(outcome.message)
            raise outcome.error
        if outcome.kind != "result":
            return None
        signals, left = outcome.value
        if left != "unchanged":
            worker.close()
        return list(signals)

    selected = _selected(campaign)
    units = preflight(campaign, look).units
    kept = [case for case in campaign.cases if finished == "kept" and _finished(folder, case)]
    _clear(folder, [case for case in campaign.cases if case not in kept])
    write_campaign(folder, campaign)
    for number, case in enumerate(kept, start=1):
        content = read_case(folder, case.key)
        if content.get("definitions") != digest(campaign.metrics):
            measure_again(folder, case, campaign.metrics)
        tell(Ended(case, content["outcome"], content["message"], number, len(campaign.cases), reused=True))
    try:
        _run_all(campaign, folder, crew, tell, [case for case in campaign.cases if case not in kept], underway)
    finally:
        write_campaign(folder, campaign)
    cases = [judged(folder, case) for case in campaign.cases]
    write_metrics(folder, cases, campaign.metrics)
    verdicts = [judge(criterion, cases, units) for criterion in campaign.criteria]
    write_acceptance(folder, verdicts)
    if selected is not None:
        write_json(folder / "selection.json", selected)
    write_reported(folder, campaign, cases, units)
    return Result(folder, {case.label: case.outcome for case in cases}, verdicts)


def _selected(campaign: Campaign) -> dict[str, Any] | None:
    """The selection of sensors that the report shows; None where it asks for none. Raises ConfigurationError."""
    if campaign.report.selection is None:
        return None
    from harness.campaignselection import selection_content  # with what it imports, every worker would pay

    return selection_content(campaign.report.selection, campaign)


def survey(case: Case) -> tuple[list[Signal], Literal["unchanged", "changed"]]:
    """The signals that the record of a case will have, and what looking left the process in; see `run_case`."""
    before = condition()
    signals = recorded_signals(case)
    return signals, "unchanged" if before == condition() else "changed"


def run_case(
    case: Case, folder: Path, definitions: Mapping[str, Definition], group: GroupSize = GROUP
) -> Literal["unchanged", "changed"]:
    """Wire, run and keep one case, in a worker; what it left the process in. Raises ConfigurationError, OSError."""
    settle()
    before = condition()
    with doing("wiring"), wire(case.scenario, case.places) as system:
        workplace.tell(Told.of(system, group))
        rows = Streamed(system, group)
        record = run(system, rows=rows)
    after = condition()
    settle()
    with doing("writing"):
        path = signals_path(folder, case.key)
        recorded: Recorded = record
        if rows.handed_over:
            rows.complete()
            recorded = StoredRecord(path)
        else:
            write_signals(record, path, group)
        write_case(folder, case, record, recorded, definitions)
    return "unchanged" if before == after and record.outcome in COMPLETE else "changed"


@dataclass(frozen=True)
class _Attempt:
    """Who calls `run_case`, see `harness.worker.Caller`."""

    case: Case
    intake: Intake
    underway: Callable[[Underway], None]
    total: int

    def answer(self, told: Told, asked: Full | Ending) -> None:
        self.intake.answer(told, asked)

    def look(self, told: Told | None, place: Whereabouts) -> None:
        if told is not None:
            self.underway(Underway(self.case, place.instant, told.grid, self.total))


def _run_all(
    campaign: Campaign,
    folder: Path,
    crew: Crew,
    tell: Callable[[Ended], None],
    cases: Sequence[Case],
    underway: Callable[[Underway], None],
) -> None:
    def run_one(case: Case, worker: Worker) -> None:
        with Intake(signals_path(folder, case.key), worker) as intake:
            attempt = _Attempt(case, intake, underway, len(campaign.cases))

            def call() -> Outcome:
                asked = (run_case, case, folder, campaign.metrics, GROUP)
                return worker.call(*asked, limits=campaign.limits, stopped=crew.stopped, caller=attempt)

            outcome = call()
            if outcome.kind in ("crash", "timeout") and not outcome.first:
                # What an earlier case did to the process may be to blame: the word of a fresh one counts.
                intake.begin_anew()
                outcome = call()
            if outcome.kind != "result":
                keep_failure(folder, case, outcome, intake)
        _clear_unfinished(folder, case)
        if outcome.output:
            write_whole(case_folder(folder, case.key) / "output.txt", outcome.output)
        if outcome.value != "unchanged" or worker.calls >= CASES_A_WORKER:
            worker.close()

    with closing(crew.each(run_one, cases)) as ended:
        for number, case in enumerate(ended, start=len(campaign.cases) - len(cases) + 1):
            content = read_case(folder, case.key)
            tell(Ended(case, content["outcome"], content["message"], number, len(campaign.cases), reused=False))


def _finished(folder: Path, case: Case) -> bool:
    has_signals = signals_path(folder, case.key).is_file()
    return has_signals and read_case(folder, case.key).get("outcome", "") not in UNFINISHED


def _clear(folder: Path, cases: Sequence[Case]) -> None:
    """Nothing of an earlier run is left to be taken for this one's."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in ("acceptance.json", "metrics.csv", "selection.json", "report.html", *FILES):
        (folder / name).unlink(missing_ok=True)
    for case in cases:
        _clear_unfinished(folder, case)
        for name in ("case.json", "output.txt"):
            (case_folder(folder, case.key) / name).unlink(missing_ok=True)


def _clear_unfinished(folder: Path, case: Case) -> None:
    """No file is left that a process was writing when it was lost."""
    for unfinished in case_folder(folder, case.key).glob(".*"):
        unfinished.unlink()
