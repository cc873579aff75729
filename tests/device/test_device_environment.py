"""Environments: where the image shows what, and directions picked as densely as they say, wherever it shines."""

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
from support.oracles.light_oracle import Array, cell_density, cell_sizes, direction_at, image_coordinates, lookup
from support.probes import probe_light_kernels

DEVICES = ["cpu", *(device.alias for device in wp.get_cuda_devices())]
CAMERA = Camera.look_at((0.0, 0.0, 5.0), (0.0, 0.0, 0.0), width=8, height=8)
UPRIGHT = (1.0, 0.0, 0.0, 0.0)
TURNED = np.array([0.5, -0.1, 0.7, 0.3]) / np.linalg.norm([0.5, -0.1, 0.7, 0.3])


class Sky:
    """An environment on a device."""

    def __init__(self, image: npt.ArrayLike | None, device: str = "cpu", **values: Any) -> None:
        image = None if image is None else np.asarray(image, dtype=np.float32)
        self.device = device
        self.table = LightTable()
        self.buffers = Buffers(device)
        scene = Scene(lights=(LightEnvironment(image, **values),))
        self.table.sync(scene, CAMERA, self.buffers)
        self.data: EnvironmentData = self.table.environment

    def seen(self, directions: Array) -> tuple[Array, Array]:
        """Radiances, shape (N, 3), and densities, shape (N,)."""
        count = len(directions)
        given = wp.array(directions.astype(np.float32), dtype=wp.vec3, device=self.device)
        radiances, densities = (wp.zeros(count, dtype=dtype, device=self.device) for dtype in (wp.vec3, float))
        Launcher(self.device, threads=1).run(
            probe_light_kernels.probe_environment, count, self.data, given, radiances, densities
        )
        return radiances.numpy().astype(np.float64), densities.numpy().astype(np.float64)

    def picks(self, u: npt.NDArray[Any]) -> Any:
        """Samples as a structured array."""
        given = wp.array(u.astype(np.float32), dtype=wp.vec2, device=self.device)
        samples = wp.zeros(len(u), dtype=LightSample, device=self.device)
        Launcher(self.device, threads=1).run(
            probe_light_kernels.probe_environment_samples, len(u), self.data, given, samples
        )
        return samples.numpy()


