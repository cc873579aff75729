"""``lumisplat completion``: commands, options and values that a shell completes."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from lumisplat.cli.commands.machine.completion_scripts import script_for
from lumisplat.cli.options.command import Command


@dataclass(frozen=True, kw_only=True)
class Completion(Command):
    """Print what lets a shell complete commands, options and their values.

    bash, a line of ~/.bashrc: eval "$(lumisplat completion bash)"

    zsh, a line of ~/.zshrc: eval "$(lumisplat completion zsh)"

    fish, once: lumisplat completion fish > ~/.config/fish/completions/lumisplat.fish
    """

    shell: Positional[Annotated[Literal["bash", "zsh", "fish"], arg(metavar="bash|zsh|fish")]]
    """The shell."""

    def run(self) -> None:
        """Prints the script."""
        sys.stdout.write(script_for(self.shell))
