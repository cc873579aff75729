"""Intersects pixels with planes in float64, as input of real-time passes."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
import warp as wp

import lumisplat as ls
from lumisplat.device.gi.surfaces import SequenceData, SurfacePixels
from lumisplat.device.structs.camera import CameraData
from lumisplat.renderer.scene.camera_table import CENTER, camera_table
from lumisplat.renderer.scene.motion import previous_image
from lumisplat.runtime.buffers import DeviceArray
from lumisplat.runtime.struct_tables import table_dtype, upload_structs

Doubles = npt.NDArray[np.float64]


@dataclass(slots=True)
class VisibleSurfaces:
    """Surfaces at the pixels of a camera, in float64, row by row; fields as in ``SurfacePixels``."""

    camera: ls.Camera
    share: Doubles
    position: Doubles
    normal: Doubles
    distance: Doubles
    extent: Doubles
    previous: Doubles
    face: npt.NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    """Index of the scene's face at each pixel; -1 for none."""
    offset: tuple[float, float] = CENTER
    """Position of the samples within their pixels."""
    alpha: float = 1.0
    """GGX alpha of all highlights."""
    footprint: float = 0.0

    def upload(self, device: str = "cpu") -> SurfacePixels:
        """Returns the struct that kernels read."""
        pixels = SurfacePixels()
        albedo = np.ones_like(self.position)
        for name in ("share", "distance", "extent"):
            setattr(pixels, name, wp.array(getattr(self, name).astype(np.float32), dtype=float, device=device))
        for name in ("position", "normal", "previous"):
            setattr(pixels, name, wp.array(getattr(self, name).astype(np.float32), dtype=wp.vec3, device=device))
        pixels.alpha, pixels.footprint = (
            wp.full(len(albedo), value, float, device=device) for value in (self.alpha, self.footprint)
        )
        pixels.albedo = wp.array(albedo.astype(np.float32), dtype=wp.vec3, device=device)
        return pixels


def sequence_row(
    frame: int, history_weight: float = 1.0, cameras: tuple[ls.Camera, ls.Camera] | None = None
) -> DeviceArray:
    """Returns a frame's number, weight of cached lighting, and ``cameras`` before and now, as kernels read them."""
    row = SequenceData()
    row.frame, row.history_weight = frame, history_weight
    if cameras:
        row.before = previous_image(*cameras)
    return upload_structs([row], SequenceData, "cpu")


def camera_rows(camera: ls.Camera, device: str = "cpu", offset: tuple[float, float] = CENTER) -> wp.array[CameraData]:
    """Returns the camera's table on the device, with samples at ``offset`` in their pixels."""
    rows = camera_table(camera, offset)
    table = wp.zeros(1, dtype=CameraData, device=device)
    assert rows.dtype == table_dtype(CameraData)
    table.assign(rows)
    return table


def pixel_rays(camera: ls.Camera, offset: tuple[float, float] = CENTER) -> tuple[Doubles, Doubles]:
    """Returns the origin (3,) and the unit directions (H W, 3) of a pinhole's samples at ``offset`` in their pixels."""
    x, y = np.meshgrid(np.arange(camera.width) + offset[0], np.arange(camera.height) + offset[1])
    local = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)], axis=-1)
    directions = local.reshape(-1, 3) @ camera.world_from_camera[:3, :3].T
    return np.asarray(camera.eye, np.float64), directions / np.linalg.norm(directions, axis=1, keepdims=True)


def box_exit(origins: Doubles, directions: Doubles, half: float = 0.5) -> tuple[Doubles, npt.NDArray[np.int64]]:
    """Returns the distance from inside a cube around the origin to its walls, and the wall: 0 for -x, 1 for +x, ..."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = np.where(directions == 0.0, np.inf, (np.copysign(half, directions) - origins) / directions)
    axis = np.argmin(ends, axis=1)
    rows = np.arange(len(directions))
    return ends[rows, axis], 2 * axis + (directions[rows, axis] > 0.0)


def inward(face: npt.NDArray[np.int64]) -> Doubles:
    """Returns inward normals of the cube's walls."""
    normals = np.zeros((len(face), 3))
    normals[np.arange(len(face)), face // 2] = np.where(face % 2, -1.0, 1.0)
    return normals


def visible_box(camera: ls.Camera, extent: float = 0.0, offset: tuple[float, float] = CENTER) -> VisibleSurfaces:
    """Returns the unit cube around the origin as a camera inside sees it."""
    eye, directions = pixel_rays(camera, offset)
    t, face = box_exit(np.broadcast_to(eye, directions.shape), directions)
    position = eye + t[:, None] * directions
    ones = np.ones(len(t))
    return VisibleSurfaces(camera, ones, position, inward(face), t, extent * ones, position.copy(), face, offset)


def visible_plane(
    camera: ls.Camera, normal: npt.ArrayLike, extent: float = 0.0, offset: tuple[float, float] = CENTER
) -> VisibleSurfaces:
    """Returns a plane through the origin; pixels that miss it or see its back have no surface."""
    eye, directions = pixel_rays(camera, offset)
    normal = np.asarray(normal, np.float64)
    facing = directions @ normal
    t = -(eye @ normal) / np.where(facing < -1e-3, facing, 1.0)
    is_visible = (facing < -1e-3) & (t > 0.0)
    position = np.where(is_visible[:, None], eye + t[:, None] * directions, 0.0)
    normals = np.broadcast_to(normal, directions.shape).copy()
    share, distance = is_visible.astype(np.float64), np.where(is_visible, t, 0.0)
    return VisibleSurfaces(
        camera, share, position, normals, distance, np.full(len(t), extent), position.copy(), offset=offset
    )


def tilted(normals: Doubles, degrees: float, seed: int) -> Doubles:
    """Returns normals rotated to random sides by normally distributed angles with standard deviation ``degrees``."""
    rng = np.random.default_rng(seed)
    side = np.cross(normals, rng.normal(size=normals.shape))
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    angle = np.radians(degrees) * np.abs(rng.normal(size=len(normals)))[:, None]
    return np.cos(angle) * normals + np.sin(angle) * side
