"""Executes the cases of a campaign, each in a worker process, keeps what finishes and judges the whole."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, as_completed
from dataclasses import dataclass
from multiprocessing.context import BaseContext
from pathlib import Path
from typing import Literal

from pebble import ProcessExpired, ProcessPool

from fmus.component import ConfigurationError
from harness.campaign import Campaign, Case
from harness.criteria import Verdict, judge
from harness.definitions import Definition, digest
from harness.preflight import preflight
from harness.record import COMPLETE
from harness.run import run
from harness.runfolder import (
    UNFINISHED,
    case_folder,
    judged,
    measure_again,
    read_case,
    write_acceptance,
    write_campaign,
    write_case,
    write_failure,
    write_metrics,
)
from harness.wiring import wire

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
) -> Result:
    """Run the cases, `jobs` at a time, and write the run folder; what became of the cases `finished` earlier is said.

    `tell` hears of every case as it ends. Raises ConfigurationError before anything is written; KeyboardInterrupt
    passes through with the finished cases kept.
    """
    units = preflight(campaign).units
    kept = [case for case in campaign.cases if finished == "kept" and _finished(folder, case)]
    _clear(folder, [case for case in campaign.cases if case not in kept])
    write_campaign(folder, campaign)
    for number, case in enumerate(kept, start=1):
        content = read_case(folder, case.key)
        if content.get("definitions") != digest(campaign.metrics):
            measure_again(folder, case, campaign.metrics)
        tell(Ended(case, content["outcome"], content["message"], number, len(campaign.cases), reused=True))
    try:
        _run_all(campaign, folder, jobs, tell, [case for case in campaign.cases if case not in kept])
    finally:
        write_campaign(folder, campaign)
    cases = [judged(folder, case) for case in campaign.cases]
    write_metrics(folder, cases, campaign.metrics)
    verdicts = [judge(criterion, cases, units) for criterion in campaign.criteria]
    write_acceptance(folder, verdicts)
    return Result(folder, {case.label: case.outcome for case in cases}, verdicts)


def run_case(case: Case, folder: Path, definitions: Mapping[str, Definition]) -> None:
    """Wire, run and keep one case. Raises ConfigurationError."""
    with wire(case.scenario, case.places) as system:
        record = run(system)
    write_case(folder, case, record, definitions)


def _run_all(campaign: Campaign, folder: Path, jobs: int, tell: Callable[[Ended], None], cases: Sequence[Case]) -> None:
    if not cases:
        return
    pool = ProcessPool(max_workers=min(jobs, len(cases)), max_tasks=CASES_A_WORKER, context=_context())
    before = len(campaign.cases) - len(cases)
    try:
        waiting: dict[Future[None], Case] = {
            pool.schedule(run_case, args=[case, folder, campaign.metrics], timeout=campaign.case_limit): case
            for case in cases
        }
        for number, future in enumerate(as_completed(waiting), start=before + 1):
            case, error = waiting[future], future.exception()
            if error is not None:
                _keep_failure(folder, case, error, campaign.case_limit)
            content = read_case(folder, case.key)
            tell(Ended(case, content["outcome"], content["message"], number, len(campaign.cases), reused=False))
        pool.close()
    except BaseException:
        pool.stop()
        raise
    finally:
        pool.join()


def _keep_failure(folder: Path, case: Case, error: BaseException, limit: float) -> None:
    if isinstance(error, TimeoutError):
        write_failure(folder, case, "timeout", f"took longer than its limit of {limit:g} s and was ended")
    elif isinstance(error, ProcessExpired):
        write_failure(folder, case, "crash", f"its process ended with {_exit_text(error.exitcode)}")
    elif isinstance(error, ConfigurationError):
        write_failure(folder, case, "error", str(error))
    else:
        trace = {"category": "trace", "text": str(error.__cause__ or "")}
        write_failure(folder, case, "error", f"{type(error).__name__}: {error}", [trace])


def _exit_text(code: int | None) -> str:
    if code is not None and code < 0:
        known = {int(one): one.name for one in signal.Signals}
        return f"the signal {known.get(-code, -code)}"
    return f"exit code {code}"


def _finished(folder: Path, case: Case) -> bool:
    has_signals = (case_folder(folder, case.key) / "signals.parquet").is_file()
    return has_signals and read_case(folder, case.key).get("outcome", "") not in UNFINISHED


def _clear(folder: Path, cases: Sequence[Case]) -> None:
    """Nothing of an earlier run is left to be taken for this one's."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in ("acceptance.json", "metrics.csv", "report.html"):
        (folder / name).unlink(missing_ok=True)
    for case in cases:
        (folder / "cases" / case.key / "case.json").unlink(missing_ok=True)


def _context() -> BaseContext:
    """Fresh processes that know nothing of the parent's threads; forked from a warm one where the platform can."""
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    if "forkserver" not in multiprocessing.get_all_start_methods():
        return multiprocessing.get_context("spawn")
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["harness.cases"])
    return context
