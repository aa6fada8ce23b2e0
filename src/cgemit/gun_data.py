"""Guns and samples as data of run.json, and back."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

from cgemit.gun import Gun, Guns, Source
from cgemit.io.folders import RECORD
from cgemit.samples import EventSample
from cgemit.values import InTurn


def gun_data(gun: Source | Guns | None) -> list[dict[str, Any]] | None:
    """Return the particle source as JSON: one object per gun, a range as ``{"from": low, "to": high}``.

    None stands for given particles.
    """
    if gun is None:
        return None
    guns = gun.guns if isinstance(gun, Guns) else (gun,)
    return [_data_of(one) for one in guns]


def _data_of(one: Source) -> dict[str, Any]:
    """Return one source as JSON; the key ``sample`` tells samples from guns."""
    named = (
        {"sample": one.name, **one.options()} if isinstance(one, EventSample) else {n: getattr(one, n) for n in _GUN}
    )
    return {name: _value_data(name, value) for name, value in named.items()}


def gun_from(data: Any, problems: list[str]) -> Source | Guns | None:
    """Return the source that `gun_data` was made from; None, with problems added, if there are any."""
    if data is None:
        return None
    try:
        guns = [_source_from({name: _value(name, value) for name, value in one.items()}) for one in data]
        return guns[0] if len(guns) == 1 else Guns(tuple(guns))
    except (ValueError, TypeError, KeyError, IndexError, AttributeError) as error:
        problems += [f"{RECORD}: source: {one}" for one in getattr(error, "problems", [error])]
    return None


def _source_from(given: dict[str, Any]) -> Source:
    return EventSample(given.pop("sample"), **given) if "sample" in given else Gun(**given)


_GUN = [f.name for f in fields(Gun)]
_TRIPLES = ("vertex", "vertex_sigma")


def _value_data(name: str, value: Any) -> Any:
    if name in _TRIPLES:
        return [_value_data("", one) for one in value]
    if isinstance(value, InTurn):
        return list(value.values)
    return {"from": value[0], "to": value[1]} if isinstance(value, tuple) else value


def _value(name: str, data: Any) -> Any:
    if name in _TRIPLES:
        return tuple(_value("", one) for one in data)
    return (data["from"], data["to"]) if isinstance(data, dict) else data
