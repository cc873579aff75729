"""Tests of ray-traced Gaussians against float64: response, reach, canonical space, box and ellipsoid normal."""

from __future__ import annotations

import math

import numpy as np
import pytest
import warp as wp

import lumisplat as ls
from lumisplat.constants import ALPHA_MAX, ALPHA_MIN, BOX_MARGIN
from lumisplat.device.gaussian.particle import canonical_from_object
from lumisplat.device.structs.bvh import FAR, Box, Particle
from lumisplat.device.structs.scene import KernelData
from lumisplat.renderer.scene.assets import upload_gaussians
from lumisplat.renderer.scene.instance_tables import KERNEL_LINEAR_SLOPE, kernel_data
from lumisplat.runtime.launcher import Launcher
from lumisplat.runtime.struct_tables import table_dtype
from support.kinds import present
from support.oracles import raster_oracle as oracles
from support.probes import probe_tree_kernels
from support.scenes.raster_scenes import random_gaussians

DEVICES = ["cpu", *(device.alias for device in wp.get_cuda_devices())]
DEGREES = range(6)


def kernel_of(degree: int, min_response: float = 0.0, adaptive: bool = True) -> KernelData:
    """Returns the ``KernelData`` of the response settings."""
    response = ls.config.ResponseConfig(kernel_degree=degree, min_response=min_response, adaptive_clamping=adaptive)
    return kernel_data(random_gaussians(0, 1), ls.RenderConfig(response=response))


def response(degree: int, distance: np.ndarray | float) -> np.ndarray:
    """Returns the response at a canonical distance (Hamdi et al. 2024; degree 0 is NVIDIA's linear kernel)."""
    distance = np.asarray(distance, np.float64)
    if degree == 0:
        return np.maximum(1.0 - KERNEL_LINEAR_SLOPE * distance, 0.0)
    return np.exp(-4.5 / 3.0**degree * distance**degree)


def probe(kernel: KernelData, opacities: np.ndarray, distances: np.ndarray, device: str) -> tuple[np.ndarray, ...]:
    """Returns the device's squared reach of each opacity and alpha at each distance."""
    count = len(opacities)
    table = np.zeros(count, table_dtype(KernelData))
    for name in present(table.dtype.names):
        table[name] = getattr(kernel, name)
    reaches, alphas = (wp.zeros(count, dtype=float, device=device) for _ in range(2))
    inputs = [wp.array(values.astype(np.float32), dtype=float, device=device) for values in (opacities, distances)]
    kernels = wp.array(table, dtype=KernelData, device=device)
    Launcher(device, threads=1).run(probe_tree_kernels.probe_responses, count, kernels, *inputs, reaches, alphas)
    return reaches.numpy().astype(np.float64), alphas.numpy().astype(np.float64)


def probe_gaussians(
    kernel: KernelData, gaussians: ls.Gaussians, origins: np.ndarray, directions: np.ndarray
) -> dict[str, np.ndarray]:
    """Returns the device's particles, boxes and ellipsoid normals; Gaussian i is intersected by ray i."""
    rays = [wp.array(values.astype(np.float32), dtype=wp.vec3, device="cpu") for values in (origins, directions)]
    kinds = {"particles": Particle, "boxes": Box, "normals": wp.vec3}
    out = {name: wp.zeros(gaussians.count, dtype=kind, device="cpu") for name, kind in kinds.items()}
    Launcher("cpu", threads=1).run(
        *(probe_tree_kernels.probe_particles, gaussians.count, kernel, upload_gaussians(gaussians, "cpu")),
        *(*rays, *out.values()),
    )
    return {name: values.numpy() for name, values in out.items()}


def frames(gaussians: ls.Gaussians) -> tuple[np.ndarray, np.ndarray]:
    """Returns the rotations, shape (N, 3, 3), and scales, shape (N, 3), of N Gaussians in float64."""
    quaternions = gaussians.rotations_wxyz.astype(np.float64)
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    return oracles.rotation_from_quaternion(quaternions), gaussians.scales.astype(np.float64)


