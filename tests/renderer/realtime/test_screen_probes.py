"""Screen probes: exact results in a white furnace, and irradiance with closed forms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import lumisplat as ls
from support.oracles.form_factors import polygon_irradiance
from support.scenes.gi_surfaces import (
    Doubles,
    VisibleSurfaces,
    box_exit,
    pixel_rays,
    tilted,
    visible_box,
    visible_plane,
)
from support.scenes.probe_sequence import ProbeSequence, constant

GREY = np.array([0.3, 1.0, 2.5])


def box_camera(step: float = 0.0, width: int = 160, height: int = 96) -> ls.Camera:
    """Returns a camera inside the cube; each step moves and rotates it."""
    eye = (0.1 + 0.03 * step, -0.4, 0.05)
    return ls.Camera.look_at(eye, (0.08 * step, 0.5, 0.0), (0.0, 0.0, 1.0), width=width, height=height, fov_y=1.2)


def bright_wall(origins: Doubles, directions: Doubles) -> tuple[Doubles, Doubles]:
    """Returns radiance 1 for rays that hit the cube's wall at +x, 0 for others, and the hit distances."""
    t, face = box_exit(origins, directions)
    return np.repeat((face == 1)[:, None] * 1.0, 3, axis=1), t


@pytest.mark.parametrize("extent", [0.0, 0.01])
@pytest.mark.parametrize("noise", [0.0, 20.0])
def test_screen_probes_give_exact_irradiance_in_a_white_furnace(extent: float, noise: float) -> None:
    """In constant radiance, each pixel is exact from the first frame on, at any tilt and with noisy normals."""
    surfaces = visible_box(box_camera(), extent)
    surfaces.normal = tilted(surfaces.normal, noise, seed=1)
    sequence = ProbeSequence(constant(GREY))
    for _ in range(3):
        np.testing.assert_allclose(
            sequence.render(surfaces), np.broadcast_to(np.pi * GREY, (surfaces.share.size, 3)), rtol=4e-6
        )


def test_screen_probes_give_exact_irradiance_in_a_white_furnace_with_a_moving_camera() -> None:
    """Reprojection, new probes and the filter neither gain nor lose light."""
    sequence = ProbeSequence(constant(GREY))
    for step in range(12):
        surfaces = visible_box(box_camera(step), 0.01 * (step % 2))
        light = sequence.render(surfaces)
        np.testing.assert_allclose(light, np.broadcast_to(np.pi * GREY, light.shape), rtol=4e-6)


def test_a_small_ball_of_gaussians_with_a_black_inside_gets_exact_light_of_screen_probes() -> None:
    """In constant radiance, pixels beside a probe look below its horizon, where its rays would enter the ball."""
    camera = ls.Camera.look_at((0.1, 0.2, 4.0), (0, 0, 0), (0.1, 1.0, 0.0), width=48, height=48, fov_y=0.6)
    eye, directions = pixel_rays(camera)
    along, missed = directions @ eye, eye @ eye - 0.25
    hit = along**2 > missed
    distance = np.where(hit, -along - np.sqrt(np.maximum(along**2 - missed, 0.0)), 0.0)
    position = eye + distance[:, None] * directions
    surfaces = VisibleSurfaces(
        camera, hit.astype(np.float64), position, position / 0.5, distance, np.full(len(hit), 0.02), position.copy()
    )

    def environment(origins: Doubles, directions: Doubles) -> tuple[Doubles, Doubles]:
        enters = (origins * directions).sum(axis=1) < 0.0
        return np.where(enters[:, None], 0.0, GREY), np.where(enters, 0.5, np.inf)

    sequence = ProbeSequence(environment, tile=8)
    for _ in range(3):
        light = sequence.render(surfaces)[hit]
        np.testing.assert_allclose(light, np.broadcast_to(np.pi * GREY, light.shape), rtol=4e-6)


