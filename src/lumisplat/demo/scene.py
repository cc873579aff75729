"""The demo scene: a room that holds a capture of nearly 300,000 Gaussians and four meshes, all made by formula."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from lumisplat.constants import SH_C0
from lumisplat.demo import objects as demo_objects
from lumisplat.demo import room as demo_room
from lumisplat.demo.daylight import Daylight, irradiance
from lumisplat.math.color import encode_srgb
from lumisplat.scene.camera import Camera
from lumisplat.scene.gaussians import Gaussians, merged
from lumisplat.scene.mesh import Mesh
from lumisplat.scene.sampling.mesh_sampling import gaussians_from_mesh
from lumisplat.scene.scene import MeshInstance, Scene, SplatInstance

DAYLIGHT = Daylight(sun_direction=(-1.0, 0.52, 0.36))
"""The light in which the demo's capture was taken: through the window on the left."""

GARDEN_COUNT = 4_000
"""The last Gaussians of the capture: what the window looks out on."""

_VIEWS: dict[str, tuple[tuple[float, float, float], tuple[float, float, float], float]] = {
    "hero": ((0.95, 1.30, 3.25), (-0.06, 0.70, -0.55), 0.585),
    "left": ((-1.55, 1.35, 1.75), (0.35, 0.55, -0.75), 0.72),
    "right": ((1.75, 1.25, 1.55), (-0.85, 0.75, -0.75), 0.75),
    "detail": ((1.00, 1.12, 1.12), (0.42, 0.58, -0.80), 0.56),
    "niche": ((-0.20, 1.25, 0.75), (-0.66, 0.98, -1.75), 0.62),
    "above": ((0.25, 2.30, 2.45), (0.0, 0.25, -0.35), 0.66),
}
"""Name -> eye, target, vertical field of view."""


def demo_scene(progress: Callable[[str, float], None] | None = None) -> Scene:
    """A furnished room, without any file: one Gaussian set and four meshes.

    The set is a capture of procedural meshes, and as in any capture daylight is baked into its display colours
    (``sh``); ``albedo``, ``normals``, ``roughness`` and ``metallic`` hold what the surfaces are without that light.
    The meshes carry the same daylight in their vertex ``colors``, apart from their materials:
    ``dataclasses.replace(mesh, colors=None)`` takes it off.

    Args:
        progress: Called with a step's name and the share done, 0..1.

    Returns:
        World y up, metres, floor at y = 0.
    """
    report = progress or (lambda step, share: None)
    report("building the demo scene", 0.0)
    rng = np.random.default_rng(7)
    parts = _captured(rng)
    sets = []
    for seed, (mesh, spacing) in enumerate(parts):
        report("building the demo scene", 0.1 + 0.7 * seed / len(parts))
        sets.append(gaussians_from_mesh(mesh, math.ceil(_area(mesh) / spacing**2), seed=seed))
    report("lighting the demo scene", 0.8)
    meshes = [demo_room.woodwork(), demo_objects.ball(rng), demo_objects.knot(), demo_objects.jewel()]
    capture, meshes = _in_daylight(merged(sets), meshes)
    garden = gaussians_from_mesh(demo_room.garden(), GARDEN_COUNT)
    report("lighting the demo scene", 1.0)
    return Scene(
        splats=(SplatInstance(merged([capture, garden]), name="room"),),
        meshes=tuple(MeshInstance(mesh, name=mesh.name) for mesh in meshes),
    )


def demo_cameras(width: int = 1280, height: int = 720, count: int | None = None) -> list[Camera]:
    """Views of the demo scene: first the hero, then others around and close up.

    Args:
        width: Image width, pixels.
        height: Image height, pixels.
        count: Only the first so many; None: all.
    """
    return [
        Camera.look_at(eye, target, width=width, height=height, fov_y=fov_y, name=name)
        for name, (eye, target, fov_y) in list(_VIEWS.items())[:count]
    ]


def _captured(rng: np.random.Generator) -> list[tuple[Mesh, float]]:
    """What the capture holds, each with the distance between its Gaussians, metres."""
    walls = [(mesh, 0.022) for mesh in demo_room.side_walls(rng)]
    return [
        (demo_room.floor(rng), 0.0132),
        (demo_room.back_wall(rng), 0.0158),
        (demo_room.niche(rng), 0.013),
        *walls,
        (demo_objects.vase(rng), 0.0045),
        (demo_objects.plinth(rng), 0.009),
        (demo_objects.column(rng), 0.008),
        (demo_objects.ammonite(rng), 0.0048),
        (demo_objects.bench(), 0.0105),
        *((mesh, 0.0055) for mesh in demo_objects.fruit_bowl()),
        *((mesh, 0.0065) for mesh in demo_objects.stones(rng)),
        (demo_objects.cube(rng), 0.009),
    ]


def _in_daylight(capture: Gaussians, meshes: list[Mesh]) -> tuple[Gaussians, list[Mesh]]:
    """Both with the daylight baked in, each casting shadows on the other."""
    # The wall with the window is thick: woodwork that reaches into it must not find the sun behind it.
    outside = capture.means[capture.means[:, 0] < demo_room.LEFT + 1e-3] - np.array([0.08, 0.0, 0.0], dtype=np.float32)
    casters = np.concatenate([capture.means, outside, *(_dense_points(mesh, 2.0 * DAYLIGHT.texel) for mesh in meshes)])
    receivers = np.concatenate([capture.means, *(mesh.positions for mesh in meshes)])
    normals = np.concatenate([_array(capture.normals), *(_array(mesh.normals) for mesh in meshes)])
    light = irradiance(casters, receivers, normals, DAYLIGHT)
    display = encode_srgb(_array(capture.albedo) * light[: capture.count])
    capture = replace(capture, sh=(display[:, None, :] - 0.5) / SH_C0)
    shares = np.split(light[capture.count :], np.cumsum([mesh.vertex_count for mesh in meshes])[:-1])
    return capture, [replace(mesh, colors=share) for mesh, share in zip(meshes, shares, strict=True)]


def _dense_points(mesh: Mesh, spacing: float) -> np.ndarray:
    """The vertices, and points on all triangles no further apart than ``spacing`` along their edges."""
    corners = mesh.positions[mesh.indices]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    steps = np.ceil(longest / spacing).astype(int)
    points = [mesh.positions]
    for count in np.unique(steps):
        i, j = np.nonzero(np.add.outer(np.arange(count + 1), np.arange(count + 1)) <= count)
        weights = np.stack([i, j, count - i - j], axis=1) / count
        weights = weights[weights.max(axis=1) < 1.0]
        points.append(np.einsum("pk,fkd->fpd", weights, corners[steps == count]).reshape(-1, 3))
    return np.concatenate(points)


def _area(mesh: Mesh) -> float:
    a, b, c = mesh.positions[mesh.indices].swapaxes(0, 1)
    return 0.5 * float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())


def _array(values: np.ndarray | None) -> np.ndarray:
    assert values is not None
    return values
