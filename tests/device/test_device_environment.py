"""Tests of environments: lookup of the image by direction and importance sampling by brightness."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import warp as wp

from lumisplat.device.structs.shading import EnvironmentData, LightSample
from lumisplat.renderer.scene.lights import LightTable
from lumisplat.runtime.buffers import Buffers
from lumisplat.runtime.launcher import Launcher
from lumisplat.scene.camera import Camera
from lumisplat.scene.lights import LightEnvironment
from lumisplat.scene.scene import Scene
from support.compare.chi_square import LIMIT, chi_square_z
from support.oracles.light_oracle import Array, cell_pdf, cell_sizes, direction_at, image_coordinates, lookup
from support.probes import probe_light_kernels

DEVICES = ["cpu", *(device.alias for device in wp.get_cuda_devices())]
CAMERA = Camera.look_at((0.0, 0.0, 5.0), (0.0, 0.0, 0.0), width=8, height=8)
UPRIGHT = (1.0, 0.0, 0.0, 0.0)
ROTATED = np.array([0.5, -0.1, 0.7, 0.3]) / np.linalg.norm([0.5, -0.1, 0.7, 0.3])


class DeviceEnvironment:
    """An environment light on a device."""

    def __init__(self, image: npt.ArrayLike | None, device: str = "cpu", **values: Any) -> None:
        image = None if image is None else np.asarray(image, dtype=np.float32)
        self.device = device
        self.table = LightTable()
        self.buffers = Buffers(device)
        scene = Scene(lights=(LightEnvironment(image, **values),))
        self.table.sync(scene, CAMERA, self.buffers)
        self.data: EnvironmentData = self.table.environment

    def evaluate(self, directions: Array) -> tuple[Array, Array]:
        """Returns the radiance and the pdf of each direction, shapes (N, 3) and (N,)."""
        count = len(directions)
        given = wp.array(directions.astype(np.float32), dtype=wp.vec3, device=self.device)
        radiances, pdfs = (wp.zeros(count, dtype=dtype, device=self.device) for dtype in (wp.vec3, float))
        Launcher(self.device, threads=1).run(
            probe_light_kernels.probe_environment, count, self.data, given, radiances, pdfs
        )
        return radiances.numpy().astype(np.float64), pdfs.numpy().astype(np.float64)

    def sample(self, u: npt.NDArray[Any]) -> Any:
        """Samples the environment with N pairs of random numbers; returns a structured array of ``LightSample``."""
        given = wp.array(u.astype(np.float32), dtype=wp.vec2, device=self.device)
        samples = wp.zeros(len(u), dtype=LightSample, device=self.device)
        Launcher(self.device, threads=1).run(
            probe_light_kernels.probe_environment_samples, len(u), self.data, given, samples
        )
        return samples.numpy()


def directions(count: int, seed: int = 0) -> Array:
    """Returns unit vectors over the sphere, with some next to the poles and to the seam of an unrotated image."""
    rng = np.random.default_rng(seed)
    vectors = rng.normal(size=(count, 3))
    vectors[::10, [0, 2]] *= 10.0 ** rng.uniform(-6.0, -1.0, (len(vectors[::10]), 1))
    vectors[1::10, 0] *= 1e-4
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def random_image(height: int, width: int, seed: int = 1, dark: float = 0.4) -> npt.NDArray[np.float32]:
    """Returns an image of random texels over six decades, with a fraction ``dark`` of black ones and one sun texel."""
    rng = np.random.default_rng(seed)
    image = 10.0 ** rng.uniform(-4.0, 2.0, (height, width, 3))
    image[rng.random((height, width)) < dark] = 0.0
    image[height // 3, width // 2] = 3e4
    return image.astype(np.float32)


# --- Lookup ---


def test_top_of_the_environment_image_is_plus_y_and_its_centre_minus_z() -> None:
    """The top row is +y, the centre is -z, right of the centre is +x and the seam of left and right edge is +z."""
    image = np.zeros((2, 4, 3), dtype=np.float32)
    image[..., 0] = [[1, 2, 3, 4], [5, 6, 7, 8]]
    environment = DeviceEnvironment(image)
    centers = direction_at(UPRIGHT, np.array([0.125, 0.375, 0.625, 0.875] * 2), np.repeat([0.25, 0.75], 4))
    np.testing.assert_allclose(environment.evaluate(centers)[0][:, 0], image[..., 0].ravel(), rtol=1e-6)
    vectors = np.array([(0.0, 0.0, -1.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (-1.0, 0.0, 0.0)])
    np.testing.assert_allclose(environment.evaluate(vectors)[0][:, 0], (4.5, 5.5, 4.5, 3.5), rtol=1e-6)
    poles = environment.evaluate(np.array([(0.0, 1.0, 0.0), (0.0, -1.0, 0.0)]))[0][:, 0]
    np.testing.assert_allclose(poles, (2.5, 6.5))


def test_half_rotation_about_x_turns_the_environment_image_upside_down() -> None:
    """The rotation (0, 1, 0, 0) places the image's top at -y, for worlds whose y axis points down."""
    image = np.zeros((4, 8, 3), dtype=np.float32)
    image[0] = 1.0
    environment = DeviceEnvironment(image, rotation_wxyz=(0.0, 1.0, 0.0, 0.0))
    np.testing.assert_allclose(environment.evaluate(np.array([(0.0, -1.0, 0.0), (0.0, 1.0, 0.0)]))[0][:, 1], (1.0, 0.0))


