"""Renders what each light contributes to the images' pixels, alone, with bounced light denoised over surfaces."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np
import numpy.typing as npt

from lumisplat.config import Pipeline, RasterStrategy, RenderConfig, ToneMap
from lumisplat.errors import ConfigError, SceneError, check_instance
from lumisplat.frame.frame import Frame
from lumisplat.io.images.radiance import LINEAR, read_display_image, read_radiance
from lumisplat.math.arrays import Doubles, Flags, FloatArray, IntArray
from lumisplat.math.resampling import area_mean
from lumisplat.math.tone_map import remove_tone_map
from lumisplat.renderer.renderer import Renderer, create_renderer
from lumisplat.scene.camera import Camera
from lumisplat.scene.lights import Light, LightPoint
from lumisplat.scene.materials import Material, MaterialPbr
from lumisplat.scene.scene import MeshInstance, Scene, SplatInstance

CLIPPED_ABOVE = 0.995
"""Display value from which on a pixel may be clipped: 254 of 255 and above."""

_ASPECT_ERROR = 0.51
"""Pixels by which the height of a photograph may miss the camera's aspect ratio."""
_WHOLE = 1.0 - 1e-4
"""Share of its own pixels that count from which on a larger pixel counts."""


@dataclass(frozen=True, slots=True, eq=False)
class FitImage:
    """A photograph at its own size."""

    camera: Camera
    """Of the photograph's size."""
    light: Doubles
    """Linear Rec.709, exposed, shape (H, W, 3)."""
    counts: Flags
    """Which channels of which pixels are fitted, shape (H, W, 3)."""
    label: str
    """What messages call it."""
    clipped: int
    """Pixels that are left out, as they are at the end of the range."""
    masked: int
    """Pixels that a mask leaves out."""
    full_size: int
    """Pixels of the photograph as it was given."""

    def scaled(self, longest: int) -> FitImage:
        """The photograph with at most so many pixels along its longer side; a pixel counts if all of it does."""
        height, width = self.light.shape[:2]
        factor = longest / max(height, width)
        if factor >= 1.0:
            return self
        size = max(1, round(factor * width)), max(1, round(factor * height))
        return FitImage(
            camera=self.camera.scaled(*size),
            light=area_mean(self.light, *size).astype(np.float64),
            counts=area_mean(self.counts.astype(np.float32), *size) >= _WHOLE,
            label=self.label,
            clipped=self.clipped,
            masked=self.masked,
            full_size=self.full_size,
        )


def read_images(
    cameras: Camera | Sequence[Camera],
    images: Any,
    masks: Any = None,
    *,
    linear: bool | None = None,
    tone_map: ToneMap = ToneMap.NONE,
) -> list[FitImage]:
    """The photographs of cameras.

    Args:
        cameras: One, or one a photograph.
        images: As of `lumisplat.fit_lights`.
        masks: One a photograph, (H, W): what is at least half white counts; None, also in place of one: all does.
        linear: Whether arrays hold linear light; None: arrays and pictures are display-referred, EXR and HDR linear.
        tone_map: What display colours went through.

    Raises:
        SceneError: Numbers or sizes do not match, values are not finite, or nothing counts.
        FormatError: A file cannot be read.
    """
    views = [cameras] if isinstance(cameras, Camera) else list(cameras)
    given = [images] if _is_single_image(images) else list(images)
    covers = [None] * len(given) if masks is None else [masks] if _is_single_image(masks) else list(masks)
    for view in views:
        check_instance(view, Camera, "cameras holds something else, expected a Camera")
    if not given or len(views) != len(given):
        raise SceneError(f"there are {len(views)} cameras and {len(given)} photographs, expected one camera for each")
    if len(covers) != len(given):
        raise SceneError(f"there are {len(given)} photographs and {len(covers)} masks, expected one for each, or None")
    rows = zip(range(len(given)), views, given, covers, strict=True)
    return [
        _read(number if len(given) > 1 else None, view, item, cover, linear=linear, tone_map=tone_map)
        for number, view, item, cover in rows
    ]


def _path_of(given: Any) -> Path | None:
    """The path, if it is one."""
    return Path(cast("str", given)) if isinstance(given, str | os.PathLike) else None


def _is_single_image(images: Any) -> bool:
    """Whether this is one picture: a path, or an array of three axes; else it is a sequence of them."""
    if _path_of(images) is not None:
        return True
    return not isinstance(images, list | tuple) and np.ndim(images) < 4