# --- Response ---


@pytest.mark.parametrize("degree", DEGREES)
def test_gaussian_response_at_three_standard_deviations_is_equal_for_all_kernel_degrees(degree: int) -> None:
    """At three standard deviations, every degree responds by exp(-4.5); NVIDIA's linear kernel deviates by 0.1 %."""
    _, alphas = probe(kernel_of(degree), np.array([0.9]), np.array([3.0]), "cpu")
    assert alphas[0] == pytest.approx(0.9 * math.exp(-4.5), rel=1e-3 if degree == 0 else 1e-5)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("degree", DEGREES)
def test_alpha_of_a_traced_gaussian_is_opacity_times_response(degree: int, device: str) -> None:
    """The product holds from the centre to the reach and is clamped at 0.99."""
    random = np.random.default_rng(degree)
    opacities = np.concatenate([random.uniform(0.01, 1.0, 500), np.ones(100)])
    shares = np.concatenate([random.uniform(0.0, 1.0, 598), [0.0, 1.0]])
    reaches, _ = probe(kernel_of(degree), opacities, shares, device)
    distances = shares * np.sqrt(reaches)
    _, alphas = probe(kernel_of(degree), opacities, distances, device)
    expected = np.minimum(opacities.astype(np.float32) * response(degree, distances.astype(np.float32)), ALPHA_MAX)
    # At the end of its support the linear response is a small difference of large numbers.
    np.testing.assert_allclose(alphas, expected, rtol=1e-5, atol=3e-7 if degree == 0 else 0.0)
    assert alphas[-2] == np.float32(ALPHA_MAX)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("adaptive", [True, False])
@pytest.mark.parametrize("min_response", [0.0, 0.0113, 0.5])
@pytest.mark.parametrize("degree", DEGREES)
def test_reach_of_a_gaussian_ends_where_alpha_or_response_first_falls_to_its_minimum(
    degree: int, min_response: float, adaptive: bool, device: str
) -> None:
    """At the reach either alpha is 1/255 or the response is ``min_response``, whichever comes first.

    With adaptive clamping, opacity times response is compared with ``min_response``.
    """
    opacities = np.array([0.005, 0.02, 0.2, 0.49, 0.51, 0.8, 1.0])
    reaches, _ = probe(kernel_of(degree, min_response, adaptive), opacities, opacities, device)
    never = opacities * 1.0 <= min_response if adaptive else np.zeros(7, bool)
    np.testing.assert_array_equal(reaches < 0.0, never)
    at_end = response(degree, np.sqrt(reaches[~never]))
    alpha = opacities[~never] * at_end
    compared = alpha if adaptive else at_end
    np.testing.assert_allclose(np.minimum(alpha / ALPHA_MIN, compared / max(min_response, 1e-9)), 1.0, rtol=2e-5)


@pytest.mark.parametrize("degree", DEGREES)
def test_gaussians_of_opacity_below_1_255_have_a_negative_squared_reach(degree: int) -> None:
    """The squared reach is negative below an opacity of 1/255, 0 at it, and positive above."""
    step = np.float32(ALPHA_MIN)
    opacities = np.array([0.0, 1e-30, 0.5 * step, np.nextafter(step, np.float32(0.0)), step, 1.01 * step])
    reaches, _ = probe(kernel_of(degree), opacities, opacities, "cpu")
    assert (reaches[:4] < 0.0).all() and reaches[4] == 0.0 and reaches[5] > 0.0


@pytest.mark.parametrize("adaptive", [True, False])
def test_adaptive_clamping_drops_gaussians_of_opacity_below_the_minimum_response(adaptive: bool) -> None:
    """With a minimum of 0.5, adaptive clamping drops an opacity of 0.4; fixed clamping changes no reach by opacity."""
    reaches, _ = probe(kernel_of(2, 0.5, adaptive), np.array([0.4, 0.8, 1.0]), np.ones(3), "cpu")
    half = 2.0 * math.log(2.0)
    expected = [-1.0, 2.0 * math.log(1.6), half] if adaptive else [half] * 3
    assert reaches == pytest.approx(expected, rel=1e-5)


