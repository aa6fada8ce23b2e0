"""Reports: one file that needs nothing else; sentences that hold for the numbers they explain."""

import base64
import re
from html.parser import HTMLParser

import numpy as np
import pytest

from cgemit.analysis.widths import measure
from cgemit.study.paper import results
from cgemit.study.paper.published import paper_values
from cgemit.study.report import Code, Image, Note, Section, TableOf, html_report

PNG = b"\x89PNG\r\n\x1a\n not really"
VOID = {"meta", "img", "input", "br"}
IN_A_LINE = {"a", "b", "br", "code", "img", "input", "label"}  # all that a paragraph may hold


class Outline(HTMLParser):
    """Checks that tags close in order and keeps their attributes."""

    def __init__(self):
        super().__init__()
        self.open, self.attributes, self.tags, self.text = [], [], [], ""

    def handle_starttag(self, tag, attrs):
        """Open a tag."""
        assert "p" not in self.open or tag in IN_A_LINE, tag
        assert "a" not in self.open or tag != "a"
        self.tags.append(tag)
        self.attributes += [(tag, *pair) for pair in attrs]
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        """Close the tag that was opened last."""
        assert self.open.pop() == tag

    def handle_data(self, data):
        """Collect the text that is shown."""
        if "style" not in self.open and "pre" not in self.open:
            self.text += data

    def values(self, name):
        """Return the values of an attribute."""
        return [value for _, known, value in self.attributes if known == name]


def outline(page, folder=None):
    """Parse a page; make sure that it is complete, that it loads nothing from outside, and that its links lead there.

    Links lead to places in the page, files of the folder or arXiv.
    """
    parsed = Outline()
    parsed.feed(page)
    assert parsed.open == []
    places = parsed.values("id")
    assert len(places) == len(set(places))
    for value in parsed.values("src"):
        assert value.startswith("data:image/png;base64,")
    assert not parsed.values("srcset") + parsed.values("action")
    for value in parsed.values("href"):
        if value.startswith("#"):
            assert value[1:] in places
        elif not value.startswith("https://arxiv.org/abs/"):
            assert folder is not None
            assert (folder / value).is_file(), value
    assert not re.search(r"\bum\b", parsed.text)
    assert not {"script", "link", "iframe"} & set(parsed.tags)
    assert not re.search(r"@import|url\(", page)
    return parsed


def test_page_is_self_contained(tmp_path):
    image = tmp_path / "a.png"
    image.write_bytes(PNG)
    table = TableOf(("name", "n"), [["<b>&", "1 ± 2"]], frozenset({1}))
    parts = ["text < text", table, Image(image, "Title", "caption"), Note("careful"), Code("cgemit study")]
    page = html_report("A & B", "lead", [Section("one", parts)])
    parsed = outline(page)
    assert parsed.tags.count("figure") == 1
    assert base64.b64encode(PNG).decode() in page
    assert "&lt;b&gt;&amp;" in page
    assert "<b>&" not in page
    assert '<td class="number">1 ± 2</td>' in page


def test_text_gets_links_contents_and_one_spelling_of_micrometres(tmp_path):
    for name in ("a.png", "a.pdf", "a.csv", "summary.json"):
        (tmp_path / name).write_bytes(PNG)
    text = "650 um of arXiv:1504.02570, drums; summary.json holds <all>"
    parts = [text, Image(tmp_path / "a.png", "T", "30 um", ["a.pdf", "a.csv"]), Code("x --pitch '30 um'")]
    page = html_report("A", "lead", [Section("Pulls at 1 GeV/c", parts), Section("Rest", [])])
    parsed = outline(page, tmp_path)
    links = ["#pulls-at-1-gev-c", "#rest", "https://arxiv.org/abs/1504.02570"]
    assert parsed.values("href") == [*links, "summary.json", "a.pdf", "a.csv"]
    assert "650 µm of" in parsed.text
    assert "drums" in parsed.text
    assert "--pitch &#x27;30 um&#x27;" in page
    assert parsed.tags.count("input") == 1


def test_wide_tables_say_that_they_scroll():
    tables = {n: html_report("A", "l", [Section("s", [TableOf(["x"] * n, [["1"] * n])])]) for n in (7, 8)}
    assert [outline(page).text.count("scroll sideways") for page in tables.values()] == [0, 1]


def test_missing_picture_is_an_error(tmp_path):
    with pytest.raises(FileNotFoundError):
        html_report("t", "l", [Section("s", [Image(tmp_path / "none.png", "t", "c")])])


def test_deviation_says_how_far_and_in_which_direction():
    assert results.deviation(190.0, 4.0, 200.0) == "5.0 % below the paper (2.5 standard errors)"
    assert results.deviation(210.0, 4.0, 200.0) == "5.0 % above the paper (2.5 standard errors)"
    assert results.deviation(100.0, 1.0, 200.0) == "50.0 % below the paper"


def test_x_rms_is_explained_by_missing_deltas_only_where_that_holds():
    projected, with_deltas = (
        results.explain_x_rms(138.7, 0.3, 217.1, 0.0),
        results.explain_x_rms(215.0, 3.0, 217.1, 0.0035),
    )
    for text in (projected, with_deltas):
        assert "187.6 um" in text
        assert "within ±3 mm" in text
    assert "none here" in projected
    assert "none here" not in with_deltas
    assert "0.35 % lie outside" in with_deltas


def test_track_widths_agree_only_within_errors():
    widths = measure(np.random.default_rng(1).normal(size=1000), parameter="dr", unit="um")
    assert "Agrees" in results.explain_track("dr", widths, widths.core)
    assert "Agrees" not in results.explain_track("dr", widths, 1.2 * widths.core)
    assert "20.0 % above" in results.explain_track("dr", widths, widths.core / 1.2)


def test_variant_and_idc_sentences_follow_the_numbers():
    assert "13.0 % more" in results.explain_gap_variant(3.0, 113.0, 100.0)
    assert "1.0 % less" in results.explain_gap_variant(3.0, 99.0, 100.0)
    assert results.explain_gap_variant(3.0, 99.0, 100.0, "tiger").endswith("1.0 % less than with the nominal gap.")
    assert results.explain_x_window(1.0, 3, 100, 0, "tiger") == "3 of 100 residuals are outside. Read-out tiger."
    assert "3.00 times" in results.explain_idc("dz", 0.9, 0.3)
    assert "no tails" in results.explain_x_core(140.0, 138.0)
    assert "no tails" not in results.explain_x_core(140.0, 217.0)


def test_published_numbers():
    published = {name: (entry.value, entry.unit) for name, entry in paper_values().items() if entry.value is not None}
    assert published == {
        "x_residual_rms": (217.1, "um"),
        "v_residual_sigma": (129.0, "um"),
        "sigma_dr": (192.0, "um"),
        "sigma_dz": (0.33, "mm"),
        "sigma_p": (5.5, "MeV/c"),
    }
