"""What all tests share: that an interrupt reaches them however they were started."""

from __future__ import annotations

import signal
import threading

# A shell that runs a command in the background lets it ignore interrupts; the tests of interrupts want them heard.
if threading.current_thread() is threading.main_thread() and signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