# --- Space ---


def test_object_to_canonical_matrix_inverts_rotation_and_scale() -> None:
    """The product with rotation and scale is the identity, for flat and round Gaussians with scales of 1e-4 to 1e4."""
    gaussians = random_gaussians(1, 60, scale_range=(1e-4, 1e4))
    rotations, scales = frames(gaussians)
    for quaternion, rotation, scale in zip(gaussians.rotations_wxyz, rotations, scales, strict=True):
        w, x, y, z = map(float, quaternion)
        actual = np.array(canonical_from_object(wp.quat(x, y, z, w), wp.vec3(*scale)), np.float64).reshape(3, 3)
        np.testing.assert_allclose(actual * scale[:, None] @ rotation, np.eye(3), atol=1e-6)


def test_traced_particle_stores_the_parameters_of_its_gaussian() -> None:
    """A particle holds mean, index, log opacity, squared reach and the matrix from object to canonical space."""
    gaussians = random_gaussians(2, 200)
    kernel = kernel_of(2)
    rays = np.zeros((200, 3)), np.ones((200, 3))
    particles = probe_gaussians(kernel, gaussians, *rays)["particles"]
    np.testing.assert_array_equal(particles["mean"], gaussians.means)
    np.testing.assert_array_equal(particles["index"], np.arange(200))
    np.testing.assert_allclose(particles["log_opacity"], np.log(gaussians.opacities), atol=1e-6)
    np.testing.assert_allclose(particles["reach2"], 2.0 * np.log(gaussians.opacities / ALPHA_MIN), rtol=1e-4, atol=1e-5)
    rotations, scales = frames(gaussians)
    product = particles["canonical_from_object"] @ (rotations * scales[:, None, :])
    np.testing.assert_allclose(product, np.broadcast_to(np.eye(3), (200, 3, 3)), atol=3e-6)


@pytest.mark.parametrize("degree", [0, 2, 5])
@pytest.mark.parametrize("offset", [0.0, 1e4])
def test_bounding_boxes_tightly_contain_the_ellipsoids_of_gaussians(degree: int, offset: float) -> None:
    """Boxes contain the ellipsoid's exact bounds and exceed them by rounding only.

    Thin needles along an axis are the hard case: rounding their rotation to float32 moves their ends by more than their
    thickness.
    """
    random = np.random.default_rng(3)
    quaternions = random.normal(size=(600, 4)) * [1.0, 1e-3, 1e-3, 1e-3]
    quaternions[:200] = random.normal(size=(200, 4))
    thinnest, thickest = np.log((1e-8, 1e2))
    scales = np.exp(random.uniform(thinnest, thickest, (600, 3)))
    means = random.normal(size=(600, 3)) + offset
    gaussians = ls.Gaussians(means, quaternions, scales, random.uniform(0.01, 1.0, 600), np.zeros((600, 1, 3)))
    kernel = kernel_of(degree)
    found = probe_gaussians(kernel, gaussians, np.zeros((600, 3)), np.ones((600, 3)))
    rotations, scales = frames(gaussians)
    reach = np.sqrt(probe(kernel, gaussians.opacities, np.zeros(600), "cpu")[0])[:, None]
    half = reach * np.sqrt(np.einsum("nij,nj->ni", rotations**2, scales**2))
    means = gaussians.means.astype(np.float64)
    slack = 3.0 * BOX_MARGIN * (half.max(axis=1, keepdims=True) + np.abs(means)) + 1e-5 * half
    for sign, side in ((-1.0, "low"), (1.0, "high")):
        out = sign * (found["boxes"][side] - (means + sign * half))
        assert (out >= 0.0).all(), f"{side} cuts into {(out < 0.0).sum()} ellipsoids"
        assert (out <= slack).all()


