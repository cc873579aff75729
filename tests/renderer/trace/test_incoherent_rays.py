"""Stochastic hits of rays that traverse BVHs singly equal those of packets."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.config import HitDistance, Pipeline, RenderConfig, TraceConfig, TraceStrategy
from lumisplat.device.structs.rays import RayData
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.renderer.scene.frame_plan import FramePlan
from lumisplat.renderer.trace.gaussian_trace import GaussianTracer
from lumisplat.renderer.trees.ray_order import ray_order
from lumisplat.runtime.buffers import Buffers, device_array
from lumisplat.runtime.launcher import Launcher
from support.scenes.raster_scenes import front_camera, random_gaussians, similarity

COUNT = 512


class Rig:
    """Rays in random directions through a scene.

    Args:
        spread: Footprint of the rays; above 0, they widen Gaussians.
        threads: CPU threads.
        trace: Fields of ``TraceConfig``.
    """

    def __init__(self, *, spread: float = 0.0, threads: int = 1, **trace: object) -> None:
        self.launcher, self.buffers = Launcher("cpu", threads), Buffers("cpu")
        wanted = replace(TraceConfig(strategy=TraceStrategy.STOCHASTIC_HIT), **trace)
        config = RenderConfig(pipeline=Pipeline.TRACE, lighting=False, trace=wanted)
        near = ls.SplatInstance(random_gaussians(1, 400), similarity(offset=(0.2, 0.0, -0.3), scale=1.3))
        far = ls.SplatInstance(replace(random_gaussians(2, 300), kernel_degree=3), similarity((0.3, 1.0, 0.0), 0.8))
        scene = ls.Scene([near, far, ls.SplatInstance(random_gaussians(3, 200))])
        self.scene = DeviceScene(self.launcher, Buffers("cpu"), config)
        self.scene.sync(scene, front_camera(), FramePlan.of(config, scene))
        self.tracer = GaussianTracer(self.launcher, self.buffers, config)
        self.rays = self._rays(spread)

    def hits(self, *, alone: bool) -> dict[str, np.ndarray]:
        """Returns the hits of the rays, traversing singly or in packets."""
        self.tracer._is_stochastic_hit = alone
        hits = self.tracer.find(self.scene, self.rays, self.rays.t_max, f"alone {alone}", bounced=True)
        names = ("color", "normal", "transmittance", "depth", "gaussian", "hits")
        return {name: device_array(getattr(hits, name)).numpy().copy() for name in names}

    def _rays(self, spread: float) -> RayData:
        rng = np.random.default_rng(4)
        rays = self.buffers.struct("test.rays", RayData, COUNT)
        along = rng.normal(size=(COUNT, 3))
        values = {
            "is_active": rng.random(COUNT) < 0.9,
            "origin": np.array([0.0, 0.0, 4.0]) + rng.normal(0.0, 1.0, (COUNT, 3)),
            "direction": along / np.linalg.norm(along, axis=1, keepdims=True),
            "t_min": rng.choice([0.0, 0.4], COUNT),
            "t_max": rng.choice([1.5, np.inf], COUNT),
            "path_length": rng.uniform(0.0, 3.0, COUNT),
            "spread": np.full(COUNT, spread),
            "sample_key": np.arange(COUNT) * 77,
            "pixel_key": np.arange(COUNT),
            "sample": np.zeros(COUNT),
        }
        for name, array in values.items():
            target = device_array(getattr(rays, name))
            target.assign(array.astype(target.numpy().dtype))
        return rays


@pytest.mark.parametrize("spread", [0.0, 0.05])
@pytest.mark.parametrize("distance", list(HitDistance))
def test_stochastic_hits_of_single_rays_equal_those_of_ray_packets(distance: HitDistance, spread: float) -> None:
    """The hits are equal for every hit distance, offset, kernel degree and footprint, except where rounding decides."""
    rig = Rig(spread=spread, hit_distance=distance, dilation=0.3 if spread else 0.0)
    alone, packets = rig.hits(alone=True), rig.hits(alone=False)
    active = device_array(rig.rays.is_active).numpy().astype(bool)
    same = alone["gaussian"] == packets["gaussian"]
    assert 0.2 < (packets["gaussian"][active] >= 0).mean() < 1.0
    assert same.mean() > 0.995  # rounding changes the outcome of a few draws
    for name, values in alone.items():
        np.testing.assert_allclose(values[same], packets[name][same], rtol=2e-4, atol=2e-4, err_msg=name)


def test_stochastic_hits_of_single_rays_do_not_depend_on_thread_count() -> None:
    """Neither does the order in which rays are processed depend on threads."""
    (one, other), rig = ((Rig(threads=threads).hits(alone=True)) for threads in (1, 3)), Rig()
    for name in one:
        np.testing.assert_array_equal(one[name], other[name])
    order = device_array(ray_order(rig.launcher, rig.buffers, rig.rays, 1.0)).numpy()[:COUNT]
    assert sorted(order) == list(range(COUNT))
    active = device_array(rig.rays.is_active).numpy().astype(bool)[order]
    assert active[: active.sum()].all(), "rays that are none come last"