def _read(
    number: int | None, camera: Camera, image: Any, mask: Any, *, linear: bool | None, tone_map: ToneMap
) -> FitImage:
    path = _path_of(image)
    label = "the photograph" if number is None else f"photograph {number}"
    label = label if path is None else str(path)
    if path is not None:
        is_linear = path.suffix.lower() in LINEAR
        values: npt.NDArray[Any] = read_radiance(path) if is_linear else read_display_image(path)
    else:
        is_linear, values = bool(linear), np.asarray(image)
    values = _checked(label, values)
    camera = _camera_of_size(label, camera, values.shape[1], values.shape[0])
    counts: Flags = np.ones(values.shape, np.bool_)
    if not is_linear:
        bright = values >= CLIPPED_ABOVE
        counts = (values > 0.0) & ~(bright if tone_map is ToneMap.NONE else bright.any(axis=2, keepdims=True))
    clipped = int(np.count_nonzero(~counts.all(axis=2)))
    light = np.maximum(values, 0.0) if is_linear else remove_tone_map(values, tone_map)
    masked = 0
    if mask is not None:
        lit_pixels = _mask(label, mask, values.shape[:2])
        masked = int(np.count_nonzero(~lit_pixels))
        counts = counts & lit_pixels[..., None]
    if not light.any():
        raise SceneError(f"{label} is black: there is no light in it to be explained")
    if not counts.any():
        why = "is clipped or masked" if masked else f"is clipped, at 0 or at {CLIPPED_ABOVE} and above"
        raise SceneError(f"{label}: every pixel {why}, so that nothing is left to fit; expose it otherwise")
    return FitImage(
        camera=camera,
        light=np.asarray(light, np.float64),
        counts=counts,
        label=label,
        clipped=clipped,
        masked=masked,
        full_size=camera.width * camera.height,
    )


def _checked(label: str, values: npt.NDArray[Any]) -> FloatArray:
    """An image of numbers: bytes become 0..1."""
    if values.dtype.kind not in "fu" or values.ndim != 3 or values.shape[2] != 3 or not values.size:
        raise SceneError(f"{label} is an array {values.shape} of {values.dtype}, expected (H, W, 3), float or uint8")
    if values.dtype.kind == "u":
        return (values.astype(np.float32) / np.float32(np.iinfo(values.dtype).max)).astype(np.float32)
    bad = int(np.count_nonzero(~np.isfinite(values).all(axis=2)))
    if bad:
        raise SceneError(f"{label} has {bad:,} pixels that are NaN or infinite: mend them, or mask them with 0 instead")
    return values.astype(np.float32)


def _camera_of_size(label: str, camera: Camera, width: int, height: int) -> Camera:
    """The camera at the size of its photograph.

    Raises:
        SceneError: The aspect ratio is another.
    """
    if abs(height - width * camera.height / camera.width) > _ASPECT_ERROR * max(1.0, height / camera.height):
        raise SceneError(
            f"{label} is {width} x {height}, and its camera {camera.name or 'without a name'} {camera.width} x "
            f"{camera.height}, of another shape: crop the picture, or give the camera that took it"
        )
    return camera.scaled(width, height)


def _mask(label: str, mask: Any, size: tuple[int, ...]) -> Flags:
    """Where a photograph counts, shape (H, W).

    Raises:
        SceneError: The mask has another size.
    """
    values: npt.NDArray[Any] = np.asarray(mask) if _path_of(mask) is None else read_display_image(mask)
    if values.dtype == np.uint8:
        values = values / 255.0
    if values.ndim == 3:
        values = values.mean(axis=2)
    if values.shape != size:
        raise SceneError(f"the mask of {label} has shape {values.shape}, expected {size}, as the photograph")
    return values >= 0.5


FIT_SAMPLES_OF_PATHS = 64
"""Samples a pixel of paths, for each light: with them, 128 x 96 pixels know a lamp's light to some thousandths."""

SMOOTH_REACH = 1.0 / 32.0
"""How far to each side light that has bounced is averaged, of the longer side of the picture: as far in the scene,
whatever the picture's size. With twice that, at 64 pixels, a lamp of a bounced room was off by 2.8 % instead of 1.4."""

SMOOTH_COSINE_MIN = 0.9
"""Cosine between normals from which on neighbours are on one surface."""

SMOOTH_PLANE = 0.2
"""Distance of a neighbour from a pixel's plane up to which both are on one surface, relative to their distance."""

SMOOTH_ROUGHNESS_MIN = 0.3
"""Roughness below which what a surface reflects is not averaged: it may have edges."""

SMOOTH_ALBEDO_MIN = 0.02
"""Least albedo by which light is divided before it is averaged, so that textures stay sharp."""

Layer = Callable[[Scene, Frame], Doubles]
"""What is taken of a frame, shape (H, W, 3)."""
_Instances = tuple[tuple[SplatInstance, ...], tuple[MeshInstance, ...]]
_PATH_AOVS = ("lights", "albedo", "direct_diffuse", "direct_glossy", "emission")
_DISABLED_LIGHT = LightPoint((0.0, 0.0, 0.0), enabled=False)
"""Keeps the headlight away from scenes without lights."""
_UNLIT_WEIGHT_MAX = 1e-3
"""Share of captures that keep their look, and of nothing at all, up to which a pixel tells of lights."""


