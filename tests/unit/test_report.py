"""Reports: one file that needs nothing else; sentences that hold for the numbers they explain."""

import base64
import re
from html.parser import HTMLParser

import numpy as np
import pytest

from cgemit.statistics.estimate import measure
from cgemit.study.paper import rows
from cgemit.study.paper.published import paper_values
from cgemit.study.report import Code, Image, Note, Section, TableOf, html_report

PNG = b"\x89PNG\r\n\x1a\n not really"
VOID = {"meta", "img"}


class Outline(HTMLParser):
    """Checks that tags close in order and keeps their attributes."""

    def __init__(self):
        super().__init__()
        self.open, self.attributes, self.tags = [], [], []

    def handle_starttag(self, tag, attrs):
        """Open a tag."""
        self.tags.append(tag)
        self.attributes += [(tag, *pair) for pair in attrs]
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        """Close the tag that was opened last."""
        assert self.open.pop() == tag


def outline(page):
    """Parse a page and make sure it is complete and refers to nothing outside."""
    parsed = Outline()
    parsed.feed(page)
    assert parsed.open == []
    for tag, name, value in parsed.attributes:
        if name in ("src", "href", "srcset", "action"):
            assert value.startswith("data:"), (tag, name, value)
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


def test_missing_picture_is_an_error(tmp_path):
    with pytest.raises(FileNotFoundError):
        html_report("t", "l", [Section("s", [Image(tmp_path / "none.png", "t", "c")])])


def test_deviation_says_how_far_and_in_which_direction():
    assert rows.deviation(190.0, 4.0, 200.0) == "5.0 % below the paper (2.5 standard errors)"
    assert rows.deviation(210.0, 4.0, 200.0) == "5.0 % above the paper (2.5 standard errors)"
    assert rows.deviation(100.0, 1.0, 200.0) == "50.0 % below the paper"


def test_x_rms_is_explained_by_missing_deltas_only_where_that_holds():
    projected, with_deltas = rows.explain_x_rms(138.7, 0.3, 217.1, 0.0), rows.explain_x_rms(215.0, 3.0, 217.1, 0.0035)
    for text in (projected, with_deltas):
        assert "187.6 um" in text
        assert "within ±3 mm" in text
    assert "none here" in projected
    assert "none here" not in with_deltas
    assert "0.35 % lie outside" in with_deltas


def test_track_widths_agree_only_within_errors():
    widths = measure(np.random.default_rng(1).normal(size=1000), parameter="dr", unit="um")
    assert "Agrees" in rows.explain_track("dr", widths, widths.core)
    assert "Agrees" not in rows.explain_track("dr", widths, 1.2 * widths.core)
    assert "20.0 % above" in rows.explain_track("dr", widths, widths.core / 1.2)


def test_variant_and_idc_sentences_follow_the_numbers():
    assert "13.0 % more" in rows.explain_gap_variant(3.0, 113.0, 100.0)
    assert "1.0 % less" in rows.explain_gap_variant(3.0, 99.0, 100.0)
    assert "3.00 times" in rows.explain_idc("dz", 0.9, 0.3)
    assert "no tails" in rows.explain_x_core(140.0, 138.0)
    assert "no tails" not in rows.explain_x_core(140.0, 217.0)


def test_published_numbers():
    published = {name: (entry.value, entry.unit) for name, entry in paper_values().items() if entry.value is not None}
    assert published == {
        "x_residual_rms": (217.1, "um"),
        "v_residual_sigma": (129.0, "um"),
        "sigma_dr": (192.0, "um"),
        "sigma_dz": (0.33, "mm"),
        "sigma_p": (5.5, "MeV/c"),
    }
