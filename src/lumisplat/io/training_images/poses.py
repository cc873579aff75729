"""Estimates camera poses of images with COLMAP (Schoenberger and Frahm 2016); needs the extra ``poses``.

Features, matches and models are stored in a work folder, so that an interrupted run continues. Log lines warn of images
without a pose and of signs that poses are wrong.
"""

from __future__ import annotations

import json
import logging
import math
import os
import shutil
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from lumisplat.errors import FormatError, MissingExtraError, MissingFileError
from lumisplat.io.files.source import PathLike
from lumisplat.io.images.texture import image_size
from lumisplat.io.training_images.listing import IMAGE_SUFFIXES, some_names
from lumisplat.math.arrays import FloatArray
from lumisplat.progress import Progress

COMPARED_FEATURES = 2048
"""Largest number of SIFT features per image.

docs/adr/0056-video-poses-with-few-features-and-one-lens.md states what more features would cost.
"""

COMPARED_PIXELS = 1000
"""Longer side in pixels to which images are reduced for feature extraction; more would only take longer."""

DOUBLED_PIXELS = 800
"""Longer image side, in pixels, up to which an image is upsampled to twice its size for feature extraction.

Without upsampling such images have too few features. Larger images would take three times as long for as many features.
"""

LENS_MODEL = "RADIAL"
"""COLMAP camera model of the images: one focal length and two radial distortion terms.

Pixels are assumed to be square. With two focal lengths, a scene of little depth would not determine their ratio."""

NEXT_FRAMES = 10
"""Number of following frames that each video frame is matched with."""

ALL_PAIRS_UP_TO = 40
"""Number of unordered images up to which all pairs are matched."""

SIMILAR_IMAGES = 5
"""Each image is matched with this many images of similar content, besides its neighbours in a video."""

SIMILARITY_FEATURES = 128
"""Number of features of each image, the largest ones, that are matched to find similar images."""

SIMILARITY_MATCHES_MIN = 4
"""Fewest matching features that make two images similar; fewer occur by chance (Wu 2013, section 4)."""

LOWE_RATIO = 0.8
"""Ratio test: largest quotient of the angles to the nearest and second nearest descriptor (Lowe 2004, section 7.1)."""

MODEL_IMAGES_MIN = 3
"""Fewest images of a COLMAP model that counts. With two images, nothing distinguishes right poses from wrong ones."""

POINTS_PER_IMAGE_MIN = 50
"""Mean number of points per image below which poses are likely wrong. COLMAP itself requires 30 in each image."""

REPROJECTION_ERROR_MAX = 1.5
"""Mean reprojection error, pixels at `COMPARED_PIXELS`, above which poses are likely wrong.

Errors of 0.4 to 1 are usual, and COLMAP removes points with errors above 4."""

WITHOUT_POSE_MAX = 0.25
"""If COLMAP finds no pose for more than this fraction of the images, a log line advises to record the video again."""

USUAL_FOV_DEGREES = 15.0, 130.0
"""Smallest and largest usual field of view of phones and cameras along the longer image side, degrees."""

_log = logging.getLogger("lumisplat")

Pairs = list[tuple[int, int]]
"""Pairs of images to match, as indices with the smaller one first; sorted, without duplicates."""

_BATCH = 4
"""Number of images between two progress reports of feature extraction."""
_PAIR_BATCH = 32
"""Number of image pairs between two progress reports of matching."""
_INTERRUPT_POLL_S = 0.2
"""Seconds between two checks for Ctrl C while a COLMAP step runs."""

_WORK = "poses.unfinished"
"""Name of the folder with COLMAP's intermediate results, which is removed once poses are found."""


def compared_pairs(
    count: int, descriptors: Callable[[], Sequence[FloatArray]], ordered: bool, report: Callable[[float], None]
) -> Pairs:
    """Selects the image pairs whose features are matched.

    Up to `ALL_PAIRS_UP_TO` unordered images are matched with each other. More images are matched with the most similar
    ones. A video frame is matched with the next frames and with the most similar frames, which closes loops where the
    camera returns to an earlier position.

    Args:
        count: Number of images.
        descriptors: Returns the largest features of each image, as for `similar_pairs`; called only if needed.
        ordered: Whether the images are consecutive video frames.
        report: Called with the fraction done, 0..1.
    """
    if count <= (NEXT_FRAMES if ordered else ALL_PAIRS_UP_TO):
        return [(i, j) for i in range(count) for j in range(i + 1, count)]
    neighbors = NEXT_FRAMES if ordered else 0
    pairs = {(i, i + step) for step in range(1, neighbors + 1) for i in range(count - step)}
    return sorted(pairs.union(similar_pairs(descriptors(), neighbors, report)))


