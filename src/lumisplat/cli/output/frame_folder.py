"""Folder of an animation's frames: which frames exist, and which scene and settings they were made from.

Frames are written whole or not at all, so that existing ones need not be rendered again. A stamp file beside them,
``animate.json`` (``orbit.json`` of an orbit, ``render.json`` of images), stores their provenance: everything that they
depend on. Frames of another provenance are refused. A video is made from existing frames.
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
    """Folder of the frames of one animation."""

    folder: Path
    extension: str
    stamp: str = "animate.json"
    """File name of the stamp, which stores the provenance of the frames."""
    names: tuple[str, ...] | None = None
    """File names of the frames; None is ``frame_0000`` and so on."""
    is_default: bool = field(default=False, kw_only=True)
    """True if the user has not named the folder: frames of other settings are then replaced, with a log line."""

    @staticmethod
    def named_after(output: Path | None, video: Path | None, otherwise: str, extension: str, stamp: str) -> FrameFolder:
        """Returns the folder that the user named, else one named after the video, else the default.

        Args:
            output: Value of ``-o``; None if the user named no folder.
            video: Value of ``--video``.
            otherwise: Name of the folder without a video.
            extension: Extension of the frames.
            stamp: File name of the stamp.
        """
        folder = output or (Path(otherwise) if video is None else video.with_suffix(""))
        return FrameFolder(folder, extension, stamp, is_default=output is None)

    def path(self, index: int) -> Path:
        """Returns the file of a frame."""
        return self.folder / (f"frame_{index:04d}.{self.extension}" if self.names is None else self.names[index])

    def holds(self, path: str) -> bool:
        """Returns whether a path is the folder or lies in it."""
        folder = Path(os.path.abspath(self.folder))
        return folder in (Path(os.path.abspath(path)), *Path(os.path.abspath(path)).parents)

    def is_finished(self, index: int) -> bool:
        """Returns whether a frame exists."""
        return self.path(index).is_file()

    def is_stopped(self, index: int) -> bool:
        """Returns whether a frame is unfinished because its time was over; the same command then continues."""
        return False

    def tidy(self, index: int) -> None:
        """Removes the parts of a frame that exists."""

    def prepare(self, provenance: Mapping[str, str], overwrite: bool) -> None:
        """Prepares the folder for frames of a provenance; existing frames of the same provenance stay.

        Args:
            provenance: Everything that the frames depend on, by name.
            overwrite: Remove all existing frames first.

        Raises:
            ConfigError: There are frames of another provenance; the message names the differences.
            FormatError: The folder cannot be written.
        """
        stamp = self.folder / self.stamp
        if self._frames() and not overwrite:
            overwrite = self._check(stamp, provenance)
        make_folder(self.folder)
        temporary = stamp.with_name(f".{stamp.stem}.{secrets.token_hex(6)}.lumisplat.json")  # as those of frames
        try:
            temporary.write_text(json.dumps(self._stamped(stamp, provenance), indent=1) + "\n")
            if overwrite:
                self._clear(stamp)
            while not _put(temporary, stamp):  # another run has begun at the same moment, or before its first frame
                stored = stored_provenance(stamp)
                if overwrite:
                    self._clear(stamp)
                elif stored is None:
                    stamp.unlink(missing_ok=True)
                elif self._differing(stored, provenance):
                    raise self._begun_by_another(stored, provenance)
                else:
                    os.replace(temporary, stamp)  # perhaps with more of the same origin
                    return
        except OSError as error:
            raise ls.FormatError(stamp, f"cannot be written: {error.strerror or error}") from None
        finally:
            with suppress(OSError):
                temporary.unlink()

    def _clear(self, stamp: Path) -> None:
        """Removes the stamp, then the frames.

        Other runs in the folder stop without the stamp, and remove frames that they write later. After a kill in
        between, nothing can be continued by mistake.
        """
        stamp.unlink(missing_ok=True)
        for path in self._frames():
            path.unlink(missing_ok=True)

    def check_current(self, provenance: Mapping[str, str]) -> None:
        """Checks that no run with other settings has started in the folder.

        Raises:
            ConfigError: Another run has started, or the stamp is gone.
        """
        stored = stored_provenance(self.folder / self.stamp)
        if stored is None or self._differing(stored, provenance):
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

    def _check(self, stamp: Path, provenance: Mapping[str, str]) -> bool:
        """Returns whether existing frames are to be replaced. Raises ConfigError if they may not be."""
        advice = f"give --overwrite to remove them, or another folder{' by -o' if self.is_default else ''}"
        stored = stored_provenance(stamp)
        if stored is None:
            raise ls.ConfigError(f"{self.folder} holds frames, but no {self.stamp} with their settings: {advice}")
        if not (changed := self._differing(stored, provenance)):
            return False
        if (
            not self.is_default or stored.keys() != provenance.keys()
        ):  # frames of other files are no earlier try of these
            what = f"other settings or files ({_listed(changed)})"
            raise ls.ConfigError(f"{self.folder} holds frames of {what}: {advice}")
        old = f"{counted(len(self._frames()), 'frame')} of other settings or files ({_listed(changed)})"
        _log.warning("%s: %s replaced; -o FOLDER keeps both", self.folder, old)
        return True

    def _begun_by_another(self, stored: Mapping[str, object], provenance: Mapping[str, str]) -> ls.ConfigError:
        """Returns the error about another run with other settings that has written no frame yet."""
        differing = self._differing(stored, provenance)
        return ls.ConfigError(
            f"{self.folder}: another run has begun there, which differs in {_listed(differing)}: "
            "choose another folder, or give --overwrite if it has ended without a frame"
        )

    def _stamped(self, stamp: Path, provenance: Mapping[str, str]) -> dict[str, object]:
        """Returns the content of the stamp."""
        return dict(provenance)

    def _differing(self, stored: Mapping[str, object], provenance: Mapping[str, str]) -> list[str]:
        """Returns the names whose values differ between a stamp and a provenance."""
        return sorted(name for name in {*stored, *provenance} if stored.get(name) != provenance.get(name))


def _listed(names: list[str]) -> str:
    """Returns the first three names, and the number of others."""
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")


def _put(temporary: Path, stamp: Path) -> bool:
    """Makes a file the stamp, unless one exists; returns whether it did. One of two simultaneous runs succeeds."""
    try:
        os.link(temporary, stamp)
    except FileExistsError:
        return False
    except OSError:  # a file system without links: the run that begins last stops the other
        os.replace(temporary, stamp)
    return True


def stored_provenance(stamp: Path) -> dict[str, object] | None:
    """Returns the content of a stamp; None if it is missing or no stamp."""
    try:
        stored: Any = json.loads(stamp.read_text())
    except (OSError, ValueError):
        return None
    return cast(dict[str, object], stored) if isinstance(stored, dict) else None


def flat_settings(prefix: str, settings: DataclassInstance) -> Iterator[tuple[str, str]]:
    """Yields names and values of settings; those of groups are named ``group.name``."""
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
    """Writes image files as a video.

    Raises:
        FormatError: The video cannot be written.
        SceneError: An image cannot be read.
    """
    ls.save_animation(path, _loaded_images(frames, report), fps)


def _loaded_images(paths: Sequence[Path], report: Report) -> Iterator[npt.NDArray[np.float32]]:
    """Yields the images one by one."""
    for done, path in enumerate(paths):
        report("writing the video", done / len(paths))
        try:
            yield ls.load_image(path)
        except ls.FormatError as error:
            raise ls.SceneError(f"{error}; delete it and run the command again") from None
    report("writing the video", 1.0)
