"""Screen probes: what they must get exactly right, and light with known answers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import lumisplat as ls
from support.oracles.form_factors import polygon_irradiance
from support.scenes.gi_surfaces import Doubles, Seen, box_exit, pixel_rays, seen_in_box, seen_plane, tilted
from support.scenes.probe_sequence import ProbeSequence, constant

GREY = np.array([0.3, 1.0, 2.5])


def box_camera(step: float = 0.0, width: int = 160, height: int = 96) -> ls.Camera:
    """Inside the cube; each step moves it and turns it."""
    eye = (0.1 + 0.03 * step, -0.4, 0.05)
    return ls.Camera.look_at(eye, (0.08 * step, 0.5, 0.0), (0.0, 0.0, 1.0), width=width, height=height, fov_y=1.2)


def bright_wall(origins: Doubles, ways: Doubles) -> tuple[Doubles, Doubles]:
    """The cube's wall at +x shines, the others are black."""
    t, face = box_exit(origins, ways)
    return np.repeat((face == 1)[:, None] * 1.0, 3, axis=1), t


@pytest.mark.parametrize("extent", [0.0, 0.01])
@pytest.mark.parametrize("noise", [0.0, 20.0])
def test_a_furnace_is_exact(extent: float, noise: float) -> None:
    """Where all is equally bright, so is each pixel: from the first frame on, at any tilt, with noisy normals too."""
    seen = seen_in_box(box_camera(), extent)
    seen.normal = tilted(seen.normal, noise, seed=1)
    sequence = ProbeSequence(constant(GREY))
    for _ in range(3):
        np.testing.assert_allclose(
            sequence.render(seen), np.broadcast_to(np.pi * GREY, (seen.share.size, 3)), rtol=4e-6
        )


def test_a_moving_camera_never_changes_a_furnace() -> None:
    """Reprojection, new probes and the filter neither gain nor lose light."""
    sequence = ProbeSequence(constant(GREY))
    for step in range(12):
        seen = seen_in_box(box_camera(step), 0.01 * (step % 2))
        light = sequence.render(seen)
        np.testing.assert_allclose(light, np.broadcast_to(np.pi * GREY, light.shape), rtol=4e-6)


@pytest.mark.parametrize("degrees", [0, 20, 45, 70, 90, 120])
@pytest.mark.parametrize("extent", [0.0, 0.02])
def test_a_tilted_surface_under_half_a_sky(degrees: float, extent: float) -> None:
    """E = pi L (1 + cos d) / 2; harmonics of degree 2, cells and what meshes do not see below them cost 3 % at most."""
    angle = np.radians(degrees)
    normal = np.array([np.sin(angle), 0.0, np.cos(angle)])
    eye = 3.0 * normal + (0.1, 0.8, 0.3)
    seen = seen_plane(
        ls.Camera.look_at(eye, (0, 0, 0), (0.0, 1.0, 0.1), width=96, height=96, fov_y=0.6), normal, extent
    )
    assert seen.share.all()

    def sky(origins: Doubles, ways: Doubles) -> tuple[Doubles, Doubles]:
        return np.repeat((ways[:, 2:] > 0.0).astype(np.float64), 3, axis=1), np.full(len(ways), np.inf)

    sequence = ProbeSequence(sky, refreshed=1.0)
    light = np.mean([sequence.render(seen) for _ in range(24)][8:], axis=0)
    truth = 0.5 * np.pi * (1.0 + np.cos(angle))
    assert np.abs(light.mean(axis=0) / truth - 1.0).max() < 0.03
    assert np.abs(light - truth).max() < 0.015 * np.pi


@pytest.mark.parametrize("extent", [0.0, 0.002])
def test_one_bright_wall_of_a_cube(extent: float) -> None:
    """Irradiance of the other walls against Lambert's polygon sum: the mean within 2 %, a wall's within 10 %."""
    seen = seen_in_box(box_camera(width=320, height=192), extent)
    sequence = ProbeSequence(bright_wall)
    light = np.mean([sequence.render(seen)[:, 0] for _ in range(48)][8:], axis=0)
    truth = wall_irradiance(seen)
    assert abs(light.mean() / truth.mean() - 1.0) < 0.02
    for face in {*seen.face} - {1}:
        wall = seen.face == face
        assert abs(light[wall].mean() / truth[wall].mean() - 1.0) < 0.1
        assert np.corrcoef(light[wall], truth[wall])[0, 1] > 0.94
    assert light[seen.face == 1].max() < 1e-3


