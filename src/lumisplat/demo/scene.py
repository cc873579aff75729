"""Computes the demo scene from formulas: a room with a capture of nearly 300,000 Gaussians and four meshes.

The evening version is lit by a spot light, a point light and an environment, without the captured daylight.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from lumisplat.constants import SH_C0
from lumisplat.demo import room as demo_objects, room as demo_room
from lumisplat.demo.daylight import Daylight, irradiance
from lumisplat.math.arrays import FloatArray
from lumisplat.math.color import encode_srgb
from lumisplat.scene.camera import Camera
from lumisplat.scene.gaussians import Gaussians, merge_gaussians
from lumisplat.scene.lights import Light, LightEnvironment, LightPoint, LightSpot
from lumisplat.scene.materials import MaterialPbr
from lumisplat.scene.mesh import Mesh
from lumisplat.scene.ops.mesh_sampling import gaussians_from_mesh
from lumisplat.scene.ops.surface_points import surface_area
from lumisplat.scene.placing import up_vector
from lumisplat.scene.scene import MeshInstance, Scene, SplatInstance

DAYLIGHT = Daylight(sun_direction=(-1.0, 0.52, 0.36))
"""Daylight baked into the demo's capture; it enters through the window on the left."""

GARDEN_COUNT = 4_000
"""Number of Gaussians of the garden outside of the window; they are at the end of the capture."""

_VIEWS: dict[str, tuple[tuple[float, float, float], tuple[float, float, float], float]] = {
    "hero": ((0.95, 1.30, 3.25), (-0.06, 0.70, -0.55), 0.585),
    "left": ((-1.55, 1.35, 1.75), (0.35, 0.55, -0.75), 0.72),
    "right": ((1.75, 1.25, 1.55), (-0.85, 0.75, -0.75), 0.75),
    "detail": ((1.00, 1.12, 1.12), (0.42, 0.58, -0.80), 0.56),
    "niche": ((-0.20, 1.25, 0.75), (-0.66, 0.98, -1.75), 0.62),
    "above": ((0.25, 2.30, 2.45), (0.0, 0.25, -0.35), 0.66),
}
"""Views of the demo: eye, target and vertical field of view in degrees, by name."""


def demo_scene(progress: Callable[[str, float], None] | None = None) -> Scene:
    """Creates a furnished room, without reading any file: one Gaussian set and four meshes.

    The set is a capture of procedural meshes. As in any capture, daylight is baked into its display colours (``sh``);
    ``albedo``, ``normals``, ``roughness`` and ``metallic`` describe the surfaces without that light. The vertex
    ``colors`` of the meshes contain the same daylight, separate from their materials:
    ``dataclasses.replace(mesh, colors=None)`` removes it.

    Args:
        progress: Called with the name of a step and the fraction done, 0..1.

    Returns:
        Scene with y up, in metres, with the floor at y = 0.
    """
    report = progress or _ignore
    report("building the demo scene", 0.0)
    rng = np.random.default_rng(7)
    parts = _captured_meshes(rng)
    sets: list[Gaussians] = []
    for seed, (mesh, spacing) in enumerate(parts):
        report("building the demo scene", 0.1 + 0.7 * seed / len(parts))
        sets.append(gaussians_from_mesh(mesh, math.ceil(surface_area(mesh) / spacing**2), seed=seed))
    report("lighting the demo scene", 0.8)
    meshes = [demo_room.woodwork(), demo_objects.ball(rng), demo_objects.knot(), demo_objects.jewel()]
    capture, meshes = _bake_daylight(merge_gaussians(sets), meshes)
    garden = gaussians_from_mesh(demo_room.garden(), GARDEN_COUNT)
    report("lighting the demo scene", 1.0)
    return Scene(
        splats=(SplatInstance(replace(merge_gaussians([capture, garden]), up=up_vector("y-up")), name="room"),),
        meshes=tuple(MeshInstance(mesh, name=mesh.name) for mesh in meshes),
    )


def demo_cameras(width: int = 1280, height: int = 720, count: int | None = None) -> list[Camera]:
    """Returns cameras of the demo scene: the hero view first, then others from the sides and close up.

    Args:
        width: Image width, pixels.
        height: Image height, pixels.
        count: Number of views, from the first; None for all.
    """
    return [
        Camera.look_at(eye, target, width=width, height=height, fov_y=fov_y, name=name)
        for name, (eye, target, fov_y) in list(_VIEWS.items())[:count]
    ]


def _captured_meshes(rng: np.random.Generator) -> list[tuple[Mesh, float]]:
    """Returns the meshes that become the capture, each with the distance between its Gaussians, metres."""
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


def _bake_daylight(capture: Gaussians, meshes: list[Mesh]) -> tuple[Gaussians, list[Mesh]]:
    """Lights the capture's albedo by daylight into its SH, and stores the daylight in the meshes' vertex colours.

    Capture and meshes cast shadows on each other.
    """
    # The wall with the window is thick: sunlight behind its inner side must not reach the woodwork inside of it.
    outside = capture.means[capture.means[:, 0] < demo_room.LEFT + 1e-3] - np.array([0.08, 0.0, 0.0], dtype=np.float32)
    casters = np.concatenate([capture.means, outside, *(_dense_points(mesh, 2.0 * DAYLIGHT.texel) for mesh in meshes)])
    receivers = np.concatenate([capture.means, *(mesh.positions for mesh in meshes)])
    normals = np.concatenate([_required(capture.normals), *(_required(mesh.normals) for mesh in meshes)])
    light = irradiance(casters, receivers, normals, DAYLIGHT)
    display = encode_srgb(_required(capture.albedo) * light[: capture.count])
    capture = replace(capture, sh=(display[:, None, :] - 0.5) / SH_C0)
    shares = np.split(light[capture.count :], np.cumsum([mesh.vertex_count for mesh in meshes])[:-1])
    return capture, [replace(mesh, colors=share) for mesh, share in zip(meshes, shares, strict=True)]


