"""Host pass: the surfaces that the pixels of a frame show, and those of the frame before."""

from __future__ import annotations

from dataclasses import dataclass

from lumisplat.device.structs.gi import SurfacePixels
from lumisplat.renderer.realtime import gbuffer_kernels as kernels
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.renderer.trace.ray_wave import RayWave
from lumisplat.runtime.buffers import Buffers, device_array
from lumisplat.runtime.launcher import KernelModule, Launcher

SPLATS, MESHES = 0, 1
"""The two kinds of surfaces that a pixel may show: slots of its ray's interactions."""


@dataclass(frozen=True, slots=True)
class Surfaces:
    """The surfaces of one kind."""

    kind: int
    """SPLATS or MESHES."""
    now: SurfacePixels
    before: SurfacePixels
    """Of the frame before."""


class GBuffer:
    """Keeps the surfaces of two frames.

    Args:
        launcher: Runs the kernels.
        buffers: Holds the arrays.
    """

    def __init__(self, launcher: Launcher, buffers: Buffers) -> None:
        self._launcher, self._buffers = launcher, buffers
        self._kinds_before: tuple[int, ...] = ()

    @staticmethod
    def modules() -> list[KernelModule]:
        """The kernel modules."""
        return [kernels]

    def forget(self) -> None:
        """No surface was there before."""
        self._kinds_before = ()

    def store(self, scene: DeviceScene, wave: RayWave, frame: int) -> list[Surfaces]:
        """The surfaces of the kinds that the scene has.

        Args:
            scene: The scene on the device, synced.
            wave: The first wave of the frame, with one ray a pixel.
            frame: Its number.
        """
        kinds = kinds_of(scene)
        with self._launcher.stage("gbuffer"):
            surfaces = [self._store(scene, wave, frame, kind) for kind in kinds]
        self._kinds_before = kinds
        return surfaces

    def _store(self, scene: DeviceScene, wave: RayWave, frame: int, kind: int) -> Surfaces:
        now, before = self._pixels(scene, kind, frame), self._pixels(scene, kind, frame + 1)
        if kind not in self._kinds_before:
            device_array(before.share).zero_()
        run, motion = self._launcher.run_banded, scene.motion
        if kind == SPLATS:
            inputs = scene.camera, scene.shading, scene.gaussians, motion.splats, wave.data, now
            run(kernels.store_splat_surfaces, wave.count, *inputs)
        else:
            inputs = scene.camera, scene.shading, motion.meshes, wave.data, now
            run(kernels.store_mesh_surfaces, wave.count, *inputs)
        return Surfaces(kind, now, before)

    def _pixels(self, scene: DeviceScene, kind: int, frame: int) -> SurfacePixels:
        width, height = scene.image_size
        return self._buffers.struct(f"gbuffer.{kind}.{frame % 2}", SurfacePixels, width * height)


def kinds_of(scene: DeviceScene) -> tuple[int, ...]:
    """The kinds of surfaces that pixels may show."""
    return (SPLATS,) * (scene.gaussian_count > 0) + (MESHES,) * (scene.triangle_count > 0)
