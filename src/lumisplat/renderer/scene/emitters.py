"""The triangles that shine on the device, so that paths sample them as lights."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import warp as wp

from lumisplat.constants import LIGHT_POWER_MAX, LUMINANCE, SPAWN_ERROR, SPAWN_SLENDER
from lumisplat.device.structs.shading import EmitterData, EmitterTriangle
from lumisplat.math.arrays import Doubles
from lumisplat.math.color import decode_srgb
from lumisplat.renderer.scene.lights import cumulative_shares
from lumisplat.runtime.buffers import Buffers
from lumisplat.runtime.struct_tables import table_dtype
from lumisplat.scene.materials import MaterialPbr, wraps_of
from lumisplat.scene.mesh import Mesh
from lumisplat.scene.sampling.surface_points import wrapped
from lumisplat.scene.scene import MeshInstance, Scene
from lumisplat.scene.textures import WrapPair

_INSIDE = np.array([[1, 1, 1], [4, 1, 1], [1, 4, 1], [1, 1, 4]]) / np.array([[3], [6], [6], [6]])
"""Barycentric weights of the points at which textures are looked up."""
_DARK_SHARE = 0.05
"""Of the brightest texel: no triangle of a texture is taken for darker."""


class Emitters:
    """The triangles that shine, uploaded when they change."""

    def __init__(self) -> None:
        self.data = EmitterData()
        self._key: object = None

    def sync(self, scene: Scene, buffers: Buffers) -> None:
        """Writes the table of a scene."""
        shining = [(number, instance) for number, instance in enumerate(scene.meshes) if shines(instance)]
        placed = [(number, id(instance.mesh), instance.transform.tobytes()) for number, instance in shining]
        key = placed, len(scene.meshes)
        if key == self._key:
            return
        self._key, data = None, self.data  # a failed upload does not count as finished
        first = np.full(max(len(scene.meshes), 1), -1, np.int32)
        first[[number for number, _ in shining]] = np.cumsum([0, *(i.mesh.face_count for _, i in shining)])[:-1]
        powers = [powers_of(instance) for _, instance in shining]
        power = np.concatenate(powers) if powers else np.zeros(0)
        numbers = np.repeat([number for number, _ in shining], [len(values) for values in powers]).astype(np.int32)
        data.first = buffers.upload("emitters.first", wp.int32, first)
        data.power = float(min(power.sum(), LIGHT_POWER_MAX))
        ends = cumulative_shares(power) if data.power > 0.0 else np.zeros(0, np.float32)
        data.ends = buffers.upload("emitters.ends", wp.float32, ends)
        data.instances = buffers.upload("emitters.instances", wp.int32, numbers)
        tables = [triangles_of(instance) for _, instance in shining]
        rows = np.concatenate(tables) if tables else np.zeros(0, table_dtype(EmitterTriangle))
        data.triangles = buffers.upload("emitters.triangles", EmitterTriangle, rows)
        if data.power > 0.0:
            centers = np.concatenate([_centers(instance) for _, instance in shining])
            center = np.average(centers, axis=0, weights=power)
            data.center = wp.vec3(*center)
            spread = np.average(((centers - center) ** 2).sum(axis=1), weights=power)
            data.radius = float(np.sqrt(spread + _mean_area(shining)))
        self._held = [instance for _, instance in shining]  # so that no other mesh gets its id
        self._key = key


def shines(instance: MeshInstance) -> bool:
    """Whether a mesh instance emits light."""
    return instance.mesh.material.is_emissive


def powers_of(instance: MeshInstance) -> Doubles:
    """Luminance times area of an instance's triangles, about, shape (F,)."""
    mesh, material = instance.mesh, instance.mesh.material
    emitted = np.array(material.emissive, np.float64)
    if not isinstance(material, MaterialPbr):
        emitted = emitted + np.array(material.ambient)
    brightness = np.full(mesh.face_count, float(emitted @ np.array(LUMINANCE)))
    texture = material.emissive_texture if isinstance(material, MaterialPbr) else None
    if texture is not None and mesh.uvs is not None:
        brightness *= _texture_means(mesh, texture, wraps_of(material, "emissive_texture"))
    return brightness * _areas(instance)


