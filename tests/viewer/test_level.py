"""The up direction is set by fitting the ground or by three clicks, and can be undone."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from test_viewer import HEIGHT, settled

import lumisplat as ls
from lumisplat.viewer.frames.page import Page
from lumisplat.viewer.frames.pose import ASPECT, FirstView
from lumisplat.viewer.panels.adding import with_environment_image
from lumisplat.viewer.panels.inspector import sun_angles
from lumisplat.viewer.panels.outliner import ground_normal
from lumisplat.viewer.session import Session
from support.files.hdr_files import write_hdr
from support.viewer.page_client import PageClient

TILT = math.radians(20.0)
UP = np.array([0.0, -math.cos(TILT), math.sin(TILT)])
"""Normal of the floor; y is down."""
SIDE = np.array([1.0, 0.0, 0.0])
AHEAD = np.cross(SIDE, UP)


def tilted_room() -> ls.Scene:
    """Returns a tilted floor of flat Gaussians with a heap on it, and a box that is upright in y-down."""
    rng = np.random.default_rng(3)
    across, along = rng.uniform(-1.0, 1.0, (2, 3000))
    heap = 0.15 * rng.normal(size=(600, 3)) + 0.35 * UP
    means = np.vstack([across[:, None] * SIDE + along[:, None] * AHEAD, heap])
    # Rotates the shortest axis, z, to the normal of the floor.
    turn = np.array([math.cos(0.25 * math.pi - 0.5 * TILT), math.sin(0.25 * math.pi - 0.5 * TILT), 0.0, 0.0])
    gaussians = ls.Gaussians(
        means=means.astype(np.float32),
        rotations_wxyz=np.tile(turn, (len(means), 1)).astype(np.float32),
        scales=np.tile([0.05, 0.05, 0.004], (len(means), 1)).astype(np.float32),
        opacities=np.full(len(means), 0.9, np.float32),
        sh=rng.uniform(0.0, 1.0, (len(means), 1, 3)).astype(np.float32),
    )
    box = ls.MeshInstance(ls.box(0.2), position=(-0.6, -0.1, 0.0), up="y-down", name="crate")
    return ls.Scene(
        [ls.SplatInstance(gaussians, name="room")], [box], [ls.LightDirectional((0.0, 1.0, 0.0))], up="y-down"
    )


@pytest.fixture
def viewer() -> Iterator[ls.Viewer]:
    """Opens a viewer of the tilted room."""
    viewer = ls.view(tilted_room(), height=HEIGHT, device="cpu", config=ls.RenderConfig(lighting=False))
    viewer._loader.join()
    viewer._session.set_options(outlines=False)
    yield viewer
    viewer.close()


def camera() -> ls.Camera:
    """Returns a camera that looks at the floor from the front and above."""
    return ls.Camera.look_at((0.3, -1.5, -2.5), (0.0, 0.0, 0.0), (0.0, -1.0, 0.0), width=160, height=HEIGHT)


def horizon(page: Page) -> float:
    """Returns the sine of the angle between a page's horizon and the floor."""
    assert page.pose is not None
    return abs(float(page.pose.camera(HEIGHT).camera_from_world[0, :3] @ UP))


