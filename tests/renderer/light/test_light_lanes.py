"""Kernels of CPUs that compute 16 rays at a time give the bits of the kernels that compute one ray at a time."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.renderer.light import surface_kernels, unshadowed_light_kernels
from lumisplat.renderer.trace import camera_ray_kernels
from lumisplat.runtime.launcher import Launcher
from support.scenes.light_scenes import ball_at, metal, parallelogram
from support.scenes.raster_scenes import front_camera, random_gaussians

SINGLE = {
    camera_ray_kernels.start_rays_lanes: camera_ray_kernels.start_rays,
    unshadowed_light_kernels.add_hard_lights_lanes: unshadowed_light_kernels.add_hard_lights,
}
"""Kernels that compute one ray at a time, by those that compute 16 at a time."""


class SingleRays(Launcher):
    """Launcher that runs the kernels with one ray at a time."""

    def __init__(self) -> None:
        super().__init__("cpu", threads=1)
        self.replaced: set[object] = set()
        self._count = 0

    def run_banded(self, kernel: Any, count: int, *inputs: Any, bands: int | None = None) -> None:
        """Runs the kernel, or the one that replaces it for as many rays as the wave has."""
        if kernel is surface_kernels.shade_surfaces:
            self._count = count
        if kernel in SINGLE:
            self.replaced.add(kernel)
            count = len(inputs[-1].t_max) if kernel is camera_ray_kernels.start_rays_lanes else self._count
        super().run_banded(SINGLE.get(kernel, kernel), count, *inputs, bands=bands)


def assert_same_frames(content: ls.Scene, camera: ls.Camera, config: ls.RenderConfig, kernel: object) -> None:
    """Asserts that frames are equal if one ray at a time replaces ``kernel``, and that the frame needs the kernel."""
    launcher = SingleRays()
    lanes = ls.create_renderer(config, "cpu").render(content, camera)
    single = ls.Renderer(config, launcher).render(content, camera)
    assert kernel in launcher.replaced
    assert lanes.color.max() > 0.1
    np.testing.assert_array_equal(lanes.color, single.color)
    np.testing.assert_array_equal(lanes.depth, single.depth)


LIGHTS = {
    "point": ls.LightPoint((0.4, -1.5, -0.5), color=(1.0, 0.5, 0.2), intensity=7.0, range=4.0),
    "spot": ls.LightSpot((0.2, -1.6, 0.6), (-0.2, 1.0, 0.5), intensity=9.0, inner_angle=0.3, outer_angle=0.7),
    "directional": ls.LightDirectional((0.3, 0.9, 0.7), intensity=2.0),
    "rectangle": ls.LightRect((-0.6, -1.8, 1.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0), intensity=4.0),
    "disk": ls.LightDisk((0.0, -1.5, 0.5), (0.0, 1.0, 0.4), 0.4, intensity=3.0),
}
MATERIALS = [
    ls.MaterialPbr(base_color=(0.8, 0.4, 0.2), roughness=0.4),
    metal(0.05),
    metal(0.0),
    ls.MaterialPbr(roughness=0.6, clearcoat=0.8, sheen_color=(0.3, 0.5, 0.7), sheen_roughness=0.4),
    ls.MaterialSimple(diffuse=(0.5, 0.4, 0.3), specular=(0.4, 0.4, 0.4), shininess=20.0),
    ls.MaterialPbr(base_color=(0.7, 0.9, 0.8), roughness=0.5, specular=0.0),
]


def scene(*lights: Any) -> ls.Scene:
    """Returns relit Gaussians, a floor, and six balls of different materials that lie within blocks of 16 pixels."""
    wall = parallelogram((-3.0, -2.0, 3.4), (6.0, 0.0, 0.0), (0.0, 4.0, 0.0), MATERIALS[0])
    balls = [
        ball_at((0.36 * (number - 2.5), 0.4 * (-1) ** number, 1.8), 0.2, material, rows=8)
        for number, material in enumerate(MATERIALS)
    ]
    gaussians = ls.SplatInstance(random_gaussians(5, count=80), material=ls.MaterialPbr(roughness=0.5))
    return ls.Scene([gaussians], [wall, *balls], lights)


@pytest.mark.parametrize("compensates", [False, True], ids=["single scattering", "energy compensation"])
@pytest.mark.parametrize("kind", [*LIGHTS, "headlight", "all"])
def test_hard_lights_without_shadows_have_the_bits_of_single_rays(kind: str, compensates: bool) -> None:
    """Blocks of rays mix materials with and without lanes, missing surfaces, mirror rays and the image's edge."""
    lights = list(LIGHTS.values()) if kind == "all" else [LIGHTS[kind]] if kind in LIGHTS else []
    config = ls.RenderConfig(
        pipeline=ls.Pipeline.HYBRID, shadows=ls.Shadows.OFF, lighting=True, energy_compensation=compensates, samples=1
    )
    assert_same_frames(scene(*lights), front_camera(61, 43), config, unshadowed_light_kernels.add_hard_lights_lanes)


ON_WALL = {
    "point": ls.LightPoint((0.0, 0.0, 0.0)),
    "spot": ls.LightSpot((0.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
}


@pytest.mark.parametrize("light", list(ON_WALL.values()), ids=list(ON_WALL))
def test_light_on_a_surface_does_not_darken_the_surface_point_under_it(light: ls.LightPoint | ls.LightSpot) -> None:
    """The light has no direction there; other lights still light the point, as with single rays."""
    middle = ls.Camera.look_at((0.0, 0.0, -3.0), (0.0, 0.0, 0.0), width=31, height=21)
    wall = parallelogram((-2.0, -2.0, 0.0), (4.0, 0.0, 0.0), (0.0, 4.0, 0.0), MATERIALS[0])
    shown = ls.Scene((), [wall], [light, ls.LightDirectional((0.2, 0.1, 1.0))])
    config = ls.RenderConfig(pipeline=ls.Pipeline.HYBRID, shadows=ls.Shadows.OFF, samples=1)
    frame = ls.create_renderer(config, "cpu").render(shown, middle)
    assert frame.stats is not None and frame.stats.nonfinite_count == 0
    assert frame.color[10, 15].min() > 0.01
    assert_same_frames(shown, middle, config, unshadowed_light_kernels.add_hard_lights_lanes)


CAMERAS = {
    "pinhole": front_camera(83, 61),
    "window": front_camera(83, 61, window=(16, 32, 67, 29)),
    "distorted": front_camera(83, 61, distortion=(-0.2, 0.05, 0.0, 0.0, 0.001, -0.001)),
    "fisheye": front_camera(83, 61, model="fisheye"),
    "aperture": front_camera(83, 61, aperture=0.05, focus_distance=2.0),
}


@pytest.mark.parametrize("camera", list(CAMERAS.values()), ids=list(CAMERAS))
def test_camera_rays_have_the_bits_of_single_rays(camera: ls.Camera) -> None:
    """Frames of two jittered samples are equal in colour and depth with rays from both kernels."""
    config = ls.RenderConfig(pipeline=ls.Pipeline.TRACE, samples=2, jitter=True, shadows=ls.Shadows.SOFT)
    assert_same_frames(scene(LIGHTS["disk"]), camera, config, camera_ray_kernels.start_rays_lanes)
