"""Found materials and light against a known truth: ``lumisplat.evaluate_materials``."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy.typing as npt

from lumisplat.config import Pipeline, RenderConfig
from lumisplat.config.checks import check_kind
from lumisplat.constants.materials_measured import RELIT_SAMPLES
from lumisplat.errors import SceneError
from lumisplat.io.files.source import PathLike
from lumisplat.math.arrays import FloatArray, float_array
from lumisplat.metrics.materials import Channels, environment_psnr
from lumisplat.progress import Progress, say_nothing
from lumisplat.relighting.evaluation.compare import (
    Pair,
    SeenView,
    albedo_scale,
    measured,
    normal_figures,
    roughness_rmse,
)
from lumisplat.relighting.evaluation.found import LayerRenderer, over_black, relit_scene, with_albedo
from lumisplat.relighting.evaluation.results import MaterialEvaluation, RelitFigures
from lumisplat.relighting.evaluation.truth import RelightableSet
from lumisplat.renderer.renderer import Renderer, create_renderer
from lumisplat.renderer.scene.instance_tables import footprint_of
from lumisplat.scene.gaussians import Gaussians


def evaluate_materials(
    gaussians: Gaussians,
    folder: PathLike,
    *,
    environment: npt.ArrayLike | None = None,
    config: RenderConfig | None = None,
    samples: int | None = None,
    device: str = "auto",
    progress: Progress | None = None,
) -> MaterialEvaluation:
    """Compares a capture's materials, normals and looks in new light with the truth of a set, where the object is.

    The capture is seen by the cameras of the photographs held out. Its albedo gets one scale a channel, the median
    ratio to the truth over all of them, and with that it is relit in light that photographs were not made in;
    figures are defined in the guide (docs/guide/materials.md#figures).

    Args:
        gaussians: The capture, with ``albedo``, ``normals`` and ``roughness`` as far as they were found. Without
            albedo, its captured colours stand for it, decoded and without view dependence.
        folder: A set as of tools/make_relightable_set.py or make_relightable_room.py.
        environment: The light of the photographs that was found, linear radiance, shape (H, W, 3), with the axes of
            `LightEnvironment`; None: none was.
        config: How the capture is relit; None: ``Pipeline.HYBRID``, which has shadows and no bounces, and where lamps
            light a room ``Pipeline.PATH``, which has both. Whatever it says, without a background, and with samples
            through the centres of pixels: Gaussians were learnt as they are seen there, and spread samples would blur
            them once more. Rays that find antialiased captures as narrow as they are have theirs spread.
        samples: Of each pixel of relit pictures, in place of those of ``config``; None: those, and 64 if neither says
            it, so that grain is a small part of the error (docs/guide/materials.md#grain).
        device: ``"cpu"``, ``"cuda:0"``, ... or ``"auto"``.
        progress: Called with what is being done and the fraction done, 0..1.

    Raises:
        ConfigError: ``config`` is something else.
        DeviceError: There is no such device.
        FormatError: The folder is no such set, or a file of it is missing or damaged; names it.
        SceneError: ``gaussians`` or ``environment`` are something else.
    """
    if config is not None:
        check_kind("config", config, RenderConfig)
    if not isinstance(gaussians, Gaussians):  # pyright: ignore[reportUnnecessaryIsInstance]
        raise SceneError(f"gaussians is {type(gaussians).__name__}, expected Gaussians")
    found_light = None if environment is None else _panorama(environment)
    truth, report = RelightableSet.open(folder), progress or say_nothing
    given = with_albedo(gaussians)
    seen = list(_seen(truth, given, device, report))
    scale = albedo_scale(seen)
    renderer = create_renderer(_relighting(config, samples, gaussians, has_lamps=truth.has_lamps), device)
    relit = _relit(truth, given, scale, renderer, report)
    seen = [replace(view, relit=pictures) for view, pictures in zip(seen, relit, strict=True)]
    views, problems = zip(*(measured(view, scale) for view in seen), strict=True)
    light_psnr, unlike = _environment_figure(found_light, truth)
    normal_mean, normal_median = normal_figures(seen)
    return MaterialEvaluation(
        albedo_scale=scale,
        albedo_psnr=_mean([view.albedo_psnr for view in views]),
        albedo_psnr_unscaled=_mean([view.albedo_psnr_unscaled for view in views]),
        albedo_psnr_linear=_mean([view.albedo_psnr_linear for view in views]),
        normal_mean=normal_mean,
        normal_median=normal_median,
        roughness_rmse=roughness_rmse(seen),
        environment_psnr=light_psnr,
        relit={
            name: RelitFigures(*map(_mean, zip(*(view.relit[name] for view in views), strict=True)))
            for name in truth.unseen
        },
        views=tuple(views),
        remarks=(*_remarks(gaussians, truth), *unlike, *dict.fromkeys(line for lines in problems for line in lines)),
    )


def _relighting(
    config: RenderConfig | None, samples: int | None, gaussians: Gaussians, *, has_lamps: bool
) -> RenderConfig:
    """How relit pictures are made."""
    settings = config or RenderConfig(pipeline=Pipeline.PATH if has_lamps else Pipeline.HYBRID)
    if samples is None and settings.time_limit is None and settings.noise is None:
        samples = settings.samples or RELIT_SAMPLES
    # Splats show Gaussians through the centres of pixels as they were learnt, and so do rays that widen them.
    pipeline = settings.pipeline
    wide = not pipeline.is_sequence and (pipeline.rasterises or footprint_of(gaussians, settings) > 0.0)
    return replace(settings, background=None, samples=samples, jitter=settings.jitter and not wide)


def _panorama(environment: npt.ArrayLike) -> FloatArray:
    """The environment that was found, checked."""
    image = float_array("environment", environment)
    if image.ndim != 3 or image.shape[2] != 3 or image.size == 0:
        raise SceneError(f"environment has shape {image.shape}, expected (H, W, 3)")
    if (image < 0.0).any():
        raise SceneError("environment has negative values")
    return image


def _environment_figure(found: FloatArray | None, truth: RelightableSet) -> tuple[float, list[str]]:
    """How near the environment is that was found, dB, and why it was not compared."""
    if found is None:
        return math.nan, []
    true = truth.environment()
    if true is None:
        return math.nan, [
            f"the environment that was found is not compared: lamps made the photographs of {truth.folder}"
        ]
    return environment_psnr(found, true), []


def _seen(truth: RelightableSet, gaussians: Gaussians, device: str, report: Progress) -> Iterator[SeenView]:
    """The views with the layers that both have."""
    layers = LayerRenderer.of(gaussians, device)
    for number, view in enumerate(truth.views):
        report("comparing layers", number / len(truth.views))
        region, found = truth.region(view), layers.draw(view.camera)
        pairs = {name: (found[name], truth.layer(name, view)) for name in truth.layers if name in found}
        yield SeenView(view.name, region, pairs, {})
    report("comparing layers", 1.0)


def _relit(
    truth: RelightableSet, gaussians: Gaussians, scale: Channels, renderer: Renderer, report: Progress
) -> list[dict[str, Pair]]:
    """What is seen of the capture and of the truth in all unseen light, view by view."""
    pictures: list[dict[str, Pair]] = [{} for _ in truth.views]
    for number, name in enumerate(truth.unseen):
        scene = relit_scene(gaussians, truth.lights(name), scale, truth.specular)
        for index, view in enumerate(truth.views):
            report("relighting", (number + index / len(truth.views)) / len(truth.unseen))
            wanted = truth.relit(name, view)
            pictures[index][name] = over_black(renderer, scene, view.camera), wanted
    report("relighting", 1.0)
    return pictures


def _remarks(gaussians: Gaussians, truth: RelightableSet) -> Iterator[str]:
    """What was not compared, and what stands for something else."""
    for name in ("albedo", "normal", "roughness"):
        if name not in truth.layers:
            yield f"no truth of {name}: {truth.folder / 'truth' / name} is not there"
    if not truth.unseen:
        yield f"nothing is relit: {truth.folder / 'relit'} has neither an .exr nor a .toml"
    if gaussians.albedo is None:
        yield "the capture has no albedo: its captured colours, decoded, stand for it"
    if gaussians.normals is None:
        yield "the capture has no normals of its own: those of its Gaussians' shapes are compared"
    if gaussians.roughness is None and truth.specular > 0.0:
        yield "the capture has no roughness: it is relit with 0.5"


def _mean(values: Sequence[float]) -> float:
    """The mean of those that are there."""
    existing = [value for value in values if not math.isnan(value)]
    return sum(existing) / len(existing) if existing else math.nan
