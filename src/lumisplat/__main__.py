"""Process entry of ``lumisplat`` and ``python -m lumisplat``: signals, standard streams and exit status."""

from __future__ import annotations

import gc
import os
import sys
import warnings
from collections.abc import Generator
from contextlib import contextmanager, suppress
from io import TextIOWrapper
from typing import TextIO

_NEW_OBJECTS = 100_000
"""Number of new objects that triggers a garbage collection. Python's default of 700 scans the million objects that
Warp keeps for its kernels over and over, which costs a fifth of the import time and slows frames."""


def main() -> int:
    """Runs one command. An interrupt or a closed pipe (``| head``) ends it silently, at any time.

    Returns:
        Exit status: the command's own; 2 if standard output cannot be written; 130 after an interrupt; 141 after a
        closed pipe, as shells number signals.
    """
    _open_standard_streams()
    gc.set_threshold(_NEW_OBJECTS, *gc.get_threshold()[1:])
    if "--debug" not in sys.argv:
        warnings.simplefilter("ignore")  # Lumisplat logs what users must know itself
    status = 0
    try:
        from lumisplat.cli import main as run_command  # slow, and may be interrupted

        status = run_command()
        sys.stdout.flush()
        return status
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:
        _discard(sys.stdout)
        return 141
    except OSError as error:  # writing help or buffered output failed, for example on a full disk
        _discard(sys.stdout)
        with suppress(OSError):
            if status == 0:  # otherwise the command has reported an error already
                print(f"error: {error.filename}: cannot be written: {error.strerror}", file=sys.stderr)
        _discard(sys.stderr)
        return 2


def _open_standard_streams() -> None:
    """Opens standard streams that the caller has closed (``>&-``), so that files do not get their descriptors."""
    for descriptor, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(descriptor)
        except OSError:
            os.dup2(os.open(os.devnull, os.O_RDWR), descriptor)
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(descriptor, "w" if descriptor else "r", closefd=False))
    if type(sys.stdout) is TextIOWrapper:
        out = sys.stdout
        sys.stdout = _StandardOutput(
            out.detach(), out.encoding, out.errors, line_buffering=out.line_buffering, write_through=out.write_through
        )


class _StandardOutput(TextIOWrapper):
    """Standard output whose write errors can be distinguished from errors of other files."""

    def write(self, text: str, /) -> int:
        with _named_errors():
            return super().write(text)

    def flush(self) -> None:
        with _named_errors():
            super().flush()


@contextmanager
def _named_errors() -> Generator[None]:
    try:
        yield
    except OSError as error:
        error.filename = "standard output"
        raise


def _discard(stream: TextIO) -> None:
    """Redirects a broken output stream to the null device, so that flushing its buffer at exit raises no error."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


if __name__ == "__main__":
    raise SystemExit(main())
