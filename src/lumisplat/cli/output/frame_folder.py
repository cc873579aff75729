"""Folder of rendered frames, with a stamp: a JSON file that stores what the frames were rendered from.

Frames are written whole or not at all, so that existing ones need not be rendered again. The stamp,
``animate.json`` (``orbit.json`` of an orbit, ``render.json`` of images), stores the provenance: the values of all
settings and files that affect frames. A command with another provenance does not continue with the existing frames.
Videos are made from the files of the frames.
"""

from __future__ import annotations

import json
import logging
import os
import re
import secrets
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, fields, is_dataclass
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import lumisplat as ls
from lumisplat.cli.output.console import Report, counted
from lumisplat.cli.output.images import make_folder

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt
    from _typeshed import DataclassInstance


_log = logging.getLogger("lumisplat")

_FRAME = re.compile(r"frame_\d{4,}\.(png|exr|npz)")


@dataclass(frozen=True)
class FrameFolder:
    """Folder into which a command writes frames, or other files, one by one, so that a later run can continue."""

    folder: Path
    extension: str
    stamp: str = "animate.json"
    """Name of the JSON file in the folder that stores the provenance: all settings and files that the frames depend
    on."""
    names: tuple[str, ...] | None = None
    """File name of each frame, relative to the folder; None numbers the files ``frame_0000`` and so on."""
    is_default: bool = field(default=False, kw_only=True)
    """True if the user did not name the folder: frames of other settings in it are then replaced, which is logged."""
    replace_hint: str = field(default="give --overwrite", kw_only=True)
    """How a command line must be changed so that it removes existing frames; part of messages."""

    @staticmethod
    def named_after(output: Path | None, video: Path | None, otherwise: str, extension: str, stamp: str) -> FrameFolder:
        """Returns the folder of ``-o``, else a folder named like the video, else the folder ``otherwise``.

        Args:
            output: Value of ``-o``; None if the user named no folder.
            video: Value of ``--video``; None without it.
            otherwise: Name of the folder without a video.
            extension: Extension of the frames.
            stamp: File name of the stamp.
        """
        folder = output or (Path(otherwise) if video is None else video.with_suffix(""))
        return FrameFolder(folder, extension, stamp, is_default=output is None)

    def path(self, index: int) -> Path:
        """Returns the file path of a frame, given its number."""
        return self.folder / (f"frame_{index:04d}.{self.extension}" if self.names is None else self.names[index])

    def holds(self, path: str) -> bool:
        """True if a path is this folder, or is inside it."""
        folder = Path(os.path.abspath(self.folder))
        return folder in (Path(os.path.abspath(path)), *Path(os.path.abspath(path)).parents)

    def is_finished(self, index: int) -> bool:
        """True if the frame with a number need not be made: its file exists."""
        return self.path(index).is_file()

    def is_stopped(self, index: int) -> bool:
        """True if a frame was stopped at a time limit, so that a later run continues it; False in this base class."""
        return False

    def tidy(self, index: int) -> None:
        """Removes the files that were needed only to make the frame with a number; does nothing in this base class."""

    def prepare(self, provenance: Mapping[str, str], overwrite: bool) -> None:
        """Creates the folder and the stamp file that stores the provenance; frames of the same provenance stay.

        Args:
            provenance: Values of all settings and files that the frames depend on, as text by name.
            overwrite: True removes all existing frames first.

        Raises:
            ConfigError: There are frames of another provenance; the message names the differences.
            FormatError: The folder cannot be written.
        """
        stamp = self.folder / self.stamp
        if self._frames() and not overwrite:
            overwrite = self._check(stamp, provenance)
        make_folder(self.folder)
        temporary = stamp.with_name(
            f".{stamp.stem}.{secrets.token_hex(6)}.lumisplat.json"
        )  # named like temporary files of frames
        try:
            temporary.write_text(json.dumps(self._stamped(stamp, provenance), indent=1) + "\n")
            if overwrite:
                self._clear(stamp)
            while not _create_stamp(temporary, stamp):  # another run has put its stamp there meanwhile
                stored = stored_provenance(stamp)
                if overwrite:
                    self._clear(stamp)
                elif stored is None:
                    stamp.unlink(missing_ok=True)
                elif self._differing(stored, provenance):
                    raise self._begun_by_another(stored, provenance)
                else:
                    os.replace(temporary, stamp)  # the new stamp may list more captures
                    return
        except OSError as error:
            raise ls.FormatError(stamp, f"cannot be written: {error.strerror or error}") from None
        finally:
            with suppress(OSError):
                temporary.unlink()

    def _clear(self, stamp: Path) -> None:
        """Removes the stamp file, then the frames.

        Other runs in the folder stop when the stamp is gone, and remove frames that they have just written. If the
        process is killed after removing the stamp, no later run can continue with the remaining frames by mistake.
        """
        stamp.unlink(missing_ok=True)
        for path in self._frames():
            path.unlink(missing_ok=True)

    def check_current(self, provenance: Mapping[str, str]) -> None:
        """Checks that the stamp still has this command's provenance: no run with other settings has taken the folder.

        Raises:
            ConfigError: The stamp differs or is missing.
        """
        stored = stored_provenance(self.folder / self.stamp)
        if stored is None or self._differing(stored, provenance):
            raise ls.ConfigError(
                f"{self.folder}: {self.stamp} has changed: another run with other settings has begun there, or the "
                "folder was emptied; this run stops, so that frames do not mix"
            )

    def _frames(self) -> list[Path]:
        if not self.folder.is_dir():
            return []
        if self.names is not None:
            return [path for name in self.names if (path := self.folder / name).is_file()]
        return sorted(path for path in self.folder.iterdir() if _FRAME.fullmatch(path.name))

    def _check(self, stamp: Path, provenance: Mapping[str, str]) -> bool:
        """Decides about existing frames: True if they must be replaced, False if they can stay.

        They can stay if they have this provenance. They are replaced if only values differ and the user named no
        folder.

        Args:
            stamp: Path of the stamp file.
            provenance: Values of all settings and files that the new frames depend on.

        Raises:
            ConfigError: The user has to decide: the stamp is missing, or the folder was named and its frames differ.
        """
        advice = f"{self.replace_hint} to remove them, or choose another folder{' by -o' if self.is_default else ''}"
        stored = stored_provenance(stamp)
        if stored is None:
            raise ls.ConfigError(f"{self.folder} holds frames, but no {self.stamp} with their settings: {advice}")
        if not (changed := self._differing(stored, provenance)):
            return False
        # Frames of other files are not replaced unasked: they are not an earlier try of this scene.
        if not self.is_default or stored.keys() != provenance.keys():
            what = f"other settings or files ({_listed(changed)})"
            raise ls.ConfigError(f"{self.folder} holds frames of {what}: {advice}")
        old = f"{counted(len(self._frames()), 'frame')} of other settings or files ({_listed(changed)})"
        _log.warning("%s: %s replaced; -o FOLDER keeps both", self.folder, old)
        return True

    def _begun_by_another(self, stored: Mapping[str, object], provenance: Mapping[str, str]) -> ls.ConfigError:
        """Returns the error for a stamp of another provenance in a folder without frames: another run may be active."""
        differing = self._differing(stored, provenance)
        return ls.ConfigError(
            f"{self.folder}: another run has begun there, which differs in {_listed(differing)}: "
            f"choose another folder, or {self.replace_hint} if it has ended without a frame"
        )

    def _stamped(self, stamp: Path, provenance: Mapping[str, str]) -> dict[str, object]:
        """Returns the values to write into the stamp: the provenance of this run."""
        return dict(provenance)

    def _differing(self, stored: Mapping[str, object], provenance: Mapping[str, str]) -> list[str]:
        """Returns the names of the values in which a stamp and a provenance differ; a missing value differs, too."""
        return sorted(name for name in {*stored, *provenance} if stored.get(name) != provenance.get(name))