def similar_pairs(descriptors: Sequence[FloatArray], neighbors: int, report: Callable[[float], None]) -> Pairs:
    """Pairs each image with the `SIMILAR_IMAGES` others with which it shares most of its largest features.

    Large features are few, and are found again from other viewpoints. Images whose largest features do not match seldom
    match at all (Wu 2013, "Towards Linear-Time Incremental Structure from Motion", section 4, preemptive matching).

    Args:
        descriptors: For each image the descriptors of its largest features, unit vectors of length D, shape (at most
            `SIMILARITY_FEATURES`, D).
        neighbors: Images whose indices differ by at most this are not paired.
        report: Called with the fraction done, 0..1.
    """
    count = len(descriptors)
    shared = np.zeros((count, count), np.int64)
    for i in range(count):
        report(1.0 - (1.0 - i / count) ** 2)
        for j in range(i + neighbors + 1, count):
            shared[i, j] = shared[j, i] = _matching_features(descriptors[i], descriptors[j])
    pairs: set[tuple[int, int]] = set()
    for i in range(count):
        best = np.argsort(-shared[i], kind="stable")[:SIMILAR_IMAGES]
        pairs.update((min(i, int(j)), max(i, int(j))) for j in best if shared[i, j] >= SIMILARITY_MATCHES_MIN)
    return sorted(pairs)


def _matching_features(a: FloatArray, b: FloatArray) -> int:
    """Counts features of two images that are mutual nearest neighbours and pass the ratio test."""
    if min(len(a), len(b)) < 2:
        return 0
    cosines = a @ b.T
    rows = np.arange(len(a))
    nearest = cosines.argmax(axis=1)
    angle = np.arccos(np.minimum(cosines[rows, nearest], 1.0))
    mutual = cosines.argmax(axis=0)[nearest] == rows
    cosines[rows, nearest] = -1.0
    second = np.arccos(np.minimum(cosines.max(axis=1), 1.0))
    return int(np.count_nonzero(mutual & (angle < LOWE_RATIO * second)))


def largest_features(keypoints: FloatArray, descriptors: npt.NDArray[np.uint8]) -> FloatArray:
    """Returns unit-length descriptors of an image's largest features, shape (at most `SIMILARITY_FEATURES`, D).

    Args:
        keypoints: COLMAP keypoints of N features: x, y and an affine shape whose determinant is the squared size, shape
            (N, 6); or x, y, size and orientation, shape (N, 4).
        descriptors: Descriptors of the keypoints, D numbers each, shape (N, D).
    """
    if keypoints.shape[1] == 6:
        size = np.abs(keypoints[:, 2] * keypoints[:, 5] - keypoints[:, 3] * keypoints[:, 4])
    else:
        size = keypoints[:, 2]
    chosen = descriptors[np.argsort(-size, kind="stable")[:SIMILARITY_FEATURES]].astype(np.float32)
    return chosen / np.maximum(np.linalg.norm(chosen, axis=1, keepdims=True), 1e-12)


