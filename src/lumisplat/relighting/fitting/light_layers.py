"""Renders what each light contributes to the images' pixels, alone, with bounced light denoised over surfaces."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from lumisplat.config import Pipeline, RasterStrategy, RenderConfig
from lumisplat.errors import ConfigError
from lumisplat.frame.frame import Frame
from lumisplat.math.arrays import Doubles, Flags, IntArray
from lumisplat.relighting.fitting.images import FitPhotograph
from lumisplat.renderer.renderer import Renderer, create_renderer
from lumisplat.scene.lights import Light, LightPoint
from lumisplat.scene.materials import Material, MaterialPbr
from lumisplat.scene.scene import MeshInstance, Scene, SplatInstance

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
_Things = tuple[tuple[SplatInstance, ...], tuple[MeshInstance, ...]]
_PATH_AOVS = ("lights", "albedo", "direct_diffuse", "direct_glossy", "emission")
_NOTHING = LightPoint((0.0, 0.0, 0.0), enabled=False)
"""Keeps the headlight away from scenes without lights."""
_KEPT = 1e-3
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
        self._smooth: dict[tuple[object, ...], tuple[_Things, SmoothLight]] = {}
        """By view: the things of the last scene, and which pixels are on one surface."""
        self._is_random = self.is_path or base.raster.strategy is RasterStrategy.STOCHASTIC

    def shown(self, scene: Scene, photographs: Sequence[FitPhotograph]) -> Flags:
        """Which pixels show what lights light, shape (N,)."""
        frames = self._frames(0, _with_lights(scene, ()), photographs)
        weights = [np.asarray(frame.captured_weight).ravel() for frame in frames]
        return np.concatenate(weights) < _KEPT

    def picture(self, scene: Scene, lights: Sequence[Light], photographs: Sequence[FitPhotograph]) -> Doubles:
        """Linear light of a scene under these lights alone, what shines by itself included, shape (2, N, 3)."""
        return self._both(_with_lights(scene, lights), photographs, self._whole)

    def alone(self, scene: Scene, light: Light, photographs: Sequence[FitPhotograph], fixed: Doubles) -> Doubles:
        """Linear light that one light adds.

        Args:
            scene: The scene.
            light: The light.
            photographs: Say which pixels.
            fixed: The picture without lights.

        Returns:
            Shape (2, N, 3).
        """
        lit = _with_lights(scene, (light,))
        if self.is_path:  # its own layer: what else shines would only bring noise
            return self._both(lit, photographs, self._own)
        return self._both(lit, photographs, self._whole) - fixed

    def _both(self, scene: Scene, photographs: Sequence[FitPhotograph], layer: Layer) -> Doubles:
        """A layer rendered with two seeds; a single time, if it is not random."""
        first = self._frames(0, scene, photographs)
        rows = self._rows(scene, first, layer)
        second = rows
        if self._is_random or any(frame.samples > 1 for frame in first):
            second = self._rows(scene, self._frames(1, scene, photographs), layer)
        self._rendered()
        return np.stack([rows, second])

    def _rows(self, scene: Scene, frames: Sequence[Frame], layer: Layer) -> Doubles:
        return np.concatenate([layer(scene, frame).reshape(-1, 3) for frame in frames])

    def _frames(self, half: int, scene: Scene, photographs: Sequence[FitPhotograph]) -> list[Frame]:
        while len(self._renderers) <= half:
            seed = (self.config.seed + 7919 * len(self._renderers)) % 2**32
            self._renderers.append(create_renderer(replace(self.config, seed=seed), self._device))
        return [self._renderers[half].render(scene, replace(one.camera, exposure=0.0)) for one in photographs]

    def _whole(self, scene: Scene, frame: Frame) -> Doubles:
        """All light, what has bounced averaged."""
        light = np.asarray(frame.light, np.float64)
        if not self.is_path:
            return light
        first = sum(
            np.asarray(part, np.float64) for part in (frame.direct_diffuse, frame.direct_glossy, frame.emission)
        )
        return first + self._averaged(scene, frame, light - first)

    def _own(self, scene: Scene, frame: Frame) -> Doubles:
        """The light of the only light, what has bounced averaged."""
        assert frame.light_total is not None and frame.light_direct is not None and frame.light_shadow is not None
        first = np.asarray(frame.light_direct[0] * frame.light_shadow[0], np.float64)
        return first + self._averaged(scene, frame, frame.light_total[0] - first)

    def _averaged(self, scene: Scene, frame: Frame, bounced: Doubles) -> Doubles:
        key = (frame.camera.width, frame.camera.height, frame.camera.camera_from_world.tobytes())
        things = scene.splats, scene.meshes
        held = self._smooth.get(key)
        if held is None or held[0] != things:
            held = self._smooth[key] = things, SmoothLight.of(scene, frame)
        return held[1].averaged(bounced)


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
    return replace(scene, lights=tuple(lights) or (_NOTHING,))


_Number = TypeVar("_Number", bound=np.generic)


@dataclass(frozen=True, slots=True, eq=False)
class SmoothLight:
    """Which pixels of a view are on one surface."""

    albedo: Doubles
    """By which light is divided before, (H, W, 3)."""
    offsets: tuple[tuple[int, int], ...]
    """Rows and columns to neighbours."""
    together: Flags
    """Whether each neighbour is on the pixel's surface, (offsets, H, W)."""

    @classmethod
    def of(cls, scene: Scene, frame: Frame) -> SmoothLight:
        """Of a frame with albedo."""
        assert frame.albedo is not None
        radius = max(1, round(SMOOTH_REACH * max(frame.camera.width, frame.camera.height)))
        reach = range(-radius, radius + 1)
        offsets = tuple((down, across) for down in reach for across in reach)
        position, normal = np.asarray(frame.position, np.float64), np.asarray(frame.normal, np.float64)
        surface = _matt_surfaces(scene, np.asarray(frame.instance_index))
        together = np.zeros((len(offsets), *surface.shape), np.bool_)
        for row, offset in enumerate(offsets):
            away = _shifted(position, offset) - position
            apart = np.abs((away * normal).sum(axis=2))
            flat = apart <= SMOOTH_PLANE * np.linalg.norm(away, axis=2) + 1e-9
            alike = (_shifted(normal, offset) * normal).sum(axis=2) >= SMOOTH_COSINE_MIN
            together[row] = (
                (_shifted(surface, offset) == surface) & (surface >= 0) & flat & alike & _inside(surface, offset)
            )
            if offset == (0, 0):
                together[row] = True
        albedo = np.maximum(np.asarray(frame.albedo, np.float64), SMOOTH_ALBEDO_MIN)
        return cls(albedo, offsets, together)

    def averaged(self, light: Doubles) -> Doubles:
        """Light of the view, (H, W, 3), averaged over each pixel's surface nearby."""
        arriving = light / self.albedo
        total = np.zeros_like(arriving)
        for offset, together in zip(self.offsets, self.together, strict=True):
            total += np.where(together[..., None], _shifted(arriving, offset), 0.0)
        return total / self.together.sum(axis=0)[..., None] * self.albedo


def _matt_surfaces(scene: Scene, instances: IntArray) -> IntArray:
    """The instance that each pixel shows; -1 where there is none, or what it reflects is sharp."""
    materials = [instance.material for instance in scene.splats] + [one.mesh.material for one in scene.meshes]
    matt = np.array([*(_is_matt(material) for material in materials), False])
    return np.where(matt[instances], instances, -1).astype(np.int32)


def _is_matt(material: Material | None) -> bool:
    return not isinstance(material, MaterialPbr) or material.roughness >= SMOOTH_ROUGHNESS_MIN


def _shifted(image: npt.NDArray[_Number], offset: tuple[int, int]) -> npt.NDArray[_Number]:
    """What stands at an offset from each pixel; rows and columns go round."""
    return np.roll(image, (-offset[0], -offset[1]), axis=(0, 1))


def _inside(image: IntArray, offset: tuple[int, int]) -> Flags:
    """Whether an offset from each pixel leads to one of the image."""
    height, width = image.shape
    inside = np.zeros((height, width), np.bool_)
    down, across = offset
    inside[max(-down, 0) : height - max(down, 0), max(-across, 0) : width - max(across, 0)] = True
    return inside
