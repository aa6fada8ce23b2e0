"""Self-contained HTML reports: tables, pictures embedded in the page, nothing from outside."""

from __future__ import annotations

import base64
import re
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

from cgemit.tables.show import shown

# A picture opens at its full size when it is clicked, without a script: its check box covers the page with it.
# A table of many columns is at least 64rem wide, which 1063px with the padding do not hold: then the hint is shown.
# The shadows of .wide lie at the edges; the white covers scroll with the table and hide them at its ends.
_CSS = """
:root { color-scheme: light; }
body { font: 16px/1.55 system-ui, "Segoe UI", Helvetica, Arial, sans-serif; color: #1d2430; background: #fff;
  max-width: 1080px; margin: 2.5rem auto 4rem; padding: 0 1.25rem; }
h1 { font-size: 1.7rem; line-height: 1.25; margin: 0 0 .4rem; }
h2 { font-size: 1.25rem; margin: 2.6rem 0 .8rem; padding-bottom: .25rem; border-bottom: 2px solid #0072b2; }
p.lead { color: #4a5464; margin-top: 0; }
table { border-collapse: collapse; width: 100%; font-size: .93rem; }
th { text-align: left; background: #eef3f8; font-weight: 600; }
th, td { padding: .42rem .6rem; border-bottom: 1px solid #dde3ea; vertical-align: top; }
td.number, th.number { text-align: right; font-variant-numeric: tabular-nums; }
td.number { white-space: nowrap; }
td.why { color: #4a5464; font-size: .88rem; line-height: 1.45; min-width: 22rem; }
tr:hover td { background: #f8fafc; }
a { color: #00527f; }
nav { background: #f4f6f9; border-radius: 4px; padding: .6rem 1rem; }
nav ol { columns: 2 20rem; margin: .3rem 0; padding-left: 1.6rem; }
figure { margin: 1.6rem 0 2.2rem; }
figure img { max-width: 100%; height: auto; display: block; margin: 0 auto; }
figure label { display: block; cursor: zoom-in; }
figure input { position: absolute; opacity: 0; }
figure input:focus-visible + img { outline: 3px solid #0072b2; }
figure label:has(:checked) { position: fixed; inset: 0; z-index: 9; overflow: auto; background: #fff;
  cursor: zoom-out; }
figure label:has(:checked) img { max-width: none; min-width: 100%; }
figcaption { color: #4a5464; font-size: .92rem; margin-top: .5rem; }
figcaption b { color: #1d2430; }
.note { background: #fff7e8; border-left: 4px solid #e69f00; padding: .6rem .9rem; margin: 1rem 0; }
.wide { overflow-x: auto; background: linear-gradient(to right, #fff 30%, transparent) left / 40px 100%,
  linear-gradient(to left, #fff 30%, transparent) right / 40px 100%,
  linear-gradient(to right, #0003, transparent) left / 14px 100%,
  linear-gradient(to left, #0003, transparent) right / 14px 100%; background-repeat: no-repeat;
  background-attachment: local, local, scroll, scroll; }
.hint { display: none; color: #4a5464; font-size: .88rem; margin: .3rem 0; }
table.many { font-size: .8rem; min-width: 64rem; }
table.many th, table.many td { padding: .35rem .4rem; }
pre { background: #f4f6f9; padding: .8rem 1rem; overflow-x: auto; border-radius: 4px; }
@media (max-width: 1063px) { td.why { min-width: 16rem; } .hint { display: block; } }
@media (max-width: 640px) { body { margin-top: 1rem; padding: 0 .7rem; }
  table:has(td.why) tr { display: flex; flex-wrap: wrap; } th.why { display: none; }
  table:has(td.why) th, table:has(td.why) td { flex: 1; border: 0; white-space: normal; }
  table:has(td.why) td.why { flex-basis: 100%; min-width: 0; border-bottom: 1px solid #dde3ea; } }
@media print { body { margin: 0; max-width: none; } h2, figure { break-inside: avoid; } h2, h2 + p {
  break-after: avoid; }
  .wide { overflow: visible; background: none; } .hint { display: none; }
  table.many { font-size: .62rem; min-width: 0; }
  figure img { max-width: 80%; max-height: 45vh; } }
"""

_MANY = 8  # columns from which on a table is set smaller, so that the page holds it


@dataclass(frozen=True)
class TableOf:
    """A table of a report.

    Attributes
    ----------
    headers : sequence of str
    rows : sequence of sequence of str
    numbers : set of int
        Columns that hold numbers.
    texts : set of int
        Columns that hold long text.
    """

    headers: Sequence[str]
    rows: Sequence[Sequence[str]]
    numbers: frozenset[int] = frozenset()
    texts: frozenset[int] = frozenset()


@dataclass(frozen=True)
class Image:
    """A PNG file with a title, a caption and the names of files beside the page that belong to it."""

    path: Path
    title: str
    caption: str
    files: Sequence[str] = ()


