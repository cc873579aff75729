"""The Makefile and the pre-commit hooks run the same checks."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
TOOLS = {"ruff", "pyright", "typos", "check-added-large-files"}


def commands_of_make() -> list[str]:
    """Returns the commands of ``make check`` in order, without the path of the tool."""
    recipe = re.search(r"^check:.*\n((?:\t.*\n)+)", (ROOT / "Makefile").read_text(), re.MULTILINE)
    assert recipe
    return re.findall(r"\$\(BIN\)/(.*)", recipe[1])


def commands_of_hooks() -> list[str]:
    """Returns the commands of the pre-commit hooks in order."""
    return re.findall(r"entry: \.venv/bin/(.*)", (ROOT / ".pre-commit-config.yaml").read_text())


def test_pre_commit_hooks_and_make_check_run_the_same_commands() -> None:
    """Tools, arguments and order are equal."""
    assert commands_of_hooks() == commands_of_make()
    assert {command.split()[0] for command in commands_of_make()} == TOOLS


def test_versions_of_checking_tools_are_pinned() -> None:
    """The extra [dev] pins each tool, so that new rules of a release cannot fail a check."""
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    pinned = {re.split(r"[\[=]", requirement)[0] for requirement in extras["dev"] if "==" in requirement}
    assert pinned == {"ruff", "pyright", "typos", "pre-commit", "pre-commit-hooks"}
