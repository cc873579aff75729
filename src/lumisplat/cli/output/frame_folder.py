"""The folder of an animation's frames: which are there, and of which scene and settings they were made.

Frames appear whole or not at all, so that those that are there need not be rendered again. ``animate.json`` beside them
(``orbit.json`` of an orbit) says what they were made of; frames of anything else are refused instead of continued.
"""

from __future__ import annotations

import json
import os
import re
import secrets
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, fields, is_dataclass
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import lumisplat as ls
from lumisplat.cli.output.pictures import make_folder

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

_FRAME = re.compile(r"frame_\d{4,}\.(png|exr|npz)")


@dataclass(frozen=True)
class FrameFolder:
    """Frames of one animation."""

    folder: Path
    extension: str
    stamp: str = "animate.json"
    """The file that says what the frames were made of."""

    def path(self, index: int) -> Path:
        """The file of a frame."""
        return self.folder / f"frame_{index:04d}.{self.extension}"

    def is_finished(self, index: int) -> bool:
        """Whether a frame is there."""
        return self.path(index).is_file()

    def prepare(self, origin: Mapping[str, str], overwrite: bool) -> None:
        """Makes the folder ready for frames of an origin; frames of this origin that are there already stay.

        Args:
            origin: All that frames are made of, by name.
            overwrite: Whether to remove all frames that are there first.

        Raises:
            ConfigError: There are frames of another origin; the message names what differs.
            FormatError: The folder cannot be written to.
        """
        stamp = self.folder / self.stamp
        frames = self._frames()
        if overwrite:
            for frame in frames:
                frame.unlink()
        elif frames:
            self._check(stamp, origin)
        make_folder(self.folder)
        temporary = stamp.with_name(f".{stamp.stem}.{secrets.token_hex(6)}.lumisplat.json")  # as those of frames
        try:
            temporary.write_text(json.dumps(dict(origin), indent=1) + "\n")
            os.replace(temporary, stamp)
        except OSError as error:
            raise ls.FormatError(stamp, f"cannot be written: {error.strerror or error}") from None
        finally:
            with suppress(OSError):
                temporary.unlink()

    def _frames(self) -> list[Path]:
        if not self.folder.is_dir():
            return []
        return sorted(path for path in self.folder.iterdir() if _FRAME.fullmatch(path.name))

    def _check(self, stamp: Path, origin: Mapping[str, str]) -> None:
        """Raises ConfigError unless the frames that are there are of this origin."""
        advice = "give --overwrite to remove them, or another folder"
        try:
            before: Any = json.loads(stamp.read_text())
        except (OSError, ValueError):
            before = None
        if not isinstance(before, dict):
            raise ls.ConfigError(
                f"{self.folder} holds frames, but no {self.stamp} that says what they are of: {advice}"
            )
        stored = cast(dict[str, object], before)
        changed = sorted(name for name in {*stored, *origin} if stored.get(name) != origin.get(name))
        if changed:
            named = ", ".join(changed[:3]) + (f" and {len(changed) - 3} more" if len(changed) > 3 else "")
            raise ls.ConfigError(f"{self.folder} holds frames from before a change of {named}: {advice}")


def flat_settings(prefix: str, settings: DataclassInstance) -> Iterator[tuple[str, str]]:
    """Names and values of settings, groups included."""
    for entry in fields(settings):
        value = getattr(settings, entry.name)
        if is_dataclass(value) and not isinstance(value, type):
            yield from flat_settings(f"{prefix}{entry.name}.", value)
        else:
            yield f"{prefix}{entry.name}", value.value if isinstance(value, Enum) else repr(value)