@pytest.mark.parametrize("degrees", [0, 20, 45, 70, 90, 120])
@pytest.mark.parametrize("extent", [0.0, 0.02])
def test_screen_probe_irradiance_under_a_bright_half_sphere_is_within_3_percent(degrees: float, extent: float) -> None:
    """E = pi L (1 + cos d) / 2 at tilt d; SH degree, cells and the horizon of meshes cause errors of at most 3 %."""
    angle = np.radians(degrees)
    normal = np.array([np.sin(angle), 0.0, np.cos(angle)])
    eye = 3.0 * normal + (0.1, 0.8, 0.3)
    surfaces = visible_plane(
        ls.Camera.look_at(eye, (0, 0, 0), (0.0, 1.0, 0.1), width=96, height=96, fov_y=0.6), normal, extent
    )
    assert surfaces.share.all()

    def environment(origins: Doubles, directions: Doubles) -> tuple[Doubles, Doubles]:
        return np.repeat((directions[:, 2:] > 0.0).astype(np.float64), 3, axis=1), np.full(len(directions), np.inf)

    sequence = ProbeSequence(environment, refreshed=1.0)
    light = np.mean([sequence.render(surfaces) for _ in range(24)][8:], axis=0)
    truth = 0.5 * np.pi * (1.0 + np.cos(angle))
    assert np.abs(light.mean(axis=0) / truth - 1.0).max() < 0.03
    assert np.abs(light - truth).max() < 0.015 * np.pi


@pytest.mark.parametrize("extent", [0.0, 0.002])
def test_screen_probe_irradiance_of_a_bright_wall_matches_lamberts_formula(extent: float) -> None:
    """On the other walls, the mean is within 2 %, and each wall within 10 %."""
    surfaces = visible_box(box_camera(width=320, height=192), extent)
    sequence = ProbeSequence(bright_wall)
    light = np.mean([sequence.render(surfaces)[:, 0] for _ in range(48)][8:], axis=0)
    truth = wall_irradiance(surfaces)
    assert abs(light.mean() / truth.mean() - 1.0) < 0.02
    for face in {*surfaces.face} - {1}:
        wall = surfaces.face == face
        assert abs(light[wall].mean() / truth[wall].mean() - 1.0) < 0.1
        assert np.corrcoef(light[wall], truth[wall])[0, 1] > 0.94
    assert light[surfaces.face == 1].max() < 1e-3


def wall_irradiance(surfaces: VisibleSurfaces) -> Doubles:
    """Returns the irradiance of each pixel from the bright wall."""
    corners = np.array([[0.5, -0.5, -0.5], [0.5, 0.5, -0.5], [0.5, 0.5, 0.5], [0.5, -0.5, 0.5]])
    values = [
        0.0 if face == 1 else abs(polygon_irradiance(position, normal, corners))
        for position, normal, face in zip(surfaces.position, surfaces.normal, surfaces.face, strict=True)
    ]
    return np.array(values)


def test_surfaces_with_noisy_normals_lose_no_light_from_screen_probes() -> None:
    """Gaussians whose normals scatter by 20 degrees get within 1 % of the light that their cosines imply."""
    camera = ls.Camera.look_at((0.1, 0.8, 3.0), (0, 0, 0), (0.0, 1.0, 0.1), width=160, height=96, fov_y=0.6)
    smooth = visible_plane(camera, (0.0, 0.0, 1.0), 0.02)
    noisy = visible_plane(camera, (0.0, 0.0, 1.0), 0.02)
    noisy.normal = tilted(noisy.normal, 20.0, seed=2)

    def gradient(origins: Doubles, directions: Doubles) -> tuple[Doubles, Doubles]:
        return np.repeat(1.0 + directions[:, 2:], 3, axis=1), np.full(len(directions), np.inf)

    sequence = ProbeSequence(gradient, refreshed=1.0)
    light = np.mean([sequence.render(noisy)[:, 0] for _ in range(8)][2:], axis=0)
    truth = np.pi + 2.0 / 3.0 * np.pi * noisy.normal[:, 2]
    assert abs(light.mean() / truth.mean() - 1.0) < 0.01
    assert smooth.share.all()


def test_disoccluded_pixels_get_screen_probe_light_in_their_first_frame() -> None:
    """A panel before most of the image vanishes; all disoccluded pixels have light in the next frame."""
    sequence = ProbeSequence(constant(GREY))
    surfaces = visible_box(box_camera())
    for frame in range(6):
        hidden = behind_panel(surfaces) if frame < 5 else surfaces
        light = sequence.render(hidden)
        assert np.isfinite(light).all()
        np.testing.assert_allclose(light, np.broadcast_to(np.pi * GREY, light.shape), rtol=4e-6)