@dataclass(frozen=True)
class Note:
    """A paragraph that must not be overlooked."""

    text: str


@dataclass(frozen=True)
class Code:
    """Text to be typed."""

    text: str


#: What a section may hold; a plain string is a paragraph.
Part = TableOf | Image | Note | Code | str


@dataclass(frozen=True)
class Section:
    """A heading and what is below it."""

    title: str
    parts: Sequence[Part]


def html_report(title: str, lead: str, sections: Sequence[Section], first: Sequence[Part] = ()) -> str:
    """Return a whole HTML page that needs no other file and no network.

    In its text, arXiv numbers and files beside the page become links, "um" becomes "µm", and d_ρ and d_z are set as
    symbols.

    Parameters
    ----------
    title, lead : str
        Heading, and the sentence below it.
    sections : sequence of Section
        Of distinct titles.
    first : sequence of Part
        What stands before the contents.

    Raises
    ------
    FileNotFoundError
        If a picture is missing.
    """
    body = [f"<h1>{escape(title)}</h1>", f'<p class="lead">{_text(lead)}</p>', *map(_html, first), _contents(sections)]
    for section in sections:
        body.append(f'<h2 id="{_anchor(section.title)}">{escape(section.title)}</h2>')
        body += [_html(part) for part in section.parts]
    head = (
        '<meta charset="utf-8">\n<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>{_CSS}</style>"
    )
    page = "\n".join(body)
    return f'<!DOCTYPE html>\n<html lang="en">\n<head>\n{head}\n</head>\n<body>\n{page}\n</body>\n</html>\n'


def _anchor(title: str) -> str:
    """Return a heading as the name of its place in the page."""
    return re.sub(r"[^a-z0-9]+", "-", title.lower()).strip("-")


def _contents(sections: Sequence[Section]) -> str:
    entries = "".join(f'<li><a href="#{_anchor(one.title)}">{escape(one.title)}</a></li>' for one in sections)
    return f'<nav aria-label="Contents"><b>Contents</b><ol>{entries}</ol></nav>'


_LINKS = re.compile(r"arXiv:(?P<arxiv>\d{4}\.\d{5})|\b(?P<file>(?:summary|run)\.json)\b")
_SYMBOLS = re.compile(r"\bd_([ρz])\b")


def _text(text: str) -> str:
    """Return a text as HTML, with links, one spelling of the micrometre, and d_ρ and d_z as symbols."""

    def link(found: re.Match[str]) -> str:
        places = {"arxiv": "https://arxiv.org/abs/{}", "file": "{}"}
        kind = found.lastgroup or "file"
        return f'<a href="{places[kind].format(found[kind])}">{found[0]}</a>'

    return _SYMBOLS.sub(r"<i>d</i><sub>\1</sub>", _LINKS.sub(link, escape(shown(text))))


def _html(part: Part) -> str:
    match part:
        case TableOf():
            return _table(part)
        case Image():
            return _figure(part)
        case Note():
            return f'<p class="note">{_text(part.text)}</p>'
        case Code():
            return f"<pre><code>{escape(part.text)}</code></pre>"
        case _:
            return f"<p>{_text(part)}</p>"


def _figure(image: Image) -> str:
    data = base64.b64encode(image.path.read_bytes()).decode("ascii")
    title = escape(image.title)
    picture = (
        f'<label><input type="checkbox" aria-label="Show at full size: {title}">'
        f'<img src="data:image/png;base64,{data}" alt="{title}" title="Click for full size"></label>'
    )
    files = ", ".join(f'<a href="{escape(name)}">{escape(name)}</a>' for name in image.files)
    caption = f"<b>{_text(image.title)}.</b> {_text(image.caption)}" + (f"<br>Files: {files}" if files else "")
    return f"<figure>{picture}<figcaption>{caption}</figcaption></figure>"


def _table(table: TableOf) -> str:
    def attributes(column: int) -> str:
        name = "number" if column in table.numbers else "why" if column in table.texts else ""
        return f' class="{name}"' if name else ""

    head = "".join(f"<th{attributes(i)}>{_text(text)}</th>" for i, text in enumerate(table.headers))
    cells = ("".join(f"<td{attributes(i)}>{_text(text)}</td>" for i, text in enumerate(row)) for row in table.rows)
    body = "\n".join(f"<tr>{row}</tr>" for row in cells)
    many = len(table.headers) >= _MANY
    kind, hint = (' class="many"', _HINT) if many else ("", "")
    content = f"<table{kind}><thead><tr>{head}</tr></thead><tbody>\n{body}\n</tbody></table>"
    # In the order of the keyboard, so that it scrolls with the arrow keys.
    return f'{hint}<div class="wide" tabindex="0">{content}</div>'


_HINT = '<p class="hint">Wide table: scroll sideways for all columns ⟶</p>'
