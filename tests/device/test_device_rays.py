"""Tests of camera rays on the device, against a float64 oracle and closed forms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import warp as wp

import lumisplat as ls
from lumisplat.constants import SUBPIXEL_STEPS
from lumisplat.device.camera.camera import camera_ray, disk_point, rotated
from lumisplat.device.splat.blending import pixel_ray
from lumisplat.device.structs.camera import CameraData, SampleData
from lumisplat.device.structs.rays import Ray
from lumisplat.renderer.scene.camera_table import camera_table, subpixel
from lumisplat.runtime.launcher import Launcher
from lumisplat.runtime.struct_tables import table_dtype
from support.kinds import present
from support.oracles.camera_oracle import camera_rays, unit
from support.probes import probe_kernels
from support.scenes.raster_scenes import front_camera, rotation

DEVICES = ["cpu", *(device.alias for device in wp.get_cuda_devices())]
MODELS = list(ls.CameraModel)
FISHEYE, ORTHOGRAPHIC, PINHOLE = ls.CameraModel.FISHEYE, ls.CameraModel.ORTHOGRAPHIC, ls.CameraModel.PINHOLE


def device_rays(
    camera: ls.Camera, sample: int = 0, seed: int = 0, jitter: bool = True, device: str = "cpu"
) -> np.ndarray:
    """Returns the rays of all pixels as a structured array of ``Ray``, shape (H, W)."""
    cameras = wp.zeros(1, dtype=CameraData, device=device)
    cameras.assign(camera_table(camera, subpixel(sample if jitter else 0)))
    samples = wp.array([sample_of(sample, seed)], dtype=SampleData, device=device)
    rays = wp.zeros(camera.width * camera.height, dtype=Ray, device=device)
    Launcher(device, threads=1).run(probe_kernels.probe_rays, rays.shape[0], cameras, samples, rays)
    return rays.numpy().reshape(camera.height, camera.width)


def sample_of(index: int, seed: int) -> SampleData:
    """Returns the ``SampleData`` of a sample index and a seed."""
    sample = SampleData()
    sample.index, sample.seed = index, wp.uint32(seed)
    return sample


def moved_pose(angle: float = 0.7, eye: tuple[float, float, float] = (0.5, -1.0, 2.0)) -> np.ndarray:
    """Returns a camera_from_world with rotation and translation, shape (4, 4)."""
    world_from_camera = rotation((0.2, 1.0, -0.4), angle)
    world_from_camera[:3, 3] = eye
    return np.linalg.inv(world_from_camera)


def lens_camera(model: ls.CameraModel, **changes: object) -> ls.Camera:
    """Returns a camera with aperture, rolling shutter and offset principal point.

    A fisheye camera has rays that point backwards, and corners without rays.
    """
    features = {
        "camera_from_world": moved_pose(),
        "camera_from_world_end": moved_pose(1.3, (0.6, -0.8, 2.5)),
        "aperture": 0.3,
        "focus_distance": 2.5,
        "near": 0.2,
        "cx": 19.7,
        "cy": 15.1,
    }
    return front_camera(40, 30, 7.0, **{"model": model} | features | changes)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("features", [{}, {"aperture": 0.0}, {"camera_from_world_end": None}])
def test_device_camera_rays_match_the_float64_oracle(
    model: ls.CameraModel, features: dict[str, object], device: str
) -> None:
    """Origin, direction and ``t_min`` match for the first samples and for a sample above one million."""
    camera = lens_camera(model, **features)
    for sample, seed in ((0, 0), (1, 0), (2, 7), (1_000_003, 2**32 - 1)):
        rays = device_rays(camera, sample, seed, device=device)
        origins, directions, near = camera_rays(camera, sample, seed)
        missing = np.isnan(near)
        assert missing.any() == (model is FISHEYE)
        np.testing.assert_array_equal(rays["direction"][missing], 0.0)
        np.testing.assert_allclose(rays["origin"][~missing], origins[~missing], atol=3e-6)
        np.testing.assert_allclose(rays["direction"][~missing], directions[~missing], atol=3e-6)
        np.testing.assert_allclose(rays["t_min"][~missing], near[~missing], rtol=1e-5)
        np.testing.assert_array_equal(rays["path_length"], 0.0)


@pytest.mark.parametrize("model", MODELS)
def test_device_camera_ray_directions_match_the_host(model: ls.CameraModel) -> None:
    """Without aperture, the first sample's directions equal ``ray_directions``, which define depth_z."""
    camera = front_camera(40, 30, 7.0, model=model)
    np.testing.assert_allclose(device_rays(camera)["direction"], camera.ray_directions(), atol=1e-6)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("model", [ls.CameraModel.PINHOLE, FISHEYE])
