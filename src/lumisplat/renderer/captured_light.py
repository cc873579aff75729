"""Light for meshes that stand in a capture without lights: what the capture shows around them.

Six small unlit frames of the captures, from the middle of the meshes, become an environment: the light of a probe, as
avatars have it (docs/adr/0093-meshes-put-into-captures.md).
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
"""Rows of the image of a capture around meshes without lights: 5.6 degrees, finer than most highlights."""

CAPTURED_LIGHT_COVERED = 0.75
"""Share of all directions that a capture must cover around meshes to light them; else a light at the camera does. Rooms
and places under a sky cover nearly all; ground without a sky covers half, from below, and would show meshes nearly
black."""

_log = logging.getLogger("lumisplat")

_FINER = 4
"""Directions across and down a pixel of the image, whose mean it is."""


def uses_captured_light(config: RenderConfig, scene: Scene) -> bool:
    """Whether the light of a scene's captures replaces the lights that it does not have, where that surrounds meshes.

    Paths and frames in real time find that light by themselves.
    """
    is_unlit = config.lighting is None and not scene.lights
    return is_unlit and bool(scene.meshes) and has_emissive_captures(scene) and not config.pipeline.bounces_light


class CapturedLightCache:
    """Finds the light of captures around meshes, and keeps it as long as both stay where they are."""

    def __init__(self) -> None:
        self._splats: tuple[SplatInstance, ...] = ()
        """Captures for which the light was found."""
        self._box = np.zeros((2, 3))
        """Box of the meshes then."""
        self._light: CapturedLight | None = None
        self._render: Callable[[Scene, Camera], Frame] | None = None
        """Renders the captures around meshes that move, which it holds on the device; None: meshes have not moved."""

    def lit(self, scene: Scene, stops: float, renderer: Callable[[], Callable[[Scene, Camera], Frame]]) -> Scene:
        """Returns the scene with the light of its captures; as it is where these do not surround its meshes.

        Args:
            scene: One that takes it, by `uses_captured_light`.
            stops: ``RenderConfig.capture_gain``.
            renderer: Makes what renders unlit frames without a background, as `lumisplat.Renderer.render` does.
        """
        box, is_same = np.stack(_bounds(scene.meshes)), _are_same_captures(scene.splats, self._splats)
        if not is_same or not np.array_equal(box, self._box):
            render = self._render or renderer()
            self._light = captured_light(scene, box, render)
            self._splats, self._box, self._render = scene.splats, box, render if is_same else None
        _warn_once(
            "there are no lights: meshes are lit by the capture around them (RenderConfig.lighting=True: by a light at "
            "the camera, RenderConfig.lighting=False: not at all)"
            if self._light
            else "there are no lights, and the capture does not surround the meshes: they are lit from the camera "
            "(RenderConfig.lighting=False: not at all; Pipeline.PATH: by the capture)"
        )
        if self._light is None:
            return scene
        return replace(scene, lights=(replace(self._light, intensity=2.0**stops),))


def captured_light(scene: Scene, box: Doubles, render: Callable[[Scene, Camera], Frame]) -> CapturedLight | None:
    """Finds the light that the captures of a scene give to what is in a box; None: they cover too little around it.

    Directions that the captures leave open get the mean of the others. The box has its corners in rows, shape (2, 3).
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
    along = panorama_directions(_FINER * rows, 2 * _FINER * rows).reshape(-1, 3)
    fine = filled[face_pixels(along, PROBE_FACE_PX)].reshape(rows, _FINER, 2 * rows, _FINER, 3)
    image = fine.mean(axis=(1, 3)).astype(np.float32)
    return CapturedLight(image, visible=False, casts_shadow=False, name="capture")


def _bounds(meshes: tuple[MeshInstance, ...]) -> tuple[Doubles, Doubles]:
    lows, highs = zip(*(instance.bounds() for instance in meshes), strict=True)
    return np.min(lows, axis=0), np.max(highs, axis=0)


def _are_same_captures(now: tuple[SplatInstance, ...], before: tuple[SplatInstance, ...]) -> bool:
    """Whether captures look the same: the same Gaussians at the same places."""
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
def _warn_once(line: str) -> None:
    """Logs a line, once a process: renderers come and go, and what was assumed stays."""
    _log.warning("%s", line)