def test_levelling_in_the_viewer_and_its_undo_change_the_up_direction_not_the_capture(viewer: ls.Viewer) -> None:
    """Page, upright objects, sun angles and ground follow the new up; capture and light stay in place."""
    session = viewer._session
    crate = next(entry.id for entry in viewer.document.entries if entry.name == "crate")
    with PageClient(viewer.url) as client:
        client.look(camera())
        settled(viewer, client)
        (page,) = viewer._pages.values()
        before, pose, ground = viewer.document, page.pose, session.extent.height_below
        assert horizon(page) > 0.03
        viewer._outliner.level.fit()
        up = np.array(viewer.scene.up_direction)
        assert up @ UP > math.cos(math.radians(0.5))
        placed = np.asarray(viewer.document.entry(crate).world_from_file)
        np.testing.assert_allclose(placed[:3, 1] / np.linalg.norm(placed[:3, 1]), up, atol=1e-9)
        np.testing.assert_array_equal(viewer.scene.splats[0].transform, before.scene().splats[0].transform)
        sun = viewer.scene.lights[0]
        assert isinstance(sun, ls.LightDirectional) and sun == before.scene().lights[0]
        _, elevation, _ = sun_angles(sun.direction, viewer.scene.up_direction)
        assert elevation == pytest.approx(70.0, abs=0.5)
        bottom = np.array(session.extent.center) @ up - session.extent.height_below
        assert bottom == pytest.approx(0.0, abs=0.05) and ground != session.extent.height_below
        assert horizon(page) < 0.005
        assert page.pose is not None and page.pose.position == pytest.approx(pose.position)  # pyright: ignore
        assert session.undo()
        assert viewer.document is before and session.extent.height_below == pytest.approx(ground)
        assert page.pose.wxyz == pytest.approx(pose.wxyz, abs=1e-6)  # pyright: ignore[reportOptionalMemberAccess]
        assert session.redo() and viewer.scene.up_direction == pytest.approx(tuple(up))


def test_page_whose_camera_was_not_moved_shows_the_whole_scene_after_levelling(viewer: ls.Viewer) -> None:
    """An unmoved page, or one that looks straight down at the new ground, shows the levelled scene from its front."""
    first = viewer._first_view
    viewer._session.apply(lambda document: document.with_up("z-up"))
    assert viewer._first_view.up == (0.0, 0.0, 1.0) != first.up
    below = ls.Camera.look_at((0.0, 0.1, 3.0), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0), width=160, height=HEIGHT)
    with PageClient(viewer.url) as client:
        client.look(camera())
        settled(viewer, client)
        client.look(below)
        settled(viewer, client)
        viewer._session.undo()
        viewer._session.redo()
        (page,) = viewer._pages.values()
        assert page.pose is not None
        position, _ = viewer._first_view.at(page.pose.aspect)
        np.testing.assert_allclose(page.pose.position, position, atol=1e-5)


def test_three_clicks_on_the_ground_set_the_up_direction_of_the_viewers_scene(viewer: ls.Viewer) -> None:
    """The clicks select nothing, a click on the background does not count, and later clicks select again."""
    session, level = viewer._session, viewer._outliner.level
    problems: list[str] = []
    session.error_listeners.append(problems.append)
    with PageClient(viewer.url) as client:
        client.look(camera())
        settled(viewer, client)
        (page,) = viewer._pages.values()
        level.start()
        click(viewer, page, (0.99, 0.01))
        assert session.ground_points == () and "no surface at that point" in problems[0]
        for count, (across, along) in enumerate(((-0.8, 0.7), (0.8, 0.7), (0.6, -0.8)), start=1):
            seen = camera().camera_from_world @ np.append(across * SIDE + along * AHEAD, 1.0)
            at = camera().fx * seen[:2] / seen[2] + (camera().cx, camera().cy)
            click(viewer, page, tuple(at / (camera().width, camera().height)))
            assert session.ground_points is None if count == 3 else len(session.ground_points or ()) == count
        assert session.selected is None
        assert np.array(viewer.scene.up_direction) @ UP > math.cos(math.radians(2.0))
        settled(viewer, client)
        click(viewer, page, (0.5, 0.5))
        assert session.selected is not None


def click(viewer: ls.Viewer, page: Page, at: tuple[float, ...]) -> None:
    """Clicks at a point of the image, given as fractions of width and height."""
    viewer._pick(page, SimpleNamespace(screen_pos=at))


def test_three_collinear_clicks_on_the_ground_leave_the_up_direction_unchanged(viewer: ls.Viewer) -> None:
    """An error is reported, and the mode of clicking ground points ends."""
    problems: list[str] = []
    viewer._session.error_listeners.append(problems.append)
    with PageClient(viewer.url) as client:
        client.look(camera())
        settled(viewer, client)
        (page,) = viewer._pages.values()
        before = viewer.document
        viewer._outliner.level.start()
        for _ in range(3):
            click(viewer, page, (0.5, 0.6))
    assert "are collinear" in problems[0] and viewer.document is before and viewer._session.ground_points is None


