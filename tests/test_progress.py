"""What is told of a campaign while it runs: nothing needless, and how far the running cases are."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console
from rich.progress import Progress, TextColumn

from harness.campaign import Case, read_campaign
from harness.cases import Ended, Underway, execute
from harness.clock import CrankGrid, Grid, TimeGrid
from harness.progress import QUIET, Bar, Lines, all_reached, reached

CAMPAIGN = """\
campaign: told
clock: {time: {step: 1 ms, stop: 4 s}}
parts:
  torque: {use: source, unit: N.m, step: {at: 1 s, from: 0 N.m, to: 1 N.m}}
vary: {seed: 1..5}
"""
TIME = TimeGrid(1.0, 1e-3, 4000)


def crank(stop: float) -> CrankGrid:
    """7200 steps of 6 deg from 90 deg on."""
    return CrankGrid(0.0, 7200, stop, 6.0, 1, 90.0, 120, (), 0.1)


@pytest.fixture
def five(tmp_path: Path) -> tuple[Case, ...]:
    file = tmp_path / "told.yaml"
    file.write_text(CAMPAIGN)
    return read_campaign(file).cases


@pytest.mark.parametrize(
    ("grid", "instant", "said", "share"),
    [
        (TIME, 0, "1 s of 5 s (0 %)", 0.0),
        (TIME, 1, "1 s of 5 s (0 %)", 0.0),
        (TIME, 1001, "2 s of 5 s (25 %)", 0.25),
        (TIME, 4001, "5 s of 5 s (100 %)", 1.0),
        (crank(np.inf), 3601, "21690 deg of 43290 deg (50 %)", 0.5),
        (crank(20.0), 3601, "21690 deg", None),
    ],
)
def test_a_case_is_said_to_be_where_its_last_complete_row_is(
    five: tuple[Case, ...], grid: Grid, instant: int, said: str, share: float | None
) -> None:
    underway = Underway(five[0], instant, grid, 5)
    assert (reached(underway), underway.share) == (said, share)


def test_three_running_cases_are_named_and_the_others_counted(five: tuple[Case, ...]) -> None:
    running = [Underway(case, 1001, TIME, 5) for case in five]
    where = "2 s of 5 s (25 %)"
    assert all_reached(running[:1]) == f"seed = 1 at {where}"
    assert all_reached(running) == f"seed = 1 at {where}; seed = 2 at {where}; seed = 3 at {where}; 2 more"


def test_a_pipe_hears_of_running_cases_only_after_a_while_of_silence(five: tuple[Case, ...]) -> None:
    now, stream = 0.0, io.StringIO()
    lines = Lines(stream, now=lambda: now)
    lines.underway(Underway(five[0], 1, TIME, 5))
    now = QUIET - 0.1
    lines.underway(Underway(five[1], 1, TIME, 5))
    lines.ended(Ended(five[0], "ok", "", 1, 5, reused=False))
    now += QUIET - 0.1
    lines.underway(Underway(five[1], 1001, TIME, 5))
    assert stream.getvalue().splitlines() == ["[1/5] seed = 1  ok"]
    now += 0.1
    lines.underway(Underway(five[1], 2001, TIME, 5))
    lines.underway(Underway(five[1], 2002, TIME, 5))
    assert stream.getvalue().splitlines()[1:] == ["running: seed = 2 at 3 s of 5 s (50 %)"]


def test_a_bar_counts_cases_that_ended_and_grows_with_those_that_run(five: tuple[Case, ...]) -> None:
    console = Console(file=io.StringIO(), force_terminal=True, width=200)
    with Progress(TextColumn("{task.description}"), console=console) as progress:
        bar = Bar(console, progress, progress.add_task("wiring", total=None, count=""))
        (task,) = progress.tasks
        bar.underway(Underway(five[0], 1001, TIME, 5))
        assert (task.total, task.completed, task.fields["count"]) == (5, 0.25, "0/5")
        assert task.description == "seed = 1 at 2 s of 5 s (25 %)"
        bar.ended(Ended(five[0], "error", "no torque", 1, 5, reused=False))
        assert (task.completed, task.fields["count"]) == (1.0, "1/5")


def test_a_campaign_tells_where_its_cases_are_and_never_of_one_that_ended(tmp_path: Path) -> None:
    file = tmp_path / "told.yaml"
    file.write_text(CAMPAIGN.replace("stop: 4 s", "stop: 1000 s"))
    told: list[Ended | Underway] = []
    execute(read_campaign(file), tmp_path / "run", 2, told.append, underway=told.append)
    over: set[str] = set()
    for one in told:
        assert one.case.key not in over
        if isinstance(one, Ended):
            over.add(one.case.key)
        else:
            assert 0 <= one.instant <= 1_000_001 and one.total == 5
    assert len(over) == 5
    # How often depends on how fast the machine is; of a million steps some are told while they go on.
    assert any(1 < one.instant < 1_000_000 for one in told if isinstance(one, Underway))
