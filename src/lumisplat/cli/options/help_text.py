"""What ``--help`` says of options: their docstrings, whose lines are those of the source and not of the terminal."""

from __future__ import annotations

import functools

import docstring_parser
from docstring_parser import Docstring


def join_lines_of_docstrings() -> None:
    """Lets tyro, which reads docstrings by `docstring_parser`, see each paragraph of an option as one line.

    It takes a line that begins with no letter for one that has to stay a line, and all but the first begin with the
    spaces of the source: without this, text is wrapped where the source is, and then at the width of the terminal.
    It stays so for the process: tyro keeps what it has read, whoever parses first (a farm parses options of training).
    """
    parse = docstring_parser.parse_from_object

    @functools.wraps(parse)
    def parse_and_join(obj: object) -> Docstring:
        found = parse(obj)
        for option in found.params:
            option.description = _joined(option.description or "")
        return found

    docstring_parser.parse_from_object = parse_and_join


def _joined(text: str) -> str:
    """A text whose paragraphs are a line each."""
    paragraphs = "\n".join(line.strip() for line in text.splitlines()).split("\n\n")
    return "\n\n".join(" ".join(paragraph.split()) for paragraph in paragraphs)
