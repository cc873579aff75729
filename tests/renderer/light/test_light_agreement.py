"""Different ways to light the same scene agree: mesh and Gaussians, raster, trace and hybrid, lit and unlit."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.demo.shapes import join_meshes, rounded_box, sphere, torus, transform_mesh
from support.compare.images import assert_close
from support.kinds import for_splats, present
from support.scenes.light_rig import PIPELINES, lit
from support.scenes.light_scenes import ball_at, box, matte, parallelogram
from support.scenes.pipelines import DIRECT
from support.scenes.raster_scenes import random_gaussians, similarity

LIGHT = ls.LightPoint((-1.3, 2.4, 1.0), color=(1.0, 0.9, 0.7), intensity=20.0)
CAMERA = ls.Camera.look_at((0.5, 2.2, 3.2), (0.15, 0.35, -0.1), width=96, height=72, fov_y=0.5)
RED = matte(0.8, 0.3, 0.2)
SHINY = ls.MaterialPbr(base_color=(0.3, 0.6, 0.8), roughness=0.4)


def ring() -> ls.Mesh:
    """Returns a tilted ring."""
    return transform_mesh(torus(0.5, 0.18), similarity((1.0, 0.0, 0.3), 0.5, 1.0, (0.0, 0.6, 0.0)))


def tray() -> ls.Mesh:
    """Returns a slab, and a ball above it that shadows it."""
    slab = transform_mesh(rounded_box((1.3, 0.2, 1.0), 0.06), similarity((0.3, 1.0, 0.1), 0.2, 1.0, (0.0, 0.45, 0.0)))
    return join_meshes([slab, transform_mesh(sphere(0.22), similarity(offset=(-0.1, 0.85, 0.0)))])


OBJECTS = {
    "sphere": (ball_at((0.0, 0.7, 0.0), 0.5, RED), 12_000),
    "shiny sphere": (ball_at((0.0, 0.7, 0.0), 0.5, SHINY), 12_000),
    "ring": (replace(ring(), material=RED), 12_000),
    "box": (transform_mesh(box((0.7, 0.6, 0.5), RED), similarity((0.2, 1.0, 0.0), 0.6, 1.0, (0.0, 0.6, 0.0))), 16_000),
    "tray": (replace(tray(), material=RED), 20_000),
}
FLOOR = parallelogram((-3.0, 0.0, 3.0), (6.0, 0.0, 0.0), (0.0, 0.0, -6.0), matte(0.8))


@cache
def gaussians_of(name: str) -> ls.Gaussians:
    """Returns the object as Gaussians with normals and albedo."""
    mesh, count = OBJECTS[name]
    return ls.gaussians_from_mesh(mesh, count)


def as_mesh(name: str) -> ls.Scene:
    """Returns a scene with the object as a mesh over the floor."""
    return ls.Scene((), [FLOOR, OBJECTS[name][0]], [LIGHT])


def as_gaussians(name: str, **changes: object) -> ls.Scene:
    """Returns a scene with the object as Gaussians over the floor."""
    instance = ls.SplatInstance(gaussians_of(name), material=for_splats(OBJECTS[name][0].material))
    return ls.Scene([replace(instance, **changes)], [FLOOR], [LIGHT])


def overlap(first: np.ndarray, second: np.ndarray) -> float:
    """Returns the intersection over union of two masks."""
    return float(np.count_nonzero(first & second) / np.count_nonzero(first | second))


def inner(mask: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Returns the pixels of a mask whose neighbours within two pixels are in the mask and have similar normals."""
    inside = mask.copy()
    for rows in range(-2, 3):
        for columns in range(-2, 3):
            moved = np.roll(normals, (rows, columns), (0, 1))
            inside &= np.roll(mask, (rows, columns), (0, 1)) & ((moved * normals).sum(-1) > 0.7)
    return inside


def psnr(first: np.ndarray, second: np.ndarray) -> float:
    """Returns the PSNR between two images in decibels; white is 1."""
    return float(-10.0 * np.log10(np.mean((np.clip(first, 0.0, 1.0) - np.clip(second, 0.0, 1.0)) ** 2)))


