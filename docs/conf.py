"""Configuration of the documentation's site: `sphinx-build -W -c docs . build/site` from the project's folder."""

import dataclasses
import importlib
import inspect
import re
import tomllib
from functools import cache
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
html_js_files = ["pictures.js"]
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


#: Public methods that the program calls, not its users.
INTERNAL = set(
    re.findall(
        r"\w+",
        """
    add_to among_all below by_kind card_label cells children complete contradictions covers_as described design_keys
    displacements drift_text drop_replaced empty end_points ends_within entries extra_value from_layers hint_of inner
    joined labelled length_text line log_term materials may_lack minus moved_text note notes of_hits only_at_origin
    options parts points precision prior_in problems radii_between range_text removed_text results rings shoot slabs
    smooth solid spread stacks stands_for stated text title wire_ends wire_matter with_meta within set
        """,
    )
)
#: Readers of settings and workers that a function is given; `Sensitivity.of` is for users.
INTERNAL_OF = ("Settings", "Readout", "Workers", "Optimization", "BeamSpot", "Evaluation", "Search", "Background")
NOT_OWN = {"ndarray", "str", "int", "float", "bool", "dict", "list", "tuple", "None"}


@cache
def _documented():
    """Return the full name of each object of the reference by each name that docstrings may call it."""
    pages = [page.read_text(encoding="utf-8") for page in (Path(__file__).parent / "reference").glob("*.md")]
    found = {}
    for name in re.findall(r"^\.\. auto\w+:: (cgemit\.[\w.]+)$", "\n".join(pages), re.MULTILINE):
        parts = name.split(".")
        for length in range(1, len(parts)):
            short = ".".join(parts[length:])
            if short != parts[-1] or parts[1] not in ("helix", "units", "base"):
                found.setdefault(short, name)
        found[name] = found["cg." + ".".join(parts[1:])] = name
    return {name: full for name, full in found.items() if name not in NOT_OWN}


@cache
def _object(name):
    """Return an object of the reference by its full name."""
    module = importlib.import_module("cgemit")
    for part in name.split(".")[1:]:
        if not hasattr(module, part):
            importlib.import_module(f"{module.__name__}.{part}")
        module = getattr(module, part)
    return module


def _full_name(text, owner, own):
    """Return the full name of what a docstring calls `text`, also of a member of its class; None of its parameters."""
    names = _documented()
    name = text.removesuffix("()")
    if name in own:
        return None
    if name in names:
        return names[name]
    cls, _, member = name.rpartition(".")
    cls = names.get(cls) if cls else owner
    if cls and member.isidentifier() and not _is_internal(cls, member):
        thing = _object(cls)
        if inspect.isclass(thing) and inspect.getdoc(vars(thing).get(member)) and not member.startswith("_"):
            return f"{cls}.{member}"
    return None


def _is_internal(cls, member):
    return member in INTERNAL or (member == "of" and any(cls.endswith(end) for end in INTERNAL_OF))


def _linked(text, owner, own):
    """Make `name` in a text a link to the reference where it has such an object, else code; link pages of docs."""

    def role(match):
        full = _full_name(match[1], owner, own)
        return f":py:obj:`{match[1]} <{full}>`" if full else f"``{match[1]}``"

    text = re.sub(r"(?<![`:])`([^`<>]+)`(?![`_])", role, text)
    return re.sub(r"(?<![\w/`])docs/([\w/-]+)\.md(?![\w`])", r":doc:`/docs/\1`", text)


def _linked_type(text):
    """Make the classes of a type links."""
    classes = {name: full for name, full in _documented().items() if name[0].isupper() and "." not in name}
    return re.sub(r"(?<![\w.`])[A-Z]\w+(?![\w`.])", lambda m: _role(m[0], classes), text)


def _role(name, classes):
    return f":py:obj:`{name} <{classes[name]}>`" if name in classes else name


