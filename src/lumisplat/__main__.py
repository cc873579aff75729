"""``lumisplat`` and ``python -m lumisplat``: the process around the command line."""

from __future__ import annotations

import os
import sys


def main() -> int:
    """Runs one command. An interrupt or a reader that has gone (``| head``) end it without a word, at any time.

    Returns:
        Exit status: the command's, 130 when interrupted, 141 when nobody reads on, as a shell counts signals.
    """
    try:
        from lumisplat.cli import main as run_command  # takes a while: an interrupt may come already here

        status = run_command()
        sys.stdout.flush()
        return status
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # what is left is flushed at exit
        return 141


if __name__ == "__main__":
    raise SystemExit(main())
