"""Limits of the rasteriser: scenes that it draws differently, which it logs once."""

from __future__ import annotations

import logging

from lumisplat.config import NormalMethod, TraceConfig
from lumisplat.constants import KERNEL_DEGREE
from lumisplat.scene.scene import Scene

_log = logging.getLogger("lumisplat")


class RasterWarnings:
    """Logs each limit once a renderer."""

    def __init__(self) -> None:
        self._warned_of_degrees: set[int] = set()
        self._has_warned_of_mirrors = False
        self._has_warned_of_normals = False

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

    def warn_of_normals(self, config: TraceConfig) -> None:
        """Logs once that what the camera sees itself in hybrid frames has the normals of rasterised Gaussians."""
        if config.normal_method is NormalMethod.ELLIPSOID and not self._has_warned_of_normals:
            self._has_warned_of_normals = True
            _log.warning(
                "NormalMethod.ELLIPSOID is not used for what the camera sees itself in the hybrid pipeline: "
                "Pipeline.TRACE uses it"
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