def _returned(obj):
    """Return the type that a function returns as docstrings write it; None if it returns nothing."""
    function = inspect.unwrap(getattr(obj, "__func__", obj))
    text = str(getattr(function, "__annotations__", {}).get("return", "None")).replace("cgemit.", "")
    if text in ("None", "Never"):
        return None
    text = {"Self": "the same class", "Floats": "ndarray, float64"}.get(text.strip("'"), text.strip("'"))
    if text == "Any":
        text = {"to_pandas": "pandas.DataFrame", "to_xarray": "xarray.Dataset", "to_awkward": "awkward.Array"}.get(
            getattr(function, "__name__", ""), "object"
        )
    text = re.sub(r"(?:npt\.)?NDArray\[(?:np\.)?([\w]+)\]", r"ndarray, \1", text).replace("ndarray, Any", "ndarray")
    text = text.replace("Floats", "ndarray").replace("npt.ArrayLike", "array_like").replace(" | ", " or ")
    while re.search(r"\[([^\[\]]*)\]", text):
        text = re.sub(r"\b(?:tuple|list|Sequence|Iterator|Iterable)\[([^\[\]]*)\]", r"sequence of (\1)", text)
        text = re.sub(r"\b(?:dict|Mapping)\[([^\[\],]*), ([^\[\]]*)\]", r"dict of \1 to \2", text)
        text = re.sub(r"\b(\w+)\[([^\[\]]*)\]", r"\1 of (\2)", text)
    return re.sub(r"sequence of \((\w+)\)", r"sequence of \1", text)


def _docstring(app, what, name, obj, options, lines):
    """Link names and types, say what is returned, and make |x| no substitution, as it is not in reStructuredText."""
    end = lines.index("Examples") if "Examples" in lines else len(lines)
    owner = (
        name if what == "class" else name.rpartition(".")[0] if what in ("method", "property", "attribute") else None
    )
    function = inspect.unwrap(getattr(obj, "__func__", obj))
    own = inspect.signature(function).parameters if what in ("function", "method") else ()
    code, section = [], ""
    for i, line in enumerate(lines[:end]):
        if i + 1 < end and re.fullmatch("-{3,}", lines[i + 1]):
            section = line
        line = _linked(line, owner, own)
        if section in ("Parameters", "Attributes") and re.match(r"\*{0,2}\w[^:]* : ", line):
            names, _, kind = line.partition(" : ")
            line = f"{names} : {_linked_type(kind)}"
        elif section == "Returns" and re.match(r"\w", line):
            line = _linked_type(line)
        code.append(re.sub(r"\|(?=.*\|)|(?<=\w)\|", r"\\|", line) if "``" not in line else line)
    if what in ("property", "attribute") and code:
        code[0] = code[0].replace(": ", " – ", 1)  # napoleon takes what is before a colon for the type
    if what in ("function", "method") and "Returns" not in code and code and (returned := _returned(obj)):
        at = code.index("Raises") if "Raises" in code else len(code)
        code[at:at] = ["", "Returns", "-------", _linked_type(returned), ""]
    lines[:end] = code


def _signature(app, what, name, obj, options, signature, annotation):
    """Leave out how results are built: nobody calls classes that have fields without a default and no parameters."""
    if what != "class" or not dataclasses.is_dataclass(obj) or "Parameters\n---" in (obj.__doc__ or ""):
        return None
    missing = dataclasses.MISSING
    fields = [one for one in dataclasses.fields(obj) if one.init]
    needed = any(one.default is missing and one.default_factory is missing for one in fields)
    return ("", annotation) if needed or any(one.name.startswith("_") for one in fields) else None


def _skip(app, what, name, obj, skip, options):
    """Leave out what the program calls; `what` is what it belongs to."""
    qualified = getattr(obj, "__qualname__", name)
    return True if name in INTERNAL or (name == "of" and _is_internal(qualified.rpartition(".")[0], "of")) else None


def _with_contents(app, docname, source):
    """Append the lists of pages to the front page: where README.md is shown without Sphinx, they are no text."""
    if docname == root_doc:
        source[0] += "\n" + (Path(__file__).parent / "site" / "contents.md").read_text(encoding="utf-8")


def setup(app):
    """Connect the changes of docstrings, before napoleon reads them, and the lists of pages."""
    app.connect("autodoc-process-docstring", _docstring, priority=100)
    app.connect("autodoc-process-signature", _signature)
    app.connect("autodoc-skip-member", _skip)
    app.connect("source-read", _with_contents)
