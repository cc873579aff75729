"""Sphinx settings."""

from lumisplat import __version__

project = "Lumisplat"
copyright = "The Lumisplat founders"
release = __version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.mathjax", "sphinx.ext.napoleon"]
source_suffix = {".md": "markdown"}
exclude_patterns = ["_build", "adr/0000-template.md"]
html_theme = "furo"
html_title = f"Lumisplat {release}"

myst_enable_extensions = ["dollarmath", "colon_fence"]
myst_heading_anchors = 3

# Equations of docs/method are numbered by page and place, (2.9), so that other pages can refer to them.
numfig = True
math_eqref_format = "equation {number}"

# Public names live in lumisplat and are resolved on first use, so autodoc is told where to look.
autodoc_typehints = "description"
# Python's range, a type of some parameters, has the name of the range of lights.
suppress_warnings = ["ref.python"]
autodoc_member_order = "bysource"
napoleon_google_docstring = True
napoleon_numpy_docstring = False


# Napoleon takes "a: b" at the start of an attribute's docstring for a type and a text; ours are sentences. Attributes
# are put aside before it runs (at the default priority of 500), and put back after.
_sentences: dict[str, list[str]] = {}


def put_aside(app, what, name, obj, options, lines):
    if what in ("attribute", "property"):
        _sentences[name] = list(lines)
    # The list of fields in the help of settings: autodoc describes each field itself.
    written = vars(obj).get("__doc__") if what == "class" else None
    if type(written).__name__ == "FieldDocs" and "Attributes:" in lines:
        del lines[lines.index("Attributes:") :]


def put_back(app, what, name, obj, options, lines):
    if name in _sentences:
        lines[:] = _sentences.pop(name)


def setup(app):
    app.connect("autodoc-process-docstring", put_aside, priority=400)
    app.connect("autodoc-process-docstring", put_back, priority=600)
