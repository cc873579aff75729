"""Poses of photographs from their contents alone, by COLMAP (Schoenberger and Frahm 2016), with the extra ``poses``.

The choice and its figures: docs/adr/0045-photographs-and-poses.md.
"""

from __future__ import annotations

import logging
import os
import tempfile
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

from lumisplat.errors import FormatError, MissingExtraError, MissingFileError
from lumisplat.io.files.source import PathLike
from lumisplat.io.images.texture import image_size
from lumisplat.io.photographs.listing import some_names

_log = logging.getLogger("lumisplat")

_SUFFIXES = (".jpg", ".jpeg", ".png", ".webp", ".tif", ".tiff", ".bmp")
_NEIGHBOURS = 10
"""How many of the next frames of a film a frame is compared with; and with those at twice, four times, ... as far."""
_BATCH = 8
"""Photographs whose features are found between two reports of progress."""
_PAIRS = 100
"""Pairs that are compared between two reports, at least."""

Report = Callable[[str, float], None]


def find_poses(folder: PathLike, *, ordered: bool = False, progress: Report | None = None) -> Path:
    """Finds where photographs were taken from, and writes a sparse model of COLMAP beside them.

    Photographs of one size are taken for those of one lens. It takes minutes for 50 photographs, and hours for
    hundreds: small ones will do (1,000 pixels), as `load_photographs` needs those that the poses were found for.

    Args:
        folder: Its photographs are in ``images``; without that, in the folder itself.
        ordered: The photographs are frames of a film in the order of their names: each is compared with those after it,
            rather than with all others.
        progress: Called with what is being done and the fraction done, 0..1.

    Returns:
        The folder of the model, ``sparse/0``. Photographs without a pose are not in it; a log line counts them.

    Raises:
        FormatError: There are fewer than two photographs, one cannot be read, there is a model already, or no poses
            were found: photographs must overlap, show texture, and be taken from different places.
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
    with tempfile.TemporaryDirectory(prefix=".poses-", dir=folder) as work, _quiet(pycolmap, folder):
        mapping = _Mapping(pycolmap, _images(folder), names, Path(work), progress or (lambda _, share: None))
        mapping.extract()
        mapping.match(ordered)
        placed = mapping.place()
        if not placed:
            raise FormatError(
                folder,
                f"no poses were found for its {len(names)} photographs: they must overlap, show texture, and be taken "
                "from different places",
            )
        (folder / "sparse").mkdir()
        os.replace(mapping.model, folder / "sparse" / "0")
    if lost := sorted({*names} - placed):
        _log.warning(
            "%s: no pose was found for %d of %d photographs (%s)", folder, len(lost), len(names), some_names(lost)
        )
    return folder / "sparse" / "0"


@dataclass(frozen=True, slots=True)
class _Mapping:
    """The steps of COLMAP, each of which reads what the ones before have written."""

    pycolmap: Any
    images: Path
    names: Sequence[str]
    work: Path
    report: Report

    @property
    def model(self) -> Path:
        """Where the model is written."""
        return self.work / "model"

    @property
    def _database(self) -> Path:
        """The file of features and matches."""
        return self.work / "database.db"

    @property
    def _links(self) -> list[str]:
        """Names without spaces, which divide those in COLMAP's lists of pairs."""
        return [f"{index:06d}{Path(name).suffix}" for index, name in enumerate(self.names)]

    def extract(self) -> None:
        """Finds features, and how many lenses there are."""
        (self.work / "images").mkdir()
        for link, name in zip(self._links, self.names, strict=True):
            (self.work / "images" / link).symlink_to((self.images / name).resolve())
        one_lens = len({image_size(self.images / name) for name in self.names}) == 1
        options = self.pycolmap.ImageReaderOptions(camera_model="OPENCV")
        modes = self.pycolmap.CameraMode
        for start in range(0, len(self.names), _BATCH):
            self.report("finding features", start / len(self.names))
            self.pycolmap.extract_features(
                self._database,
                self.work / "images",
                image_names=self._links[start : start + _BATCH],
                camera_mode=modes.SINGLE if one_lens else modes.PER_IMAGE,
                reader_options=options,
            )
            if one_lens:
                options.existing_camera_id = 1
        self.report("finding features", 1.0)

    def match(self, ordered: bool) -> None:
        """Compares features of pairs."""
        pairs = _pairs(len(self.names), ordered)
        listed = self.work / "pairs.txt"
        step = max(_PAIRS, len(pairs) // 50)
        for start in range(0, len(pairs), step):
            self.report("comparing photographs", start / len(pairs))
            listed.write_text("".join(f"{self._links[i]} {self._links[j]}\n" for i, j in pairs[start : start + step]))
            options = self.pycolmap.ImportedPairingOptions(match_list_path=listed)
            self.pycolmap.match_image_pairs(self._database, pairing_options=options)
        self.report("comparing photographs", 1.0)

    def place(self) -> set[str]:
        """Finds poses, and writes the model with the most of them; the names of its photographs, which may be none."""
        placed = 2  # the mapper begins with a pair

        def next_image() -> None:
            nonlocal placed
            placed += 1
            self.report("finding poses", min(0.99, placed / len(self.names)))

        self.report("finding poses", 0.0)
        options = self.pycolmap.IncrementalPipelineOptions(random_seed=0)
        found: dict[int, Any] = self.pycolmap.incremental_mapping(
            self._database, self.work / "images", self.work, options, next_image_callback=next_image
        )
        self.report("finding poses", 1.0)
        if not found:
            return set()
        best = max(found.values(), key=lambda model: model.num_reg_images())
        name_of = dict(zip(self._links, self.names, strict=True))
        for image in best.images.values():
            image.name = name_of[image.name]
        self.model.mkdir()
        best.write(self.model)
        return {best.image(index).name for index in best.reg_image_ids()}


def _pairs(count: int, ordered: bool) -> list[tuple[int, int]]:
    """The pairs of photographs that are compared."""
    if not ordered:
        return [(i, j) for i in range(count) for j in range(i + 1, count)]
    steps = [*range(1, _NEIGHBOURS + 1)]
    while steps[-1] < count:
        steps.append(2 * steps[-1])
    return [(i, i + step) for i in range(count) for step in steps if i + step < count]


def _images(folder: Path) -> Path:
    return folder / "images" if (folder / "images").is_dir() else folder


def _photographs(folder: Path) -> Sequence[str]:
    """The names of the photographs of a folder, in order."""
    if not folder.is_dir():
        raise MissingFileError(folder, "no such folder")
    images = _images(folder)
    names = sorted(path.name for path in images.iterdir() if path.suffix.lower() in _SUFFIXES and path.is_file())
    if len(names) < 2:
        found = "one photograph" if names else "no photographs"
        raise FormatError(images, f"has {found}, expected two or more ({', '.join(_SUFFIXES)})")
    return names


@contextmanager
def _quiet(pycolmap: Any, folder: Path) -> Generator[None]:
    """COLMAP's own lines stay off the terminal, and its errors become ours."""
    level = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = 3
    try:
        yield
    except (RuntimeError, ValueError) as error:
        if isinstance(error, FormatError):
            raise
        raise FormatError(folder, f"COLMAP cannot find poses: {' '.join(str(error).split())[:200]}") from error
    finally:
        pycolmap.logging.minloglevel = level
