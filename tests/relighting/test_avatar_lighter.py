"""`AvatarLighter` casts shadows of actors on a captured scene, and lights the actors, frame by frame."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.constants import SH_C0
from lumisplat.demo.shapes import icosphere
from lumisplat.lights import LightPath
from lumisplat.math.color import decode_srgb
from lumisplat.math.transforms import multiply_quaternions, rotation_matrix
from lumisplat.relighting import avatar_lighter, probe
from lumisplat.relighting.actor_light import share_beyond
from lumisplat.scene.lights import Light
from lumisplat.scene.ops.mesh_sampling import sample_surface
from lumisplat.shadow_maps import casters_and_receivers
from lumisplat.shadow_maps.deep_shadow_map import DeepShadowMap
from support.scenes.known_light_captures import meadow
from support.scenes.light_room import captured, light_ball

AS_HELD = ls.config.RelightConfig(gamma=1.0)
"""Light as the probe holds it, without an estimated exposure."""
SHADOW = ls.config.DeepShadowConfig(resolution=128, bins=32)
LIGHT = ls.LightPoint((0.0, 3.0, 0.0), intensity=9.0, name="bulb")


@pytest.fixture(autouse=True)
def few_discs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Samples shadow-casting meshes with 4,000 Gaussians; small shadow maps resolve no more, and more take seconds."""
    monkeypatch.setattr(casters_and_receivers, "sample_surface", partial(sample_surface, count=4000))


def floor(x: float = 0.0, cells: int = 21) -> ls.Gaussians:
    """Returns a grey captured floor at y = 0, 4 by 4 units about (x, 0, 0), with Gaussians 0.2 apart by default."""
    steps = np.linspace(-2.0, 2.0, cells)
    points = np.stack(np.meshgrid(steps + x, [0.0], steps, indexing="ij"), axis=-1).reshape(-1, 3)
    return captured(points, np.full(3, 0.4), scale=0.1)


def puppet(x: float = 0.0, count: int = 800) -> ls.SplatInstance:
    """Returns an actor: an opaque ball of radius 0.4 at height 1."""
    rng = np.random.default_rng(1)
    points = rng.normal(size=(count, 3))
    points *= 0.4 / np.linalg.norm(points, axis=1, keepdims=True)
    pose = np.eye(4)
    pose[:3, 3] = (x, 1.0, 0.0)
    return ls.SplatInstance(captured(points, np.full(3, 0.6), opacity=0.95, scale=0.04), pose, name="puppet")


def config(**changes: object) -> ls.config.AvatarLightingConfig:
    """Returns settings with small shadow maps, only direct light and no relighting, except for the given changes."""
    settings = ls.config.AvatarLightingConfig(shadow_map=SHADOW, direct=1.0, relight=False, transfer=AS_HELD)
    return replace(settings, **changes)


def lighter(scene: ls.Scene, lights: Sequence[Light] | None = (LIGHT,), **changes: object) -> ls.AvatarLighter:
    """Returns an `AvatarLighter` on the CPU; ``changes`` are fields of `AvatarLightingConfig`."""
    return ls.AvatarLighter(scene, lights, config(**changes), device="cpu")


def light_left(before: ls.Gaussians, after: ls.Gaussians) -> np.ndarray:
    """Returns the ratio of linear mean colours after and before lighting, for each Gaussian, shape (N,)."""
    old, new = (decode_srgb(g.sh[:, 0].mean(axis=1).astype(np.float64) * SH_C0 + 0.5) for g in (before, after))
    return new / old


def transformed(gaussians: ls.Gaussians, wxyz: np.ndarray) -> ls.Gaussians:
    """Returns Gaussians turned about the origin by a quaternion."""
    rotation = rotation_matrix(wxyz)
    turned = multiply_quaternions(wxyz, gaussians.rotations_wxyz.astype(np.float64))
    return replace(gaussians, means=gaussians.means @ rotation.T, rotations_wxyz=turned)


def turn_between(first: ls.Gaussians, second: ls.Gaussians) -> np.ndarray:
    """Returns the rotation that takes the first Gaussian of one set to that of another, shape (3, 3)."""
    before, after = (rotation_matrix(one.rotations_wxyz[0]) for one in (first, second))
    return after @ before.T


def test_actor_makes_a_captured_floor_dark_inside_its_shadow_and_unchanged_outside() -> None:
    """A ball's shadow on the floor is a disc of radius 0.61: black inside, and unchanged outside."""
    ground = floor()
    scene = lighter(ls.Scene(splats=[ground])).light([puppet()])
    left = light_left(ground, scene.splats[0].gaussians)
    away = np.hypot(ground.means[:, 0], ground.means[:, 2])
    assert left[away < 0.3].max() < 0.05
    np.testing.assert_array_equal(scene.splats[0].gaussians.sh[away > 1.6], ground.sh[away > 1.6])
    assert scene.splats[1].name == "puppet"


def test_shadow_on_a_capture_follows_the_moving_actor() -> None:
    """In the next frame, the shadow is at the actor's new position, and the shadow at the old position is gone."""
    ground = floor()
    stage = lighter(ls.Scene(splats=[ground]))
    stage.light([puppet(-1.0)])
    left = light_left(ground, stage.light([puppet(1.0)]).splats[0].gaussians)
    assert left[np.abs(ground.means - (1.5, 0.0, 0.0)).max(axis=1) < 0.15].max() < 0.05
    assert (left[ground.means[:, 0] < 0.0] == 1.0).all()


def blocked(points: np.ndarray, lamp: Sequence[float], radius: float) -> np.ndarray:
    """Returns whether the ball of `puppet`, with this radius, hides a lamp from each point, shape (N,): geometry."""
    to_lamp = np.array(lamp) - points
    along = ((np.array([0.0, 1.0, 0.0]) - points) * to_lamp).sum(axis=1) / (to_lamp**2).sum(axis=1)
    return np.linalg.norm(points + along[:, None] * to_lamp - (0.0, 1.0, 0.0), axis=1) < radius


