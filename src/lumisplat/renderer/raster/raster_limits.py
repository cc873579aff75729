"""Limits of the rasteriser: scenes and cameras that it refuses, or draws differently and logs once."""

from __future__ import annotations

import logging

from lumisplat.constants import KERNEL_DEGREE
from lumisplat.errors import SceneError
from lumisplat.scene.camera import Camera, CameraModel
from lumisplat.scene.scene import Scene

_log = logging.getLogger("lumisplat")


def refuse_lens(camera: Camera) -> None:
    """Raises a `SceneError` for a camera that only rays can draw: not a sharp pinhole, or with a rolling shutter."""
    problem = None
    if camera.model is not CameraModel.PINHOLE:
        problem = f"is {camera.model.value}"
    elif camera.aperture > 0.0:
        problem = f"has an aperture of {camera.aperture:g}"
    elif camera.camera_from_world_end is not None:
        problem = "has a rolling shutter"
    if problem:
        name = f" '{camera.name}'" if camera.name else ""
        raise SceneError(f"camera{name} {problem}, which the raster pipeline cannot draw: use Pipeline.TRACE")


class RasterWarnings:
    """Logs each limit once a renderer."""

    def __init__(self) -> None:
        self._warned_of_degrees: set[int] = set()
        self._has_warned_of_mirrors = False

    def warn_of_mirrors(self, scene: Scene) -> None:
        """Logs once that smooth meshes only reflect the environment, or the background, in lit frames."""
        count = sum(instance.mesh.material.is_smooth for instance in scene.meshes)
        if count and not self._has_warned_of_mirrors:
            self._has_warned_of_mirrors = True
            _log.warning(
                "%d smooth meshes (mirrors, glass) show the environment alone in the raster pipeline: "
                "Pipeline.HYBRID follows what they reflect and let through",
                count,
            )

    def warn_of_degree(self, scene: Scene) -> None:
        """Logs once for each kernel degree other than the rasteriser's, which is Gaussian."""
        degrees = {instance.gaussians.kernel_degree for instance in scene.splats} - {KERNEL_DEGREE}
        for degree in sorted(degrees - self._warned_of_degrees):
            _log.warning(
                "a capture has kernel degree %d, which the raster pipeline draws as degree %d: its shapes come out "
                "right with Pipeline.TRACE",
                degree,
                KERNEL_DEGREE,
            )
        self._warned_of_degrees |= degrees
