"""``lumisplat metrics``: compares images with references, or the light of captures."""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

import lumisplat as ls
from lumisplat.cli.options.command import Flag, LoadingCommand, own_options_first
from lumisplat.cli.output.comparisons import Figures, cells, digits, mean, plain
from lumisplat.cli.output.console import Report, print_columns, progress_bars

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    _Capture = ls.Gaussians | ls.Scene

_log = logging.getLogger("lumisplat")

_IMAGE_METRICS = {"psnr": "psnr", "ssim": "ssim", "ms-ssim": "ms_ssim", "flip": "flip"}
_USUAL = ("psnr", "ssim", "flip")
_SHADOW_METRICS = {"sae": "sae", "sm-iou": "sm_iou", "bf": "boundary_f"}
METRICS = (*_IMAGE_METRICS, *_SHADOW_METRICS)
"""Names that ``--metrics`` accepts."""
_LIGHT_METRICS = {"paa_y": "PAA-Y", "apf_y": "APF-Y", "ncm_ab": "NCM-ab"}


@own_options_first
@dataclass(frozen=True, kw_only=True)
class Metrics(LoadingCommand):
    """Compare images with references, or the light of captures.

    A log line says which metrics cannot be computed, and why.
    Guide: docs/guide/metrics.md.
    """

    files: Positional[
        Annotated[tuple[Path, ...], arg(metavar="IMAGE REFERENCE | AVATAR --scene SCENE", help_behavior_hint="")]
    ] = ()
    """Compare two images, or two folders of images; with --scene, give an avatar's capture."""
    metrics: Annotated[str | None, arg(metavar="NAMES", help_behavior_hint="(default: psnr,ssim,flip)")] = None
    """Choose psnr, ssim, ms-ssim, flip; for shadow images sae (strength), sm-iou (area), bf (outline)."""
    scene: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """Compare the light on the avatar with this capture around it."""
    before: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """With --scene: read the avatar as it was before relighting, and print the improvement."""
    radius: Annotated[float | None, arg(metavar="METRES", help_behavior_hint="(default: 1.5)")] = None
    """With --scene: use scene Gaussians within this distance of the avatar's centre."""
    json: Flag = False
    """Print JSON instead of a table."""

    def run(self) -> None:
        """Compares the images or the light of the captures, and prints the metrics."""
        if self.scene is not None:
            self._compare_light(self.scene)
            return
        about_light = {"--before": self.before, "--radius": self.radius, "--drop-invalid": self.drop_invalid or None}
        for option, value in about_light.items():
            if value is not None:
                raise ls.ConfigError(f"{option} needs --scene, the scene around the avatar")
        if len(self.files) != 2:
            raise ls.ConfigError(
                f"{_counted(self.files)}, expected an image and its reference, or an avatar and --scene"
            )
        self._compare_images(*self.files)

    def _compare_images(self, image: Path, reference: Path) -> None:
        """Prints the metrics of an image, or of each image of a folder, against its reference, and their means."""
        names = _wanted(self.metrics)
        pairs = image_pairs(image, reference)
        with progress_bars() as report:
            figures, problems = _compared(pairs, names, report)
        for problem in problems:
            _log.warning("%s", problem)
        means = {name: mean([row[name] for row in figures]) for name in names}
        if self.json:
            images = [{"name": pair.name, **plain(row)} for pair, row in zip(pairs, figures, strict=True)]
            print(json.dumps({"images": images, "mean": plain(means), "problems": problems}, indent=2))
            return
        rows = [[pair.name, *cells(row)] for pair, row in zip(pairs, figures, strict=True)]
        print_columns(["", *names], rows if len(rows) == 1 else [*rows, ["mean", *cells(means)]])

    def _compare_light(self, scene: Path) -> None:
        """Prints the light metrics of an avatar; with ``--before``, of both avatars, and the improvement."""
        if self.metrics is not None:
            raise ls.ConfigError("--metrics selects image metrics: with --scene, all three light metrics are computed")
        if len(self.files) != 1:
            raise ls.ConfigError(f"{_counted(self.files)}, expected one avatar to compare with --scene")
        paths = [path for path in (self.before, self.files[0]) if path is not None]
        with progress_bars() as report:
            captured_scene = self._capture(scene, report)
            avatars = [self._capture(path, report) for path in paths]
            figures: list[Figures] = []
            for index, avatar in enumerate(avatars):
                report("comparing light", index / len(avatars))
                figures.append(self._light_figures(avatar, captured_scene))
            report("comparing light", 1.0)
        if len(figures) == 2:
            _print_gain(*figures, as_json=self.json)
        elif self.json:
            print(json.dumps(plain(figures[0]), indent=2))
        else:
            rows = [[label, digits(name, figures[0][name])] for name, label in _LIGHT_METRICS.items()]
            print_columns(["", paths[0].name], rows)

    def _capture(self, path: Path, report: Report) -> _Capture:
        """Loads a capture, or a scene that contains captures.

        Raises:
            FormatError: The file has no Gaussians.
        """
        asset = self.load_asset(path, report)
        if isinstance(asset, ls.Mesh) or (isinstance(asset, ls.Scene) and not asset.splats):
            raise ls.FormatError(path, "has no Gaussians: metrics of light compare captures")
        return asset

    def _light_figures(self, avatar: _Capture, scene: _Capture) -> Figures:
        """Returns how well the light on an avatar matches the scene around it, as metric values by name."""
        points = ls.metrics.LitPoints.of(avatar)
        options = {} if self.radius is None else {"radius": self.radius}
        return {name: _metric(name)(points, scene, **options) for name in _LIGHT_METRICS}


