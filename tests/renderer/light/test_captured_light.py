"""Meshes in captures without lights: lit by the captures around them, or by a headlight."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.math.color import decode_srgb
from lumisplat.math.sh import even_directions
from lumisplat.renderer import captured_light
from support.scenes.pipelines import DIRECT
from support.scenes.raster_scenes import flat_sh, front_camera, octahedron, one_gaussian

POSITION = np.array([0.2, -0.1, 4.0])
MATT = ls.MaterialSimple(emissive=(0, 0, 0), diffuse=(1, 1, 1), base_color=(0.5, 0.5, 0.5))


@pytest.fixture(autouse=True)
def _unsaid() -> Iterator[None]:
    captured_light._warn_once.cache_clear()
    yield
    captured_light._warn_once.cache_clear()


def shell(colors: np.ndarray, share: float = 1.0, radius: float = 8.0) -> ls.Gaussians:
    """Returns a sphere of dense Gaussians around the mesh, like a room; below a ``share`` of 1 only its bottom.

    Args:
        colors: Display-referred colour of all Gaussians, or one for each of 3,000.
        share: Fraction of the sphere by solid angle, from +y on.
        radius: Scene units.
    """
    along = even_directions(3000)
    covered = along[:, 1] >= 1.0 - 2.0 * share
    count = int(covered.sum())
    return ls.Gaussians(
        POSITION + radius * along[covered],
        np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
        np.full((count, 3), 0.05 * radius),
        np.ones(count),
        flat_sh(np.broadcast_to(colors, (3000, 3))[covered]),
    )


def ball(radius: float = 0.8, **attributes: Any) -> ls.Mesh:
    """Returns a smooth ball at the test position."""
    import trimesh

    sphere = trimesh.creation.icosphere(subdivisions=4, radius=radius)
    positions = sphere.vertices + POSITION
    return ls.Mesh(positions, sphere.faces, normals=sphere.vertex_normals, material=MATT, **attributes)


def light_on(scene: ls.Scene, **settings: Any) -> np.ndarray:
    """Returns linear colours of the pixels inside the ball."""
    frame = ls.render(scene, front_camera(64, 48), ls.RenderConfig(**settings), device="cpu")
    assert frame.color_space == "linear"
    return frame.color[frame.instance_index == 1]


@pytest.mark.parametrize("pipeline", DIRECT)
def test_diffuse_mesh_inside_a_uniform_capture_shows_its_albedo(pipeline: ls.Pipeline) -> None:
    """In a white furnace, brightness is albedo times the capture's constant radiance on every side, in one sample."""
    color = np.array([0.9, 0.6, 0.3])
    seen = light_on(ls.Scene([shell(color)], [ball()]), pipeline=pipeline)
    np.testing.assert_allclose(seen.mean(axis=0), 0.5 * decode_srgb(color), rtol=0.01)
    assert seen.std(axis=0).max() < 0.02


@pytest.mark.parametrize("axis", [0, 1])
def test_irradiance_on_a_mesh_inside_a_half_bright_capture_is_one_plus_cosine_over_two(axis: int) -> None:
    """Irradiance is (1 + cosine) / 2 by the angle between the normal and the centre of the bright half."""
    along = even_directions(3000)
    colors = np.where(along[:, axis, None] > 0.0, [1.0, 1.0, 1.0], [0.0, 0.0, 0.0])
    camera = front_camera(96, 72)
    frame = ls.render(ls.Scene([shell(colors)], [ball()]), camera, device="cpu")
    inside = frame.instance_index == 1
    expected = 0.5 * 0.5 * (1.0 + frame.normal[inside][:, axis])
    error = frame.color[inside].mean(axis=1) - expected
    assert abs(error.mean()) < 0.01 and np.sqrt(np.mean(error**2)) < 0.03


