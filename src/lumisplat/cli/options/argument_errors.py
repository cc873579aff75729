"""What is wrong with the arguments, in one line: tyro says it in a panel of many."""

from __future__ import annotations

import contextlib
import io
import re
from collections.abc import Iterator
from itertools import dropwhile, takewhile

_STYLES = re.compile(r"\x1b\[[0-9;]*m")


class ArgumentsError(Exception):
    """The arguments do not parse; the message is one line."""


@contextlib.contextmanager
def panels_as_errors() -> Iterator[None]:
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
    """The first paragraph below a panel's title, the option it suggests, and where help is.

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
    """The choices of an option in one order, which tyro does not keep, without the None of one that is not given."""
    choices = [choice for choice in re.findall(r"'([^']*)'", listed[1]) if choice != "None"]
    return f"one of {', '.join(sorted(choices, key=lambda choice: (len(choice) * choice.isdigit(), choice)))}"


def _is_rule(row: str) -> bool:
    return row != "" and set(row) <= {"─", "-"}