def test_ground_normal_through_three_clicked_points_faces_the_camera() -> None:
    """The order of the points does not matter; collinear points have no normal."""
    points = [np.array(point) for point in ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 2.0))]
    for order in ((0, 1, 2), (1, 0, 2)):
        for side in (1.0, -1.0):
            normal = ground_normal([points[number] for number in order], (5.0, 2.0 * side, 1.0))
            assert normal == (0.0, side, 0.0)
    assert ground_normal([points[0], points[1], (2.0, 0.01, 0.0)], (0.0, 1.0, 0.0)) is None
    assert ground_normal([points[0], points[0], points[1]], (0.0, 1.0, 0.0)) is None


@pytest.mark.parametrize("size", [(0.4, 3.0, 0.4), (3.0, 0.3, 0.5), (1.0, 1.0, 1.0)])
def test_first_view_shows_the_whole_scene_on_pages_of_any_aspect_ratio(size: tuple[float, float, float]) -> None:
    """All corners of the scene are in view, and a tall scene is no smaller than necessary on a phone."""
    scene = ls.Scene(meshes=[ls.MeshInstance(ls.box(size))], up="y-up")
    view = FirstView.of(scene)
    low, high = scene.meshes[0].bounds()
    corners = np.array([[(low, high)[i >> axis & 1][axis] for axis in range(3)] for i in range(8)])
    for aspect in (0.4, 0.6, 1.0, ASPECT, 3.0):
        eye, target = view.at(aspect)
        seen = ls.Camera.look_at(eye, target, view.up, width=round(1000 * aspect), height=1000, fov_y=view.fov_y)
        local = corners @ seen.camera_from_world[:3, :3].T + seen.camera_from_world[:3, 3]
        pixels = seen.fx * local[:, :2] / local[:, 2:]
        assert (np.abs(pixels) <= (0.5 * seen.width, 0.5 * seen.height)).all()
        if size[1] == 3.0 and aspect >= 0.4:
            assert np.ptp(pixels[:, 1]) > 600.0


def test_environment_image_added_in_the_viewer_is_upright(tmp_path: Path) -> None:
    """The image's upper edge faces up for every up direction; an environment that has a rotation keeps it."""
    from viser import transforms

    file = tmp_path / "sky.hdr"
    write_hdr(file, np.ones((4, 8, 3), np.float32))
    for up in ("y-down", "y-up", "z-up"):
        document, number = with_environment_image(ls.io.SceneDocument.of(ls.Scene(up=up)), str(file))
        (environment,) = document.entry(number).lights
        assert isinstance(environment, ls.LightEnvironment)
        turned = transforms.SO3(np.asarray(environment.rotation_wxyz, np.float64)).as_matrix()
        np.testing.assert_allclose(turned[:, 1], document.scene().up_direction, atol=1e-9)
    document = document.changed(number, rotation_wxyz=[1.0, 0.0, 0.0, 0.0])
    document, number = with_environment_image(document, str(file))
    assert list(document.entry(number).table["rotation_wxyz"]) == [1.0, 0.0, 0.0, 0.0]


def test_levelling_a_scene_without_captures_reports_what_to_do() -> None:
    """A scene of meshes reports an error and keeps its up direction."""
    viewer = ls.view(ls.Scene(meshes=[ls.MeshInstance(ls.box(1.0))], up="y-up"), height=HEIGHT, device="cpu")
    viewer._loader.join()
    problems: list[str] = []
    session: Session = viewer._session
    session.error_listeners.append(problems.append)
    viewer._outliner.level.fit()
    assert viewer.scene.up_direction == (0.0, 1.0, 0.0) and "click three points" in problems[0]
    assert viewer._outliner.level._fits.disabled
    viewer.close()
