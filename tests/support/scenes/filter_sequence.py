"""Runs the light filter over several frames; tests give surfaces and samples, so neither scene nor tracer is needed."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import numpy.typing as npt
import warp as wp

import lumisplat as ls
from lumisplat.device.gi.surfaces import LightHistory, Reprojection, SurfaceLight, SurfacePixels
from lumisplat.renderer.realtime.gbuffer import PixelSurfaces
from lumisplat.renderer.realtime.gbuffer_kernels import find_previous
from lumisplat.renderer.realtime.light_filter import LightFilter
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.renderer.scene.motion import in_size_of
from lumisplat.runtime.buffers import Buffers, device_array
from lumisplat.runtime.launcher import Launcher
from support.scenes.gi_surfaces import Doubles, VisibleSurfaces, camera_rows, sequence_row

LOBE_WIDTHS = 1.5
"""Width of the averages of glossy light, in widths of the highlight."""

Mask = npt.NDArray[np.bool_]


class FilterSequence:
    """Runs a light filter frame by frame.

    Args:
        threads: CPU threads.
        parallel: Option of `Launcher`.
        shared: Number of pixels that share a sample.
        is_indirect: Whether the light is indirect.
        **settings: Fields of `FilterConfig`.
    """

    def __init__(
        self,
        threads: int = 1,
        parallel: bool = False,
        *,
        shared: int = 1,
        is_indirect: bool = False,
        **settings: int,
    ) -> None:
        self._buffers = Buffers("cpu")
        launcher = Launcher("cpu", threads=threads, parallel=parallel)
        given = ls.config.FilterConfig(**settings)
        self.filter = LightFilter(
            launcher, self._buffers, given, "light", shared=shared, lobe_widths=LOBE_WIDTHS, is_indirect=is_indirect
        )
        self.frame = 0
        self.history_weight = 1.0
        """Weight of history in the next frames, as in ``Motion``."""
        self._seen: VisibleSurfaces | None = None
        self._before: SurfacePixels | None = None

    def render(
        self, seen: VisibleSurfaces, diffuse: Doubles, glossy: Doubles | None = None, sampled: Mask | None = None
    ) -> Doubles:
        """Returns the filtered light of the next frame, shape (pixels, 2, 3): diffuse and glossy.

        Args:
            seen: Surfaces at the pixels; ``previous`` holds their positions in the last frame.
            diffuse: Diffuse samples, shape (pixels, 3).
            glossy: Glossy samples, shape (pixels, 3); None for half of the diffuse ones.
            sampled: True for pixels that have a sample; None for all.
        """
        light = SurfaceLight()
        samples = diffuse, 0.5 * diffuse if glossy is None else glossy
        light.is_sampled = wp.array(np.ones(len(diffuse), bool) if sampled is None else sampled, dtype=wp.bool)
        light.diffuse, light.glossy = (wp.array(x.astype(np.float32), dtype=wp.vec3) for x in samples)
        before = self._seen or seen
        now = seen.upload()
        scene = SimpleNamespace(
            camera=camera_rows(seen.camera, offset=seen.offset),
            motion=SimpleNamespace(
                camera=camera_rows(in_size_of(seen.camera, before.camera)),
                sequence=sequence_row(self.frame, self.history_weight, (before.camera, seen.camera)),
                size_before=before.camera.image_size,
            ),
            image_size=(seen.camera.width, seen.camera.height),
        )
        surfaces = self._surfaces(now, scene)
        found = self.filter.filter(cast(DeviceScene, scene), surfaces, light, self.frame)
        self._seen, self._before = seen, now
        self.frame += 1
        return np.stack([values(found.diffuse), values(found.glossy)], axis=1)

    def _surfaces(self, now: SurfacePixels, scene: SimpleNamespace) -> PixelSurfaces:
        """Returns the surfaces of a frame with those of the last one, and the pixels that showed them there."""
        width, height = scene.image_size
        before = self._before or now
        reprojection = self._buffers.struct("reprojection", Reprojection, width * height)
        inputs = [0, wp.vec2i(width, height), now, before, scene.motion.sequence]
        inputs += [scene.camera, scene.motion.camera, reprojection]
        wp.launch(find_previous, width * height, inputs=inputs, device="cpu")
        return PixelSurfaces(1, now, before, reprojection)

    def history(self) -> LightHistory:
        """Returns the history of the last frame."""
        assert self._before is not None
        count = len(device_array(self._before.share))
        return self._buffers.struct(f"light.history{(self.frame - 1) % 2}", LightHistory, count)

    def ages(self) -> Doubles:
        """Returns the number of frames in each pixel's history."""
        return values(self.history().frames)


def values(array: wp.array[Any]) -> Doubles:
    """Copies a device array to float64."""
    return device_array(array).numpy().astype(np.float64)
