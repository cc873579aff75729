"""Computes the shadow ratios of catchers, and blurs them where captures have no clear surface.

A shadow ratio is the captured colour with added objects and lights over the captured colour without them.
"""

from __future__ import annotations

import warp as wp

from lumisplat.renderer.film import catcher_kernels as kernels
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.runtime.buffers import Buffers, DeviceArray
from lumisplat.runtime.launcher import KernelModule, Launcher


class CatcherRatios:
    """Computes the shadow ratios of catchers (docs/method/lighting.md#captures-without-a-surface).

    Args:
        launcher: Runs the kernels.
        buffers: Holds the arrays.
    """

    def __init__(self, launcher: Launcher, buffers: Buffers) -> None:
        self._launcher, self._buffers = launcher, buffers

    @staticmethod
    def modules() -> list[KernelModule]:
        """Returns the modules of the kernels that this class launches."""
        return [kernels]

    def ratios(self, count: int) -> DeviceArray:
        """Returns the array of ``count`` shadow ratios, one per pixel, for ``FilmData.ratio``."""
        return self._buffers.get("film.shadow_ratio", wp.vec3, count)

    def develop(self, scene: DeviceScene, film: DeviceArray, count: int) -> None:
        """Computes shadow ratios from the means of all samples, and then the colours of all pixels from the ratios."""
        get, run = self._buffers.get, self._launcher.run_banded
        ratio, across = self.ratios(count), get("film.ratio_across", wp.vec3, count)
        measured, rows = (get(f"film.{name}", wp.vec4, count) for name in ("depth_noise_sums", "depth_noise_rows"))
        depths, noise = (get(f"film.{name}", wp.float32, count) for name in ("catcher_depths", "depth_noise"))
        run(kernels.store_ratios, count, scene.camera, scene.shading, film, depths, ratio)
        run(kernels.measure_depths, count, scene.camera, depths, measured)
        run(kernels.sum_depths, count, False, scene.camera, measured, rows)
        run(kernels.sum_depths, count, True, scene.camera, rows, measured)
        run(kernels.find_noise, count, scene.camera, measured, noise)
        run(kernels.smooth_ratios, count, False, scene.camera, film, depths, noise, ratio, across)
        run(kernels.smooth_ratios, count, True, scene.camera, film, depths, noise, across, ratio)
        run(kernels.develop_ratios, count, film)
