"""Checks every FMU below a folder, several at a time, and keeps what was found as JSON."""

from __future__ import annotations

import platform
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from importlib.metadata import version
from pathlib import Path
from threading import Event
from typing import Any, NamedTuple

from fmus.component import ConfigurationError
from fmus.description import Validation
from harness.checking import NAMES, Checked, check
from harness.runfolder import VERSIONED, commit, write_json


class Manner(NamedTuple):
    """How FMUs are checked: so many at a time, so many seconds [s] for each probe, by what tier of validation."""

    jobs: int = 1
    seconds: float = 60.0
    validation: Validation = "warn"


def survey(folder: Path, manner: Manner, tell: Callable[[Checked, int, int], None]) -> list[Checked]:
    """Every FMU below the folder as it was checked, by path; `tell` hears of each as it is done, with how many are.

    Raises ConfigurationError: there is no FMU below the folder. KeyboardInterrupt passes through, with no process left.
    """
    files = sorted(path for path in folder.rglob("*.fmu") if path.is_file())
    if not files:
        raise ConfigurationError(f"{folder}: wants a folder with FMUs in it, found no file that ends in .fmu")
    stop = Event()
    found: dict[Path, Checked] = {}
    with ThreadPoolExecutor(manner.jobs) as pool:
        waiting = {pool.submit(check, path, manner.seconds, manner.validation, stop.is_set): path for path in files}
        try:
            for number, future in enumerate(as_completed(waiting), start=1):
                path = waiting[future]
                found[path] = future.result()
                tell(found[path], number, len(files))
        except BaseException:
            stop.set()
            pool.shutdown(wait=True, cancel_futures=True)
            raise
    return [found[path] for path in files]


def as_json(folder: Path, checked: Sequence[Checked], manner: Manner) -> dict[str, Any]:
    """A survey as it is kept; paths of FMUs are those below the folder."""
    rows = [{**one.to_json(), "fmu": Path(one.fmu).relative_to(folder).as_posix()} for one in checked]
    return {
        "folder": str(folder),
        "platform": f"{platform.system()} {platform.machine()}",
        "versions": {"python": platform.python_version(), **{name: version(name) for name in VERSIONED}},
        "commit": commit(),
        "validation": manner.validation,
        "seconds": manner.seconds,
        "probes": list(NAMES),
        "fmus": rows,
    }


def keep(page: Path, content: Any) -> Path:
    """The JSON file written beside a page, of its name."""
    path = page.with_suffix(".json")
    write_json(path, content)
    return path
