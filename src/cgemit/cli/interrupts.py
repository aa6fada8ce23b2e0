"""Ctrl-C, or SIGTERM, always ends the run, wherever it arrives."""

from __future__ import annotations

import _thread
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager

_AGAIN = 0.02  # s


@contextmanager
def interrupts_kept() -> Iterator[None]:
    """Repeat an interrupt that Python has dropped, and take SIGTERM for one.

    By default SIGTERM ends the process on the spot, and unfinished folders stay behind.

    An exception that arises while an object is taken down (a finalizer, a weak reference's callback) is reported and
    forgotten; matplotlib has many of these, so that Ctrl-C during the drawing would sometimes do nothing.
    """
    report = sys.unraisablehook

    def repeat(dropped: sys.UnraisableHookArgs) -> None:
        if dropped.exc_type is KeyboardInterrupt:
            # Later and from outside: here it would be dropped again.
            threading.Timer(_AGAIN, _thread.interrupt_main).start()
        else:
            report(dropped)

    sys.unraisablehook = repeat
    # Python handles signals in its main thread only; a program that calls us may have a handler of its own.
    takes_over = (
        threading.current_thread() is threading.main_thread() and signal.getsignal(signal.SIGTERM) == signal.SIG_DFL
    )
    if takes_over:
        signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        sys.unraisablehook = report
        if takes_over:
            signal.signal(signal.SIGTERM, signal.SIG_DFL)
