"""Renders a scene to the six faces of a cube map around a position, with the solid angle of each pixel."""

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
"""View direction and up direction of each of the six faces, world space."""


class CubeSamples(NamedTuple):
    """Incident radiance at a position from N directions, one row per direction."""

    directions: Doubles
    """Unit directions in world space, shape (N, 3) for N directions."""
    radiance: FloatArray
    """Linear Rec.709 radiance from each of N directions, shape (N, 3)."""
    weights: Doubles
    """Solid angle that each of N directions stands for, steradians, shape (N,)."""
    alpha: FloatArray
    """Coverage of each of N directions by the scene, 0..1, shape (N,)."""


class CubeFaces(NamedTuple):
    """Pixels of a cube map's six faces, each P x P, face by face and row by row."""

    radiance: FloatArray
    """Linear Rec.709 radiance of each pixel of six P x P faces, shape (6 P P, 3); premultiplied by alpha if the frames
    have no background."""
    alpha: FloatArray
    """Coverage by the scene of each pixel of six P x P faces, 0..1, shape (6 P P,)."""


class CubeViews(NamedTuple):
    """The six cameras of a cube map, and the directions and solid angles of its pixels."""

    cameras: tuple[Camera, ...]
    directions: Doubles
    """World-space direction, not of unit length, through the centre of each pixel of six P x P faces, shape (6 P P,
    3)."""
    weights: Doubles
    """Solid angle of each pixel of six P x P faces, steradians, shape (6 P P,)."""


def render_faces(
    scene: Scene, position: Doubles, render: Callable[[Scene, Camera], Frame], face_px: int, near: float
) -> CubeFaces:
    """Renders a scene from a position to the six faces of a cube map.

    Unlit frames are decoded by `captured_radiance`; lit frames are linear already. Pixels without a surface show the
    scene's visible environment in lit frames, else the background of the frames.

    Args:
        scene: The scene.
        position: Centre of the cube, world space, shape (3,).
        render: Renders a face, as `lumisplat.Renderer.render` does.
        face_px: Pixels along a face's edge.
        near: Half the side, scene units, of a cube around the position; nothing inside the cube is rendered.

    Raises:
        SceneError: ``render`` refuses the scene.
    """
    frames = [render(scene, camera) for camera in cube_views(position, face_px, near).cameras]
    radiance = np.concatenate([_radiance(frame).reshape(-1, 3) for frame in frames])
    return CubeFaces(radiance, np.concatenate([frame.alpha.ravel() for frame in frames]))


def render_cube(
    scene: Scene, position: Doubles, render: Callable[[Scene, Camera], Frame], face_px: int, near: float
) -> CubeSamples:
    """Samples the incident radiance at a position through a cube map; arguments as for `render_faces`.

    Pixels that are not finite are left out, and a warning counts them.

    Raises:
        SceneError: No pixel is finite, or ``render`` refuses the scene.
    """
    cube = _cube(face_px)
    radiance, alpha = render_faces(scene, position, render, face_px, near)
    if np.nanmax(alpha) == 0.0:
        where = ", ".join(f"{x:g}" for x in position)
        _log.warning(
            "a probe at (%s) sees nothing of the scene, only the background: move the probe into the scene", where
        )
    finite = np.isfinite(radiance).all(axis=1)
    if not finite.any():
        raise SceneError("all pixels of a probe are infinite or NaN: make colours and lights of the scene smaller")
    if not finite.all():
        _log.warning("%d pixels of a probe's faces are not finite and are left out", np.count_nonzero(~finite))
        return CubeSamples(cube.directions[finite], radiance[finite], cube.weights[finite], alpha[finite])
    return CubeSamples(cube.directions, radiance, cube.weights, alpha)


def face_pixels(directions: Doubles, face_px: int) -> IntArray:
    """Returns the index of the cube map pixel in each of N directions.

    Args:
        directions: Directions in world space, of any length above 0, shape (N, 3).
        face_px: Pixels along a face's edge.

    Returns:
        Row in `CubeFaces` of each direction's pixel, shape (N,).
    """
    in_view = np.stack([directions @ camera.camera_from_world[:3, :3].T for camera in _cube(face_px).cameras])
    face = np.argmax(in_view[:, :, 2], axis=0)
    x, y, z = in_view[face, np.arange(len(directions))].T
    column, row = (np.clip((0.5 + 0.5 * axis / z) * face_px, 0, face_px - 1).astype(np.int32) for axis in (x, y))
    return (face * face_px + row) * face_px + column


def cube_solid_angles(face_px: int) -> Doubles:
    """Returns the solid angle of each pixel of a face, steradians, shape (face_px, face_px).

    Over six faces the solid angles sum to 4 pi exactly. A rectangle from the face's centre to (x, y), at distance 1,
    covers ``atan(x y / sqrt(x^2 + y^2 + 1))``.
    """
    edge = np.linspace(-1.0, 1.0, face_px + 1)
    x, y = edge[None, :], edge[:, None]
    corner = np.arctan(x * y / np.sqrt(x * x + y * y + 1.0))
    return corner[1:, 1:] - corner[1:, :-1] - corner[:-1, 1:] + corner[:-1, :-1]


def cube_views(position: Doubles, face_px: int, near: float) -> CubeViews:
    """Returns the views of a cube map around a position; arguments as for `render_faces`."""
    cube = _cube(face_px)
    return cube._replace(cameras=tuple(_moved(camera, position, near) for camera in cube.cameras))


@lru_cache(maxsize=4)
def _cube(face_px: int) -> CubeViews:
    """Returns the views of a cube map around the origin."""
    cameras = tuple(
        Camera.look_at((0.0, 0.0, 0.0), axis, up, width=face_px, height=face_px, fov_y=0.5 * np.pi)
        for axis, up in _FACES
    )
    directions = np.concatenate([world_rays(camera)[1].reshape(-1, 3) for camera in cameras])
    weights = np.tile(cube_solid_angles(face_px).ravel(), len(_FACES))
    for array in (directions, weights):
        array.flags.writeable = False
    return CubeViews(cameras, directions, weights)


def _moved(camera: Camera, position: Doubles, near: float) -> Camera:
    """Returns the camera moved from the origin to the position, with another near plane."""
    pose = np.array(camera.camera_from_world)
    pose[:3, 3] = -pose[:3, :3] @ position
    return replace(camera, camera_from_world=pose, near=near)


def _radiance(frame: Frame) -> FloatArray:
    """Returns the linear radiance of a frame's pixels composited over its background, (H, W, 3)."""
    if frame.color_space == "linear":
        return frame.color
    weight = frame.alpha if frame.background is None else np.ones_like(frame.alpha)
    return captured_radiance(frame.color, weight)
