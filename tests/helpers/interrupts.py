"""Programs that tests interrupt."""

import os
import pty
import re
import signal
import subprocess
import termios
from contextlib import contextmanager


def interruptible(command, **options):
    """Start a program that Ctrl-C ends, also where this process ignores it, as jobs in the background do."""
    return subprocess.Popen(command, preexec_fn=_default, **options)


def _default():
    signal.signal(signal.SIGINT, signal.SIG_DFL)


@contextmanager
def on_terminal(command, **options):
    """Start such a program with a terminal for stderr; yield it and a function that reads up to a pattern, or all."""
    ours, theirs = pty.openpty()
    termios.tcsetwinsize(theirs, (24, 100))

    def read(pattern=None):
        found = ""
        while pattern is None or not re.search(pattern, found):
            try:
                found += os.read(ours, 4096).decode()
            except OSError:  # the program has ended
                break
        return found

    with interruptible(command, stderr=theirs, **options) as process:
        os.close(theirs)
        yield process, read
    os.close(ours)