@pytest.mark.parametrize(
    "lens",
    [
        (0.0578421, -0.0805099, 0.0, 0.0, -0.000980296, 0.00015575),
        (-0.28, 0.09, -0.012, 0.0, 0.0006, -0.0011),
        (0.21, 0.03, 0.01, 0.002, 0.004, -0.003),
    ],
)
def test_device_ray_directions_through_distorted_lenses_match_the_host(lens, model, device) -> None:
    """Newton's method converges in float32 to the float64 result."""
    camera = front_camera(40, 30, 23.0, model=model, distortion=lens)
    expected = camera.ray_directions()
    assert (expected != 0.0).any(axis=2).all()
    np.testing.assert_allclose(device_rays(camera, device=device)["direction"], expected, atol=3e-6)


def test_distorted_lens_has_no_rays_beyond_its_monotonic_radius() -> None:
    """Device and host agree on the pixels without rays, except at the radius itself, where rounding decides."""
    camera = front_camera(64, 48, 33.0, distortion=(-0.5, 0.0, 0.0, 0.0, 0.0, 0.0))
    missing = (camera.ray_directions() == 0.0).all(axis=2)
    found = (device_rays(camera)["direction"] == 0.0).all(axis=2)
    assert missing.any() and (found != missing).mean() < 0.01


def test_pinhole_camera_rays_match_the_rasterisers_projection() -> None:
    """Rays pass through the pixel centres of the rasteriser and start at the same near plane."""
    camera = front_camera(cx=20.3, cy=31.7, fx=50.0, fy=75.0, near=0.25)
    data = CameraData()
    data.focal, data.raster_center = wp.vec2(50.0, 75.0), wp.vec2(20.3, 31.7)
    rays = device_rays(camera)
    for y, x in ((0, 0), (47, 63), (13, 5)):
        through = np.array(pixel_ray(data, x, y))
        np.testing.assert_allclose(rays["direction"][y, x], through / np.linalg.norm(through), atol=1e-7)
        assert rays["t_min"][y, x] == pytest.approx(0.25 * np.linalg.norm(through), rel=1e-6)
    np.testing.assert_array_equal(rays["origin"], 0.0)


def test_camera_ray_called_from_python_equals_that_of_the_kernel() -> None:
    """Python and the kernel return the same ray for a pixel, and none for a corner beyond the lens."""
    camera = lens_camera(FISHEYE)
    rays = device_rays(camera, 3, 5)
    row = camera_table(camera, subpixel(3))[0]
    data, sample = CameraData(), sample_of(3, 5)
    for name in row.dtype.names:
        kind = type(getattr(data, name))
        value = row[name].tolist()
        setattr(data, name, kind(*np.ravel(value).tolist()) if row[name].ndim else kind(value))
    ray = camera_ray(data, sample, 11, 20)
    np.testing.assert_allclose(np.array(ray.origin), rays["origin"][20, 11], atol=1e-6)
    np.testing.assert_allclose(np.array(ray.direction), rays["direction"][20, 11], atol=1e-6)
    assert np.array_equal(np.array(camera_ray(data, sample, 0, 0).direction), (0.0, 0.0, 0.0))


# --- Camera models, closed forms ---


