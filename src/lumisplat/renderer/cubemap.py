"""A scene rendered to the six faces of a cube around a place, each pixel with the solid angle that it covers."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from lumisplat.errors import SceneError
from lumisplat.frame.frame import Frame
from lumisplat.math.arrays import Doubles, FloatArray, IntArray
from lumisplat.math.tone_map import captured_radiance
from lumisplat.scene.camera import Camera
from lumisplat.scene.ops.views import world_rays
from lumisplat.scene.scene import Scene

_log = logging.getLogger("lumisplat")


_FACES = (
    ((1.0, 0.0, 0.0), (0.0, -1.0, 0.0)),
    ((-1.0, 0.0, 0.0), (0.0, -1.0, 0.0)),
    ((0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
    ((0.0, -1.0, 0.0), (0.0, 0.0, -1.0)),
    ((0.0, 0.0, 1.0), (0.0, -1.0, 0.0)),
    ((0.0, 0.0, -1.0), (0.0, -1.0, 0.0)),
)
"""Direction of view of each face, and the direction that is up in it."""


class CubeSamples(NamedTuple):
    """Radiance that arrives at a place, one row for each direction."""

    directions: Doubles
    """Unit, world space, shape (N, 3)."""
    radiance: FloatArray
    """Linear Rec.709, shape (N, 3)."""
    weights: Doubles
    """Solid angles, steradians, shape (N,)."""


class CubeFaces(NamedTuple):
    """What the pixels of the six faces of a cube show, P pixels along an edge, face by face and row by row."""

    radiance: FloatArray
    """Linear Rec.709, shape (6 P P, 3); without a background it is premultiplied."""
    alpha: FloatArray
    """How much of each pixel the scene covers, 0..1, shape (6 P P,)."""


class _Cube(NamedTuple):
    """The faces of a cube around the origin."""

    cameras: tuple[Camera, ...]
    directions: Doubles
    """Through the pixels' centres, shape (6 P P, 3)."""
    weights: Doubles
    """Solid angles of the pixels, shape (6 P P,)."""


def render_faces(
    scene: Scene, position: Doubles, render: Callable[[Scene, Camera], Frame], face_px: int, near: float
) -> CubeFaces:
    """Renders a scene from a place to the six faces of a cube.

    Unlit frames are decoded by `captured_radiance`, lit ones are linear. Uncovered pixels have the background of the
    frames, or in lit ones the scene's visible environment.

    Args:
        scene: The scene.
        position: The centre of the cube, world space, shape (3,).
        render: Renders a face, as `lumisplat.Renderer.render` does.
        face_px: Pixels along a face's edge.
        near: Half the side of the cube inside which nothing is seen, scene units.

    Raises:
        SceneError: The scene is refused.
    """
    frames = [render(scene, _moved(camera, position, near)) for camera in _cube(face_px).cameras]
    radiance = np.concatenate([_radiance(frame).reshape(-1, 3) for frame in frames])
    return CubeFaces(radiance, np.concatenate([frame.alpha.ravel() for frame in frames]))


def render_cube(
    scene: Scene, position: Doubles, render: Callable[[Scene, Camera], Frame], face_px: int, near: float
) -> CubeSamples:
    """Samples the radiance that arrives at a place, as of `render_faces`.

    Pixels that are not finite are left out, and counted in a log line.

    Raises:
        SceneError: No pixel is finite, or the scene is refused.
    """
    cube = _cube(face_px)
    radiance, alpha = render_faces(scene, position, render, face_px, near)
    if np.nanmax(alpha) == 0.0:
        place = ", ".join(f"{x:g}" for x in position)
        _log.warning("a probe at (%s) sees nothing of the scene, only the background", place)
    finite = np.isfinite(radiance).all(axis=1)
    if not finite.any():
        raise SceneError("a probe sees no pixel that is finite: are colours or lights of the scene too large?")
    if not finite.all():
        _log.warning("%d pixels of a probe's faces are not finite, and left out", np.count_nonzero(~finite))
        return CubeSamples(cube.directions[finite], radiance[finite], cube.weights[finite])
    return CubeSamples(cube.directions, radiance, cube.weights)


def face_pixels(directions: Doubles, face_px: int) -> IntArray:
    """Finds the pixels of a cube's faces that lie along directions.

    Args:
        directions: World space, of any length above 0, shape (N, 3).
        face_px: Pixels along a face's edge, P.

    Returns:
        Rows of `CubeFaces`, shape (N,).
    """
    seen = np.stack([directions @ camera.camera_from_world[:3, :3].T for camera in _cube(face_px).cameras])
    face = np.argmax(seen[:, :, 2], axis=0)
    x, y, z = seen[face, np.arange(len(directions))].T
    column, row = (np.clip((0.5 + 0.5 * axis / z) * face_px, 0, face_px - 1).astype(np.int32) for axis in (x, y))
    return (face * face_px + row) * face_px + column


def cube_solid_angles(face_px: int) -> Doubles:
    """Solid angle of each pixel of a face, steradians, shape (P, P): over six faces they sum to 4 pi, exactly.

    A rectangle from the face's centre to (x, y), at distance 1, covers ``atan(x y / sqrt(x^2 + y^2 + 1))``.
    """
    edge = np.linspace(-1.0, 1.0, face_px + 1)
    x, y = edge[None, :], edge[:, None]
    corner = np.arctan(x * y / np.sqrt(x * x + y * y + 1.0))
    return corner[1:, 1:] - corner[1:, :-1] - corner[:-1, 1:] + corner[:-1, :-1]


@lru_cache(maxsize=4)
def _cube(face_px: int) -> _Cube:
    cameras = tuple(
        Camera.look_at((0.0, 0.0, 0.0), axis, up, width=face_px, height=face_px, fov_y=0.5 * np.pi)
        for axis, up in _FACES
    )
    directions = np.concatenate([world_rays(camera)[1].reshape(-1, 3) for camera in cameras])
    weights = np.tile(cube_solid_angles(face_px).ravel(), len(_FACES))
    for array in (directions, weights):
        array.flags.writeable = False
    return _Cube(cameras, directions, weights)


def _moved(camera: Camera, position: Doubles, near: float) -> Camera:
    """The camera with its eye at a place instead of the origin."""
    pose = np.array(camera.camera_from_world)
    pose[:3, 3] = -pose[:3, :3] @ position
    return replace(camera, camera_from_world=pose, near=near)


def _radiance(frame: Frame) -> FloatArray:
    """Linear radiance of a frame's pixels over its background, (H, W, 3)."""
    if frame.color_space == "linear":
        return frame.color
    weight = frame.alpha if frame.background is None else np.ones_like(frame.alpha)
    return captured_radiance(frame.color, weight)
