"""Captures that real-time frames sample as lights (docs/adr/0097-emissive-captures-are-sampled-as-lights.md)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from lumisplat.constants import LUMINANCE, SH_C0
from lumisplat.device.gi.captured_emitters import EmitterBox
from lumisplat.device.structs.scene import SplatInstanceData
from lumisplat.math.arrays import Doubles
from lumisplat.math.color import decode_srgb
from lumisplat.math.transforms import matrices_from_quaternions
from lumisplat.renderer.scene.assets import AssetCache
from lumisplat.renderer.scene.materials import is_relit
from lumisplat.runtime.buffers import Buffers, DeviceArray
from lumisplat.runtime.struct_tables import table_dtype
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.mesh import Mesh
from lumisplat.scene.scene import Scene, SplatInstance

EMITTER_BOXES = 16
"""Largest number of boxes that enclose parts of an emissive capture when it is sampled as a light."""

EMITTER_REACH = 3.0
"""Number of standard deviations of each Gaussian that the boxes around an emissive capture enclose."""

EMITTER_FLAT = 1e-3
"""Shortest edge of a box as a fraction of its longest, so that the volume of a flat box exceeds rounding errors."""

EMITTER_FLOOR = 0.05
"""Power of the box around a whole capture, as a fraction of the other boxes' total. Also the lowest luminance with
which a Gaussian counts, as a fraction of the capture's mean."""

EMITTER_GAUSSIANS = 16_384
"""Largest number of Gaussians of an emissive capture that are read to compute the boxes around the capture."""

EMITTER_RECEIVERS = 1024
"""Largest number of triangles or Gaussians of a lit object that are sampled to decide whether a capture counts as a
light or as surrounding scenery.
"""


class Boxes(NamedTuple):
    """K oriented boxes around parts of a capture that is sampled as a light, in object space."""

    centers: Doubles
    """Centre of each of K boxes, shape (K, 3)."""
    axes: Doubles
    """Unit axes of each of K boxes, in rows, shape (K, 3, 3)."""
    halves: Doubles
    """Half edge lengths of each of K boxes, shape (K, 3)."""
    powers: Doubles
    """Approximate power of each of K boxes, luminance times area of its Gaussians, shape (K,)."""


class CapturedEmitters:
    """Finds the captures that are sampled as lights, and writes their tables when they change."""

    def __init__(self) -> None:
        self.boxes: DeviceArray | None = None
        """Table of the boxes (EmitterBox) around captures that are sampled as lights; None: there are no such
        captures."""
        self.marked: DeviceArray | None = None
        """Copy of the scene's splat instances with another ``relit`` flag: 1 for captures sampled as lights, else 0.
        The tracer accumulates the radiance of flagged captures separately. None: there are no such captures."""
        self.instances: tuple[int, ...] = ()
        """Indices of the splat instances that are sampled as lights."""
        self._boxes: AssetCache[Boxes] = AssetCache(boxes_of)
        self._bounds: AssetCache[Doubles] = AssetCache(bounds_of)
        self._points: AssetCache[Doubles] = AssetCache(_sample_points)

    def sync(self, scene: Scene, splats: np.ndarray, buffers: Buffers) -> None:
        """Writes the tables of a scene; ``splats`` holds its splat instances as rows of SplatInstanceData."""
        emissive = [number for number, instance in enumerate(scene.splats) if not is_relit(instance)]
        receivers = self._receivers(scene) if emissive else np.zeros((0, 4))
        bounds = self._bounds.of([scene.splats[number].gaussians for number in emissive])
        candidates = zip(emissive, bounds, strict=True)
        lights = [number for number, box in candidates if is_separate_emitter(scene.splats[number], box, receivers)]
        self.instances = tuple(lights)
        emitters = [scene.splats[number] for number in lights]
        boxes = self._boxes.of([emitter.gaussians for emitter in emitters])
        if not lights:
            self.boxes = self.marked = None
            return
        rows = np.concatenate([_world_rows(emitter, its) for emitter, its in zip(emitters, boxes, strict=True)])
        self.boxes = buffers.upload("captured_emitters", EmitterBox, rows)
        marked = splats.copy()
        marked["relit"] = np.isin(np.arange(len(marked)), lights)
        self.marked = buffers.upload("captured_emitters.marked", SplatInstanceData, marked)

    def _receivers(self, scene: Scene) -> Doubles:
        """Returns world-space sample points on lit surfaces, and the area that each of N points stands for, (N, 4)."""
        assets = [(instance.mesh, instance.transform) for instance in scene.meshes]
        assets += [(instance.gaussians, instance.transform) for instance in scene.splats if is_relit(instance)]
        points = self._points.of([asset for asset, _ in assets])
        rows = [np.zeros((0, 4))]
        for (_, world_from_object), local in zip(assets, points, strict=True):
            linear = world_from_object[:3, :3]
            stretch = abs(float(np.linalg.det(linear))) ** (2.0 / 3.0)
            rows.append(np.column_stack([local[:, :3] @ linear.T + world_from_object[:3, 3], stretch * local[:, 3]]))
        return np.concatenate(rows)


