"""Shadow offsets: surfaces of Gaussians do not shadow themselves, but objects on them do."""

from __future__ import annotations

import numpy as np
import pytest

import lumisplat as ls
from support.scenes.light_rig import PIPELINES, floor_points, lit
from support.scenes.raster_scenes import flat_sh, one_gaussian
from support.scenes.shadow_rig import SCHEDULES, ShadowRig
from support.scenes.trace_scenes import similarity

AHEAD = np.array([0.0, 0.0, 1.0])
OVERHEAD = ls.LightDirectional((0.1, -1.0, 0.05), intensity=3.0)


@pytest.mark.parametrize("schedule", SCHEDULES)
@pytest.mark.parametrize(
    "method", [ls.config.ShadowMethod.EXACT, ls.config.ShadowMethod.FIRST_HITS], ids=lambda method: method.value
)
def test_shadow_offset_between_two_gaussians_is_that_of_the_smaller_one(
    schedule: str, method: ls.config.ShadowMethod
) -> None:
    """A Gaussian blocks beyond the smaller of the offsets of either Gaussian, in scales and in world units."""
    rig = ShadowRig(schedule)
    for scale, placed, t_min, absolute, arrives in (
        (0.2, 1.0, 9.0, 0.0, 0.5),  # 4 * 0.2 < 1: the blocking Gaussian's offset is smaller than the distance
        (0.3, 1.0, 9.0, 0.0, 1.0),  # 4 * 0.3 > 1
        (0.3, 1.0, 0.9, 0.0, 0.5),  # the surface's Gaussian is smaller
        (0.1, 3.0, 9.0, 0.0, 1.0),  # 4 * 0.1 * 3 > 1: an instance of scale 3
        (0.2, 1.0, 9.0, 0.3, 1.0),  # 4 * 0.2 + 0.3 > 1
    ):
        small = one_gaussian((0.0, 0.0, 1.0 / placed), scale, 0.5)
        scene = ls.Scene([ls.SplatInstance(small, similarity(scale=placed))])
        light = rig.light(scene, np.zeros(3), AHEAD, t_min=t_min, method=method, offset=4.0, offset_absolute=absolute)
        assert light[0, 0] == pytest.approx(arrives, abs=1e-5), (scale, placed, t_min, absolute)


@pytest.mark.parametrize("schedule", SCHEDULES)
def test_gaussian_casts_a_shadow_if_the_light_is_nearer_than_the_shadow_ray_offset(schedule: str) -> None:
    """The small Gaussian is nearer than the offset of the wide one."""
    scene = ls.Scene([one_gaussian((0.0, 0.0, 0.5), 0.05, 0.5)])
    light = ShadowRig(schedule).light(scene, np.zeros((2, 3)), AHEAD, t_min=3.0, t_max=[1.0, 0.4])
    np.testing.assert_allclose(light[:, 0], [0.5, 1.0], atol=1e-5)


def discs(points: np.ndarray, normals: np.ndarray, scale: float, thickness: float) -> ls.Gaussians:
    """Returns opaque grey discs."""
    half = normals + np.array([0.0, 0.0, 1.0])
    quaternions = np.stack([half[:, 2], -half[:, 1], half[:, 0], np.zeros(len(points))], axis=1)
    scales = np.tile([scale, scale, thickness], (len(points), 1))
    quaternions = quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)
    colors = np.full((len(points), 3), 0.5)
    return ls.Gaussians(points, quaternions, scales, np.full(len(points), 0.95), flat_sh(colors))


def floor_of_discs(scale: float, thickness: float, height_noise: float, tilt: float) -> ls.Gaussians:
    """Returns a floor at y = 0 of discs with random heights and tilts (standard deviations, units and radians)."""
    rng = np.random.default_rng(3)
    coordinates = np.arange(-1.5, 1.5, 0.75 * scale)
    x, z = (axis.ravel() for axis in np.meshgrid(coordinates, coordinates))
    normals = np.array([0.0, 1.0, 0.0]) + rng.normal(0.0, tilt, (len(x), 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return discs(np.stack([x, rng.normal(0.0, height_noise, len(x)), z], axis=1), normals, scale, thickness)


def ball_of_discs(center: tuple[float, float, float], radius: float, count: int = 3000) -> ls.Gaussians:
    """Returns a ball of discs along a spiral."""
    y = 1.0 - 2.0 * (np.arange(count) + 0.5) / count
    angle = np.arange(count) * np.pi * (3.0 - np.sqrt(5.0))
    ring = np.sqrt(1.0 - y * y)
    normals = np.stack([ring * np.cos(angle), y, ring * np.sin(angle)], axis=1)
    spacing = radius * np.sqrt(4.0 * np.pi / count)
    return discs(np.array(center) + radius * normals, normals, 0.7 * spacing, 0.2 * spacing)


def floor_light(splats: list[ls.Gaussians], pipeline: ls.Pipeline) -> tuple[np.ndarray, np.ndarray]:
    """Returns the unshadowed fraction of light at N pixels of the floor, (N,), and the positions, (N, 3)."""
    camera = ls.Camera.look_at((0.0, 0.5, 2.5), (0.0, 0.0, 0.0), width=96, height=64, fov_y=0.35)
    scene = ls.Scene([ls.SplatInstance(one, material=ls.MaterialPbr()) for one in splats], lights=[OVERHEAD])
    frame = lit(scene, camera, pipeline, aovs=("lights",))
    assert frame.light_shadow is not None
    is_floor = (frame.instance_index == 0) & (frame.alpha > 0.95)
    return frame.light_shadow[0][is_floor].mean(axis=-1), floor_points(camera)[is_floor]


@PIPELINES
def test_objects_close_above_wide_splats_cast_shadows_on_them(pipeline: ls.Pipeline) -> None:
    """A ball is 0.05 to 0.45 above discs of scale 0.2, that is, within four scales."""
    ball = ball_of_discs((0.0, 0.25, -0.1), 0.2)
    share, points = floor_light([floor_of_discs(0.2, 0.01, 0.005, 0.02), ball], pipeline)
    below = points - 0.25 / OVERHEAD.direction[1] * np.array(OVERHEAD.direction)
    distance = np.hypot(below[:, 0], below[:, 2] + 0.1)
    assert (distance < 0.13).sum() > 30
    assert share[distance < 0.13].mean() < 0.02
    assert share[distance > 0.35].mean() > 0.999


@PIPELINES
def test_surface_of_splats_scattered_in_height_and_tilt_does_not_shadow_itself(pipeline: ls.Pipeline) -> None:
    """Disc heights scatter by 0.6 of their scale, and tilts by 20 degrees, as in captures."""
    share, _ = floor_light([floor_of_discs(0.05, 0.01, 0.03, 0.35)], pipeline)
    assert len(share) > 1000
    assert share.mean() > 0.98
