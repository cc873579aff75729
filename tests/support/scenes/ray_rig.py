"""Traces rays through meshes only, to test the ray tracer's mesh path apart from its kernel for Gaussians."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt

from lumisplat.config import Pipeline, RenderConfig
from lumisplat.device.structs.rays import GaussianHits, MeshHits, RayData
from lumisplat.renderer.integrators.whitted import WhittedIntegrator
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.renderer.scene.frame_plan import FramePlan
from lumisplat.renderer.trace.primary_hits import PrimaryHits
from lumisplat.renderer.trace.ray_tracer import MeshTracer
from lumisplat.runtime.buffers import Buffers
from lumisplat.runtime.launcher import Launcher
from lumisplat.scene.scene import Scene
from support.scenes.raster_scenes import front_camera


@dataclass(frozen=True)
class Hits:
    """Closest triangle of each ray, one row per ray."""

    t: np.ndarray  # (N,), inf if nothing is hit
    face: np.ndarray  # (N,), index among the faces of all meshes; -1 for none
    instance: np.ndarray
    weights: np.ndarray  # (N, 3), barycentric


class RayRig:
    """Traces rays through scenes of meshes.

    Args:
        device: Warp device name.
        threads: CPU threads.
        color: Colour of a layer of Gaussians in front of every mesh, the same for each ray.
        transmittance: Transmittance of that layer.
        parallel: Use the CUDA schedule; None uses it only on CUDA.
    """

    def __init__(
        self,
        device: str = "cpu",
        threads: int | None = None,
        color: tuple[float, float, float] = (0.0, 0.0, 0.0),
        transmittance: float = 1.0,
        parallel: bool | None = None,
    ) -> None:
        self._launcher = Launcher(
            device, threads, parallel=parallel, profile=True
        )  # the host reads the rays, so nothing is captured as a graph
        self.buffers = Buffers(device)
        self._config = RenderConfig(pipeline=Pipeline.TRACE, lighting=False)
        self.scene = DeviceScene(self._launcher, Buffers(device), self._config)
        self.color, self.transmittance = color, transmittance
        self._meshes = MeshTracer(self._launcher, self.buffers)
        self.waves: list[SimpleNamespace] = []
        """Rays of each wave of the last call: fields of ``RayData`` as NumPy arrays, and hit distances ``t_max``."""

    def hits(
        self, scene: Scene, origins: npt.ArrayLike, directions: npt.ArrayLike, **limits: float | np.ndarray
    ) -> Hits:
        """Returns the closest triangles; ``t_min`` and ``t_max`` default to 0 and infinity."""
        self._sync(scene, RenderConfig(pipeline=Pipeline.TRACE, lighting=False))
        rays = self._rays(origins, directions, **limits)
        hits = self._meshes.find(self.scene, rays, "test.hits")
        face, weights = hits.face.numpy().copy(), hits.weights.numpy()
        missed = face < 0
        instance = np.where(missed, -1, hits.instance.numpy())
        weights = np.where(missed[:, None], 0.0, np.column_stack([1.0 - weights.sum(axis=1), weights]))
        return Hits(hits.t.numpy().copy(), face, instance, weights)

    def colors(
        self,
        scene: Scene,
        origins: npt.ArrayLike,
        directions: npt.ArrayLike,
        *,
        bounces: int = 3,
        background: tuple[float, float, float] = (0.0, 0.0, 0.0),
        **limits: float | np.ndarray,
    ) -> np.ndarray:
        """Returns the colours of rays, including mirrors and glass, shape (N, 3)."""
        config = RenderConfig(pipeline=Pipeline.TRACE, lighting=False, background=background, max_bounces=bounces)
        plan = self._sync(scene, config)
        self.waves = []
        hits = self.find_hits(self.scene, self._rays(origins, directions, **limits), "test")
        tracer: Any = self
        integrator = WhittedIntegrator(self._launcher, self.buffers, config, tracer)
        integrator.begin_sample(self.scene, 0)
        return integrator.shade(self.scene, plan, hits).row.radiance.captured.numpy().copy()

    def find_hits(self, scene: DeviceScene, rays: RayData, name: str, *, bounced: bool = False) -> PrimaryHits:
        """Replaces the ray tracer's method: finds meshes, and puts the same Gaussians in front of all of them."""
        meshes = self._meshes.find(scene, rays, f"{name}.meshes")
        self._record(rays, meshes)
        gaussians = self.buffers.struct(f"{name}.gaussians", GaussianHits, rays.t_max.shape[0])
        gaussians.color.fill_(self.color)
        gaussians.transmittance.fill_(self.transmittance)
        return PrimaryHits(rays, meshes, gaussians)

    def _sync(self, scene: Scene, config: RenderConfig) -> FramePlan:
        if config != self._config:
            self.scene, self._config = DeviceScene(self._launcher, Buffers(self._launcher.device), config), config
        plan = FramePlan.of(config, scene)
        self.scene.sync(scene, front_camera(), plan)
        self.scene.begin_sample(0)
        return plan

    def _rays(
        self,
        origins: npt.ArrayLike,
        directions: npt.ArrayLike,
        t_min: float | np.ndarray = 0.0,
        t_max: float | np.ndarray = np.inf,
    ) -> RayData:
        origins = self.scene.frame.points(np.asarray(origins)).astype(np.float32)
        count = len(origins)
        rays = self.buffers.struct("test.rays", RayData, count)
        rays.origin.assign(origins)
        rays.direction.assign(np.asarray(directions, np.float32))
        rays.is_active.assign(np.broadcast_to(np.greater(t_max, t_min), count))
        rays.t_min.assign(np.full(count, t_min, np.float32))
        rays.t_max.assign(np.full(count, t_max, np.float32))
        rays.path_length.zero_()
        rays.spread.zero_()
        rays.normal.zero_()
        rays.sample_key.assign(np.arange(count, dtype=np.uint32))
        rays.pixel_key.assign(np.arange(count, dtype=np.uint32))
        rays.sample.zero_()
        return rays

    def _record(self, rays: RayData, meshes: MeshHits) -> None:
        active = np.asarray(rays.is_active.numpy(), bool)
        fields = ("origin", "direction", "path_length", "sample_key")
        wave = {name: getattr(rays, name).numpy()[active] for name in fields}
        wave["origin"] = wave["origin"] + self.scene.frame.origin
        self.waves.append(SimpleNamespace(**wave, t_max=meshes.t.numpy()[active]))
