"""The demo scene: contents, exposure, and views without holes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.constants import SH_C0
from lumisplat.demo import room as demo_room
from lumisplat.math.color import decode_srgb
from support.kinds import pbr_of


def test_demo_scene_has_its_documented_contents(demo: ls.Scene) -> None:
    """One capture of 150,000 to 300,000 Gaussians with surface data, and four meshes, are in a room of a few metres."""
    assert len(demo.splats) == 1
    assert 150_000 <= demo.gaussian_count <= 300_000
    assert {instance.name for instance in demo.meshes} == {"white paint", "striped glass", "brass", "aquamarine"}
    gaussians = demo.splats[0].gaussians
    for name in ("normals", "albedo", "roughness", "metallic"):
        assert getattr(gaussians, name) is not None
    low, high = demo.bounds()
    assert (low > [-4.0, -0.5, -4.5]).all()
    assert (high < [3.0, 4.0, 3.5]).all()


def test_surfaces_of_the_demo_room_face_inwards() -> None:
    """Otherwise the sun would light the outside of walls that are seen from inside."""
    rng = np.random.default_rng(0)
    room, niche = (-0.05, 1.2, 0.0), (demo_room.NICHE_X, 0.9, demo_room.BACK - 0.1)
    walls = [*demo_room.side_walls(rng), demo_room.back_wall(rng), demo_room.floor(rng)]
    for mesh, middle in [*((wall, room) for wall in walls), (demo_room.niche(rng), niche)]:
        assert mesh.normals is not None
        assert np.einsum("ij,ij->i", mesh.normals, middle - mesh.positions).min() > 0.0
        a, b, c = mesh.positions[mesh.indices].swapaxes(0, 1)
        assert (np.einsum("ij,ij->i", np.cross(b - a, c - a), middle - a) > 0.0).all()


def test_demo_scene_has_many_colours_and_materials(demo: ls.Scene) -> None:
    """Roughness and metalness vary over the scene."""
    gaussians = demo.splats[0].gaussians
    assert gaussians.roughness is not None
    assert np.unique(gaussians.roughness).size >= 5
    assert any(pbr_of(instance.mesh).metallic == 1.0 for instance in demo.meshes)


def test_baked_daylight_of_the_demo_makes_no_colour_brighter_than_its_albedo(demo: ls.Scene) -> None:
    """The display colour is albedo times light of 0..1, with both sun and shade."""
    gaussians = demo.splats[0].gaussians
    assert gaussians.albedo is not None
    shown = decode_srgb(np.clip(gaussians.sh[:, 0] * SH_C0 + 0.5, 0.0, 1.0)).sum(axis=1)
    fraction = shown / np.maximum(gaussians.albedo.sum(axis=1), 1e-3)
    assert fraction.max() < 1.01
    assert np.percentile(fraction, 5) < 0.5
    assert np.percentile(fraction, 95) > 0.7
    for instance in demo.meshes:
        assert instance.mesh.colors is not None
        assert 0.0 <= instance.mesh.colors.min() < instance.mesh.colors.max() <= 1.0


def test_demo_cameras_have_unique_names_and_start_with_hero() -> None:
    """Sizes and count are the requested ones."""
    cameras = ls.demo_cameras(320, 180)
    names = [camera.name for camera in cameras]
    assert names[0] == "hero"
    assert len(set(names)) == len(names) >= 4
    assert {(camera.width, camera.height) for camera in cameras} == {(320, 180)}
    assert [camera.name for camera in ls.demo_cameras(count=2)] == names[:2]


def test_demo_frames_have_no_holes_from_any_demo_camera(demo: ls.Scene) -> None:
    """Every pixel of every view is opaque."""
    renderer = ls.create_renderer(device="cpu")
    for camera in ls.demo_cameras(480, 270):
        frame = renderer.render(demo, camera)
        assert (frame.alpha < 0.98).mean() < 2e-3, camera.name
        assert np.isfinite(frame.depth[frame.alpha > 0.98]).all()
        assert frame.color.std() > 0.06


def test_building_the_demo_scene_reports_progress_from_0_to_1(demo_and_progress: tuple[ls.Scene, list[float]]) -> None:
    """Reported fractions never decrease."""
    reported = demo_and_progress[1]
    assert reported[0] == 0.0
    assert reported == sorted(reported)
    assert reported[-1] == 1.0


@pytest.fixture(scope="module")
def lit(demo: ls.Scene) -> ls.Scene:
    """Returns the demo scene under evening light."""
    return ls.demo_scene_lit(demo)


def test_relit_demo_scene_has_the_gaussians_and_meshes_of_the_demo_scene(demo: ls.Scene, lit: ls.Scene) -> None:
    """Meshes are at the same positions; there is a mirror, glass, and three kinds of lights."""
    assert [instance.name for instance in lit.splats] == ["room", "garden"]
    means = np.concatenate([instance.gaussians.means for instance in lit.splats])
    np.testing.assert_array_equal(means, demo.splats[0].gaussians.means)
    assert [one.name for one in lit.meshes] == [one.name for one in demo.meshes]
    for one, before in zip(lit.meshes, demo.meshes, strict=True):
        np.testing.assert_array_equal(one.mesh.positions, before.mesh.positions)
        assert one.mesh.colors is None
    smooth = [one.mesh.material for one in lit.meshes if one.mesh.material.is_smooth]
    assert sorted(material.transmission for material in smooth if isinstance(material, ls.MaterialPbr)) == [0.0, 1.0]
    assert [type(light) for light in lit.lights] == [ls.LightSpot, ls.LightPoint, ls.LightEnvironment]
    assert [light.name for light in lit.lights] == ["spot", "lamp", "sky"]


def test_relit_demo_scene_contains_no_baked_daylight(lit: ls.Scene) -> None:
    """The room is black with all lights off, while the garden still emits its captured radiance."""
    camera = ls.demo_cameras(160, 90, count=1)[0]
    off = replace(lit, lights=(ls.LightPoint((0.0, 1.0, 0.0), intensity=0.0),))
    dark = ls.render(off, camera, ls.RenderConfig(shadows=ls.Shadows.OFF), device="cpu")
    unlit = ls.render(lit, camera, ls.RenderConfig(lighting=False), device="cpu")
    assert dark.light is not None
    alone = ls.render(
        replace(off, splats=lit.splats[:1]), camera, ls.RenderConfig(shadows=ls.Shadows.OFF), device="cpu"
    )
    room = alone.instance_index == 0
    assert room.sum() > 3000 and np.abs(alone.color[room]).max() < 1e-5
    untouched = (dark.instance_index == 1) & (dark.light == 0.0).all(axis=2)
    assert untouched.sum() > 300
    np.testing.assert_array_equal(dark.pixels_srgb()[untouched], unlit.pixels_srgb()[untouched])


def test_relit_demo_scene_is_well_exposed_from_every_camera(lit: ls.Scene) -> None:
    """Most pixels are neither black nor white, and both warm and cool light are visible."""
    config = ls.RenderConfig(shadows=ls.Shadows.OFF, tone_map=ls.ToneMap.NEUTRAL, samples=2)
    renderer = ls.create_renderer(config, "cpu")
    for camera in ls.demo_cameras(160, 90):
        frame = renderer.render(lit, camera)
        pixels = frame.pixels_srgb()[frame.instance_index != 1]
        brightest = pixels.max(axis=1)
        assert 0.15 < np.median(brightest) < 0.8, camera.name
        assert (brightest > 0.99).mean() < 0.02, camera.name
        assert (brightest < 0.02).mean() < 0.05, camera.name
        assert frame.stats is not None and frame.stats.nonfinite_count == 0


def test_demo_scenes_have_plus_y_as_their_up_direction(demo_and_progress: tuple[ls.Scene, list[float]]) -> None:
    """The capture states its up direction, also outside of the scene."""
    scene = demo_and_progress[0]
    for shown in (scene, ls.demo_scene_lit(), ls.Scene(splats=scene.splats)):
        assert (shown.up_direction, shown.up_source) == ((0.0, 1.0, 0.0), "capture")
