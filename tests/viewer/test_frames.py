"""What is behind the frames: how fine they are, from where, and what is drawn on them."""

from __future__ import annotations

import itertools
import math
import threading

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.viewer.frames.loop import THREAD, Renderers, frame_config
from lumisplat.viewer.frames.page import (
    GAUSSIAN_STEPS,
    PIXEL_STEPS,
    DetailController,
    DetailStep,
    first_step,
    page_depth,
    split_image,
)
from lumisplat.viewer.frames.pose import Pose
from lumisplat.viewer.frames.scene_builder import Levels
from lumisplat.viewer.overlays import box_outline, draw_outlines, light_outline
from lumisplat.viewer.picking import picked
from lumisplat.viewer.scene_extent import Extent, world_corners
from lumisplat.viewer.thresholds import DEPTH_STRIDE, LEVEL_GAUSSIANS_MIN

FACING = ls.Camera.look_at((0.0, 0.0, -4.0), (0.0, 0.0, 0.0), (0.0, -1.0, 0.0), width=160, height=90)


def paced(cost: dict[DetailStep, float], budget: float, frames: int = 200) -> list[DetailStep]:
    """The steps of frames that take a known time each."""
    detail, taken = DetailController(), []
    for _ in range(frames):
        taken.append(detail.step)
        detail.record(cost[detail.step], budget)
    return taken


def costs(full: float) -> dict[DetailStep, float]:
    """Milliseconds by step: Gaussians count most."""
    return {step: full * (1.0, 0.25, 0.125)[step.level] * step.scale for step in GAUSSIAN_STEPS}


def test_steps_leave_out_gaussians_first_and_pixels_second() -> None:
    """Each is coarser than the one before; pixels go once there is a level of a quarter."""
    assert (
        GAUSSIAN_STEPS[0] == DetailStep(0, 1.0)
        and GAUSSIAN_STEPS[1] == DetailStep(1, 1.0)
        and GAUSSIAN_STEPS[2].scale < 1.0
    )
    for finer, coarser in itertools.pairwise(GAUSSIAN_STEPS):
        assert coarser.level >= finer.level and coarser.scale <= finer.scale and coarser != finer
    assert all(step.level == 0 for step in PIXEL_STEPS)


@pytest.mark.parametrize("full", [20.0, 100.0, 300.0, 2000.0])
def test_a_pace_keeps_its_budget_and_wastes_little(full: float) -> None:
    """It ends on the finest step that keeps the time with some room, or on the coarsest of all."""
    cost = costs(full)
    last = paced(cost, 40.0)[-1]
    fitting = [step for step in GAUSSIAN_STEPS if cost[step] <= 0.7 * 40.0]
    assert cost[last] <= 40.0 or last == GAUSSIAN_STEPS[-1]
    assert not fitting or GAUSSIAN_STEPS.index(last) <= GAUSSIAN_STEPS.index(fitting[0])


def test_a_pace_does_not_flicker() -> None:
    """Where two steps are on both sides of the budget, it seldom changes between them."""
    taken = paced({step: 45.0 if step == GAUSSIAN_STEPS[0] else 25.0 for step in GAUSSIAN_STEPS}, 40.0, 400)[50:]
    changes = sum(a != b for a, b in itertools.pairwise(taken))
    assert changes <= 0.06 * len(taken)


def test_a_pace_far_beyond_its_budget_leaves_out_much_at_once() -> None:
    """Two frames say that it is so; a single one may be another program's."""
    detail = DetailController()
    detail.record(10.0, 40.0)
    detail.record(900.0, 40.0)
    assert detail.step == GAUSSIAN_STEPS[1]
    detail.record(900.0, 40.0)
    assert detail.step == GAUSSIAN_STEPS[-1]


@pytest.mark.parametrize(("count", "level", "scale"), [(1000, 1, 1.0), (2_000_000, 1, 1.0), (3_000_000, 2, 0.5)])
def test_large_scenes_begin_coarsely(count: int, level: int, scale: float) -> None:
    """Their first frame has no more Gaussians than can be drawn at once; others begin at a quarter."""
    assert GAUSSIAN_STEPS[first_step(count)] == DetailStep(level, scale)


def many(count: int) -> ls.Gaussians:
    """Gaussians in a unit cube."""
    rng = np.random.default_rng(0)
    return ls.Gaussians(
        means=rng.uniform(size=(count, 3)),
        rotations_wxyz=np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
        scales=np.full((count, 3), 0.01),
        opacities=np.full(count, 0.5),
        sh=np.zeros((count, 1, 3)),
    )