def test_gaussians_too_transparent_to_be_hit_have_inverted_bounding_boxes() -> None:
    """An inverted box is hit by no ray and leaves a union with another box unchanged."""
    gaussians = ls.Gaussians(
        [[1.0, 2.0, 3.0]] * 2, [[1, 0, 0, 0]] * 2, np.ones((2, 3)), [0.0, 0.0039], np.ones((2, 1, 3))
    )
    found = probe_gaussians(kernel_of(2), gaussians, np.zeros((2, 3)), np.ones((2, 3)))["boxes"]
    assert (found["low"] == np.float32(FAR)).all() and (found["high"] == -np.float32(FAR)).all()


# --- Ellipsoid ---


def test_ellipsoid_normal_is_the_density_gradient_at_the_entry_point() -> None:
    """The entry point lies at the reach, in canonical distance; the gradient, by central differences, faces the ray."""
    count = 300
    gaussians = random_gaussians(4, count, scale_range=(0.02, 2.0))
    random = np.random.default_rng(5)
    rotations, scales = frames(gaussians)
    kernel = kernel_of(2)
    reach = np.sqrt(np.maximum(probe(kernel, gaussians.opacities, np.zeros(count), "cpu")[0], 0.0))
    # Rays through a point inside the ellipsoid start outside, inside or behind it.
    inside = 0.6 * reach[:, None] * oracles.normalized(random.normal(size=(count, 3)))
    target = gaussians.means + np.einsum("nij,nj->ni", rotations, scales * inside)
    directions = oracles.normalized(random.normal(size=(count, 3)))
    origins = target - random.uniform(-1.0, 8.0, (count, 1)) * directions
    actual = probe_gaussians(kernel, gaussians, origins, directions)["normals"]

    def level(points: np.ndarray) -> np.ndarray:
        local = np.einsum("nji,nj->ni", rotations, points - gaussians.means) / scales
        return np.linalg.norm(local, axis=1)

    low, high = np.full(count, -200.0), np.zeros(count)  # distances from the target: outside, and inside
    for _ in range(80):
        middle = 0.5 * (low + high)
        out = level(target + middle[:, None] * directions) > reach
        low, high = np.where(out, middle, low), np.where(out, high, middle)
    entry = target + high[:, None] * directions
    step = 1e-5 * scales.min(axis=1)[:, None]
    sides = [level(entry + step * axis) - level(entry - step * axis) for axis in np.eye(3)]
    gradient = oracles.normalized(np.stack(sides, axis=-1))
    gradient *= -np.sign(np.einsum("ni,ni->n", gradient, directions))[:, None]
    has_reach = gaussians.opacities > 1.1 * ALPHA_MIN
    assert has_reach.sum() > 250
    np.testing.assert_allclose(actual[has_reach], gradient[has_reach], atol=2e-3)
    np.testing.assert_allclose(np.linalg.norm(actual, axis=1), 1.0, atol=1e-5)
    assert (np.einsum("ni,ni->n", actual, directions) <= 1e-6).all()


def test_ellipsoid_normal_of_a_sphere_matches_the_closed_form() -> None:
    """A ray that passes the centre at 0.6 radii enters 0.8 radii before it, so the normal is (0.6, 0, -0.8)."""
    ball = ls.Gaussians([[0.0, 0.0, 0.0]], [[1, 0, 0, 0]], [[0.5] * 3], [1.0], np.zeros((1, 1, 3)))
    radius = 0.5 * math.sqrt(2.0 * math.log(255.0))
    found = probe_gaussians(kernel_of(2), ball, np.array([[0.6 * radius, 0.0, -7.0]]), np.array([[0.0, 0.0, 1.0]]))
    np.testing.assert_allclose(found["normals"][0], (0.6, 0.0, -0.8), atol=1e-5)
