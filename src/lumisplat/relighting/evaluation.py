"""Evaluates estimated materials and light against ground truth: ``lumisplat.inverse.evaluate_materials``."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple, NoReturn, cast

import numpy as np
import numpy.typing as npt

from lumisplat.config import Pipeline, RenderConfig, Shadows
from lumisplat.config.checks import check_kind
from lumisplat.constants import SH_C0
from lumisplat.errors import FormatError, MissingExtraError, MissingFileError, SceneError
from lumisplat.frame.frame import Frame
from lumisplat.frame.frame_data import unpremultiplied
from lumisplat.io.files.source import PathLike
from lumisplat.io.images.exr import read_exr
from lumisplat.io.images.radiance import read_display_image, read_radiance
from lumisplat.io.scene_toml.scene_file import read_scene_file
from lumisplat.io.training_images.loading import TrainingImage, load_training_images
from lumisplat.math.arrays import Doubles, Flags, FloatArray, float_array
from lumisplat.math.color import decode_srgb, encode_srgb
from lumisplat.metrics.images import flip, psnr, ssim
from lumisplat.metrics.materials import Channels, channel_scale, environment_psnr, normal_errors
from lumisplat.progress import Progress, no_progress
from lumisplat.renderer.renderer import Renderer, create_renderer
from lumisplat.renderer.scene.instance_tables import footprint_of
from lumisplat.scene.camera import Camera
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.lights import Light, LightEnvironment
from lumisplat.scene.materials import MaterialPbr
from lumisplat.scene.scene import Scene, SplatInstance

INSIDE = 0.5
"""A pixel is compared with ground truth if the object covers at least this fraction of the pixel."""

LAYERS = {"albedo": "RGB", "normal": "XYZ", "roughness": "Y"}
"""EXR channels of each material layer that has ground truth, by the layer's name."""
LIGHTS = {".exr", ".toml"}
"""File extensions of lights in a data set: ``.exr`` is an environment image, ``.toml`` a scene file with local lights.
"""
_MAKER = "tools/make_relightable_set.py makes complete data sets"


