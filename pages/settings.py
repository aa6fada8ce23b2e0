"""Write docs/settings.md: the text below, and tables of all settings made from their classes.

Run ``python docs/settings_page.py``; a test compares the page with its output.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from cgemit.base.settings import Choice, classes_in, expected, kinds_of
from cgemit.chain.settings import Settings

PAGE = Path(__file__).with_name("settings.md")

TEXT = """\
# Settings

Settings control the stages of the chain; a [detector file](methods/detector.md) describes the detector. Each stage has
a class with a default for every setting, and `Settings` holds the classes of all stages.

## Three ways to give them

In Python:

```python
import cgemit as cg

settings = cg.Settings(simulate=cg.SimulateSettings(deltas=False), fit=cg.FitSettings(loss="mean"))
result = cg.run("besiii-cgem-design", cg.Gun("mu-", p=1.0, cos_theta=0.0), n=100, settings=settings)
```

In a file, TOML or JSON (if the name ends in `.json`). A setting that is not in the file has its default:

```toml
[simulate]
deltas = false

[fit]
loss = "mean"
states = ["hits", 90.0]       # a tuple in Python is a list in a file
```

`cg.Settings.load("my.toml")` reads it, `settings.save("my.toml")` writes all settings. `to_toml`, `from_toml`,
`to_json`, `from_json`, `to_dict` and `from_dict` do the same with text and dicts. The class of each stage has these
methods too. Reading back gives equal settings, to the last bit. TOML has no null: the string `"none"` stands for None,
and a setting that is None by default may be left out.

On the command line, `cgemit study`, `resolution` and `simulate` take a file and single values:

```sh
cgemit settings > my.toml                                        # all defaults, with the allowed values
cgemit simulate -d besiii-cgem --settings my.toml --set fit.loss=mean --p 1 --cos-theta 0 -n 1000 --fit -o out
cgemit settings --settings out/run.json                          # the settings of that run
```

`--set` changes a setting if the first part of the name is a stage. Otherwise it changes a value of the detector
(`--set cgem.L2.pitch_x="500 um"`). The file is applied first, then each `--set` in its order, then options that stand
for a setting: `--no-deltas` (`simulate.deltas`), `--hypothesis` (`fit.hypothesis`), `--states` (`fit.states`). It is an
error if such an option and a `--set` give different values to the same setting. In Python,
`Settings().with_overrides({"fit.loss": "mean"})` is the equivalent of `--set`.

An invalid choice raises an error when the settings are made; mypy finds it earlier. All problems of a file and of the
command line are listed at once, each with its source:

```
cgemit: wrong settings
  my.toml: fit.loss: got 'meen', expected one of 'truncated', 'mean', 'most_probable'; did you mean "mean"?
  --set: fit.tolerance: got -1, expected a positive number
```

## The record of a run

Every output folder of `study`, `resolution` and `simulate` has a `run.json`. It holds the command, the versions of
cgemit, Python and numpy, the seed, the source of particles, all settings of all stages, the complete detector files,
and a hash of this configuration. The tables hold the hash and the seed too.

`cg.Result.load(folder)` reads the files of `result.save(folder)` or `cgemit simulate -o folder` and returns an equal
result. A folder with a damaged file, or with tables of another run, is refused, and the error names every such file.

## All settings

Lengths are in mm, momenta in GeV/c, charges in fC, energies of ionization in keV.
"""


def page() -> str:
    """Return the text of the page."""
    return TEXT + "".join(part for stage, cls in kinds_of(Settings).items() for part in sections(stage, cls))


def sections(path: str, cls: type[Any], name: str = "") -> Iterator[str]:
    """Yield the table of a class of settings, then the tables of the classes that its settings may hold."""
    choice = f' with `name = "{name}"`' if name else ""
    lines = [f"\n### `[{path}]`{choice}: {cls.__name__}\n"]
    lines += ["| setting | default | allowed | meaning |", "|---|---|---|---|"]
    settings, about = cls(), meanings(cls)
    for field, kind in kinds_of(cls).items():
        value = getattr(settings, field)
        default = f'"{value.name}"' if isinstance(kind, Choice) else shown(value)
        cells = [f"`{field}`", default, expected(kind), about.get(field, "")]
        lines.append("| " + " | ".join(cell.replace("|", r"\|") for cell in cells) + " |")
    yield "\n".join(lines) + "\n"
    for field, kind in kinds_of(cls).items():
        for inner_name, inner in classes_in(kind).items():
            yield from sections(f"{path}.{field}", inner, inner_name)


def shown(value: object) -> str:
    """Return a default in the notation of a file."""
    if isinstance(value, tuple):
        return f"[{', '.join(map(shown, value))}]"
    if isinstance(value, bool) or value is None:
        return str(value).lower()
    return f'"{value}"' if isinstance(value, str) else repr(value)


def meanings(cls: type[Any]) -> dict[str, str]:
    """Return the description of each attribute from the docstrings of a class and those it is made from."""
    found: dict[str, str] = {}
    for one in reversed(cls.__mro__):
        section = re.search(
            r"Attributes\n-+\n(.*?)(?:\n\n|\Z)", inspect.cleandoc(vars(one).get("__doc__") or ""), re.DOTALL
        )
        entries = re.split(r"^(\w+(?:, \w+)*) : .*\n?", section[1] if section else "", flags=re.MULTILINE)[1:]
        for names, text in zip(entries[::2], entries[1::2], strict=True):
            found |= dict.fromkeys(names.split(", "), " ".join(text.split()).replace("``", "`"))
    return found


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
