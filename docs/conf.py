"""Configuration of the documentation's site: `sphinx-build -W -c docs . build/site` from the project's folder."""

import re
import tomllib
from importlib.util import find_spec
from pathlib import Path

PROJECT = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text(encoding="utf-8"))["project"]

project = "cgemit"
author = copyright = PROJECT["authors"][0]["name"]
version = release = PROJECT["version"]

extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.mathjax", "sphinx.ext.napoleon"]
root_doc = "README"
include_patterns = [
    *("README.md", "CHANGELOG.md", "CONTRIBUTING.md", "pages/README.md", "pages/reference/README.md"),
    *("docs/*.md", "docs/how-to/*.md", "docs/methods/*.md", "docs/reference/*.md", "notebooks/*.py"),
]
exclude_patterns = ["build", "docs/*.py"]
# A name such as Detector has several homes, which are the same.
suppress_warnings = ["ref.python"]

html_theme = "furo"
html_title = f"cgemit {release}"
# Formulas need no network: MathJax lies with the pages. Its package is not used as an extension, since it does not
# declare that it is safe for parallel builds.
html_static_path = ["site/static", f"{find_spec('sphinx-mathjax-offline').submodule_search_locations[0]}/static"]
mathjax_path = "mathjax/tex-chtml.js"
html_css_files = ["wide.css"]
html_favicon = "site/favicon.svg"
html_extra_path = ["site/index.html"]  # index.html, which leads to README.html

myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 4
nb_custom_formats = {".py": ["jupytext.reads", {"fmt": "py:percent"}]}
nb_execution_mode = "force"
nb_execution_timeout = 300
nb_execution_raise_on_error = True
nb_execution_in_temp = True
nb_merge_streams = True
nb_output_stderr = "error"

autodoc_member_order = "bysource"
autodoc_typehints = "none"  # the docstrings say more
autodoc_default_options = {"members": True}
napoleon_numpy_docstring = True
napoleon_google_docstring = False
napoleon_use_rtype = False
napoleon_use_param = False
napoleon_custom_sections = [("Attributes", "params_style")]  # several names in one line, as of parameters


def _literal(app, what, name, obj, options, lines):
    """Make `name` in docstrings a code text and |x| no substitution, as they are not in reStructuredText."""
    end = lines.index("Examples") if "Examples" in lines else len(lines)
    code = [re.sub(r"(?<!`)`([^`<>]+)`(?![`_])", r"``\1``", line) for line in lines[:end]]
    if what in ("property", "attribute") and code:
        code[0] = code[0].replace(": ", " – ", 1)  # napoleon takes what is before a colon for the type
    lines[:end] = [re.sub(r"\|(?=.*\|)|(?<=\w)\|", r"\\|", line) if "``" not in line else line for line in code]


def _with_contents(app, docname, source):
    """Append the lists of pages to the front page: where README.md is shown without Sphinx, they are no text."""
    if docname == root_doc:
        source[0] += "\n" + (Path(__file__).parent / "site" / "contents.md").read_text(encoding="utf-8")


def setup(app):
    """Connect the changes of docstrings, before napoleon reads them, and the lists of pages."""
    app.connect("autodoc-process-docstring", _literal, priority=100)
    app.connect("source-read", _with_contents)
