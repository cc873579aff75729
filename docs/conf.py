"""Sphinx settings."""

from lumisplat import __version__

project = "Lumisplat"
copyright = "The Lumisplat founders"
release = __version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
source_suffix = {".md": "markdown"}
exclude_patterns = ["_build", "adr/0000-template.md"]
html_theme = "furo"
html_title = f"Lumisplat {release}"

myst_enable_extensions = ["dollarmath", "colon_fence"]
myst_heading_anchors = 3

# Public names live in lumisplat and are resolved on first use, so autodoc is told where to look.
autodoc_typehints = "description"
autodoc_member_order = "bysource"
napoleon_google_docstring = True
napoleon_numpy_docstring = False


def keep_colons(app, what, name, obj, options, lines):
    """Napoleon reads "a: b" in the first line of an attribute's docstring as type and text; ours are sentences."""
    if what in ("attribute", "property"):
        lines.insert(0, "")


def setup(app):
    app.connect("autodoc-process-docstring", keep_colons, priority=400)