@dataclass(frozen=True, slots=True)
class RelightableSet:
    """Folder of a data set with ground-truth materials and relit images. Files are read on demand."""

    folder: Path
    views: tuple[TrainingImage, ...]
    """Held-out images, which no training used, with their cameras; alpha is blended over black."""
    layers: tuple[str, ...]
    """Names of the material layers (keys of `LAYERS`) for which the folder has ground-truth images."""
    unseen: tuple[str, ...]
    """Names of the lights in the subfolder ``relit``. No training image was made under these lights."""
    specular: float
    """Strength of the true surfaces' specular highlights, as `MaterialPbr.specular`; 0: Lambertian."""

    @classmethod
    def open(cls, folder: PathLike) -> RelightableSet:
        """Finds the images, layers and lights of a folder.

        Raises:
            FormatError: The folder lists no held-out images, or has neither layers nor relit images.
            MissingFileError: There is no such folder.
        """
        root = Path(folder)
        if root.is_dir() and not (root / "transforms_test.json").is_file():
            raise FormatError(root, f"has no transforms_test.json with the cameras of the ground truth; {_MAKER}")
        views = load_training_images(root).held_out
        layers = tuple(name for name in LAYERS if (root / "truth" / name).is_dir())
        unseen = tuple(sorted({path.stem for path in (root / "relit").glob("*") if path.suffix in LIGHTS}))
        if not layers and not unseen:
            raise FormatError(
                root, f"has neither truth/albedo, truth/normal and the like nor relit/*.exr or *.toml; {_MAKER}"
            )
        return cls(root, views, layers, unseen, _specular(root / "set.json"))

    def region(self, view: TrainingImage) -> Flags:
        """Returns a mask, (H, W), of the pixels whose alpha and mask are at least 0.5; all True if a view has neither.

        Raises:
            FormatError: The mask is empty.
        """
        shares = [share for share in (view.alpha(), view.mask()) if share is not None]
        inside = np.ones((view.camera.height, view.camera.width), np.bool_)
        for share in shares:
            inside &= share >= INSIDE
        if not inside.any():
            raise FormatError(view.path, "shows no object: alpha is below 0.5 in every pixel")
        return inside

    def layer(self, name: str, view: TrainingImage) -> FloatArray:
        """Reads the ground-truth layer ``name`` of a view, C channels, shape (H, W, C).

        Raises:
            FormatError: The file is missing, damaged, of another size, or not finite.
        """
        path = self.folder / "truth" / name / f"{view.name}.exr"
        stored, channels = read_exr(_existing(path)), LAYERS[name]
        missing = [channel for channel in channels if channel not in stored]
        if missing:
            raise FormatError(path, f"has no channel {missing[0]}, expected {', '.join(channels)} and A")
        values = np.stack([stored[channel] for channel in channels], axis=-1).astype(np.float32)
        _check_size(path, values, view)
        if not np.isfinite(values).all():
            raise FormatError(path, "has values that are not finite")
        return values

    def relit(self, name: str, view: TrainingImage) -> FloatArray:
        """Reads the ground-truth image of a view under an unseen light, display colours over black, shape (H, W, 3).

        Raises:
            FormatError: The file is missing, damaged, or of another size.
        """
        path = self.folder / "relit" / name / f"{view.name}.png"
        image = read_display_image(_existing(path))
        _check_size(path, image, view)
        return image

    @property
    def has_lights(self) -> bool:
        """True if an unseen light is a scene file with local lights rather than an environment image."""
        return any((self.folder / "relit" / f"{name}.toml").is_file() for name in self.unseen)

    def lights(self, name: str) -> tuple[Light, ...]:
        """Reads the lights of the unseen light ``name``.

        Raises:
            FormatError: The file is missing or damaged, or holds something other than lights.
        """
        file = self.folder / "relit" / f"{name}.toml"
        if not file.is_file():
            return (LightEnvironment(read_radiance(_existing(file.with_suffix(".exr"))), visible=False),)
        return read_scene_file(file, _refuse).lights

    def environment(self) -> FloatArray | None:
        """Reads the true environment of the training images, linear, (H, W, 3); None if local lights lit the images.

        Raises:
            FormatError: The file is missing or damaged.
        """
        path = self.folder / "environment.exr"
        if not path.exists() and (self.folder / "lamps.toml").exists():
            return None
        return read_radiance(_existing(path))


def _refuse(path: PathLike) -> NoReturn:
    """Raises an error: a scene file that may contain only lights refers to the file ``path``."""
    raise FormatError(path, "is named in a light file of a data set, expected only [[lights]] and [environment]")


def _existing(path: Path) -> Path:
    if not path.is_file():
        raise MissingFileError(path, "no such file: the data set is incomplete")
    return path


def _check_size(path: Path, values: FloatArray, view: TrainingImage) -> None:
    height, width = values.shape[:2]
    if (width, height) != (view.camera.width, view.camera.height):
        wanted = f"{view.camera.width} x {view.camera.height} of {view.path}"
        raise FormatError(path, f"has {width} x {height} pixels, expected the {wanted}")


def _specular(path: Path) -> float:
    """Reads the strength of specular highlights from ``set.json``; 1 without the file."""
    if not path.exists():
        return 1.0
    try:
        stored = cast("object", json.loads(path.read_bytes()))
    except (OSError, ValueError) as error:
        raise FormatError(path, f"cannot be read as JSON: {error}") from None
    specular = cast("dict[str, object]", stored).get("specular", 1.0) if isinstance(stored, dict) else None
    if not isinstance(specular, (int, float)) or not 0.0 <= specular <= 1.0:
        raise FormatError(path, f"has specular {specular!r}, expected a number in 0..1")
    return float(specular)


RELIT_SAMPLES = 64
"""Default samples per pixel of relit images; docs/guide/materials.md#noise states how much noise they leave."""


