"""Renders the radiance that each single light adds to images; averages indirect light over surfaces to reduce noise."""

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
"""Display value from which a pixel may be clipped: 254 of 255."""

_ASPECT_ERROR = 0.51
"""Largest accepted difference, pixels, between an image's height and the height that the camera's aspect ratio gives
for the image's width."""
_WHOLE = 1.0 - 1e-4
"""A downscaled pixel is fitted if fitted pixels cover at least this fraction of its area: 1, less a tolerance for
rounding."""


@dataclass(frozen=True, slots=True, eq=False)
class FitImage:
    """An image to fit, in linear light, with its camera and a mask of the pixels that are fitted."""

    camera: Camera
    """Camera of the image, scaled to the image's width and height."""
    light: Doubles
    """Linear Rec.709 light of the image, radiance times the exposure factor, shape (H, W, 3)."""
    counts: Flags
    """True for each channel of each pixel that is fitted: neither clipped nor masked, shape (H, W, 3)."""
    label: str
    """Name of the image in error messages and remarks."""
    clipped: int
    """Number of pixels that are not fitted because a channel is black (0) or white (above `CLIPPED_ABOVE`)."""
    masked: int
    """Number of pixels that are not fitted because the user's mask excludes them."""
    full_size: int
    """Number of pixels of the image before any downscaling."""

    def scaled(self, longest: int) -> FitImage:
        """Returns the image downscaled to at most ``longest`` pixels along its longer side.

        A downscaled pixel is fitted only if all the pixels that it covers are fitted.
        """
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
    """Reads the images to fit, decodes them to linear light and marks the pixels that can be fitted.

    Args:
        cameras: One camera, or one for each image.
        images: As for `lumisplat.fit_lights`.
        masks: One mask for each image, shape (H, W): pixels of at least half white are fitted. None, also as an item:
            all pixels are fitted.
        linear: Whether arrays hold linear light. None: arrays and display images are display-referred, EXR and HDR
            linear.
        tone_map: Tone map that display-referred images were made with.

    Raises:
        SceneError: Numbers or sizes do not match, values are not finite, or no pixel can be fitted.
        FormatError: A file cannot be read.
    """
    views = [cameras] if isinstance(cameras, Camera) else list(cameras)
    given = [images] if _is_single_image(images) else list(images)
    covers = [None] * len(given) if masks is None else [masks] if _is_single_image(masks) else list(masks)
    for view in views:
        check_instance(view, Camera, "cameras holds something else, expected Cameras")
    if not given or len(views) != len(given):
        raise SceneError(f"there are {len(views)} cameras and {len(given)} images, expected one camera for each")
    if len(covers) != len(given):
        raise SceneError(f"there are {len(given)} images and {len(covers)} masks, expected one for each, or None")
    rows = zip(range(len(given)), views, given, covers, strict=True)
    return [
        _read(number if len(given) > 1 else None, view, item, cover, linear=linear, tone_map=tone_map)
        for number, view, item, cover in rows
    ]


def _path_of(given: Any) -> Path | None:
    """Returns the argument as a path if it is a string or a path, otherwise None."""
    return Path(cast("str", given)) if isinstance(given, str | os.PathLike) else None


def _is_single_image(images: Any) -> bool:
    """Returns whether the argument is one image (a path or an array of at most three axes) rather than a sequence."""
    if _path_of(images) is not None:
        return True
    return not isinstance(images, list | tuple) and np.ndim(images) < 4


def _read(
    number: int | None, camera: Camera, image: Any, mask: Any, *, linear: bool | None, tone_map: ToneMap
) -> FitImage:
    path = _path_of(image)
    label = "the image" if number is None else f"image {number}"
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
        raise SceneError(f"{label} is black: it shows no light to fit")
    if not counts.any():
        why = "is clipped or masked" if masked else f"is clipped (at 0, or at {CLIPPED_ABOVE} and above)"
        raise SceneError(f"{label}: every pixel {why}, and none is left to fit; change its exposure")
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
    """Returns an image's values as float32, integers scaled to 0..1; refuses other shapes, types and values."""
    if values.dtype.kind not in "fu" or values.ndim != 3 or values.shape[2] != 3 or not values.size:
        raise SceneError(f"{label} is an array {values.shape} of {values.dtype}, expected (H, W, 3), float or uint8")
    if values.dtype.kind == "u":
        return (values.astype(np.float32) / np.float32(np.iinfo(values.dtype).max)).astype(np.float32)
    bad = int(np.count_nonzero(~np.isfinite(values).all(axis=2)))
    if bad:
        raise SceneError(f"{label} has {bad:,} pixels that are NaN or infinite: set them to 0 and mask them")
    return values.astype(np.float32)


