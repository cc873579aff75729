"""What a file says that is not read, or a scene that is not written: told in one log line at the end."""

from __future__ import annotations

import logging
import os
from dataclasses import dataclass, field

from lumisplat.io.files.source import PathLike

_log = logging.getLogger("lumisplat")

_NAMES_LISTED = 3
"""Names of things that a remark lists."""
_REMARKS_LISTED = 12
"""Remarks in one line."""


@dataclass(slots=True)
class Remarks:
    """Remarks about a file: each once, with the names of the things that it is about."""

    path: PathLike
    head: str
    """Beginning of the line, after the file."""
    names: dict[str, list[str]] = field(default_factory=dict[str, list[str]])

    def add(self, remark: str, name: str = "") -> None:
        """Notes what a thing has that is left out, or how it is understood.

        Args:
            remark: Such as ``"the range of lights"``.
            name: The thing.
        """
        names = self.names.setdefault(remark, [])
        if name and name not in names:
            names.append(name)

    def report(self) -> None:
        """Logs the line, if there is anything to say."""
        if not self.names:
            return
        said = [remark + _listed(names) for remark, names in self.names.items()]
        more = f"; and {len(said) - _REMARKS_LISTED} more" if len(said) > _REMARKS_LISTED else ""
        _log.warning("%s: %s: %s%s", os.fspath(self.path), self.head, "; ".join(said[:_REMARKS_LISTED]), more)


def _listed(names: list[str]) -> str:
    """The first few names, in brackets."""
    more = f" and {len(names) - _NAMES_LISTED} more" if len(names) > _NAMES_LISTED else ""
    return f" ({', '.join(names[:_NAMES_LISTED])}{more})" if names else ""