def evaluate_materials(
    gaussians: Gaussians,
    folder: PathLike,
    *,
    environment: npt.ArrayLike | None = None,
    config: RenderConfig | None = None,
    samples: int | None = None,
    denoise: bool = False,
    device: str = "auto",
    progress: Progress | None = None,
) -> MaterialEvaluation:
    """Compares a capture's materials, normals and appearance under new light with ground truth.

    Pixels are compared if the object covers at least half of the pixel. The capture is rendered from the cameras of the
    held-out images. Its albedo is scaled by one factor per channel, the median ratio to the ground truth over all
    views. The scaled albedo is relit under light in which no training image was made. The metrics are defined in the
    guide (docs/guide/materials.md#figures).

    Args:
        gaussians: The capture with its estimates: any of ``albedo``, ``normals`` and ``roughness``. Without an albedo,
            its captured colours are used, decoded and without view dependence.
        folder: A data set made by tools/make_relightable_set.py or make_relightable_room.py.
        environment: Estimated environment of the training images, linear radiance, shape (H, W, 3), with the axes of
            `LightEnvironment`; None: it was not estimated.
        config: Settings of the relit renders. None: ``Pipeline.HYBRID``, which has shadows and no bounces; if local
            lights light a room, ``Pipeline.PATH``, which has shadows and bounces. Frames have no background. If the
            pipeline rasterises or rays have a footprint, samples go through pixel centres, as in training; only rays
            without a footprint, as for antialiased captures, are jittered.
        samples: Samples per pixel of relit images. None: the number in ``config``, or 64 if ``config`` sets none, so
            that noise is a small part of the error (docs/guide/materials.md#noise).
        denoise: True denoises relit images, as `Frame.denoised` does.
        device: ``"cpu"``, ``"cuda:0"``, ... or ``"auto"``.
        progress: Called with a label of the stage and the fraction done, 0..1.

    Raises:
        ConfigError: ``config`` is of another type.
        DeviceError: There is no such device.
        FormatError: The folder is no such data set, or one of its files is missing or damaged; the message names it.
        MissingExtraError: ``denoise`` is set, and the denoiser is not installed.
        SceneError: ``gaussians`` or ``environment`` are of another type.
    """
    if config is not None:
        check_kind("config", config, RenderConfig)
    if not isinstance(gaussians, Gaussians):  # pyright: ignore[reportUnnecessaryIsInstance]
        raise SceneError(f"gaussians is {type(gaussians).__name__}, expected Gaussians")
    if denoise:
        Frame.check_denoiser()
    found_environment = None if environment is None else _panorama(environment)
    truth, report = RelightableSet.open(folder), progress or no_progress
    given = with_albedo(gaussians)
    compared = list(_compared_views(truth, given, device, report))
    scale = albedo_scale(compared)
    default = RenderConfig(pipeline=Pipeline.PATH if truth.has_lights else Pipeline.HYBRID)
    renderer = create_renderer(relighting_config(config or default, samples, gaussians, denoise=denoise), device)
    relit = _relit(truth, given, scale, renderer, report, denoise=denoise)
    compared = [replace(view, relit=pictures) for view, pictures in zip(compared, relit, strict=True)]
    views, problems = zip(*(measured(view, scale) for view in compared), strict=True)
    light_psnr, environment_remarks = _environment_figure(found_environment, truth)
    normal_mean, normal_median = normal_figures(compared)
    return MaterialEvaluation(
        albedo_scale=scale,
        albedo_psnr=_mean([view.albedo_psnr for view in views]),
        albedo_psnr_unscaled=_mean([view.albedo_psnr_unscaled for view in views]),
        albedo_psnr_linear=_mean([view.albedo_psnr_linear for view in views]),
        normal_mean=normal_mean,
        normal_median=normal_median,
        roughness_rmse=roughness_rmse(compared),
        environment_psnr=light_psnr,
        relit={
            name: RelitFigures(*map(_mean, zip(*(view.relit[name] for view in views), strict=True)))
            for name in truth.unseen
        },
        views=tuple(views),
        remarks=(
            *_remarks(gaussians, truth),
            *environment_remarks,
            *dict.fromkeys(remark for lines in problems for remark in lines),
        ),
    )


def relighting_config(
    settings: RenderConfig, samples: int | None, gaussians: Gaussians, *, denoise: bool
) -> RenderConfig:
    """Returns the settings of relit images: ``settings`` with samples, with an albedo if ``denoise``, no background."""
    if denoise:
        settings = replace(settings, aovs=(*settings.aovs, "albedo"))
    if samples is None and settings.time_limit is None and settings.noise is None:
        samples = settings.samples or RELIT_SAMPLES
    # Rasterisation, and rays with an antialiasing footprint, render Gaussians as trained only at pixel centres.
    pipeline = settings.pipeline
    wide = not pipeline.is_sequence and (pipeline.rasterises or footprint_of(gaussians, settings) > 0.0)
    return replace(settings, background=None, samples=samples, jitter=settings.jitter and not wide)