def test_quarter_rotation_about_y_moves_the_environment_centre_to_minus_x() -> None:
    """The rotation maps environment to world coordinates, so the image's centre moves from -z to -x."""
    image = np.zeros((4, 8, 3), dtype=np.float32)
    image[:, 3:5] = 1.0
    environment = DeviceEnvironment(image, rotation_wxyz=(np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0))
    np.testing.assert_allclose(
        environment.evaluate(np.array([(-1.0, 0.0, 0.0), (0.0, 0.0, -1.0)]))[0][:, 1], (1.0, 0.0), atol=1e-6
    )


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("shape", [(1, 1), (1, 5), (5, 1), (2, 3), (17, 40), (128, 256)])
def test_environment_lookup_matches_the_float64_oracle(shape: tuple[int, int], device: str) -> None:
    """Bilinear lookups, times colour and intensity, match the oracle within the rounding of float32 directions."""
    image = np.random.default_rng(3).random((*shape, 3), dtype=np.float32)
    environment = DeviceEnvironment(image, device, rotation_wxyz=ROTATED, color=(1.0, 0.5, 0.25), intensity=2.0)
    # Directions next to the poles are left out, because rounding changes their longitude strongly.
    vectors = direction_at(ROTATED, *np.random.default_rng(4).uniform(0.02, 0.98, (2, 5000)))
    expected = lookup(image, *image_coordinates(ROTATED, vectors)) * (2.0, 1.0, 0.5)
    np.testing.assert_allclose(environment.evaluate(vectors)[0], expected, atol=2e-6 * max(shape) + 2e-6)


def test_environment_lookup_is_continuous_at_the_seam_and_the_poles() -> None:
    """The lookup interpolates across the seam, and directions next to a pole reach all texels of its row."""
    environment = DeviceEnvironment(random_image(16, 32, dark=0.0))
    azimuth = np.array([-1e-5, 1e-5])
    seam = np.stack([np.sin(azimuth), np.full(2, 0.3), np.cos(azimuth)], axis=1)
    left, right = environment.evaluate(seam / np.linalg.norm(seam, axis=1, keepdims=True))[0]
    np.testing.assert_allclose(left, right, rtol=1e-2)
    for y in (1.0, -1.0):
        tiny = np.array([(1e-4, y, 0.0), (-1e-4, y, 0.0), (0.0, y, 1e-4), (0.0, y, -1e-4)])
        values = environment.evaluate(tiny)[0][:, 0]
        row = random_image(16, 32, dark=0.0)[0 if y > 0.0 else -1, :, 0]
        expected = [0.5 * (row[i - 1] + row[i]) for i in (24, 8, 0, 16)]
        np.testing.assert_allclose(values, expected, rtol=1e-2)


