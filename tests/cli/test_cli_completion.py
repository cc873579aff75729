"""``lumisplat completion``: what the scripts complete, in the shells that are here."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path
from typing import get_args, get_type_hints

import pytest

import lumisplat as ls
from lumisplat import cli
from lumisplat.cli.commands.machine.completion_scripts import SCRIPTS, command_words, script_for
from lumisplat.cli.input.positionals import gathered_positionals

_CASES = (
    (("re",), ["relight", "render"]),
    (("render", "--shadow-me"), ["--shadow-method"]),
    (("render", "a.ply", "--pipeline", "tr"), ["trace"]),
    (("completion", "--de"), ["--debug"]),
    (("farm", "a"), ["animate"]),
    (("farm", "animate", "--workers"), ["--workers"]),
    (("farm", "render", "a.ply", "--pipeline", "tr"), ["trace"]),
    (("animate", "--workers"), []),
    (("completion", "z"), ["zsh"]),
    (("completion", ""), ["bash", "fish", "zsh"]),
    (("render", "a.ply", "--aov", "gau"), ["gaussian_index"]),
    (("farm", "render", "a.ply", "--aov", "depth,gau"), ["depth,gaussian_index"]),
    (("metrics", "a.png", "b.png", "--metrics", "ms"), ["ms-ssim"]),
)
"""What has been typed, and what it is completed to."""


def needs(shell: str) -> None:
    """Skips a test where a shell is not installed."""
    if shutil.which(shell) is None:
        pytest.skip(f"{shell} is not installed")


def completed_by_bash(words: tuple[str, ...], script: Path) -> list[str]:
    """What bash completes the last word to."""
    quoted = " ".join(f"'{word}'" for word in ("lumisplat", *words))
    line = f"source {script}; COMP_WORDS=({quoted}); COMP_CWORD={len(words)}; _lumisplat; "
    line += 'printf "%s\\n" "${COMPREPLY[@]}"'
    return subprocess.run(["bash", "-c", line], capture_output=True, text=True, check=True).stdout.split()


def completed_by_fish(words: tuple[str, ...], script: Path) -> list[str]:
    """What fish completes the last word to."""
    line = f"source {script}; complete -C 'lumisplat {' '.join(words)}'"
    done = subprocess.run(["fish", "-c", line], capture_output=True, text=True, check=True).stdout
    return [one.split("\t")[0] for one in done.splitlines()]


@pytest.mark.parametrize(("shell", "completed"), [("bash", completed_by_bash), ("fish", completed_by_fish)])
def test_commands_options_and_values(tmp_path: Path, shell: str, completed) -> None:
    """Of each command its own; file names stay the shell's."""
    needs(shell)
    script = tmp_path / "script"
    script.write_text(script_for(shell))
    for words, expected in _CASES:
        assert completed(words, script) == expected
    assert completed(("render", str(tmp_path / "scr")), script) in ([], [str(script)])


def test_zsh_reads_it() -> None:
    """Without a word, and knows the command then."""
    needs("zsh")
    line = f"{script_for('zsh')}\nprint $_comps[lumisplat]"
    done = subprocess.run(["zsh", "-f", "-c", line], capture_output=True, text=True, check=True)
    assert "_lumisplat" in done.stdout and not done.stderr


def test_all_commands_are_there(capsys: pytest.CaptureFixture[str]) -> None:
    """In the script of every shell; the command prints it."""
    from lumisplat.cli import main

    for shell in SCRIPTS:
        assert main(["completion", shell]) == 0
        script = capsys.readouterr().out
        assert all(name in script for name in ("render", "doctor", "shadow-method", "hybrid"))


def test_files_may_stand_between_options() -> None:
    """In every command: what follows a flag is a file, what follows another option is its value."""
    table = command_words(
        subprocess.run(
            [sys.executable, "-m", "lumisplat", "--tyro-print-completion", "bash"],
            check=True,
            capture_output=True,
            text=True,
        ).stdout
    )
    kinds = cli._commands(cli._Command)
    farmed = cli._commands(get_args(get_type_hints(kinds.pop("farm"), include_extras=True)["what"])[0])
    for name, kind in (kinds | {f"farm {name}": kind for name, kind in farmed.items()}).items():
        words = table[name]
        for option in words.options:
            given = gathered_positionals(["a", option, "b", "c"], kind)
            values = 1 if option in words.choices else 0
            expected = ["a", *("b", "c")[values:], option, *("b",)[:values]]
            assert given == expected or option == "--objects", (name, option)
    typed = ["render", "a.ply", "--lod", "3", "b.obj", "--stats", "c.obj", "-o", "x.png"]
    assert cli._arguments(typed) == ["render", "a.ply", "b.obj", "c.obj", "--lod", "3", "--stats", "-o", "x.png"]
    assert cli._arguments(["dataset", "a", "--objects", "b", "c"]) == ["dataset", "a", "--objects", "b", "c"]


def test_another_tyro_is_told() -> None:
    """Whose scripts have no table of options."""
    with pytest.raises(ls.ConfigError, match="this version of tyro"):
        command_words("complete -F _tyro lumisplat")