def test_levels_are_made_once_and_stand_where_the_capture_stands() -> None:
    """Until they are there, what there is is shown; small captures have none."""
    made = threading.Semaphore(0)
    levels = Levels(made.release)
    capture, small = many(5 * LEVEL_GAUSSIANS_MIN), many(100)
    scene = ls.Scene([ls.SplatInstance(capture, position=(1, 2, 3)), ls.SplatInstance(small)])
    assert levels.scene(scene, 0) is scene
    assert levels.scene(scene, 1).splats[0].gaussians is capture
    assert made.acquire(timeout=60)
    coarse = levels.scene(scene, 1)
    assert coarse.splats[0].gaussians.count == round(0.25 * capture.count) and coarse.splats[1].gaussians is small
    np.testing.assert_array_equal(coarse.splats[0].transform, scene.splats[0].transform)
    assert levels.scene(scene, 1) is coarse
    assert levels.scene(scene, 2).splats[0].gaussians is coarse.splats[0].gaussians  # a sixteenth would be too few
    levels.close()


def test_levels_of_a_large_scene_have_thinned_ones_in_their_place(monkeypatch: pytest.MonkeyPatch) -> None:
    """They are there at once, and fill as much; many small captures count as one large one."""
    monkeypatch.setattr("lumisplat.viewer.frames.scene_builder.MOVING_GAUSSIANS_MAX", 4 * LEVEL_GAUSSIANS_MIN)
    made, busy = threading.Semaphore(0), threading.Event()
    busy.set()
    levels = Levels(made.release, is_busy=busy.is_set)
    capture = many(LEVEL_GAUSSIANS_MIN)
    scene = ls.Scene([ls.SplatInstance(capture, position=(x, 0.0, 0.0)) for x in range(5)])
    standing_in = levels.scene(scene, 1).splats[3].gaussians
    assert standing_in.count == capture.count // 4
    np.testing.assert_allclose(standing_in.scales, 0.01 * 4.0 ** (1.0 / 3.0), rtol=1e-6)
    assert np.isin(standing_in.means, capture.means).all() and levels.scene(scene, 1).splats[0].gaussians is standing_in
    assert not made.acquire(timeout=0.2)  # a view moves: nothing is merged yet
    busy.clear()
    assert made.acquire(timeout=60)
    level = levels.scene(scene, 1)
    assert {id(i.gaussians) for i in level.splats} == {id(level.splats[0].gaussians)} != {id(standing_in)}
    levels.close()


