"""Poses of photographs from their contents alone, by COLMAP (Schoenberger and Frahm 2016), with the extra ``poses``.

The choices and their figures: docs/adr/0045-photographs-and-poses.md and docs/adr/0056-poses-of-films.md.
"""

from __future__ import annotations

import logging
import os
import shutil
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any

from lumisplat.errors import FormatError, MissingExtraError, MissingFileError
from lumisplat.io.files.source import PathLike
from lumisplat.io.photographs.listing import IMAGE_SUFFIXES
from lumisplat.io.photographs.mapping import Mapping
from lumisplat.io.photographs.verdict import Placement
from lumisplat.progress import Progress

_log = logging.getLogger("lumisplat")

_WORK = "poses.unfinished"
"""Folder of what has been found until poses are."""


def find_poses(folder: PathLike, *, ordered: bool = False, progress: Progress | None = None) -> Path:
    """Finds where photographs were taken from, and writes a sparse model of COLMAP beside them.

    Photographs of one size are taken for those of one lens, with one focal length. COLMAP sees large ones at a
    thousand pixels; the poses are of the files as they are, which `load_photographs` makes smaller itself. What has
    been found is kept in ``poses.unfinished`` in the folder until all is: after an interruption, the same call goes on.

    Args:
        folder: Its photographs are in ``images``; without that, in the folder itself.
        ordered: The photographs are frames of a film in the order of their names: each is compared with the next ones,
            and with those that look like it. Else those that look alike are compared, of few photographs all.
        progress: Called with what is being done and the fraction done, 0..1.

    Returns:
        The folder of the model, ``sparse/0``. Photographs without a pose are not in it. Log lines say how many these
        are, and what speaks against the poses: pieces that do not join, few points, large errors, an odd lens.

    Raises:
        FormatError: There are fewer than two photographs, one cannot be read, there is a model already, or no poses
            were found: photographs must overlap, show texture, and be taken from different places.
        KeyboardInterrupt: With what has been found, in words.
        MissingFileError: There is no such folder.
        MissingExtraError: pycolmap is not installed.
    """
    folder = Path(folder)
    names = _photographs(folder)
    if (folder / "sparse").exists():
        raise FormatError(
            folder / "sparse", "is there already: load_photographs reads it; remove it to find poses anew"
        )
    try:
        pycolmap: Any = import_module("pycolmap")
    except ImportError:
        raise MissingExtraError("find_poses", "poses") from None
    mapping = Mapping(pycolmap, _images(folder), names, folder / _WORK, progress or (lambda _, share: None))
    with _quiet(pycolmap, mapping, folder):
        mapping.prepare()
        mapping.extract()
        mapping.match(ordered)
        models = mapping.place()
        if not models:
            raise FormatError(folder, f"no poses were found for its {len(names)} photographs: {mapping.why_none()}")
        model = mapping.work / "model"
        model.mkdir(exist_ok=True)
        models[0].write(model)
        (folder / "sparse").mkdir()
        os.replace(model, folder / "sparse" / "0")
        shutil.rmtree(mapping.work)
    for remark in Placement.of(names, models).remarks():
        _log.warning("%s: %s", folder, remark)
    return folder / "sparse" / "0"


def _images(folder: Path) -> Path:
    return folder / "images" if (folder / "images").is_dir() else folder


def _photographs(folder: Path) -> Sequence[str]:
    """The names of the photographs of a folder, in order."""
    if not folder.is_dir():
        raise MissingFileError(folder, "no such folder")
    images = _images(folder)
    names = sorted(path.name for path in images.iterdir() if path.suffix.lower() in IMAGE_SUFFIXES and path.is_file())
    if len(names) < 2:
        found = "one photograph" if names else "no photographs"
        raise FormatError(images, f"has {found}, expected two or more ({', '.join(IMAGE_SUFFIXES)})")
    return names


@contextmanager
def _quiet(pycolmap: Any, mapping: Mapping, folder: Path) -> Generator[None]:
    """COLMAP's own lines stay off the terminal, and its errors become ours, after which nothing is left."""
    level = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = 3
    try:
        yield
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"{mapping.work} holds {mapping.found()}; the same command continues") from None
    except FormatError:
        shutil.rmtree(mapping.work, ignore_errors=True)
        raise
    except OSError as error:
        raise FormatError(mapping.work, f"cannot be written: {error.strerror or error}") from None
    except (RuntimeError, ValueError) as error:
        shutil.rmtree(mapping.work, ignore_errors=True)
        raise FormatError(folder, f"COLMAP cannot find poses: {' '.join(str(error).split())[:200]}") from error
    finally:
        pycolmap.logging.minloglevel = level
