"""Folder of rendered frames, which records the scene and the settings that the frames were made from.

Frames are written whole or not at all, so that existing ones need not be rendered again. A stamp file beside them,
``animate.json`` (``orbit.json`` of an orbit, ``render.json`` of images), stores their provenance: the values of
everything that affects them. A run whose provenance differs does not continue with these frames. Videos are made from
the files of the frames.
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
    """Folder of the frames of one animation, or of other files that a command makes one by one."""

    folder: Path
    extension: str
    stamp: str = "animate.json"
    """File name of the stamp, which stores the provenance of the frames."""
    names: tuple[str, ...] | None = None
    """File names of the frames; None names them ``frame_0000`` and so on."""
    is_default: bool = field(default=False, kw_only=True)
    """True if the user did not name the folder. Frames of other settings are then replaced, and a log line says so."""

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
        """Returns the file path of a frame, given its number."""
        return self.folder / (f"frame_{index:04d}.{self.extension}" if self.names is None else self.names[index])

    def holds(self, path: str) -> bool:
        """Returns whether a path is the folder or lies in it."""
        folder = Path(os.path.abspath(self.folder))
        return folder in (Path(os.path.abspath(path)), *Path(os.path.abspath(path)).parents)

    def is_finished(self, index: int) -> bool:
        """Returns whether a frame exists."""
        return self.path(index).is_file()

    def is_stopped(self, index: int) -> bool:
        """Returns whether a frame is unfinished because it reached a time limit; the same command then continues it."""
        return False

    def tidy(self, index: int) -> None:
        """Removes files that are no longer needed once a frame exists; none in this class."""

    def prepare(self, provenance: Mapping[str, str], overwrite: bool) -> None:
        """Creates the folder and its stamp; existing frames of the same provenance stay.

        Args:
            provenance: Values of everything that the frames depend on, by name.
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
        """Removes the stamp, then the frames.

        Other runs in the folder stop when the stamp is gone, and remove frames that they have just written. If the
        process is killed after removing the stamp, no later run can continue with the remaining frames by mistake.
        """
        stamp.unlink(missing_ok=True)
        for path in self._frames():
            path.unlink(missing_ok=True)

    def check_current(self, provenance: Mapping[str, str]) -> None:
        """Checks that no run with other settings has started in the folder.

        Raises:
            ConfigError: Another run has started, or the stamp is missing.
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
        """Returns whether existing frames have to be replaced; raises a ConfigError if the user has to decide."""
        advice = f"give --overwrite to remove them, or another folder{' by -o' if self.is_default else ''}"
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
        """Returns the error about a run with other settings that has started here but has not written a frame yet."""
        differing = self._differing(stored, provenance)
        return ls.ConfigError(
            f"{self.folder}: another run has begun there, which differs in {_listed(differing)}: "
            "choose another folder, or give --overwrite if it has ended without a frame"
        )

    def _stamped(self, stamp: Path, provenance: Mapping[str, str]) -> dict[str, object]:
        """Returns the values to store in the stamp."""
        return dict(provenance)

    def _differing(self, stored: Mapping[str, object], provenance: Mapping[str, str]) -> list[str]:
        """Returns the names whose values differ between a stamp and a provenance."""
        return sorted(name for name in {*stored, *provenance} if stored.get(name) != provenance.get(name))


def _listed(names: list[str]) -> str:
    """Returns at most three names as text, and how many more there are."""
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")


def _create_stamp(temporary: Path, stamp: Path) -> bool:
    """Renames a file to the stamp's name, unless a stamp exists; returns True on success.

    If two runs do this at the same time, one of them succeeds.
    """
    try:
        os.link(temporary, stamp)
    except FileExistsError:
        return False
    except OSError:  # no hard links here: of two runs, the later one stops the other
        os.replace(temporary, stamp)
    return True


def stored_provenance(stamp: Path) -> dict[str, object] | None:
    """Returns the content of a stamp; None if the file is missing or is not a JSON object."""
    try:
        stored: Any = json.loads(stamp.read_text())
    except (OSError, ValueError):
        return None
    return cast(dict[str, object], stored) if isinstance(stored, dict) else None


def flat_settings(prefix: str, settings: DataclassInstance) -> Iterator[tuple[str, str]]:
    """Yields name and value of each setting as text; settings of a group are named ``group.name``."""
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
