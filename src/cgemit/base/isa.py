"""Choice of the instruction set of the kernels, and the cores of a process.

The fastest that the processor has is chosen when it is first needed; the environment variable ``CGEMIT_ISA`` names
another: ``scalar`` (one track at a time, the reference), ``baseline`` (what every processor of its kind has), ``v3``
(x86-64-v3: AVX2 and FMA, 4 tracks side by side) or ``v4`` (x86-64-v4: AVX-512, 8 tracks).
"""

from __future__ import annotations

import os
from pathlib import Path

from cgemit import _core

NAMES = ("scalar", "baseline", "v3", "v4")
VARIABLE = "CGEMIT_ISA"

_chosen = False  # until then the core uses its scalar kernels, whatever was requested


def available() -> tuple[str, ...]:
    """Return the instruction sets that this build has and this processor runs, slowest first.

    Returns
    -------
    tuple of str
        At least ``"scalar"``.

    Examples
    --------
    >>> cg.isa.available()[0]
    'scalar'
    """
    return tuple(
        name for name in NAMES if name == "scalar" or (_library(name).exists() and _core.kernels.processor_runs(name))
    )


def cores() -> int:
    """Return the number of cores that this process may use, which a batch system or `taskset` can limit.

    Examples
    --------
    >>> cg.isa.cores() >= 1
    True
    """
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def name() -> str:
    """Return the instruction set in use, chosen now if it was not before (`choose`).

    Examples
    --------
    >>> cg.isa.name() in cg.isa.available()
    True
    """
    choose()
    return _core.kernels.isa()


def lanes() -> int:
    """Return how many tracks the kernels in use handle side by side; see `name`.

    Examples
    --------
    >>> cg.isa.lanes() >= 1
    True
    """
    choose()
    return _core.kernels.lanes()


def use(isa: str) -> None:
    """Use another instruction set from now on, in all threads.

    Parameters
    ----------
    isa : str
        One of `available`.

    Raises
    ------
    ValueError
        If it is not available here.

    Examples
    --------
    >>> before = cg.isa.name()
    >>> cg.isa.use("scalar")
    >>> cg.isa.lanes()
    1
    >>> cg.isa.use(before)
    """
    if isa not in available():
        raise ValueError(f"instruction set: {isa!r}, expected one of {', '.join(available())}")
    if isa == "scalar":
        _core.kernels.use_scalar_kernels()
    else:
        _core.kernels.use_kernels(str(_library(isa)))
    global _chosen
    _chosen = True


def choose() -> None:
    """Use what ``CGEMIT_ISA`` names, or else the last of `available`, unless a set has been chosen before.

    Nothing is computed before: every compiled detector, which all kernels take, comes after this.

    Raises
    ------
    ValueError
        If ``CGEMIT_ISA`` names what is not available here.

    Examples
    --------
    >>> cg.isa.choose()
    >>> cg.isa.name() in cg.isa.available()
    True
    """
    if _chosen:
        return
    wanted = os.environ.get(VARIABLE, "")
    if wanted and wanted not in available():
        raise ValueError(f"{VARIABLE}: {wanted!r}, expected one of {', '.join(available())}")
    use(wanted or available()[-1])
    _core.common.keep_memory()


def _library(isa: str) -> Path:
    # Beside the compiled module: an editable installation keeps that apart from the Python files.
    return Path(_core.__file__).with_name(f"_kernels_{isa}.so")
