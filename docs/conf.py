"""Sphinx settings."""

import os
import re
from pathlib import Path

from sphinx.addnodes import index

from lumisplat import __version__
from lumisplat.config.setting import FieldDocs

project = "Lumisplat"
copyright = "The Lumisplat founders"
release = __version__

extensions = ["myst_parser", "sphinx_design", "sphinx.ext.autodoc", "sphinx.ext.mathjax", "sphinx.ext.napoleon"]
source_suffix = {".md": "markdown"}
exclude_patterns = ["_build", "adr/0000-template.md"]
html_theme = "furo"
html_title = f"Lumisplat {release}"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_search_scorer = str(Path(__file__).parent / "_static" / "scorer.js")

myst_enable_extensions = ["dollarmath", "colon_fence"]
myst_heading_anchors = 3
smartquotes_action = "qe"  # not dashes, which are options

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
    elif what == "class" and isinstance(obj.__dict__.get("__doc__"), FieldDocs):
        del lines[lines.index("Attributes:") :]  # autodoc lists the fields itself


def put_back(app, what, name, obj, options, lines):
    if name in _sentences:
        lines[:] = _sentences.pop(name)


# The words of other programs lead the search to the page of their row.
WORDS = Path(__file__).parent / "guide" / "from_other_programs.md"
_ROW = re.compile(r"^\| (?!there|---)(.+) \| .+ \| \[.+\]\((.+)\) \|$", re.MULTILINE)


def words_of_other_programs():
    """Returns (page, anchor, word) of each word in the tables of WORDS."""
    for there, target in _ROW.findall(WORDS.read_text(encoding="utf-8")):
        page, _, anchor = target.partition("#")
        name = os.path.normpath(f"guide/{page.removesuffix('.md')}")
        yield from ((name, anchor, word.strip()) for word in re.sub(r" \(.*?\)", "", there).split(","))


def add_words(app, doctree):
    words = [(anchor, word) for page, anchor, word in words_of_other_programs() if page == app.env.docname]
    if words:
        app.env.note_dependency(str(WORDS))
        doctree += index(entries=[("single", word, anchor, "main", None) for anchor, word in words])


def setup(app):
    app.connect("autodoc-process-docstring", put_aside, priority=400)
    app.connect("autodoc-process-docstring", put_back, priority=600)
    app.connect("doctree-read", add_words)
