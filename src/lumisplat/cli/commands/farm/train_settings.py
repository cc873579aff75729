"""What is other for single folders of ``lumisplat farm train``: a table for each, with options of train as keys.

[fox]
cap = 200_000
exposures = true

[garden]
iterations = 30_000
poses = "colmap"
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, cast

import tyro
from tyro.conf import FlagCreatePairsOff

import lumisplat as ls
from lumisplat.cli.commands.train import Train
from lumisplat.cli.input.file_marks import toml_values
from lumisplat.cli.input.messages import ArgumentsError, panels_as_errors

_log = logging.getLogger("lumisplat")

_OF_ALL = ("folder", "output", "overwrite", "stop_after", "device", "debug")
"""Options that are none of single folders."""


@dataclass(frozen=True)
class TrainSettings:
    """The tables of a file, by names of folders."""

    path: Path | None
    names: list[str]
    tables: dict[str, dict[str, Any]]

    @staticmethod
    def read(path: Path | None, names: list[str]) -> TrainSettings:
        """Reads them.

        Args:
            path: The file; None: there is none.
            names: Of the folders that there are.

        Raises:
            FormatError: The file cannot be read, or holds something else than tables.
        """
        if path is None:
            return TrainSettings(None, names, {})
        try:
            document = toml_values(path)
        except FileNotFoundError:
            raise ls.errors.MissingFileError(path, "no such file") from None
        except (OSError, ValueError) as error:
            raise ls.FormatError(path, f"cannot be read as TOML: {error}") from None
        for name, table in document.items():
            if not isinstance(table, dict):
                raise ls.FormatError(
                    path, f"{name} stands in no table: begin one by the name of a folder, [{names[0]}]"
                )
        return TrainSettings(path, names, cast(dict[str, dict[str, Any]], document))

    def warn_of_unused(self) -> None:
        """Logs which table is of no folder, if one is."""
        if others := [name for name in self.tables if name not in self.names]:
            given = ", ".join(self.names)
            _log.warning("%s: [%s] is of no folder that is given: there are %s", self.path, others[0], given)

    def text(self, name: str) -> str:
        """The settings of a folder as a text, the same for the same settings."""
        return ", ".join(f"{key} = {value!r}" for key, value in sorted(self.tables.get(name, {}).items()))

    def applied(self, name: str, training: Train) -> Train:
        """A training with the settings of its folder.

        Raises:
            FormatError: A key is no option of single folders, or a value is none of it.
        """
        known = [entry.name for entry in fields(Train) if entry.name not in _OF_ALL]
        args: list[str] = []
        for key, value in self.tables.get(name, {}).items():
            if key.replace("-", "_") not in known:
                raise self._error(name, f"unknown key {key!r}, expected options of train, such as cap or iterations")
            option = key.replace("-", "_")
            if isinstance(getattr(training, option), bool):
                if not isinstance(value, bool):
                    raise self._error(name, f"{key} is {value!r}, expected true or false")
                training = replace(training, **{option: value})
            elif isinstance(value, str | int | float) and not isinstance(value, bool):
                args.append(f"--{option.replace('_', '-')}={value}")
            else:
                raise self._error(name, f"{key} is {value!r}, expected a number or a word, as of the command")
        try:
            with panels_as_errors():
                own = tyro.cli(Train, args=args, default=training, config=(FlagCreatePairsOff,))
            own.check()
        except (ArgumentsError, ls.ConfigError) as error:
            raise self._error(name, f"{error}") if self.tables.get(name) else error from None
        return own

    def _error(self, name: str, what: str) -> ls.FormatError:
        assert self.path is not None
        return ls.FormatError(self.path, f"[{name}] {what}")
