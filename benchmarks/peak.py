"""How much memory a command takes: `python -m benchmarks.peak COMMAND ...` runs it and prints what was seen, as JSON.

It is a process of its own since a process begins with the peak of the one that started it: this one has but a few MB.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

LOOK = 0.02  # s
PAGE = os.sysconf("SC_PAGE_SIZE") if hasattr(os, "sysconf") else 4096


def main() -> None:
    """Run the command and print its exit code, its seconds, and bytes of resident memory at their peak.

    `largest` is the largest process of all that came of it, by the system's own account; `together` all at one time,
    as seen every 20 ms, where the system tells (Linux), else 0.
    """
    begin = time.perf_counter()
    process = subprocess.Popen(sys.argv[1:], stdout=sys.stderr)
    together, ended = 0, 0
    while not ended:
        together = max(together, sum(_resident(number) for number in _family(process.pid)))
        time.sleep(LOOK)
        ended, status, usage = os.wait4(process.pid, os.WNOHANG)
    seconds = time.perf_counter() - begin
    largest = usage.ru_maxrss * (1 if sys.platform == "darwin" else 1024)
    code = os.waitstatus_to_exitcode(status)
    print(json.dumps({"code": code, "seconds": seconds, "largest": largest, "together": together}))


def _family(number: int) -> list[int]:
    """A process and all that came of it; none where the system does not tell."""
    found = [number]
    for task in Path(f"/proc/{number}/task").glob("*/children"):
        with suppress(OSError):
            for child in task.read_text().split():
                found += _family(int(child))
    return found


def _resident(number: int) -> int:
    with suppress(OSError, IndexError):
        return int(Path(f"/proc/{number}/statm").read_text().split()[1]) * PAGE
    return 0


if __name__ == "__main__":
    main()