def _panorama(environment: npt.ArrayLike) -> FloatArray:
    """Checks the user's estimated environment image, and returns it as an array."""
    image = float_array("environment", environment)
    if image.ndim != 3 or image.shape[2] != 3 or image.size == 0:
        raise SceneError(f"environment has shape {image.shape}, expected (H, W, 3)")
    if (image < 0.0).any():
        raise SceneError("environment has negative values")
    return image


def _environment_figure(found: FloatArray | None, truth: RelightableSet) -> tuple[float, list[str]]:
    """Returns the PSNR of the estimated environment ``found``, dB, and remarks; NaN if no comparison is possible.

    The remarks give the reasons.
    """
    if found is None:
        return math.nan, []
    true = truth.environment()
    if true is None:
        return math.nan, [f"the estimated environment is not compared: local lights lit the images of {truth.folder}"]
    return environment_psnr(found, true), []


def _compared_views(
    truth: RelightableSet, gaussians: Gaussians, device: str, report: Progress
) -> Iterator[ComparedView]:
    """Yields each held-out view with its rendered and true layers, less those that capture or data set lack."""
    layers = LayerRenderer.of(gaussians, device)
    for number, view in enumerate(truth.views):
        report("comparing layers", number / len(truth.views))
        region, found = truth.region(view), layers.draw(view.camera)
        pairs = {name: (found[name], truth.layer(name, view)) for name in truth.layers if name in found}
        yield ComparedView(view.name, region, pairs, {})
    report("comparing layers", 1.0)


def _relit(
    truth: RelightableSet, gaussians: Gaussians, scale: Channels, renderer: Renderer, report: Progress, *, denoise: bool
) -> list[dict[str, Pair]]:
    """Renders the capture under each unseen light; returns per view the (render, ground truth) pairs by light name."""
    pictures: list[dict[str, Pair]] = [{} for _ in truth.views]
    for number, name in enumerate(truth.unseen):
        scene = relit_scene(gaussians, truth.lights(name), scale, truth.specular)
        for index, view in enumerate(truth.views):
            report("relighting", (number + index / len(truth.views)) / len(truth.unseen))
            wanted = truth.relit(name, view)
            pictures[index][name] = over_black(renderer, scene, view.camera, denoise=denoise), wanted
    report("relighting", 1.0)
    return pictures


def _remarks(gaussians: Gaussians, truth: RelightableSet) -> Iterator[str]:
    """Yields a sentence for each layer that is not compared, because the data set or the capture lacks it."""
    for name in ("albedo", "normal", "roughness"):
        if name not in truth.layers:
            yield f"no ground truth for {name}: {truth.folder / 'truth' / name} is missing"
    if not truth.unseen:
        yield f"nothing is relit: {truth.folder / 'relit'} has neither an .exr nor a .toml"
    if gaussians.albedo is None:
        yield "the capture has no albedo: its decoded captured colours are used instead"
    if gaussians.normals is None:
        yield "the capture has no normals: the shortest axes of its Gaussians are compared"
    if gaussians.roughness is None and truth.specular > 0.0:
        yield "the capture has no roughness: it is relit with 0.5"


def _mean(values: Sequence[float]) -> float:
    """Returns the mean of the values that are not NaN; NaN if all are."""
    existing = [value for value in values if not math.isnan(value)]
    return sum(existing) / len(existing) if existing else math.nan


class RelitFigures(NamedTuple):
    """Image metrics of renders under one unseen light against ground truth, over the pixels of the object."""

    psnr: float
    """Peak signal-to-noise ratio of display values over the object, dB."""
    ssim: float
    """Structural similarity, at most 1; NaN if images are too small or scikit-image is not installed."""
    flip: float
    """LDR-FLIP error, 0..1, lower is better; NaN if flip-evaluator is not installed."""