def wall_irradiance(seen: Seen) -> Doubles:
    """What the bright wall sends to each pixel."""
    corners = np.array([[0.5, -0.5, -0.5], [0.5, 0.5, -0.5], [0.5, 0.5, 0.5], [0.5, -0.5, 0.5]])
    values = [
        0.0 if face == 1 else abs(polygon_irradiance(position, normal, corners))
        for position, normal, face in zip(seen.position, seen.normal, seen.face, strict=True)
    ]
    return np.array(values)


def test_noisy_normals_lose_no_light() -> None:
    """Gaussians whose normals scatter by 20 degrees get the light of smooth ones, to 1 %, once cosines are the same."""
    camera = ls.Camera.look_at((0.1, 0.8, 3.0), (0, 0, 0), (0.0, 1.0, 0.1), width=160, height=96, fov_y=0.6)
    smooth = seen_plane(camera, (0.0, 0.0, 1.0), 0.02)
    noisy = seen_plane(camera, (0.0, 0.0, 1.0), 0.02)
    noisy.normal = tilted(noisy.normal, 20.0, seed=2)

    def gradient(origins: Doubles, ways: Doubles) -> tuple[Doubles, Doubles]:
        return np.repeat(1.0 + ways[:, 2:], 3, axis=1), np.full(len(ways), np.inf)

    sequence = ProbeSequence(gradient, refreshed=1.0)
    light = np.mean([sequence.render(noisy)[:, 0] for _ in range(8)][2:], axis=0)
    truth = np.pi + 2.0 / 3.0 * np.pi * noisy.normal[:, 2]
    assert abs(light.mean() / truth.mean() - 1.0) < 0.01
    assert smooth.share.all()


def test_disocclusion_is_never_black() -> None:
    """When a panel that hid most of the picture jumps away, all of what was behind it has light at once."""
    sequence = ProbeSequence(constant(GREY))
    seen = seen_in_box(box_camera())
    for frame in range(6):
        hidden = behind_panel(seen) if frame < 5 else seen
        light = sequence.render(hidden)
        assert np.isfinite(light).all()
        np.testing.assert_allclose(light, np.broadcast_to(np.pi * GREY, light.shape), rtol=4e-6)


def behind_panel(seen: Seen) -> Seen:
    """The same with a panel before the left three quarters of the picture."""
    camera, columns = seen.camera, np.tile(np.arange(seen.camera.width), seen.camera.height)
    covered = columns < 0.75 * camera.width
    ways = (seen.position - camera.eye) / seen.distance[:, None]
    distance = np.where(covered, 0.1, seen.distance)
    position = np.where(covered[:, None], camera.eye + 0.1 * ways, seen.position)
    normal = np.where(covered[:, None], -ways, seen.normal)
    return Seen(camera, seen.share, position, normal, distance, seen.extent, position.copy(), seen.face)


def test_no_light_leaks_round_a_post() -> None:
    """Walls that are bright left of a post and dark right of it: each of their pixels is either, beside it too."""
    camera = box_camera()
    plane, columns = seen_in_box(camera), np.tile(np.arange(camera.width), camera.height)
    is_post = (columns >= 77) & (columns < 84)
    ways = (plane.position - camera.eye) / plane.distance[:, None]
    seen = replace(
        plane,
        position=np.where(is_post[:, None], camera.eye + 0.1 * ways, plane.position),
        normal=np.where(is_post[:, None], -ways, plane.normal),
        distance=np.where(is_post, 0.1, plane.distance),
    )
    seen.previous = seen.position.copy()
    middle = np.asarray(camera.world_from_camera)[:3, 0]

    def left_half(origins: Doubles, ways: Doubles) -> tuple[Doubles, Doubles]:
        is_left = (origins - camera.eye) @ middle < 0.0
        return np.where(is_left[:, None], GREY, 0.0), np.full(len(ways), 1.0)

    sequence = ProbeSequence(left_half, refreshed=1.0)
    light = [sequence.render(seen) for _ in range(8)][-1]
    expected = np.where((columns < 77)[:, None], np.pi * GREY, 0.0)
    off = np.abs(light - expected).max(axis=1)[~is_post] / (np.pi * GREY.max())
    assert off.max() < 0.05


def test_few_visible_surfaces_are_lit_too() -> None:
    """A lone pixel, one of little share, and one far from any probe with light: none is black, none is not a number."""
    seen = seen_in_box(box_camera())
    seen.share[:] = 0.0
    pixels = [5, 80 * 160 + 77, 95 * 160 + 159]
    seen.share[pixels] = 1.0, 0.01, 1.0
    sequence = ProbeSequence(constant(GREY), refreshed=0.02)
    light = sequence.render(seen)
    assert len(sequence.rays[0]) > 0
    np.testing.assert_allclose(light[pixels], np.broadcast_to(np.pi * GREY, (3, 3)), rtol=4e-6)
    assert np.abs(np.delete(light, pixels, axis=0)).max() == 0.0