def test_light_that_a_capture_casts_on_a_mesh_is_updated_after_the_mesh_moves(monkeypatch: pytest.MonkeyPatch) -> None:
    """A new object at the same position does not render the light again; frames equal those of a new renderer."""
    found, made = captured_light.captured_light, list[object]()
    boxes = list[np.ndarray]()

    def counted(scene: ls.Scene, box: np.ndarray, render: object) -> captured_light.CapturedLight | None:
        boxes.append(box)
        made.append(render)
        return found(scene, box, render)  # pyright: ignore[reportArgumentType]

    monkeypatch.setattr(captured_light, "captured_light", counted)
    along = even_directions(3000)
    room = shell(np.where(along[:, :1] > 0.0, [1.0, 1.0, 1.0], [0.1, 0.1, 0.1]))
    renderer, camera = ls.create_renderer(device="cpu"), front_camera(64, 48)
    for step in (0.0, 0.0, 0.5, 1.0, 1.5):
        scene = ls.Scene([ls.SplatInstance(room)], [ls.MeshInstance(ball(), position=(step, 0.0, 0.0))])
        frame = renderer.render(scene, camera)
    assert len(boxes) == 4 and len(set(map(id, made[1:]))) == 1
    np.testing.assert_array_equal(frame.color, ls.render(scene, camera, device="cpu").color)


def test_light_that_a_capture_casts_on_a_mesh_equals_that_by_path_tracing() -> None:
    """The mean brightness of the mesh agrees within 5 %."""
    along = even_directions(3000)
    colors = 0.5 + 0.4 * along[:, [1, 0, 2]]
    scene = ls.Scene([shell(colors, radius=50.0)], [ball()])
    seen, truth = light_on(scene), light_on(scene, pipeline=ls.Pipeline.PATH, samples=32, jitter=False)
    np.testing.assert_allclose(seen.mean(axis=0), truth.mean(axis=0), rtol=0.05)


def test_lighting_a_mesh_by_a_capture_does_not_change_captured_pixels() -> None:
    """Pixels of the capture have equal bytes with and without the mesh's lighting."""
    scene = ls.Scene([shell(np.array([0.7, 0.5, 0.2]))], [ball()])
    camera = front_camera(64, 48)
    lit, flat = (
        ls.render(scene, camera, ls.RenderConfig(lighting=lighting), device="cpu") for lighting in (None, False)
    )
    outside = lit.instance_index == 0
    assert outside.any()
    np.testing.assert_array_equal(lit.pixels_srgb()[outside], flat.pixels_srgb()[outside])


@pytest.mark.parametrize("share", [0.0, 0.5])
def test_mesh_that_no_capture_surrounds_is_lit_by_a_headlight(share: float) -> None:
    """Beside a captured figure, or on a captured floor without a sky, the frame equals that of lighting=True."""
    capture = shell(np.array([0.5, 0.5, 0.5]), share) if share else one_gaussian((1.5, 0.0, 4.0))
    scene = ls.Scene([capture], [octahedron((0.0, 0.0, 4.0), 1.0)])
    frame, headlit = (
        ls.render(scene, front_camera(40, 30), ls.RenderConfig(lighting=lighting), device="cpu")
        for lighting in (None, True)
    )
    np.testing.assert_array_equal(frame.color, headlit.color)


def test_captures_do_not_light_meshes_if_the_scene_has_lights_or_lighting_is_set() -> None:
    """A light, a disabled light, or lighting set to True or False switches the light of captures off."""
    capture, light = shell(np.array([0.2, 0.2, 0.8])), ls.LightPoint(POSITION - (0, 0, 3), intensity=5.0)
    scene = ls.Scene([capture], [ball()])
    for lights, lighting in (((light,), None), ((replace(light, enabled=False),), None), ((), True)):
        seen = light_on(replace(scene, lights=lights), lighting=lighting)
        np.testing.assert_allclose(seen[:, 2], seen[:, 0], atol=1e-6)  # nothing blue
    flat = ls.render(scene, front_camera(64, 48), ls.RenderConfig(lighting=False), device="cpu")
    assert np.ptp(flat.color[flat.instance_index == 1], axis=0).max() < 1e-6