def test_shadow_of_a_lamp_that_moves_by_keyframes_falls_where_geometry_says() -> None:
    """Gaussians are dark inside the cone behind the ball and lit outside; a frame alone is as the one after others.

    Gaussians of the ball reach 0.12 beyond its radius of 0.4, and those of the floor two times their 0.1.
    """
    ground = floor()
    lamp = LightPath([replace(LIGHT, position=(x, 3.0, 0.5)) for x in (-1.5, 1.5)], [0.0, 3.0])
    moving = ls.Animation(ls.Scene(splats=[ground]), lights=[lamp], frame_count=4, fps=1.0)
    whole, lit = lighter(moving.scene_at(0.0), None), ground
    for time in moving.times.tolist():
        whole.update(moving.scene_at(time))
        lit = whole.light([puppet()]).splats[0].gaussians
        left = light_left(ground, lit)
        position: Any = lamp.at(time)
        assert left[blocked(ground.means, position.position, 0.3)].max() < 0.1
        assert left[~blocked(ground.means, position.position, 0.7)].min() > 0.99
    alone = lighter(moving.scene_at(0.0), None)
    alone.update(moving.scene_at(3.0))
    np.testing.assert_array_equal(lit.sh, alone.light([puppet()]).splats[0].gaussians.sh)


def test_shadow_of_a_lamp_that_fades_fades_with_it() -> None:
    """A quarter of the light casts a quarter of the shadow, none none; a brighter lamp's is that of the capture."""
    ground = floor()
    lights = [[replace(LIGHT, intensity=share * LIGHT.intensity)] for share in (1.0, 0.25, 1e-6, 0.0, 3.0)]
    stage, depths = lighter(ls.Scene([ground], lights=lights[0]), None), []
    for one in lights:
        stage.update(ls.Scene([ground], lights=one))
        depths.append(1.0 - light_left(ground, stage.light([puppet()]).splats[0].gaussians).min())
    np.testing.assert_allclose(depths, np.array([1.0, 0.25, 0.0, 0.0, 1.0]) * depths[0], atol=5e-3)
    assert depths[0] > 0.9


def test_maps_are_built_anew_for_lights_that_moved_and_no_others(monkeypatch: pytest.MonkeyPatch) -> None:
    """One light moves, one fades, one stays, and one grows; the static mesh's shadow follows the moving one, too."""
    built: list[object] = []
    build = DeepShadowMap.build
    monkeypatch.setattr(
        DeepShadowMap,
        "build",
        lambda casters, light, *more, **keys: built.append(light) or build(casters, light, *more, **keys),
    )
    mesh = replace(icosphere(0.4), material=ls.MaterialPbr())
    moved, faded = replace(LIGHT, position=(1.0, 3.0, 0.0)), replace(LIGHT, position=(0.0, 3.0, 1.0), intensity=2.0)
    grown = replace(LIGHT, radius=0.5)
    first = ls.Scene([floor()], [ls.MeshInstance(mesh, position=(1.0, 1.0, 1.0))], [LIGHT, faded, LIGHT, LIGHT])
    stage = lighter(first, None)
    stage.light([puppet()])
    assert len(built) == 2 * 4  # the actor's and the mesh's
    built.clear()
    second = replace(first, lights=[moved, replace(faded, intensity=4.0), LIGHT, grown])
    stage.update(second)
    again = stage.light([puppet()]).splats[0].gaussians
    assert built == [moved, grown, moved, grown]
    alone = lighter(first, None)
    alone.update(second)
    np.testing.assert_array_equal(again.sh, alone.light([puppet()]).splats[0].gaussians.sh)
    with pytest.raises(ls.SceneError, match="other captures or meshes than the lighter's"):
        stage.update(ls.Scene([floor()]))


def test_probe_of_an_actor_follows_an_environment_that_changes() -> None:
    """A brighter environment around the capture brightens the actor, as if the lighter had begun with it."""
    dim = ls.Scene([floor()], lights=[ls.LightEnvironment(color=(0.2, 0.2, 0.2)), replace(LIGHT, intensity=0.0)])
    bright = replace(dim, lights=[replace(dim.lights[0], intensity=4.0), dim.lights[1]])
    stage = lighter(dim, None, relight=True)
    probes = stage._probes
    before = stage.light([puppet()]).splats[1].gaussians.sh[:, 0]
    stage.update(bright)
    after = stage.light([puppet()]).splats[1].gaussians.sh[:, 0]
    assert after.mean() > before.mean() + 0.1
    assert stage._probes is probes  # and its renderer, which holds the capture
    np.testing.assert_array_equal(
        after, lighter(bright, None, relight=True).light([puppet()]).splats[1].gaussians.sh[:, 0]
    )


def test_captures_in_shadow_keep_the_materials_of_each_frame() -> None:
    """Light that a shadowed capture emits by itself fades with its material."""
    ground, materials = floor(), [ls.MaterialSimple(emissive=value, diffuse=0.0) for value in (1.0, 0.1)]
    scenes = [ls.Scene([ls.SplatInstance(ground, material=material)]) for material in materials]
    stage = lighter(scenes[0])
    for scene, material in zip(scenes, materials, strict=True):
        stage.update(scene)
        seen = stage.light([puppet()]).splats[0]
        assert seen.gaussians is not ground and seen.material == material


def test_frames_of_an_actor_that_returns_to_its_first_position_are_equal_to_the_bit() -> None:
    """The frame of an actor that moved away and back equals its first frame, including the relit colours."""
    stage = lighter(ls.Scene(splats=[floor()]), lights=[LIGHT, replace(LIGHT, position=(1.0, 2.0, 1.0))], relight=True)
    first = stage.light([puppet()])
    stage.light([puppet(0.7)])
    again = stage.light([puppet()])
    for one, other in zip(first.splats, again.splats, strict=True):
        np.testing.assert_array_equal(one.gaussians.sh, other.gaussians.sh)


def test_shadow_of_an_actor_removes_the_direct_fraction_of_the_light_and_no_more() -> None:
    """With a direct fraction of 0.6, the darkest Gaussian in shadow keeps 0.4 of its light."""
    ground = floor()
    left = light_left(ground, lighter(ls.Scene(splats=[ground]), direct=0.6).light([puppet()]).splats[0].gaussians)
    assert left.min() == pytest.approx(0.4, abs=0.02)


