"""Which pictures are compared with which: two files, or those of two folders by their names."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

import lumisplat as ls

_log = logging.getLogger("lumisplat")

_EXTENSIONS = (".png", ".jpg", ".jpeg", ".webp", ".exr", ".hdr")


@dataclass(frozen=True)
class Pair:
    """A picture and its reference."""

    name: str
    image: Path
    reference: Path


def picture_pairs(image: Path, reference: Path) -> list[Pair]:
    """The pairs of two files or two folders, in the order of their names.

    Pictures of folders are paired by their names without the extension: a PNG may have an EXR as reference.

    Pictures without a partner are left out, and a log line says which.

    Raises:
        FormatError: One is missing, only one is a folder, a folder has no pictures or two of the same name, or no
            picture has a partner.
    """
    for path in (image, reference):
        if not path.exists():
            raise ls.FormatError(path, "no such file or folder")
    if image.is_dir() != reference.is_dir():
        folder, file = (image, reference) if image.is_dir() else (reference, image)
        raise ls.FormatError(folder, f"is a folder and {file} is not: compare two files, or two folders")
    if not image.is_dir():
        return [Pair(image.stem, image, reference)]
    ours, theirs = _pictures(image), _pictures(reference)
    both = sorted({*ours} & {*theirs})
    for folder, missing in ((reference, sorted({*ours} - {*theirs})), (image, sorted({*theirs} - {*ours}))):
        if missing:
            count = f" ({len(missing)} pictures of the other folder are missing)" if len(missing) > 1 else ""
            problem = ls.FormatError(folder, f"has no picture '{missing[0]}' as the other folder does{count}")
            if not both:
                raise problem
            _log.warning("%s: left out", problem)
    return [Pair(name, ours[name], theirs[name]) for name in both]


def _pictures(folder: Path) -> dict[str, Path]:
    """The pictures of a folder by their names without the extension."""
    found: dict[str, Path] = {}
    for path in sorted(folder.iterdir()):
        if path.suffix.lower() in _EXTENSIONS and not path.name.startswith("."):
            if path.stem in found:
                raise ls.FormatError(path, f"has the name of {found[path.stem].name}: which of them is to be compared?")
            found[path.stem] = path
    if not found:
        raise ls.FormatError(folder, f"holds no pictures ({', '.join(_EXTENSIONS)})")
    return found
