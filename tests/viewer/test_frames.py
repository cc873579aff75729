"""Frames of the viewer have levels of detail, cameras, picking and overlays."""

from __future__ import annotations

import itertools
import math
import threading
import time
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.viewer.frames.loop import THREAD, Renderers, frame_config
from lumisplat.viewer.frames.page import (
    GAUSSIAN_STEPS,
    PIXEL_STEPS,
    DetailController,
    DetailStep,
    Page,
    ScreenImage,
    first_step,
    page_depth,
    split_image,
)
from lumisplat.viewer.frames.pose import Pose
from lumisplat.viewer.frames.scene_builder import Levels
from lumisplat.viewer.overlays import box_outline, draw_outlines, light_outline
from lumisplat.viewer.panels.status import frame_line
from lumisplat.viewer.picking import picked
from lumisplat.viewer.scene_extent import Extent, world_corners
from lumisplat.viewer.thresholds import (
    DEPTH_STRIDE,
    DIRECT_MS,
    GAP_DECAY,
    LEVEL_GAUSSIANS_MIN,
    SETTLED_GAPS,
    SETTLED_S,
)

FACING = ls.Camera.look_at((0.0, 0.0, -4.0), (0.0, 0.0, 0.0), (0.0, -1.0, 0.0), width=160, height=90)


def chosen_steps(cost: dict[DetailStep, float], budget: float, frames: int = 200) -> list[DetailStep]:
    """Returns the detail steps that the controller chooses for frames, given the time of each step in milliseconds."""
    detail, taken = DetailController(), []
    for _ in range(frames):
        taken.append(detail.step)
        detail.record(cost[detail.step], budget)
    return taken


def costs(full: float) -> dict[DetailStep, float]:
    """Returns the milliseconds of each detail step, proportional to Gaussians and image scale."""
    return {step: full * (1.0, 0.25, 0.125)[step.level] * step.scale for step in GAUSSIAN_STEPS}


def test_viewer_detail_steps_reduce_gaussians_before_they_reduce_pixels() -> None:
    """Each step is coarser than the previous one; resolution drops only after the first reduced level of detail."""
    assert (
        GAUSSIAN_STEPS[0] == DetailStep(0, 1.0)
        and GAUSSIAN_STEPS[1] == DetailStep(1, 1.0)
        and GAUSSIAN_STEPS[2].scale < 1.0
    )
    for finer, coarser in itertools.pairwise(GAUSSIAN_STEPS):
        assert coarser.level >= finer.level and coarser.scale <= finer.scale and coarser != finer
    assert all(step.level == 0 for step in PIXEL_STEPS)


@pytest.mark.parametrize("full", [20.0, 100.0, 300.0, 2000.0])
def test_viewer_uses_the_finest_detail_step_within_the_time_budget_of_a_frame(full: float) -> None:
    """The controller ends at the finest step with some headroom in the budget, or at the coarsest step."""
    cost = costs(full)
    last = chosen_steps(cost, 40.0)[-1]
    fitting = [step for step in GAUSSIAN_STEPS if cost[step] <= 0.7 * 40.0]
    assert cost[last] <= 40.0 or last == GAUSSIAN_STEPS[-1]
    assert not fitting or GAUSSIAN_STEPS.index(last) <= GAUSSIAN_STEPS.index(fitting[0])


def test_viewer_does_not_alternate_between_two_detail_steps() -> None:
    """With the budget between the times of two steps, the controller seldom switches."""
    taken = chosen_steps({step: 45.0 if step == GAUSSIAN_STEPS[0] else 25.0 for step in GAUSSIAN_STEPS}, 40.0, 400)[50:]
    changes = sum(a != b for a, b in itertools.pairwise(taken))
    assert changes <= 0.06 * len(taken)


