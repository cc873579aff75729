"""Octahedral maps of directions, on the device, on the host and in the reference."""

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
    """Maps directions to points of the square, back to directions, and to cell indices."""
    given = wp.array(directions.astype(np.float32), dtype=wp.vec3, device="cpu")
    points, back = (wp.zeros(len(directions), dtype=kind, device="cpu") for kind in (wp.vec2, wp.vec3))
    numbers = wp.zeros(len(directions), dtype=int, device="cpu")
    wp.launch(probe_map, len(directions), inputs=[cells, given, points, back, numbers], device="cpu")
    return device_array(points).numpy(), device_array(back).numpy(), device_array(numbers).numpy()


def test_cells_of_an_octahedral_map_have_equal_solid_angles() -> None:
    """Each of 64 cells gets 1/64 of uniformly spread directions."""
    _, _, cells = mapped(spiral(400_000))
    shares = np.bincount(cells, minlength=64) / 400_000
    np.testing.assert_allclose(shares, 1.0 / 64.0, rtol=5e-3)


def test_octahedral_maps_of_device_and_host_match_the_reference() -> None:
    """Points, cells and the inverse mapping agree."""
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    directions = np.concatenate([spiral(1_000), axes])
    points, back, cells = mapped(directions)
    expected = np.array([square_of(direction) for direction in directions])
    np.testing.assert_allclose(points[:1_000], expected[:1_000], atol=1e-6)
    np.testing.assert_allclose(back, directions, atol=2e-6)
    np.testing.assert_allclose(directions_of_square(expected), directions, atol=1e-7)
    assert np.mean(cells[:1_000] == [cell_of(direction, 8) for direction in directions[:1_000]]) > 0.999


def test_neighbour_cells_across_the_border_of_an_octahedral_map_touch_on_the_sphere() -> None:
    """The wrapped cell lies one step beyond the border of the square."""
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


def test_sh_projection_of_octahedral_cells_is_exact_for_light_of_degree_2() -> None:
    """The coefficients of degree-2 light are recovered to 1e-12; constant light gives only the first coefficient."""
    fit = sh_fit_of_cells(8, 2)
    np.testing.assert_allclose(fit.sum(axis=0), np.eye(9)[0] * np.sqrt(4.0 * np.pi), atol=1e-12)
    coefficients = np.random.default_rng(1).normal(size=9)
    np.testing.assert_allclose(fit.T @ (cell_means(8, 2) @ coefficients), coefficients, atol=1e-12)


@pytest.mark.parametrize("power", [1, 3])
def test_irradiance_from_octahedral_cells_adds_what_sh_of_degree_2_cannot_represent(power: int) -> None:
    """The correction is 0 for degree-2 light and halves errors for light above a horizon.

    The light is a power of the cosine above the surface: pi times 2 / (2 + power) is the irradiance.
    """
    beyond, fit, means = irradiance_residual(8, 2, 16), sh_fit_of_cells(8, 2), cell_means(8, 2)
    np.testing.assert_allclose(beyond @ means, 0.0, atol=1e-12)
    directions, convolved = spiral(100_000), np.repeat([np.pi, 2.0 * np.pi / 3.0, np.pi / 4.0], [1, 3, 5])
    _, _, cells = mapped(directions)
    errors = list[list[float]]()
    for normal in spiral(40):
        light = np.maximum(directions @ normal, 0.0) ** power
        found = np.bincount(cells, light, 64) / np.bincount(cells)
        _, _, facing = mapped(normal[None], 16)
        sh_only, rest = sh_basis(normal, 2) * convolved @ fit.T @ found, beyond[facing[0]] @ found
        truth = np.pi * 2.0 / (2.0 + power)
        errors.append([float(value) / truth - 1.0 for value in (sh_only, sh_only + rest)])
    sh_only, both = np.sqrt(np.mean(np.square(errors), axis=0))
    assert both < 0.6 * sh_only


def test_mean_sh_basis_of_each_octahedral_cell_matches_the_sphere() -> None:
    """Quadrature over cells equals means over uniformly spread directions in the cells."""
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
def test_points_on_a_pixel_ray_project_to_that_pixel_for_all_camera_models(
    model: ls.CameraModel, distortion: tuple[float, ...]
) -> None:
    """The point is projected to the centre of the pixel."""
    eye, target = (1.0, 2.0, 0.5), (0.2, -1.0, 0.0)
    camera = ls.Camera.look_at(eye, target, (0.0, 0.0, 1.0), width=24, height=16, fov_y=0.9, model=model)
    camera = dataclasses.replace(camera, distortion=distortion)
    found = wp.zeros(24 * 16, dtype=wp.vec2, device="cpu")
    samples = wp.zeros(1, dtype=SampleData, device="cpu")
    wp.launch(probe_seen, 24 * 16, inputs=[camera_rows(camera), samples, found], device="cpu")
    x, y = np.meshgrid(np.arange(24) + 0.5, np.arange(16) + 0.5)
    np.testing.assert_allclose(device_array(found).numpy(), np.stack([x, y], axis=-1).reshape(-1, 2), atol=2e-3)