def test_fisheye_of_220_degrees_has_rays_that_point_backwards() -> None:
    """Rays at the middle of an edge point 110 degrees off the axis, and ``near`` is a distance along the ray."""
    camera = ls.Camera.look_at(
        (1, 2, 3), (1, 2, 9), (0, -1, 0), width=222, height=220, fov_y=np.radians(220.0), near=0.4, model=FISHEYE
    )
    rays = device_rays(camera)
    angle = np.radians(109.5)
    mean = unit(rays["direction"][0, 110] + rays["direction"][0, 111])
    np.testing.assert_allclose(mean, (0.0, -np.sin(angle), np.cos(angle)), atol=1e-4)
    angle = np.hypot(np.radians(109.5), np.radians(10.5))
    np.testing.assert_allclose(rays["direction"][120, 220][2], np.cos(angle), atol=1e-6)
    np.testing.assert_array_equal(rays["t_min"], np.float32(0.4))
    np.testing.assert_array_equal(rays["origin"], np.broadcast_to((1.0, 2.0, 3.0), (220, 222, 3)))


def test_orthographic_rays_start_on_the_plane_through_the_eye() -> None:
    """At 10 pixels per unit, the ray of pixel (x, y) starts 0.1 (x - cx, y - cy) off the axis."""
    rays = device_rays(front_camera(20, 10, 10.0, model=ORTHOGRAPHIC, near=0.5))
    np.testing.assert_array_equal(rays["direction"], np.broadcast_to((0.0, 0.0, 1.0), (10, 20, 3)))
    np.testing.assert_allclose(rays["origin"][2, 17], (0.75, -0.25, 0.0), atol=1e-7)
    np.testing.assert_allclose(rays["origin"][9, 0], (-0.95, 0.45, 0.0), atol=1e-7)
    np.testing.assert_array_equal(rays["t_min"], np.float32(0.5))


@pytest.mark.parametrize("model", MODELS)
def test_camera_at_threefold_resolution_keeps_the_rays_of_the_original_pixels(model: ls.CameraModel) -> None:
    """At three times the resolution, the middle of each 3 x 3 pixels has the original pixel's ray."""
    camera = lens_camera(model, aperture=0.0, camera_from_world_end=None)
    large, small = device_rays(camera.scaled(width=120)), device_rays(camera)
    for name in ("origin", "direction", "t_min"):
        np.testing.assert_allclose(large[name][1::3, 1::3], small[name], atol=1e-5)


# --- Samples ---


def test_sub_pixel_sample_positions_follow_the_r2_sequence() -> None:
    """Sample 0 is the pixel centre; all pixels share the sample offsets. Without jitter, all samples are sample 0."""
    assert subpixel(0) == (0.5, 0.5)
    np.testing.assert_allclose(subpixel(1), (0.2548776662466927, 0.0698402909980532), atol=1e-15)
    np.testing.assert_allclose(subpixel(2), (0.0097553324933854, 0.6396805819961064), atol=1e-15)
    camera = front_camera(8, 6, 5.0)
    rays = device_rays(camera, 2)["direction"].astype(np.float64)
    x = rays[..., 0] / rays[..., 2] * 5.0 + 4.0 - np.arange(8)
    y = rays[..., 1] / rays[..., 2] * 5.0 + 3.0 - np.arange(6)[:, None]
    np.testing.assert_allclose(x, 0.0097553, atol=2e-6)
    np.testing.assert_allclose(y, 0.6396806, atol=2e-6)
    np.testing.assert_array_equal(device_rays(camera, 2, jitter=False), device_rays(camera, 0))


def test_r2_sequence_steps_are_powers_of_the_plastic_number() -> None:
    """The steps are 1/g and 1/g^2, where g^3 = g + 1."""
    x, y = SUBPIXEL_STEPS
    assert 1.0 / x**3 == pytest.approx(1.0 / x + 1.0, abs=1e-14)
    assert y == pytest.approx(x * x, abs=1e-15)


def test_sub_pixel_sample_positions_are_evenly_distributed() -> None:
    """Of 64 successive samples, at most three fall into each of 32 cells and at most one cell stays empty.

    Random samples leave four cells empty.
    """
    for first in (0, 17, 1_000_003):
        points = np.array([subpixel(n) for n in range(first, first + 64)])
        x, y = (points * (8, 4)).astype(int).T
        counts = np.bincount(y * 8 + x, minlength=32)
        assert (counts == 0).sum() <= 1 and counts.max() <= 3


# --- Lens ---