def is_separate_emitter(instance: SplatInstance, bounds: Doubles, receivers: Doubles) -> bool:
    """Returns whether a capture counts as a light: most lit surface area is outside the capture.

    Otherwise the capture counts as scenery that surrounds the lit surfaces.

    Args:
        instance: The capture.
        bounds: Lower and upper corner of a box around the capture, object space, shape (2, 3).
        receivers: N world-space sample points on lit surfaces, and the area that each point represents, shape (N, 4).
    """
    if not len(receivers):
        return False
    world_from_object = instance.transform
    local = (receivers[:, :3] - world_from_object[:3, 3]) @ np.linalg.inv(world_from_object[:3, :3]).T
    inside = ((local > bounds[0]) & (local < bounds[1])).all(axis=1)
    return bool(receivers[inside, 3].sum() < 0.5 * receivers[:, 3].sum())


def boxes_of(gaussians: Gaussians) -> Boxes:
    """Returns boxes around parts of a capture; the first encloses the whole capture, so that no direction is left out.

    The part with the largest luminance times area is split first, at the median of its power.
    """
    step = max(1, -(-gaussians.count // EMITTER_GAUSSIANS))
    means = gaussians.means[::step].astype(np.float64)
    scales = gaussians.scales[::step].astype(np.float64)
    rotations = matrices_from_quaternions(gaussians.rotations_wxyz[::step].astype(np.float64))
    shown = decode_srgb(np.clip(gaussians.sh[::step, 0].astype(np.float64) * SH_C0 + 0.5, 0.0, None))
    luminance = shown @ np.array(LUMINANCE)
    luminance = np.maximum(luminance, EMITTER_FLOOR * max(float(luminance.mean()), 1e-6))
    low_to_high = np.sort(scales, axis=1)
    areas = 2.0 * np.pi * gaussians.opacities[::step].astype(np.float64) * low_to_high[:, 1] * low_to_high[:, 2]
    spread = rotations * scales[:, None, :]
    builder = _GaussianBoxes(means, spread, luminance, np.maximum(areas, 1e-30))
    parts = [builder.box(np.arange(len(means)))]
    while len(parts) < EMITTER_BOXES:
        largest = max(range(len(parts)), key=lambda k: parts[k].power if len(parts[k].members) > 1 else 0.0)
        if len(parts[largest].members) < 2:
            break
        parts += builder.halves(parts.pop(largest))
    enclosing = _enclosing_box(gaussians, EMITTER_FLOOR * sum(box.power for box in parts))
    return Boxes(
        np.stack([enclosing.center, *(box.center for box in parts)]),
        np.stack([enclosing.axes, *(box.axes for box in parts)]),
        np.stack([enclosing.half, *(box.half for box in parts)]),
        np.array([enclosing.power, *(box.power for box in parts)]),
    )


class _Box(NamedTuple):
    center: Doubles
    axes: Doubles
    half: Doubles
    power: float
    members: npt.NDArray[np.integer]


class _GaussianBoxes(NamedTuple):
    """Gaussians of a capture, and methods that enclose subsets of the Gaussians in oriented boxes."""

    means: Doubles
    spread: Doubles
    """Principal axes of each of N Gaussians as columns whose length is the standard deviation, shape (N, 3, 3)."""
    luminance: Doubles
    areas: Doubles

    def box(self, members: npt.NDArray[np.integer]) -> _Box:
        """Returns a box around the Gaussians with indices ``members``, along the principal axes of their means."""
        means, weights = self.means[members], self.areas[members]
        offsets = means - np.average(means, axis=0, weights=weights)
        axes = np.linalg.eigh(np.einsum("n,nx,ny->xy", weights / weights.sum(), offsets, offsets))[1].T
        along = means @ axes.T
        reach = EMITTER_REACH * np.linalg.norm(axes @ self.spread[members], axis=2)
        low, high = (along - reach).min(axis=0), (along + reach).max(axis=0)
        half = 0.5 * (high - low)
        half = np.maximum(half, EMITTER_FLAT * half.max())
        faces = half * np.roll(half, 1)
        covered = min(1.0, float(weights.sum() / (4.0 * faces.max())))
        power = float(np.average(self.luminance[members], weights=weights) * covered * 8.0 * faces.sum())
        return _Box(0.5 * (low + high) @ axes, axes, half, power, members)

    def halves(self, box: _Box) -> list[_Box]:
        """Splits a box's Gaussians across its longest axis into halves of equal power; returns a box around each."""
        along = self.means[box.members] @ box.axes[int(box.half.argmax())]
        order = np.argsort(along, kind="stable")
        power: Doubles = np.cumsum((self.luminance * self.areas)[box.members][order])
        middle = min(max(int((power < 0.5 * power[-1]).sum()), 1), len(order) - 1)
        return [self.box(box.members[order[:middle]]), self.box(box.members[order[middle:]])]


def _enclosing_box(gaussians: Gaussians, power: float) -> _Box:
    low, high = _bounds(gaussians, 1)
    return _Box(0.5 * (low + high), np.eye(3), 0.5 * (high - low), power, np.zeros(0, np.int64))


def bounds_of(gaussians: Gaussians) -> Doubles:
    """Returns lower and upper corner of a box around a capture, object space, shape (2, 3), from a part of it."""
    return _bounds(gaussians, max(1, -(-gaussians.count // EMITTER_GAUSSIANS)))


def _bounds(gaussians: Gaussians, step: int) -> Doubles:
    """Returns lower and upper corner of a box around every ``step``-th Gaussian, shape (2, 3)."""
    means = gaussians.means[::step]
    reach = EMITTER_REACH * gaussians.scales[::step].max(axis=1, keepdims=True)
    return np.stack([(means - reach).min(axis=0), (means + reach).max(axis=0)]).astype(np.float64)


def _world_rows(instance: SplatInstance, boxes: Boxes) -> np.ndarray:
    """Returns the table rows of a capture's boxes, transformed to world space."""
    rows = np.zeros(len(boxes.powers), table_dtype(EmitterBox))
    linear = instance.transform[:3, :3]
    rows["center"] = boxes.centers @ linear.T + instance.transform[:3, 3]
    rows["box_from_world"] = boxes.axes @ (linear / instance.scale).T
    rows["half"] = instance.scale * boxes.halves
    rows["power"] = instance.scale**2 * boxes.powers
    return rows


_TRIANGLE_POINTS = np.array([[1.0, 1.0, 1.0], [2.0, 0.5, 0.5], [0.5, 2.0, 0.5], [0.5, 0.5, 2.0]]) / 3.0
"""Barycentric coordinates of four sample points in a triangle; each point represents a quarter of the area."""


def _sample_points(asset: Mesh | Gaussians) -> Doubles:
    """Returns N sample points on a mesh or Gaussians, object space, and the area that each represents, (N, 4)."""
    if isinstance(asset, Mesh):
        step = max(1, -(-asset.face_count // EMITTER_RECEIVERS))
        corners = asset.positions.astype(np.float64)[asset.indices[::step]]
        sides = corners[:, 1:] - corners[:, :1]
        areas = 0.5 * np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
        # Large triangles extend far: four points represent each.
        points = np.einsum("pc,fcx->pfx", _TRIANGLE_POINTS, corners).reshape(-1, 3)
        return np.column_stack([points, step * np.tile(0.25 * areas, len(_TRIANGLE_POINTS))])
    step = max(1, -(-asset.count // EMITTER_RECEIVERS))
    scales = np.sort(asset.scales[::step].astype(np.float64), axis=1)
    return np.column_stack([asset.means[::step].astype(np.float64), step * 2.0 * np.pi * scales[:, 1] * scales[:, 2]])