def test_shadow_of_actors_under_equal_lights_is_the_mean_of_the_lights_transmittances() -> None:
    """For two equal lights, the factor is the mean of their shadow maps' transmittances through all actors."""
    ground = floor()
    lights = [ls.LightDirectional((0.5, -1.0, 0.0)), ls.LightDirectional((-0.5, -1.0, 0.0))]
    actors = [puppet(-0.8), puppet(0.8)]
    left = light_left(ground, lighter(ls.Scene(splats=[ground]), lights).light(actors).splats[0].gaussians)
    maps = [DeepShadowMap.build(actors, light, ground, SHADOW, device="cpu") for light in lights]
    expected = np.mean([shadow.transmittance_of(ground) for shadow in maps], axis=0)
    np.testing.assert_allclose(left, expected, atol=2e-3)
    assert (left < 0.55).sum() > 20


def test_captures_outside_any_actor_shadow_stay_the_same_objects() -> None:
    """Only the shadowed one of three captures becomes a new object, and is as dark as if it were the only capture."""
    sets = [ls.SplatInstance(floor(9.0)), ls.SplatInstance(floor()), ls.SplatInstance(floor(-9.0))]
    # Both shadow maps get equal bins, and no sample depends on the index of a receiver.
    same = replace(SHADOW, max_distance=4.0, sampling=ls.config.ReceiverSampling.CENTER)
    scene = lighter(ls.Scene(splats=sets), shadow_map=same).light([puppet()])
    assert scene.splats[0] is sets[0] and scene.splats[2] is sets[2]
    alone = lighter(ls.Scene(splats=[sets[1]]), shadow_map=same).light([puppet()])
    left = [light_left(sets[1].gaussians, s.gaussians) for s in (scene.splats[1], alone.splats[0])]
    assert left[0].min() < 0.05
    np.testing.assert_allclose(left[0], left[1], atol=0.01)