def test_environment_without_an_image_is_sampled_uniformly() -> None:
    """An environment without an image has its colour in all directions and the pdf 1 / (4 pi)."""
    environment = DeviceEnvironment(None, color=(0.2, 0.4, 0.6), intensity=5.0)
    radiances, pdfs = environment.evaluate(directions(1000))
    np.testing.assert_allclose(radiances, np.tile((1.0, 2.0, 3.0), (1000, 1)), rtol=1e-6)
    np.testing.assert_allclose(pdfs, 0.25 / np.pi, rtol=1e-6)
    samples = environment.sample(np.random.default_rng(0).random((50_000, 2)))
    np.testing.assert_allclose(
        samples["irradiance"], np.tile(4.0 * np.pi * np.array([1, 2, 3]), (50_000, 1)), rtol=1e-5
    )
    assert np.abs(samples["direction"].mean(axis=0)).max() < LIMIT / np.sqrt(3 * 50_000)
    np.testing.assert_allclose(np.mean(samples["direction"] ** 2, axis=0), 1.0 / 3.0, atol=0.01)
    assert np.isinf(samples["distance"]).all()


# --- Importance sampling ---


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("shape", [(1, 1), (1, 6), (7, 1), (6, 12), (9, 16)])
def test_environment_pdf_of_a_texel_is_proportional_to_its_mean_brightness(shape: tuple[int, int], device: str) -> None:
    """The pdf of a texel's cell matches brute-force averages of the lookup, and integrates to 1 over the sphere."""
    image = np.random.default_rng(5).random((*shape, 3), dtype=np.float32)
    height, width = shape
    u, v = np.meshgrid((np.arange(width) + 0.5) / width, (np.arange(height) + 0.5) / height)
    vectors = direction_at(ROTATED, u, v).reshape(-1, 3)
    pdfs = DeviceEnvironment(image, device, rotation_wxyz=ROTATED).evaluate(vectors)[1].reshape(shape)
    np.testing.assert_allclose(pdfs, cell_pdf(image), rtol=1e-4)
    assert np.sum(pdfs * cell_sizes(height, width)) == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize(("height", "width"), [(1, 1), (2, 2), (5, 8), (16, 32), (64, 128)])
@pytest.mark.parametrize("wxyz", [UPRIGHT, ROTATED])
def test_directions_sampled_from_an_environment_follow_its_pdf(height: int, width: int, wxyz: Any) -> None:
    """The chi-square test has bins of half a texel, poles and black regions included."""
    environment = DeviceEnvironment(random_image(height, width), rotation_wxyz=wxyz)
    count = 400_000
    samples = environment.sample(np.random.default_rng(6).random((count, 2), dtype=np.float32))
    u, v = image_coordinates(wxyz, samples["direction"].astype(np.float64))
    column, row = (u * 2 * width).astype(int) % (2 * width), np.minimum((v * 2 * height).astype(int), 2 * height - 1)
    counts = np.bincount(row * 2 * width + column, minlength=4 * height * width).astype(np.float64)
    centers = np.meshgrid((np.arange(2 * width) + 0.5) / (2 * width), (np.arange(2 * height) + 0.5) / (2 * height))
    pdfs = environment.evaluate(direction_at(wxyz, *centers).reshape(-1, 3))[1]
    expected = count * pdfs * cell_sizes(2 * height, 2 * width).ravel()
    assert expected.sum() == pytest.approx(count, rel=1e-6)
    assert abs(chi_square_z(counts, expected)) < LIMIT


def test_mean_of_environment_samples_is_the_total_irradiance() -> None:
    """Pdf and irradiance of a sample equal those of a lookup; the mean irradiance is the integral over the sphere."""
    image = random_image(32, 64)
    environment = DeviceEnvironment(image, rotation_wxyz=ROTATED, intensity=0.5)
    samples = environment.sample(np.random.default_rng(7).random((200_000, 2), dtype=np.float32))
    np.testing.assert_allclose(np.linalg.norm(samples["direction"], axis=1), 1.0, atol=1e-6)
    radiances, pdfs = environment.evaluate(samples["direction"])
    # Rounding decides which cell contains a direction on a border.
    assert np.mean(np.abs(pdfs / samples["pdf"] - 1.0) > 1e-5) < 1e-3
    expected = radiances / samples["pdf"][:, None]
    np.testing.assert_allclose(samples["irradiance"], expected, rtol=1e-3, atol=1e-3 * expected.mean())
    u, v = np.meshgrid((np.arange(1024) + 0.5) / 1024, (np.arange(512) + 0.5) / 512)
    values = 0.5 * lookup(image, u.ravel(), v.ravel()) * np.sin(np.pi * v.ravel())[:, None] * 2.0 * np.pi**2
    error = samples["irradiance"].std(axis=0, dtype=np.float64) / np.sqrt(200_000)
    found = samples["irradiance"].mean(axis=0, dtype=np.float64)
    assert (np.abs(found - values.mean(axis=0)) < LIMIT * error + 1e-3 * found).all()


