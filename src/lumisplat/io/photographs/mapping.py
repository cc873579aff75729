"""The steps of COLMAP: features, pairs, poses. What is found is kept in a folder, and not sought again."""

from __future__ import annotations

import json
import logging
import shutil
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lumisplat.constants.photographs import (
    COMPARED_FEATURES,
    COMPARED_PIXELS,
    DOUBLED_PIXELS,
    FEW_POINTS,
    LENS_MODEL,
    SMALLEST_PIECE,
)
from lumisplat.io.images.texture import image_size
from lumisplat.io.photographs.pairs import compared_pairs, largest_features
from lumisplat.math.arrays import FloatArray
from lumisplat.progress import Progress

_log = logging.getLogger("lumisplat")

_BATCH = 4
"""Photographs whose features are found between two reports of progress."""
_PAIRS = 32
"""Pairs that are compared between two reports."""
_WATCHED_S = 0.2
"""How often is looked for Ctrl C, seconds."""


@dataclass(frozen=True, slots=True)
class Mapping:
    """Poses of photographs in the making; each step reads what the ones before have written."""

    pycolmap: Any
    images: Path
    """The folder of the photographs."""
    names: Sequence[str]
    """In their order."""
    work: Path
    """The folder of what is found; is made by `prepare`."""
    report: Progress

    @property
    def _database(self) -> Path:
        """The file of features and matches."""
        return self.work / "database.db"

    @property
    def _links(self) -> list[str]:
        """Names without spaces, which divide those in COLMAP's lists of pairs."""
        return [f"{index:06d}{Path(name).suffix}" for index, name in enumerate(self.names)]

    def prepare(self) -> None:
        """Makes the folder, unless what an interrupted call has found of the same photographs is in it."""
        stats = [(self.images / name).stat() for name in self.names]
        known = {
            "features": [COMPARED_FEATURES, COMPARED_PIXELS, DOUBLED_PIXELS, LENS_MODEL],
            "photographs": [
                [name, stat.st_size, stat.st_mtime_ns] for name, stat in zip(self.names, stats, strict=True)
            ],
        }
        listed = self.work / "photographs.json"
        if listed.is_file() and self._database.is_file() and listed.read_text() == json.dumps(known):
            _log.warning("%s: goes on from %s", self.work, self.found())
            return
        shutil.rmtree(self.work, ignore_errors=True)
        (self.work / "images").mkdir(parents=True)
        for link, name in zip(self._links, self.names, strict=True):
            (self.work / "images" / link).symlink_to((self.images / name).resolve())
        listed.write_text(json.dumps(known))

    def found(self) -> str:
        """What is in the folder, in words."""
        if not self._database.is_file():
            return "nothing yet"
        with self.pycolmap.Database.open(self._database) as database:
            features, pairs = database.num_images(), database.num_matched_image_pairs()
        return f"features of {features:,} of {len(self.names):,} photographs, {pairs:,} compared pairs"

    def extract(self) -> None:
        """Finds features. Photographs of one size are taken for those of one lens."""
        extraction = self.pycolmap.FeatureExtractionOptions(max_image_size=COMPARED_PIXELS)
        extraction.sift.max_num_features = COMPARED_FEATURES
        sizes = {image_size(self.images / name) for name in self.names}
        one_lens = len(sizes) == 1
        extraction.sift.first_octave = -1 if max(map(max, sizes)) <= DOUBLED_PIXELS else 0
        options = self.pycolmap.ImageReaderOptions(camera_model=LENS_MODEL)
        mode = self.pycolmap.CameraMode.SINGLE if one_lens else self.pycolmap.CameraMode.PER_IMAGE
        for start in range(0, len(self.names), _BATCH):
            self.report("finding features", start / len(self.names))
            if one_lens and start > 0:
                options.existing_camera_id = 1
            self._call(
                self.pycolmap.extract_features,
                self._database,
                self.work / "images",
                image_names=self._links[start : start + _BATCH],
                camera_mode=mode,
                reader_options=options,
                extraction_options=extraction,
            )
        self.report("finding features", 1.0)

    def match(self, ordered: bool) -> None:
        """Compares features of pairs; `compared_pairs` says of which."""
        pairs = compared_pairs(
            len(self.names), self._largest_features, ordered, lambda share: self.report("choosing pairs", share)
        )
        self.report("choosing pairs", 1.0)
        listed = self.work / "pairs.txt"
        for start in range(0, len(pairs), _PAIRS):
            self.report("comparing photographs", start / len(pairs))
            listed.write_text("".join(f"{self._links[i]} {self._links[j]}\n" for i, j in pairs[start : start + _PAIRS]))
            options = self.pycolmap.ImportedPairingOptions(match_list_path=listed)
            self._call(self.pycolmap.match_image_pairs, self._database, pairing_options=options)
        self.report("comparing photographs", 1.0)

    def _largest_features(self) -> list[FloatArray]:
        """Of each photograph, in the order of their names."""
        with self.pycolmap.Database.open(self._database) as database:
            number = {image.name: image.image_id for image in database.read_all_images()}
            return [
                largest_features(database.read_keypoints(number[link]), database.read_descriptors(number[link]).data)
                for link in self._links
            ]

    def place(self) -> list[Any]:
        """Finds poses: models of COLMAP that do not join, the one of most photographs first; there may be none."""
        finished, placed = 0, 0

        def first_pair() -> None:
            nonlocal finished, placed
            finished, placed = finished + placed * (placed >= SMALLEST_PIECE), 2
            tell()

        def next_image() -> None:
            nonlocal placed
            placed += 1
            tell()

        def tell() -> None:
            done = min(finished + placed, len(self.names))
            step = "all placed, adjusting" if done == len(self.names) else f"{done} of {len(self.names)} placed"
            self.report(f"finding poses, {step}", min(done / len(self.names), 0.99))

        self.report("finding poses", 0.0)
        options = self.pycolmap.IncrementalPipelineOptions(random_seed=0, min_model_size=SMALLEST_PIECE)
        found: dict[int, Any] = self._call(
            self.pycolmap.incremental_mapping,
            self._database,
            self.work / "images",
            self.work,
            options,
            initial_image_pair_callback=first_pair,
            next_image_callback=next_image,
        )
        self.report("finding poses", 1.0)
        name_of = dict(zip(self._links, self.names, strict=True))
        for model in found.values():
            for image in model.images.values():
                image.name = name_of[image.name]
        return sorted(found.values(), key=lambda model: -model.num_reg_images())

    def why_none(self) -> str:
        """What photographs without poses lack."""
        with self.pycolmap.Database.open(self._database) as database:
            features = database.num_keypoints() / len(self.names)
            pairs = sum(shared > 0 for shared in database.read_two_view_geometry_num_inliers()[1])
        if features < FEW_POINTS:
            return f"they show too little texture, {features:.0f} features each: more light, or something patterned"
        if pairs < len(self.names) - 1:
            return f"only {pairs} pairs show the same things: neighbours must overlap by two thirds, and be sharp"
        return "they must be taken from different places: walk around things, rather than turn on the spot"

    def _call(self, step: Callable[..., Any], *args: Any, **options: Any) -> Any:
        """Runs a step of COLMAP so that Ctrl C ends it soon, and what it has found by then stays."""
        token = self.pycolmap.CancellationToken()
        with ThreadPoolExecutor(1) as pool:
            running = pool.submit(step, *args, cancellation_token=token, **options)
            try:
                while not running.done():
                    wait([running], timeout=_WATCHED_S)
            except KeyboardInterrupt:
                token.cancel()
                raise
            return running.result()
