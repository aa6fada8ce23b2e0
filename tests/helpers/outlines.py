"""Outline of an HTML page, which has to be complete and to load nothing from outside."""

import re
from html.parser import HTMLParser

VOID = {"meta", "img", "input", "br"}


IN_A_LINE = {"a", "b", "br", "code", "i", "img", "input", "label", "sub"}


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