class LightLayers:
    """Renders lights one by one, in all photographs.

    Args:
        config: How light behaves; None: as paths.
        device: As of ``create_renderer``.
        share: Of the samples that are taken.
        rendered: Called after each light.
    """

    def __init__(
        self,
        config: RenderConfig | None,
        device: str,
        share: float = 1.0,
        *,
        rendered: Callable[[], None] = lambda: None,
    ) -> None:
        base = RenderConfig(pipeline=Pipeline.PATH) if config is None else config
        if base.pipeline.is_sequence:
            raise ConfigError("Pipeline.REALTIME finds light over many frames: fit by Pipeline.PATH, whose light it is")
        self.is_path = base.pipeline.traces_paths
        samples = base.samples or (FIT_SAMPLES_OF_PATHS if self.is_path else None)
        half = None if samples is None else max(1, round(0.5 * share * samples))
        settled = {"background": (0.0, 0.0, 0.0), "lighting": True, "samples": half, "adaptive": False}
        without = {"time_limit": None, "noise": None, "aovs": _PATH_AOVS if self.is_path else ()}
        self.config = replace(base, **settled, **without)
        self._device, self._rendered = device, rendered
        self._renderers: list[Renderer] = []
        self._smooth: dict[tuple[object, ...], tuple[_Instances, SurfaceAverage]] = {}
        """By view: the things of the last scene, and which pixels are on one surface."""
        self._is_random = self.is_path or base.raster.strategy is RasterStrategy.STOCHASTIC

    def lit_pixels(self, scene: Scene, images: Sequence[FitImage]) -> Flags:
        """Which pixels show what lights light, shape (N,)."""
        frames = self._frames(0, _with_lights(scene, ()), images)
        weights = [np.asarray(frame.captured_weight).ravel() for frame in frames]
        return np.concatenate(weights) < _UNLIT_WEIGHT_MAX

    def render(self, scene: Scene, lights: Sequence[Light], images: Sequence[FitImage]) -> Doubles:
        """Linear light of a scene under these lights alone, what shines by itself included, shape (2, N, 3)."""
        return self._both(_with_lights(scene, lights), images, self._all_light)

    def render_light(self, scene: Scene, light: Light, images: Sequence[FitImage], fixed: Doubles) -> Doubles:
        """Linear light that one light adds.

        Args:
            scene: The scene.
            light: The light.
            images: Say which pixels.
            fixed: The picture without lights.

        Returns:
            Shape (2, N, 3).
        """
        lit = _with_lights(scene, (light,))
        if self.is_path:  # its own layer: what else shines would only bring noise
            return self._both(lit, images, self._single_light)
        return self._both(lit, images, self._all_light) - fixed

    def _both(self, scene: Scene, images: Sequence[FitImage], layer: Layer) -> Doubles:
        """A layer rendered with two seeds; a single time, if it is not random."""
        first = self._frames(0, scene, images)
        rows = self._rows(scene, first, layer)
        second = rows
        if self._is_random or any(frame.samples > 1 for frame in first):
            second = self._rows(scene, self._frames(1, scene, images), layer)
        self._rendered()
        return np.stack([rows, second])

    def _rows(self, scene: Scene, frames: Sequence[Frame], layer: Layer) -> Doubles:
        return np.concatenate([layer(scene, frame).reshape(-1, 3) for frame in frames])

    def _frames(self, seed_index: int, scene: Scene, images: Sequence[FitImage]) -> list[Frame]:
        while len(self._renderers) <= seed_index:
            seed = (self.config.seed + 7919 * len(self._renderers)) % 2**32
            self._renderers.append(create_renderer(replace(self.config, seed=seed), self._device))
        return [self._renderers[seed_index].render(scene, replace(item.camera, exposure=0.0)) for item in images]

    def _all_light(self, scene: Scene, frame: Frame) -> Doubles:
        """All light, what has bounced averaged."""
        light = np.asarray(frame.light, np.float64)
        if not self.is_path:
            return light
        first = sum(
            np.asarray(part, np.float64) for part in (frame.direct_diffuse, frame.direct_glossy, frame.emission)
        )
        return first + self._averaged(scene, frame, light - first)

    def _single_light(self, scene: Scene, frame: Frame) -> Doubles:
        """The light of the only light, what has bounced averaged."""
        assert frame.light_total is not None and frame.light_direct is not None and frame.light_shadow is not None
        first = np.asarray(frame.light_direct[0] * frame.light_shadow[0], np.float64)
        return first + self._averaged(scene, frame, frame.light_total[0] - first)

    def _averaged(self, scene: Scene, frame: Frame, bounced: Doubles) -> Doubles:
        key = (frame.camera.width, frame.camera.height, frame.camera.camera_from_world.tobytes())
        instances = scene.splats, scene.meshes
        cached = self._smooth.get(key)
        if cached is None or cached[0] != instances:
            cached = self._smooth[key] = instances, SurfaceAverage.of(scene, frame)
        return cached[1].averaged(bounced)


