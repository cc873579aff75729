"""``-o -``: what is otherwise written to a file goes to standard output, and messages to standard error."""

from __future__ import annotations

import contextlib
import io
import shutil
import sys
import tempfile
from collections.abc import Generator
from pathlib import Path

import lumisplat as ls

STANDARD_OUTPUT = Path("-")


def refuse_standard_output(output: Path | None) -> None:
    """Refuses ``-o -`` where many files are written.

    Raises:
        ConfigError: It is given.
    """
    if output == STANDARD_OUTPUT:
        raise ls.ConfigError("-o - is one file, and frames are many: give a folder")


@contextlib.contextmanager
def standard_output(suffix: str) -> Generator[Path]:
    """Yields a file to write, which is copied to standard output at the end, whole or not at all.

    What is printed in the meantime appears on standard error.

    Args:
        suffix: Extension of the file, which selects its format.

    Raises:
        ConfigError: Standard output is a terminal, or closed.
        LumisplatError: The block has raised one; it names standard output instead of the file.
    """
    out = sys.stdout
    if sys.__stdout__ is None or out.isatty():
        raise ls.ConfigError("-o - is standard output: send it to a file or a program, such as -o - > picture.png")
    messages = io.StringIO()
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / f"out{suffix}"
        try:
            with contextlib.redirect_stdout(messages):
                yield file
        except ls.LumisplatError as error:
            if str(file) not in str(error):
                raise
            raise ls.SceneError(str(error).replace(str(file), "standard output")) from error
        print(messages.getvalue().replace(str(file), "standard output"), end="", file=sys.stderr)
        out.flush()
        with file.open("rb") as stream:
            shutil.copyfileobj(stream, out.buffer)
        out.flush()
