"""Scripts by which shells complete commands, options and their values; file names stay the shell's own."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import lumisplat as ls
from lumisplat.cli.commands.metrics import METRICS

_MARK = "COMPLETION_SPEC = "
"""What the table of all options begins with in the scripts that tyro makes."""


@dataclass(frozen=True)
class CommandWords:
    """The words that may follow a command."""

    options: list[str] = field(default_factory=list[str])
    choices: dict[str, list[str]] = field(default_factory=dict[str, list[str]])
    """Of an option, such as ``--pipeline``, its values; of options that take any value, none."""
    lists: dict[str, tuple[str, ...]] = field(default_factory=dict[str, tuple[str, ...]])
    """Of an option that takes several words with commas between, such as ``--aov``, these words."""
    positional: tuple[str, ...] = ()
    """Words that come first, such as those of ``completion``."""
    inner: list[str] = field(default_factory=list[str])
    """Its own commands, such as ``animate`` of ``farm``; they are commands of the name ``farm animate``."""


def command_words(script: str) -> dict[str, CommandWords]:
    """The words of each command.

    Args:
        script: What tyro makes for bash. Of it, the table of options is taken: the code around it completes no file
            names, and takes lines of the help for options.

    Raises:
        ConfigError: It has no such table.
    """
    line = next((line for line in script.splitlines() if line.startswith(_MARK)), None)
    if line is None:
        raise ls.ConfigError("this version of tyro lists no options for completion: pip install tyro==1.0.17")
    return dict(_commands("", ast.literal_eval(line.removeprefix(_MARK))["subcommands"]))


def _lists() -> dict[str, tuple[str, ...]]:
    """Options that take several words with commas between, and these words."""
    return {"--aov": ls.Frame.LAYERS, "--metrics": METRICS}


def _commands(above: str, found: dict[str, Any]) -> Iterator[tuple[str, CommandWords]]:
    """The words of commands and of those in them, by their names after those of the commands above them."""
    listed = _lists()
    for name, command in found.items():
        words = CommandWords(positional=POSITIONAL.get(name, ()), inner=list(command["subcommands"]))
        for option in command["options"]:
            words.options.extend(option["flags"])
            if option["type"] != "flag":
                values = sorted(set(option.get("choices", [])) - {"None"})
                words.choices.update(dict.fromkeys(option["flags"], values))
                words.lists.update((flag, listed[flag]) for flag in option["flags"] if flag in listed)
        yield above + name, words
        yield from _commands(f"{above}{name} ", command["subcommands"])


def bash_script(commands: dict[str, CommandWords]) -> str:
    """For bash from 3.2 on."""
    values = [
        f'    "{name} {option}") words="{" ".join(choices)}" ;;'
        for name, words in commands.items()
        for option, choices in words.choices.items()
    ]
    lists = [
        f'    "{name} {option}") words="{" ".join(listed)}" head="${{word%"${{word##*,}}"}}" ;;'
        for name, words in commands.items()
        for option, listed in words.lists.items()
    ]
    options = [f'      "{name} -"*) words="{" ".join(words.options)}" ;;' for name, words in commands.items()]
    outer = {name: words.inner for name, words in commands.items() if words.inner}
    inner = [
        f'    {name}) if [ "$COMP_CWORD" -eq 2 ]; then inner="{" ".join(words)}"; '
        f'else command="{name} ${{COMP_WORDS[2]}}"; fi ;;'
        for name, words in outer.items()
    ]
    inner += [
        f'    {name}) if [ "$COMP_CWORD" -eq 2 ]; then inner="{" ".join(words.positional)}"; fi ;;'
        for name, words in commands.items()
        if words.positional
    ]
    top = " ".join(name for name in commands if " " not in name)
    return "\n".join(
        [
            "_lumisplat() {",
            '  local word="${COMP_WORDS[COMP_CWORD]}" command="${COMP_WORDS[1]}" words="" inner="" head=""',
            '  case "$command" in',
            *inner,
            "  esac",
            '  case "$command ${COMP_WORDS[COMP_CWORD-1]}" in',
            *lists,
            *values,
            '    *) case "$command $word" in',
            *options,
            "    esac ;;",
            "  esac",
            f'  if [ "$COMP_CWORD" -eq 1 ]; then words="{top} --help --version"; fi',
            '  COMPREPLY=($(compgen -P "$head" -W "$words $inner" -- "${word#"$head"}"))',
            "}",
            "complete -o bashdefault -o default -F _lumisplat lumisplat",
            "",
        ]
    )


def zsh_script(commands: dict[str, CommandWords]) -> str:
    """For zsh, which runs that of bash."""
    return f"autoload -Uz compinit bashcompinit && compinit -u && bashcompinit\n{bash_script(commands)}"


def fish_script(commands: dict[str, CommandWords]) -> str:
    """For fish."""
    top = " ".join(name for name in commands if " " not in name)
    lines = [f"complete -c lumisplat -n __fish_use_subcommand -f -a '{top}'"]
    for name, words in commands.items():
        seen = "; and ".join(f"__fish_seen_subcommand_from {part}" for part in name.split())
        if words.inner:
            inner = " ".join(words.inner)
            seen += f"; and not __fish_seen_subcommand_from {inner}"
            lines.append(f"complete -c lumisplat -n '{seen}' -f -a '{inner}'")
        if words.positional:
            lines.append(f"complete -c lumisplat -n '{seen}' -f -a '{' '.join(words.positional)}'")
        for option in words.options:
            kind = f"-l {option[2:]}" if option.startswith("--") else f"-s {option[1:]}"
            choices = words.choices.get(option)
            if listed := words.lists.get(option):
                choices = [f"(__fish_append , {' '.join(listed)})"]
            value = "" if choices is None else f" -x -a '{' '.join(choices)}'" if choices else " -r"
            lines.append(f"complete -c lumisplat -n '{seen}' {kind}{value}")
    return "\n".join([*lines, ""])


POSITIONAL = {"completion": ("bash", "fish", "zsh")}
"""Commands whose first word is one of a few."""

SCRIPTS = {"bash": bash_script, "zsh": zsh_script, "fish": fish_script}
"""By shell."""


def script_for(shell: str) -> str:
    """The script of a shell.

    Args:
        shell: A key of `SCRIPTS`.
    """
    command = [sys.executable, "-P", "-m", "lumisplat", "--tyro-print-completion", "bash"]
    made = subprocess.run(command, check=True, capture_output=True, text=True)
    return SCRIPTS[shell](command_words(made.stdout))