@dataclass(frozen=True, slots=True)
class ColmapRun:
    """A COLMAP reconstruction in progress. Each step reads the results of earlier steps from the work folder."""

    pycolmap: Any
    images: Path
    """Folder of the images whose poses are estimated."""
    names: Sequence[str]
    """File names of the images, sorted."""
    work: Path
    """Folder of COLMAP's database and intermediate results; created by `prepare`."""
    report: Progress

    @property
    def _database(self) -> Path:
        """COLMAP database file with features and matches."""
        return self.work / "database.db"

    @property
    def _links(self) -> list[str]:
        """Names of symbolic links to the images, such as ``000000.jpg``: COLMAP's pair lists allow no spaces."""
        return [f"{index:06d}{Path(name).suffix}" for index, name in enumerate(self.names)]

    def prepare(self) -> None:
        """Creates the work folder. A work folder of an interrupted run with equal images and settings is used again."""
        stats = [(self.images / name).stat() for name in self.names]
        known = {
            "features": [COMPARED_FEATURES, COMPARED_PIXELS, DOUBLED_PIXELS, LENS_MODEL],
            "photographs": [
                [name, stat.st_size, stat.st_mtime_ns] for name, stat in zip(self.names, stats, strict=True)
            ],
        }
        listed = self.work / "photographs.json"
        if listed.is_file() and self._database.is_file() and listed.read_text() == json.dumps(known):
            _log.warning("%s: continues from %s", self.work, self.summary())
            return
        shutil.rmtree(self.work, ignore_errors=True)
        (self.work / "images").mkdir(parents=True)
        for link, name in zip(self._links, self.names, strict=True):
            (self.work / "images" / link).symlink_to((self.images / name).resolve())
        listed.write_text(json.dumps(known))

    def summary(self) -> str:
        """Describes for a message how many features and matches the work folder holds."""
        if not self._database.is_file():
            return "nothing yet"
        with self.pycolmap.Database.open(self._database) as database:
            features, pairs = database.num_images(), database.num_matched_image_pairs()
        return f"features of {features:,} of {len(self.names):,} images, {pairs:,} matched pairs"

    def extract(self) -> None:
        """Extracts SIFT features. Images of one size are assumed to share one lens."""
        extraction = self.pycolmap.FeatureExtractionOptions(max_image_size=COMPARED_PIXELS)
        extraction.sift.max_num_features = COMPARED_FEATURES
        sizes = {image_size(self.images / name) for name in self.names}
        one_lens = len(sizes) == 1
        extraction.sift.first_octave = -1 if max(map(max, sizes)) <= DOUBLED_PIXELS else 0
        options = self.pycolmap.ImageReaderOptions(camera_model=LENS_MODEL)
        mode = self.pycolmap.CameraMode.SINGLE if one_lens else self.pycolmap.CameraMode.PER_IMAGE
        for start in range(0, len(self.names), _BATCH):
            self.report("extracting features", start / len(self.names))
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
        self.report("extracting features", 1.0)

    def match(self, ordered: bool) -> None:
        """Matches the features of image pairs, which `compared_pairs` selects.

        Args:
            ordered: Whether the images are consecutive video frames.
        """
        pairs = compared_pairs(
            len(self.names), self._largest_features, ordered, lambda share: self.report("selecting pairs", share)
        )
        self.report("selecting pairs", 1.0)
        listed = self.work / "pairs.txt"
        for start in range(0, len(pairs), _PAIR_BATCH):
            self.report("matching images", start / len(pairs))
            listed.write_text(
                "".join(f"{self._links[i]} {self._links[j]}\n" for i, j in pairs[start : start + _PAIR_BATCH])
            )
            options = self.pycolmap.ImportedPairingOptions(match_list_path=listed)
            self._call(self.pycolmap.match_image_pairs, self._database, pairing_options=options)
        self.report("matching images", 1.0)

    def _largest_features(self) -> list[FloatArray]:
        """Reads the largest features of each image from the database, in the order of the images."""
        with self.pycolmap.Database.open(self._database) as database:
            number = {image.name: image.image_id for image in database.read_all_images()}
            return [
                largest_features(database.read_keypoints(number[link]), database.read_descriptors(number[link]).data)
                for link in self._links
            ]

    def estimate_poses(self) -> list[Any]:
        """Runs incremental mapping. Returns disjoint COLMAP models, the largest first; empty if none was found."""
        finished, with_pose = 0, 0

        def first_pair() -> None:
            nonlocal finished, with_pose
            finished, with_pose = finished + with_pose * (with_pose >= MODEL_IMAGES_MIN), 2
            report_step()

        def next_image() -> None:
            nonlocal with_pose
            with_pose += 1
            report_step()

        def report_step() -> None:
            done = min(finished + with_pose, len(self.names))
            step = "bundle adjustment" if done == len(self.names) else f"{done} of {len(self.names)} images"
            self.report(f"finding poses, {step}", min(done / len(self.names), 0.99))

        self.report("finding poses", 0.0)
        options = self.pycolmap.IncrementalPipelineOptions(random_seed=0, min_model_size=MODEL_IMAGES_MIN)
        models: dict[int, Any] = self._call(
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
        for model in models.values():
            for image in model.images.values():
                image.name = name_of[image.name]
        return sorted(models.values(), key=lambda model: -model.num_reg_images())

    def failure_reason(self) -> str:
        """Describes for a message why no model was found: too few features, too few matching pairs, or no parallax."""
        with self.pycolmap.Database.open(self._database) as database:
            features = database.num_keypoints() / len(self.names)
            pairs = sum(shared > 0 for shared in database.read_two_view_geometry_num_inliers()[1])
        if features < POINTS_PER_IMAGE_MIN:
            return (
                f"they have too little texture, {features:.0f} features each: use more light, or add textured objects"
            )
        if pairs < len(self.names) - 1:
            return f"only {pairs} image pairs match: neighbouring images must be sharp and overlap by two thirds"
        return "there is no parallax: move around the objects instead of rotating in one place"

    def _call(self, step: Callable[..., Any], *args: Any, **options: Any) -> Any:
        """Runs a COLMAP step in a thread, so that Ctrl C cancels the step soon and keeps its results so far."""
        token = self.pycolmap.CancellationToken()
        with ThreadPoolExecutor(1) as pool:
            running = pool.submit(step, *args, cancellation_token=token, **options)
            try:
                while not running.done():
                    wait([running], timeout=_INTERRUPT_POLL_S)
            except KeyboardInterrupt:
                token.cancel()
                raise
            return running.result()


@dataclass(frozen=True, slots=True)
class PoseReport:
    """Numbers about a COLMAP reconstruction, by which `remarks` recognises wrong poses."""

    names: Sequence[str]
    """File names of all images, with and without a pose."""
    with_pose: Sequence[str]
    """File names of the images for which COLMAP found a pose, sorted."""
    model_sizes: Sequence[int]
    """Number of images in the chosen model, then of the further images that each other model adds.

    Models that add fewer than `MODEL_IMAGES_MIN` images are left out.
    """
    points: int
    points_per_image: float
    """Mean number of points that an image with a pose observes."""
    error: float
    """Mean reprojection error, in pixels of an image whose longer side has at most `COMPARED_PIXELS`."""
    fov_degrees: float
    """Field of view along the longer image side, degrees. With several cameras, it is the one farthest from the usual
    range, `USUAL_FOV_DEGREES`.
    """

    @classmethod
    def of(cls, names: Sequence[str], models: Sequence[Any]) -> PoseReport:
        """Computes the numbers of the report from a COLMAP reconstruction.

        Args:
            names: Names of all images.
            models: Disjoint COLMAP models, the chosen one first.
        """
        best = models[0]
        names_of = [{model.image(index).name for index in model.reg_image_ids()} for model in models]
        others = [len(other - names_of[0]) for other in names_of[1:]]
        cameras = best.cameras.values()
        views = [
            2.0 * math.degrees(math.atan2(0.5 * max(camera.width, camera.height), camera.mean_focal_length()))
            for camera in cameras
        ]
        shrink = min(COMPARED_PIXELS / max(max(camera.width, camera.height) for camera in cameras), 1.0)
        return cls(
            names=names,
            with_pose=sorted(names_of[0]),
            model_sizes=[len(names_of[0]), *(count for count in others if count >= MODEL_IMAGES_MIN)],
            points=best.num_points3D(),
            points_per_image=best.compute_mean_observations_per_reg_image(),
            error=best.compute_mean_reprojection_error() * shrink,
            fov_degrees=max(views, key=lambda view: abs(view - sum(USUAL_FOV_DEGREES) / 2.0)),
        )

    def remarks(self) -> list[str]:
        """Returns warnings for the user, one line each; empty if the poses look right."""
        low, high = USUAL_FOV_DEGREES
        remarks: list[str] = []
        if len(self.model_sizes) > 1:
            *others, last = map(str, self.model_sizes)
            remarks.append(
                f"the images form {len(self.model_sizes)} separate models, of {', '.join(others)} and {last} "
                "images: the largest is used"
            )
        if len(self.with_pose) < len(self.names):
            remarks.append(self._without_pose_text())
        if self.points_per_image < POINTS_PER_IMAGE_MIN:
            remarks.append(
                f"an image observes {self.points_per_image:.0f} of {self.points:,} points on average, "
                f"expected {POINTS_PER_IMAGE_MIN} or more: poses are likely wrong; "
                "the background needs texture, too"
            )
        if self.error > REPROJECTION_ERROR_MAX:
            remarks.append(
                f"the mean reprojection error is {self.error:.1f} pixels, expected below {REPROJECTION_ERROR_MAX:g}: "
                "poses are likely wrong; avoid moving objects, blur and zooming"
            )
        if not low <= self.fov_degrees <= high:
            remarks.append(
                f"the estimated field of view is {self.fov_degrees:.0f} degrees, expected {low:.0f} to {high:.0f}: "
                "poses are likely wrong; move around the objects instead of rotating in one place"
            )
        return remarks

    def _without_pose_text(self) -> str:
        without_pose = sorted({*self.names} - {*self.with_pose})
        line = f"no pose was found for {len(without_pose)} of {len(self.names)} images ({some_names(without_pose)})"
        if len(without_pose) > WITHOUT_POSE_MAX * len(self.names):
            line += ": move slower, avoid blur, record more texture, or extract more frames (extract-frames --every)"
        return line


def find_poses(folder: PathLike, *, ordered: bool = False, progress: Progress | None = None) -> Path:
    """Estimates camera poses of the images in a folder, and writes a COLMAP sparse model beside them.

    Images of one size are assumed to share one lens and focal length. Features are extracted at `COMPARED_PIXELS`, but
    poses and intrinsics are those of the full-size files; `load_training_images` can downscale them. Intermediate
    results are stored in the subfolder ``poses.unfinished`` until the poses are found: after an interruption the same
    call continues.

    Args:
        folder: Folder with the images in its ``images`` subfolder, or directly in it if it has no ``images``.
        ordered: Whether the images, sorted by name, are consecutive video frames. Each frame is then matched with the
            next ones and with similar ones. Otherwise similar images are matched, or all pairs if there are few images.
        progress: Called with the name of the current step and the fraction done, 0..1.

    Returns:
        Folder of the model, ``sparse/0``. Images without a pose are not in it. Log lines count these images, and warn
        of signs that poses are wrong: disjoint models, few points, large errors, an unusual field of view.

    Raises:
        FormatError: There are fewer than two images, an image cannot be read, a model already exists, or no poses were
            found. Images need overlap, texture and different camera positions.
        KeyboardInterrupt: The message says what the work folder holds so far.
        MissingFileError: There is no such folder.
        MissingExtraError: pycolmap is not installed.
    """
    folder = Path(folder)
    names = _image_names(folder)
    if (folder / "sparse").exists():
        raise FormatError(
            folder / "sparse", "already exists: load_training_images reads it; remove it to find poses again"
        )
    try:
        pycolmap: Any = import_module("pycolmap")
    except ImportError:
        raise MissingExtraError("find_poses", "poses") from None
    run = ColmapRun(pycolmap, _image_folder(folder), names, folder / _WORK, progress or (lambda _, share: None))
    with _colmap_errors(pycolmap, run, folder):
        run.prepare()
        run.extract()
        run.match(ordered)
        models = run.estimate_poses()
        if not models:
            raise FormatError(folder, f"no poses were found for its {len(names)} images: {run.failure_reason()}")
        model = run.work / "model"
        model.mkdir(exist_ok=True)
        models[0].write(model)
        (folder / "sparse").mkdir()
        os.replace(model, folder / "sparse" / "0")
        shutil.rmtree(run.work)
    for remark in PoseReport.of(names, models).remarks():
        _log.warning("%s: %s", folder, remark)
    return folder / "sparse" / "0"


def _image_folder(folder: Path) -> Path:
    return folder / "images" if (folder / "images").is_dir() else folder


def _image_names(folder: Path) -> Sequence[str]:
    """Lists the image files of a folder, sorted by name; raises `FormatError` if there are fewer than two."""
    if not folder.is_dir():
        raise MissingFileError(folder, "no such folder")
    images = _image_folder(folder)
    names = sorted(path.name for path in images.iterdir() if path.suffix.lower() in IMAGE_SUFFIXES and path.is_file())
    if len(names) < 2:
        count = "one image" if names else "no images"
        raise FormatError(images, f"has {count}, expected two or more ({', '.join(IMAGE_SUFFIXES)})")
    return names


@contextmanager
def _colmap_errors(pycolmap: Any, run: ColmapRun, folder: Path) -> Generator[None]:
    """Silences COLMAP's log, and converts its errors to `FormatError` after removing the work folder."""
    level = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = 3
    try:
        yield
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"{run.work} holds {run.summary()}; the same command continues") from None
    except FormatError:
        shutil.rmtree(run.work, ignore_errors=True)
        raise
    except OSError as error:
        raise FormatError(run.work, f"cannot be written: {error.strerror or error}") from None
    except (RuntimeError, ValueError) as error:
        shutil.rmtree(run.work, ignore_errors=True)
        raise FormatError(folder, f"COLMAP cannot find poses: {' '.join(str(error).split())[:200]}") from error
    finally:
        pycolmap.logging.minloglevel = level
