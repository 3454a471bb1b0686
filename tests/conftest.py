"""What all tests share: that an interrupt reaches them however they were started, and the command line in one call."""

from __future__ import annotations

import signal
import sys
import threading

import pytest

from harness.cli import main

# A shell that runs a command in the background lets it ignore interrupts; the tests of interrupts want them heard.
if threading.current_thread() is threading.main_thread() and signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture
def crankbench(monkeypatch, capsys):
    """Calls the command line in this process: (exit code, stdout, stderr)."""

    def call(*arguments):
        monkeypatch.setattr(sys, "argv", ["crankbench", *map(str, arguments)])
        try:
            main()
            code = 0
        except SystemExit as ended:
            code = ended.code or 0
        said = capsys.readouterr()
        return code, said.out, said.err

    return call