@pytest.mark.parametrize("seed", range(3))
def test_environment_pdf_is_positive_wherever_the_radiance_is_positive(seed: int) -> None:
    """The pdf is above 0 next to black texels, and for texels that a sun outshines by many decades."""
    rng = np.random.default_rng(seed)
    image = np.zeros((12, 24, 3), dtype=np.float32)
    for i in range(8):
        image[rng.integers(12), rng.integers(24), i % 3] = (1e-30, 1e-6, 1.0, 1e12)[i % 4]
    image[0, 3], image[-1, 20], image[6, 0] = 1e-9, 1e-9, 1e-9
    environment = DeviceEnvironment(image)
    vectors = directions(200_000, seed)
    radiances, pdfs = environment.evaluate(vectors)
    shines = radiances.max(axis=1) > 0.0
    u, v = image_coordinates(UPRIGHT, vectors)
    at_border = np.minimum(np.abs(u * 24 - np.rint(u * 24)), np.abs(v * 12 - np.rint(v * 12))) < 1e-4
    assert 0.1 < shines.mean() < 0.9
    assert (pdfs[shines & ~at_border] > 0.0).all()
    assert (pdfs[~shines & ~at_border] == 0.0).mean() > 0.7
    # The CDFs are multiples of 2^-24, as random numbers are, so every cell of positive pdf can be drawn.
    ends = [array.numpy() for array in (environment.data.row_ends, environment.data.column_ends)]
    for values in ends:
        np.testing.assert_array_equal(values, np.rint(values * 2.0**24) / 2.0**24)
    assert ends[0][-1] == 1.0


def test_black_environment_has_zero_radiance_and_pdf() -> None:
    """A black image has radiance, irradiance and pdf 0 in all directions."""
    environment = DeviceEnvironment(np.zeros((4, 8, 3)))
    radiances, pdfs = environment.evaluate(directions(100))
    assert not radiances.any()
    assert not pdfs.any()
    samples = environment.sample(np.random.default_rng(0).random((100, 2)))
    assert not samples["irradiance"].any()
    assert not samples["pdf"].any()
    np.testing.assert_allclose(np.linalg.norm(samples["direction"], axis=1), 1.0)


def test_missing_environment_has_zero_radiance_and_pdf() -> None:
    """The struct of a scene without an environment has radiance, irradiance and pdf 0."""
    environment = DeviceEnvironment(random_image(4, 8))
    environment.table.sync(Scene(), CAMERA, environment.buffers)
    radiances, pdfs = environment.evaluate(directions(100))
    assert not radiances.any()
    assert not pdfs.any()
    samples = environment.sample(np.random.default_rng(0).random((100, 2)))
    assert not samples["irradiance"].any()
    assert not samples["pdf"].any()


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("shape", [(1, 1), (1, 2), (3, 1), (8, 16), (512, 4)])
def test_environment_lookups_and_samples_are_finite_for_extreme_values(shape: tuple[int, int], device: str) -> None:
    """Results stay finite for random numbers of 0 and 1, poles, a zero direction and the largest float32 radiances."""
    for brightest in (1e-38, 1.0, 3e38):
        image = np.zeros((*shape, 3), dtype=np.float32)
        image[0, 0] = brightest
        environment = DeviceEnvironment(image, device, intensity=1e30)
        ends = np.array([0.0, 1e-7, 0.5, 1.0 - 2.0**-24, 1.0])
        samples = environment.sample(np.stack(np.meshgrid(ends, ends), axis=-1).reshape(-1, 2))
        for name in ("direction", "irradiance", "pdf"):
            assert np.isfinite(samples[name]).all()
        assert (samples["pdf"] > 0.0).all()
        axes = np.concatenate([np.eye(3), -np.eye(3), np.zeros((1, 3)), [[1e-30, 1.0, 0.0], [-1e-30, 0.0, 1.0]]])
        for found in environment.evaluate(axes):
            assert np.isfinite(found).all()