def test_shadow_maps_of_later_frames_reuse_the_memory_of_the_first(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two lights build one shadow map each; later frames rebuild both maps without more device memory."""
    built = []
    build = DeepShadowMap.build.__func__

    def counting(*arguments: object, **options: object) -> DeepShadowMap:
        built.append(build(DeepShadowMap, *arguments, **options))
        return built[-1]

    monkeypatch.setattr(DeepShadowMap, "build", counting)
    stage = lighter(ls.Scene(splats=[floor()]), [LIGHT, replace(LIGHT, position=(1, 3, 0))])
    stage.light([puppet()])
    held = [shadow.bytes for shadow in built]
    for _ in range(3):
        stage.light([puppet()])
    assert len(built) == 2 and [shadow.bytes for shadow in built] == held


def test_avatar_lighter_without_actors_returns_the_same_capture_objects_as_the_scene() -> None:
    """The captures are the scene's own objects, without copies."""
    scene = ls.Scene(splats=[floor()])
    assert lighter(scene).light([]).splats[0] is scene.splats[0]


def test_flags_of_an_actor_disable_its_shadow_or_its_relighting() -> None:
    """One actor casts no shadow and the other keeps its colours; both actors are in the frame."""
    ground = floor()
    stage = lighter(ls.Scene(splats=[ground]), relight=True)
    scene = stage.light([puppet(-1.0), puppet(1.0)], casts_shadow=[False, True], relit=[True, False])
    left = light_left(ground, scene.splats[0].gaussians)
    assert (left[ground.means[:, 0] < 0.0] == 1.0).all() and left.min() < 0.05
    is_unchanged = [(i.gaussians.sh == puppet().gaussians.sh).all() for i in scene.splats[1:]]
    assert is_unchanged == [False, True]


def test_relit_actor_is_lit_by_the_radiance_around_its_position() -> None:
    """Above a floor in black space, only the actor's lower side is lit; without relighting, its colours stay."""
    scene = ls.Scene(splats=[floor(cells=41)])
    normals = puppet().gaussians.means / 0.4
    actor = replace(puppet(), gaussians=replace(puppet().gaussians, normals=normals))
    lit = lighter(scene, relight=True, lights_on_actors=False).light([actor]).splats[1]
    left = light_left(actor.gaussians, lit.gaussians)
    assert left[normals[:, 1] < -0.9].mean() > 2.0 * left[normals[:, 1] > 0.9].mean()
    assert lighter(scene).light([actor]).splats[1] is actor


def test_avatar_lighter_reuses_normals_and_probes_of_a_static_actor(monkeypatch: pytest.MonkeyPatch) -> None:
    """Normals are estimated once for each actor, and probes once for each position of an actor."""
    calls: list[str] = []
    estimate, capture = avatar_lighter.estimate_normals, probe.render_cube

    def counted_estimate(*arguments: Any) -> Any:
        calls.append("normals")
        return estimate(*arguments)

    def counted_capture(*arguments: Any, **options: Any) -> Any:
        calls.append("probe")
        return capture(*arguments, **options)

    monkeypatch.setattr(avatar_lighter, "estimate_normals", counted_estimate)
    monkeypatch.setattr(probe, "render_cube", counted_capture)
    stage = lighter(ls.Scene(splats=[floor()]), relight=True)
    actor = puppet()
    for x in (0.0, 0.0, 0.5):
        pose = np.array(actor.transform)
        pose[0, 3] = x
        stage.light([replace(actor, world_from_object=pose)])
    assert calls.count("normals") == 1 and calls.count("probe") == 2


def test_mesh_actors_cast_shadows_on_captures_and_are_lit_by_the_lights_of_the_frame() -> None:
    """The frame has lights for the mesh; pixels of captures equal those of an unlit frame."""
    ground = floor()
    pose = np.eye(4)
    pose[:3, 3] = (0.0, 1.0, 0.0)
    actor = ls.MeshInstance(icosphere(0.4), pose)
    scene = lighter(ls.Scene(splats=[ground]), relight=True).light([actor])
    assert scene.meshes == (actor,)
    assert [light.name for light in scene.lights] == ["bulb", "around"]
    left = light_left(ground, scene.splats[0].gaussians)
    away = np.hypot(ground.means[:, 0], ground.means[:, 2])
    assert left[away < 0.3].max() < 0.05 and (left[away > 1.6] == 1.0).all()
    camera = ls.Camera.look_at((0.0, 2.5, 3.0), (0.0, 0.0, 0.0), width=48, height=32, fov_y=1.0)
    # One sample passes through each pixel centre, as in the unlit frame.
    lit = ls.render(scene, camera, ls.RenderConfig(samples=1), device="cpu").pixels_srgb()
    unlit = ls.render(ls.Scene(splats=scene.splats), camera, device="cpu").pixels_srgb()
    there = ls.render(ls.Scene(meshes=scene.meshes), camera, device="cpu").alpha > 0.0
    assert 0 < there.sum() < there.size
    np.testing.assert_array_equal(lit[~there], unlit[~there])


def test_captures_do_not_shadow_mesh_actors() -> None:
    """A mesh actor under a captured lampshade and ceiling, which would block all shadow rays, is as bright as alone."""
    shade = light_ball(LIGHT.position, (0.9, 0.9, 0.9), radius=0.1, count=400)
    ceiling = captured(np.array([0.0, 4.0, 0.0]) + floor().means, np.full(3, 0.5), opacity=1.0, scale=0.2)
    pose = np.eye(4)
    pose[1, 3] = 1.0
    actor = ls.MeshInstance(icosphere(0.4), pose)
    camera = ls.Camera.look_at((0.0, 1.6, 3.0), (0.0, 1.0, 0.0), width=48, height=32, fov_y=0.4)
    there = ls.render(ls.Scene(meshes=[actor]), camera, device="cpu").alpha == 1.0
    alone = ls.Scene(splats=[captured(np.array([[0.0, -9.0, 0.0]]), np.ones(3))])
    open_air, enclosed = (
        ls.render(lighter(scene).light([actor]), camera, device="cpu").color[there].mean()
        for scene in (alone, ls.Scene(splats=[floor(), shade, ceiling]))
    )
    assert enclosed == pytest.approx(open_air, rel=1e-3) and open_air > 0.05


def test_mesh_actors_get_no_probe_light_if_the_given_lights_have_an_environment() -> None:
    """The frame has all enabled lights; if they include an environment, no light from a probe is added."""
    lights = [LIGHT, replace(LIGHT, casts_shadow=False), ls.LightEnvironment(name="sky"), replace(LIGHT, enabled=False)]
    stage = lighter(ls.Scene(splats=[floor()]), lights, relight=True)
    assert stage.lights == (LIGHT,)
    frame = stage.light([ls.MeshInstance(icosphere(0.4))])
    assert [light.name for light in frame.lights] == ["bulb", "bulb", "sky"]
    assert [light.intensity for light in frame.lights] == [9.0, 9.0, 1.0]


def test_captures_beside_mesh_actors_lose_their_materials_and_are_rendered_unlit() -> None:
    """The frame's lights are for meshes, so captures and Gaussian actors lose materials and ``shadow_catcher``."""
    sets = [ls.SplatInstance(floor(), material=ls.MaterialPbr()), ls.SplatInstance(floor(9.0), shadow_catcher=True)]
    actors = [ls.MeshInstance(icosphere(0.4)), replace(puppet(2.0), material=ls.MaterialPbr())]
    stage = lighter(ls.Scene(splats=sets))
    assert all(i.material is None and not i.shadow_catcher for i in stage.light(actors).splats)
    alone = stage.light(actors[1:])
    assert not alone.lights and alone.splats[0].material is not None and alone.splats[1].shadow_catcher


def test_meshes_of_a_scene_cast_shadows_on_its_captures_also_if_there_are_no_actors() -> None:
    """The capture was made without the meshes; their shadows are multiplied by the shadows of actors."""
    ground = floor()
    pose = np.eye(4)
    pose[:3, 3] = (1.0, 1.0, 0.0)
    stage = lighter(ls.Scene(splats=[ground], meshes=[ls.MeshInstance(icosphere(0.4), pose)]))
    alone = light_left(ground, stage.light([]).splats[0].gaussians)
    both = light_left(ground, stage.light([puppet(-1.0)]).splats[0].gaussians)
    assert alone[ground.means[:, 0] > 0.0].min() < 0.05 and (alone[ground.means[:, 0] < 0.0] == 1.0).all()
    np.testing.assert_array_equal(both[ground.means[:, 0] > 0.0], alone[ground.means[:, 0] > 0.0])
    assert both[ground.means[:, 0] < 0.0].min() < 0.05


def test_relit_captures_get_scene_lights_and_ray_traced_shadows_in_place_of_shadow_maps(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Captures with a material and shadow catchers are shadowed by the renderer's rays, which a warning reports."""
    sets = [
        ls.SplatInstance(floor(), material=ls.MaterialPbr()),
        ls.SplatInstance(floor(), shadow_catcher=True),
        ls.SplatInstance(floor()),
    ]
    scene = ls.Scene(splats=sets, lights=[LIGHT, ls.LightEnvironment()])
    with caplog.at_level(logging.WARNING, logger="lumisplat"):
        stage = lighter(scene, None)
    assert stage.lights == (LIGHT,)
    assert "2 of 3 captures reflect light: the renderer's shadow rays shadow them" in caplog.text
    frame = stage.light([puppet()])
    assert frame.lights == scene.lights
    shiny = replace(puppet(), material=ls.MaterialPbr())
    assert lighter(ls.Scene(splats=sets[2:], lights=scene.lights), None, relight=True).light([shiny]).splats[1] is shiny
    assert frame.splats[0] is sets[0] and frame.splats[1] is sets[1] and frame.splats[2] is not sets[2]


def test_avatar_lighter_without_lights_estimates_them_once_around_the_first_actors() -> None:
    """A lamp in the capture becomes a light, with the direct fraction of the irradiance at the actor's position."""
    scene = ls.Scene(splats=[floor(), light_ball((1.0, 2.5, 0.5), (1.0, 0.8, 0.6))])
    # The lamp does not light the floor: it is found by its score alone.
    looks = ls.config.LightEstimationConfig(evidence=0.0)
    stage = lighter(scene, None, light_count=1, direct=0.8, estimation=looks)
    assert stage.lights is None
    first = stage.light([puppet()])
    assert stage.lights is not None and stage.estimate is not None
    assert np.linalg.norm(np.subtract(stage.lights[0].position, (1.0, 2.5, 0.5))) < 0.081
    assert light_left(scene.splats[0].gaussians, first.splats[0].gaussians).min() < 0.25
    found = stage.lights
    stage.light([puppet(0.5)])
    assert stage.lights is found
    # The mean radiance around the actor gives a surface pi times as much irradiance.
    middle = np.array([0.0, 1.0, 0.0]) + np.average(puppet().gaussians.means, axis=0)
    around = ls.avatars.EnvironmentProbe.capture(scene, middle, device="cpu")
    directions = np.random.default_rng(0).normal(size=(20_000, 3))
    mean = (around.radiance(directions) @ (0.2126, 0.7152, 0.0722)).mean()
    arriving = found[0].intensity / np.sum(np.subtract(found[0].position, middle) ** 2)
    assert arriving == pytest.approx(0.8 * np.pi * mean, rel=0.03)


def test_light_inside_an_actor_is_logged_once_as_a_warning(caplog: pytest.LogCaptureFixture) -> None:
    """A light inside an actor is shadowed everywhere; a light just above a flat, wide Gaussian is not inside."""
    within = ls.LightPoint((0.1, 1.02, 0.0), name="torch")
    above = ls.LightPoint((0.0, 1.3, 0.0), name="lantern")
    # A disc that faces x, rotated by 90 degrees about z, faces y.
    disc = replace(captured(np.zeros((1, 3)), np.ones(3)), scales=np.array([[0.01, 0.3, 0.3]]))
    turned = np.array([[0, -1, 0, 0], [1, 0, 0, 1.0], [0, 0, 1, 0], [0, 0, 0, 1]])
    stage = lighter(ls.Scene(splats=[floor()]), [within, above])
    with caplog.at_level(logging.WARNING, logger="lumisplat"):
        for _ in range(2):
            stage.light([ls.SplatInstance(disc, turned)])
    assert caplog.text.count("is inside an actor") == 1 and "'torch'" in caplog.text


def test_shadow_region_follows_the_actors_from_frame_to_frame() -> None:
    """After the actor has moved, ``region_radius`` is measured from its new position."""
    ground = floor()
    slanted = ls.LightDirectional((1.0, -1.0, 0.0))
    near = replace(SHADOW, region_radius=0.8)  # measured from the ball of radius 0.4
    stage = lighter(ls.Scene(splats=[ground]), [slanted], shadow_map=near)
    stage.light([puppet(-1.5)])
    left = light_left(ground, stage.light([puppet(0.5)]).splats[0].gaussians)
    assert left[ground.means[:, 0] > 1.2].min() < 0.05
    assert (left[ground.means[:, 0] > 0.5 + 0.4 + 0.8] == 1.0).all()


def test_actors_too_far_from_any_capture_to_cast_shadows_are_logged_once(caplog: pytest.LogCaptureFixture) -> None:
    """The capture stays the same object, without any shadow."""
    ground = floor()
    stage = lighter(ls.Scene(splats=[ground]), shadow_map=replace(SHADOW, region_radius=0.5))
    with caplog.at_level(logging.WARNING, logger="lumisplat"):
        frames = [stage.light([puppet()]) for _ in range(2)]
    assert all(frame.splats[0].gaussians is ground for frame in frames)
    assert caplog.text.count("no receivers within 0.5 of the actors") == 1


def test_avatar_lighter_without_shadows_estimates_no_lights() -> None:
    """The capture stays the same object, and the actor is added to the frame."""
    scene = ls.Scene(splats=[floor()])
    frame = ls.AvatarLighter(scene, None, config(shadows=False), device="cpu").light([puppet()])
    assert frame.splats[0] is scene.splats[0] and len(frame.splats) == 2


@pytest.mark.parametrize(
    ("scene", "lights", "actors", "message"),
    [
        (3, None, [], "takes a Scene with captured Gaussians"),
        (ls.Scene(), None, [], "takes a Scene with captured Gaussians"),
        (ls.Scene(splats=[floor()]), [], [], "none of the lights"),
        (ls.Scene(splats=[floor()]), [ls.LightEnvironment()], [], "none of the lights"),
        (ls.Scene(splats=[floor()]), [replace(LIGHT, casts_shadow=False)], [], "none of the lights"),
        (ls.Scene(splats=[floor()]), LIGHT, [], "lights is a LightPoint, expected a list"),
        (ls.Scene(splats=[floor()]), [LIGHT, 3], [], "lights holds a int"),
        (ls.Scene(splats=[floor()]), [LIGHT], [3], "actors holds a int"),
        (ls.Scene(splats=[floor()]), [LIGHT], puppet(), "actors is one SplatInstance"),
        (ls.Scene(splats=[floor()]), None, [puppet()], "no light found"),
    ],
)
def test_avatar_lighter_refuses_invalid_scenes_lights_and_actors(
    scene: Any, lights: Any, actors: Any, message: str
) -> None:
    """Scenes without captures, lights that cast no shadow, and actors of another type are refused."""
    with pytest.raises(ls.SceneError, match=message):
        lighter(scene, lights).light(actors)


def test_avatar_lighter_refuses_a_list_of_flags_unless_it_has_one_flag_per_actor() -> None:
    """Flags must be a list with one boolean per actor."""
    with pytest.raises(ls.SceneError, match="relit has 2 entries, expected 1"):
        lighter(ls.Scene(splats=[floor()])).light([puppet()], relit=[True, False])


def test_actors_are_lit_by_scene_lights_as_by_given_ones_if_no_capture_has_a_material() -> None:
    """No capture reflects the scene's lights, so they light actors like given lights; captures do not block them."""
    environment = ls.LightEnvironment(intensity=0.5, name="sky")
    bare, ball = [ls.SplatInstance(floor())], ls.MeshInstance(icosphere(0.4))
    for lights in ((LIGHT,), (LIGHT, environment), (environment,)):
        own, given = lighter(ls.Scene(splats=bare, lights=lights), None, relight=True), None
        if LIGHT in lights:
            given = lighter(ls.Scene(splats=bare), lights, relight=True).light([ball]).lights
            frame = own.light([ball])
            assert [(o.name, o.intensity, o.casts_shadow) for o in frame.lights] == [
                (g.name, g.intensity, g.casts_shadow) for g in given
            ]
        # Without meshes, the frame only has the environment as background.
        assert own.light([]).lights == tuple(light for light in lights if light is environment)
    shiny = replace(puppet(), material=ls.MaterialPbr())
    assert lighter(ls.Scene(splats=bare, lights=[LIGHT]), None).light([shiny]).lights == (LIGHT,)


def test_probe_of_an_actor_includes_the_background_radiance() -> None:
    """An actor far from all captures is lit by the background's radiance alone."""
    scene = ls.Scene(splats=[captured(np.array([[0.0, -50.0, 0.0]]), np.ones(3))])
    actor = puppet()
    colors = []
    for background in ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0)):
        stage = ls.AvatarLighter(scene, [LIGHT], config(relight=True), background=background, device="cpu")
        colors.append(stage.light([actor]).splats[1].gaussians.sh[:, 0].mean() * SH_C0 + 0.5)
    assert colors[0] < 0.02
    assert decode_srgb(np.array(colors[1])) == pytest.approx(0.6, abs=0.01)