def test_levels_are_made_in_blocks_that_are_whole_together(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each Gaussian is merged within a box of space, and their progress is told up to the end."""
    monkeypatch.setattr("lumisplat.viewer.frames.scene_builder.LEVEL_BLOCK", 8192)
    made, told = threading.Semaphore(0), list[float]()
    levels = Levels(made.release, told.append)
    capture = many(4 * LEVEL_GAUSSIANS_MIN)
    scene = ls.Scene([capture])
    levels.scene(scene, 1)
    assert made.acquire(timeout=60)
    merged = levels.scene(scene, 1).splats[0].gaussians
    assert merged.count == pytest.approx(0.25 * capture.count, rel=1e-3)
    octants = [np.bincount((g.means > 0.5) @ (1, 2, 4), minlength=8) for g in (capture, merged)]
    np.testing.assert_allclose(octants[1], 0.25 * octants[0], rtol=0.05)
    assert told == sorted(told) and told[0] == 0.0 and told[-1] == 1.0 and len(told) == 18
    levels.close()


def test_a_pose_is_the_camera_of_the_page() -> None:
    """The same rays as of a camera that looks from there, at any number of rows."""
    from viser import transforms

    wanted = ls.Camera.look_at((1.0, -2.0, -3.0), (0.0, 0.5, 0.0), (0.0, -1.0, 0.0), width=320, height=180, fov_y=0.7)
    matrix = np.linalg.inv(wanted.camera_from_world)
    wxyz = tuple(float(x) for x in transforms.SO3.from_matrix(matrix[:3, :3]).wxyz)
    x, y, z = matrix[:3, 3].tolist()
    camera = Pose((x, y, z), (wxyz[0], wxyz[1], wxyz[2], wxyz[3]), 0.7, 320 / 180, 4.0).camera(180)
    np.testing.assert_allclose(camera.camera_from_world, wanted.camera_from_world, atol=1e-12)
    assert (camera.width, camera.height) == (320, 180)
    np.testing.assert_allclose((camera.fx, camera.fy), (wanted.fx, wanted.fy), rtol=1e-12)


@pytest.mark.parametrize(("size", "units"), [(0.02, 100.0), (1.0, 1.0), (20.0, 1.0), (400.0, 0.01), (1e5, 1e-5)])
def test_scenes_of_all_sizes_fit_on_a_page(size: float, units: float) -> None:
    """In powers of ten; those that fit as they are stay so."""
    cube = ls.Scene(meshes=[ls.MeshInstance(ls.box(size / math.sqrt(3.0)), position=(7.0, 0.0, 0.0))])
    extent = Extent.of(cube)
    assert extent.size == pytest.approx(size, rel=1e-5) and extent.page_from_scene == pytest.approx(units)
    assert Extent.of(ls.Scene()).page_from_scene == 1.0


def shifted(z: float) -> np.ndarray:
    """A translation along the view."""
    matrix = np.eye(4)
    matrix[2, 3] = z
    return matrix


def box_frame() -> ls.Frame:
    """A box of two units in the middle, lit."""
    return ls.render(ls.Scene(meshes=[ls.box(2.0)]), FACING, device="cpu")


def test_picks_are_read_off_the_frame() -> None:
    """The box's front is 3 units away in the middle; beside it, and outside of the picture, is nothing to pick."""
    frame = box_frame()
    pick = picked(frame, 0.5, 0.5)
    assert pick is not None and (pick.instance, pick.gaussian) == (0, -1)
    assert pick.depth == pytest.approx(3.0, rel=1e-3)
    np.testing.assert_allclose(pick.position, (0.0, 0.0, -1.0), atol=0.03)
    assert picked(frame, 0.01, 0.5) is None and picked(frame, -3.0, 7.0) is None


def test_depth_of_a_page_is_view_depth_in_its_units() -> None:
    """Of every fourth pixel; where nothing is, as far away as handles need."""
    depth = page_depth(box_frame(), 10.0)
    assert depth.shape == (math.ceil((90 - 2) / DEPTH_STRIDE), 160 // DEPTH_STRIDE)
    assert depth[11, 20] == pytest.approx(30.0, rel=1e-3) and depth[0, 0] >= 1000.0


def test_lines_are_dimmed_behind_what_is_in_the_frame() -> None:
    """In front of the box they have their colour, behind it a share of it, and nothing else changes."""
    frame = box_frame()
    black = np.zeros((90, 160, 3), np.uint8)
    near, far = (world_corners((np.full(3, -0.2), np.full(3, 0.2)), shifted(z)) for z in (-1.45, 1.45))
    front = draw_outlines(black, frame, [box_outline(near)])
    back = draw_outlines(black, frame, [box_outline(far)])
    assert front.max() > 200 and 0 < back.max() < 120
    assert (front.any(axis=2).mean() < 0.1) and not black.any()


@pytest.mark.parametrize(
    ("light", "reach"),
    [
        (ls.LightPoint((0, 0, 0), radius=0.3), 0.3),
        (ls.LightPoint((0, 0, 0), radius=0.3, range=2.0), 2.0),
        (ls.LightSphere((0, 0, 0), 0.5), 0.5),
        (ls.LightSpot((0, 0, 0), (0, 0, 1), range=3.0, outer_angle=0.5), 3.0),
        (ls.LightRect((0, 0, 0), (0.6, 0, 0), (0, 0.8, 0)), 0.5),
        (ls.LightDisk((0, 0, 0), (1, 2, -2), 0.5), 0.5),
    ],
)
def test_outlines_reach_as_far_as_lights(light: object, reach: float) -> None:
    """To their radius or their range."""
    outline = light_outline(light, 0.1, is_selected=True)
    assert outline is not None
    farthest = max(float(np.linalg.norm(line, axis=1).max()) for line in outline.lines)
    assert farthest == pytest.approx(reach, rel=1e-6)
    assert light_outline(ls.LightEnvironment(), 0.1, is_selected=True) is None


def test_a_split_picture_is_before_to_the_left_and_after_to_the_right() -> None:
    """With a white line between, wherever it is."""
    before, after = np.full((4, 10, 3), 10, np.uint8), np.full((4, 10, 3), 90, np.uint8)
    joined = split_image(before, after, 0.3)
    assert (joined[:, :3] == 10).all() and (joined[:, 3] == 255).all() and (joined[:, 4:] == 90).all()
    assert (after == 90).all()
    assert (split_image(before, after, 5.0)[:, :9] == 10).all()
    assert (split_image(before, after, 0.0)[:, 1:] == 90).all()


def test_the_log_has_no_word_of_grain_that_is_still_to_go(caplog: pytest.LogCaptureFixture) -> None:
    """Frames of one sample are no news in the viewer's thread; in any other they are, also while a viewer is open."""
    renderers = Renderers("cpu", lambda label, share: None)
    scene = ls.Scene(meshes=[ls.box(1.0)], lights=[ls.LightEnvironment()])
    config = frame_config(ls.RenderConfig(pipeline=ls.Pipeline.HYBRID), "color")

    def render() -> None:
        renderers.of(threading.current_thread().name, config).render(scene, FACING)

    thread = threading.Thread(target=render, name=THREAD)
    thread.start()
    thread.join()
    assert "noisy" not in caplog.text
    render()
    assert "noisy" in caplog.text
    renderers.close()