@pytest.mark.parametrize("height", [48, 192])
def test_screen_probes_keep_their_light_when_the_image_size_changes(height: int) -> None:
    """When the light goes out with the change, four fifths of the pixels still have half of it."""
    sequence = ProbeSequence(constant(GREY))
    for _ in range(8):
        sequence.render(visible_box(box_camera()))
    sequence.tracer = constant(np.zeros(3))
    kept = sequence.render(visible_box(box_camera(width=height * 5 // 3 + 1, height=height)))
    assert (kept[:, 0] > 0.5 * np.pi * GREY[0]).mean() > 0.8


def behind_panel(surfaces: VisibleSurfaces) -> VisibleSurfaces:
    """Returns the surfaces with a panel before the left three quarters of the image."""
    camera, columns = surfaces.camera, np.tile(np.arange(surfaces.camera.width), surfaces.camera.height)
    covered = columns < 0.75 * camera.width
    directions = (surfaces.position - camera.eye) / surfaces.distance[:, None]
    distance = np.where(covered, 0.1, surfaces.distance)
    position = np.where(covered[:, None], camera.eye + 0.1 * directions, surfaces.position)
    normal = np.where(covered[:, None], -directions, surfaces.normal)
    return VisibleSurfaces(
        camera, surfaces.share, position, normal, distance, surfaces.extent, position.copy(), surfaces.face
    )


def test_screen_probes_leak_no_light_around_a_post() -> None:
    """Walls are bright left of a post and dark right of it; each pixel is bright or dark, also beside the post."""
    camera = box_camera()
    plane, columns = visible_box(camera), np.tile(np.arange(camera.width), camera.height)
    is_post = (columns >= 77) & (columns < 84)
    directions = (plane.position - camera.eye) / plane.distance[:, None]
    surfaces = replace(
        plane,
        position=np.where(is_post[:, None], camera.eye + 0.1 * directions, plane.position),
        normal=np.where(is_post[:, None], -directions, plane.normal),
        distance=np.where(is_post, 0.1, plane.distance),
    )
    surfaces.previous = surfaces.position.copy()
    middle = np.asarray(camera.world_from_camera)[:3, 0]

    def left_half(origins: Doubles, directions: Doubles) -> tuple[Doubles, Doubles]:
        is_left = (origins - camera.eye) @ middle < 0.0
        return np.where(is_left[:, None], GREY, 0.0), np.full(len(directions), 1.0)

    sequence = ProbeSequence(left_half, refreshed=1.0)
    light = [sequence.render(surfaces) for _ in range(8)][-1]
    expected = np.where((columns < 77)[:, None], np.pi * GREY, 0.0)
    off = np.abs(light - expected).max(axis=1)[~is_post] / (np.pi * GREY.max())
    assert off.max() < 0.05


def test_pixels_far_from_any_screen_probe_get_finite_nonzero_light() -> None:
    """A single pixel, one of small coverage, and one far from all lit probes are neither black nor NaN."""
    surfaces = visible_box(box_camera())
    surfaces.share[:] = 0.0
    pixels = [5, 80 * 160 + 77, 95 * 160 + 159]
    surfaces.share[pixels] = 1.0, 0.01, 1.0
    sequence = ProbeSequence(constant(GREY), refreshed=0.02)
    light = sequence.render(surfaces)
    assert len(sequence.rays[0]) > 0
    np.testing.assert_allclose(light[pixels], np.broadcast_to(np.pi * GREY, (3, 3)), rtol=4e-6)
    assert np.abs(np.delete(light, pixels, axis=0)).max() == 0.0


def test_screen_probes_of_a_frame_without_surfaces_send_no_rays() -> None:
    """There are no probes, no rays and no light."""
    surfaces = visible_box(box_camera())
    surfaces.share[:] = 0.0
    sequence = ProbeSequence(constant(GREY))
    assert np.abs(sequence.render(surfaces)).max() == 0.0
    assert len(sequence.rays[0]) == 0


def test_screen_probes_do_not_depend_on_thread_count() -> None:
    """A moving sequence with varying light has equal bits on one, two and five threads."""
    frames = []
    for threads in (1, 2, 5):
        sequence = ProbeSequence(bright_wall, threads)
        frames.append([sequence.render(visible_box(box_camera(step), 0.002)) for step in range(5)])
    np.testing.assert_array_equal(frames[0], frames[1])
    np.testing.assert_array_equal(frames[0], frames[2])


def test_screen_probes_after_a_reset_equal_new_screen_probes() -> None:
    """Frames of another image size are equal, too."""
    used = ProbeSequence(constant(GREY))
    for step in range(3):
        used.render(visible_box(box_camera(step)))
    used.probes.reset()
    used.tracer, used.frame = bright_wall, 0
    fresh = ProbeSequence(bright_wall)
    surfaces = visible_box(box_camera())
    np.testing.assert_array_equal(used.render(surfaces), fresh.render(surfaces))
    other = visible_box(box_camera(width=100, height=50))
    used.probes.reset()
    fresh, used.frame = ProbeSequence(bright_wall), 0
    np.testing.assert_array_equal(used.render(other), fresh.render(other))


def test_screen_probe_irradiance_is_never_negative() -> None:
    """SH ringing on the side away from a small bright light is clamped at 0."""
    camera = ls.Camera.look_at((0.1, 0.8, 3.0), (0, 0, 0), (0.0, 1.0, 0.1), width=160, height=96, fov_y=0.6)
    surfaces = visible_plane(camera, (0.0, 0.0, 1.0), 0.02)
    towards = np.array([0.86, 0.0, -0.5])

    def light_source(origins: Doubles, directions: Doubles) -> tuple[Doubles, Doubles]:
        return np.repeat(100.0 * (directions @ towards > 0.9).astype(np.float64)[:, None], 3, axis=1), np.full(
            len(directions), np.inf
        )

    sequence = ProbeSequence(light_source, refreshed=1.0)
    light = [sequence.render(surfaces) for _ in range(4)][-1]
    assert light.min() == 0.0
    assert np.isfinite(light).all()


def seen_floor(camera: ls.Camera, end: float, offset: tuple[float, float]) -> VisibleSurfaces:
    """Returns the floor y = 0 up to a wall at z = -end."""
    surfaces = visible_plane(camera, (0, 1, 0), offset=offset)
    eye, directions = pixel_rays(camera, offset)
    wall = (directions[:, 2] < 0.0) & ((surfaces.share == 0.0) | (surfaces.position[:, 2] < -end))
    t = (-end - eye[2]) / np.where(wall, directions[:, 2], -1.0)
    surfaces.position[wall] = (eye + t[:, None] * directions)[wall]
    surfaces.normal[wall] = 0.0, 0.0, 1.0
    surfaces.distance[wall], surfaces.share[wall] = t[wall], 1.0
    surfaces.previous = surfaces.position.copy()
    return surfaces


@pytest.mark.parametrize("slope", [1.0, pytest.param(-1.0, marks=pytest.mark.deep)])
def test_floor_seen_at_a_grazing_angle_loses_no_screen_probe_light_far_away(slope: float) -> None:
    """Light that changes with distance is right within 2 % far away, after any number of frames.

    Far away, a tile covers metres of the floor, which a probe at the near end of the tile does not represent.
    """
    camera = ls.Camera.look_at((0, 0.3, 0), (0, 0.28, -6), (0.03, 1, 0), width=192, height=144, fov_y=0.9)

    def wall_radiance(positions: Doubles) -> Doubles:
        return 1.05 + slope * np.clip(-positions[:, 2] / 6.0, 0.0, 1.0) ** 2

    def trace(origins: Doubles, directions: Doubles) -> tuple[Doubles, Doubles]:
        return np.repeat(wall_radiance(origins)[:, None], 3, axis=1), np.full(len(directions), 9.0)

    sequence = ProbeSequence(trace, tile=8)
    found, truth = np.zeros(0), np.zeros(0)
    rng = np.random.default_rng(3)
    for frame in range(64):
        across, down = rng.random(2)
        surfaces = seen_floor(camera, 6.0, (across, down))
        irradiance = sequence.render(surfaces)[:, 0]
        far = (surfaces.normal[:, 1] == 1.0) & (surfaces.position[:, 2] < -3.0)
        if frame >= 32:
            found = np.append(found, irradiance[far])
            truth = np.append(truth, np.pi * wall_radiance(surfaces.position[far]))
    assert found.mean() == pytest.approx(truth.mean(), rel=0.02)
