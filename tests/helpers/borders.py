"""Calls of the compiled module that are recorded, and repeated with each of their numbers replaced by a wrong one.

A function of `cgemit._core` may refuse a number or compute with it. It must come to an end, and not end the process.
"""

from __future__ import annotations

import contextlib
import faulthandler
import os
import resource
import signal
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from types import ModuleType
from typing import Any

import numpy as np

from cgemit import _core

#: Replaces a number.
WRONG = (np.nan, np.inf, -np.inf, -1.0, 0.0, 1e308, -1e300)
SECONDS, BYTES = 4, 8 * 2**30


@dataclass
class Call:
    """A call of a function of the compiled module."""

    name: str
    function: Callable[..., Any]
    arguments: tuple[Any, ...]
    keywords: dict[str, Any]
    leaves: list[tuple[Any, ...]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.leaves = list(leaves((self.arguments, self.keywords)))

    def repeat(self, path: tuple[Any, ...], value: float) -> None:
        """Call it again with another value at the path."""
        arguments, keywords = replaced((self.arguments, self.keywords), path, value)
        self.function(*arguments, **keywords)


def leaves(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Yield the paths of all numbers with a fraction; of an array the middle one, and all at once (None)."""
    if isinstance(value, float):
        yield path
    elif isinstance(value, np.ndarray) and value.dtype.kind == "f" and value.size:
        yield from ((*path, step) for step in (value.size // 2, None))
    elif isinstance(value, (list, tuple)):
        for i, one in enumerate(value):
            yield from leaves(one, (*path, i))
    elif isinstance(value, dict):
        for name, one in value.items():
            yield from leaves(one, (*path, name))


def entries(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Yield the paths of all entries of the dicts among arguments: columns of tables, and settings."""
    if isinstance(value, dict):
        for name, one in value.items():
            yield (*path, name)
            yield from entries(one, (*path, name))
    elif isinstance(value, (list, tuple)):
        for i, one in enumerate(value):
            yield from entries(one, (*path, i))


def of_another_type(value: Any) -> Any:
    """Return a value that stands for none of this type: text for a number, a number for text."""
    if isinstance(value, np.ndarray):
        return np.full(value.shape, "text")
    return 0.5 if isinstance(value, str) else "text"


def changed(value: Any, path: tuple[Any, ...], change: Callable[[Any], Any] | None) -> Any:
    """Return a copy in which the entry at the path is changed, or missing without a change."""
    step, *rest = path
    if isinstance(value, dict):
        if not rest:
            others = {name: one for name, one in value.items() if name != step}
            return others if change is None else value | {step: change(value[step])}
        return value | {step: changed(value[step], tuple(rest), change)}
    return type(value)(changed(one, tuple(rest), change) if i == step else one for i, one in enumerate(value))


def replaced(value: Any, path: tuple[Any, ...], number: float) -> Any:
    """Return a copy in which the number at the path is another one."""
    if not path:
        return number
    step, *rest = path
    if isinstance(value, np.ndarray):
        copied = value.copy()
        copied.reshape(-1)[slice(None) if step is None else step] = number
        return copied
    if isinstance(value, dict):
        return value | {step: replaced(value[step], tuple(rest), number)}
    return type(value)(replaced(one, tuple(rest), number) if i == step else one for i, one in enumerate(value))


def compiled_names() -> list[tuple[ModuleType, str, Any]]:
    """Return the submodules of the compiled module with the names and objects that each defines."""
    parts = [one for name, one in vars(_core).items() if isinstance(one, ModuleType) and not name.startswith("_")]
    return [(part, name, one) for part in parts for name, one in vars(part).items() if not name.startswith("_")]


@contextlib.contextmanager
def recorded(calls: dict[str, list[Call]], most: int = 2) -> Iterator[None]:
    """Record the first calls of each function, and of the constructor of each class, while the context lasts."""
    originals = []

    def record(owner: Any, attribute: str, name: str) -> None:
        original = getattr(owner, attribute)
        originals.append((owner, attribute, original))

        def called(*arguments: Any, **keywords: Any) -> Any:
            made = isinstance(owner, type)  # without the object that is made
            if len(calls.setdefault(name, [])) < most:
                calls[name].append(Call(name, owner if made else original, arguments[made:], keywords))
            return original(*arguments, **keywords)

        setattr(owner, attribute, called)

    for part, name, one in compiled_names():
        if not callable(one):
            continue
        if not isinstance(one, type):
            record(part, name, name)
        elif "__init__" in vars(one) and not hasattr(one, "__members__"):
            record(one, "__init__", name)
    try:
        yield
    finally:
        for owner, attribute, original in originals:
            setattr(owner, attribute, original)


def deaths(call: Call, wrong: tuple[float, ...] = WRONG) -> list[str]:
    """Repeat a call in processes of their own with every wrong number; say which ended the process, and how."""
    tries = [(path, value) for path in call.leaves for value in wrong]
    found, done = [], 0
    while done < len(tries):
        reader, writer = os.pipe()
        child = os.fork()
        if not child:
            _run(call, tries[done:], writer)
        os.close(writer)
        with os.fdopen(reader, "rb") as ended:
            done += len(ended.read())
        status = os.waitpid(child, 0)[1]
        if done < len(tries):
            path, value = tries[done]
            by = signal.Signals(os.WTERMSIG(status)).name if os.WIFSIGNALED(status) else f"exit code {status >> 8}"
            found.append(f"{call.name}{path}: {value}: {by}")
            done += 1
    return found


def _run(call: Call, tries: list[tuple[tuple[Any, ...], float]], writer: int) -> None:
    resource.setrlimit(resource.RLIMIT_AS, (BYTES, BYTES))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    faulthandler.disable()
    for path, value in tries:
        signal.alarm(SECONDS)
        with contextlib.suppress(Exception):
            call.repeat(path, value)
        os.write(writer, b".")
    os._exit(0)
