"""Rooms of meshes for tests of light bounces; tools/make_mitsuba_path_reference.py renders their references.

All colours are linear. The scenes use only materials that mean the same in both renderers: white metals (Fresnel term 1
at all angles), purely diffuse materials, and clear glass. No mesh has smooth normals, so both render the same
polyhedra.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

import lumisplat as ls
from lumisplat.demo.shapes import transform_mesh
from support.scenes.light_scenes import ball_at, box, clear_glass, directions_of, matte, metal, parallelogram
from support.scenes.path_scenes import as_splats
from support.scenes.raster_scenes import similarity

WIDTH, HEIGHT = 128, 96
TILE = 32
"""Side in pixels of the tiles whose means are compared."""
BOUNCES = 8
SIZE = (4.0, 3.0, 5.0)
"""Size of the rooms (x, y up, z); one corner is the origin."""
CEILING_LIGHT = ((1.2, 1.4), (2.8, 3.0))
"""Two opposite corners (x, z) of the ceiling light."""


@dataclass(frozen=True)
class PathRoom:
    """A room and the camera that looks into it."""

    scene: ls.Scene
    camera: ls.Camera


def path_rooms() -> dict[str, PathRoom]:
    """Returns all rooms, keyed by the names of their references: the objects' material and the light."""
    objects = {
        "diffuse": [faceted_ball(0.0), turned_box(matte(0.2, 0.5, 0.8))],
        "metal": [faceted_ball(0.0, metal(0.4)), turned_box(metal(0.6))],
        "glass": [faceted_ball(0.0, clear_glass()), turned_box(matte(0.2, 0.5, 0.8))],
        "rough_glass": [faceted_ball(0.0, replace(clear_glass(), roughness=0.5)), turned_box(matte(0.2, 0.5, 0.8))],
    }
    lit = {"area": (closed_room, ()), "sky": (open_room, (environment_light(),))}
    rooms = {
        f"{kind}_{light}": PathRoom(ls.Scene((), [*walls(), *objects[kind]], lights), room_camera())
        for kind in objects
        for light, (walls, lights) in lit.items()
    }
    return rooms | {"cornell": cornell_box()}


def with_gaussians(room: PathRoom, count: int | None = None) -> PathRoom:
    """Replaces the ball and the end wall of a closed room by ``count`` Gaussians each."""
    end, ball = 1, len(room.scene.meshes) - 2
    splats = [as_splats(room.scene.meshes[number].mesh, count) for number in (end, ball)]
    meshes = [instance for number, instance in enumerate(room.scene.meshes) if number not in {end, ball}]
    return replace(room, scene=ls.Scene(splats, meshes))


def room_camera(width: int = WIDTH, height: int = HEIGHT) -> ls.Camera:
    """Looks from one end of the room to the other, tilted so that no edge is parallel to a row of pixels.

    Pixels along such an edge would all sample it alike.
    """
    eye, target = (2.1, 1.5, 4.9), (1.95, 1.15, 0.0)
    return ls.Camera.look_at(eye, target, (0.1, 1.0, 0.0), width=width, height=height, fov_y=0.8)


def cornell_box() -> PathRoom:
    """Returns Mitsuba's ``mitsuba.cornell_box()`` from an oblique view.

    Mitsuba's light is one-sided, so the light here has a black lid.
    """
    white = matte(0.885809, 0.698859, 0.666422)
    red, green = matte(0.570068, 0.0430135, 0.0443706), matte(0.105421, 0.37798, 0.076425)
    shining = replace(white, emissive=(18.387, 13.9873, 6.75357))
    x, y, z = 2.0 * np.eye(3)
    left, right = -0.5 * (x + y + z), 0.5 * (x - y - z)
    across, along = np.array([0.46, 0.0, 0.0]), np.array([0.0, 0.0, 0.38])
    corner = np.array([-0.23, 0.99, -0.18])
    meshes = [
        parallelogram(left, z, x, white),
        parallelogram(left + y, x, z, white),
        parallelogram(left, x, y, white),
        parallelogram(left, y, z, red),
        parallelogram(right, z, y, green),
        block((-0.33, -0.4, -0.28), ((0.28491, 0.0, -0.0939491), (0.0, 0.61, 0.0), (0.0939491, 0.0, 0.28491)), white),
        block((0.335, -0.7, 0.38), ((0.286891, 0.0, 0.0877115), (0.0, 0.3, 0.0), (-0.0877115, 0.0, 0.286891)), white),
        parallelogram(corner, across, along, shining),
        parallelogram(np.add(corner, (0.0, 1e-4, 0.0)), across, along, matte(0.0)),
    ]
    camera = ls.Camera.look_at((0, 0, 3.9), (0, -0.25, 0), (0.1, 1.0, 0.0), width=WIDTH, height=WIDTH, fov_y=0.55)
    return PathRoom(ls.Scene((), meshes), camera)


