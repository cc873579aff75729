"""Direct light of lamps and suns in real time, whose visibility is remembered while their light is computed anew."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import warp as wp

import lumisplat as ls
from lumisplat.device.gi.light_visibility import VISIBILITY_MOST
from lumisplat.renderer.scene.motion import has_same_place, lights_before
from support.probes.probe_visibility_kernels import find_variances, repack
from support.scenes.path_scenes import as_splats, diffuse, quad

Floats = npt.NDArray[np.float32]

FLOOR = quad((-2, 0, -2), (0, 0, 4), (4, 0, 0), diffuse(0.5))
ABOVE = ls.Camera.look_at((0, 3.0, 0.01), (0, 0, 0), (0, 0, -1), width=48, height=32, fov_y=0.6)


def direct_light(scenes: list[ls.Scene], camera: ls.Camera, **settings: Any) -> list[Floats]:
    """Returns the direct diffuse light of each frame of a sequence."""
    real_time = ls.RealtimeConfig(antialiasing=False, **settings)
    config = ls.RenderConfig(pipeline=ls.Pipeline.REALTIME, max_bounces=0, aovs=("direct_diffuse",), realtime=real_time)
    renderer = ls.create_renderer(config, device="cpu")
    frames: list[Any] = [renderer.render(scene, camera) for scene in scenes]
    return [frame.direct_diffuse for frame in frames]


def hard(scene: ls.Scene, camera: ls.Camera) -> Floats:
    """Returns direct light with hard shadows."""
    config = ls.RenderConfig(pipeline=ls.Pipeline.HYBRID, shadows=ls.Shadows.HARD, max_bounces=0)
    return ls.render(scene, camera, config, device="cpu").color


def with_lamp(x: float, intensity: float = 2.0) -> ls.Scene:
    """Returns a floor under a point light, beside a sun that a shade over the whole floor blocks."""
    shade = quad((-4, 4, -4), (8, 0, 0), (0, 0, 8), diffuse(0.5))
    sun = ls.LightDirectional((0.0, -1.0, 0.0), intensity=8.0)
    return ls.Scene(meshes=[FLOOR, shade], lights=[ls.LightPoint((x, 1.0, 0.0), intensity=intensity), sun])


def test_light_of_a_moving_lamp_beside_a_blocked_sun_is_right_in_every_frame() -> None:
    """Most samples are black, and the lamp moves and brightens; without memory of visibility 7 to 25 % are missing."""
    still = [with_lamp(-0.6)] * 24
    moving = [with_lamp(-0.6 + 0.05 * k, 2.0 * 1.03**k) for k in range(24)]
    frames = direct_light([*still, *moving], ABOVE)[-24:]
    for scene, frame in zip(moving, frames, strict=True):
        truth = hard(scene, ABOVE)
        assert frame.mean() == pytest.approx(truth.mean(), rel=0.005)
        assert np.abs(frame - truth).mean() < 0.01 * truth.mean()


HIGH = ls.Camera.look_at((0, 8.0, 0.01), (0, 0, 0), (0, 0, -1), width=72, height=48, fov_y=0.3)

BALL = replace(ls.sphere(0.25), material=diffuse(0.5))


def with_ball(x: float, splats: ls.Gaussians | None) -> ls.Scene:
    """Returns a floor under three lamps and a ball, which is a mesh or consists of these Gaussians."""
    lamps = [ls.LightPoint((0.0, 1.8, z), intensity=1.0) for z in (-0.1, 0.0, 0.1)]
    if splats is None:
        return ls.Scene(meshes=[FLOOR, ls.MeshInstance(BALL, position=(x, 0.8, 0.0))], lights=lamps)
    ball = ls.SplatInstance(splats, material=ls.MaterialPbr(), position=(x, 0.8, 0.0))
    return ls.Scene(splats=[ball], meshes=[FLOOR], lights=lamps)


@pytest.mark.parametrize("splats", [None, as_splats(BALL, 4_000).gaussians], ids=["mesh", "splats"])
def test_shadow_of_a_ball_that_jumps_follows_within_five_frames(splats: ls.Gaussians | None) -> None:
    """Nine tenths of the old shadow are lit, and nine tenths of the new one dark, with two other lamps."""
    scenes = [with_ball(x, splats) for x in (-0.5, 0.5)]
    frames = direct_light([scenes[0]] * 24 + [scenes[1]] * 5, HIGH)
    config = ls.RenderConfig(pipeline=ls.Pipeline.HYBRID, shadows=ls.Shadows.HARD, max_bounces=0)
    truths = [ls.render(scene, HIGH, config, device="cpu") for scene in scenes]
    floor = np.all([truth.depth > 7.9 for truth in truths], axis=0)
    settled = direct_light([scenes[1]] * 28, HIGH)
    before, after, now = (image.mean(axis=2) for image in (frames[23], settled[-1], frames[-1]))
    for shadow in (floor & (before < 0.3 * after), floor & (after < 0.3 * before)):
        assert shadow.sum() > 20
        gone = (now - before)[shadow].sum() / (after - before)[shadow].sum()
        assert gone > 0.9


@pytest.mark.parametrize("splats", [None, as_splats(BALL, 4_000).gaussians], ids=["mesh", "splats"])
def test_shadow_of_a_moving_ball_stays_with_it(splats: ls.Gaussians | None) -> None:
    """Light is 4 % off at most while the ball moves by a quarter of its radius a frame; by statistics, 7 to 8 %."""
    scenes = [with_ball(-0.5 + 0.06 * max(k - 23, 0), splats) for k in range(36)]
    truth = hard(scenes[-1], HIGH)
    assert np.abs(direct_light(scenes, HIGH)[-1] - truth).mean() < 0.04 * truth.mean()


@pytest.mark.parametrize("at", [(0.0, 0.25, 1.4), (0.5, 2.6, 0.0)], ids=["beside the light", "behind the lamp"])
def test_penumbra_keeps_its_samples_while_a_ball_moves_where_its_light_does_not_pass(at: tuple[float, ...]) -> None:
    """The light of pixels away from the ball is that of a scene in which the ball stands, to the bit."""
    edge = quad((0, 0.5, -2), (0, 0, 4), (2, 0, 0), diffuse(0.5))
    soft = ls.LightSphere((0.0, 1.5, 0.0), 0.3, intensity=8.0)
    small = replace(ls.sphere(0.1), material=diffuse(0.5))
    images: list[Floats] = []
    for step in (0.0, 0.002):
        balls = [ls.MeshInstance(small, position=np.add(at, (0.0, 0.0, step * k))) for k in range(24)]
        scenes = [ls.Scene(meshes=[FLOOR, edge, ball], lights=[soft]) for ball in balls]
        images.append(direct_light(scenes, ABOVE)[-1])
    np.testing.assert_array_equal(images[1][8:20], images[0][8:20])


def test_a_moving_lamp_that_lights_nothing_changes_no_light_elsewhere() -> None:
    """Forgetting is local: a lamp moves below the floor while a soft light has a penumbra above."""
    edge = quad((0, 0.5, -2), (0, 0, 4), (2, 0, 0), diffuse(0.5))
    soft = ls.LightSphere((0.0, 1.5, 0.0), 0.3, intensity=8.0)
    lamps = [ls.LightPoint((0.0, -1.0, 0.01 * k), intensity=5.0) for k in range(48)]
    still = direct_light([ls.Scene(meshes=[FLOOR, edge], lights=[soft, lamps[0]])] * 48, ABOVE)
    moved = direct_light([ls.Scene(meshes=[FLOOR, edge], lights=[soft, lamp]) for lamp in lamps], ABOVE)
    mean = np.mean(still[24:], axis=0)
    noise, with_motion = (np.sqrt(np.mean(np.square(np.array(frames[24:]) - mean))) for frames in (still, moved))
    assert noise > 0.0
    assert with_motion < 1.2 * noise


LOW = ls.Camera.look_at((0, 1.0, 0.01), (0, 0, 0), (0, 0, -1), width=48, height=32, fov_y=0.6)


def light_after(scenes: list[ls.Scene]) -> float:
    """Returns the mean direct light of the second half of a sequence."""
    frames = direct_light(scenes, LOW)
    return float(np.mean(frames[len(frames) // 2 :]))


def soft_light(scene: ls.Scene) -> float:
    """Returns the mean direct light with soft shadows, 64 samples."""
    config = ls.RenderConfig(pipeline=ls.Pipeline.HYBRID, shadows=ls.Shadows.SOFT, samples=64, max_bounces=0)
    return float(ls.render(scene, LOW, config, device="cpu").color.mean())


def plate_with_hole() -> list[ls.Mesh]:
    """Returns a plate above the floor with a hole of 0.1 x 0.1 in its middle."""
    cells = [
        ((-2.5, -2.5), (2.45, 5.0)),
        ((0.05, -2.5), (2.45, 5.0)),
        ((-0.05, -2.5), (0.1, 2.45)),
        ((-0.05, 0.05), (0.1, 2.45)),
    ]
    return [quad((x, 1.2, z), (a, 0, 0), (0, 0, b), diffuse(0.5)) for (x, z), (a, b) in cells]


@pytest.mark.parametrize("step", [0.0, 0.001])
def test_mean_light_of_a_lamp_that_is_nearly_hidden_is_right(step: float) -> None:
    """Seen through a hole, a twentieth of the lamp lights the floor; its samples are rare, and none may be lost."""
    plate = plate_with_hole()
    lamps = [ls.LightSphere((step * (k % 2), 1.5, 0.0), 0.295, intensity=8.0) for k in range(48)]
    scenes = [ls.Scene(meshes=[FLOOR, *plate], lights=[lamp]) for lamp in lamps]
    truth = soft_light(scenes[0])
    assert 0.03 < truth / soft_light(ls.Scene(meshes=[FLOOR], lights=[lamps[0]])) < 0.08
    assert light_after(scenes) == pytest.approx(truth, rel=0.03)


def test_mean_light_of_lamps_that_are_nearly_hidden_is_right_while_something_moves_before_them() -> None:
    """Two small triangles and the box around them move under the hole: chance must not make six dim lamps brighter."""
    corners = [(-1.0, 1.1, -1.0), (-1.0, 1.1, -0.999), (-0.999, 1.1, -1.0)]
    points = np.array([*corners, *(-np.array(corners) * (1, -1, 1))])
    moving = ls.Mesh(points, [(0, 1, 2), (3, 4, 5)], material=diffuse(0.5))
    lamps = [ls.LightSphere((0.01 * k, 1.5, 0.0), 0.29, intensity=2.0) for k in range(6)]
    places = [ls.MeshInstance(moving, position=(0.0, 0.0, 0.001 * (k % 2))) for k in range(48)]
    scenes = [ls.Scene(meshes=[FLOOR, *plate_with_hole(), place], lights=lamps) for place in places]
    assert light_after(scenes) == pytest.approx(soft_light(scenes[0]), rel=0.03)


def test_lamps_below_a_surface_take_no_samples_from_the_others() -> None:
    """The noise of a penumbra stays the same when eight lamps are placed under the floor."""
    edge = quad((0, 0.5, -2), (0, 0, 4), (2, 0, 0), diffuse(0.5))
    soft = ls.LightSphere((0.0, 1.5, 0.0), 0.3, intensity=8.0)
    below = [ls.LightPoint((0.1 * k, -1.0, 0.0), intensity=5.0) for k in range(8)]
    alone, beside = (
        np.array(direct_light([ls.Scene(meshes=[FLOOR, edge], lights=[soft, *others])] * 32, ABOVE)[16:])
        for others in ([], below)
    )
    assert alone.std(axis=0).mean() > 0.0
    assert beside.std(axis=0).mean() < 1.1 * alone.std(axis=0).mean()


def test_soft_lamp_without_shadows_lights_a_wall_that_it_cuts_by_the_part_in_front() -> None:
    """The visibility of its centre differs from 1 although nothing blocks it."""
    lamp = ls.LightPoint((0.0, 0.1, 0.0), intensity=2.0, radius=0.2, casts_shadow=False)
    scene = ls.Scene(meshes=[FLOOR], lights=[lamp])
    assert light_after([scene] * 32) == pytest.approx(soft_light(scene), rel=0.02)


def test_lit_sliver_beside_a_nearer_edge_keeps_its_light() -> None:
    """Light falls between table and wall on a strip a pixel high; jitter hides it in some frames."""
    wall = quad((-2, -1, 0), (4, 0, 0), (0, 4, 0), diffuse(0.8))
    table = quad((-2, 1, 0.05), (4, 0, 0), (0, 0, 1.45), diffuse(0.0))
    scene = ls.Scene(meshes=[wall, table], lights=[ls.LightPoint((0.0, 2.0, 1.0), intensity=4.0)])
    camera = ls.Camera.look_at((0, 0.6, 3), (0, 0.8, 0), (0, 1, 0), width=32, height=20, fov_y=0.35)
    config = ls.RenderConfig(pipeline=ls.Pipeline.REALTIME, max_bounces=0, aovs=("direct_diffuse",))
    renderer = ls.create_renderer(config, "cpu")
    frames: list[Any] = [renderer.render(scene, camera) for _ in range(64)]
    many = ls.RenderConfig(pipeline=ls.Pipeline.HYBRID, shadows=ls.Shadows.HARD, samples=64, max_bounces=0)
    truth = ls.render(scene, camera, many, device="cpu").color
    assert 0.0 < (truth.mean(axis=(1, 2)) > 0.0).sum() <= 4
    assert np.mean([frame.direct_diffuse for frame in frames[32:]]) == pytest.approx(truth.mean(), rel=0.1)


def test_coloured_shadows_of_glass_keep_their_colour_in_remembered_visibility() -> None:
    """Light through red glass is red after 24 frames, as in a frame with one sample of each light."""
    glass = ls.MaterialPbr(base_color=(0.9, 0.2, 0.2), roughness=0.0, transmission=1.0, ior=1.0)
    pane = quad((-2, 0.5, -2), (0, 0, 4), (2.1, 0, 0), glass)
    lit = ls.Scene(meshes=[FLOOR, pane], lights=[ls.LightPoint((0.0, 2.0, 0.0), intensity=3.0)])
    low = ls.Camera.look_at((0, 0.45, 0.01), (-0.3, 0, 0), (0, 0, -1), width=24, height=16, fov_y=0.2)
    found = direct_light([lit] * 24, low)[-1].mean(axis=(0, 1))
    truth = hard(lit, low).mean(axis=(0, 1))
    assert truth[0] > 2.0 * truth[1] > 0.0
    np.testing.assert_allclose(found, truth, rtol=0.01)


def test_lights_are_recognised_when_others_appear_move_or_swap_places() -> None:
    """Equal lights correspond, then those of one colour and intensity, then those of one type; others are new."""
    lamp, other = ls.LightPoint((0, 1, 0), intensity=2.0), ls.LightPoint((0, 2, 0), (1.0, 0.5, 0.2))
    sun = ls.LightDirectional((0, -1, 0))
    assert lights_before([lamp, other, sun], [lamp, other, sun]) == [0, 1, 2]
    assert lights_before([other, sun, lamp], [lamp, other, sun]) == [1, 2, 0]
    moved = replace(lamp, position=(0.0, 3.0, 0.0))
    assert lights_before([other, moved, sun], [lamp, other, sun]) == [1, 0, 2]
    dimmed = replace(moved, intensity=1.0)
    assert lights_before([other, dimmed], [lamp, other]) == [1, 0]
    assert lights_before([sun, lamp], [lamp]) == [-1, 0]
    assert has_same_place([replace(lamp, intensity=1.0, color=(1.0, 0.0, 0.0))], [lamp], 0, 0)  # equally visible
    now, before = [other, moved, sun], [lamp, other]
    assert [has_same_place(now, before, *pair) for pair in enumerate((1, 0, -1))] == [True, False, False]
    assert not has_same_place([], before, 0, 0)  # a headlight replaces missing lights


def test_packed_visibility_is_within_half_a_step_and_rounding_of_the_original() -> None:
    """Steps are a millionth; 0, 1 and 2 are exact. Three roundings to float32 add up to 1/16 step each."""
    values = np.random.default_rng(1).uniform(0.0, VISIBILITY_MOST, (500, 3)).astype(np.float32)
    values[:3] = [[0.0], [1.0], [VISIBILITY_MOST]]
    found = wp.zeros(len(values), dtype=wp.vec3, device="cpu")
    wp.launch(repack, len(values), inputs=[wp.array(values, dtype=wp.vec3, device="cpu"), found], device="cpu")
    step = 1.0 / 1048575.0
    assert (np.abs(found.numpy() - values) <= (0.5 + 3.0 / 16.0) * step).all()
    np.testing.assert_array_equal(found.numpy()[:3], values[:3])


def test_variance_of_shadow_rays_falls_with_the_number_of_samples() -> None:
    """Laplace's rule: 1/4 without samples, and p (1 - p) in the limit."""
    values, counts = np.array([0.7, 0.0, 0.5, 1.0]), np.array([0.0, 2.0, 1e6, 30.0])
    found = wp.zeros(4, dtype=float, device="cpu")
    given = (wp.array(x.astype(np.float32), dtype=float, device="cpu") for x in (values, counts))
    wp.launch(find_variances, 4, inputs=[*given, found], device="cpu")
    share = (values * counts + 1.0) / (counts + 2.0)
    np.testing.assert_allclose(found.numpy(), share * (1.0 - share), rtol=1e-5)