def _listed(names: list[str]) -> str:
    """Returns a text with the first three names, and the number of further ones."""
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")


def _create_stamp(temporary: Path, stamp: Path) -> bool:
    """Renames a temporary file to the stamp's path unless a stamp exists; returns False if one does.

    Of two runs at the same time, only one succeeds (on file systems without hard links, the later one replaces the
    stamp).
    """
    try:
        os.link(temporary, stamp)
    except FileExistsError:
        return False
    except OSError:  # no hard links here: of two runs, the later one stops the other
        os.replace(temporary, stamp)
    return True


def stored_provenance(stamp: Path) -> dict[str, object] | None:
    """Returns the values that a stamp file stores; None if the file is missing or is not a JSON object."""
    try:
        stored: Any = json.loads(stamp.read_text())
    except (OSError, ValueError):
        return None
    return cast(dict[str, object], stored) if isinstance(stored, dict) else None


def flat_settings(prefix: str, settings: DataclassInstance) -> Iterator[tuple[str, str]]:
    """Yields (name, value as text) of each field of a settings object; fields of a group are named ``group.field``.

    Args:
        prefix: Text before each name.
        settings: The settings.
    """
    for entry in fields(settings):
        value = getattr(settings, entry.name)
        if is_dataclass(value) and not isinstance(value, type):
            yield from flat_settings(f"{prefix}{entry.name}.", value)
        else:
            yield f"{prefix}{entry.name}", value.value if isinstance(value, Enum) else repr(value)


def check_video(path: Path, fps: float) -> None:
    """Checks that a video can be written, before its frames are rendered: extension, rate, package and folder.

    Raises:
        FormatError: The video cannot be written.
        MissingExtraError: A package is not installed.
    """
    if path.suffix.lower() == ".png":
        raise ls.FormatError(path, "is an image name, expected .mp4, .gif, .webp or .apng")
    import numpy as np

    if path.exists() and not path.is_file():
        raise ls.FormatError(path, "is a folder or a device, expected the name of a video")
    with tempfile.TemporaryDirectory() as elsewhere:
        trial = Path(elsewhere) / f"trial{path.suffix}"
        try:
            ls.save_animation(trial, [np.zeros((16, 16, 3), np.float32)], fps)
        except ls.FormatError as error:
            raise ls.FormatError(path, str(error).removeprefix(f"{trial}: ")) from None
    folder = next(parent for parent in path.absolute().parents if parent.exists())
    try:
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        raise ls.FormatError(path, f"cannot be written, as {folder} is not writable: {error.strerror}") from None


def write_video(path: Path, frames: Sequence[Path], fps: float, report: Report) -> None:
    """Writes a video from image files, one frame from each.

    Args:
        path: Path of the video; its extension selects the format.
        frames: Image files, in order.
        fps: Frames per second.
        report: Receives the progress.

    Raises:
        FormatError: The video cannot be written.
        SceneError: An image cannot be read.
    """
    ls.save_animation(path, _loaded_images(frames, report), fps)


def _loaded_images(paths: Sequence[Path], report: Report) -> Iterator[npt.NDArray[np.float32]]:
    """Yields the images of files one by one, and reports the progress."""
    for done, path in enumerate(paths):
        report("writing the video", done / len(paths))
        try:
            yield ls.load_image(path)
        except ls.FormatError as error:
            raise ls.SceneError(f"{error}; delete it and run the command again") from None
    report("writing the video", 1.0)
