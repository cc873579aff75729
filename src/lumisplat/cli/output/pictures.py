"""Which cameras are rendered to which files, in which format."""

from __future__ import annotations

import mimetypes
import re
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import lumisplat as ls

FORMATS = ("png", "exr", "npz")
_UNSAFE = re.compile(r"[^\w.-]+")
_STEM_BYTES = 150
"""Longest file stem, UTF-8: room for layer names and suffixes below the usual limit of 255 bytes."""


@dataclass(frozen=True)
class Shot:
    """A picture to render."""

    camera: ls.Camera
    path: Path


def plan_shots(cameras: Sequence[ls.Camera], wanted: Sequence[str], output: Path, format_name: str) -> list[Shot]:
    """Decides which cameras are rendered, and to which files.

    Args:
        cameras: All cameras.
        wanted: Names of those to render; none means all.
        output: A folder, or for a single picture a file ``.png``, ``.exr`` or ``.npz``.
        format_name: One of `FORMATS`, or ``auto``: that of the file's name, else PNG.

    Raises:
        ConfigError: A name is unknown, the output is an image of another kind, or its name and format do not go
            together.
    """
    stems = file_stems([camera.name for camera in cameras])
    chosen = [index for index in range(len(cameras)) if not wanted or {cameras[index].name, stems[index]} & {*wanted}]
    for name in wanted:
        if not any(name in (cameras[index].name, stems[index]) for index in chosen):
            listed = ", ".join(stems[:5]) + (", ..." if len(stems) > 5 else "")
            raise ls.ConfigError(f"no frame is named '{name}': there are {len(stems)} ({listed})")
    suffix = output.suffix.lower().removeprefix(".")
    if suffix not in FORMATS:
        if (mimetypes.guess_type(output)[0] or "").startswith(("image/", "video/")):
            raise ls.ConfigError(
                f"{output}: unknown image extension '.{suffix}', expected .png, .exr or .npz, or a folder"
            )
        extension = "png" if format_name == "auto" else format_name
        return [Shot(cameras[index], output / f"{stems[index]}.{extension}") for index in chosen]
    if format_name not in ("auto", suffix):
        raise ls.ConfigError(f"{output}: the name says {suffix}, --format says {format_name}")
    if len(chosen) > 1:
        raise ls.ConfigError(
            f"{output}: {len(chosen)} frames do not fit in one file: give a folder, or name one by --frames"
        )
    return [Shot(cameras[index], output) for index in chosen]


def file_stems(names: Sequence[str]) -> list[str]:
    """A safe file stem for each frame name, with a number where two would be equal, ignoring case."""
    taken: set[str] = set()
    copies: dict[str, int] = {}
    stems: list[str] = []
    for index, name in enumerate(names):
        safe = _UNSAFE.sub("_", name).strip("._").encode()[:_STEM_BYTES].decode(errors="ignore")
        safe = safe or f"frame_{index:04d}"
        stem = safe
        while stem.casefold() in taken:
            copies[safe] = copies.get(safe, 1) + 1
            stem = f"{safe}_{copies[safe]}"
        taken.add(stem.casefold())
        stems.append(stem)
    return stems


def check_writable(output: Path) -> None:
    """Checks whether pictures can be written, before anything slow is done; leaves nothing behind.

    Args:
        output: As for `plan_shots`.

    Raises:
        FormatError: A file is in the way, or the folder that is there already cannot be written to.
    """
    check_folder(output.parent if output.suffix.lower().removeprefix(".") in FORMATS else output, output)


def check_folder(folder: Path, output: Path | None = None) -> None:
    """Checks whether files can be written into a folder that is there or that can be made; leaves nothing behind.

    Args:
        folder: The folder.
        output: What messages name; None: the folder.

    Raises:
        FormatError: As of `check_writable`.
    """
    existing = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    if not existing.is_dir():
        raise ls.FormatError(existing, "is a file, expected a folder")
    try:
        tempfile.TemporaryFile(dir=existing).close()
    except OSError as error:
        raise ls.FormatError(
            output or folder, f"cannot be written, nothing can in {existing}: {error.strerror}"
        ) from None


def make_folder(folder: Path) -> None:
    """Makes ``folder`` and its parents.

    Raises:
        FormatError: It cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except FileExistsError:
        raise ls.FormatError(folder, "is a file, expected a folder for the pictures") from None
    except OSError as error:
        raise ls.FormatError(folder, f"the output folder cannot be made: {error.strerror}") from None
