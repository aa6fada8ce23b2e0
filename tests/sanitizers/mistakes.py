"""Make one of the mistakes of mistakes.cpp: ``python mistakes.py LIBRARY NAME``."""

import ctypes
import sys
import threading

library, name = sys.argv[1:]
mistake = getattr(ctypes.CDLL(library), name)
if name == "race":
    counter = ctypes.c_int()
    both = threading.Barrier(2)

    def run() -> None:
        both.wait()
        mistake(ctypes.byref(counter))  # releases the lock of the interpreter

    threads = [threading.Thread(target=run) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
else:
    for _ in range(3):
        mistake(7)