def block(center: tuple[float, ...], axes: tuple[tuple[float, ...], ...], material: ls.MaterialPbr) -> ls.Mesh:
    """Returns a parallelepiped, given half of its edge vectors."""
    around = box((2.0, 2.0, 2.0), material)
    return replace(around, positions=around.positions @ np.array(axes) + np.array(center))


def closed_room() -> list[ls.Mesh]:
    """Returns six walls with a light in the ceiling."""
    return [*floor_and_walls(), *ceiling(), behind(), ceiling_light()]


def open_room() -> list[ls.Mesh]:
    """Returns a room into which light enters from above and from behind the camera."""
    return floor_and_walls()


def floor_and_walls() -> list[ls.Mesh]:
    """Returns the floor, the end wall, a red and a green side wall."""
    x, y, z = np.diag(SIZE)
    return [
        parallelogram(0 * x, z, x, matte(0.7, 0.65, 0.6)),
        parallelogram(0 * x, x, y, matte(0.75)),
        parallelogram(z, -z, y, matte(0.7, 0.15, 0.1)),
        parallelogram(x, z, y, matte(0.15, 0.6, 0.2)),
    ]


def ceiling() -> list[ls.Mesh]:
    """Returns a white ceiling in four pieces around the light."""
    (x0, z0), (x1, z1) = CEILING_LIGHT
    height = SIZE[1]
    pieces = (
        ((0.0, 0.0), (x0, SIZE[2])),
        ((x1, 0.0), (SIZE[0], SIZE[2])),
        ((x0, 0.0), (x1, z0)),
        ((x0, z1), (x1, SIZE[2])),
    )
    return [level(start, end, height, matte(0.8)) for start, end in pieces]


def behind() -> ls.Mesh:
    """Returns the wall behind the camera."""
    x, y, z = np.diag(SIZE)
    return parallelogram(x + z, -x, y, matte(0.5))


def ceiling_light() -> ls.Mesh:
    """Returns an emitting square that faces down."""
    shining = ls.MaterialPbr(base_color=(0.5,) * 3, roughness=1.0, specular=0.0, emissive=(6.0, 5.4, 4.5))
    return level(*CEILING_LIGHT, SIZE[1], shining)


def level(start: tuple[float, float], end: tuple[float, float], height: float, material: ls.MaterialPbr) -> ls.Mesh:
    """Returns a horizontal rectangle that faces down, given two opposite corners (x, z)."""
    across, along = end[0] - start[0], end[1] - start[1]
    return parallelogram((start[0], height, start[1]), (across, 0.0, 0.0), (0.0, 0.0, along), material)


def faceted_ball(lift: float, material: ls.MaterialPbr | None = None) -> ls.Mesh:
    """Returns a flat-shaded ball, ``lift`` above the floor."""
    ball = ball_at((1.15, 0.7 + lift, 2.1), 0.7, material or matte(0.8, 0.5, 0.2), rows=32)
    return replace(ball, normals=None)


def turned_box(material: ls.MaterialPbr) -> ls.Mesh:
    """Returns a tall box, rotated about y."""
    return transform_mesh(box((1.0, 1.7, 0.9), material), similarity((0.0, 1.0, 0.0), 0.45, offset=(2.75, 0.85, 1.3)))


def mild_environment(directions: np.ndarray) -> np.ndarray:
    """Returns linear radiance of an environment without a sun for unit directions: bright ahead, dark below."""
    x, y, z = np.moveaxis(directions, -1, 0)[..., None]
    return np.array([0.5, 0.7, 1.1]) * (1.0 + 0.7 * y) + np.array([1.1, 0.8, 0.4]) * np.exp(
        3.0 * (0.6 * x - 0.8 * z - 1.0)
    )


def environment_light() -> ls.LightEnvironment:
    """Returns the environment as a light, rotated so that its bright side is on the right behind the camera."""
    u, v = (np.arange(256) + 0.5) / 256, (np.arange(128)[:, None] + 0.5) / 128
    image = mild_environment(directions_of(u, v)).astype(np.float32)
    return ls.LightEnvironment(image, rotation_wxyz=(0.0, 0.0, 1.0, 0.0))
