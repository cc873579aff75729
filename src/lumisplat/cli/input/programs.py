"""Runs scene programs: Python files that define an ``animation``, for what a scene file cannot say."""

from __future__ import annotations

import ast
import runpy
import sys
import traceback
from collections.abc import Iterator
from pathlib import Path

import lumisplat as ls

PROGRAM = ".py"
"""Extension of scene programs."""


def run_program(path: Path) -> ls.Animation:
    """Runs a Python file, and returns its ``animation``: an `Animation`, or a function that returns one.

    Modules beside the file can be imported, as by ``python FILE``.

    Raises:
        FormatError: The file cannot be read, fails, or defines no animation; the message names the line that failed.
    """
    _source(path)
    sys.path.insert(0, str(path.resolve().parent))
    try:
        found = runpy.run_path(str(path), run_name="lumisplat_scene").get("animation")
        if callable(found):
            found = found()
    except (Exception, SystemExit) as error:
        raise ls.FormatError(path, f"{_line(path, error)}{type(error).__name__}: {error}") from error
    finally:
        sys.path.pop(0)
    if isinstance(found, ls.Animation):
        return found
    if found is None:
        raise ls.FormatError(path, "defines no `animation`: expected an Animation, or a function that returns one")
    raise ls.FormatError(path, f"`animation` is a {type(found).__name__}, expected an Animation")


def program_texts(path: Path) -> Iterator[str]:
    """Yields the strings in a program that may be names of files; none if it is no valid Python."""
    for node in ast.walk(ast.parse(_source(path))):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.value
        elif isinstance(node, ast.Import):
            yield from (f"{alias.name.replace('.', '/')}.py" for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield f"{node.module.replace('.', '/')}.py"


def _source(path: Path) -> str:
    """Returns the text of a program."""
    from lumisplat.io.files.source import read_text  # imported late: the help must not need NumPy

    return read_text(path)


def _line(path: Path, error: BaseException) -> str:
    """Returns the text ``line N: `` for the last line of the program itself that an error passed through."""
    if isinstance(error, SyntaxError) and error.filename == str(path):
        return f"line {error.lineno}: "
    lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == str(path)]
    return f"line {lines[-1]}: " if lines else ""
