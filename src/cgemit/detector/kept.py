"""What is computed of a part is kept with it: parts never change, and a variant shares most of them with its base."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any, Concatenate, ParamSpec, TypeVar

_P = TypeVar("_P", bound="Part")
_R = TypeVar("_R")
_A = ParamSpec("_A")

_KEPT = "_kept"


class Part:
    """An immutable dataclass that keeps what functions with `once` made of it; neither equality nor files see that."""

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name != _KEPT}


def once(make: Callable[Concatenate[_P, _A], _R]) -> Callable[Concatenate[_P, _A], _R]:
    """Return the function of a part and hashable arguments that calls `make` once for the same object and arguments.

    Looking up an object is faster than hashing its values, as a cache of equal parts has to.
    """

    @wraps(make)
    def kept(part: _P, /, *args: _A.args, **named: _A.kwargs) -> _R:
        key = (make, args) if args else make
        try:
            value: _R = part.__dict__[_KEPT][key]
        except KeyError:
            value = make(part, *args, **named)
            part.__dict__.setdefault(_KEPT, {})[key] = value
        return value

    return kept