def _dense_points(mesh: Mesh, spacing: float) -> npt.NDArray[np.floating]:
    """Returns a mesh's vertices, and points on its triangles so dense that neighbours are at most ``spacing`` apart."""
    corners = mesh.positions[mesh.indices]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    steps = np.ceil(longest / spacing).astype(int)
    points: list[npt.NDArray[np.floating]] = [mesh.positions]
    for count in np.unique(steps):
        k = np.arange(int(count) + 1)
        i, j = np.nonzero(k[:, None] + k <= count)
        weights = np.stack([i, j, count - i - j], axis=1) / count
        weights = weights[weights.max(axis=1) < 1.0]
        points.append(np.einsum("pk,fkd->fpd", weights, corners[steps == count]).reshape(-1, 3))
    return np.concatenate(points)


def _required(values: FloatArray | None) -> FloatArray:
    assert values is not None
    return values


def _ignore(step: str, share: float) -> None:
    """Progress callback that does nothing."""


_POLISHED = {
    "brass": {"base_color": (0.95, 0.78, 0.42), "metallic": 1.0},
    "aquamarine": {"base_color": (0.75, 0.93, 1.0), "transmission": 1.0, "ior": 1.58},
}
"""Material settings by mesh name that turn the brass knot into a mirror and the jewel into glass, in the evening
scene."""


def demo_scene_lit(scene: Scene | None = None, progress: Callable[[str, float], None] | None = None) -> Scene:
    """Creates the relit demo scene: the room captured in daylight, under evening light.

    The room's Gaussians reflect by their albedo, roughness and metallic, so that none of the captured daylight
    is left; the baked daylight of the meshes is removed. The brass knot is a mirror, the jewel is glass. The garden
    outside is a set without a material and emits its captured radiance. The lights are, in order, a warm ``spot``, a
    soft ``lamp`` in the niche, and a dim, cool ``sky``.

    Args:
        scene: Result of `demo_scene`; None to create it, which takes seconds.
        progress: As for `demo_scene`.

    Returns:
        Scene with y up, in metres, with the floor at y = 0.
    """
    scene = scene or demo_scene(progress)
    capture = scene.splats[0].gaussians
    garden_first = capture.count - GARDEN_COUNT
    room, garden = (
        capture.subset(np.arange(first, end)) for first, end in ((0, garden_first), (garden_first, capture.count))
    )
    return Scene(
        splats=(SplatInstance(room, material=MaterialPbr(), name="room"), SplatInstance(garden, name="garden")),
        meshes=tuple(_without_daylight(instance) for instance in scene.meshes),
        lights=_lights(),
    )


def _without_daylight(instance: MeshInstance) -> MeshInstance:
    """Returns a mesh instance without baked daylight, and with its settings from `_POLISHED`, if it has any."""
    mesh = instance.mesh
    assert isinstance(mesh.material, MaterialPbr)
    material = mesh.material
    if instance.name in _POLISHED:
        material = replace(material, roughness=0.0, **_POLISHED[instance.name])
    return replace(instance, mesh=replace(mesh, material=material, colors=None))


def _lights() -> tuple[Light, ...]:
    spot = LightSpot(
        position=(2.0, 2.0, 1.0),
        direction=(-2.6, -1.7, -1.6),
        color=(1.0, 0.76, 0.5),
        intensity=50.0,
        inner_angle=0.2,
        outer_angle=0.8,
        radius=0.06,
        name="spot",
    )
    lamp = LightPoint((-0.62, 1.5, -1.42), color=(1.0, 0.66, 0.38), intensity=0.9, radius=0.08, name="lamp")
    return spot, lamp, LightEnvironment(_evening_sky(), intensity=0.34, visible=False, name="sky")


def _evening_sky(rows: int = 64) -> FloatArray:
    """Returns an environment image of linear radiance, shape (rows, 2 rows, 3).

    The sky is blue above and pale at the horizon, the ground dark. Clouds are brighter in the directions from which
    light enters the room.
    """
    theta = (np.arange(rows) + 0.5) * np.pi / rows
    phi = (np.arange(2 * rows) + 0.5 - rows) * np.pi / rows
    up = np.cos(theta)[:, None] + 0.0 * phi
    right, back = (np.sin(theta)[:, None] * along for along in (np.sin(phi), -np.cos(phi)))
    clouds = np.array([-0.48, 0.66, 0.58])
    off = np.arccos(np.clip(np.stack([right, up, back], axis=-1) @ clouds, -1.0, 1.0))[..., None]
    height = np.clip(up, 0.0, 1.0)[..., None] ** 0.6
    sky = np.array([0.75, 0.80, 0.95]) * (1.0 - height) + np.array([0.35, 0.55, 1.0]) * height
    ground = np.array([0.12, 0.11, 0.10])
    bright = 1.6 * np.exp(-((off / 0.5) ** 2)) * np.array([0.70, 0.85, 1.0])
    return (np.where(up[..., None] > 0.0, sky, ground) + bright).astype(np.float32)
