"""Tests ``lumisplat completion`` in the installed shells."""

from __future__ import annotations

import ast
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args, get_type_hints

import pytest

from lumisplat import cli
from lumisplat.cli.commands.completion import FILES
from lumisplat.cli.input.arguments import gathered_positionals

_CASES = (
    (("re",), ["relight", "render"]),
    (("render", "--camera-p"), ["--camera-path"]),
    (("render", "a.ply", "--pipeline", "tr"), ["trace"]),
    (("completion", "--de"), ["--debug"]),
    (("farm", "a"), ["animate"]),
    (("farm", "animate", "--workers"), ["--workers"]),
    (("farm", "render", "a.ply", "--pipeline", "tr"), ["trace"]),
    (("animate", "--workers"), []),
)
"""Typed words, and the completions of the last word."""


@pytest.fixture(scope="module")
def scripts(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Returns the script of each shell, as the command prints it."""
    folder = tmp_path_factory.mktemp("scripts")
    for shell in FILES:
        command = [sys.executable, "-m", "lumisplat", "completion", shell]
        (folder / shell).write_bytes(subprocess.run(command, check=True, capture_output=True).stdout)
    return {shell: folder / shell for shell in FILES}


def needs(shell: str) -> None:
    """Skips a test if a shell is not installed."""
    if shutil.which(shell) is None:
        pytest.skip(f"{shell} is not installed")


def completed_by_bash(words: tuple[str, ...], script: Path) -> list[str]:
    """Returns the completions of the last word in bash; empty if bash completes file names."""
    quoted = " ".join(f"'{word}'" for word in ("lumisplat", *words))
    line = f"source {script}; COMP_WORDS=({quoted}); COMP_CWORD={len(words)}; _lumisplat; "
    line += 'printf "%s\\n" "${COMPREPLY[@]}"; complete -p lumisplat >&2'
    done = subprocess.run(["bash", "-c", line], capture_output=True, text=True, check=True)
    assert "-o default" in done.stderr
    return done.stdout.split()


def completed_by_fish(words: tuple[str, ...], script: Path) -> list[str]:
    """Returns the completions of the last word in fish."""
    line = f"source {script}; complete -C 'lumisplat {' '.join(words)}'"
    done = subprocess.run(["fish", "-c", line], capture_output=True, text=True, check=True).stdout
    return [one.split("\t")[0] for one in done.splitlines()]


@pytest.mark.parametrize(("shell", "completed"), [("bash", completed_by_bash), ("fish", completed_by_fish)])
def test_shells_complete_commands_options_and_values_of_lumisplat(
    scripts: dict[str, Path], shell: str, completed
) -> None:
    """The shells are bash and fish."""
    needs(shell)
    for words, expected in _CASES:
        assert sorted(completed(words, scripts[shell])) == expected


@pytest.mark.parametrize("before", [("render",), ("render", "--cameras"), ("info", "a.ply"), ("animate",)])
def test_bash_completes_file_names_of_lumisplat_commands(scripts: dict[str, Path], before: tuple[str, ...]) -> None:
    """An empty word completes file names, too."""
    needs("bash")
    start = str(scripts["bash"])[:-2]
    assert completed_by_bash((*before, start), scripts["bash"]) in ([], [str(scripts["bash"])])
    assert not [one for one in completed_by_bash((*before, ""), scripts["bash"]) if one.startswith("-")]


def test_zsh_completion_script_has_no_syntax_error(scripts: dict[str, Path]) -> None:
    """Zsh reads the script with its option -n."""
    needs("zsh")
    done = subprocess.run(["zsh", "-n", scripts["zsh"]], capture_output=True, text=True, check=True)
    assert not done.stderr


def test_completion_script_of_each_shell_has_every_command(scripts: dict[str, Path]) -> None:
    """The shells are bash, fish and zsh."""
    for script in scripts.values():
        text = script.read_text()
        assert all(name in text for name in ("render", "doctor", "camera-path", "hybrid"))


def options_with_values(command: dict[str, Any], name: str) -> Iterator[tuple[str, str, bool]]:
    """Yields each command and option of tyro's specification, and whether a value follows the option."""
    for option in command["options"]:
        yield from ((name, flag, option["type"] != "flag") for flag in option["flags"])
    for inner, found in command["subcommands"].items():
        yield from options_with_values(found, f"{name} {inner}".strip())


def test_completion_knows_which_options_take_a_value(scripts: dict[str, Path]) -> None:
    """In each command, the word behind a flag is a file, and the word behind any other option is its value."""
    kinds = cli._commands(cli._Command)
    farmed = cli._commands(get_args(get_type_hints(kinds.pop("farm"), include_extras=True)["what"])[0])
    kinds |= {f"farm {name}": kind for name, kind in farmed.items()}
    line = next(line for line in scripts["bash"].read_text().splitlines() if line.startswith("COMPLETION_SPEC = "))
    listed = list(options_with_values(ast.literal_eval(line.partition(" = ")[2]), ""))
    assert len(listed) > 400
    for name, option, has_value in listed:
        if name in kinds:
            given = gathered_positionals(["a", option, "b", "c"], kinds[name])
            expected = ["a", *("b", "c")[has_value:], option, *("b",)[:has_value]]
            assert given == expected or option == "--objects", (name, option)
    typed = ["render", "a.ply", "--lod", "3", "b.obj", "--stats", "c.obj", "-o", "x.png"]
    assert cli._arguments(typed) == (
        ["render", "a.ply", "b.obj", "c.obj", "--lod", "3", "--stats", "-o", "x.png"],
        "lumisplat render",
    )
    assert cli._arguments(["dataset", "a", "--objects", "b", "c"])[0] == ["dataset", "a", "--objects", "b", "c"]
