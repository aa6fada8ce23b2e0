"""What was shot, as text for titles."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from cgemit.gun import Gun, Guns, Source
from cgemit.values import InTurn

_NAMES = {"p": "p = {} GeV/c", "pt": "pT = {} GeV/c", "theta": "θ = {} rad", "cos_theta": "cos θ = {}"}


def shot_text(source: Source | Guns | None) -> str:
    """Return particle, momentum and angle of a gun, or of several, as text.

    Parameters
    ----------
    source : Gun, EventSample, Guns or None
        None: particles were given.
    """
    guns: Sequence[Source] = () if source is None else source.guns if isinstance(source, Guns) else (source,)
    texts = []
    for gun in guns:
        if not isinstance(gun, Gun):
            texts.append(repr(gun))
            continue
        given = {name: text for name, text in _NAMES.items() if getattr(gun, name) is not None}
        texts.append(", ".join([str(gun.particle), *(t.format(_value(getattr(gun, n))) for n, t in given.items())]))
    return "; ".join(texts) or "given particles"


def _value(value: Any) -> str:
    if isinstance(value, InTurn):
        return ", ".join(f"{one:g}" for one in value.values[:5]) + (", ..." if len(value.values) > 5 else "")
    return f"{value[0]:g} to {value[1]:g}" if isinstance(value, tuple) else f"{value:g}"