@dataclass(frozen=True, slots=True, eq=False)
class MaterialView:
    """Metrics and images of one held-out view.

    A metric is NaN if the capture or the ground truth lacks the layer that the metric compares, such as roughness.
    """

    name: str
    coverage: float
    """Fraction, 0..1, of the image's pixels that are compared: the object covers at least half of each of these
    pixels."""
    albedo_psnr: float
    """PSNR, dB, of the sRGB-encoded albedo after each channel is multiplied by `MaterialEvaluation.albedo_scale`."""
    albedo_psnr_unscaled: float
    """PSNR, dB, of the sRGB-encoded albedo as estimated, without the scale to ground truth."""
    albedo_psnr_linear: float
    """PSNR, dB, of the linear albedo after each channel is multiplied by `MaterialEvaluation.albedo_scale`."""
    normal_mean: float
    """Mean angle between estimated and true normals over the view's compared pixels, degrees."""
    normal_median: float
    """Median angle between estimated and true normals over the view's compared pixels, degrees."""
    roughness_rmse: float
    """Root mean square error of perceptual roughness over the view's compared pixels, 0..1."""
    relit: Mapping[str, RelitFigures]
    """Image metrics of this view under each unseen light, by the light's name."""
    region: Flags
    """Mask, shape (H, W), of the pixels that are compared: the object covers at least half of each of these pixels."""
    pictures: Mapping[str, tuple[FloatArray, FloatArray]]
    """(Estimate, ground truth) as display images, shape (H, W, 3) each. The keys are ``albedo``, ``normal``,
    ``roughness``, and ``relit/NAME`` for each unseen light."""


@dataclass(frozen=True, slots=True, eq=False)
class MaterialEvaluation:
    """Metrics of estimated materials and light against ground truth, as `evaluate_materials` computes them.

    A metric is NaN if the data set has no ground truth for it, or the capture no estimate; ``remarks`` lists the
    reasons. PSNR, SSIM and FLIP are means over the views; other metrics are over the pixels of all views.
    """

    albedo_scale: tuple[float, float, float]
    """Factor by which each channel of the estimated albedo is multiplied to fit the ground truth; 1 without ground
    truth."""
    albedo_psnr: float
    """PSNR of the sRGB-encoded albedo after scaling by ``albedo_scale``, dB."""
    albedo_psnr_unscaled: float
    """PSNR, dB, of the sRGB-encoded albedo as estimated, without ``albedo_scale``."""
    albedo_psnr_linear: float
    """PSNR of the linear albedo after scaling by ``albedo_scale``, dB."""
    normal_mean: float
    """Mean angle between estimated and true normals over the compared pixels of all views, degrees."""
    normal_median: float
    """Median angle between estimated and true normals over the compared pixels of all views, degrees."""
    roughness_rmse: float
    """Root mean square error of perceptual roughness over the compared pixels of all views, 0..1."""
    environment_psnr: float
    """PSNR, dB, of the estimated environment image after scaling by one factor per channel; NaN if it was not compared
    (docs/guide/materials.md#figures)."""
    relit: Mapping[str, RelitFigures]
    """Image metrics under each unseen light, by the light's name; the albedo is scaled by ``albedo_scale``."""
    views: tuple[MaterialView, ...]
    """Metrics of each held-out view, sorted by name."""
    remarks: tuple[str, ...]
    """Notes on layers without ground truth and on layers that the capture does not store, one sentence each."""

    def __repr__(self) -> str:
        relit = ", ".join(f"{name} {figures.psnr:.2f}" for name, figures in self.relit.items())
        return (
            f"MaterialEvaluation(views={len(self.views)}, albedo_psnr={self.albedo_psnr:.2f}, "
            f"normal_mean={self.normal_mean:.2f}, roughness_rmse={self.roughness_rmse:.4f}, relit_psnr={{{relit}}})"
        )


Pair = tuple[FloatArray, FloatArray]
"""An image of the estimate and the same image of the ground truth."""