def _print_gain(before: Figures, after: Figures, *, as_json: bool) -> None:
    """Prints the light metrics of an avatar before and after relighting, and by how much they decreased (improved)."""
    table = {
        name: {"original": before[name], "relit": after[name], "delta": before[name] - after[name]}
        for name in _LIGHT_METRICS
    }
    if as_json:
        print(json.dumps(table, indent=2))
        return
    rows = [[_LIGHT_METRICS[name], *(digits(name, value) for value in row.values())] for name, row in table.items()]
    print_columns(["", "original", "relit", "delta"], rows)


def _wanted(names: str | None) -> list[str]:
    """Returns the metrics named in a comma-separated list; None selects the default image metrics."""
    chosen = [*_USUAL] if names is None else [name.strip() for name in names.split(",") if name.strip()]
    for name in chosen or [names]:
        if name not in METRICS:
            raise ls.ConfigError(f"--metrics has '{name}', expected some of {', '.join(METRICS)}")
    return list(dict.fromkeys(chosen))


def _compared(pairs: Sequence[Pair], names: Sequence[str], report: Report) -> tuple[list[Figures], list[str]]:
    """Returns the metrics of each image pair (NaN if one fails), and the texts of the different errors.

    Raises:
        LumisplatError: No metric of any pair could be computed.
    """
    rows: list[Figures] = []
    problems: dict[str, ls.LumisplatError] = {}
    for index, pair in enumerate(pairs):
        report("comparing", index / len(pairs))
        row = dict.fromkeys(names, math.nan)
        for name in names:
            try:
                row[name] = _figure(name, pair)
            except ls.errors.MissingExtraError as error:
                problems.setdefault(f"no {name}: {error}", error)
            except ls.SceneError as error:
                problems.setdefault(str(error), error)
        rows.append(row)
    report("comparing", 1.0)
    if problems and all(math.isnan(value) for row in rows for value in row.values()):
        raise next(iter(problems.values()))
    return rows, [*problems]


def _figure(name: str, pair: Pair) -> float:
    """Returns the value of the metric ``name`` for an image and its reference."""
    load = _loaded_image if name in _IMAGE_METRICS else _shadow_strength
    image, reference = load(pair.image), load(pair.reference)
    try:
        return _metric((_IMAGE_METRICS | _SHADOW_METRICS)[name])(image, reference)
    except ls.SceneError as error:
        raise ls.FormatError(pair.image, f"cannot be compared with {pair.reference}: {error}") from None


@lru_cache(maxsize=2)
def _loaded_image(path: Path) -> npt.NDArray[np.float32]:
    """Loads an image in display colours. The last two images are cached, as each metric of a pair loads both."""
    return ls.load_image(path)


def _metric(name: str) -> Callable[..., float]:
    """Returns the function of `lumisplat.metrics` for a metric name such as ``ms-ssim``."""
    return getattr(ls.metrics, name)


@lru_cache(maxsize=2)
def _shadow_strength(path: Path) -> npt.NDArray[np.float32]:
    """Loads an image for shadow metrics: the mean over its colour channels, shape (H, W).

    Values are linear for .exr and .hdr files, display colours for all others.
    """
    linear = path.suffix.lower() in (".exr", ".hdr")
    return (ls.io.load_radiance(path) if linear else ls.load_image(path)).mean(axis=2)


def _counted(files: Sequence[Path]) -> str:
    """Returns the number of files as text for an error message, such as ``3 files``."""
    return "no file given" if not files else f"{len(files)} file{'s' * (len(files) > 1)} given"


_EXTENSIONS = (".png", ".jpg", ".jpeg", ".webp", ".exr", ".hdr")


@dataclass(frozen=True)
class Pair:
    """Paths of an image and of the reference that it is compared with."""

    name: str
    image: Path
    reference: Path


def image_pairs(image: Path, reference: Path) -> list[Pair]:
    """Pairs an image with a reference, or the images of two folders, sorted by name.

    Images of folders are paired by name without extension, so that a PNG may have an EXR as reference. Images without a
    partner are left out and logged.

    Raises:
        FormatError: A path is missing, only one is a folder, a folder has no images or two of the same name, or no
            image has a partner.
    """
    for path in (image, reference):
        if not path.exists():
            raise ls.FormatError(path, "no such file or folder")
    if image.is_dir() != reference.is_dir():
        folder, file = (image, reference) if image.is_dir() else (reference, image)
        raise ls.FormatError(folder, f"is a folder and {file} is not: compare two files, or two folders")
    if not image.is_dir():
        return [Pair(image.stem, image, reference)]
    ours, theirs = _images(image), _images(reference)
    both = sorted({*ours} & {*theirs})
    for folder, missing in ((reference, sorted({*ours} - {*theirs})), (image, sorted({*theirs} - {*ours}))):
        if missing:
            count = f" ({len(missing)} images of the other folder are missing)" if len(missing) > 1 else ""
            problem = ls.FormatError(folder, f"lacks an image '{missing[0]}', which the other folder has{count}")
            if not both:
                raise problem
            _log.warning("%s: left out", problem)
    return [Pair(name, ours[name], theirs[name]) for name in both]


def _images(folder: Path) -> dict[str, Path]:
    """Returns the paths of the images in a folder, by file name without extension."""
    found: dict[str, Path] = {}
    for path in sorted(folder.iterdir()):
        if path.suffix.lower() in _EXTENSIONS and not path.name.startswith("."):
            if path.stem in found:
                raise ls.FormatError(path, f"has the same name as {found[path.stem].name}: remove one of them")
            found[path.stem] = path
    if not found:
        raise ls.FormatError(folder, f"holds no images ({', '.join(_EXTENSIONS)})")
    return found