def test_light_that_captures_cast_on_meshes_does_not_depend_on_earlier_frames() -> None:
    """A renderer that has rendered other positions gives the bits of a new renderer with any number of threads."""
    along = even_directions(3000)
    scene = ls.Scene([shell(np.where(along[:, :1] > 0.0, 0.9, 0.1) * np.ones(3))], [ball()])
    moved = replace(scene, meshes=[ls.MeshInstance(ball(), position=(1.5, 0.0, 0.0))])
    camera = front_camera(48, 36)
    renderer = ls.create_renderer(device="cpu", threads=1)
    first, other, again = (renderer.render(one, camera) for one in (scene, moved, scene))
    np.testing.assert_array_equal(first.color, again.color)
    np.testing.assert_array_equal(other.color, ls.create_renderer(device="cpu", threads=3).render(moved, camera).color)
    middle = first.instance_index == 1
    assert abs(float(first.color[middle].mean()) - float(other.color[other.instance_index == 1].mean())) > 0.01


@pytest.mark.parametrize("pipeline", [*DIRECT, ls.Pipeline.PATH, ls.Pipeline.REALTIME])
def test_capture_gain_of_one_stop_doubles_the_light_that_captures_cast_on_meshes(pipeline: ls.Pipeline) -> None:
    """The light doubles in every pipeline; the estimated gain exposes a grey ball like the grey room around it."""
    color = np.array([0.5, 0.5, 0.5])
    scene = ls.Scene([shell(color, radius=30.0)], [ball()])
    gain = ls.avatars.estimate_capture_gain(scene, device="cpu")

    def shown(**settings: Any) -> ls.Frame:
        is_realtime = pipeline is ls.Pipeline.REALTIME
        samples = {} if is_realtime else {"samples": 4}
        renderer = ls.create_renderer(ls.RenderConfig(pipeline=pipeline, **samples, **settings), "cpu")
        return [renderer.render(scene, front_camera(64, 48)) for _ in range(16 if is_realtime else 1)][-1]

    plain, bright, mapped = shown(), shown(capture_gain=gain), shown(tone_map=ls.ToneMap.AGX)
    on_ball = plain.instance_index == 1
    one, gained = (frame.color[on_ball].mean() for frame in (plain, bright))
    # In real time, 16 frames of probes of a ray or two are within 5 %.
    assert gained == pytest.approx(2.0**gain * one, rel=0.05 if pipeline is ls.Pipeline.REALTIME else 0.02)
    assert gained == pytest.approx(float(decode_srgb(color).mean()), rel=0.06)
    assert (mapped.pixels_srgb()[on_ball] != plain.pixels_srgb()[on_ball]).mean() > 0.9
    beside = ~np.any([np.roll(on_ball, (x, y), (0, 1)) for x in (-1, 0, 1) for y in (-1, 0, 1)], axis=0)
    np.testing.assert_array_equal(mapped.pixels_srgb()[beside], plain.pixels_srgb()[beside])


def test_light_that_a_capture_casts_on_a_mesh_does_not_depend_on_the_sample_count() -> None:
    """Directions are spread over samples; with one layer per light, each sample has a single direction."""
    scene = ls.Scene([shell(np.array([0.9, 0.6, 0.3]))], [ball()])
    one = light_on(scene).mean(axis=0)
    np.testing.assert_allclose(light_on(scene, samples=8, jitter=False).mean(axis=0), one, rtol=0.01)
    np.testing.assert_allclose(light_on(scene, aovs=("lights",), jitter=False).mean(axis=0), one, rtol=0.02)


def test_log_says_once_that_captures_light_the_meshes_of_a_scene(caplog: pytest.LogCaptureFixture) -> None:
    """Two renderers and three frames log one line, which names the setting."""
    scene = ls.Scene([shell(np.array([0.5, 0.5, 0.5]))], [ball()])
    with caplog.at_level(logging.WARNING, logger="lumisplat"):
        for _ in range(2):
            ls.render(scene, front_camera(8, 6), device="cpu")
        ls.render(ls.Scene(scene.splats), front_camera(8, 6), device="cpu")
    lines = [record.getMessage() for record in caplog.records]
    assert len(lines) == 1 and "by the capture around them" in lines[0] and "RenderConfig.lighting=False" in lines[0]
