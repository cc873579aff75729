"""``lumisplat completion``: prints the script that completes commands, options and values in a shell."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from lumisplat.cli.options.command import Command, own_options_first

FILES = {
    "bash": """
_lumisplat() {
  local cur="${COMP_WORDS[COMP_CWORD]}" one
  local -a found=()
  _tyro_lumisplat
  for one in "${COMPREPLY[@]}"; do
    if [[ -n "$one" && ( "$one" != -* || "$cur" == -* ) ]]; then found+=("$one"); fi
  done
  COMPREPLY=("${found[@]}")
}
complete -o bashdefault -o default -F _lumisplat lumisplat
""",
    "zsh": """
(( compstate[nmatches] )) || _files
""",
    "fish": """
complete --command lumisplat --force-files
""",
}
"""Shell code for each shell that completes file names where no option or value matches; printed after tyro's script."""


@own_options_first
@dataclass(frozen=True, kw_only=True)
class Completion(Command):
    """Print a script that completes commands in a shell.

    bash, a line of ~/.bashrc: eval "$(lumisplat completion bash)"

    zsh, a file in a folder of $fpath: lumisplat completion zsh > ~/.zfunc/_lumisplat

    fish, once: lumisplat completion fish > ~/.config/fish/completions/lumisplat.fish
    """

    shell: Positional[Annotated[Literal["bash", "zsh", "fish"], arg(metavar="bash|zsh|fish")]]
    """Write the script for this shell."""

    def run(self) -> None:
        """Prints the shell code of `FILES`; `lumisplat.cli.main` has printed the completion script of tyro before."""
        print(FILES[self.shell], end="")
