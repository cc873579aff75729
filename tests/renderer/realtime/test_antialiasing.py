"""Temporal antialiasing against frames of many samples a pixel, for static, moving and fading scenes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
import warp as wp

import lumisplat as ls
from lumisplat.device.gi.surfaces import KnownLight, TemporalPixels
from lumisplat.renderer.realtime.antialiasing_kernels import blend
from support.scenes.gi_surfaces import camera_rows, sequence_row
from support.scenes.light_scenes import matte
from support.scenes.raster_scenes import checker_quad, front_camera, one_gaussian, quad, random_gaussians, similarity

Doubles = npt.NDArray[np.float64]

CAMERA = front_camera()
LIGHT = ls.LightPoint((0.0, 0.0, -50.0), intensity=1e-6)
"""Negligible light: the scenes consist of emissive meshes, which have no noise."""
PARTS = ("direct_diffuse", "indirect_diffuse", "direct_glossy", "indirect_glossy", "emission")


def emissive_square(*radiance: float, half: float = 1.0, tilt: float = 0.0) -> ls.Mesh:
    """Returns an emissive square."""
    material = ls.MaterialPbr(base_color=(0.0, 0.0, 0.0), emissive=radiance)  # pyright: ignore[reportArgumentType]
    return quad(4.0, half, tilt, material=material)


def renderer(antialiasing: bool = True, threads: int = 1, **settings: object) -> ls.Renderer:
    """Returns a renderer of a real-time sequence without bounces."""
    realtime = ls.RealtimeConfig(antialiasing=antialiasing)
    config = ls.RenderConfig(pipeline=ls.Pipeline.REALTIME, max_bounces=0, realtime=realtime, **settings)  # pyright: ignore[reportArgumentType]
    return ls.create_renderer(config, "cpu", threads=threads)


def scene_of(*meshes: ls.Mesh | ls.MeshInstance, **settings: object) -> ls.Scene:
    """Returns emissive meshes before a black background."""
    return ls.Scene((), meshes, [LIGHT], **settings)  # pyright: ignore[reportArgumentType]


def truth(scene: ls.Scene, camera: ls.Camera = CAMERA) -> ls.Frame:
    """Renders the reference with 64 samples a pixel."""
    config = ls.RenderConfig(pipeline=ls.Pipeline.HYBRID, samples=64, max_bounces=0, lighting=True)
    return ls.create_renderer(config, "cpu", threads=1).render(scene, camera)


def error(frame: ls.Frame, of: ls.Frame) -> float:
    """Returns the root mean square error of the colour."""
    return float(np.sqrt(np.mean((frame.color - of.color) ** 2)))


def test_temporal_antialiasing_of_static_edges_converges_to_the_reference() -> None:
    """The first frame has one sample at each pixel centre; later frames add samples at other positions."""
    scene = scene_of(
        replace(
            emissive_square(0.8, 0.5, 0.2, tilt=0.5),
            positions=np.array(emissive_square(1.0, 1.0, 1.0).positions) * 0.9 + 0.07,
        )
    )
    sharp, smooth = renderer(antialiasing=False).render(scene, CAMERA), renderer(aovs=PARTS)
    frames = [smooth.render(scene, CAMERA) for _ in range(48)]
    np.testing.assert_array_equal(frames[0].color, sharp.color)
    good = truth(scene)
    assert error(sharp, good) > 0.02
    assert error(frames[16], good) < 0.4 * error(sharp, good)
    assert error(frames[47], good) < 0.15 * error(sharp, good)
    np.testing.assert_allclose(frames[47].alpha, good.alpha, atol=0.08)
    flicker = np.std([frame.color.mean(axis=2) for frame in frames[32:]], axis=0)
    assert flicker.max() < 0.02
    total = sum(np.asarray(getattr(frames[47], part), np.float64) for part in PARTS)
    np.testing.assert_allclose(total, frames[47].color, atol=1e-5, rtol=1e-5)


def test_temporal_antialiasing_of_captures_and_environment_converges_to_many_samples() -> None:
    """The scene has unlit captures, an environment and a mesh."""
    rng = np.random.default_rng(2)
    environment = ls.LightEnvironment(rng.uniform(0.0, 1.0, (16, 32, 3)).astype(np.float32))
    scene = ls.Scene([random_gaussians(4, count=60)], [emissive_square(0.7, 0.1, 0.1, half=0.5)], [environment])
    good, sharp, smooth = truth(scene), renderer(antialiasing=False), renderer()
    assert error(sharp.render(scene, CAMERA), good) > 0.005
    frames = [smooth.render(scene, CAMERA) for _ in range(40)]
    assert error(frames[-1], good) < 0.25 * error(frames[0], good)


def test_sub_pixel_wires_do_not_flicker_with_temporal_antialiasing() -> None:
    """A wire a quarter of a pixel wide is hit in one frame of four, but has its mean brightness in every frame."""
    wire = replace(
        emissive_square(1.0, 1.0, 1.0),
        positions=np.array(emissive_square(1.0, 1.0, 1.0).positions) * (0.0083, 1.0, 1.0) + (0.03, 0.0, 0.0),
    )
    scene, smooth = scene_of(wire), renderer()
    frames = np.array([smooth.render(scene, CAMERA).color[..., 0] for _ in range(80)])[48:, 14:34]
    good = truth(scene).color[14:34, :, 0]
    assert good.max() == pytest.approx(0.25, abs=0.08)
    np.testing.assert_allclose(frames.mean(axis=0), good, atol=0.04)
    assert frames.std(axis=0).max() < 0.05


def test_moved_objects_leave_no_trail_with_temporal_antialiasing() -> None:
    """Pixels that an object has left show the background at once, pixels of its former edges one frame later."""
    mesh = emissive_square(1.0, 1.0, 1.0, half=0.5)
    away = similarity(offset=(1.2, 0.0, 0.0))
    smooth, first = renderer(), scene_of(ls.MeshInstance(mesh))
    for _ in range(20):
        smooth.render(first, CAMERA)
    gone = [smooth.render(scene_of(ls.MeshInstance(mesh, away)), CAMERA) for _ in range(3)]
    empty = truth(scene_of(ls.MeshInstance(mesh, away))).alpha == 0.0
    for frame, most in zip(gone, (0.005, 0.001, 0.001), strict=True):
        assert frame.color[empty].max() <= most


@pytest.mark.parametrize("goes", [True, False])
def test_temporal_antialiasing_leaves_no_outline_where_objects_start_to_move_or_vanish(goes: bool) -> None:
    """Edge pixels average object and background; once the object moves or vanishes, only the background remains."""
    mesh, wall = emissive_square(0.3, 0.3, 0.3, half=0.5, tilt=0.4), emissive_square(0.8, 0.8, 0.8, half=6.0)
    behind = ls.MeshInstance(wall, similarity(offset=(0.0, 0.0, 2.0)))
    turned = [similarity((0.0, 0.0, 1.0), 0.3, offset=(x, 0.0, 0.0)) for x in (0.0, 0.4)]
    first, then = ([ls.MeshInstance(mesh, at)] for at in turned)
    smooth = renderer()
    for _ in range(40):
        smooth.render(scene_of(*first, behind), CAMERA)
    then = [] if goes else then
    frame = smooth.render(scene_of(*then, behind), CAMERA)
    away = truth(scene_of(*then)).alpha == 0.0 if then else np.ones(frame.color.shape[:2], bool)
    near = np.pad(~away, 2)
    near = np.any([np.roll(near, (y, x), (0, 1)) for y in range(-2, 3) for x in range(-2, 3)], axis=0)[2:-2, 2:-2]
    np.testing.assert_allclose(frame.color[~near], 0.8, atol=0.01)


@pytest.mark.parametrize("step", [0.03, 0.2])
def test_temporal_antialiasing_smooths_edges_of_moving_objects(step: float) -> None:
    """At half a pixel or three pixels a frame, the error is below that of single samples and zero away from edges."""
    mesh, smooth, sharp = emissive_square(0.9, 0.6, 0.3, half=0.5, tilt=0.4), renderer(), renderer(antialiasing=False)
    turned = [similarity((0.0, 0.0, 1.0), 0.3, offset=(1.2 - step * left, -1.0, 0.4)) for left in range(11, -1, -1)]
    scenes = [scene_of(ls.MeshInstance(mesh, at)) for at in turned]
    frames = [[each.render(scene, CAMERA) for scene in scenes][-1] for each in (smooth, sharp)]
    good = truth(scenes[-1])
    assert error(frames[0], good) < 0.7 * error(frames[1], good)
    shown = np.pad(good.alpha, 2) > 0.0
    near = np.any([np.roll(shown, (y, x), (0, 1)) for y in range(-2, 3) for x in range(-2, 3)], axis=0)[2:-2, 2:-2]
    assert np.abs(frames[0].color[~near]).max() < 1e-3


@pytest.mark.parametrize(("fine", "most"), [(1.0, 0.7), (2.5, 1.1)])
def test_temporal_antialiasing_keeps_textures_sharp_while_the_camera_moves(fine: float, most: float) -> None:
    """Texels of 3 to 8 pixels have a lower error than single samples, texels of 1 to 3 pixels about the same."""
    texture = checker_quad(4.0)
    texture = replace(texture, uvs=fine * np.asarray(texture.uvs))
    scene = ls.Scene((), [texture], [ls.LightDirectional((0.2, 0.3, 1.0))])
    steps = [
        replace(CAMERA, camera_from_world=similarity((0.1, 1.0, 0.0), 0.004 * n, offset=(0.013 * n, 0.0, 0.0)))
        for n in range(16)
    ]
    shown = [
        [each.render(scene, camera) for camera in steps][-1] for each in (renderer(), renderer(antialiasing=False))
    ]
    good = truth(scene, steps[-1])
    assert error(shown[0], good) < most * error(shown[1], good)


def test_temporal_antialiasing_follows_a_fading_light() -> None:
    """The light fades by a tenth a frame; the image lags behind by less than a tenth."""
    smooth = renderer()
    for number in range(30):
        left = 0.9 ** max(number - 10, 0)
        frame = smooth.render(scene_of(emissive_square(left, left, left)), CAMERA)
        assert frame.color[24, 32, 0] == pytest.approx(left, rel=0.1)


def test_temporal_antialiasing_shows_a_light_change_of_2_percent_in_the_next_frame() -> None:
    """The change is as small as noise could be, and visible in the next frame."""
    before, after = scene_of(emissive_square(0.8, 0.8, 0.8)), scene_of(emissive_square(0.784, 0.784, 0.784))
    smooth = renderer()
    for _ in range(16):
        smooth.render(before, CAMERA)
    assert smooth.render(after, CAMERA).color[CAMERA.height // 2, CAMERA.width // 2] == pytest.approx(0.784, abs=1e-4)


def test_temporal_antialiasing_does_not_depend_on_thread_count() -> None:
    """The bits are equal with 1, 2 and 5 threads, also after a reset."""
    mesh = emissive_square(0.9, 0.6, 0.3, half=0.5, tilt=0.4)
    scenes = [
        ls.Scene(
            [one_gaussian((-0.3, 0.2, 3.0), 0.2, 0.8)],
            [ls.MeshInstance(mesh, similarity(offset=(x, 0.0, 0.0)))],
            [LIGHT],
        )
        for x in (0.0, 0.01, 0.03, 0.03)
    ]
    results = []
    for threads in (1, 2, 5):
        smooth = renderer(threads=threads)
        for _ in range(2):
            smooth.reset()
            results.append([smooth.render(scene, CAMERA).color for scene in scenes])
    for result in results[1:]:
        np.testing.assert_array_equal(result, results[0])


@pytest.mark.parametrize("relit", [True, False])
def test_small_relit_gaussian_objects_cover_as_much_as_rays_find(relit: bool) -> None:
    """Silhouettes are those of rays and not wider by the dilation, which still single samples of unlit sets need."""
    gaussians = ls.gaussians_from_mesh(ls.sphere(0.5), 20_000)
    ball = ls.SplatInstance(gaussians, position=(0.1, 0.05, 4.0), material=ls.MaterialPbr() if relit else None)
    scene, camera = ls.Scene([ball], (), [LIGHT]), front_camera().scaled(32, 24)
    drawer = renderer()
    *_, covered = (drawer.render(scene, camera).alpha.sum() for _ in range(48))
    traced = ls.RenderConfig(pipeline=ls.Pipeline.TRACE, samples=64)
    expected = ls.render(scene, camera, traced, device="cpu").alpha.sum()
    assert (abs(covered / expected - 1.0) < 0.02) == relit, covered / expected


def test_still_edges_keep_their_antialiasing_while_something_moves_out_of_sight() -> None:
    """An edge is as smooth as in a still scene, though an object behind the camera moves and a lamp with it."""
    mesh, hidden = emissive_square(0.9, 0.6, 0.3, half=0.5, tilt=0.4), emissive_square(0.1, 0.1, 0.1, half=0.1)
    edge = ls.MeshInstance(mesh, similarity((0.0, 0.0, 1.0), 0.3))
    good = truth(scene_of(edge))
    errors = []
    for step in (0.0, 0.01):
        smooth, frames = renderer(), []
        for number in range(32):
            behind = ls.MeshInstance(hidden, similarity(offset=(step * number, 0.0, -9.0)))
            lamp = ls.LightPoint((step * number, 0.0, -9.0), intensity=1e-6)
            frames.append(smooth.render(replace(scene_of(edge, behind), lights=[lamp]), CAMERA))
        errors.append(error(frames[-1], good))
    assert errors[1] < 1.05 * errors[0]


@pytest.mark.parametrize("step", [0.02, 0.05])
def test_lit_edges_are_as_smooth_and_as_bright_under_a_moving_lamp_as_under_a_still_one(step: float) -> None:
    """A lamp comes closer by 2 or 5 cm a frame, beside an environment whose noise hides the change from its samples."""
    edge = ls.MeshInstance(quad(4.0, 1.0, 0.3, material=matte(0.8)), similarity((0.0, 0.0, 1.0), 0.3))
    environment = ls.LightEnvironment(color=(0.3, 0.3, 0.3), visible=False)
    last = ls.Scene((), [edge], [ls.LightPoint((0.0, 0.0, -1.0), intensity=20.0), environment])
    errors = []
    for moved in (0.0, step):
        smooth, frames = renderer(), []
        for left in range(31, -1, -1):
            lamp = ls.LightPoint((0.0, 0.0, -1.0 - moved * left), intensity=20.0)
            frames.append(smooth.render(replace(last, lights=[lamp, environment]), CAMERA))
        errors.append(error(frames[-1], truth(last)))
    assert errors[1] < 1.1 * errors[0]


def test_textures_keep_their_antialiasing_while_something_moves_out_of_sight() -> None:
    """Each frame shows other points of a texture as fine as pixels, whose light must not count as changed."""
    texture = np.random.default_rng(3).integers(0, 256, (96, 96, 3), dtype=np.uint8)
    material = replace(matte(1.0), base_color_texture=texture)
    square = quad(4.0, 1.0, 0.3, material=material, uvs=[[0, 0], [1, 0], [1, 1], [0, 1]])
    lamp, hidden = ls.LightPoint((0.0, 0.0, -1.0), intensity=20.0), emissive_square(0.1, 0.1, 0.1, half=0.1)
    good, errors = truth(ls.Scene((), [square], [lamp])), []
    for step in (0.0, 0.01):
        smooth, frames = renderer(), []
        for number in range(32):
            behind = ls.MeshInstance(hidden, position=(step * number, 0.0, -9.0))
            frames.append(smooth.render(ls.Scene((), [square, behind], [lamp]), CAMERA))
        errors.append(error(frames[-1], good))
    assert errors[1] < 2.0 * errors[0]


@pytest.mark.parametrize(("history_weight", "expected"), [(1.0, 1.0 / 32.0), (0.7, 0.25)])
def test_indirect_light_is_averaged_over_four_frames_while_light_changes(
    history_weight: float, expected: float
) -> None:
    """A mean of 31 black frames takes a white one by 1/32 at rest, by 1/4 while something changes."""
    camera = ls.Camera.look_at((0, 0, 0), (0, 0, 1), (0, -1, 0), width=4, height=4, fov_y=0.5)
    pixels, none = TemporalPixels(), KnownLight()
    pixels.weight = wp.full(16, 1.0 / 32.0, dtype=wp.float32, device="cpu")
    pixels.changed = wp.full(16, -1, dtype=wp.int32, device="cpu")
    places = np.array([(x, y) for y in range(4) for x in range(4)], np.float32)
    pixels.previous_pixel = wp.array(places, dtype=wp.vec2, device="cpu")
    image, before, after = (wp.full(256, wp.vec3(v), dtype=wp.vec3, device="cpu") for v in (1.0, 0.0, 0.0))
    tables = sequence_row(1, history_weight, (camera, camera)), camera_rows(camera)
    wp.launch(blend, 256, [0, *tables, pixels, False, False, True, none, none, before, image, after], device="cpu")
    np.testing.assert_allclose(after.numpy()[:16], expected, rtol=1e-6)
