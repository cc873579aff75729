"""Finds the ellipsoids whose normals rasterised Gaussians have with ``NormalMethod.ELLIPSOID``."""

from __future__ import annotations

import math

from lumisplat.config import NormalMethod, RenderConfig
from lumisplat.device.structs.raster import SplatEllipsoid
from lumisplat.device.structs.rays import GaussianHits
from lumisplat.renderer.raster import ellipsoid_kernels
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.runtime.buffers import Buffers, DeviceArray
from lumisplat.runtime.launcher import Launcher


class Ellipsoids:
    """Finds the ellipsoids at which the Gaussians of a frame end, if its normals are those of ellipsoids.

    Args:
        launcher: Runs the kernels.
        buffers: Holds the arrays.
        config: Settings, which stay the same for the lifetime of the object.
    """

    def __init__(self, launcher: Launcher, buffers: Buffers, config: RenderConfig) -> None:
        self._launcher, self._buffers, self._dilation = launcher, buffers, config.raster.dilation
        self.are_used = config.trace.normal_method is NormalMethod.ELLIPSOID
        """True if frames have normals of ellipsoids; False: of splats."""
        self.none = buffers.get("raster.no_ellipsoids", SplatEllipsoid, 0)
        """Empty array, which leaves splats their normals."""

    def find(self, scene: DeviceScene, rects: DeviceArray) -> DeviceArray:
        """Returns the ellipsoid of each Gaussian that a tile of ``rects`` lists; empty if frames use none."""
        if not self.are_used:
            return self.none
        count = scene.gaussian_count
        found = self._buffers.get("raster.ellipsoids", SplatEllipsoid, count)
        inputs = (scene.splat_camera, self._dilation, scene.splat_instances, scene.gaussians, rects, found)
        self._launcher.run_banded(ellipsoid_kernels.find_ellipsoids, count, *inputs)
        return found

    def set_normals(self, scene: DeviceScene, ellipsoids: DeviceArray, hits: GaussianHits) -> None:
        """Gives pixels that show one opaque Gaussian the normal of its ellipsoid, if frames use ellipsoids."""
        if self.are_used:
            inputs = (scene.splat_camera, ellipsoids, hits)
            self._launcher.run_banded(ellipsoid_kernels.set_hit_normals, math.prod(scene.image_size), *inputs)