@PIPELINES
@pytest.mark.parametrize("name", OBJECTS)
def test_mesh_of_an_object_and_gaussians_made_from_it_cast_equal_shadows(name: str, pipeline: ls.Pipeline) -> None:
    """The test compares masks of the shadows on the floor and of the object on itself."""
    mesh = lit(as_mesh(name), CAMERA, pipeline, aovs=("lights",))
    splats = lit(as_gaussians(name), CAMERA, pipeline, aovs=("lights",))
    assert mesh.light_shadow is not None
    assert splats.light_shadow is not None
    assert mesh.light_direct is not None
    dark, dark_too = (present(frame.light_shadow)[0].mean(axis=2) < 0.5 for frame in (mesh, splats))

    # Splat instances are numbered before meshes: the floor is 0 in one frame and 1 in the other.
    floor = (mesh.instance_index == 0) & (splats.instance_index == 1) & (splats.gaussian_index < 0)
    assert dark[floor].sum() > 300
    assert overlap(dark[floor], dark_too[floor]) > 0.95

    # At grazing angles, the surface gets too little light for a shadow to be measured.
    whole = inner((mesh.instance_index == 1) & (splats.instance_index == 0), mesh.normal)
    direct = mesh.light_direct[0].mean(axis=2)
    facing = whole & (direct > 0.5 * direct[whole].mean())
    assert facing.sum() > 100
    if name == "tray":
        assert dark[facing].sum() > 80
        assert overlap(dark[facing], dark_too[facing]) > (0.95 if pipeline is ls.Pipeline.TRACE else 0.8)
    else:
        assert dark_too[facing].mean() < 0.01


@PIPELINES
@pytest.mark.parametrize("name", OBJECTS)
def test_mesh_of_an_object_and_gaussians_made_from_it_are_equally_bright(name: str, pipeline: ls.Pipeline) -> None:
    """The test compares unshadowed brightness away from edges.

    The rasteriser orders discs by their centres, so that discs that face the viewer get too much weight. Footprints
    have the same effect: they suit only captures trained with them.
    """
    thin = ls.TraceConfig(dilation=0.0)
    mesh = lit(as_mesh(name), CAMERA, pipeline, aovs=("lights",))
    splats = lit(as_gaussians(name), CAMERA, pipeline, aovs=("lights",), trace=thin)
    assert mesh.light_direct is not None
    assert splats.light_direct is not None
    whole = inner((mesh.instance_index == 1) & (splats.instance_index == 0), mesh.normal)
    shone, shone_too = (present(frame.light_direct)[0][whole].mean(axis=1) for frame in (mesh, splats))
    total, each = (0.01, 0.03) if pipeline is ls.Pipeline.TRACE else (0.06, 0.1)
    assert shone_too.mean() == pytest.approx(shone.mean(), rel=total)
    assert np.abs(shone_too - shone).mean() < each * shone.mean()


def test_raster_trace_and_hybrid_pipelines_give_equal_frames_of_lit_meshes() -> None:
    """Frames of meshes differ only by rounding."""
    scene = as_mesh("tray")
    raster, trace, hybrid = (lit(scene, CAMERA, pipeline) for pipeline in DIRECT)
    for frame in (raster, hybrid):
        off = np.abs(frame.color - trace.color).max(axis=2)
        assert (off < 1e-4).mean() > 0.998


@pytest.mark.parametrize("name", ["ring", "shiny sphere"])
def test_raster_trace_and_hybrid_pipelines_give_equal_frames_of_lit_gaussians(name: str) -> None:
    """Raster and hybrid frames are equal; both differ from traced frames because of their footprints."""
    raster, trace, hybrid = (lit(as_gaussians(name), CAMERA, pipeline) for pipeline in DIRECT)
    assert_close(hybrid.color, raster.color, atol=1e-4)
    assert psnr(raster.color, trace.color) > 23.0
    assert np.abs(raster.color - trace.color).mean() < 0.02
    whole = inner((trace.instance_index == 0) & (trace.alpha > 0.99), trace.normal)
    assert raster.color[whole].mean() == pytest.approx(trace.color[whole].mean(), rel=0.05)