def triangles_of(instance: MeshInstance) -> npt.NDArray[np.void]:
    """An instance's triangles as paths sample them, shape (F,); of rounding errors, each has its largest."""
    corners = _corners(instance)
    edges = corners[:, 1:] - corners[:, :1]
    across = np.cross(edges[:, 0], edges[:, 1])
    area = np.linalg.norm(across, axis=1)
    area[area < np.finfo(np.float32).tiny] = np.inf  # without a place above: it has no power either
    error = _rounding_error(instance, across / area[:, None])
    # Opposite the corners.
    sides = np.linalg.norm(np.stack([edges[:, 1] - edges[:, 0], edges[:, 1], edges[:, 0]], axis=1), axis=2)
    longest = sides.max(axis=1)
    error += SPAWN_ERROR / 16.0 * longest * np.minimum(longest**2 / area, SPAWN_SLENDER)
    rows = np.zeros(len(corners), table_dtype(EmitterTriangle))
    rows["corner"], rows["edge1"], rows["edge2"], rows["across"] = corners[:, 0], edges[:, 0], edges[:, 1], across
    rows["lift"] = error / area
    # A corner's height over the opposite side is twice the area over that side.
    rows["inside"] = np.minimum(2.0 * (error / area)[:, None] * sides, 0.25)
    return rows


def _rounding_error(instance: MeshInstance, normals: Doubles) -> Doubles:
    """How far off their planes hits on an instance's triangles may be, shape (F,); see ``spawn_point``."""
    world_from_object = instance.transform[:3, :3]
    local = instance.mesh.positions.astype(np.float64)[instance.mesh.indices]
    offsets = local @ world_from_object.T
    # Of each triangle, the largest coordinates: those of corners.
    sizes = 2.0 * np.abs(instance.transform[:3, 3]) + np.abs(offsets).max(axis=1)
    sizes += np.abs(local).max(axis=1) @ np.abs(world_from_object).T
    local_sizes = np.abs(local[:, 0]) + np.abs(local[:, 1:] - local[:, :1]).sum(axis=1)
    local_sizes += np.abs(offsets).max(axis=1) @ np.abs(np.linalg.inv(world_from_object)).T
    error: Doubles = (np.abs(normals) * sizes).sum(axis=1) + (np.abs(normals @ world_from_object) * local_sizes).sum(
        axis=1
    )
    return SPAWN_ERROR * error


def _texture_means(mesh: Mesh, texture: npt.NDArray[np.uint8], wraps: WrapPair) -> Doubles:
    """Luminance of a texture, mean over some points of each triangle, shape (F,)."""
    assert mesh.uvs is not None
    points = np.einsum("pc,fcx->fpx", _INSIDE, mesh.uvs[mesh.indices])
    height, width = texture.shape[:2]
    columns, rows = (
        np.minimum(wrapped(points[..., k], wraps[k]) * size, size - 1).astype(int)
        for k, size in ((0, width), (1, height))
    )
    luminance = decode_srgb(texture[rows, columns, :3].astype(np.float64) / 255.0) @ np.array(LUMINANCE)
    means: Doubles = luminance.mean(axis=1)
    return np.maximum(means, _DARK_SHARE * means.max(initial=0.0))


def _corners(instance: MeshInstance) -> Doubles:
    """World-space corners of the triangles, shape (F, 3, 3)."""
    world = instance.mesh.positions.astype(np.float64) @ instance.transform[:3, :3].T + instance.transform[:3, 3]
    corners: Doubles = world[instance.mesh.indices]
    return corners


def _areas(instance: MeshInstance) -> Doubles:
    corners = _corners(instance)
    edges = corners[:, 1:] - corners[:, :1]
    return 0.5 * np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)


def _centers(instance: MeshInstance) -> Doubles:
    return _corners(instance).mean(axis=1)


def _mean_area(shining: list[tuple[int, MeshInstance]]) -> float:
    """Of their triangles."""
    return float(np.concatenate([_areas(instance) for _, instance in shining]).mean())
