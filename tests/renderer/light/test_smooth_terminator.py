"""Shadow terminator on smooth meshes of few triangles: as on many triangles, without light leaks."""

from __future__ import annotations

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.scene.lights import Light
from support.scenes.light_scenes import matte
from support.scenes.pipelines import DIRECT

PIPELINES = pytest.mark.parametrize("pipeline", DIRECT, ids=lambda pipeline: pipeline.value)
SIDE = ls.LightDirectional((-1.0, -0.3, -0.2), intensity=np.pi)
BEHIND = ls.LightDirectional((0.0, 0.0, 1.0), intensity=np.pi)
FRONT = ls.Camera.look_at((0.0, 0.0, 3.4), (0.0, 0.0, 0.0), width=96, height=96, fov_y=0.75)


def sphere(meridians: int, center: tuple[float, float, float] = (0.0, 0.0, 0.0), radius: float = 1.0) -> ls.Mesh:
    """Returns a sphere with half as many parallels as meridians, and with the normals of the exact sphere."""
    angle, polar = np.meshgrid(
        np.linspace(0.0, 2.0 * np.pi, meridians + 1), np.linspace(0.0, np.pi, meridians // 2 + 1), indexing="ij"
    )
    normals = np.stack([np.sin(polar) * np.cos(angle), np.cos(polar), np.sin(polar) * np.sin(angle)], axis=-1)
    number = np.arange(normals.size // 3).reshape(angle.shape)
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    faces = np.concatenate(
        [np.stack([a, b, c], -1)[:, 1:].reshape(-1, 3), np.stack([a, c, d], -1)[:, :-1].reshape(-1, 3)]
    )
    normals = normals.reshape(-1, 3)
    return ls.Mesh(radius * normals + center, faces, normals=normals, material=matte(1.0))


def frame_of(
    meshes: list[ls.Mesh],
    light: Light,
    pipeline: ls.Pipeline = ls.Pipeline.TRACE,
    shadows: ls.Shadows = ls.Shadows.HARD,
    samples: int = 1,
    camera: ls.Camera = FRONT,
) -> ls.Frame:
    """Renders a frame lit by one light."""
    config = ls.RenderConfig(pipeline=pipeline, lighting=True, shadows=shadows, samples=samples)
    return ls.render(ls.Scene(meshes=meshes, lights=[light]), camera, config, device="cpu")


def misjudged(coarse: ls.Frame, fine: ls.Frame) -> tuple[float, float]:
    """Returns the fractions of pixels that are wrongly black, and wrongly lit."""
    both = (coarse.alpha > 0.0) & (fine.alpha > 0.0)
    ours, theirs = coarse.color[both][:, 0], fine.color[both][:, 0]
    return float(((ours == 0.0) & (theirs > 0.05)).mean()), float(((theirs == 0.0) & (ours > 0.05)).mean())


@PIPELINES
@pytest.mark.parametrize("shadows", [ls.Shadows.HARD, ls.Shadows.OFF], ids=lambda shadows: shadows.value)
def test_sphere_of_few_smooth_triangles_is_lit_by_a_point_light_like_one_of_many(
    shadows: ls.Shadows, pipeline: ls.Pipeline
) -> None:
    """A sphere of 12 meridians is lit up to the terminator, and not beyond."""
    coarse, fine = (frame_of([sphere(count)], SIDE, pipeline, shadows) for count in (12, 192))
    dark, lit = misjudged(coarse, fine)
    assert dark < 0.006
    assert lit < 0.006
    inner = coarse.normal[..., 2] > 0.4  # at the outline, normals that face away are replaced
    ours, smooth = coarse.color[inner][:, 0], np.maximum(-coarse.normal[inner] @ np.array(SIDE.direction), 0.0)
    assert (ours <= smooth + 1e-5).all()
    assert ours.sum() == pytest.approx(smooth.sum(), rel=2e-3)


@pytest.mark.parametrize(
    "light",
    [
        ls.LightDirectional((-1.0, -0.3, -0.2), intensity=np.pi, angle=0.1),
        ls.LightSphere((2.4, 0.8, 0.6), radius=0.3, intensity=20.0),
    ],
    ids=["sun", "lamp"],
)
def test_sphere_of_few_smooth_triangles_is_lit_by_an_area_light_like_one_of_many(light: Light) -> None:
    """The lights are a sun of 6 degrees and a nearby area light."""
    coarse, fine = (frame_of([sphere(count)], light, shadows=ls.Shadows.SOFT, samples=16) for count in (12, 192))
    dark, lit = misjudged(coarse, fine)
    assert dark < 0.006
    assert lit < 0.006


@PIPELINES
def test_surfaces_of_coarse_meshes_that_face_away_from_the_light_are_black(pipeline: ls.Pipeline) -> None:
    """The surfaces are a coarse smooth sphere, and a box with face normals."""
    ball = frame_of([sphere(12)], BEHIND, pipeline)
    assert ball.alpha.max() == 1.0
    # The camera is at a finite distance, and sees less than the unlit half of the ball.
    assert not ball.color.any()
    box = frame_of([cube()], BEHIND, pipeline)
    assert box.alpha.max() == 1.0
    assert not box.color.any()


def cube(half: float = 0.7) -> ls.Mesh:
    """Returns a cube whose faces have separate vertices and normals."""
    positions, normals, faces = [], [], []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            normal = np.roll([sign, 0.0, 0.0], axis)
            first, second = np.roll([0.0, 1.0, 0.0], axis), np.roll([0.0, 0.0, sign], axis)
            start = len(positions)
            positions += [half * (normal + u * first + v * second) for u, v in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
            normals += [normal] * 4
            faces += [[start, start + 1, start + 2], [start, start + 2, start + 3]]
    return ls.Mesh(positions, faces, normals=normals, material=matte(1.0))


def test_coarse_meshes_with_smooth_normals_let_no_light_into_a_closed_room() -> None:
    """Coarse spheres inside the room touch its walls; the light is outside."""
    room = cube(1.0)
    balls = [sphere(8, (x, y, 0.0), 0.45) for x in (-0.55, 0.55) for y in (-0.55, 0.55)]
    camera = ls.Camera.look_at((0.0, 0.0, 0.95), (0.0, 0.0, 0.0), width=96, height=96, fov_y=1.6)
    for light in (SIDE, BEHIND, ls.LightPoint((1.3, 0.2, 0.3), intensity=5.0)):
        frame = frame_of([room, *balls], light, camera=camera)
        assert set(np.unique(frame.instance_index)) == {0, 1, 2, 3, 4}
        assert not frame.color.any()


def test_slope_facing_away_from_light_in_a_valley_with_smoothed_normals_is_black() -> None:
    """In a valley with smoothed normals, the slope that faces away from the light is black down to the bottom."""
    ends = np.array([[-1.0, 0.6], [0.0, 0.0], [1.0, 0.6]])
    positions = [[x, y, z] for z in (-1.0, 1.0) for x, y in ends]
    tilted = np.array([[0.6, 1.0, 0.0], [0.0, 1.0, 0.0], [-0.6, 1.0, 0.0]])
    normals = np.tile(tilted / np.linalg.norm(tilted, axis=1, keepdims=True), (2, 1))
    valley = ls.Mesh(positions, [[0, 3, 4], [0, 4, 1], [1, 4, 5], [1, 5, 2]], normals=normals, material=matte(1.0))
    low = ls.LightDirectional((-1.0, -0.5, 0.0), intensity=np.pi)  # flatter than the slopes
    camera = ls.Camera.look_at((0.0, 3.0, 0.01), (0.0, 0.0, 0.0), width=64, height=64, fov_y=0.5)
    frame = frame_of([valley], low, camera=camera)
    x = (np.arange(64) - 31.5)[None, :] * np.ones((64, 1))
    facing_away = x > 0.0  # this slope rises towards the light
    assert frame.alpha.min() == 1.0
    assert not frame.color[facing_away].any()
    assert frame.color[x < -20.0].all()


def test_wall_behind_a_light_does_not_block_its_shadow_rays() -> None:
    """Shadow rays from the ball end at the light."""
    source = ls.LightPoint((1.6, 0.0, -1.1), intensity=10.0)
    corners = [[1.66, -9.0, -9.0], [1.66, 9.0, -9.0], [1.66, 9.0, 9.0], [1.66, -9.0, 9.0]]
    wall = ls.Mesh(corners, [[0, 1, 2], [0, 2, 3]], material=matte(0.0))
    alone, before_wall = (frame_of(meshes, source) for meshes in ([sphere(10)], [sphere(10), wall]))
    ball = before_wall.instance_index == 0
    assert ball.mean() > 0.2
    np.testing.assert_array_equal(alone.color[ball], before_wall.color[ball])
