"""Rooms of meshes compared with Mitsuba's ``path``: the stored blocks of tools/make_mitsuba_path_reference.py.

Bounces and polyhedra are equal, so that only noise differs. A quick frame has fewer pixels per block, and its blocks
cover the same parts of the room.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.constants import SUBPIXEL_STEPS
from support.compare.tile_means import TileMeans, tile_means_of_two
from support.scenes.path_rooms import BOUNCES, TILE, PathRoom, path_rooms, with_gaussians
from support.scenes.path_scenes import paths

REFERENCE = Path(__file__).resolve().parents[2] / "reference"
ROOMS = path_rooms()
NOISY = ("metal_area", "glass_area", "rough_glass_area")
EDGE_TOLERANCE = 0.001
"""Relative error of a block at edges, because all pixels are sampled at the same few sub-pixel positions."""


def reference_of(name: str) -> TileMeans:
    """Returns Mitsuba's blocks of pixels."""
    with np.load(REFERENCE / f"mitsuba_path_{name}.npz") as stored:
        return TileMeans(stored["blocks"], stored["errors"])


def blocks_of(room: PathRoom, samples: int, shrink: int) -> TileMeans:
    """Returns Lumisplat's blocks of two frames of ``samples`` samples, ``shrink`` times smaller than the reference.

    Gaussians have no footprint, because they were made from surfaces, not trained on images.
    """
    as_made = ls.TraceConfig(dilation=0.0)
    view = centred(room.camera.scaled(width=room.camera.width // shrink), samples)
    first, second = (paths(room.scene, view, samples, BOUNCES, seed=seed, trace=as_made).color for seed in (0, 1))
    return tile_means_of_two(first, second, TILE // shrink)


def centred(camera: ls.Camera, samples: int) -> ls.Camera:
    """Returns the camera shifted by the mean sub-pixel position of the samples, at most 0.1 pixels from the centre."""
    positions = (0.5 + np.arange(samples)[:, None] * SUBPIXEL_STEPS) % 1.0
    x, y = positions.mean(axis=0) - 0.5
    return replace(camera, cx=camera.cx + x, cy=camera.cy + y)


def errors_of(name: str, ours: TileMeans) -> tuple[np.ndarray, np.ndarray]:
    """Returns the relative errors of the blocks, and their standard errors."""
    theirs = reference_of(name)
    return ours.means / theirs.means - 1.0, np.hypot(ours.errors, theirs.errors) / theirs.means


def assert_agrees(name: str, ours: TileMeans, systematic: float = EDGE_TOLERANCE) -> None:
    """Asserts that every block, and the whole image, is within four standard errors.

    Args:
        name: Name of the room.
        ours: Lumisplat's blocks.
        systematic: Additional relative tolerance of a block.
    """
    error, chance = errors_of(name, ours)
    assert np.median(chance) < 0.01
    assert (np.abs(error) < 4.0 * chance + systematic).all(), f"{np.abs(error / chance).max():.1f} standard errors"
    shares = reference_of(name).means / reference_of(name).means.sum(axis=(0, 1))
    whole, its_chance = (shares * error).sum(axis=(0, 1)), np.sqrt(np.square(shares * chance).sum(axis=(0, 1)))
    assert (its_chance < 0.005).all()
    assert (np.abs(whole) < 4.0 * its_chance + 0.5 * systematic).all(), f"the image is off by {whole}"


@pytest.mark.parametrize("name", ROOMS)
def test_path_traced_rooms_equal_mitsuba_up_to_noise(name: str) -> None:
    """Bounces and polyhedra are equal in both renderers."""
    assert_agrees(name, blocks_of(ROOMS[name], 32 if name in NOISY else 16, 2))


@pytest.mark.deep
@pytest.mark.parametrize("name", ROOMS)
def test_32_pixel_blocks_of_path_traced_rooms_are_within_1_percent_of_mitsuba(name: str) -> None:
    """The test renders enough samples for this precision."""
    error, chance = errors_of(name, blocks_of(ROOMS[name], 256 if name in NOISY else 64, 1))
    assert chance.max() < 0.006
    assert np.abs(error).max() < 0.01


def test_path_traced_gaussian_ball_and_wall_equal_meshes_in_mitsuba() -> None:
    """The agreement includes silhouettes, and the seam where the wall touches others."""
    ours = blocks_of(with_gaussians(ROOMS["diffuse_area"], 20_000), 16, 2)
    assert_agrees("diffuse_area", ours, systematic=0.02)


@pytest.mark.parametrize("change", ["a darker wall", "a brighter light"])
def test_mitsuba_room_comparison_fails_for_a_changed_albedo_or_light(change: str) -> None:
    """A wall that reflects 5 % less, or a light that is 2 % brighter, fails the comparison."""
    room = ROOMS["diffuse_area"]
    meshes = [instance.mesh for instance in room.scene.meshes]
    number = 1 if change == "a darker wall" else -3
    material = meshes[number].material
    assert isinstance(material, ls.MaterialPbr)
    factor = 0.95 if change == "a darker wall" else 1.02
    for name in ("base_color",) if number == 1 else ("emissive",):
        material = replace(material, **{name: [factor * value for value in getattr(material, name)]})
    meshes[number] = replace(meshes[number], material=material)
    with pytest.raises(AssertionError, match=r"standard errors|image"):
        assert_agrees("diffuse_area", blocks_of(replace(room, scene=ls.Scene((), meshes)), 16, 2))