def test_disk_sampling_is_uniform_in_area() -> None:
    """Equal parts of (u, v) map to equal areas in rings and sectors."""
    grid = (np.arange(40) + 0.5) / 40.0
    points = np.array([disk_point(float(u), float(v)) for u in grid for v in grid])
    radius = np.linalg.norm(points, axis=1)
    assert radius.max() < 1.0
    ring = (radius**2 * 8.0).astype(int)
    sector = ((np.arctan2(points[:, 1], points[:, 0]) / (2.0 * np.pi) % 1.0) * 8.0).astype(int)
    np.testing.assert_array_equal(np.bincount(ring * 8 + sector, minlength=64), 25)


@pytest.mark.parametrize("model", MODELS)
def test_thin_lens_rays_of_a_pixel_intersect_at_the_focus_distance(model: ls.CameraModel) -> None:
    """The rays of all samples meet at view depth 2.5, or at distance 2.5 for a fisheye."""
    camera = front_camera(12, 10, 3.0, model=model, aperture=0.4, focus_distance=2.5)
    sharp = replace(camera, aperture=0.0)
    center = device_rays(sharp)
    if model is FISHEYE:
        focus = 2.5 * center["direction"]
    else:
        focus = center["origin"] + center["direction"] * (2.5 / center["direction"][..., 2:])
        np.testing.assert_allclose(focus[..., 2], 2.5, rtol=1e-6)
    found = np.linalg.norm(center["direction"], axis=-1) > 0.5
    starts = []
    for sample in range(20):
        rays = device_rays(camera, sample, jitter=False)
        starts.append(rays["origin"])
        to_focus = focus - rays["origin"]
        miss = np.linalg.norm(np.cross(to_focus, rays["direction"]), axis=-1)
        assert miss[found].max() < 2e-6
        assert (np.einsum("yxi,yxi->yx", to_focus, rays["direction"])[found] > 0.0).all()
    assert np.ptp(np.array(starts)[:, found], axis=0).max() > 0.4


@pytest.mark.parametrize("model", MODELS)
def test_circle_of_confusion_matches_the_thin_lens_formula(model: ls.CameraModel) -> None:
    """At depths of half and twice the focus distance, the blur is a uniform disk of |depth / focus - 1| apertures."""
    camera = front_camera(64, 64, 64.0 / 1.2, model=model, aperture=0.2, focus_distance=2.0, near=1e-3)
    center, rays = device_rays(replace(camera, aperture=0.0)), device_rays(camera, 5, jitter=False)
    for depth in (1.0, 4.0):
        if model is FISHEYE:  # on the plane tangent to the sphere of that radius at the central ray
            plane = np.einsum("yxi,yxi->yx", center["direction"], rays["direction"])
            start = np.einsum("yxi,yxi->yx", center["direction"], rays["origin"])
            points = rays["origin"] + ((depth - start) / plane)[..., None] * rays["direction"]
            middle = depth * center["direction"]
        else:
            points, middle = (
                r["origin"] + ((depth - r["origin"][..., 2]) / r["direction"][..., 2])[..., None] * r["direction"]
                for r in (rays, center)
            )
        distance = np.linalg.norm(points - middle, axis=-1) / (0.2 * abs(depth / 2.0 - 1.0))
        assert 0.98 < distance.max() < 1.0 + 1e-4
        # Uniform over the disk: the squared distance is uniform in 0..1, mean 1/2, variance 1/12; 4,096 pixels.
        assert abs((distance**2).mean() - 0.5) < 4.0 / np.sqrt(12.0 * distance.size)
        assert np.abs((points - middle).mean(axis=(0, 1))).max() < 4.0 * 0.5 * 0.2 * abs(depth / 2.0 - 1.0) / 64.0


def test_aperture_disk_of_a_fisheye_is_perpendicular_to_each_camera_ray() -> None:
    """The blur has the same size across the image, for rays that point sideways or backwards, too."""
    camera = front_camera(40, 40, 9.0, model=FISHEYE, aperture=0.3, focus_distance=2.0)
    rays, center = device_rays(camera, 1, jitter=False), device_rays(replace(camera, aperture=0.0))
    assert center["direction"][..., 2].min() < -0.5
    along = np.einsum("yxi,yxi->yx", rays["origin"], center["direction"])
    assert np.abs(along).max() < 1e-6


