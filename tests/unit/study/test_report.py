"""Reports: one file that needs nothing else; sentences that hold for the numbers they explain."""

import base64

import numpy as np
import pytest

from cgemit.analysis.widths import measure
from cgemit.study.paper import results
from cgemit.study.paper.published import paper_values
from cgemit.study.report import Code, Image, Note, Section, TableOf, html_report
from outlines import outline

PNG = b"\x89PNG\r\n\x1a\n not really"


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


def test_symbols_are_set_in_text_and_not_in_names_of_files(tmp_path):
    for name in ("d_z.png", "d_z.csv", "figure5_d_rho_d_z.pdf"):
        (tmp_path / name).write_bytes(PNG)
    picture = Image(tmp_path / "d_z.png", "Figure: d_ρ", "caption", ["d_z.csv", "figure5_d_rho_d_z.pdf"])
    page = html_report("t", "σ(d_z) <", [Section("s", [picture])])
    assert "σ(<i>d</i><sub>z</sub>) &lt;" in page
    assert "<b>Figure: <i>d</i><sub>ρ</sub>.</b>" in page
    assert [link for link in outline(page, tmp_path).values("href") if not link.startswith("#")] == picture.files


def test_missing_picture_is_an_error(tmp_path):
    with pytest.raises(FileNotFoundError):
        html_report("t", "l", [Section("s", [Image(tmp_path / "none.png", "t", "c")])])


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
    assert results.explain_x_window(1.0, 3, 100, 0, "tiger") == "3 of 100 residuals are outside. Readout tiger."
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
