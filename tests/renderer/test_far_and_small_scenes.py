"""Frames do not depend on the distance from the origin or on the unit, in all pipelines, shadows and ray queries."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import lumisplat as ls

FAR = [(5e5, -3e5, 1e5), (5e6, 5e5, 3e2)]
PIPELINES = [ls.Pipeline.RASTER, ls.Pipeline.HYBRID, ls.Pipeline.TRACE, ls.Pipeline.PATH]
DIRECTIONS = np.random.default_rng(1).normal(size=(200, 3))
DIRECTIONS /= np.linalg.norm(DIRECTIONS, axis=1, keepdims=True)
FLOOR = np.array([[-2.0, -0.6, -2.0], [2.0, -0.6, -2.0], [2.0, -0.6, 2.0], [-2.0, -0.6, 2.0]])
TRIANGLES = np.array([[0, 2, 1], [0, 3, 2]])


def ball(unit: float = 1.0) -> ls.Gaussians:
    """Returns coloured Gaussians on a sphere."""
    count = len(DIRECTIONS)
    return ls.Gaussians(
        means=0.5 * unit * DIRECTIONS,
        rotations_wxyz=np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
        scales=np.full((count, 3), 0.06 * unit),
        opacities=np.full(count, 0.9),
        sh=np.random.default_rng(2).normal(size=(count, 1, 3)) * 0.3,
        normals=DIRECTIONS,
    )


def lit(place: Any = (0.0, 0.0, 0.0), unit: float = 1.0, *, in_mesh: bool = False) -> tuple[ls.Scene, ls.Camera]:
    """Returns a lit ball and its shadow on a floor at ``place``, in a unit; the floor's corners may be far away."""
    at = np.asarray(place, float)
    floor = ls.Mesh(unit * FLOOR + (at if in_mesh else 0.0), TRIANGLES)
    scene = ls.Scene(
        [ls.SplatInstance(ball(unit), material=ls.MaterialPbr(), position=at)],
        [ls.MeshInstance(floor, position=(0, 0, 0) if in_mesh else at)],
        [ls.LightPoint(at + unit * np.array([1.0, 2.0, 1.0]), intensity=20.0 * unit**2, radius=0.1 * unit)],
        up="y-up",
    )
    return scene, ls.Camera.look_at(at + unit * np.array([1.5, 1.0, 2.0]), at, width=32, height=24)


def shown(pipeline: ls.Pipeline, scene: ls.Scene, camera: ls.Camera) -> np.ndarray:
    """Returns the colours of a frame."""
    config = ls.RenderConfig(pipeline=pipeline, shadows=ls.Shadows.SOFT, samples=2)
    return ls.render(scene, camera, config, device="cpu").color


@pytest.mark.parametrize("pipeline", PIPELINES)
def test_lit_frame_does_not_depend_on_the_distance_from_the_origin(pipeline: ls.Pipeline) -> None:
    """The frame includes shadows, in whose penumbrae rounding may differ."""
    expected = shown(pipeline, *lit())
    for position in FAR:
        np.testing.assert_allclose(shown(pipeline, *lit(position)), expected, atol=2e-3)


def test_mesh_whose_vertices_are_far_from_its_own_origin_looks_like_one_near_it() -> None:
    """The corners are far away in object space, at integers that float32 represents exactly."""
    place = (2.0**20, -(2.0**20), 2.0**19)
    scene, camera = lit()
    low = np.round(8.0 * FLOOR) / 8.0  # eighths stay exact at 2^20
    near = replace(scene, meshes=[ls.MeshInstance(ls.Mesh(low, TRIANGLES))])
    far_scene, far_camera = lit(place)
    far = replace(far_scene, meshes=[ls.MeshInstance(ls.Mesh(low + place, TRIANGLES))])
    expected = shown(ls.Pipeline.TRACE, near, camera)
    np.testing.assert_allclose(shown(ls.Pipeline.TRACE, far, far_camera), expected, atol=2e-3)


def test_realtime_brightness_does_not_depend_on_the_distance_from_the_origin() -> None:
    """Cells of the cache and noise differ, but means agree, and an unmoved scene keeps its history."""
    config = ls.RenderConfig(pipeline=ls.Pipeline.REALTIME, shadows=ls.Shadows.SOFT)
    means = []
    for place in ((0.0, 0.0, 0.0), *FAR):
        renderer = ls.create_renderer(config, "cpu")
        scene, camera = lit(place)
        means.append([renderer.render(scene, camera).color.mean() for _ in range(3)])
    np.testing.assert_allclose(means[1:], [means[0], means[0]], rtol=0.01)


@pytest.mark.parametrize("pipeline", PIPELINES)
@pytest.mark.parametrize("unit", [1e-3, 1e-5, 1e3])
def test_frames_of_every_pipeline_are_equal_for_any_unit_of_length(pipeline: ls.Pipeline, unit: float) -> None:
    """Scenes in millimetres or micrometres are not clipped by a near plane of 0.01 units."""
    np.testing.assert_allclose(shown(pipeline, *lit(unit=unit)), shown(pipeline, *lit()), atol=1e-3)


