"""What shows the results of cells: a notebook that people look at, a program that runs one, a terminal, or nothing."""

from __future__ import annotations

from typing import Any


def has_people() -> bool:
    """Whether somebody can look at a widget: nbconvert and others that run notebooks have a kernel, but no keyboard."""
    kernel = getattr(_shell(), "kernel", None)
    if kernel is None:
        return False
    return bool(kernel.get_parent("shell").get("content", {}).get("allow_stdin", False))


def has_pictures() -> bool:
    """Whether pictures can be shown, which a terminal cannot; whoever asks without a shell can."""
    shell = _shell()
    return shell is None or "image/png" in shell.display_formatter.active_types


def _shell() -> Any:
    """IPython's shell; None: there is none."""
    try:
        from IPython.core.getipython import get_ipython
    except ImportError:
        return None
    return get_ipython()
