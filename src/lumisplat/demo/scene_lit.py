"""The demo scene in the evening: without its captured daylight, lit by a spot, a lamp and the sky."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from lumisplat.demo.scene import GARDEN_COUNT, demo_scene
from lumisplat.math.arrays import FloatArray
from lumisplat.scene.lights import Light, LightEnvironment, LightPoint, LightSpot
from lumisplat.scene.materials import MaterialPbr
from lumisplat.scene.scene import MeshInstance, Scene, SplatInstance

_POLISHED = {
    "brass": {"base_color": (0.95, 0.78, 0.42), "metallic": 1.0},
    "aquamarine": {"base_color": (0.75, 0.93, 1.0), "transmission": 1.0, "ior": 1.58},
}
"""Material settings, by name, of the meshes that become a mirror and glass."""


def demo_scene_lit(scene: Scene | None = None, progress: Callable[[str, float], None] | None = None) -> Scene:
    """The demo scene, relit: the room that was captured in daylight, in the light of an evening.

    The room's Gaussians reflect by their albedo, roughness and metallic, so that nothing of the captured daylight is
    left; the baked daylight of the meshes is removed. The brass knot is a mirror, the jewel is glass. The garden
    outside is a set without a material and shines as captured. The lights are, in order, a warm ``spot``, a soft
    ``lamp`` in the niche, and a dim, cool ``sky``.

    Args:
        scene: The result of `demo_scene`; None: it is made again, which takes seconds.
        progress: As for `demo_scene`.

    Returns:
        World y up, metres, floor at y = 0.
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
    """The instance without baked daylight, and with its polished material if it has one."""
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
    """Linear radiance of all directions, shape (rows, 2 rows, 3).

    The sky is blue above and pale at the horizon, the ground dark; brighter clouds are where light enters the room.
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