def _camera_of_size(label: str, camera: Camera, width: int, height: int) -> Camera:
    """Returns the camera scaled to the size of its image; ``label`` names the image in the error.

    Raises:
        SceneError: Camera and image have different aspect ratios.
    """
    if abs(height - width * camera.height / camera.width) > _ASPECT_ERROR * max(1.0, height / camera.height):
        raise SceneError(
            f"{label} is {width} x {height}, but its camera {camera.name or '(unnamed)'} is {camera.width} x "
            f"{camera.height}, another aspect ratio: crop the image, or give the camera that took it"
        )
    return camera.scaled(width, height)


def _mask(label: str, mask: Any, size: tuple[int, ...]) -> Flags:
    """Returns a mask, (H, W), of the pixels in which the user's mask image is at least half white.

    Raises:
        SceneError: The mask has another size than its image.
    """
    values: npt.NDArray[Any] = np.asarray(mask) if _path_of(mask) is None else read_display_image(mask)
    if values.dtype == np.uint8:
        values = values / 255.0
    if values.ndim == 3:
        values = values.mean(axis=2)
    if values.shape != size:
        raise SceneError(f"the mask of {label} has shape {values.shape}, expected {size}, as the image")
    return values >= 0.5


FIT_SAMPLES_OF_PATHS = 64
"""Samples per pixel for each light in path-traced fits. In images of 128 x 96 pixels, this number determines the power
of a light to a few thousandths."""

SMOOTH_REACH = 1.0 / 32.0
"""Half the side of the square of pixels over which indirect light is averaged, as a fraction of the render's longer
side. For a light in a room with bounces, at 64 pixels, twice this size gave an error of 2.8 % instead of 1.4 %."""

SMOOTH_COSINE_MIN = 0.9
"""Smallest cosine between the normals of two pixels that count as showing one surface."""

SMOOTH_PLANE = 0.2
"""Two pixels show one surface only if the point of the second lies near the tangent plane of the first: the distance
from the plane is at most this times the distance between the two points."""

SMOOTH_ROUGHNESS_MIN = 0.3
"""Smallest roughness of materials whose indirect light is averaged over neighbouring pixels: reflections in smoother
materials have sharp edges."""

SMOOTH_ALBEDO_MIN = 0.02
"""Lower bound of the albedo by which indirect light is divided before it is averaged. The average is multiplied by the
albedo again; textures thus stay sharp."""

Layer = Callable[[Scene, Frame], Doubles]
"""Function that returns the linear radiance of a scene's rendered frame, such as that due to one light, shape (H, W,
3)."""
_Instances = tuple[tuple[SplatInstance, ...], tuple[MeshInstance, ...]]
_PATH_AOVS = ("lights", "albedo", "direct_diffuse", "direct_glossy", "emission")
_DISABLED_LIGHT = LightPoint((0.0, 0.0, 0.0), enabled=False)
"""Disabled light that is added to scenes without lights, so that the renderer adds no headlight."""
_UNLIT_WEIGHT_MAX = 1e-3
"""A pixel is fitted only if unlit captures and background cover less than this fraction of the pixel."""


class LightLayers:
    """Renders what single lights add to the N pixels of all images of a fit.

    Args:
        config: How light is rendered; None: path tracing.
        device: As for ``create_renderer``.
        share: Fraction of the settings' samples per pixel that renders use, at most 1.
        rendered: Called after each render of all images, for the progress bar.
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
            raise ConfigError(
                "Pipeline.REALTIME gathers light over many frames: use Pipeline.PATH, which it approximates"
            )
        self.is_path = base.pipeline.traces_paths
        samples = base.samples or (FIT_SAMPLES_OF_PATHS if self.is_path else None)
        half = None if samples is None else max(1, round(0.5 * share * samples))
        settled = {"background": (0.0, 0.0, 0.0), "lighting": True, "samples": half, "adaptive": False}
        without = {"time_limit": None, "noise": None, "aovs": _PATH_AOVS if self.is_path else ()}
        self.config = replace(base, **settled, **without)
        self._device, self._rendered = device, rendered
        self._renderers: list[Renderer] = []
        self._smooth: dict[tuple[object, ...], tuple[_Instances, SurfaceAverage]] = {}
        """Cached neighbourhoods for averaging, by the camera's size and pose, each with the scene's instances for
        which it was computed."""
        self._is_random = self.is_path or base.raster.strategy is RasterStrategy.STOCHASTIC

    def lit_pixels(self, scene: Scene, images: Sequence[FitImage]) -> Flags:
        """Returns which of N pixels show only surfaces that reflect light, and no unlit capture or background, (N,)."""
        frames = self._frames(0, _with_lights(scene, ()), images)
        weights = [np.asarray(frame.captured_weight).ravel() for frame in frames]
        return np.concatenate(weights) < _UNLIT_WEIGHT_MAX

    def render(self, scene: Scene, lights: Sequence[Light], images: Sequence[FitImage]) -> Doubles:
        """Renders emission plus the light of ``lights`` alone at the N pixels of all images, linear, shape (2, N, 3).

        The first axis holds two renders with independent random numbers, or the same deterministic render twice.
        """
        return self._both(_with_lights(scene, lights), images, self._all_light)

    def render_light(self, scene: Scene, light: Light, images: Sequence[FitImage], fixed: Doubles) -> Doubles:
        """Renders the radiance that one light alone adds at the N pixels of all images.

        Args:
            scene: The scene.
            light: The light.
            images: Images whose pixels are rendered.
            fixed: Render of the scene without lights, shape (2, N, 3).

        Returns:
            Two renders with independent random numbers, or one deterministic one twice, linear, shape (2, N, 3).
        """
        lit = _with_lights(scene, (light,))
        if self.is_path:  # the light's own layer; a difference of renders would add noise
            return self._both(lit, images, self._single_light)
        return self._both(lit, images, self._all_light) - fixed

    def _both(self, scene: Scene, images: Sequence[FitImage], layer: Layer) -> Doubles:
        """Renders a layer of all images with two seeds, (2, N, 3); a deterministic render is made once, and copied."""
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
        """Returns a frame's radiance due to all its lights, (H, W, 3), with indirect light averaged over surfaces."""
        light = np.asarray(frame.light, np.float64)
        if not self.is_path:
            return light
        first = sum(
            np.asarray(part, np.float64) for part in (frame.direct_diffuse, frame.direct_glossy, frame.emission)
        )
        return first + self._averaged(scene, frame, light - first)

    def _single_light(self, scene: Scene, frame: Frame) -> Doubles:
        """Returns a frame's radiance due to its first light, (H, W, 3), with indirect light averaged over surfaces."""
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
    """Returns the light with a colour of (1, 1, 1) and an intensity of 1."""
    return replace(light, color=(1.0, 1.0, 1.0), intensity=1.0)