@dataclass(frozen=True, slots=True)
class ComparedView:
    """One held-out view: its layers and relit images as pairs (estimate, ground truth), shape (H, W, C) each."""

    name: str
    region: Flags
    """Mask, shape (H, W), of the pixels that are compared: the object covers at least half of each of these pixels."""
    layers: Mapping[str, Pair]
    """(Estimate, ground truth) of each layer, such as ``albedo``, that both capture and data set have."""
    relit: Mapping[str, Pair]
    """(Render, ground truth) under each unseen light, display colours over black, by the light's name."""

    def counted(self, layer: str) -> tuple[Doubles, Doubles]:
        """Returns estimate and ground truth of a layer at N compared pixels, (N, C) each; without the layer, N is 0."""
        if layer not in self.layers:
            return np.zeros((0, 3)), np.zeros((0, 3))
        found, truth = self.layers[layer]
        return found[self.region].astype(np.float64), truth[self.region].astype(np.float64)


def albedo_scale(views: Sequence[ComparedView]) -> Channels:
    """Returns for each channel the median ratio of true to estimated albedo over all views; 1 without an albedo."""
    pairs = [view.counted("albedo") for view in views]
    found, truth = (np.concatenate([pair[side] for pair in pairs]) for side in (0, 1))
    return channel_scale(found, truth) if len(found) else (1.0, 1.0, 1.0)


def normal_figures(views: Sequence[ComparedView]) -> tuple[float, float]:
    """Returns mean and median angle between estimated and true normals over the pixels of all views, degrees."""
    errors = np.concatenate([normal_errors(*view.counted("normal")) for view in views])
    return (float(errors.mean()), float(np.median(errors))) if len(errors) else (math.nan, math.nan)


def roughness_rmse(views: Sequence[ComparedView]) -> float:
    """Returns the root mean square error of estimated roughness over the compared pixels of all views, 0..1."""
    pairs = [view.counted("roughness") for view in views]
    errors = np.concatenate([(found - truth)[:, 0] for found, truth in pairs])
    return float(np.sqrt(np.mean(errors**2))) if len(errors) else math.nan


def measured(view: ComparedView, scale: Channels) -> tuple[MaterialView, list[str]]:
    """Computes the metrics and images of a view; also returns a sentence for each metric that is missing.

    Args:
        view: The view, with relit images of the scaled albedo.
        scale: Factor of each channel of the estimated albedo.
    """
    problems: list[str] = []
    mean, median = normal_figures([view])
    result = MaterialView(
        name=view.name,
        coverage=float(view.region.mean()),
        albedo_psnr=_albedo_psnr(view, scale),
        albedo_psnr_unscaled=_albedo_psnr(view, (1.0, 1.0, 1.0)),
        albedo_psnr_linear=_albedo_psnr(view, scale, linear=True),
        normal_mean=mean,
        normal_median=median,
        roughness_rmse=roughness_rmse([view]),
        relit={name: _relit_figures(pair, view.region, problems) for name, pair in view.relit.items()},
        region=view.region,
        pictures=_display_images(view, scale),
    )
    return result, problems


def _albedo_psnr(view: ComparedView, scale: Channels, *, linear: bool = False) -> float:
    if "albedo" not in view.layers:
        return math.nan
    found, truth = _albedo_images(view, scale, linear=linear)
    return psnr(found, truth, region=view.region)


def _albedo_images(view: ComparedView, scale: Channels, *, linear: bool = False) -> Pair:
    found, truth = view.layers["albedo"]
    pair = np.clip(found * np.array(scale, np.float32), 0.0, 1.0), np.clip(truth, 0.0, 1.0)
    return pair if linear else (_displayed(pair[0]), _displayed(pair[1]))


def _displayed(linear: FloatArray) -> FloatArray:
    return np.clip(encode_srgb(linear), 0.0, 1.0).astype(np.float32)


def _relit_figures(pair: Pair, region: Flags, problems: list[str]) -> RelitFigures:
    figures: list[float] = []
    for name, metric in {"psnr": psnr, "ssim": ssim, "flip": flip}.items():
        try:
            figures.append(metric(*pair, region=region))
        except (MissingExtraError, SceneError) as error:
            figures.append(math.nan)
            problems.append(f"no {name}: {error}")
    return RelitFigures(*figures)


