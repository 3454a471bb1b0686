"""The pytest plug-in: one test a criterion of a run folder, and a fixture that reads run folders.

`pytest runs/driveline` collects the criteria of `runs/driveline/acceptance.json`, named as the campaign names them.
A test of one's own reads a run with the fixture `crankbench_run`:

    def test_the_hybrid_observer_stays_close(crankbench_run):
        run = crankbench_run("runs/driveline")
        assert run.metric("rmse_hybrid").max() < 1e-3

Relative paths are taken from pytest's root directory. Nothing but pytest is imported before a run folder is met.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from reports.folder import Criterion, Run


def pytest_collect_file(file_path: Path, parent: pytest.Collector) -> pytest.Collector | None:
    """The campaign.json of a run folder stands for its criteria, so that a missing acceptance.json is noticed."""
    if file_path.name != "campaign.json" or not _is_run_folder(file_path.parent):
        return None
    criteria: pytest.Collector = AcceptanceFile.from_parent(parent, path=file_path.with_name("acceptance.json"))
    return criteria


def pytest_ignore_collect(collection_path: Path) -> bool | None:
    """The cases of a run folder hold records, not tests."""
    if collection_path.name == "cases" and _is_run_folder(collection_path.parent):
        return True
    return None


@pytest.fixture(scope="session")
def crankbench_run(request: pytest.FixtureRequest) -> Callable[[Path | str], Run]:
    """A function that reads a run folder; a relative path is taken from pytest's root directory."""
    from reports.folder import read_run

    return lambda folder: read_run(request.config.rootpath / folder)


class AcceptanceFile(pytest.File):
    """acceptance.json of a run folder."""

    def collect(self) -> Iterable[pytest.Item]:
        """One test a criterion. Raises CollectError: the run folder cannot be read or was not judged."""
        from reports.folder import RunFolderError, read_criteria, read_run

        try:
            criteria = read_criteria(self.path.parent)
            run = read_run(self.path.parent)
        except RunFolderError as error:
            raise self.CollectError(str(error)) from error
        if run.missing and not criteria:
            raise self.CollectError(_incomplete(run))
        taken: dict[str, int] = {}
        for criterion in criteria:
            taken[criterion.name] = taken.get(criterion.name, 0) + 1
            again = f" ({taken[criterion.name]})" if taken[criterion.name] > 1 else ""
            yield CriterionTest.from_parent(self, name=criterion.name + again, criterion=criterion, run=run)


class CriterionTest(pytest.Item):
    """One criterion: passes where it was met and every case of the campaign is there."""

    def __init__(self, *, criterion: Criterion, run: Run, **rest: Any) -> None:
        super().__init__(**rest)
        self.criterion, self.run = criterion, run

    def runtest(self) -> None:
        """Raises AssertionError naming the criterion, the value, the bound and the worst case."""
        if not self.criterion.passed:
            raise AssertionError(_verdict(self.criterion, self.run))
        if self.run.missing:
            raise AssertionError(_incomplete(self.run))

    def repr_failure(self, excinfo: pytest.ExceptionInfo[BaseException], style: Any = None) -> Any:
        """The message alone: a traceback into this file helps nobody."""
        return (
            excinfo.getrepr(style="value") if excinfo.errisinstance(AssertionError) else super().repr_failure(excinfo)
        )

    def reportinfo(self) -> tuple[Path, None, str]:
        """The file and a headline that is not the end of the test's id: pytest would write its dots as `::`."""
        return self.path, None, f"criterion: {self.name}"


def _is_run_folder(path: Path) -> bool:
    return (path / "campaign.json").is_file() and any((path / name).exists() for name in ("cases", "acceptance.json"))


def _verdict(criterion: Criterion, run: Run) -> str:
    unit = "" if criterion.unit in ("", "1") else f" {criterion.unit}"
    worst = next((case for case in run.cases if case.key == criterion.case), None)
    lines = [f"value {criterion.value:.6g}{unit}, bound {criterion.bound:.6g}{unit}: {criterion.name}"]
    if worst is not None:
        lines.append(f"worst case: {worst.label} ({worst.key}), {worst.outcome}")
    elif criterion.case:
        lines.append(f"worst case: {criterion.case}")
    if criterion.reason:
        lines.append(criterion.reason)
    if run.missing:
        lines.append(_incomplete(run))
    lines.append(f"in {run.path}")
    return "\n".join(lines)


def _incomplete(run: Run) -> str:
    named = ", ".join(case.label for case in run.missing[:5]) + (", ..." if len(run.missing) > 5 else "")
    return f"incomplete campaign: {len(run.missing)} of {len(run.cases)} cases have no case.json: {named}"
