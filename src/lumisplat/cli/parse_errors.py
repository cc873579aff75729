"""Arguments that do not parse, said in one line: tyro prints a panel of many."""

from __future__ import annotations

import contextlib
import io
import re
from collections.abc import Generator
from itertools import dropwhile, takewhile

_STYLES = re.compile(r"\x1b\[[0-9;]*m")


class ArgumentsError(Exception):
    """The arguments do not parse; the message is one line."""


@contextlib.contextmanager
def panels_as_errors() -> Generator[None]:
    """Turns the panel that tyro prints before it exits into an exception.

    Raises:
        ArgumentsError: tyro has refused the arguments.
    """
    panel = io.StringIO()
    try:
        with contextlib.redirect_stderr(panel):
            yield
    except SystemExit as stop:
        if stop.code:
            raise ArgumentsError(one_line(panel.getvalue())) from None
        raise


def one_line(panel: str) -> str:
    """A panel's first paragraph, the option that it suggests, and the command that prints the help.

    A panel without such a paragraph comes back whole, its lines joined.
    """
    rows = [row.strip(" │") for row in _STYLES.sub("", panel).splitlines()[1:]]
    message = " ".join(takewhile(lambda row: row and not _is_rule(row), dropwhile(_is_rule, rows)))
    message = re.sub(r"one of \((.*)\)", _choices, message).replace("{None}|", "")
    text = " ".join(rows)
    suggested = re.search(r"Perhaps you meant: +(--[\w-]+)", text)
    if suggested:
        message += f"; perhaps you meant {suggested[1]}"
    helping = re.search(r"lumisplat[\w ]* --help$", text.rstrip("╰─╯ "))
    return f"{message} (see {helping[0]})" if message and helping else message or " ".join(panel.split())


def _choices(listed: re.Match[str]) -> str:
    """The choices of an option, sorted as tyro does not keep an order, and without the None of an absent option."""
    choices = [choice for choice in re.findall(r"'([^']*)'", listed[1]) if choice != "None"]
    return f"one of {', '.join(sorted(choices, key=lambda choice: (len(choice) * choice.isdigit(), choice)))}"


def _is_rule(row: str) -> bool:
    return row != "" and set(row) <= {"─", "-"}
