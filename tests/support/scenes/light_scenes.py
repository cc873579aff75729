"""Lit mesh scenes for comparisons with Mitsuba; tools/make_mitsuba_light_reference.py renders their references.

All colours are linear. The scenes use only materials that mean the same in both renderers: white metals (Fresnel term 1
at all angles), purely diffuse materials, and clear glass.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

import lumisplat as ls
from lumisplat.demo.shapes import sphere, transform_mesh
from lumisplat.scene.materials import Material
from support.scenes.raster_scenes import similarity

WIDTH, HEIGHT = 96, 72
ROTATION_WXYZ = (0.84, 0.10, -0.50, 0.30)
"""Rotation of the environment; no axis maps to itself."""


@dataclass(frozen=True)
class LightScene:
    """A scene with the settings for a comparison of two renderings."""

    name: str
    scene: ls.Scene
    camera: ls.Camera
    shadows: ls.Shadows = ls.Shadows.HARD
    """SOFT if the light has an extent; such images are noisy and averaged over the pixel area."""
    smooth: bool = False
    """True if the scene has mirrors or glass."""


def light_scenes() -> dict[str, LightScene]:
    """Returns all scenes, keyed by the names of their references."""
    point = ls.LightPoint((1.6, 2.6, 1.4), color=(1.0, 0.9, 0.7), intensity=30.0)
    spot = ls.LightSpot((1.4, 2.8, 1.6), (-1.4, -2.4, -1.7), intensity=40.0, inner_angle=0.42, outer_angle=0.55)
    sun = ls.LightDirectional((-0.6, -1.0, -0.5), color=(1.0, 0.95, 0.8), intensity=5.0)
    rect = ls.LightRect((0.8, 3.0, 1.0), (1.2, -0.3, 0.0), (0.0, 0.0, 0.8), color=(1.0, 0.8, 0.6), intensity=9.0)
    disk = ls.LightDisk((0.8, 3.0, 1.0), (-0.3, -1.0, -0.2), 0.55, (1.0, 0.8, 0.6), 9.0)
    ball = ls.LightSphere((1.3, 2.7, 1.2), 0.35, intensity=40.0)
    even = ls.LightEnvironment(color=(0.7, 0.9, 1.0), intensity=1.5)
    environment = ls.LightEnvironment(
        environment_image(256, 512), color=(1.0, 0.9, 0.8), intensity=0.8, rotation_wxyz=ROTATION_WXYZ
    )
    soft = ls.Shadows.SOFT
    scenes = [
        LightScene("point", ls.Scene((), _room(), [point]), _room_camera()),
        LightScene("spot", ls.Scene((), _room(), [spot]), _room_camera()),
        LightScene("directional", ls.Scene((), _room(), [sun]), _room_camera()),
        LightScene("rect", ls.Scene((), _room(), [rect]), _room_camera(), soft),
        LightScene("disk", ls.Scene((), _room(), [disk]), _room_camera(), soft),
        LightScene("sphere", ls.Scene((), _room(), [ball]), _room_camera(), soft),
        LightScene("constant", ls.Scene((), _room(), [even]), _room_camera(), soft),
        LightScene("sky", ls.Scene((), _table(), [environment]), _table_camera(), soft),
        LightScene("metal", ls.Scene((), _metals(), [point]), _table_camera()),
        LightScene("metal_sky", ls.Scene((), _metals(), [environment]), _table_camera(), soft),
        LightScene("smooth", ls.Scene((), _mirror_and_glass(), [point]), _room_camera(), smooth=True),
    ]
    return {one.name: one for one in scenes}


def matte(red: float, green: float | None = None, blue: float | None = None) -> ls.MaterialPbr:
    """Returns a purely diffuse (Lambertian) material; a single number sets all three channels of the albedo."""
    color = (red, red if green is None else green, red if blue is None else blue)
    return ls.MaterialPbr(base_color=color, roughness=1.0, specular=0.0)


def metal(roughness: float) -> ls.MaterialPbr:
    """Returns a white metal, which reflects all light at every angle except for its own microfacet shadowing."""
    return ls.MaterialPbr(base_color=(1.0, 1.0, 1.0), metallic=1.0, roughness=roughness)


def clear_glass(ior: float = 1.5) -> ls.MaterialPbr:
    """Returns smooth colourless glass."""
    return ls.MaterialPbr(base_color=(1.0, 1.0, 1.0), transmission=1.0, roughness=0.0, ior=ior)


def parallelogram(corner: npt.ArrayLike, edge_u: npt.ArrayLike, edge_v: npt.ArrayLike, material: Material) -> ls.Mesh:
    """Returns two triangles that face ``cross(edge_u, edge_v)``."""
    p, u, v = np.array(corner), np.array(edge_u), np.array(edge_v)
    return ls.Mesh(np.stack([p, p + u, p + u + v, p + v]), [[0, 1, 2], [0, 2, 3]], material=material)


def box(size: tuple[float, ...], material: ls.MaterialPbr) -> ls.Mesh:
    """Returns a flat-shaded box of twelve triangles centred at the origin."""
    corners = 0.5 * np.array(size) * [[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
    sides = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    return ls.Mesh(
        corners, [[q[a], q[b], q[c]] for q in sides for a, b, c in ((0, 1, 2), (0, 2, 3))], material=material
    )


def ball_at(center: tuple[float, float, float], radius: float, material: ls.MaterialPbr, rows: int = 40) -> ls.Mesh:
    """Returns a sphere with smooth normals."""
    placed = transform_mesh(sphere(radius, rows=rows, columns=2 * rows), similarity(offset=center))
    return replace(placed, material=material, uvs=None)


def environment_radiance(directions: np.ndarray) -> np.ndarray:
    """Returns linear radiance of an environment without symmetry, with a small sun, for unit directions; (..., 3)."""
    x, y, z = np.moveaxis(directions, -1, 0)[..., None]
    radiance = np.array([0.30, 0.45, 0.80]) * (0.6 + 0.4 * y) + np.array([0.05, 0.04, 0.02])
    for lobe, sharpness, color in (
        ((1.0, 0.1, 0.0), 4.0, (0.9, 0.1, 0.1)),
        ((0.0, 0.2, 1.0), 6.0, (0.1, 0.8, 0.1)),
        ((-0.4, -0.9, 0.3), 3.0, (0.5, 0.4, 0.0)),
        (SUN, 2.0 / np.radians(2.5) ** 2, (320.0, 290.0, 240.0)),
    ):
        axis = np.array(lobe) / np.linalg.norm(lobe)
        cosine = axis[0] * x + axis[1] * y + axis[2] * z
        radiance = radiance + np.array(color) * np.exp(sharpness * (cosine - 1.0))
    return radiance


SUN = (0.55, 0.70, 0.25)
"""Direction towards the environment's sun in environment space, of any length."""


