"""Rooms of meshes against Mitsuba's ``path``: the stored blocks of tools/make_mitsuba_path_reference.py.

The same number of bounces and the same polyhedra: all that differs is chance. A quick frame has fewer pixels, and
blocks of as many fewer, so that they show the same parts of the room.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.constants import SUBPIXEL_STEPS
from support.compare.blocks import Blocks, blocks_of_two
from support.scenes.path_rooms import BLOCK, BOUNCES, PathRoom, path_rooms, with_gaussians
from support.scenes.path_scenes import paths

REFERENCE = Path(__file__).resolve().parents[2] / "reference"
ROOMS = path_rooms()
NOISY = ("metal_area", "glass_area", "rough_glass_area")
SAME_PLACES = 0.001
"""Relative error of a block at edges: all pixels are sampled at the same few places."""


def reference_of(name: str) -> Blocks:
    """Mitsuba's blocks."""
    with np.load(REFERENCE / f"mitsuba_path_{name}.npz") as stored:
        return Blocks(stored["blocks"], stored["errors"])


def blocks_of(room: PathRoom, samples: int, shrink: int) -> Blocks:
    """Ours, of two frames with so many samples each, ``shrink`` times as small as the reference.

    Gaussians, if there are any, are as wide as they are: they were made of surfaces, not trained on pictures.
    """
    as_made = ls.TraceConfig(dilation=0.0)
    view = centred(room.camera.scaled(width=room.camera.width // shrink), samples)
    first, second = (paths(room.scene, view, samples, BOUNCES, seed=seed, trace=as_made).color for seed in (0, 1))
    return blocks_of_two(first, second, BLOCK // shrink)


def centred(camera: ls.Camera, samples: int) -> ls.Camera:
    """Its picture, moved by how far the mean place of so many samples is from the centre of the pixels: up to 0.1."""
    places = (0.5 + np.arange(samples)[:, None] * SUBPIXEL_STEPS) % 1.0
    x, y = places.mean(axis=0) - 0.5
    return replace(camera, cx=camera.cx + x, cy=camera.cy + y)


def errors_of(name: str, ours: Blocks) -> tuple[np.ndarray, np.ndarray]:
    """Relative errors of the blocks, and their standard errors."""
    theirs = reference_of(name)
    return ours.means / theirs.means - 1.0, np.hypot(ours.errors, theirs.errors) / theirs.means


def assert_agrees(name: str, ours: Blocks, systematic: float = SAME_PLACES) -> None:
    """Every block within four standard errors, and the whole picture too, of which they are smaller.

    Args:
        name: Of the room.
        ours: Its blocks.
        systematic: Share of a block that is allowed on top.
    """
    error, chance = errors_of(name, ours)
    assert np.median(chance) < 0.01
    assert (np.abs(error) < 4.0 * chance + systematic).all(), f"{np.abs(error / chance).max():.1f} standard errors"
    shares = reference_of(name).means / reference_of(name).means.sum(axis=(0, 1))
    whole, its_chance = (shares * error).sum(axis=(0, 1)), np.sqrt(np.square(shares * chance).sum(axis=(0, 1)))
    assert (its_chance < 0.005).all()
    assert (np.abs(whole) < 4.0 * its_chance + 0.5 * systematic).all(), f"the picture is off by {whole}"


@pytest.mark.parametrize("name", ROOMS)
def test_rooms_are_lit_as_in_mitsuba(name: str) -> None:
    """All that differs is chance."""
    assert_agrees(name, blocks_of(ROOMS[name], 32 if name in NOISY else 16, 2))


@pytest.mark.deep
@pytest.mark.parametrize("name", ROOMS)
def test_blocks_of_rooms_differ_by_less_than_one_per_cent(name: str) -> None:
    """Blocks of 32 x 32 pixels."""
    error, chance = errors_of(name, blocks_of(ROOMS[name], 256 if name in NOISY else 64, 1))
    assert chance.max() < 0.006
    assert np.abs(error).max() < 0.01


def test_a_ball_and_a_wall_of_gaussians_are_lit_as_meshes() -> None:
    """In the room of Mitsuba's meshes, at silhouettes and where the wall meets others too."""
    ours = blocks_of(with_gaussians(ROOMS["diffuse_area"], 20_000), 16, 2)
    assert_agrees("diffuse_area", ours, systematic=0.02)


@pytest.mark.parametrize("change", ["a darker wall", "a brighter lamp"])
def test_another_room_would_be_noticed(change: str) -> None:
    """The comparison fails for a wall that reflects 5 % less, and for a lamp 2 % brighter."""
    room = ROOMS["diffuse_area"]
    meshes = [instance.mesh for instance in room.scene.meshes]
    number = 1 if change == "a darker wall" else -3
    material = meshes[number].material
    assert isinstance(material, ls.MaterialPbr)
    factor = 0.95 if change == "a darker wall" else 1.02
    for name in ("base_color",) if number == 1 else ("emissive",):
        material = replace(material, **{name: [factor * value for value in getattr(material, name)]})
    meshes[number] = replace(meshes[number], material=material)
    with pytest.raises(AssertionError, match=r"standard errors|picture"):
        assert_agrees("diffuse_area", blocks_of(replace(room, scene=ls.Scene((), meshes)), 16, 2))