def _display_images(view: ComparedView, scale: Channels) -> dict[str, Pair]:
    """Returns the view's (estimate, truth) pairs as display images, black outside the compared pixels, by name."""
    images: dict[str, Pair] = {}
    if "albedo" in view.layers:
        images["albedo"] = _albedo_images(view, scale)
    if "normal" in view.layers:
        found, truth = view.layers["normal"]
        images["normal"] = 0.5 + 0.5 * found, 0.5 + 0.5 * truth
    if "roughness" in view.layers:
        found, truth = (np.repeat(values, 3, axis=2) for values in view.layers["roughness"])
        images["roughness"] = found, truth
    images |= {f"relit/{name}": pair for name, pair in view.relit.items()}
    inside = view.region[..., None].astype(np.float32)
    return {name: (np.clip(a, 0.0, 1.0) * inside, np.clip(b, 0.0, 1.0) * inside) for name, (a, b) in images.items()}


def with_albedo(gaussians: Gaussians) -> Gaussians:
    """Returns the Gaussians with an albedo; if they have none, it is their decoded mean captured colour."""
    if gaussians.albedo is not None:
        return gaussians
    captured = np.clip(0.5 + SH_C0 * gaussians.sh[:, 0], 0.0, 1.0)
    return replace(gaussians, albedo=decode_srgb(captured))


@dataclass(frozen=True, slots=True)
class LayerRenderer:
    """Renders images of a capture's albedo, normals and roughness, with the values that lit frames use."""

    renderer: Renderer
    unlit: Renderer
    lit_scene: Scene
    roughness_scene: Scene | None
    captured_scene: Scene

    @classmethod
    def of(cls, gaussians: Gaussians, device: str) -> LayerRenderer:
        """Creates a lit renderer for albedo and normals, and an unlit one for roughness; Gaussians need an albedo."""
        lit_config = RenderConfig(
            background=None, lighting=True, shadows=Shadows.OFF, samples=1, aovs=("albedo",), pipeline=Pipeline.RASTER
        )
        with_base_colors = None
        if gaussians.roughness is not None:
            # Roughness becomes a colour, so that it is blended without encoding.
            values = np.repeat((gaussians.roughness[:, None, None] - 0.5) / SH_C0, 3, axis=2)
            with_base_colors = Scene(splats=(SplatInstance(replace(gaussians, sh=values)),))
        return cls(
            create_renderer(lit_config, device),
            create_renderer(RenderConfig(background=None, lighting=False), device),
            Scene(splats=(SplatInstance(gaussians, material=MaterialPbr()),)),
            with_base_colors,
            Scene(splats=(gaussians,)),
        )

    def look(self, camera: Camera) -> Frame:
        """Renders the captured look, without a background."""
        return self.unlit.render(self.captured_scene, camera)

    def draw(self, camera: Camera) -> dict[str, FloatArray]:
        """Renders linear albedo (H, W, 3), unit normals (H, W, 3; 0 in the background) and roughness (H, W, 1).

        The roughness layer is missing if the Gaussians store no roughness.
        """
        frame = self.renderer.render(self.lit_scene, camera)
        assert frame.albedo is not None
        layers = {"albedo": unpremultiplied(frame.albedo, frame.alpha), "normal": frame.normal}
        if self.roughness_scene is not None:
            layers["roughness"] = self.unlit.render(self.roughness_scene, camera).straight()[..., :1]
        return layers


def relit_scene(gaussians: Gaussians, lights: tuple[Light, ...], scale: tuple[float, ...], specular: float) -> Scene:
    """Returns a scene of the capture under ``lights``, with its albedo multiplied by ``scale`` and clipped to 0..1.

    Args:
        gaussians: Gaussians with an albedo.
        lights: All lights of the scene.
        scale: Factor per channel of the albedo.
        specular: `MaterialPbr.specular` of the capture's material: strength of highlights, 0: Lambertian.
    """
    assert gaussians.albedo is not None
    scaled = replace(gaussians, albedo=np.clip(gaussians.albedo * np.array(scale), 0.0, 1.0))
    return Scene(splats=(SplatInstance(scaled, material=MaterialPbr(specular=specular)),), lights=lights)


def over_black(renderer: Renderer, scene: Scene, camera: Camera, *, denoise: bool = False) -> FloatArray:
    """Renders sRGB colours times alpha, shape (H, W, 3): blended over black, like the images of the data set."""
    frame = renderer.render(scene, camera)
    pixels = (frame.denoised() if denoise else frame).pixels_srgb()
    return pixels[..., :3] * pixels[..., 3:]
