"""Make one of the mistakes of mistakes.cpp: ``python mistakes.py LIBRARY NAME``."""

import ctypes
import sys
import threading

library, name = sys.argv[1:]
mistake = getattr(ctypes.CDLL(library), name)
if name == "race":
    counter = ctypes.c_int()
    threads = [threading.Thread(target=mistake, args=(ctypes.byref(counter),)) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
else:
    for _ in range(3):
        mistake(7)