def brightness(captured_at: float, place: float, albedo: float | None = None) -> float:
    """Returns the mean linear brightness of a relit ball captured in one light, above a floor seen in another.

    Args:
        captured_at: Brightness of the ball's capture, relative to 0.8.
        place: Light above the floor.
        albedo: Albedo that the ball stores; None: none.
    """
    ground = captured(floor().means, np.full(3, 0.8 * place), scale=0.1)
    ball = replace(puppet(), gaussians=captured(puppet().gaussians.means, np.full(3, 0.8 * captured_at), scale=0.04))
    if albedo is not None:
        stored = np.full((ball.gaussians.count, 3), albedo, np.float32)
        ball = replace(ball, gaussians=replace(ball.gaussians, albedo=stored))
    stage = lighter(ls.Scene(splats=[ground]), relight=True, transfer=ls.config.RelightConfig(), lights_on_actors=False)
    return float(decode_srgb(stage.light([ball]).splats[1].gaussians.sh[:, 0] * SH_C0 + 0.5).mean())


def test_a_relit_figure_is_as_bright_as_its_surroundings_make_a_card_of_its_albedo(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Balls have the brightness of their albedo of 0.5, times the light of the floor, however bright their capture."""
    with caplog.at_level(logging.WARNING, logger="lumisplat"):
        assert brightness(0.5, 1.0) == pytest.approx(0.5, rel=0.15)
    assert caplog.text.count("actor 'puppet' is lit at ") == 1
    assert "to match its surroundings (light there 1, in its own capture 0.8, display white 1)" in caplog.text
    assert brightness(0.35, 1.0) == pytest.approx(brightness(0.5, 1.0), rel=0.02)
    assert brightness(0.5, 0.3) == pytest.approx(0.3 * brightness(0.5, 1.0), rel=0.02)


def test_a_relit_figure_of_known_albedo_is_as_bright_as_its_surroundings_make_it(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """A figure made of a dark mesh stays dark, and one whose capture was in shadow is lit by the place alone."""
    grey = brightness(0.5, 1.0)  # of an albedo taken to be 0.5
    with caplog.at_level(logging.WARNING, logger="lumisplat"):
        assert brightness(0.125, 0.6, albedo=0.1) == pytest.approx(0.6 * grey * 0.1 / 0.5, rel=0.02)
    assert "(light there 0.6, in its own capture 1, display white 1)" in caplog.text
    assert brightness(0.125, 0.6, albedo=0.4) == pytest.approx(0.6 * grey * 0.4 / 0.5, rel=0.02)


@pytest.mark.parametrize("unit", [1.0, 1e-3])
def test_the_light_of_a_capture_does_not_depend_on_the_units_of_its_file(unit: float) -> None:
    """A small figure of known albedo is as bright as a large one."""
    ball = replace(puppet().gaussians, albedo=np.full((puppet().gaussians.count, 3), 0.5, np.float32))
    ball = replace(ball, means=ball.means * np.float32(unit), scales=ball.scales * np.float32(unit))
    ground = captured(floor().means * np.float32(unit), np.full(3, 0.8), scale=0.1 * unit)
    stage = lighter(ls.Scene([ground]), relight=True, transfer=ls.config.RelightConfig(), lights_on_actors=False)
    shown = decode_srgb(stage.light([ball]).splats[1].gaussians.sh[:, 0] * SH_C0 + 0.5).mean()
    assert shown == pytest.approx(0.5, rel=0.15)


def test_an_open_place_lights_figures_from_where_no_capture_is() -> None:
    """The sky that a captured floor leaves open lights the upper side most; a given background is taken instead."""
    scene = ls.Scene(splats=[floor(cells=41)])
    normals = puppet().gaussians.means / 0.4
    actor = replace(puppet(), gaussians=replace(puppet().gaussians, normals=normals))
    auto = config(relight=True, transfer=ls.config.RelightConfig(), lights_on_actors=False)
    for background, brighter in (((0.0, 0.0, 0.0), "up"), ((0.05, 0.05, 0.05), "down")):
        stage = ls.AvatarLighter(scene, [LIGHT], auto, background=background, device="cpu")
        left = light_left(actor.gaussians, stage.light([actor]).splats[1].gaussians)
        up, down = left[normals[:, 1] > 0.9].mean(), left[normals[:, 1] < -0.9].mean()
        assert (up > 1.25 * down) if brighter == "up" else (down > 1.5 * up)


def test_figures_are_in_the_shadow_of_each_other_and_of_themselves() -> None:
    """Under a vertical sun a ball below another gets no sun, whether they are two actors or one."""
    scene = ls.Scene(splats=[captured(np.array([[0.0, -50.0, 0.0]]), np.ones(3))])
    normals = puppet().gaussians.means / np.float32(0.4)
    upper = replace(puppet(), gaussians=replace(puppet().gaussians, normals=normals))
    pose = np.array(upper.transform)
    pose[1, 3] = -0.5
    lower = replace(upper, world_from_object=pose)
    means = np.concatenate([puppet().gaussians.means + np.array([0.0, 1.5, 0.0], np.float32), puppet().gaussians.means])
    joined = replace(captured(means, np.full(3, 0.6), opacity=0.95, scale=0.04), normals=np.tile(normals, (2, 1)))
    sun = sunny((0.0, -1.0, 0.0))
    lit = {}
    for shadows in (True, False):
        settings = config(relight=True, shadows=shadows)
        for actors in ([upper, lower], [ls.SplatInstance(joined, pose)]):
            stage = ls.AvatarLighter(scene, [sun], settings, background=(0.5, 0.5, 0.5), device="cpu")
            placed = stage.light(actors).splats[1:]
            left = [light_left(old.gaussians, new.gaussians) for old, new in zip(actors, placed, strict=True)]
            lit[shadows, len(actors)] = np.concatenate(left).reshape(2, -1)
    around = decode_srgb(np.array(0.5))
    facing = normals[:, 1] > 0.5
    for count in (2, 1):
        shadowed, bare = lit[True, count][:, facing], lit[False, count][:, facing]
        np.testing.assert_allclose(bare[1], bare[0], atol=5e-3)
        np.testing.assert_allclose(shadowed[0], bare[0], atol=0.02)  # no acne
        assert np.median(shadowed[1]) < around + 0.03 and np.median(bare[1]) > around + 0.3


def test_figures_cast_no_shadows_of_a_light_that_the_scene_keeps_from_them() -> None:
    """Under a lid as bright as the background no light of the sun above arrives, so that no figure can block any."""
    lid = captured(floor().means + np.array([0.0, 3.0, 0.0], np.float32), decode_srgb(np.full(3, 0.5)), scale=0.3)
    ball = puppet().gaussians
    upper = replace(puppet(), gaussians=replace(ball, normals=ball.means / np.float32(0.4)))
    pose = np.array(upper.transform)
    pose[1, 3] = -0.5
    lower = replace(upper, world_from_object=pose)
    lit = []
    for shadows in (True, False):
        settings = config(relight=True, shadows=shadows)
        sun = sunny((0.0, -1.0, 0.0))
        stage = ls.AvatarLighter(ls.Scene(splats=[lid]), [sun], settings, background=(0.5, 0.5, 0.5), device="cpu")
        lit.append(light_left(ball, stage.light([upper, lower]).splats[2].gaussians))
    np.testing.assert_allclose(*lit, atol=5e-3)


def test_normals_of_a_sequence_are_those_of_its_first_frame_turned_along(monkeypatch: pytest.MonkeyPatch) -> None:
    """A figure whose every frame is a new object is estimated once; the sides follow its turn."""
    first = puppet().gaussians
    turn = np.array([np.cos(0.6), 0.0, np.sin(0.6), 0.0])
    frames = [first]
    for _ in range(3):
        frames.append(transformed(frames[-1], turn))
    estimate, calls = avatar_lighter.estimate_normals, []
    monkeypatch.setattr(avatar_lighter, "estimate_normals", lambda *given: calls.append(1) or estimate(*given))
    stage = lighter(ls.Scene(splats=[floor()]), relight=True)
    found = [stage._normals_of(0, frame) for frame in frames]  # pyright: ignore[reportPrivateUsage]
    assert len(calls) == 1
    for normals, frame in zip(found, frames, strict=True):
        np.testing.assert_allclose(normals, found[0] @ turn_between(first, frame).T, atol=1e-5)


def test_an_actor_keeps_its_exposure_when_another_one_leaves() -> None:
    """Two balls captured in different light: the second one alone looks as it did beside the first one."""
    scene = ls.Scene(splats=[floor()])
    dark, bright = (captured(puppet().gaussians.means, np.full(3, grey), scale=0.04) for grey in (0.2, 0.5))

    def shown(time: float) -> list[ls.SplatInstance]:
        return [ls.SplatInstance(dark, name="dark")] if time < 0.5 else []

    actors = [ls.Actor(shown), ls.Actor(bright, name="bright")]
    stage = lighter(scene, relight=True, shadows=False, transfer=ls.config.RelightConfig(), lights_on_actors=False)
    both, alone = (
        stage.light([one for one, _, _ in placed], keys=[key for _, _, key in placed]).splats[-1].gaussians.sh
        for placed in map(ls.Animation(scene, actors).placed_at, (0.0, 1.0))
    )
    np.testing.assert_array_equal(alone, both)
    with pytest.raises(ls.SceneError, match="keys has 1 different entries, expected 2, one per actor"):
        stage.light([puppet(), puppet()], keys=["a", "a"])


def test_light_that_actors_hide_from_the_whole_capture_is_logged_once(caplog: pytest.LogCaptureFixture) -> None:
    """A light in a hollow actor is inside no Gaussian, but the whole capture is in shadow."""
    stage = lighter(ls.Scene(splats=[floor()]), [replace(LIGHT, position=(0.0, 1.0, 0.0), name="torch")])
    with caplog.at_level(logging.WARNING, logger="lumisplat"):
        for x in (0.0, 0.1):
            stage.light([puppet(x)])
    assert caplog.text.count("light 'torch' hardly reaches the capture") == 1


def sunny(direction: tuple[float, float, float], intensity: float = 0.5 * np.pi) -> ls.LightDirectional:
    """Returns a sun that shines along a direction."""
    return ls.LightDirectional(direction, intensity=intensity, name="sun")


def ball_in(scene: ls.Scene, lights: list[Light], **changes: object) -> np.ndarray:
    """Returns the brightness of the puppet's Gaussians, relit in a scene, relative to a white environment, (N,)."""
    actor = puppet()
    actor = replace(actor, gaussians=replace(actor.gaussians, normals=actor.gaussians.means / np.float32(0.4)))
    white = ls.AvatarLighter(scene, lights, config(relight=True, **changes), background=(0.5, 0.5, 0.5), device="cpu")
    return light_left(actor.gaussians, white.light([actor]).splats[-1].gaussians)


def test_given_lights_add_their_irradiance_to_relit_actors_unless_disabled() -> None:
    """A sun of irradiance pi / 2 adds half the cosine, a lamp its candela over squared distance times the cosine."""
    scene = ls.Scene(splats=[captured(np.array([[0.0, -50.0, 0.0]]), np.ones(3))])
    sun = sunny((0.0, -1.0, 0.0))
    upwards = puppet().gaussians.means[:, 1] / 0.4
    around = decode_srgb(np.array(0.5))
    lit = ball_in(scene, [sun])
    np.testing.assert_allclose(lit, around + 0.5 * np.maximum(upwards, 0.0), atol=5e-3)
    np.testing.assert_allclose(ball_in(scene, [sun], lights_on_actors=False), around, atol=5e-3)
    offsets = np.array(LIGHT.position) - (puppet().gaussians.means + np.array((0.0, 1.0, 0.0)))
    distances = np.linalg.norm(offsets, axis=1)
    cosines = np.einsum("ni,ni->n", offsets, puppet().gaussians.means / 0.4) / distances
    arriving = 9.0 / distances**2 * np.maximum(cosines, 0.0) / np.pi
    np.testing.assert_allclose(ball_in(scene, [LIGHT]), around + arriving, atol=0.01)


def test_sun_blocked_by_the_scene_does_not_light_actors(caplog: pytest.LogCaptureFixture) -> None:
    """A roof above the actor blocks the sun with a warning; a roof aside or beyond the shadow distance does not."""
    roof = captured(np.array([0.0, 3.0, 0.0]) + floor(cells=41).means, np.zeros(3), opacity=1.0, scale=0.1)
    sun = sunny((0.0, -1.0, 0.0))
    with caplog.at_level(logging.WARNING, logger="lumisplat"):
        under, without = (ball_in(ls.Scene(splats=[roof]), [sun], lights_on_actors=on) for on in (True, False))
    np.testing.assert_allclose(under, without, atol=5e-3)
    assert caplog.text.count("light 'sun' does not reach an actor") == 1
    assert "shadow_distance" in caplog.text
    caplog.clear()
    below_sky = ball_in(ls.Scene(splats=[roof]), [replace(sun, shadow_distance=1.5)])
    assert (below_sky - without).max() > 0.4
    assert "does not reach an actor" not in caplog.text
    slanted = sunny((0.0, -0.3, 1.0))
    assert (ball_in(ls.Scene(splats=[roof]), [slanted]) - without).max() > 0.4


def test_sun_adds_to_relit_actors_only_irradiance_that_their_probe_does_not_contain() -> None:
    """The probe's irradiance from the sun's direction beyond its mean is subtracted from the sun, down to 0."""
    directions = np.random.default_rng(0).normal(size=(4000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    spot = np.where(directions[:, 1:2] > 0.9, 5.0, 0.2) * np.ones(3)
    probe = ls.avatars.EnvironmentProbe.fit(directions, spot)
    held = (probe.irradiance((0.0, 1.0, 0.0)) - np.pi * probe.coefficients[0] * SH_C0)[0]
    assert held > 0.5
    for intensity, left in ((0.5 * held, 0.0), (3.0 * held, 2.0 / 3.0)):
        assert share_beyond(probe, sunny((0, -1, 0), intensity), np.zeros(3)) == pytest.approx(left, abs=2e-3)
    assert share_beyond(probe, sunny((0, 1, 0), 1.0), np.zeros(3)) == pytest.approx(1.0)


def test_actors_cast_shadows_of_an_estimated_sun_if_no_local_light_is_found(caplog: pytest.LogCaptureFixture) -> None:
    """The estimated sun is within 10 degrees of the true one, and a warning reports that no local light was found."""
    towards = np.array([0.5, 0.7, 0.4])
    scene = ls.Scene(splats=[meadow((0.5, 0.7, 0.4))])
    stage = lighter(scene, None, direct=0.8)
    with caplog.at_level(logging.WARNING, logger="lumisplat"):
        frame = stage.light([puppet()])
    assert stage.estimate is None and stage.sun is not None and stage.lights is not None
    assert "no light found" in caplog.text
    (sun,) = stage.lights
    assert isinstance(sun, ls.LightDirectional) and sun.intensity > 0.1
    assert -np.dot(sun.direction, towards) / np.linalg.norm(towards) > np.cos(np.radians(10.0))
    assert frame.splats[0].gaussians is not scene.splats[0].gaussians


def points_of_sphere(center: tuple[float, float, float], radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Returns 300 points of a sphere and its outward normals, shape (300, 3) each."""
    normals = np.random.default_rng(0).normal(size=(300, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return center + radius * normals, normals


def test_relighting_an_actor_lowers_its_light_metrics() -> None:
    """A figure lit bluish from the side is relit among diffuse balls below a reddish ceiling.

    The direction and the colour of its light agree better by a fifth. APF-Y must not rise: it is linear in brightness.
    """
    reddish, steps = np.array([1.0, 0.8, 0.6]), np.linspace(-8.0, 8.0, 33)
    ceiling = np.stack(np.meshgrid(steps, [2.5], steps, indexing="ij"), axis=-1).reshape(-1, 3)
    sets = [captured(ceiling, reddish, opacity=0.99, scale=0.4)]
    for x, z in ((-1.0, 0.0), (1.0, 0.0), (0.0, -1.0), (0.0, 1.0)):
        points, normals = points_of_sphere((x, 0.0, z), 0.1)
        irradiance = 0.5 + 0.5 * normals[:, 1:2]  # an endless ceiling of constant radiance
        sets.append(replace(captured(points, 0.5 * irradiance * reddish, opacity=0.95, scale=0.02), normals=normals))
    scene = ls.Scene(splats=[ls.SplatInstance(one) for one in sets])
    points, normals = points_of_sphere((0.0, 0.0, 0.0), 0.2)
    bluish = (0.3 + 0.5 * np.maximum(normals[:, :1], 0.0)) * (0.5, 0.6, 0.7)
    figure = ls.SplatInstance(replace(captured(points, bluish, opacity=0.95), normals=normals))
    settings = ls.config.AvatarLightingConfig(shadows=False)
    lighter = ls.AvatarLighter(scene, config=settings, background=(0.0, 0.0, 0.0), device="cpu")
    relit = lighter.light([figure]).splats[-1]
    around = ls.metrics.LitPoints.of(scene, around=np.zeros(3), radius=1.5)
    for metric, most in ((ls.metrics.paa_y, 0.8), (ls.metrics.apf_y, 1.0), (ls.metrics.ncm_ab, 0.8)):
        before, after = (metric(ls.metrics.LitPoints.of(one), around, radius=1.5) for one in (figure, relit))
        assert after < most * before, (metric.__name__, before, after)
