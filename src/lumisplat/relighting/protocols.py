"""Scores relightable captures by the rules of published benchmarks: ``lumisplat.inverse.evaluate_published``.

Whole images count, as in the evaluations of the authors, so that figures compare with published ones; those of
`evaluate_materials` count the object alone. docs/guide/published_sets.md lists the rules and where they differ.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.ndimage import minimum_filter

from lumisplat.config import PathConfig, PathPrimary, Pipeline, RenderConfig
from lumisplat.errors import FormatError, MissingExtraError, SceneError
from lumisplat.frame.frame import Frame
from lumisplat.io.files.source import PathLike
from lumisplat.io.images.radiance import LINEAR, read_radiance
from lumisplat.math.arrays import Doubles, Flags, FloatArray
from lumisplat.math.color import decode_srgb, encode_srgb
from lumisplat.math.resampling import area_mean
from lumisplat.metrics.images import ssim
from lumisplat.metrics.materials import normal_errors
from lumisplat.progress import Progress, no_progress
from lumisplat.relighting.evaluation import LayerRenderer, relighting_config, relit_scene, with_albedo
from lumisplat.relighting.published_sets import (
    ORB_SIZE,
    PublishedSet,
    RelitView,
    TestView,
    open_nerf_synthetic,
    open_orb,
    open_synthetic4relight,
    open_tensoir,
    unit_texels,
)
from lumisplat.renderer.renderer import create_renderer
from lumisplat.scene.camera import Camera
from lumisplat.scene.gaussians import Gaussians

Scale = tuple[float, float, float]
"""Factor of each channel of the estimated albedo."""

Figures = dict[str, float]
"""Figures of one view by name, or their means."""

Remarks = dict[str, None]
"""Sentences in order, without repetition."""

_MSE = "mse:"
"""Prefix of figures of which the mean counts as PSNR."""


class Benchmark(Enum):
    """A published benchmark of relighting or of novel views."""

    TENSOIR = "tensoir"
    """TensoIR-Synthetic (Jin et al. 2023): 100 and 200 views of an object, five other environments."""
    SYNTHETIC4RELIGHT = "synthetic4relight"
    """Synthetic4Relight (Zhang et al. 2022), by the rules of R3DG (Gao et al. 2024): two other environments."""
    ORB = "orb"
    """Stanford-ORB (Kuang et al. 2023): HDR photographs of an object in three places, with their environments."""
    NERF_SYNTHETIC = "nerf-synthetic"
    """NeRF-Synthetic (Mildenhall et al. 2020): novel views alone."""


@dataclass(frozen=True, slots=True)
class PublishedFigures:
    """Figures of a capture by the rules of a published benchmark."""

    benchmark: Benchmark
    views: int
    """Number of test views."""
    figures: Mapping[str, float]
    """Means over views by name (docs/guide/published_sets.md#figures); those under one light are ``NAME/LIGHT``."""
    albedo_scale: Scale
    """Factor of each channel of the estimated albedo; 1 where the rules have none."""
    remarks: tuple[str, ...]
    """Sentences that say what was not computed, and what the set or the installed packages lack for it."""


def check_published(folder: PathLike, benchmark: Benchmark, lights: PathLike | None = None) -> None:
    """Raises an error if files of one object of a published benchmark are missing; reads no images.

    Args:
        folder: Folder of the object.
        benchmark: The benchmark to which it belongs.
        lights: As for `evaluate_published`.

    Raises:
        FormatError: A file is missing or damaged; the message names it.
    """
    _RULES[benchmark].open(Path(folder), None if lights is None else Path(lights))


def evaluate_published(
    gaussians: Gaussians,
    folder: PathLike,
    benchmark: Benchmark,
    *,
    lights: PathLike | None = None,
    config: RenderConfig | None = None,
    samples: int | None = None,
    denoise: bool = False,
    device: str = "auto",
    progress: Progress | None = None,
) -> PublishedFigures:
    """Scores a capture on one object of a published benchmark, by the rules of its authors.

    Args:
        gaussians: The capture, trained on the images of the folder, with any of ``albedo``, ``normals`` and
            ``roughness``. Without an albedo, its captured colours are used, decoded.
        folder: Folder of the object, as published.
        benchmark: The benchmark to which it belongs.
        lights: Folder of the environments in which objects are relit; for Stanford-ORB the folder ``ground_truth``, by
            default beside ``blender_HDR``. None: nothing is relit in the others.
        config: Settings of relit renders; None: ``Pipeline.PATH`` with ``PathPrimary.ISO``, which blends albedo along a
            ray as the training images were blended.
        samples: Samples per pixel of relit renders; None: 64, or those of ``config``.
        denoise: True denoises relit renders, as `Frame.denoised` does.
        device: ``"cpu"``, ``"cuda:0"``, ... or ``"auto"``.
        progress: Called with a label of the stage and the fraction done, 0..1.

    Raises:
        DeviceError: There is no such device.
        FormatError: A file is missing or damaged; the message names it.
        MissingExtraError: ``denoise`` is set, and the denoiser is not installed.
        SceneError: ``gaussians`` are of another type.
    """
    if not isinstance(gaussians, Gaussians):  # pyright: ignore[reportUnnecessaryIsInstance]
        raise SceneError(f"gaussians is {type(gaussians).__name__}, expected Gaussians")
    if denoise:
        Frame.check_denoiser()
    rules, report = _RULES[benchmark], progress or no_progress
    found = rules.open(Path(folder), None if lights is None else Path(lights))
    given = with_albedo(gaussians)
    layers, remarks = LayerRenderer.of(given, device), Remarks()
    scale: Scale = (1.0, 1.0, 1.0)
    if rules.scaling_views is not None and "albedo" in found.views[0].layers:
        chosen = [found.views[row] for row in rules.scaling_views(len(found.views))]
        scale = _scale((_Truth.of(view, rules.size), _shown(layers, view.camera, rules.size)) for view in chosen)
    rows: list[Figures] = []
    for index, view in enumerate(found.views):
        report("comparing views", index / len(found.views))
        truth, shown = _Truth.of(view, rules.size), _shown(layers, view.camera, rules.size)
        rows.append(rules.compare(truth, shown, scale, remarks))
    figures = _means(rows)
    under: dict[str, list[Figures]] = {}
    if found.relit:
        settings = config or RenderConfig(pipeline=Pipeline.PATH, path=PathConfig(primary=PathPrimary.ISO))
        settings = relighting_config(settings, samples, gaussians, denoise=denoise)
        renderer = create_renderer(settings, device)
        for index, view in enumerate(found.relit):
            report("relighting", index / len(found.relit))
            frame = renderer.render(relit_scene(given, (view.lights(),), scale, 1.0), _sized(view.camera, rules.size))
            frame = frame.denoised() if denoise else frame
            seen = _Truth.of(view, rules.size), frame.straight(), frame.alpha[..., None]
            under.setdefault(view.light, []).append(rules.compare_relit(*seen, remarks))
    elif rules.compare_relit is not _nothing:
        remarks["nothing is relit: lights, the folder of the environments, is not given"] = None
    report("comparing", 1.0)
    figures |= _means([row for rows in under.values() for row in rows])
    for light, rows in under.items():
        figures |= {f"{name}/{light}": value for name, value in _means(rows).items()}
    return PublishedFigures(benchmark, len(found.views), figures, scale, tuple(remarks))


class _Truth(NamedTuple):
    """A test image and its ground truth, at the size at which they are compared."""

    color: FloatArray
    """Straight colours, (H, W, 3): display-referred sRGB, or linear radiance of an EXR."""
    alpha: FloatArray
    """Alpha or mask, (H, W, 1)."""
    view: TestView | RelitView
    size: int | None

    @classmethod
    def of(cls, view: TestView | RelitView, size: int | None) -> _Truth:
        """Reads the image of a view, and its mask.

        Raises:
            FormatError: A file is damaged, or has another size than the camera.
        """
        if view.image.suffix.lower() in LINEAR:
            color, alpha = _resized(read_radiance(view.image), size), None
        else:
            texels = _resized(unit_texels(view.image), size)
            color, alpha = texels[..., :3], texels[..., 3:] if texels.shape[2] == 4 else None
        if view.mask is not None:
            alpha = _resized(unit_texels(view.mask)[..., :1], size)
        camera = _sized(view.camera, size)
        if color.shape[:2] != (camera.height, camera.width):
            found = f"{color.shape[1]} x {color.shape[0]}"
            raise FormatError(view.image, f"has {found} pixels, expected {camera.width} x {camera.height}")
        return cls(color, np.ones((*color.shape[:2], 1), np.float32) if alpha is None else alpha, view, size)

    def layer(self, name: str) -> FloatArray | None:
        """Reads a layer of ground truth as it is stored, channels 0..1 of a PNG; None if the set has none."""
        path = self.view.layers.get(name) if isinstance(self.view, TestView) else None
        if path is None:
            return None
        if path.suffix == ".npy":
            return _resized(np.load(path, allow_pickle=False).astype(np.float32), self.size)
        return _resized(unit_texels(path), self.size)

    @property
    def inside(self) -> Flags:
        """Pixels of which the object covers any part, (H, W)."""
        return self.alpha[..., 0] > 0.0


class _Shown(NamedTuple):
    """A capture at a test view."""

    novel: FloatArray
    """Captured look over black, display-referred sRGB, (H, W, 3)."""
    alpha: FloatArray
    """(H, W, 1)."""
    albedo: FloatArray
    """Linear, straight, (H, W, 3)."""
    normal: FloatArray
    """Unit normals in world space, 0 where nothing is, (H, W, 3)."""
    roughness: FloatArray | None
    """(H, W, 1)."""
    camera: Camera


def _shown(layers: LayerRenderer, camera: Camera, size: int | None) -> _Shown:
    seen = _sized(camera, size)
    drawn = layers.draw(seen)
    look = layers.look(seen)
    alpha = np.clip(look.alpha, 0.0, 1.0)[..., None]
    novel = np.clip(look.premultiplied(), 0.0, 1.0)
    return _Shown(novel, alpha, drawn["albedo"], drawn["normal"], drawn.get("roughness"), seen)


def _sized(camera: Camera, size: int | None) -> Camera:
    return camera if size is None or camera.height <= size else camera.scaled(size, size)


def _resized(image: FloatArray, size: int | None) -> FloatArray:
    return image if size is None or len(image) <= size else area_mean(image, size, size)


def _scale(pairs: Iterable[tuple[_Truth, _Shown]]) -> Scale:
    """Returns the median ratio of true to estimated albedo, by channel, over the object's pixels of several views."""
    ratios: list[Doubles] = []
    for truth, shown in pairs:
        wanted = truth.layer("albedo")
        assert wanted is not None
        found = np.maximum(shown.albedo[truth.inside].astype(np.float64), 1e-6)
        ratios.append(wanted[..., :3][truth.inside] / found)
    red, green, blue = np.median(np.concatenate(ratios), axis=0).tolist()
    return red, green, blue


def _means(rows: Sequence[Figures]) -> Figures:
    """Returns the mean of each figure; that of ``mse:NAME`` as ``NAME_psnr``, dB."""
    means: Figures = {}
    for name in rows[0] if rows else ():
        mean = float(np.mean([row[name] for row in rows]))
        if name.startswith(_MSE):
            means[f"{name.removeprefix(_MSE)}_psnr"] = _decibels(mean)
        else:
            means[name] = mean
    return means


def _decibels(error: float) -> float:
    return float("inf") if error == 0.0 else -10.0 * float(np.log10(error))


def _psnr(found: FloatArray, truth: FloatArray) -> float:
    return _decibels(float(np.mean((found.astype(np.float64) - truth) ** 2)))


def _similar(name: str, found: FloatArray, truth: FloatArray, remarks: Remarks) -> Figures:
    """Returns PSNR and SSIM of two images in 0..1, as figures with a prefix."""
    figures = {f"{name}_psnr": _psnr(found, truth)}
    try:
        figures[f"{name}_ssim"] = ssim(found, truth)
    except (MissingExtraError, SceneError) as error:
        remarks[f"no ssim: {error}"] = None
    return figures


def _over_white(color: FloatArray, alpha: FloatArray) -> FloatArray:
    return np.clip(color * alpha + (1.0 - alpha), 0.0, 1.0).astype(np.float32)


def _scaled(albedo: FloatArray, scale: Scale) -> FloatArray:
    return np.clip(albedo * np.array(scale), 0.0, 1.0).astype(np.float32)


def _displayed(linear: FloatArray) -> FloatArray:
    return encode_srgb(np.clip(linear, 0.0, 1.0)).astype(np.float32)


def _novel(truth: _Truth, shown: _Shown, _: Scale, remarks: Remarks) -> Figures:
    """Compares the captured look with the image, both over white."""
    found = np.minimum(shown.novel + 1.0 - shown.alpha, 1.0)
    return _similar("novel", found, _over_white(truth.color, truth.alpha), remarks)


def _tensoir(truth: _Truth, shown: _Shown, scale: Scale, remarks: Remarks) -> Figures:
    """Compares a view over white; albedo, stored linear, with a gamma of 2.2; normals with (0, 0, 1) around."""
    figures = _novel(truth, shown, scale, remarks)
    albedo, normal = truth.layer("albedo"), truth.layer("normal")
    assert albedo is not None
    assert normal is not None
    wanted = _over_white(albedo[..., :3], albedo[..., 3:])
    found = np.where(truth.inside[..., None], _over_white(_scaled(shown.albedo, scale), shown.alpha), np.float32(1.0))
    figures[f"{_MSE}albedo"] = float(np.mean((found ** (1.0 / 2.2) - wanted ** (1.0 / 2.2)) ** 2))
    around = np.array([0.0, 0.0, 1.0], np.float32)
    turned = (2.0 * normal[..., :3] - 1.0) * normal[..., 3:] + around * (1.0 - normal[..., 3:])
    estimated = shown.normal * shown.alpha + around * (1.0 - shown.alpha)
    turned = turned / np.linalg.norm(turned, axis=2, keepdims=True)
    angles = normal_errors(estimated.reshape(-1, 3), turned.reshape(-1, 3))
    object_angles = angles[truth.alpha.reshape(-1) >= 0.5]
    return figures | {"normal_mae": float(angles.mean()), "normal_mae_object": float(object_angles.mean())}


def _tensoir_relit(truth: _Truth, color: FloatArray, alpha: FloatArray, remarks: Remarks) -> Figures:
    return _similar("relit", _over_white(_displayed(color), alpha), _over_white(truth.color, truth.alpha), remarks)


def _synthetic4relight(truth: _Truth, shown: _Shown, scale: Scale, remarks: Remarks) -> Figures:
    """Compares a view over white, inside the true mask; albedo as it is stored, which is linear."""
    figures = _novel(truth, shown, scale, remarks)
    albedo, roughness = truth.layer("albedo"), truth.layer("roughness")
    assert albedo is not None
    assert roughness is not None
    wanted = _over_white(albedo[..., :3], truth.alpha)
    figures |= _similar("albedo", _over_white(_scaled(shown.albedo, scale), truth.alpha), wanted, remarks)
    if shown.roughness is not None:
        error = (shown.roughness - roughness[..., :1]) * truth.alpha
        figures["roughness_mse"] = float(np.mean(error**2))
    return figures


def _synthetic4relight_relit(truth: _Truth, color: FloatArray, alpha: FloatArray, remarks: Remarks) -> Figures:
    found = _over_white(_over_white(_displayed(color), alpha), truth.alpha)
    return _similar("relit", found, _over_white(truth.color, truth.alpha), remarks)


def _nothing(truth: _Truth, color: FloatArray, alpha: FloatArray, remarks: Remarks) -> Figures:
    """Compares nothing: the benchmark has no relit images."""
    return {}


def _orb(truth: _Truth, shown: _Shown, scale: Scale, remarks: Remarks) -> Figures:
    """Compares a photograph: HDR up to 4, and as displayed, each after the best factor of each channel."""
    figures = _orb_similar("novel", truth, decode_srgb(shown.novel).astype(np.float32), remarks)
    albedo, normal, mask = truth.layer("albedo"), truth.layer("normal"), _eroded(truth.alpha)
    if albedo is not None:
        wanted = decode_srgb(albedo[..., :3]).astype(np.float32) * mask
        found = _fitted(shown.albedo * mask, wanted, mask)
        figures["albedo_psnr"] = _psnr(np.clip(found, 0.0, 1.0), np.clip(wanted, 0.0, 1.0))
    if normal is not None:
        # The truth is in the axes of the camera, x right, y up and -z forward.
        turned = shown.normal @ shown.camera.camera_from_world[:3, :3].T * (1.0, -1.0, -1.0)
        lengths = np.maximum(np.linalg.norm(normal, axis=2, keepdims=True), 1e-6)
        distance = (1.0 - np.sum(turned * normal / lengths, axis=2, keepdims=True)) * mask
        figures["normal_cosine"] = float(distance.sum() / max(float(mask.sum()), 1.0))
    return figures


def _orb_relit(truth: _Truth, color: FloatArray, alpha: FloatArray, remarks: Remarks) -> Figures:
    return _orb_similar("relit", truth, color * alpha, remarks)


def _orb_similar(name: str, truth: _Truth, found: FloatArray, remarks: Remarks) -> Figures:
    """Returns PSNR-H, PSNR-L and SSIM of linear images, over the eroded mask and black around it."""
    mask = _eroded(truth.alpha)
    wanted = np.maximum(truth.color, 0.0) * mask
    fitted = _fitted(found * mask, wanted, mask)
    low = np.clip(wanted, 0.0, 1.0)
    lighter = float(encode_srgb(low).mean() / low.mean()) if low.mean() > 1e-8 else 1.0
    bright = [np.clip(lighter * image, 0.0, 4.0) for image in (fitted, wanted)]
    figures = _similar(name, _displayed(fitted), _displayed(wanted), remarks)
    grey = 0.5 * mask  # no image counts as worse than grey
    figures[f"{name}_psnr_h"] = max(_psnr(bright[0], bright[1]), _psnr(grey, bright[1]))
    figures[f"{name}_psnr_l"] = max(figures.pop(f"{name}_psnr"), _psnr(grey, _displayed(wanted)))
    return figures


def _eroded(alpha: FloatArray) -> FloatArray:
    """Returns 1 where the mask is at least half covered in a square of 5 x 5 pixels, else 0, (H, W, 1)."""
    return minimum_filter((alpha > 0.5).astype(np.float32), size=(5, 5, 1), mode="nearest")


def _fitted(found: FloatArray, wanted: FloatArray, mask: FloatArray) -> FloatArray:
    """Multiplies each channel by the factor with the least squared error over the mask."""
    squares = np.sum(found.astype(np.float64) ** 2, axis=(0, 1))
    products = np.sum(found.astype(np.float64) * wanted, axis=(0, 1))
    without = np.sum(wanted, axis=(0, 1), dtype=np.float64) / max(float(mask.sum()), 1.0)
    return (found * np.where(squares > 1e-6, products / np.maximum(squares, 1e-6), without)).astype(np.float32)


@dataclass(frozen=True, slots=True)
class _Rules:
    """How a benchmark finds its files and computes its figures."""

    open: Callable[[Path, Path | None], PublishedSet]
    compare: Callable[[_Truth, _Shown, Scale, Remarks], Figures]
    """Figures of one view in the light of the training images."""
    compare_relit: Callable[[_Truth, FloatArray, FloatArray, Remarks], Figures]
    """Figures of one relit view, from straight linear colours and alpha."""
    scaling_views: Callable[[int], Iterable[int]] | None = None
    """Test views, of a number of them, that tell the scale of the albedo; None: it is not scaled for relighting."""
    size: int | None = None
    """Width and height, pixels, at which images are compared; None: their own."""


_RULES = {
    Benchmark.TENSOIR: _Rules(
        open_tensoir, _tensoir, _tensoir_relit, lambda count: range(0, count, max(count // 20, 1))
    ),
    Benchmark.SYNTHETIC4RELIGHT: _Rules(
        open_synthetic4relight, _synthetic4relight, _synthetic4relight_relit, lambda count: range(1)
    ),
    Benchmark.ORB: _Rules(open_orb, _orb, _orb_relit, size=ORB_SIZE),
    Benchmark.NERF_SYNTHETIC: _Rules(open_nerf_synthetic, _novel, _nothing),
}
