"""Meshes as shadow catchers: visible only by the shadows on them and by their reflections."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.demo.shapes import sphere
from renderer.light.test_shadow_catcher import HEIGHT, RADIUS, SHARE, SUN, below, disc
from support.scenes.path_scenes import diffuse

PIPELINES = pytest.mark.parametrize("pipeline", list(ls.Pipeline), ids=lambda one: one.value)


def plane(material: ls.MaterialPbr | None = None, y: float = 0.0, size: float = 4.0) -> ls.MeshInstance:
    """Returns a horizontal proxy mesh that catches shadows."""
    corners = [[-size, y, size], [size, y, size], [size, y, -size], [-size, y, -size]]
    mesh = ls.Mesh(corners, [[0, 1, 2], [0, 2, 3]], material=material or diffuse(0.5))
    return ls.MeshInstance(mesh, shadow_catcher=True)


def floaters(count: int = 4000, seed: int = 3) -> ls.SplatInstance:
    """Returns a captured floor without a clear surface: Gaussians up to 4 cm below and above the plane."""
    random = np.random.default_rng(seed)
    means = np.column_stack(
        [random.uniform(-4, 4, count), random.uniform(-0.04, 0.04, count), random.uniform(-4, 4, count)]
    )
    sh = np.full((count, 1, 3), 0.4, np.float32)
    wxyz = np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))
    return ls.SplatInstance(ls.Gaussians(means, wxyz, np.full((count, 3), 0.09), np.full(count, 0.9), sh))


def rendered(scene: ls.Scene, camera: ls.Camera, pipeline: ls.Pipeline, **settings: object) -> ls.Frame:
    """Renders a frame with the shadow ratio."""
    config = ls.RenderConfig(pipeline=pipeline, aovs=("shadow_ratio",))
    return ls.render(scene, camera, replace(config, **settings), device="cpu")


@PIPELINES
def test_shadow_catcher_mesh_has_the_shadow_ratio_of_a_captured_floor(pipeline: ls.Pipeline) -> None:
    """Below a disc, the ratio is the unoccluded ambient light over the sum of ambient light and sun."""
    scene = ls.Scene([], [plane(), disc()], [SUN])
    frame = rendered(scene, below(), pipeline, background=None)
    given = 0.5 * np.pi
    expected = given * (1.0 - SHARE) / (given + SUN.intensity * np.array(SUN.color))
    assert frame.shadow_ratio is not None and frame.shadow_matte is not None
    np.testing.assert_allclose(frame.shadow_ratio.mean(axis=(0, 1)), expected, rtol=0.04)
    # For compositing over a backplate, the transparent frame contains only the shadow.
    np.testing.assert_allclose(frame.alpha.mean(), 1.0 - expected.min(), rtol=0.02)
    np.testing.assert_allclose(frame.shadow_matte[..., :3], 0.0, atol=1e-6)
    assert RADIUS > HEIGHT


@PIPELINES
def test_shadow_catcher_mesh_is_invisible_away_from_added_objects(pipeline: ls.Pipeline) -> None:
    """Away from added objects, captures and indices keep their bits, and the catcher hides nothing."""
    camera = ls.Camera.look_at((0, 1.6, 4.2), (0, 0.2, 0), (0, 1, 0), width=96, height=48, fov_y=0.5)
    ball = ls.MeshInstance(replace(sphere(0.2, rows=16), material=diffuse(0.5)), position=(0, 0.2, 0))
    light = ls.LightPoint((0, 1.0, 0), intensity=3.0)
    with_plane = rendered(ls.Scene([floaters()], [plane(size=0.8), ball], [light]), camera, pipeline)
    without = rendered(ls.Scene([floaters()], [ball], [light]), camera, pipeline)
    away = np.abs(without.position[..., 0]) > 1.0
    assert away.sum() > 500
    np.testing.assert_array_equal(with_plane.color[away], without.color[away])
    np.testing.assert_array_equal(with_plane.instance_index == 2, without.instance_index == 1)
    assert (with_plane.instance_index != 1).all()
    assert with_plane.color.mean() < 0.998 * without.color.mean()


@pytest.mark.parametrize("albedo", [0.2, 0.7])
def test_light_bounced_between_a_shadow_catcher_mesh_and_objects_depends_on_its_albedo(albedo: float) -> None:
    """Light bounces between a white lid and the floor; a mesh catcher has the ratio of a captured floor."""
    constant = ls.LightEnvironment(color=(1.0, 1.0, 1.0), visible=False)
    settings = {"background": (0.0, 0.0, 0.0), "samples": 64, "max_bounces": 6}
    lid = disc(0.9)
    proxy = rendered(ls.Scene([], [plane(diffuse(albedo)), lid], [constant]), below(), ls.Pipeline.PATH, **settings)
    floor = replace(plane(diffuse(albedo)), shadow_catcher=False)
    shadowed, open_floor = (
        ls.render(scene, below(), ls.RenderConfig(pipeline=ls.Pipeline.PATH, **settings), device="cpu").color.mean()
        for scene in (ls.Scene([], [floor, lid], [constant]), ls.Scene([], [floor], [constant]))
    )
    assert proxy.shadow_ratio is not None
    assert proxy.shadow_ratio.mean() == pytest.approx(shadowed / open_floor, rel=0.04)


def test_shadow_ratio_of_colour_channels_in_which_there_is_no_light_is_one() -> None:
    """Below a disc, the light has no blue, so that the ratio of the blue channel is 1."""
    yellow = ls.LightEnvironment(color=(0.3, 0.4, 0.0), visible=False)
    frame = rendered(ls.Scene([], [plane(), disc()], [yellow]), below(), ls.Pipeline.HYBRID, samples=16)
    assert frame.shadow_ratio is not None
    assert frame.shadow_ratio[..., :2].max() < 0.5
    np.testing.assert_array_equal(frame.shadow_ratio[..., 2], 1.0)


@PIPELINES
def test_shadow_catcher_mesh_darkens_the_visible_environment_behind_it(pipeline: ls.Pipeline) -> None:
    """The environment map is the background photograph where nothing was captured."""
    constant = ls.LightEnvironment(color=(0.3, 0.4, 0.9))
    scene = ls.Scene([], [plane(), disc()], [constant])
    frame = rendered(scene, below(), pipeline)
    assert frame.shadow_ratio is not None and frame.shadow_ratio.mean() < 0.6
    np.testing.assert_allclose(frame.color, frame.shadow_ratio * np.array((0.3, 0.4, 0.9)), rtol=1e-3)


def test_shadow_catcher_mesh_below_floaters_shows_a_smooth_shadow() -> None:
    """Shadows on the floaters are blotchy; on the mesh through them they are smooth."""
    camera = ls.Camera.look_at((0, 3.0, 0.01), (0, 0, 0), (0, 0, -1), width=64, height=64, fov_y=0.5)
    lid = replace(disc(), positions=disc().positions * np.array([0.9, 2.0, 0.9]) + np.array([0.0, 0.6, 0.9]))
    sun = ls.LightDirectional((0.0, -1.0, -0.64), intensity=3.0)
    proxy = rendered(ls.Scene([floaters()], [plane(), lid], [sun]), camera, ls.Pipeline.HYBRID)
    assert proxy.shadow_ratio is not None
    x, z = proxy.position[..., 0], proxy.position[..., 2]
    inside = np.hypot(x, z) < 0.25
    assert inside.sum() > 100
    assert proxy.shadow_ratio[inside].std() < 0.05 and proxy.shadow_ratio[inside].mean() < 0.5


def test_glossy_shadow_catcher_mesh_reflects_added_objects() -> None:
    """The rest of the frame is unchanged."""
    camera = ls.Camera.look_at((0, 0.8, 3.0), (0, 0, 0), (0, 1, 0), width=64, height=48, fov_y=0.6)
    light = ls.LightDirectional((0, -0.3, -1), intensity=4.0, casts_shadow=False)
    red = ls.MeshInstance(
        replace(sphere(0.3, rows=24), material=ls.MaterialPbr(base_color=(0.8, 0.05, 0.05))), position=(0, 0.5, 0)
    )
    glossy = ls.MaterialPbr(base_color=(0.5,) * 3, roughness=0.0, ior=2.5)
    frames = [
        rendered(ls.Scene([], [plane(material), red], [light]), camera, ls.Pipeline.HYBRID, background=(0.5, 0.5, 0.5))
        for material in (glossy, diffuse(0.5))
    ]
    gained = frames[0].color - frames[1].color
    assert gained[..., 0].max() > 0.02
    mirrored = gained[..., 0] > 0.02
    assert gained[mirrored][:, 0].mean() > 3.0 * gained[mirrored][:, 1].mean()
    assert np.nonzero(mirrored)[0].min() > 24  # below the ball


@pytest.mark.parametrize("suffix", ["glb", "usda", "toml"])
def test_gltf_usd_and_scene_files_store_the_shadow_catcher_flag_of_meshes(tmp_path: Path, suffix: str) -> None:
    """The flag is in the extras of glTF, in primvars of USD, and a key of scene files."""
    if suffix == "usda":
        pytest.importorskip("pxr")
    if suffix == "toml":
        (tmp_path / "a.toml").write_text(
            '[[meshes]]\nshape = "plane"\nshadow_catcher = true\n[[meshes]]\nshape = "box"\n'
        )
    else:
        ls.save(tmp_path / f"a.{suffix}", ls.Scene([], [plane(), ls.MeshInstance(disc())]))
    loaded = ls.load(tmp_path / f"a.{suffix}")
    assert isinstance(loaded, ls.Scene)
    assert sorted(one.shadow_catcher for one in loaded.meshes) == [False, True]


def test_unlit_frames_and_mattes_leave_out_shadow_catcher_meshes() -> None:
    """Instances behind catchers in the list keep their index."""
    camera = ls.Camera.look_at((0, 0.8, 3.0), (0, 0.2, 0), (0, 1, 0), width=32, height=24, fov_y=0.6)
    box = ls.MeshInstance(ls.box((0.5, 0.5, 0.5)), name="box")
    scene = ls.Scene([floaters()], [plane(), box])
    frame = ls.render(scene, camera, ls.RenderConfig(lighting=False), device="cpu")
    assert set(np.unique(frame.instance_index)) <= {-1, 0, 2} and (frame.instance_index == 2).any()
    mattes = ls.layers.render_mattes(scene, camera, device="cpu")
    assert mattes.objects.coverage("box").max() == pytest.approx(1.0)


def test_frames_with_shadow_catcher_meshes_cannot_be_resumed() -> None:
    """The error is one line."""
    scene = ls.Scene([], [plane(), disc()], [SUN])
    renderer = ls.create_renderer(ls.RenderConfig(pipeline=ls.Pipeline.HYBRID, samples=2), "cpu")
    frame = renderer.render(scene, below())
    with pytest.raises(ls.ConfigError, match="cannot be resumed"):
        renderer.render(scene, below(), resume=frame)
