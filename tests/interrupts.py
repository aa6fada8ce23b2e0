"""Programs that tests interrupt."""

import signal
import subprocess
from contextlib import contextmanager


def interruptible(command, **options):
    """Start a program that Ctrl-C ends, also where this process ignores it, as jobs in the background do."""
    return subprocess.Popen(command, preexec_fn=_default, **options)


def _default():
    signal.signal(signal.SIGINT, signal.SIG_DFL)


@contextmanager
def interrupts_taken():
    """Let this process take interrupts within the block, whatever it was started with."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