def test_viewer_skips_detail_steps_after_two_very_slow_frames_in_a_row() -> None:
    """One slow frame changes little, because another program may have caused it."""
    detail = DetailController()
    detail.record(10.0, 40.0)
    detail.record(900.0, 40.0)
    assert detail.step == GAUSSIAN_STEPS[1]
    detail.record(900.0, 40.0)
    assert detail.step == GAUSSIAN_STEPS[-1]


@pytest.mark.parametrize(("count", "level", "scale"), [(1000, 1, 1.0), (2_000_000, 1, 1.0), (3_000_000, 2, 0.5)])
def test_viewer_starts_large_scenes_at_a_coarser_detail_step_than_small_ones(
    count: int, level: int, scale: float
) -> None:
    """The first frame has at most `MOVING_GAUSSIANS_MAX` Gaussians; small scenes start at a quarter of theirs."""
    assert GAUSSIAN_STEPS[first_step(count)] == DetailStep(level, scale)


class NoScreen:
    """Screen that shows nothing."""

    def show(self, shown: ScreenImage) -> None:
        """Drops the image."""

    def close(self) -> None:
        """Does nothing."""


def test_camera_counts_as_stopped_after_three_times_the_usual_gap_between_its_messages(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A single step may begin a motion, so it waits longest; a motion with one longer gap waits longer for a while."""
    now = [100.0]
    monkeypatch.setattr("lumisplat.viewer.frames.page.time.monotonic", lambda: now[0])
    page = Page(NoScreen(), threading.Condition())
    poses = itertools.cycle([Pose((x, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), 1.0, 1.5, 1.0) for x in (0.0, 1.0)])

    def wait_after(gaps: list[float]) -> float:
        for gap in gaps:
            now[0] += gap
            page.set_pose(next(poses))
        return page.stops_at - now[0]

    assert wait_after([0.0]) == pytest.approx(SETTLED_GAPS * SETTLED_S)
    assert wait_after([0.02] * 40) == pytest.approx(SETTLED_GAPS * 0.02)
    assert wait_after([0.1]) == pytest.approx(SETTLED_GAPS * 0.1)
    assert wait_after([0.02]) == pytest.approx(SETTLED_GAPS * GAP_DECAY * 0.1)
    assert wait_after([60.0]) == pytest.approx(SETTLED_GAPS * SETTLED_S)
    page.close()


def test_next_frame_of_a_view_is_full_where_its_camera_is_said_to_have_stopped_and_full_frames_are_fast() -> None:
    """The camera counts as stopped until it moves again; changes of the scene are shown by reduced frames first."""
    page = Page(NoScreen(), threading.Condition())
    poses = itertools.cycle([Pose((x, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), 1.0, 1.5, 1.0) for x in (0.0, 1.0)])
    page.set_pose(next(poses))
    page.key, page.full_ms = (7, 0), DIRECT_MS
    assert not page.skips_reduced(7)
    page.stop()
    assert page.skips_reduced(7) and page.stops_at <= time.monotonic()
    assert not page.skips_reduced(8)
    page.full_ms = DIRECT_MS + 1.0
    assert not page.skips_reduced(7)
    page.full_ms = DIRECT_MS
    page.set_pose(next(poses))
    assert not page.skips_reduced(7) and page.stops_at > time.monotonic() + 2.0 * SETTLED_S
    page.close()


def random_capture(count: int) -> ls.Gaussians:
    """Returns a capture of Gaussians in a unit cube."""
    rng = np.random.default_rng(0)
    return ls.Gaussians(
        means=rng.uniform(size=(count, 3)),
        rotations_wxyz=np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
        scales=np.full((count, 3), 0.01),
        opacities=np.full(count, 0.5),
        sh=np.zeros((count, 1, 3)),
    )


def test_status_line_of_a_coarse_frame_tells_the_gaussians_that_it_shows() -> None:
    """A capture too small for levels of detail shows all its Gaussians at the coarsest step, and meshes have none."""
    page, coarsest = cast(Page, SimpleNamespace(noise=None, frames_at_rest=0)), GAUSSIAN_STEPS[-1]
    lines = [
        frame_line(page, ls.render(scene, FACING, device="cpu"), coarsest, 12.0)
        for scene in (ls.Scene([random_capture(400)]), ls.Scene(meshes=[ls.box(1.0)]))
    ]
    assert lines == ["160 × 90 · 400 Gaussians · 12 ms", "160 × 90 · 1 sample · 12 ms"]


def test_level_of_detail_of_a_capture_is_built_once_and_has_the_instances_transform() -> None:
    """The full capture is shown until its level of detail exists; small captures have no levels."""
    made = threading.Semaphore(0)
    levels = Levels(made.release)
    capture, small = random_capture(5 * LEVEL_GAUSSIANS_MIN), random_capture(100)
    scene = ls.Scene([ls.SplatInstance(capture, position=(1, 2, 3)), ls.SplatInstance(small)])
    assert levels.scene(scene, 0) is scene
    assert levels.scene(scene, 1).splats[0].gaussians is capture
    assert made.acquire(timeout=60)
    coarse = levels.scene(scene, 1)
    assert coarse.splats[0].gaussians.count == round(0.25 * capture.count) and coarse.splats[1].gaussians is small
    np.testing.assert_array_equal(coarse.splats[0].transform, scene.splats[0].transform)
    assert levels.scene(scene, 1) is coarse
    assert (
        levels.scene(scene, 2).splats[0].gaussians is coarse.splats[0].gaussians
    )  # a level of a sixteenth would have too few Gaussians
    levels.close()


def test_viewer_shows_large_scenes_thinned_until_their_levels_of_detail_are_built(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Thinned captures are available at once with enlarged Gaussians; many small captures count as one large scene."""
    monkeypatch.setattr("lumisplat.viewer.frames.scene_builder.MOVING_GAUSSIANS_MAX", 4 * LEVEL_GAUSSIANS_MIN)
    made, busy = threading.Semaphore(0), threading.Event()
    busy.set()
    levels = Levels(made.release, is_busy=busy.is_set)
    capture = random_capture(LEVEL_GAUSSIANS_MIN)
    scene = ls.Scene([ls.SplatInstance(capture, position=(x, 0.0, 0.0)) for x in range(5)])
    standing_in = levels.scene(scene, 1).splats[3].gaussians
    assert standing_in.count == capture.count // 4
    np.testing.assert_allclose(standing_in.scales, 0.01 * 4.0 ** (1.0 / 3.0), rtol=1e-6)
    assert np.isin(standing_in.means, capture.means).all() and levels.scene(scene, 1).splats[0].gaussians is standing_in
    assert not made.acquire(timeout=0.2)  # nothing is merged while a view moves
    busy.clear()
    assert made.acquire(timeout=60)
    level = levels.scene(scene, 1)
    assert {id(i.gaussians) for i in level.splats} == {id(level.splats[0].gaussians)} != {id(standing_in)}
    levels.close()


def test_level_of_detail_built_block_by_block_covers_the_whole_capture(monkeypatch: pytest.MonkeyPatch) -> None:
    """Gaussians are merged only within a spatial block, and progress runs from 0 to 1."""
    monkeypatch.setattr("lumisplat.viewer.frames.scene_builder.LEVEL_BLOCK", 8192)
    made, reported = threading.Semaphore(0), list[float]()
    levels = Levels(made.release, reported.append)
    capture = random_capture(4 * LEVEL_GAUSSIANS_MIN)
    scene = ls.Scene([capture])
    levels.scene(scene, 1)
    assert made.acquire(timeout=60)
    merged = levels.scene(scene, 1).splats[0].gaussians
    assert merged.count == pytest.approx(0.25 * capture.count, rel=1e-3)
    octants = [np.bincount((g.means > 0.5) @ (1, 2, 4), minlength=8) for g in (capture, merged)]
    np.testing.assert_allclose(octants[1], 0.25 * octants[0], rtol=0.05)
    assert reported == sorted(reported) and reported[0] == 0.0 and reported[-1] == 1.0 and len(reported) == 18
    levels.close()


def test_camera_made_of_a_browser_pages_pose_has_its_rays_at_any_image_height() -> None:
    """A pose gives the same rays as a camera at the same position, at any image height."""
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
def test_scale_of_a_scene_on_a_viewer_page_is_a_power_of_ten_and_1_for_common_sizes(size: float, units: float) -> None:
    """Scenes of about 1 to 20 units are shown at scale 1."""
    cube = ls.Scene(meshes=[ls.MeshInstance(ls.box(size / math.sqrt(3.0)), position=(7.0, 0.0, 0.0))])
    extent = Extent.of(cube)
    assert extent.size == pytest.approx(size, rel=1e-5) and extent.page_from_scene == pytest.approx(units)
    assert Extent.of(ls.Scene()).page_from_scene == 1.0


def shifted(z: float) -> np.ndarray:
    """Returns a translation along the view direction."""
    matrix = np.eye(4)
    matrix[2, 3] = z
    return matrix


def box_frame() -> ls.Frame:
    """Renders a lit box of side length 2 at the origin."""
    return ls.render(ls.Scene(meshes=[ls.box(2.0)]), FACING, device="cpu")


def test_picking_returns_the_object_and_depth_of_the_frame_at_a_pixel() -> None:
    """The box front is 3 units away at the image centre; beside the box and outside the image nothing is picked."""
    frame = box_frame()
    pick = picked(frame, 0.5, 0.5)
    assert pick is not None and (pick.instance, pick.gaussian) == (0, -1)
    assert pick.depth == pytest.approx(3.0, rel=1e-3)
    np.testing.assert_allclose(pick.position, (0.0, 0.0, -1.0), atol=0.03)
    assert picked(frame, 0.01, 0.5) is None and picked(frame, -3.0, 7.0) is None


def test_depth_image_sent_to_a_viewer_page_is_view_depth_in_page_units() -> None:
    """The depth image has every fourth pixel; pixels without a surface are farther away than any gizmo."""
    depth = page_depth(box_frame(), 10.0)
    assert depth.shape == (math.ceil((90 - 2) / DEPTH_STRIDE), 160 // DEPTH_STRIDE)
    assert depth[11, 20] == pytest.approx(30.0, rel=1e-3) and depth[0, 0] >= 1000.0


def test_parts_of_an_object_outline_behind_surfaces_are_dimmed_in_the_viewer() -> None:
    """Lines in front of the box have full colour, lines behind it a fraction, and all other pixels are unchanged."""
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
def test_outline_of_a_light_in_the_viewer_shows_its_radius_or_range(light: object, reach: float) -> None:
    """Outlines extend to the radius or the range of a light."""
    outline = light_outline(light, 0.1, is_selected=True)
    assert outline is not None
    farthest = max(float(np.linalg.norm(line, axis=1).max()) for line in outline.lines)
    assert farthest == pytest.approx(reach, rel=1e-6)
    assert light_outline(ls.LightEnvironment(), 0.1, is_selected=True) is None


def test_split_comparison_shows_the_scene_before_edits_left_and_after_them_right() -> None:
    """A white line separates the two sides at any split position."""
    before, after = np.full((4, 10, 3), 10, np.uint8), np.full((4, 10, 3), 90, np.uint8)
    joined = split_image(before, after, 0.3)
    assert (joined[:, :3] == 10).all() and (joined[:, 3] == 255).all() and (joined[:, 4:] == 90).all()
    assert (after == 90).all()
    assert (split_image(before, after, 5.0)[:, :9] == 10).all()
    assert (split_image(before, after, 0.0)[:, 1:] == 90).all()


def test_viewer_logs_no_warnings_that_its_images_are_noisy(caplog: pytest.LogCaptureFixture) -> None:
    """Noise warnings of other threads are logged, also while a viewer is open."""
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