def test_scaling_the_scene_by_a_power_of_two_changes_no_bit_of_the_frame() -> None:
    """All thresholds are relative to the size of the scene, so that only exponents change."""
    for pipeline in PIPELINES:
        np.testing.assert_array_equal(shown(pipeline, *lit(unit=2.0**10)), shown(pipeline, *lit(unit=2.0**5)))


def test_ray_queries_keep_the_precision_of_float64_origins() -> None:
    """Hits, transmittances, profiles and depths of rays at map coordinates equal those at the origin."""
    near, far = (lit(place)[0] for place in ((0.0, 0.0, 0.0), FAR[1]))
    starts = np.random.default_rng(3).uniform(-0.4, 0.4, (40, 3)) + np.array([0.0, 0.0, 3.0])
    directions = np.tile([0.0, 0.0, -1.0], (40, 1))
    near_hits = ls.trace_rays(near, starts, directions, ls.RenderConfig(lighting=False), device="cpu", profile=True)
    far_hits = ls.trace_rays(
        far, starts + FAR[1], directions, ls.RenderConfig(lighting=False), device="cpu", profile=True
    )
    np.testing.assert_allclose(far_hits.radiance, near_hits.radiance, atol=1e-4)
    np.testing.assert_allclose(far_hits.depth, near_hits.depth, atol=1e-4)
    assert near_hits.profile is not None and far_hits.profile is not None
    np.testing.assert_array_equal(far_hits.profile.gaussian_index, near_hits.profile.gaussian_index)
    passed = [
        ls.transmittance(scene, starts + place, directions, 3.5, device="cpu")
        for scene, place in ((near, (0.0, 0.0, 0.0)), (far, FAR[1]))
    ]
    np.testing.assert_allclose(passed[1], passed[0], atol=1e-4)


def test_focus_distance_does_not_depend_on_the_distance_from_the_origin() -> None:
    """The focus distance at a pixel equals that of the same scene at the origin."""
    near, far = (
        ls.rays.focused(*lit(place), 16, 12, device="cpu").focus_distance for place in ((0.0, 0.0, 0.0), FAR[0])
    )
    assert far == pytest.approx(near, rel=1e-4)


def test_deep_sample_depths_do_not_depend_on_the_distance_from_the_origin() -> None:
    """Depths are distances from the camera, wherever the camera is."""
    frames = [ls.layers.render_deep(*lit(place), device="cpu") for place in ((0.0, 0.0, 0.0), FAR[0])]
    np.testing.assert_array_equal(frames[0].first, frames[1].first)
    np.testing.assert_allclose(frames[1].near, frames[0].near, atol=1e-3)


@pytest.mark.parametrize("light", ["point", "parallel"])
@pytest.mark.parametrize("receives", [False, True])
def test_deep_shadow_maps_do_not_depend_on_the_distance_from_the_origin(
    light: str, receives: bool, tmp_path: Any
) -> None:
    """The maps of points, Gaussians and meshes are compared, also after saving and loading."""
    points = np.random.default_rng(4).uniform(-1.0, 1.0, (60, 3)) + np.array([0.0, -1.2, 0.0])
    found = []
    for place in ((0.0, 0.0, 0.0), *FAR):
        at = np.array(place)
        sheared = np.array([[1.0, 0.3, 0.0, at[0]], [0.0, 0.2, 0.0, at[1] + 0.9], [0.0, 0.0, 1.0, at[2]], [0, 0, 0, 1]])
        casters = [
            ls.SplatInstance(ball(), position=at),
            ls.MeshInstance(ls.Mesh(0.3 * FLOOR, TRIANGLES), sheared),
        ]
        source = at + np.array([0.5, 3.0, 0.5]) if light == "point" else ls.LightDirectional((0.2, -1.0, 0.1))
        shadow = ls.DeepShadowMap.build(
            casters,
            source,
            points + at if receives else None,
            ls.config.DeepShadowConfig(resolution=64, bins=16),
            device="cpu",
        )
        found.append(shadow.transmittance(points + at))
        shadow.save(tmp_path / "map.npz")
        loaded = ls.DeepShadowMap.load(tmp_path / "map.npz", device="cpu")
        np.testing.assert_array_equal(loaded.transmittance(points + at), found[-1])
    assert found[0].min() < 0.5 < found[0].max()
    for one in found[1:]:
        np.testing.assert_allclose(one, found[0], atol=2e-3)


def test_near_plane_set_by_the_user_is_not_adapted_to_the_scene() -> None:
    """Only the default near plane adapts to the scene."""
    scene, camera = lit(unit=1e-3)
    assert shown(ls.Pipeline.RASTER, scene, camera).any()
    assert not shown(ls.Pipeline.RASTER, scene, replace(camera, near=0.02)).any()