def unit(light: Light) -> Light:
    """The light with a power of 1 in each channel."""
    return replace(light, color=(1.0, 1.0, 1.0), intensity=1.0)


def power_of(light: Light) -> Doubles:
    """Colour times intensity, shape (3,)."""
    return np.array(light.color, np.float64) * light.intensity


def with_power(light: Light, power: Doubles) -> Light:
    """The light with this power: its brightest channel becomes the intensity; one without any keeps its colour."""
    brightest = float(power.max())
    if brightest <= 0.0:
        return replace(light, intensity=0.0)
    return replace(light, color=tuple(power / brightest), intensity=brightest)


def _with_lights(scene: Scene, lights: Sequence[Light]) -> Scene:
    return replace(scene, lights=tuple(lights) or (_DISABLED_LIGHT,))


_Number = TypeVar("_Number", bound=np.generic)


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceAverage:
    """Which pixels of a view are on one surface."""

    albedo: Doubles
    """By which light is divided before, (H, W, 3)."""
    offsets: tuple[tuple[int, int], ...]
    """Rows and columns to neighbours."""
    same_surface: Flags
    """Whether each neighbour is on the pixel's surface, (offsets, H, W)."""

    @classmethod
    def of(cls, scene: Scene, frame: Frame) -> SurfaceAverage:
        """Of a frame with albedo."""
        assert frame.albedo is not None
        radius = max(1, round(SMOOTH_REACH * max(frame.camera.width, frame.camera.height)))
        reach = range(-radius, radius + 1)
        offsets = tuple((down, across) for down in reach for across in reach)
        position, normal = np.asarray(frame.position, np.float64), np.asarray(frame.normal, np.float64)
        surface = _matt_surfaces(scene, np.asarray(frame.instance_index))
        same_surface = np.zeros((len(offsets), *surface.shape), np.bool_)
        for row, offset in enumerate(offsets):
            away = _shifted(position, offset) - position
            apart = np.abs((away * normal).sum(axis=2))
            flat = apart <= SMOOTH_PLANE * np.linalg.norm(away, axis=2) + 1e-9
            alike = (_shifted(normal, offset) * normal).sum(axis=2) >= SMOOTH_COSINE_MIN
            same_surface[row] = (
                (_shifted(surface, offset) == surface) & (surface >= 0) & flat & alike & _inside_image(surface, offset)
            )
            if offset == (0, 0):
                same_surface[row] = True
        albedo = np.maximum(np.asarray(frame.albedo, np.float64), SMOOTH_ALBEDO_MIN)
        return cls(albedo, offsets, same_surface)

    def averaged(self, light: Doubles) -> Doubles:
        """Light of the view, (H, W, 3), averaged over each pixel's surface nearby."""
        arriving = light / self.albedo
        total = np.zeros_like(arriving)
        for offset, same_surface in zip(self.offsets, self.same_surface, strict=True):
            total += np.where(same_surface[..., None], _shifted(arriving, offset), 0.0)
        return total / self.same_surface.sum(axis=0)[..., None] * self.albedo


def _matt_surfaces(scene: Scene, instances: IntArray) -> IntArray:
    """The instance that each pixel shows; -1 where there is none, or what it reflects is sharp."""
    materials = [instance.material for instance in scene.splats] + [item.mesh.material for item in scene.meshes]
    matt = np.array([*(_is_matt(material) for material in materials), False])
    return np.where(matt[instances], instances, -1).astype(np.int32)


def _is_matt(material: Material | None) -> bool:
    return not isinstance(material, MaterialPbr) or material.roughness >= SMOOTH_ROUGHNESS_MIN


def _shifted(image: npt.NDArray[_Number], offset: tuple[int, int]) -> npt.NDArray[_Number]:
    """What stands at an offset from each pixel; rows and columns go round."""
    return np.roll(image, (-offset[0], -offset[1]), axis=(0, 1))


def _inside_image(image: IntArray, offset: tuple[int, int]) -> Flags:
    """Whether an offset from each pixel leads to one of the image."""
    height, width = image.shape
    inside = np.zeros((height, width), np.bool_)
    down, across = offset
    inside[max(-down, 0) : height - max(down, 0), max(-across, 0) : width - max(across, 0)] = True
    return inside