@PIPELINES
def test_white_gaussians_are_nearly_invisible_in_a_white_furnace(pipeline: ls.Pipeline) -> None:
    """Gaussians of a surface lose less than 1 % of the light by shadowing each other."""
    white = matte(1.0)
    splats = ls.gaussians_from_mesh(ball_at((0.0, 0.7, 0.0), 0.5, white), 4000)
    environment = ls.LightEnvironment(color=(0.5, 1.0, 1.5))
    scene = ls.Scene([ls.SplatInstance(splats, material=white)], (), [environment])
    frame = lit(scene, CAMERA, pipeline, shadows=ls.Shadows.SOFT, samples=48)
    inside = (frame.instance_index == 0) & (frame.alpha > 0.99)
    assert inside.sum() > 500
    np.testing.assert_allclose(frame.color[inside].mean(axis=0), environment.color, rtol=0.01)


def capture() -> ls.Gaussians:
    """Returns a set of Gaussians that emits its colours, like a capture."""
    return random_gaussians(71, count=300, degree=2, center=(0.0, 0.8, 0.0), extent=(0.9, 0.7, 0.6))


@PIPELINES
@pytest.mark.parametrize("lights", [(LIGHT,), (replace(LIGHT, enabled=False),), ()], ids=["lamp", "off", "headlight"])
def test_turning_lighting_on_changes_nothing_if_no_surface_reflects_light(
    lights: tuple[ls.LightPoint, ...], pipeline: ls.Pipeline, tmp_path: Path
) -> None:
    """With any tone map, the frame has no light, and colours and files equal those of the unlit frame."""
    scene = ls.Scene([capture()], (), lights)
    settings = {"background": (0.2, 0.3, 0.4), "tone_map": ls.ToneMap.AGX}
    frame = lit(scene, CAMERA, pipeline, **settings)
    unlit = ls.render(
        scene, CAMERA, ls.RenderConfig(pipeline=pipeline, lighting=False, background=(0.2, 0.3, 0.4)), device="cpu"
    )
    assert frame.light is not None
    assert unlit.color.std() > 0.1
    np.testing.assert_array_equal(frame.captured, unlit.color)
    np.testing.assert_array_equal(frame.captured_weight, 1.0)
    np.testing.assert_array_equal(frame.light, 0.0)
    frame.save(tmp_path / "lit.png")
    unlit.save(tmp_path / "unlit.png")
    assert (tmp_path / "lit.png").read_bytes() == (tmp_path / "unlit.png").read_bytes()


@PIPELINES
def test_pixels_of_a_capture_in_front_of_a_lit_mesh_equal_those_of_the_unlit_frame(
    pipeline: ls.Pipeline, tmp_path: Path
) -> None:
    """Light on a floor changes neither the pixels of the capture in front of the floor nor the background."""
    half = parallelogram((-3.0, 0.0, 0.2), (3.2, 0.0, 0.0), (0.0, 0.0, -1.4), matte(0.8))
    scene = ls.Scene([capture()], [half], [LIGHT])
    frame = lit(scene, CAMERA, pipeline, tone_map=ls.ToneMap.NEUTRAL)
    unlit = ls.render(scene, CAMERA, ls.RenderConfig(pipeline=pipeline, lighting=False), device="cpu")
    nothing = ls.render(ls.Scene([capture()]), CAMERA, ls.RenderConfig(pipeline=pipeline, lighting=False), device="cpu")
    assert frame.light is not None
    untouched = (frame.light == 0.0).all(axis=2) & (frame.captured_weight == 1.0)
    same = (unlit.color == nothing.color).all(axis=2) & ~(unlit.instance_index == 1)
    assert 0.1 < untouched.mean() < 0.9
    assert (frame.light[~untouched] != 0.0).any()
    shown = frame.pixels_srgb()
    np.testing.assert_array_equal(shown[untouched & same], unlit.pixels_srgb()[untouched & same])
    assert (untouched & same).sum() > 0.9 * untouched.sum()