def test_lens_sample_of_a_pixel_depends_only_on_seed_and_sample_number() -> None:
    """Equal seed and sample give equal bits; a different seed or sample gives different origins."""
    camera = lens_camera(PINHOLE)
    first = device_rays(camera, 4, 9)
    np.testing.assert_array_equal(first, device_rays(camera, 4, 9))
    assert (first["origin"] != device_rays(camera, 4, 10)["origin"]).any(axis=-1).mean() > 0.99
    assert (first["origin"] != device_rays(camera, 5, 9)["origin"]).any(axis=-1).mean() > 0.99


# --- Rolling shutter ---


@pytest.mark.parametrize("model", MODELS)
def test_rolling_shutter_without_motion_changes_no_bit_of_the_rays(model: ls.CameraModel) -> None:
    """Equal start and end poses give the bits of a camera without an end pose."""
    once = lens_camera(model, camera_from_world_end=None)
    twice = replace(once, camera_from_world_end=once.camera_from_world)
    np.testing.assert_array_equal(device_rays(once, 3), device_rays(twice, 3))


def test_rolling_shutter_translates_the_camera_linearly_over_rows() -> None:
    """A motion of 5 units over 10 rows starts row y at 0.5 y + 0.25 and keeps all directions."""
    end = np.eye(4)
    end[0, 3] = -5.0
    camera = front_camera(8, 10, 6.0, camera_from_world_end=end)
    rays = device_rays(camera)
    expected = np.zeros((10, 8, 3))
    expected[..., 0] = 0.5 * np.arange(10)[:, None] + 0.25
    np.testing.assert_allclose(rays["origin"], expected, atol=1e-6)
    np.testing.assert_array_equal(rays["direction"], device_rays(front_camera(8, 10, 6.0))["direction"])


@pytest.mark.parametrize("model", MODELS)
def test_rolling_shutter_rotates_the_camera_linearly_over_rows(model: ls.CameraModel) -> None:
    """A rotation by 90 degrees about y over 9 rows rotates row y by 10 y + 5 degrees."""
    end = np.linalg.inv(rotation((0.0, 1.0, 0.0), 0.5 * np.pi))
    still = front_camera(9, 9, 6.0, model=model)
    rays, unrotated = device_rays(replace(still, camera_from_world_end=end)), device_rays(still)
    axis = rays["direction"][4, 4]
    np.testing.assert_allclose(axis, (np.sqrt(0.5), 0.0, np.sqrt(0.5)), atol=1e-6)
    for y in range(9):
        row_rotation = rotation((0.0, 1.0, 0.0), np.radians(10.0 * y + 5.0))[:3, :3]
        for name in ("origin", "direction"):
            np.testing.assert_allclose(rays[name][y], unrotated[name][y] @ row_rotation.T, atol=2e-6)


def test_device_function_rotated_is_a_right_handed_rotation() -> None:
    """A rotation by 0 about the zero axis returns the vector."""
    vector = wp.vec3(0.3, -0.2, 0.9)
    axis = np.array([1.0, 2.0, -2.0]) / 3.0
    expected = rotation((1.0, 2.0, -2.0), 2.0)[:3, :3] @ np.array(vector)
    np.testing.assert_allclose(np.array(rotated(vector, wp.vec3(*axis), 2.0)), expected, atol=1e-6)
    np.testing.assert_array_equal(np.array(rotated(vector, wp.vec3(0.0, 0.0, 0.0), 0.0)), np.array(vector))


def test_camera_table_fills_every_field_of_the_camera_struct() -> None:
    """A field that ``camera_table`` does not set would be 0."""
    camera = lens_camera(FISHEYE, distortion=(-0.01, 0.0, 0.0, 0.0, 0.001, 0.0))
    table = camera_table(replace(camera, window=(16, 16, 24, 14)), subpixel(4))
    assert table.shape == (1,) and table.dtype == table_dtype(CameraData)
    assert [name for name in present(table.dtype.names) if not np.any(table[name])] == []
