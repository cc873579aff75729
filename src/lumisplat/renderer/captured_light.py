"""Light for meshes in captures of a scene without lights: an environment map rendered from the captures.

Six small unlit views of the captures, seen from the centre of the meshes, become the environment map
(docs/adr/0093-meshes-in-captures-are-placed-automatically.md).
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np

from lumisplat.config import RenderConfig
from lumisplat.constants import NEAR_PLANE, PROBE_FACE_PX
from lumisplat.frame.frame import Frame
from lumisplat.math.arrays import Doubles
from lumisplat.math.directions import panorama_directions
from lumisplat.renderer.cubemap import cube_solid_angles, face_pixels, render_faces
from lumisplat.renderer.scene.frame_plan import CapturedLight, has_emissive_captures
from lumisplat.scene.camera import Camera
from lumisplat.scene.scene import MeshInstance, Scene, SplatInstance

CAPTURED_LIGHT_ROWS = 32
"""Rows of the environment map that is rendered from captures: 32 rows of 5.6 degrees, finer than most highlights."""

CAPTURED_LIGHT_COVERED = 0.75
"""Captures light meshes only if they cover at least this fraction of all directions around the meshes; else, a
headlight lights the meshes. Captures of rooms, or of outdoor places with their sky, cover nearly all directions. A
floor without a sky covers half of all directions, from below, and would leave meshes nearly black."""

_log = logging.getLogger("lumisplat")

_SUBTEXELS = 4
"""Number of directions along each side of a texel of the environment map; the texel's value is their mean."""


def uses_captured_light(config: RenderConfig, scene: Scene) -> bool:
    """Returns whether the meshes of a scene without lights may be lit by an environment map of its captures.

    Path-traced and real-time frames need no such map: their rays hit the captures.
    """
    is_unlit = config.lighting is None and not scene.lights
    return is_unlit and bool(scene.meshes) and has_emissive_captures(scene) and not config.pipeline.bounces_light


class CapturedLightCache:
    """Renders an environment map of the captures around the meshes, and reuses it until captures or meshes change."""

    def __init__(self) -> None:
        self._splats: tuple[SplatInstance, ...] = ()
        """Captures from which the cached environment map was rendered."""
        self._box = np.zeros((2, 3))
        """Bounding box of the meshes around which the cached map was rendered, lowest and highest corner."""
        self._light: CapturedLight | None = None
        self._render: Callable[[Scene, Camera], Frame] | None = None
        """Function that renders the captures. If only meshes changed between the last two maps, the function is kept,
        so that the captures' Gaussians stay on the device; else None."""

    def lit(self, scene: Scene, stops: float, renderer: Callable[[], Callable[[Scene, Camera], Frame]]) -> Scene:
        """Returns the scene lit by an environment map of its captures; unchanged if captures do not surround meshes.

        Args:
            scene: A scene for which `uses_captured_light` is true.
            stops: ``RenderConfig.capture_gain``: brightness of the captures' light in stops.
            renderer: Makes a function that renders unlit frames without a background, like `lumisplat.Renderer.render`.
        """
        box, is_same = np.stack(_bounds(scene.meshes)), _are_same_captures(scene.splats, self._splats)
        if not is_same or not np.array_equal(box, self._box):
            render = self._render or renderer()
            self._light = captured_light(scene, box, render)
            self._splats, self._box, self._render = scene.splats, box, render if is_same else None
        _warn_once(
            "the scene has no lights: meshes are lit by the capture around them (RenderConfig.lighting=True: by a "
            "headlight at the camera, RenderConfig.lighting=False: unlit)"
            if self._light
            else "the scene has no lights, and the capture does not surround the meshes: a headlight at the camera "
            "lights them (RenderConfig.lighting=False: unlit; Pipeline.PATH: lit by the capture)"
        )
        if self._light is None:
            return scene
        return replace(scene, lights=(replace(self._light, intensity=2.0**stops),))


def captured_light(scene: Scene, box: Doubles, render: Callable[[Scene, Camera], Frame]) -> CapturedLight | None:
    """Renders the captures around a box of meshes as an environment light; None if too few directions are covered.

    Directions that no capture covers get the mean radiance of the covered ones.

    Args:
        scene: The scene with the captures.
        box: Lowest and highest corner of the box, world space, shape (2, 3).
        render: Renders unlit frames without a background.
    """
    low, high = box
    near = max(0.5 * float((high - low).min()), NEAR_PLANE)
    captures = Scene(splats=scene.splats)
    radiance, alpha = render_faces(captures, 0.5 * (low + high), render, PROBE_FACE_PX, near)
    weights = np.tile(cube_solid_angles(PROBE_FACE_PX).ravel(), 6)
    sound = np.isfinite(radiance).all(axis=1) & np.isfinite(alpha)
    radiance, alpha = np.where(sound[:, None], radiance, 0.0), np.where(sound, alpha, 0.0)
    covered = float(weights @ alpha)
    if covered < CAPTURED_LIGHT_COVERED * weights.sum():
        return None
    filled = radiance + (1.0 - alpha)[:, None] * (weights @ radiance / covered)
    rows = CAPTURED_LIGHT_ROWS
    along = panorama_directions(_SUBTEXELS * rows, 2 * _SUBTEXELS * rows).reshape(-1, 3)
    fine = filled[face_pixels(along, PROBE_FACE_PX)].reshape(rows, _SUBTEXELS, 2 * rows, _SUBTEXELS, 3)
    image = fine.mean(axis=(1, 3)).astype(np.float32)
    return CapturedLight(image, visible=False, casts_shadow=False, name="capture")


def _bounds(meshes: tuple[MeshInstance, ...]) -> tuple[Doubles, Doubles]:
    lows, highs = zip(*(instance.bounds() for instance in meshes), strict=True)
    return np.min(lows, axis=0), np.max(highs, axis=0)


def _are_same_captures(now: tuple[SplatInstance, ...], before: tuple[SplatInstance, ...]) -> bool:
    """Returns whether two lists of captures would look equal: same Gaussians, transforms, SH degrees and materials."""
    return len(now) == len(before) and all(
        one is other
        or (
            one.gaussians is other.gaussians
            and np.array_equal(one.transform, other.transform)
            and (one.sh_degree, one.material) == (other.sh_degree, other.material)
        )
        for one, other in zip(now, before, strict=True)
    )


@cache
def _warn_once(message: str) -> None:
    """Logs a warning once per process, however many renderers are created."""
    _log.warning("%s", message)
