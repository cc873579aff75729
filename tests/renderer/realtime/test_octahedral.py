"""The square as a map of directions, on the device, on the host and in the twin."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import warp as wp

import lumisplat as ls
from lumisplat.device.structs.camera import SampleData
from lumisplat.math.directions import cell_means, directions_of_square, irradiance_residual, sh_fit_of_cells
from lumisplat.math.sh import sh_basis
from lumisplat.runtime.buffers import device_array
from support.oracles.screen_probe_oracle import cell_of, spiral, square_of
from support.probes.probe_octahedral_kernels import probe_map, probe_seen, probe_wrapped
from support.scenes.gi_surfaces import camera_rows


def mapped(directions: np.ndarray, cells: int = 8) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points, directions of these points, and cells."""
    given = wp.array(directions.astype(np.float32), dtype=wp.vec3, device="cpu")
    points, back = (wp.zeros(len(directions), dtype=kind, device="cpu") for kind in (wp.vec2, wp.vec3))
    numbers = wp.zeros(len(directions), dtype=int, device="cpu")
    wp.launch(probe_map, len(directions), inputs=[cells, given, points, back, numbers], device="cpu")
    return device_array(points).numpy(), device_array(back).numpy(), device_array(numbers).numpy()


def test_cells_are_equal_solid_angles() -> None:
    """Of directions that are spread evenly, each cell has one in 64."""
    _, _, cells = mapped(spiral(400_000))
    shares = np.bincount(cells, minlength=64) / 400_000
    np.testing.assert_allclose(shares, 1.0 / 64.0, rtol=5e-3)


def test_device_and_host_follow_the_twin() -> None:
    """Points, cells, and the way back."""
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    directions = np.concatenate([spiral(1_000), axes])
    points, back, cells = mapped(directions)
    expected = np.array([square_of(way) for way in directions])
    np.testing.assert_allclose(points[:1_000], expected[:1_000], atol=1e-6)
    np.testing.assert_allclose(back, directions, atol=2e-6)
    np.testing.assert_allclose(directions_of_square(expected), directions, atol=1e-7)
    assert np.mean(cells[:1_000] == [cell_of(way, 8) for way in directions[:1_000]]) > 0.999


def test_the_border_is_folded_onto_itself() -> None:
    """A cell and the one a step beyond the square, which is wrapped, lie side by side on the sphere."""
    side = 8
    along = np.arange(side, dtype=np.int32)
    out = np.full(side, -1, np.int32)
    for columns, rows, inside in (
        (out, along, along * side),
        (out + side + 1, along, along * side + side - 1),
        (along, out, along),
        (along, out + side + 1, along + side * (side - 1)),
    ):
        found = wp.zeros(side, dtype=int, device="cpu")
        given = [wp.array(values.astype(np.int32), dtype=int, device="cpu") for values in (columns, rows)]
        wp.launch(probe_wrapped, side, inputs=[side, *given, found], device="cpu")
        centers = directions_of_square((np.stack(np.meshgrid(along, along), axis=-1).reshape(-1, 2) + 0.5) / side)
        angles = np.arccos(np.einsum("ij,ij->i", centers[inside], centers[device_array(found).numpy()]).clip(-1, 1))
        assert angles.max() < 0.7, "about a cell's width, 0.44, the long way across at most"
        assert len({*device_array(found).numpy()}) == side


def test_harmonics_that_fit_are_exact_to_their_degree() -> None:
    """Cells of light of degree 2 give its coefficients; constant light gives nothing else, to 1e-12."""
    fit = sh_fit_of_cells(8, 2)
    np.testing.assert_allclose(fit.sum(axis=0), np.eye(9)[0] * np.sqrt(4.0 * np.pi), atol=1e-12)
    coefficients = np.random.default_rng(1).normal(size=9)
    np.testing.assert_allclose(fit.T @ (cell_means(8, 2) @ coefficients), coefficients, atol=1e-12)


@pytest.mark.parametrize("power", [1, 3])
def test_what_harmonics_leave_out_is_added(power: int) -> None:
    """Nothing to light of degree 2; above a surface that sees none below it, errors are about half as large.

    The light is the cosine above the surface to a power: pi times 2 / (2 + power) arrive.
    """
    beyond, fit, means = irradiance_residual(8, 2, 16), sh_fit_of_cells(8, 2), cell_means(8, 2)
    np.testing.assert_allclose(beyond @ means, 0.0, atol=1e-12)
    directions, convolved = spiral(100_000), np.repeat([np.pi, 2.0 * np.pi / 3.0, np.pi / 4.0], [1, 3, 5])
    _, _, cells = mapped(directions)
    errors = list[list[float]]()
    for normal in spiral(40):
        light = np.maximum(directions @ normal, 0.0) ** power
        seen = np.bincount(cells, light, 64) / np.bincount(cells)
        _, _, facing = mapped(normal[None], 16)
        alone, rest = sh_basis(normal, 2) * convolved @ fit.T @ seen, beyond[facing[0]] @ seen
        truth = np.pi * 2.0 / (2.0 + power)
        errors.append([float(found) / truth - 1.0 for found in (alone, alone + rest)])
    alone, both = np.sqrt(np.mean(np.square(errors), axis=0))
    assert both < 0.6 * alone


def test_means_over_cells_are_those_of_the_sphere() -> None:
    """Sums over points of the cells are means over evenly spread directions that fall into them."""
    directions = spiral(400_000)
    _, _, cells = mapped(directions)
    basis = sh_basis(directions, 2)
    means = np.array([basis[cells == cell].mean(axis=0) for cell in range(64)])
    np.testing.assert_allclose(cell_means(8, 2), means, atol=3e-3)


@pytest.mark.parametrize(
    ("model", "distortion"),
    [
        (ls.CameraModel.PINHOLE, (0.0,) * 6),
        (ls.CameraModel.PINHOLE, (-0.05, 0.01, 0.0, 0.0, 0.001, -0.002)),
        (ls.CameraModel.FISHEYE, (0.0,) * 6),
        (ls.CameraModel.ORTHOGRAPHIC, (0.0,) * 6),
    ],
)
def test_cameras_see_points_where_their_rays_are(model: ls.CameraModel, distortion: tuple[float, ...]) -> None:
    """A point on the ray of a pixel is seen at the centre of the pixel, by all models."""
    eye, target = (1.0, 2.0, 0.5), (0.2, -1.0, 0.0)
    camera = ls.Camera.look_at(eye, target, (0.0, 0.0, 1.0), width=24, height=16, fov_y=0.9, model=model)
    camera = dataclasses.replace(camera, distortion=distortion)
    seen = wp.zeros(24 * 16, dtype=wp.vec2, device="cpu")
    samples = wp.zeros(1, dtype=SampleData, device="cpu")
    wp.launch(probe_seen, 24 * 16, inputs=[camera_rows(camera), samples, seen], device="cpu")
    x, y = np.meshgrid(np.arange(24) + 0.5, np.arange(16) + 0.5)
    np.testing.assert_allclose(device_array(seen).numpy(), np.stack([x, y], axis=-1).reshape(-1, 2), atol=2e-3)
