"""Light that has bounced, without most of the noise of paths: the mean over neighbours on the same surface.

Its noise is rare and bright, so that most pixels are too dark: robust weights would take the bright ones for what the
scene lacks, and lights come out too strong. Light that has bounced off matt surfaces changes slowly.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from lumisplat.constants.light_fit import (
    SMOOTH_ALBEDO_MIN,
    SMOOTH_COSINE_MIN,
    SMOOTH_PLANE,
    SMOOTH_REACH,
    SMOOTH_ROUGHNESS_MIN,
)
from lumisplat.frame.frame import Frame
from lumisplat.math.arrays import Doubles, Flags, IntArray
from lumisplat.scene.materials import Material, MaterialPbr
from lumisplat.scene.scene import Scene

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
