"""The G-buffer, which holds splat and mesh surfaces at the pixels of this frame and of the previous one."""

from __future__ import annotations

from dataclasses import dataclass

import warp as wp

from lumisplat.device.gi.surfaces import Reprojection, SurfacePixels
from lumisplat.renderer.realtime import gbuffer_kernels as kernels
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.renderer.trace.ray_wave import RayWave
from lumisplat.runtime.buffers import Buffers, device_array
from lumisplat.runtime.launcher import KernelModule, Launcher

SPLATS, MESHES = 0, 1
"""Kinds of surfaces at a pixel: 0 for Gaussians, 1 for meshes. A ray has one interaction with each kind; the kind is
the index of the interaction."""


@dataclass(frozen=True, slots=True)
class PixelSurfaces:
    """Splat surfaces, or mesh surfaces, at the pixels of this frame and of the previous one."""

    kind: int
    """SPLATS (0) for surfaces of Gaussians, MESHES (1) for surfaces of meshes."""
    now: SurfacePixels
    before: SurfacePixels
    """Surfaces at the pixels of the previous frame."""
    reprojection: Reprojection
    """Pixels of the previous frame that showed the surfaces of this one."""


class GBuffer:
    """Stores the splat and mesh surfaces at the pixels of this frame and of the previous one."""

    def __init__(self, launcher: Launcher, buffers: Buffers) -> None:
        self._launcher, self._buffers = launcher, buffers
        self.kinds_before: tuple[int, ...] = ()
        """Kinds of surfaces that the previous frame of the sequence has stored."""

    @staticmethod
    def modules() -> list[KernelModule]:
        """Returns the modules of the kernels that this class launches."""
        return [kernels]

    def reset(self) -> None:
        """Begins a new sequence of frames, which has no previous frame."""
        self.kinds_before = ()

    def store(self, scene: DeviceScene, wave: RayWave, frame: int) -> list[PixelSurfaces]:
        """Stores the surfaces that camera rays hit; returns the splat and the mesh surfaces, if the scene has them."""
        kinds = (SPLATS,) * (scene.gaussian_count > 0) + (MESHES,) * (scene.triangle_count > 0)
        with self._launcher.stage("gbuffer"):
            surfaces = [self._store(scene, wave, frame, kind) for kind in kinds]
        self.kinds_before = kinds
        return surfaces

    def _store(self, scene: DeviceScene, wave: RayWave, frame: int, kind: int) -> PixelSurfaces:
        now = self._pixels(scene.image_size, kind, frame)
        before = self._pixels(scene.motion.size_before, kind, frame + 1)
        if kind not in self.kinds_before:
            device_array(before.share).zero_()
        run, motion = self._launcher.run_banded, scene.motion
        if kind == SPLATS:
            inputs = scene.camera, scene.shading, scene.gaussians, motion.splats, wave.data, now
            run(kernels.store_splat_surfaces, wave.count, *inputs)
        else:
            inputs = scene.camera, scene.shading, motion.meshes, wave.data, now
            run(kernels.store_mesh_surfaces, wave.count, *inputs)
        width, height = scene.image_size
        run(kernels.measure_footprints, width * height, wp.vec2i(width, height), scene.camera, now)
        reprojection = self._buffers.struct(f"gbuffer.{kind}.previous", Reprojection, len(now.share))
        inputs = wp.vec2i(width, height), now, before, motion.sequence, scene.camera, motion.camera, reprojection
        run(kernels.find_previous, width * height, *inputs)
        return PixelSurfaces(kind, now, before, reprojection)

    def _pixels(self, size: tuple[int, int], kind: int, frame: int) -> SurfacePixels:
        width, height = size
        return self._buffers.struct(f"gbuffer.{kind}.{frame % 2}", SurfacePixels, width * height)
