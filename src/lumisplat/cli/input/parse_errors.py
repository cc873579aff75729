"""Arguments that do not parse, said in one line: tyro prints a panel of many."""

from __future__ import annotations

import contextlib
import difflib
import io
import os
import re
from collections.abc import Generator, Iterable
from itertools import dropwhile, takewhile

_STYLES = re.compile(r"\x1b\[[0-9;]*m")


_NO_NUMBER = re.compile(
    r"Error parsing (?P<option>--[\w-]+): (?:no type matching (?P<kind>INT|FLOAT)(?:\|\{(?P<word>\w+)\})? could be "
    r"instantiated from \['(?P<value>.*)'\]\.|could not convert string to float: '(?P<float>.*)'|"
    r"invalid literal for int\(\) with base 10: '(?P<int>.*)')"
)
"""What tyro says of a value that is no number, perhaps where a word would do, too."""


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


def unknown_command(name: str, commands: Iterable[str], program: str) -> str:
    """Returns the line about a first argument that is no command: the one that is meant, or what shows a file."""
    if os.path.exists(name) or os.path.splitext(name)[1]:
        return f"'{name}' is no command: {program} render {name} renders it (see {program} --help)"
    near = difflib.get_close_matches(name, commands, 1, 0.7)
    meant = f"; perhaps you meant {near[0]}" if near else ""
    return f"'{name}' is no command{meant} (see {program} --help)"


def one_line(panel: str) -> str:
    """A panel's first paragraph, the option that it suggests, and the command that prints the help.

    A panel without such a paragraph comes back whole, its lines joined.
    """
    rows = [row.strip(" │") for row in _STYLES.sub("", panel).splitlines()[1:]]
    message = " ".join(takewhile(lambda row: row and not _is_rule(row), dropwhile(_is_rule, rows)))
    message = re.sub(r"one of \((.*)\)", _choices, message).replace("{None}|", "")
    message = _NO_NUMBER.sub(_no_number, message)
    text = " ".join(rows)
    suggested = re.search(r"Perhaps you meant: +(--[\w-]+)", text)
    if suggested:
        message += f"; perhaps you meant {suggested[1]}"
    helping = re.search(r"lumisplat[\w ]* --help$", text.rstrip("╰─╯ "))
    return f"{message} (see {helping[0]})" if message and helping else message or " ".join(panel.split())


def _no_number(found: re.Match[str]) -> str:
    """A value that is no number, as other wrong values are named."""
    value = next(text for text in (found["value"], found["float"], found["int"]) if text is not None)
    is_whole = found["kind"] == "INT" or found["int"] is not None
    word = f" or {found['word']}" if found["word"] else ""
    return f"{found['option']} is '{value}', expected a {'whole ' if is_whole else ''}number{word}"


def _choices(listed: re.Match[str]) -> str:
    """The choices of an option, sorted as tyro does not keep an order, and without the None of an absent option."""
    choices = [choice for choice in re.findall(r"'([^']*)'", listed[1]) if choice != "None"]
    return f"one of {', '.join(sorted(choices, key=lambda choice: (len(choice) * choice.isdigit(), choice)))}"


def _is_rule(row: str) -> bool:
    return row != "" and set(row) <= {"─", "-"}
