"""`crankbench`, and `python -m harness`: one thread for linear algebra, whose matrices are small, then the commands."""

from __future__ import annotations

import os

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def main() -> None:
    """Run a command. Who asks for another number of threads in the environment gets it.

    On a matrix of a hundred rows threads wait for each other, for ten times as long as they work where cores are busy.
    They are counted when NumPy is imported, and so the commands come after.
    """
    for name in THREADS:
        os.environ.setdefault(name, "1")
    from harness.cli import main as commands

    commands()


if __name__ == "__main__":
    main()
