"""Self-contained HTML reports: tables, pictures embedded in the page, nothing from outside."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

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
figure { margin: 1.6rem 0 2.2rem; }
figure img { max-width: 100%; height: auto; display: block; margin: 0 auto; }
figcaption { color: #4a5464; font-size: .92rem; margin-top: .5rem; }
figcaption b { color: #1d2430; }
.note { background: #fff7e8; border-left: 4px solid #e69f00; padding: .6rem .9rem; margin: 1rem 0; }
.wide { overflow-x: auto; }
table.many { font-size: .8rem; }
table.many th, table.many td { padding: .35rem .4rem; }
pre { background: #f4f6f9; padding: .8rem 1rem; overflow-x: auto; border-radius: 4px; }
@media print { body { margin: 0; max-width: none; } h2, figure { break-inside: avoid; } }
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
    """A PNG file with a title and a caption."""

    path: Path
    title: str
    caption: str


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


def html_report(title: str, lead: str, sections: Sequence[Section]) -> str:
    """Return a whole HTML page that needs no other file and no network.

    Parameters
    ----------
    title, lead : str
        Heading, and the sentence below it.
    sections : sequence of Section

    Raises
    ------
    FileNotFoundError
        If a picture is missing.
    """
    body = [f"<h1>{escape(title)}</h1>", f'<p class="lead">{escape(lead)}</p>']
    for section in sections:
        body.append(f"<h2>{escape(section.title)}</h2>")
        body += [_html(part) for part in section.parts]
    head = (
        '<meta charset="utf-8">\n<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>{_CSS}</style>"
    )
    page = "\n".join(body)
    return f'<!DOCTYPE html>\n<html lang="en">\n<head>\n{head}\n</head>\n<body>\n{page}\n</body>\n</html>\n'


def _html(part: Part) -> str:
    match part:
        case TableOf():
            return _table(part)
        case Image():
            data = base64.b64encode(part.path.read_bytes()).decode("ascii")
            image = f'<img src="data:image/png;base64,{data}" alt="{escape(part.title)}">'
            caption = f"<b>{escape(part.title)}.</b> {escape(part.caption)}"
            return f"<figure>{image}<figcaption>{caption}</figcaption></figure>"
        case Note():
            return f'<p class="note">{escape(part.text)}</p>'
        case Code():
            return f"<pre><code>{escape(part.text)}</code></pre>"
        case _:
            return f"<p>{escape(part)}</p>"


def _table(table: TableOf) -> str:
    def attributes(column: int) -> str:
        name = "number" if column in table.numbers else "why" if column in table.texts else ""
        return f' class="{name}"' if name else ""

    head = "".join(f"<th{attributes(i)}>{escape(text)}</th>" for i, text in enumerate(table.headers))
    cells = ("".join(f"<td{attributes(i)}>{escape(text)}</td>" for i, text in enumerate(row)) for row in table.rows)
    body = "\n".join(f"<tr>{row}</tr>" for row in cells)
    kind = ' class="many"' if len(table.headers) >= _MANY else ""
    return f'<div class="wide"><table{kind}><thead><tr>{head}</tr></thead><tbody>\n{body}\n</tbody></table></div>'
