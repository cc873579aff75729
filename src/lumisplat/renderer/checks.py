"""Checks of a renderer's inputs: raises errors for frames that cannot be rendered, and logs approximations."""

from __future__ import annotations

import logging
from dataclasses import fields, is_dataclass, replace
from typing import Any

import numpy as np

from lumisplat.config import GaussianSurface, Projection, RasterStrategy, RenderConfig
from lumisplat.config.checks import check_kind
from lumisplat.config.render import PATH_AOVS, REALTIME_AOVS
from lumisplat.constants import ITEMS_MAX, KERNEL_DEGREE, SAMPLES_MAX
from lumisplat.errors import ConfigError, SceneError
from lumisplat.frame.frame import Frame
from lumisplat.renderer.scene.frame_plan import FramePlan, may_adapt
from lumisplat.scene.camera import Camera
from lumisplat.scene.scene import Scene

_log = logging.getLogger("lumisplat")


def check_scene(scene: object) -> None:
    """Raises SceneError unless the argument is a Scene whose elements fit 32-bit indices."""
    if not isinstance(scene, Scene):
        raise SceneError(f"expected a Scene, got {type(scene).__name__}: ls.Scene(splats=[...], meshes=[...])")
    if max(scene.gaussian_count, scene.face_count) > ITEMS_MAX:
        raise SceneError(
            f"the scene has {scene.gaussian_count:,} Gaussians and {scene.face_count:,} triangles, "
            f"expected at most {ITEMS_MAX:,} of each"
        )
    for instance in scene.splats:
        count, coefficients = instance.gaussians.sh.shape[:2]
        if count * coefficients > ITEMS_MAX:
            raise SceneError(
                f"a set of {count:,} Gaussians with {coefficients} SH coefficients each has more than {ITEMS_MAX:,} "
                "coefficients: split it, or lower its SH degree"
            )


def checked_config(config: RenderConfig | None) -> RenderConfig:
    """Returns the settings, or the defaults for None.

    Raises:
        ConfigError: ``config`` is no RenderConfig.
    """
    config = RenderConfig() if config is None else config
    check_kind("config", config, RenderConfig)
    return config


def check_aovs(config: RenderConfig, plan: FramePlan) -> None:
    """Raises ConfigError if ``aovs`` requests an image that the pipeline cannot render."""
    lacking: set[str] = {*PATH_AOVS}
    others = "Pipeline.PATH does" if "bounces" in plan.aovs else "Pipeline.PATH or Pipeline.REALTIME does"
    if plan.traces_paths:
        lacking, others = {"reflection"}, "Pipeline.HYBRID does"
    if plan.has_history:
        lacking = {"bounces", "lights", "reflection", "sample_count", "variance"}
        others = "Pipeline.PATH or Pipeline.HYBRID does"
    missing = plan.aovs & lacking
    if not missing and not plan.has_history:
        missing, others = plan.aovs & {*REALTIME_AOVS}, "Pipeline.REALTIME does"
    if missing:
        names = ", ".join(sorted(missing))
        raise ConfigError(f"Pipeline.{config.pipeline.name} has no {names} among its aovs: {others}")


def check_projection(config: RenderConfig) -> None:
    """Raises ConfigError if the projection is UNSCENTED and another setting does not support UNSCENTED."""
    raster = config.raster
    if raster.projection is not Projection.UNSCENTED:
        return
    for value, needed in ((raster.strategy, RasterStrategy.SORTED), (raster.surface, GaussianSurface.ISO)):
        if value is not needed:
            raise ConfigError(f"{value} does not work with Projection.UNSCENTED: use {needed}")
    if config.pipeline.is_sequence:
        raise ConfigError("Projection.UNSCENTED does not work with Pipeline.REALTIME: use Pipeline.HYBRID")


def check_sampling(config: RenderConfig) -> None:
    """Raises ConfigError if the settings for samples per pixel are not supported by the pipeline."""
    if config.pipeline.is_sequence:
        given = [name for name in ("samples", "time_limit", "noise", "adaptive") if getattr(config, name) is not None]
        if config.samples == 1:
            given.remove("samples")
        if given:
            raise ConfigError(
                f"Pipeline.REALTIME has one sample a pixel, not {' and '.join(given)}: render more frames instead"
            )
    if config.adaptive and not may_adapt(config):
        if not config.pipeline.rasterises:
            raise ConfigError(
                "RenderConfig.adaptive=True needs independent random numbers per pixel: ShadowConfig.shared_draws=False"
            )
        raise ConfigError("RenderConfig.adaptive=True needs traced camera rays: use Pipeline.PATH or Pipeline.TRACE")


def check_samples(config: RenderConfig, plan: FramePlan, resume: Frame | None) -> None:
    """Raises ConfigError if a frame cannot have the samples that the settings ask for, or cannot be resumed."""
    check_sampling(config)
    if config.pipeline.is_sequence and resume is not None:
        raise ConfigError("a frame of Pipeline.REALTIME cannot be resumed: render the next frame instead")
    if "variance" in plan.aovs and plan.samples == 1 and resume is None and not plan.has_history:
        raise ConfigError("aovs has variance, which needs two samples or more: samples is 1")


