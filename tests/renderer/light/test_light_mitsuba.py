"""Comparison with Mitsuba's path tracer: the stored images of tools/make_mitsuba_light_reference.py.

Pixels at object edges, glass's own shadow, and the falloff region of spots are left out.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

import lumisplat as ls
from support.scenes.light_scenes import LightScene, light_scenes
from support.scenes.pipelines import DIRECT

REFERENCE = Path(__file__).resolve().parents[2] / "reference"
SCENES = light_scenes()
SHARP = [name for name, one in SCENES.items() if one.shadows is ls.Shadows.HARD]
SOFT = [name for name in SCENES if name not in SHARP]
DEEP_SCENES = ("constant", "metal_sky")
"""Scenes of the deep suite; daily tests cover constant environments in closed form, and other materials."""
DARK = 0.01
"""Fraction of an image's mean below which a pixel counts as unlit."""
BLOCK = 12
"""Side of the pixel blocks whose means are compared where samples are random."""
SAMPLES = 160
"""Samples that leave a noise of 0.5 % in the mean of a block."""


class Reference(NamedTuple):
    """Mitsuba's image of a scene, and the mask of compared pixels."""

    image: np.ndarray  # (H, W, 3), linear
    compared: np.ndarray  # (H, W)


def reference_of(name: str) -> Reference:
    """Returns the stored image of a scene."""
    with np.load(REFERENCE / f"mitsuba_light_{name}.npz") as stored:
        return Reference(stored["image"].astype(np.float64), stored["compared"])


def frame_of(one: LightScene, pipeline: ls.Pipeline, **changes: object) -> ls.Frame:
    """Returns Lumisplat's lit frame of a scene."""
    # The references have only direct light, without reflections of other surfaces in rough metals.
    direct = ls.RenderConfig(pipeline=pipeline, lighting=True, shadows=one.shadows, max_bounces=8)
    config = replace(direct, glossy_reflections=False)
    frame = ls.render(one.scene, one.camera, replace(config, **changes), device="cpu")
    assert frame.color_space == "linear"
    return frame


def assert_as_bright(ours: np.ndarray, theirs: np.ndarray, mean: float = 0.01, most: float = 0.01) -> None:
    """Asserts that lit values are within ``mean`` on average and 99 % within ``most``; dark values must be dark."""
    level = theirs.mean()
    lit = theirs > DARK * level
    assert lit.mean() > 0.3
    error = np.abs(ours - theirs) / np.where(lit, theirs, level)
    assert error[lit].mean() < mean, f"lit pixels differ by {error[lit].mean():.2%} on the mean"
    for kind, where in (("lit", lit), ("dark", ~lit)):
        worst = np.percentile(error[where], 99) if where.any() else 0.0
        assert worst < most, f"1 % of the {kind} values differ by {worst:.2%} or more"


def block_means(image: np.ndarray, compared: np.ndarray) -> np.ndarray:
    """Returns the means of the B blocks with enough compared pixels, shape (B, 3)."""
    rows, columns = (size // BLOCK for size in compared.shape)
    blocks = np.where(compared[..., None], image, 0.0).reshape(rows, BLOCK, columns, BLOCK, 3).sum(axis=(1, 3))
    counts = compared.reshape(rows, BLOCK, columns, BLOCK).sum(axis=(1, 3))
    enough = counts >= BLOCK * BLOCK // 2
    return blocks[enough] / counts[enough][:, None]


@pytest.mark.parametrize("pipeline", DIRECT, ids=lambda pipeline: pipeline.value)
@pytest.mark.parametrize("name", SHARP)
def test_images_lit_by_point_spot_and_directional_lights_equal_mitsuba(name: str, pipeline: ls.Pipeline) -> None:
    """Every pixel is compared, on diffuse, metal, mirror and glass surfaces."""
    if SCENES[name].smooth and pipeline is ls.Pipeline.RASTER:
        pytest.skip("a raster frame has no reflections")
    theirs = reference_of(name)
    ours = frame_of(SCENES[name], pipeline).color
    assert_as_bright(ours[theirs.compared], theirs.image[theirs.compared], mean=0.001)


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.deep] if name in DEEP_SCENES else []) for name in SOFT]
)
def test_images_lit_by_area_lights_and_environments_equal_mitsuba(name: str) -> None:
    """The lights are rectangle, disk and sphere, a constant environment and one with a sun, rotated about all axes.

    The test compares means of whole surfaces and of blocks, of which one in a hundred may exceed the noise.
    """
    theirs = reference_of(name)
    frame = frame_of(SCENES[name], ls.Pipeline.TRACE, samples=SAMPLES)
    for number in range(len(SCENES[name].scene.meshes)):
        surface = theirs.compared & (frame.instance_index == number)
        assert surface.sum() > 300
        error = frame.color[surface].mean(axis=0) / theirs.image[surface].mean(axis=0) - 1.0
        assert np.abs(error).max() < 0.01, f"mesh {number} is {error} brighter"
    ours = block_means(frame.color, theirs.compared)
    assert_as_bright(ours, block_means(theirs.image, theirs.compared), most=0.03)


def test_mitsuba_comparison_fails_for_a_light_moved_by_3_cm() -> None:
    """A light that is 3 cm off gives other blocks than Mitsuba's."""
    one, theirs = SCENES["point"], reference_of("point")
    moved = ls.LightPoint((1.63, 2.6, 1.4), color=(1.0, 0.9, 0.7), intensity=30.0)
    ours = frame_of(replace(one, scene=replace(one.scene, lights=(moved,))), ls.Pipeline.TRACE).color
    with pytest.raises(AssertionError, match="differ by"):
        assert_as_bright(ours[theirs.compared], theirs.image[theirs.compared])
