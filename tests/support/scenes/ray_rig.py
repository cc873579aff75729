"""Rays among meshes without Gaussians: what the ray tracer does around its Gaussian kernel, for tests of just that."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np

from lumisplat.config import RenderConfig
from lumisplat.device.structs.rays import GaussianHits, RayData
from lumisplat.renderer.integrators.specular_waves import SpecularWaves
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.renderer.trace.mesh_trace import MeshTracer
from lumisplat.renderer.trace.primary_hits import PrimaryHits
from lumisplat.runtime.buffers import Buffers
from lumisplat.runtime.launcher import Launcher
from lumisplat.scene.scene import Scene
from support.scenes.raster_scenes import front_camera


@dataclass(frozen=True)
class Hits:
    """What rays meet, one row a ray."""

    t: np.ndarray  # inf: nothing
    face: np.ndarray  # among the faces of all meshes; -1: none
    instance: np.ndarray
    weights: np.ndarray  # (N, 3), barycentric


class RayRig:
    """Follows rays through scenes of meshes.

    Args:
        device: Warp device name.
        threads: CPU threads.
        color: What the Gaussians before every mesh give a ray.
        transmittance: What they leave of the light behind them.
    """

    def __init__(
        self,
        device: str = "cpu",
        threads: int | None = None,
        color: tuple[float, float, float] = (0.0, 0.0, 0.0),
        transmittance: float = 1.0,
    ) -> None:
        launcher = Launcher(device, threads)
        self.buffers = Buffers(device)
        self.scene = DeviceScene(device)
        self.mesh_hits = MeshTracer(launcher, self.buffers)
        self.bounces = SpecularWaves(launcher, self.buffers, self.mesh_hits)
        self.color, self.transmittance = color, transmittance
        self.waves: list[SimpleNamespace] = []
        """The rays of each wave of the last call: the fields of ``RayData`` as NumPy arrays."""

    def hits(self, scene: Scene, origins: np.ndarray, directions: np.ndarray, **limits: float | np.ndarray) -> Hits:
        """The nearest triangles; ``t_min`` and ``t_max`` are 0 and infinite unless given."""
        self._sync(scene, (0.0, 0.0, 0.0))
        rays = self._rays(origins, directions, **limits)
        hits = self.mesh_hits.find(self.scene, rays, "test.hits")
        face, weights = hits.face.numpy().copy(), hits.weights.numpy()
        missed = face < 0
        instance = np.where(missed, -1, hits.instance.numpy())
        weights = np.where(missed[:, None], 0.0, np.column_stack([1.0 - weights.sum(axis=1), weights]))
        return Hits(rays.t_max.numpy().copy(), face, instance, weights)

    def colors(
        self,
        scene: Scene,
        origins: np.ndarray,
        directions: np.ndarray,
        *,
        bounces: int = 3,
        background: tuple[float, float, float] = (0.0, 0.0, 0.0),
        **limits: float | np.ndarray,
    ) -> np.ndarray:
        """What rays see, mirrors and glass included, shape (N, 3)."""
        self._sync(scene, background)
        self.waves = []
        rays = self._rays(origins, directions, **limits)
        hits = self.mesh_hits.find(self.scene, rays, "test.hits")
        radiance = self._radiance(rays, "test.radiance")
        colors = self.bounces.resolve(
            self.scene,
            PrimaryHits(rays, hits, radiance),
            trace=lambda wave: self._radiance(wave, "test.wave"),
            bounces=bounces,
        )
        return colors.numpy().copy()

    def _sync(self, scene: Scene, background: tuple[float, float, float]) -> None:
        self.scene.sync(scene, front_camera(), RenderConfig(background=background))
        self.scene.sync_rays(scene)

    def _rays(
        self,
        origins: np.ndarray,
        directions: np.ndarray,
        t_min: float | np.ndarray = 0.0,
        t_max: float | np.ndarray = np.inf,
    ) -> RayData:
        count = len(origins)
        rays = self.buffers.struct("test.rays", RayData, count)
        rays.origin.assign(np.asarray(origins, np.float32))
        rays.direction.assign(np.asarray(directions, np.float32))
        rays.t_min.assign(np.full(count, t_min, np.float32))
        rays.t_max.assign(np.full(count, t_max, np.float32))
        rays.path_length.zero_()
        rays.sample_key.assign(np.arange(count, dtype=np.uint32))
        rays.pixel_key.assign(np.arange(count, dtype=np.uint32))
        return rays

    def _radiance(self, rays: RayData, name: str) -> GaussianHits:
        self._record(rays)
        radiance = self.buffers.struct(name, GaussianHits, rays.t_max.shape[0])
        radiance.color.fill_(self.color)
        radiance.transmittance.fill_(self.transmittance)
        return radiance

    def _record(self, rays: RayData) -> None:
        there = rays.t_max.numpy() > rays.t_min.numpy()
        fields = ("origin", "direction", "t_max", "path_length", "sample_key")
        self.waves.append(SimpleNamespace(**{name: getattr(rays, name).numpy()[there] for name in fields}))
