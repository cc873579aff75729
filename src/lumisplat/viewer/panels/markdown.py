"""Words of others, such as names of files and meshes, in what pages take for Markdown or HTML."""

from __future__ import annotations

import re


def plain(text: str) -> str:
    """A text without anything that Markdown, HTML or a table would take for more than words."""
    return re.sub(r"[|<>`*_\[\]{}\\&#~!]", " ", text)