def environment_image(height: int, width: int) -> np.ndarray:
    """Returns the environment as a latitude-longitude image, shape (height, width, 3), sampled at texel centres."""
    u, v = (np.arange(width) + 0.5) / width, (np.arange(height)[:, None] + 0.5) / height
    return environment_radiance(directions_of(u, v)).astype(np.float32)


def directions_of(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Returns unit directions of a latitude-longitude image: +y at the top, -z in the middle, +x to the right."""
    longitude, polar = 2.0 * np.pi * (u - 0.5), np.pi * v
    across = np.sin(polar)
    return np.stack([across * np.sin(longitude), np.cos(polar) + 0.0 * u, -across * np.cos(longitude)], axis=-1)


def _room_camera() -> ls.Camera:
    return ls.Camera.look_at((1.7, 1.6, 3.0), (-0.15, 0.55, -0.3), width=WIDTH, height=HEIGHT, fov_y=0.72)


def _table_camera() -> ls.Camera:
    return ls.Camera.look_at((0.6, 1.7, 3.8), (0.0, 0.5, 0.0), width=WIDTH, height=HEIGHT, fov_y=0.6)


def _floor() -> ls.Mesh:
    return parallelogram((-2.0, 0.0, 2.5), (5.5, 0.0, 0.0), (0.0, 0.0, -4.5), matte(0.8, 0.75, 0.7))


def _objects() -> list[ls.Mesh]:
    turned = transform_mesh(
        box((0.8, 0.9, 0.6), matte(0.2, 0.5, 0.8)), similarity((0.0, 1.0, 0.0), 0.5, offset=(0.75, 0.45, -0.7))
    )
    return [ball_at((-0.55, 0.6, 0.1), 0.6, matte(0.8, 0.3, 0.2)), turned]


def _room() -> list[ls.Mesh]:
    return [*_corner(), *_objects()]


def _corner() -> list[ls.Mesh]:
    back = parallelogram((-2.0, 0.0, -2.0), (5.5, 0.0, 0.0), (0.0, 3.2, 0.0), matte(0.7))
    left = parallelogram((-2.0, 0.0, 2.5), (0.0, 0.0, -4.5), (0.0, 3.2, 0.0), matte(0.3, 0.7, 0.3))
    return [_floor(), back, left]


def _table() -> list[ls.Mesh]:
    return [_floor(), *_objects()]


def _metals() -> list[ls.Mesh]:
    return [_floor(), *(ball_at((x, 0.45, 0.2), 0.45, metal(r)) for x, r in ((-1.0, 0.3), (0.0, 0.5), (1.0, 0.8)))]


def _mirror_and_glass() -> list[ls.Mesh]:
    mirror = ball_at((-0.7, 0.6, -0.1), 0.6, metal(0.0), rows=96)
    glass = ball_at((0.65, 0.5, 0.5), 0.5, clear_glass(), rows=96)
    red = transform_mesh(
        box((0.5, 0.5, 0.5), matte(0.8, 0.2, 0.1)), similarity((0.0, 1.0, 0.0), 0.4, 1.0, (0.4, 0.25, -1.0))
    )
    return [*_corner(), mirror, glass, red]
