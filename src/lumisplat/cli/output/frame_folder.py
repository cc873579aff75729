"""The folder of an animation's frames: which are there, and of which scene and settings they were made.

Frames appear whole or not at all, so that those that are there need not be rendered again. ``animate.json`` beside them
(``orbit.json`` of an orbit, ``render.json`` of pictures) says what they were made of; frames of anything else are
refused instead of continued.
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
    names: tuple[str, ...] | None = None
    """File names of the frames; None: ``frame_0000`` and so on."""

    def path(self, index: int) -> Path:
        """The file of a frame."""
        return self.folder / (f"frame_{index:04d}.{self.extension}" if self.names is None else self.names[index])

    def holds(self, path: str) -> bool:
        """Whether a path is of this folder."""
        folder = Path(os.path.abspath(self.folder))
        return folder in (Path(os.path.abspath(path)), *Path(os.path.abspath(path)).parents)

    def is_finished(self, index: int) -> bool:
        """Whether a frame is there."""
        return self.path(index).is_file()

    def tidy(self, index: int) -> None:
        """Removes what a frame was made of, once it is there."""

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
        if frames and not overwrite:
            self._check(stamp, origin)
        make_folder(self.folder)
        if (
            overwrite
        ):  # the stamp first: without it, other runs in the folder stop, and a kill leaves nothing to go on with
            for path in (stamp, *frames):
                path.unlink(missing_ok=True)
        temporary = stamp.with_name(f".{stamp.stem}.{secrets.token_hex(6)}.lumisplat.json")  # as those of frames
        try:
            temporary.write_text(json.dumps(dict(origin), indent=1) + "\n")
            os.replace(temporary, stamp)
        except OSError as error:
            raise ls.FormatError(stamp, f"cannot be written: {error.strerror or error}") from None
        finally:
            with suppress(OSError):
                temporary.unlink()

    def check_current(self, origin: Mapping[str, str]) -> None:
        """Checks that no run with other settings has begun in the folder.

        Raises:
            ConfigError: One has, or the stamp is gone.
        """
        if _stored(self.folder / self.stamp) != dict(origin):
            raise ls.ConfigError(
                f"{self.folder}: {self.stamp} is not what this run has written: another run with other settings has "
                "begun there, or the folder was emptied; this one stops, so that frames do not mix"
            )

    def _frames(self) -> list[Path]:
        if not self.folder.is_dir():
            return []
        if self.names is not None:
            return [path for name in self.names if (path := self.folder / name).is_file()]
        return sorted(path for path in self.folder.iterdir() if _FRAME.fullmatch(path.name))

    def _check(self, stamp: Path, origin: Mapping[str, str]) -> None:
        """Raises ConfigError unless the frames that are there are of this origin."""
        advice = "give --overwrite to remove them, or another folder"
        stored = _stored(stamp)
        if stored is None:
            raise ls.ConfigError(
                f"{self.folder} holds frames, but no {self.stamp} that says what they are of: {advice}"
            )
        changed = sorted(name for name in {*stored, *origin} if stored.get(name) != origin.get(name))
        if changed:
            named = ", ".join(changed[:3]) + (f" and {len(changed) - 3} more" if len(changed) > 3 else "")
            raise ls.ConfigError(f"{self.folder} holds frames from before a change of {named}: {advice}")


def _stored(stamp: Path) -> dict[str, object] | None:
    """What a stamp says; None: there is none, or it is none."""
    try:
        stored: Any = json.loads(stamp.read_text())
    except (OSError, ValueError):
        return None
    return cast(dict[str, object], stored) if isinstance(stored, dict) else None


def flat_settings(prefix: str, settings: DataclassInstance) -> Iterator[tuple[str, str]]:
    """Names and values of settings, groups included."""
    for entry in fields(settings):
        value = getattr(settings, entry.name)
        if is_dataclass(value) and not isinstance(value, type):
            yield from flat_settings(f"{prefix}{entry.name}.", value)
        else:
            yield f"{prefix}{entry.name}", value.value if isinstance(value, Enum) else repr(value)
