"""A scene rendered to the six faces of a cube around a place, each pixel with the solid angle that it covers."""

from __future__ import annotations

import logging
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from lumisplat.errors import SceneError
from lumisplat.frame.frame import Frame
from lumisplat.math.arrays import Doubles, FloatArray
from lumisplat.math.tone_map import captured_radiance
from lumisplat.renderer.renderer import Renderer, create_renderer
from lumisplat.scene.camera import Camera
from lumisplat.scene.checks import check_kind
from lumisplat.scene.ops.pixel_rays import world_rays
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


class _Cube(NamedTuple):
    """The faces of a cube around the origin."""

    cameras: tuple[Camera, ...]
    directions: Doubles
    """Through the pixels' centres, shape (6 P P, 3)."""
    weights: Doubles
    """Solid angles of the pixels, shape (6 P P,)."""


def render_cube(scene: Scene, position: Doubles, renderer: Renderer, face_px: int, near: float) -> CubeSamples:
    """Renders a scene from a place to the six faces of a cube.

    Unlit frames are decoded by `captured_radiance`, lit ones are linear. Uncovered pixels have the renderer's
    background, or in lit frames the scene's visible environment. Pixels that are not finite are left out, and counted
    in a log line.

    Args:
        scene: The scene.
        position: The centre of the cube, world space, shape (3,).
        renderer: Renders the faces.
        face_px: Pixels along a face's edge.
        near: Half the side of the cube inside which nothing is seen, scene units.

    Raises:
        SceneError: No pixel is finite, or the renderer refuses the scene.
    """
    check_kind("scene", scene, Scene, "a Scene")
    if renderer.config.lighting is None and scene.is_lit_by_default and not scene.lights:
        # The headlight that shows meshes alone goes with the viewer: it is no light of the place.
        renderer = create_renderer(replace(renderer.config, lighting=False), renderer.device)
    cube = _cube(face_px)
    colors: list[FloatArray] = []
    covered = 0.0
    for camera in cube.cameras:
        frame = renderer.render(scene, _moved(camera, position, near))
        colors.append(_radiance(frame).reshape(-1, 3))
        covered = max(covered, float(np.nanmax(frame.alpha)))
    if covered == 0.0:
        place = ", ".join(f"{x:g}" for x in position)
        _log.warning("a probe at (%s) sees nothing of the scene, only the background", place)
    radiance = np.concatenate(colors)
    finite = np.isfinite(radiance).all(axis=1)
    if not finite.any():
        raise SceneError("a probe sees no pixel that is finite: are colours or lights of the scene too large?")
    if not finite.all():
        _log.warning("%d pixels of a probe's faces are not finite, and left out", np.count_nonzero(~finite))
        return CubeSamples(cube.directions[finite], radiance[finite], cube.weights[finite])
    return CubeSamples(cube.directions, radiance, cube.weights)


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