def power_of(light: Light) -> Doubles:
    """Returns colour times intensity, shape (3,)."""
    return np.array(light.color, np.float64) * light.intensity


def with_power(light: Light, power: Doubles) -> Light:
    """Returns the light with the given ``power`` (colour times intensity); the brightest channel of its colour is 1.

    With power 0 the intensity becomes 0, and the colour stays.
    """
    brightest = float(power.max())
    if brightest <= 0.0:
        return replace(light, intensity=0.0)
    return replace(light, color=tuple(power / brightest), intensity=brightest)


def _with_lights(scene: Scene, lights: Sequence[Light]) -> Scene:
    return replace(scene, lights=tuple(lights) or (_DISABLED_LIGHT,))


_Number = TypeVar("_Number", bound=np.generic)


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceAverage:
    """Lists, for each pixel of a view, the nearby pixels on its surface; indirect light is averaged over them."""

    albedo: Doubles
    """Divisor of light before averaging: the albedo, at least `SMOOTH_ALBEDO_MIN`, shape (H, W, 3)."""
    offsets: tuple[tuple[int, int], ...]
    """Row and column offsets of the D neighbours of a pixel, itself included."""
    same_surface: Flags
    """True where a pixel's neighbour, at one of D ``offsets``, lies on the pixel's own surface, shape (D, H, W)."""

    @classmethod
    def of(cls, scene: Scene, frame: Frame) -> SurfaceAverage:
        """Finds each pixel's neighbours on the same surface, from a frame's positions, normals and instance indices."""
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
        """Averages light, (H, W, 3), over the neighbours on each pixel's surface, without blurring the albedo."""
        arriving = light / self.albedo
        total = np.zeros_like(arriving)
        for offset, same_surface in zip(self.offsets, self.same_surface, strict=True):
            total += np.where(same_surface[..., None], _shifted(arriving, offset), 0.0)
        return total / self.same_surface.sum(axis=0)[..., None] * self.albedo


def _matt_surfaces(scene: Scene, instances: IntArray) -> IntArray:
    """Returns the index of each pixel's instance; -1 for background and for roughness below `SMOOTH_ROUGHNESS_MIN`."""
    materials = [instance.material for instance in scene.splats] + [item.mesh.material for item in scene.meshes]
    matt = np.array([*(_is_matt(material) for material in materials), False])
    return np.where(matt[instances], instances, -1).astype(np.int32)


def _is_matt(material: Material | None) -> bool:
    return not isinstance(material, MaterialPbr) or material.mesh_roughness >= SMOOTH_ROUGHNESS_MIN


def _shifted(image: npt.NDArray[_Number], offset: tuple[int, int]) -> npt.NDArray[_Number]:
    """Returns for each pixel the value ``offset`` (rows, columns) away; offsets wrap around at the image's borders."""
    return np.roll(image, (-offset[0], -offset[1]), axis=(0, 1))


def _inside_image(image: IntArray, offset: tuple[int, int]) -> Flags:
    """Returns for each pixel whether the pixel ``offset`` (rows, columns) away is inside the image."""
    height, width = image.shape
    inside = np.zeros((height, width), np.bool_)
    down, across = offset
    inside[max(-down, 0) : height - max(down, 0), max(-across, 0) : width - max(across, 0)] = True
    return inside
