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


def main() -> None:
    """Run the command and print its exit code, its seconds, and bytes of resident memory at their peak.

    `largest` is the largest process of all that came of it. What the system says at its end leaves out processes that
    others have waited for, so each is also asked for its own peak every 20 ms, where the system tells (Linux). There
    `together` is what all held at one time, memory that they share counted once; elsewhere it is 0.
    """
    begin = time.perf_counter()
    process = subprocess.Popen(sys.argv[1:], stdout=sys.stderr)
    largest, together, ended = 0, 0, 0
    while not ended:
        family = _family(process.pid)
        largest = max(largest, *(_kilobytes(number, "status", "VmHWM") for number in family))
        together = max(together, sum(_kilobytes(number, "smaps_rollup", "Pss") for number in family))
        time.sleep(LOOK)
        ended, status, usage = os.wait4(process.pid, os.WNOHANG)
    seconds = time.perf_counter() - begin
    largest = max(1024 * largest, usage.ru_maxrss * (1 if sys.platform == "darwin" else 1024))
    code = os.waitstatus_to_exitcode(status)
    print(json.dumps({"code": code, "seconds": seconds, "largest": largest, "together": 1024 * together}))


def _family(number: int) -> list[int]:
    """A process and all that came of it and is still there; no more than itself where the system does not tell."""
    found = [number]
    for task in Path(f"/proc/{number}/task").glob("*/children"):
        with suppress(OSError):
            for child in task.read_text().split():
                found += _family(int(child))
    return found


def _kilobytes(number: int, file: str, name: str) -> int:
    """An entry of a file of a process under /proc; 0 where there is none, as when the process has just ended."""
    with suppress(OSError):
        for entry in Path(f"/proc/{number}/{file}").read_text().splitlines():
            if entry.startswith(f"{name}:"):
                return int(entry.split()[1])
    return 0


if __name__ == "__main__":
    main()