def test_no_surface_no_light() -> None:
    """A frame that shows nothing has no probes, no rays and no light."""
    seen = seen_in_box(box_camera())
    seen.share[:] = 0.0
    sequence = ProbeSequence(constant(GREY))
    assert np.abs(sequence.render(seen)).max() == 0.0
    assert len(sequence.rays[0]) == 0


def test_threads_give_the_same_bits() -> None:
    """A moving sequence with light that varies, on one, two and five threads."""
    pictures = []
    for threads in (1, 2, 5):
        sequence = ProbeSequence(bright_wall, threads)
        pictures.append([sequence.render(seen_in_box(box_camera(step), 0.002)) for step in range(5)])
    np.testing.assert_array_equal(pictures[0], pictures[1])
    np.testing.assert_array_equal(pictures[0], pictures[2])


def test_reset_forgets() -> None:
    """After a reset, and with another size, frames are those of new probes."""
    used = ProbeSequence(constant(GREY))
    for step in range(3):
        used.render(seen_in_box(box_camera(step)))
    used.probes.reset()
    used.tracer, used.frame = bright_wall, 0
    fresh = ProbeSequence(bright_wall)
    seen = seen_in_box(box_camera())
    np.testing.assert_array_equal(used.render(seen), fresh.render(seen))
    other = seen_in_box(box_camera(width=100, height=50))
    fresh, used.frame = ProbeSequence(bright_wall), 0
    np.testing.assert_array_equal(used.render(other), fresh.render(other))


def test_dark_sides_are_not_negative() -> None:
    """One small bright light: irradiance of the side away from it does not ring below zero."""
    camera = ls.Camera.look_at((0.1, 0.8, 3.0), (0, 0, 0), (0.0, 1.0, 0.1), width=160, height=96, fov_y=0.6)
    seen = seen_plane(camera, (0.0, 0.0, 1.0), 0.02)
    towards = np.array([0.86, 0.0, -0.5])

    def lamp(origins: Doubles, ways: Doubles) -> tuple[Doubles, Doubles]:
        return np.repeat(100.0 * (ways @ towards > 0.9).astype(np.float64)[:, None], 3, axis=1), np.full(
            len(ways), np.inf
        )

    sequence = ProbeSequence(lamp, refreshed=1.0)
    light = [sequence.render(seen) for _ in range(4)][-1]
    assert light.min() == 0.0
    assert np.isfinite(light).all()


def seen_floor(camera: ls.Camera, end: float, offset: tuple[float, float]) -> Seen:
    """The floor y = 0 up to a wall at z = -end."""
    seen = seen_plane(camera, (0, 1, 0), offset=offset)
    eye, ways = pixel_rays(camera, offset)
    wall = (ways[:, 2] < 0.0) & ((seen.share == 0.0) | (seen.position[:, 2] < -end))
    t = (-end - eye[2]) / np.where(wall, ways[:, 2], -1.0)
    seen.position[wall] = (eye + t[:, None] * ways)[wall]
    seen.normal[wall] = 0.0, 0.0, 1.0
    seen.distance[wall], seen.share[wall] = t[wall], 1.0
    seen.previous = seen.position.copy()
    return seen


@pytest.mark.parametrize("slope", [1.0, -1.0])
def test_a_floor_that_is_seen_at_a_slant_keeps_its_light(slope: float) -> None:
    """Light that grows or falls with the distance is right far away, too, however long it stands; to 2 %.

    A tile is metres of the floor there, of which a probe at its near end says little.
    """
    camera = ls.Camera.look_at((0, 0.3, 0), (0, 0.28, -6), (0.03, 1, 0), width=192, height=144, fov_y=0.9)

    def glow(places: Doubles) -> Doubles:
        return 1.05 + slope * np.clip(-places[:, 2] / 6.0, 0.0, 1.0) ** 2

    def trace(origins: Doubles, ways: Doubles) -> tuple[Doubles, Doubles]:
        return np.repeat(glow(origins)[:, None], 3, axis=1), np.full(len(ways), 9.0)

    sequence = ProbeSequence(trace, tile=8)
    found, truth = np.zeros(0), np.zeros(0)
    rng = np.random.default_rng(3)
    for frame in range(64):
        across, down = rng.random(2)
        seen = seen_floor(camera, 6.0, (across, down))
        irradiance = sequence.render(seen)[:, 0]
        far = (seen.normal[:, 1] == 1.0) & (seen.position[:, 2] < -3.0)
        if frame >= 32:
            found = np.append(found, irradiance[far])
            truth = np.append(truth, np.pi * glow(seen.position[far]))
    assert found.mean() == pytest.approx(truth.mean(), rel=0.02)