def directions(count: int, seed: int = 0) -> Array:
    """All around, some of them next to the poles and to the seam of an upright image."""
    rng = np.random.default_rng(seed)
    vectors = rng.normal(size=(count, 3))
    vectors[::10, [0, 2]] *= 10.0 ** rng.uniform(-6.0, -1.0, (len(vectors[::10]), 1))
    vectors[1::10, 0] *= 1e-4
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def picture(height: int, width: int, seed: int = 1, dark: float = 0.4) -> npt.NDArray[np.float32]:
    """Random texels over six decades, a share of them black, and a sun."""
    rng = np.random.default_rng(seed)
    image = 10.0 ** rng.uniform(-4.0, 2.0, (height, width, 3))
    image[rng.random((height, width)) < dark] = 0.0
    image[height // 3, width // 2] = 3e4
    return image.astype(np.float32)


# --- Where the image shows what ---


def test_axes() -> None:
    """Up is above, -z in the middle, +x right of it, +z where left and right edges meet."""
    image = np.zeros((2, 4, 3), dtype=np.float32)
    image[..., 0] = [[1, 2, 3, 4], [5, 6, 7, 8]]
    sky = Sky(image)
    centers = direction_at(UPRIGHT, np.array([0.125, 0.375, 0.625, 0.875] * 2), np.repeat([0.25, 0.75], 4))
    np.testing.assert_allclose(sky.seen(centers)[0][:, 0], image[..., 0].ravel(), rtol=1e-6)
    ways = np.array([(0.0, 0.0, -1.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (-1.0, 0.0, 0.0)])
    np.testing.assert_allclose(sky.seen(ways)[0][:, 0], (4.5, 5.5, 4.5, 3.5), rtol=1e-6)
    poles = sky.seen(np.array([(0.0, 1.0, 0.0), (0.0, -1.0, 0.0)]))[0][:, 0]
    np.testing.assert_allclose(poles, (2.5, 6.5))


def test_half_a_turn_about_x() -> None:
    """What (0, 1, 0, 0) is for: in a world with y down, up is -y."""
    image = np.zeros((4, 8, 3), dtype=np.float32)
    image[0] = 1.0
    sky = Sky(image, rotation_wxyz=(0.0, 1.0, 0.0, 0.0))
    np.testing.assert_allclose(sky.seen(np.array([(0.0, -1.0, 0.0), (0.0, 1.0, 0.0)]))[0][:, 1], (1.0, 0.0))


def test_a_quarter_turn_about_y() -> None:
    """World from environment: what was in the middle, at -z, goes to -x."""
    image = np.zeros((4, 8, 3), dtype=np.float32)
    image[:, 3:5] = 1.0
    sky = Sky(image, rotation_wxyz=(np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0))
    np.testing.assert_allclose(sky.seen(np.array([(-1.0, 0.0, 0.0), (0.0, 0.0, -1.0)]))[0][:, 1], (1.0, 0.0), atol=1e-6)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("shape", [(1, 1), (1, 5), (5, 1), (2, 3), (17, 40), (128, 256)])
def test_twin(shape: tuple[int, int], device: str) -> None:
    """Bilinear lookups are the twin's, as exactly as directions in float32 allow; factors apply."""
    image = np.random.default_rng(3).random((*shape, 3), dtype=np.float32)
    sky = Sky(image, device, rotation_wxyz=TURNED, color=(1.0, 0.5, 0.25), intensity=2.0)
    # Not those next to the poles, where rounding turns them a long way.
    ways = direction_at(TURNED, *np.random.default_rng(4).uniform(0.02, 0.98, (2, 5000)))
    expected = lookup(image, *image_coordinates(TURNED, ways)) * (2.0, 1.0, 0.5)
    np.testing.assert_allclose(sky.seen(ways)[0], expected, atol=2e-6 * max(shape) + 2e-6)


def test_seam_and_poles() -> None:
    """No step where the edges meet, and all of the poles' neighbourhood is found."""
    sky = Sky(picture(16, 32, dark=0.0))
    turn = np.array([-1e-5, 1e-5])
    seam = np.stack([np.sin(turn), np.full(2, 0.3), np.cos(turn)], axis=1)
    left, right = sky.seen(seam / np.linalg.norm(seam, axis=1, keepdims=True))[0]
    np.testing.assert_allclose(left, right, rtol=1e-2)
    for y in (1.0, -1.0):
        tiny = np.array([(1e-4, y, 0.0), (-1e-4, y, 0.0), (0.0, y, 1e-4), (0.0, y, -1e-4)])
        values = sky.seen(tiny)[0][:, 0]
        row = picture(16, 32, dark=0.0)[0 if y > 0.0 else -1, :, 0]
        expected = [0.5 * (row[i - 1] + row[i]) for i in (24, 8, 0, 16)]
        np.testing.assert_allclose(values, expected, rtol=1e-2)


def test_one_color() -> None:
    """Without an image: the colour everywhere, directions evenly."""
    sky = Sky(None, color=(0.2, 0.4, 0.6), intensity=5.0)
    radiances, densities = sky.seen(directions(1000))
    np.testing.assert_allclose(radiances, np.tile((1.0, 2.0, 3.0), (1000, 1)), rtol=1e-6)
    np.testing.assert_allclose(densities, 0.25 / np.pi, rtol=1e-6)
    samples = sky.picks(np.random.default_rng(0).random((50_000, 2)))
    np.testing.assert_allclose(
        samples["irradiance"], np.tile(4.0 * np.pi * np.array([1, 2, 3]), (50_000, 1)), rtol=1e-5
    )
    assert np.abs(samples["direction"].mean(axis=0)).max() < LIMIT / np.sqrt(3 * 50_000)
    np.testing.assert_allclose(np.mean(samples["direction"] ** 2, axis=0), 1.0 / 3.0, atol=0.01)
    assert np.isinf(samples["distance"]).all()


# --- Picking by brightness ---


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("shape", [(1, 1), (1, 6), (7, 1), (6, 12), (9, 16)])
def test_density_is_the_brightness(shape: tuple[int, int], device: str) -> None:
    """Over a texel's cell, what the lookup gives on average, to the twin's brute force; it integrates to 1."""
    image = np.random.default_rng(5).random((*shape, 3), dtype=np.float32)
    height, width = shape
    u, v = np.meshgrid((np.arange(width) + 0.5) / width, (np.arange(height) + 0.5) / height)
    ways = direction_at(TURNED, u, v).reshape(-1, 3)
    densities = Sky(image, device, rotation_wxyz=TURNED).seen(ways)[1].reshape(shape)
    np.testing.assert_allclose(densities, cell_density(image), rtol=1e-4)
    assert np.sum(densities * cell_sizes(height, width)) == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize(("height", "width"), [(1, 1), (2, 2), (5, 8), (16, 32), (64, 128)])
@pytest.mark.parametrize("wxyz", [UPRIGHT, TURNED])
def test_directions_are_as_dense_as_said(height: int, width: int, wxyz: Any) -> None:
    """Chi-square over half-texels, poles and black parts included."""
    sky = Sky(picture(height, width), rotation_wxyz=wxyz)
    count = 400_000
    samples = sky.picks(np.random.default_rng(6).random((count, 2), dtype=np.float32))
    u, v = image_coordinates(wxyz, samples["direction"].astype(np.float64))
    column, row = (u * 2 * width).astype(int) % (2 * width), np.minimum((v * 2 * height).astype(int), 2 * height - 1)
    counts = np.bincount(row * 2 * width + column, minlength=4 * height * width).astype(np.float64)
    centers = np.meshgrid((np.arange(2 * width) + 0.5) / (2 * width), (np.arange(2 * height) + 0.5) / (2 * height))
    densities = sky.seen(direction_at(wxyz, *centers).reshape(-1, 3))[1]
    expected = count * densities * cell_sizes(2 * height, 2 * width).ravel()
    assert expected.sum() == pytest.approx(count, rel=1e-6)
    assert abs(chi_square_z(counts, expected)) < LIMIT


def test_samples_are_consistent() -> None:
    """Density and irradiance are those of looking the direction up; their mean is the light of the whole sphere."""
    image = picture(32, 64)
    sky = Sky(image, rotation_wxyz=TURNED, intensity=0.5)
    samples = sky.picks(np.random.default_rng(7).random((200_000, 2), dtype=np.float32))
    np.testing.assert_allclose(np.linalg.norm(samples["direction"], axis=1), 1.0, atol=1e-6)
    radiances, densities = sky.seen(samples["direction"])
    # On the borders of cells, rounding decides to which one a direction belongs.
    assert np.mean(np.abs(densities / samples["pdf"] - 1.0) > 1e-5) < 1e-3
    expected = radiances / samples["pdf"][:, None]
    np.testing.assert_allclose(samples["irradiance"], expected, rtol=1e-3, atol=1e-3 * expected.mean())
    u, v = np.meshgrid((np.arange(1024) + 0.5) / 1024, (np.arange(512) + 0.5) / 512)
    values = 0.5 * lookup(image, u.ravel(), v.ravel()) * np.sin(np.pi * v.ravel())[:, None] * 2.0 * np.pi**2
    error = samples["irradiance"].std(axis=0, dtype=np.float64) / np.sqrt(200_000)
    found = samples["irradiance"].mean(axis=0, dtype=np.float64)
    assert (np.abs(found - values.mean(axis=0)) < LIMIT * error + 1e-3 * found).all()


@pytest.mark.parametrize("seed", range(3))
def test_whatever_shines_is_found(seed: int) -> None:
    """Where the lookup gives anything, density is not 0: also beside black texels, and in the shade of a sun."""
    rng = np.random.default_rng(seed)
    image = np.zeros((12, 24, 3), dtype=np.float32)
    for i in range(8):
        image[rng.integers(12), rng.integers(24), i % 3] = (1e-30, 1e-6, 1.0, 1e12)[i % 4]
    image[0, 3], image[-1, 20], image[6, 0] = 1e-9, 1e-9, 1e-9
    sky = Sky(image)
    ways = directions(200_000, seed)
    radiances, densities = sky.seen(ways)
    shines = radiances.max(axis=1) > 0.0
    u, v = image_coordinates(UPRIGHT, ways)
    at_border = np.minimum(np.abs(u * 24 - np.rint(u * 24)), np.abs(v * 12 - np.rint(v * 12))) < 1e-4
    assert 0.1 < shines.mean() < 0.9
    assert (densities[shines & ~at_border] > 0.0).all()
    assert (densities[~shines & ~at_border] == 0.0).mean() > 0.7
    # And is drawn, if only by few numbers: the steps of float32.
    ends = [array.numpy() for array in (sky.data.row_ends, sky.data.column_ends)]
    for values in ends:
        np.testing.assert_array_equal(values, np.rint(values * 2.0**24) / 2.0**24)
    assert ends[0][-1] == 1.0


def test_dark_images() -> None:
    """Black gives nothing from anywhere, and is picked nowhere."""
    sky = Sky(np.zeros((4, 8, 3)))
    radiances, densities = sky.seen(directions(100))
    assert not radiances.any()
    assert not densities.any()
    samples = sky.picks(np.random.default_rng(0).random((100, 2)))
    assert not samples["irradiance"].any()
    assert not samples["pdf"].any()
    np.testing.assert_allclose(np.linalg.norm(samples["direction"], axis=1), 1.0)


def test_no_environment() -> None:
    """The struct that stands for none gives nothing either."""
    sky = Sky(picture(4, 8))
    sky.table.sync(Scene(), CAMERA, sky.buffers)
    radiances, densities = sky.seen(directions(100))
    assert not radiances.any()
    assert not densities.any()
    samples = sky.picks(np.random.default_rng(0).random((100, 2)))
    assert not samples["irradiance"].any()
    assert not samples["pdf"].any()


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("shape", [(1, 1), (1, 2), (3, 1), (8, 16), (512, 4)])
def test_finite(shape: tuple[int, int], device: str) -> None:
    """The ends of the random numbers, poles, a direction of no length, and the largest figures."""
    for brightest in (1e-38, 1.0, 3e38):
        image = np.zeros((*shape, 3), dtype=np.float32)
        image[0, 0] = brightest
        sky = Sky(image, device, intensity=1e30)
        ends = np.array([0.0, 1e-7, 0.5, 1.0 - 2.0**-24, 1.0])
        samples = sky.picks(np.stack(np.meshgrid(ends, ends), axis=-1).reshape(-1, 2))
        for name in ("direction", "irradiance", "pdf"):
            assert np.isfinite(samples[name]).all()
        assert (samples["pdf"] > 0.0).all()
        axes = np.concatenate([np.eye(3), -np.eye(3), np.zeros((1, 3)), [[1e-30, 1.0, 0.0], [-1e-30, 0.0, 1.0]]])
        for found in sky.seen(axes):
            assert np.isfinite(found).all()
