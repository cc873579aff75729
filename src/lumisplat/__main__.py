"""``lumisplat`` and ``python -m lumisplat``: the process around the command line."""

from __future__ import annotations

import os
import sys


def main() -> int:
    """Runs one command. An interrupt or a closed pipe (``| head``) ends it silently, at any time.

    Returns:
        Exit status: the command's, 130 when interrupted, 141 when the pipe is closed, as a shell counts signals.
    """
    try:
        from lumisplat.cli import main as run_command  # takes a while, and may be interrupted

        status = run_command()
        sys.stdout.flush()
        return status
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # Python flushes the rest at exit
        return 141


if __name__ == "__main__":
    raise SystemExit(main())