def check_window(config: RenderConfig, plan: FramePlan, camera: Camera) -> None:
    """Raises ConfigError if ``camera`` renders only a window of the image, but the settings need the whole image.

    Real-time frames, ``noise``, ``time_limit`` and ``adaptive`` need the whole image.
    """
    if camera.window is None:
        return
    if plan.has_history:
        raise ConfigError("Pipeline.REALTIME needs the whole image: use another pipeline with Camera.window")
    if plan.adapts or config.noise is not None or config.time_limit is not None:
        raise ConfigError(
            "noise, time_limit and adaptive choose samples by the whole image: with Camera.window, set only samples"
        )


def check_blocks(config: RenderConfig, plan: FramePlan, camera: Camera | None = None) -> None:
    """Raises ConfigError unless a frame's samples can be split over processes.

    A split needs a number of samples that is fixed and the same for all pixels.
    """
    if camera is not None and plan.rasterises and not plan.is_unscented and camera.is_distorted:
        raise ConfigError(
            "rasterised frames with lens distortion are resampled: their samples cannot be split; use Pipeline.TRACE"
        )
    if plan.has_history or not plan.is_sampled:
        what = "Pipeline.REALTIME" if plan.has_history else "an unlit frame of the sorted rasteriser"
        raise ConfigError(f"{what} is drawn in one go: it has no samples to split")
    if plan.adapts or config.noise is not None or config.time_limit is not None:
        raise ConfigError(
            "noise, time_limit and adaptive choose the number of samples during rendering: to split a frame, "
            "set only samples"
        )


def check_resumable(frame: Frame, camera: Camera, config: RenderConfig, plan: FramePlan) -> None:
    """Raises ConfigError unless samples of this camera and these settings can be added to a frame.

    Args:
        frame: The frame to resume.
        camera: Camera of the new samples.
        config: Settings of the new samples.
        plan: Plan of the new samples.
    """
    check_kind("resume", frame, Frame)
    if not plan.is_sampled:
        raise ConfigError("an unlit frame of the sorted rasteriser cannot be resumed: it is drawn in one go")
    if frame.samples == 0:
        raise ConfigError("cannot resume a rasterised frame: only frames with samples can be resumed")
    if frame.is_denoised:
        raise ConfigError("cannot resume a denoised frame: resume the frame before denoising")
    if plan.is_lit != frame.has("light"):
        raise ConfigError("cannot resume an unlit frame as a lit frame or vice versa: keep RenderConfig.lighting")
    if frame.color.shape[:2] != camera.image_size[::-1] or frame.background != config.background:
        height, width = frame.color.shape[:2]
        raise ConfigError(
            f"cannot resume a frame of {width} x {height} pixels over background {frame.background}: the new one is "
            f"{camera.image_size[0]} x {camera.image_size[1]} over {config.background}"
        )
    other = differing(frame.camera, replace(camera, name=frame.camera.name))
    if frame.config is not None:
        limits = {name: getattr(frame.config, name) for name in ("samples", "time_limit", "tone_map")}
        other += differing(frame.config, replace(config, **limits))
    if other:
        raise ConfigError(
            f"cannot resume a frame of another camera or other settings: they differ in {', '.join(other)}"
        )
    if frame.samples + plan.samples > SAMPLES_MAX:
        raise ConfigError(f"a frame has at most {SAMPLES_MAX:,} samples: this one has {frame.samples:,} already")


def check_resumed_scene(frame: Frame, scene: Scene) -> None:
    """Raises ConfigError if the frame to resume and the scene have different numbers of Gaussians or triangles."""
    before, now = frame.stats, (scene.gaussian_count, scene.face_count)
    if before is not None and (before.gaussian_count, before.triangle_count) != now:
        raise ConfigError(
            f"cannot resume a frame of another scene: it has {before.gaussian_count:,} Gaussians and "
            f"{before.triangle_count:,} triangles, the given scene {now[0]:,} and {now[1]:,}"
        )


def differing(one: Any, other: Any, prefix: str = "") -> list[str]:
    """Returns the names of fields in which two dataclasses of one type differ; nested fields as ``trace.strategy``."""
    names: list[str] = []
    for field in fields(one):
        value, other_value = getattr(one, field.name), getattr(other, field.name)
        if is_dataclass(value):
            names += differing(value, other_value, f"{prefix}{field.name}.")
        elif not np.array_equal(value, other_value):
            names.append(prefix + field.name)
    return names


class RasterWarnings:
    """Logs warnings, each once per renderer, of effects that the rasteriser cannot draw exactly."""

    def __init__(self) -> None:
        self._warned_of_degrees: set[int] = set()
        self._has_warned_of_mirrors = False

    def warn_of_mirrors(self, scene: Scene) -> None:
        """Logs once that smooth meshes in lit raster frames reflect only the environment, or else the background."""
        count = sum(instance.mesh.material.is_smooth for instance in scene.meshes)
        if count and not self._has_warned_of_mirrors:
            self._has_warned_of_mirrors = True
            _log.warning(
                "%d smooth meshes (mirrors, glass) reflect only the environment in the raster pipeline: "
                "Pipeline.HYBRID traces their reflections and refractions",
                count,
            )

    def warn_of_degree(self, scene: Scene) -> None:
        """Logs once for each kernel degree (shape of the falloff) that the rasteriser draws as degree 2, a Gaussian."""
        degrees = {instance.gaussians.kernel_degree for instance in scene.splats} - {KERNEL_DEGREE}
        for degree in sorted(degrees - self._warned_of_degrees):
            _log.warning(
                "a capture has kernel degree %d, which the raster pipeline draws as degree %d: Pipeline.TRACE draws "
                "its exact shape",
                degree,
                KERNEL_DEGREE,
            )
        self._warned_of_degrees |= degrees
