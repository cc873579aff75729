"""Changes that must not change a frame: order, hidden splats, threads, repetition, and the coordinate frame."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

import lumisplat as ls
from support.compare.backends import renderer_of
from support.compare.images import assert_close, assert_close_outside_band
from support.oracles import raster_oracle as oracles
from support.scenes.raster_scenes import (
    cases,
    front_camera,
    joined,
    octahedron,
    one_gaussian,
    quad,
    random_gaussians,
    similarity,
)

IMAGES = ("color", "alpha", "depth", "normal", "gaussian_index", "instance_index")
Images = dict[str, np.ndarray]


def images(frame: ls.Frame) -> Images:
    """Returns the images of a frame by name."""
    return {name: getattr(frame, name) for name in IMAGES}


def assert_equal(actual: ls.Frame, expected: ls.Frame, names: tuple[str, ...] = IMAGES) -> None:
    """Asserts bit-equal images."""
    for name in names:
        np.testing.assert_array_equal(getattr(actual, name), getattr(expected, name), err_msg=name)


def full_scene() -> ls.Scene:
    """Returns two instances and two meshes, one of them crossed by splats."""
    asset = random_gaussians(70, 120, degree=2, center=(0.0, 0.0, 0.0), extent=(1.0, 1.0, 1.0))
    placed = [ls.SplatInstance(asset, similarity((1, 1, 0), 0.4 + i, 0.8, (i - 0.5, 0.2 * i, 4.0))) for i in range(2)]
    return ls.Scene(placed, [octahedron((0.1, 0.1, 4.0), 0.6), quad(5.5, tilt=0.3)])


def test_rasterised_frame_does_not_depend_on_the_order_of_gaussians_in_their_set(renderer: ls.Renderer) -> None:
    """Shuffled Gaussians give the same frame to the bit, except for their indices."""
    gaussians = random_gaussians(71, 300, degree=1)
    order = np.random.default_rng(0).permutation(300)
    assert len(np.unique(gaussians.means[:, 2])) == 300
    frame = renderer.render(ls.Scene([gaussians]), front_camera())
    shuffled = renderer.render(ls.Scene([gaussians.subset(order)]), front_camera())
    assert_equal(shuffled, frame, ("color", "alpha", "depth", "normal", "instance_index"))
    found = shuffled.gaussian_index >= 0
    np.testing.assert_array_equal(order[shuffled.gaussian_index[found]], frame.gaussian_index[found])


def test_splats_at_equal_depth_are_drawn_in_the_order_of_the_scene(renderer: ls.Renderer) -> None:
    """Among splats at one depth, the first of a set is in front, and the first of the instances."""
    red = one_gaussian(opacity=0.9, color=(1.0, 0.0, 0.0))
    blue = one_gaussian(opacity=0.9, color=(0.0, 0.0, 1.0))
    camera = front_camera(cx=32.5, cy=24.5)
    for scene in (ls.Scene([joined(red, blue)]), ls.Scene([red, blue])):
        assert renderer.render(scene, camera).color[24, 32] == pytest.approx([0.9, 0.0, 0.09], abs=1e-5)
    for scene in (ls.Scene([joined(blue, red)]), ls.Scene([blue, red])):
        assert renderer.render(scene, camera).color[24, 32] == pytest.approx([0.09, 0.0, 0.9], abs=1e-5)


def test_rasteriser_logs_each_unsupported_kernel_degree_of_a_capture_once(
    backend: str, caplog: pytest.LogCaptureFixture
) -> None:
    """A capture of another kernel degree is drawn as Gaussian; a renderer logs each degree once."""
    gaussian = random_gaussians(21, 30)
    quartic, linear = (replace(gaussian, kernel_degree=degree) for degree in (4, 0))
    renderer = renderer_of(backend)
    expected = renderer.render(ls.Scene([gaussian]), front_camera())
    assert not caplog.records
    for _ in range(2):
        np.testing.assert_array_equal(renderer.render(ls.Scene([quartic]), front_camera()).color, expected.color)
    renderer.render(ls.Scene([gaussian, linear, quartic]), front_camera())
    messages = [record.getMessage() for record in caplog.records]
    assert [line.partition(",")[0] for line in messages] == [
        f"a capture has kernel degree {degree}" for degree in (4, 0)
    ]


def test_gaussian_set_split_into_instances_is_rasterised_like_the_whole_set(renderer: ls.Renderer) -> None:
    """Colour, alpha, depth and normal are equal to the bit."""
    gaussians = random_gaussians(72, 200, degree=1)
    parts = [gaussians.subset(np.arange(start, 200, 3)) for start in range(3)]
    whole = renderer.render(ls.Scene([gaussians]), front_camera())
    cut = renderer.render(ls.Scene(parts), front_camera())
    assert_equal(cut, whole, ("color", "alpha", "depth", "normal"))
    found = whole.gaussian_index >= 0
    np.testing.assert_array_equal(cut.instance_index[found], whole.gaussian_index[found] % 3)
    np.testing.assert_array_equal(cut.gaussian_index[found], whole.gaussian_index[found] // 3)


@pytest.mark.parametrize(
    "hidden",
    [
        random_gaussians(73, 50, center=(0.0, 0.0, -4.0)),  # behind the camera
        random_gaussians(74, 50, center=(0.0, 0.0, 12.0), extent=(0.2, 0.2, 1.0), scale_range=(0.01, 0.1)),  # occluded
        random_gaussians(75, 50, center=(60.0, 0.0, 4.0)),  # outside the image
        one_gaussian(opacity=1.0 / 256.0),  # below one step
        one_gaussian(opacity=0.0),
        one_gaussian((0.0, 0.0, 0.005), 0.001, 1.0),  # nearer than the near plane
    ],
    ids=["behind", "occluded", "outside", "faint", "nothing", "too near"],
)
def test_invisible_splats_do_not_change_a_rasterised_frame(renderer: ls.Renderer, hidden: ls.Gaussians) -> None:
    """The splats are behind the camera, occluded, outside the image, too faint or too near; all bits stay."""
    wall = [one_gaussian((0.0, 0.0, 8.0 + 0.1 * i), 6.0, 1.0) for i in range(4)]
    visible = joined(random_gaussians(76, 150), *wall)
    frame = renderer.render(ls.Scene([visible]), front_camera())
    assert_equal(renderer.render(ls.Scene([joined(visible, hidden)]), front_camera()), frame)


def test_rasterised_frame_is_bit_equal_when_rendered_again(renderer: ls.Renderer, backend: str) -> None:
    """The frame is rendered again after another frame, and by another renderer."""
    scene, camera = full_scene(), front_camera()
    first = renderer.render(scene, camera)
    other = renderer.render(ls.Scene([random_gaussians(77)]), front_camera(90, 70))
    for _ in range(3):
        assert_equal(renderer.render(scene, camera), first)
    assert_equal(renderer_of(backend).render(scene, camera), first)
    assert other.color.shape == (70, 90, 3)


def test_rasterised_frame_does_not_change_when_the_next_frame_is_rendered(renderer: ls.Renderer) -> None:
    """All images of the earlier frame keep their bits."""
    frame = renderer.render(full_scene(), front_camera())
    before = {name: image.copy() for name, image in images(frame).items()}
    renderer.render(ls.Scene([random_gaussians(78)]), front_camera())
    for name, image in images(frame).items():
        np.testing.assert_array_equal(image, before[name])


def test_rasterised_frames_do_not_depend_on_thread_count() -> None:
    """One, two and five CPU threads give the same frame to the bit."""
    scene, camera = full_scene(), front_camera(150, 90, 140.0)
    single = ls.create_renderer(device="cpu", threads=1).render(scene, camera)
    for threads in (2, 5):
        assert_equal(ls.create_renderer(device="cpu", threads=threads).render(scene, camera), single)


def test_cropped_camera_rasterises_a_crop_of_the_image(renderer: ls.Renderer) -> None:
    """The crop may lie anywhere in the image."""
    scene = full_scene()
    whole = renderer.render(scene, front_camera(64, 48))
    left, top = 21, 13
    part = renderer.render(scene, front_camera(64 - left, 48 - top, cx=32.0 - left, cy=24.0 - top))
    for name in ("color", "alpha", "normal"):
        assert_close(getattr(part, name), getattr(whole, name)[top:, left:], atol=1e-4, name=name)


def test_rasterised_frame_is_unchanged_if_scene_and_camera_move_together(renderer: ls.Renderer) -> None:
    """The images are equal when scene and camera are transformed together; depths scale."""
    move = similarity((0.2, 1.0, -0.4), 2.2, 1.7, (3.0, -5.0, 11.0))
    scene, camera = full_scene(), front_camera()
    moved = ls.Scene(
        [ls.SplatInstance(i.gaussians, move @ i.transform) for i in scene.splats],
        [ls.MeshInstance(i.mesh, move @ i.transform) for i in scene.meshes],
    )
    pose = np.linalg.inv(move @ camera.world_from_camera)
    pose[:3, :3] /= np.cbrt(np.linalg.det(pose[:3, :3]))
    pose[:3, 3] = -pose[:3, :3] @ (move @ [*camera.eye, 1.0])[:3]
    expected = renderer.render(scene, camera)
    frame = renderer.render(moved, front_camera(camera_from_world=pose))
    twin = oracles.render(scene, camera)
    for name, rule in {
        "color": lambda image: image,
        "alpha": lambda image: image,
        "depth": lambda image: np.where(np.isfinite(image), image, 1e6) / 1.7,
        "normal": lambda image: image @ move[:3, :3] / 1.7,
    }.items():
        undone = (
            rule(getattr(frame, name))
            if name != "depth"
            else np.where(np.isinf(frame.depth), np.inf, frame.depth / 1.7)
        )
        assert_close_outside_band(undone, getattr(expected, name), twin["band"], atol=1e-3, name=name)


def test_renderer_reused_for_rearranged_assets_gives_the_frame_of_a_new_renderer(backend: str) -> None:
    """The assets change their transforms, count, order and neighbours."""
    first, second = (random_gaussians(seed, 60 + seed, center=(0.0, 0.0, 0.0)) for seed in (80, 81))
    ball, wall = octahedron((0.1, 0.1, 0.0), 0.6), quad(1.5, tilt=0.3)
    left, right = similarity(offset=(-0.7, 0.0, 4.0)), similarity((0.0, 1.0, 0.0), 1.0, 0.8, (0.8, 0.2, 4.4))
    warm = renderer_of(backend)
    for splats, meshes in (
        ([(first, left), (second, right)], [(ball, left), (wall, right)]),
        ([(second, left), (first, right)], [(wall, left), (ball, right)]),
        ([(first, left), (second, right), (first, right)], [(ball, right), (ball, left)]),
        ([(second, right)], []),
        ([], [(wall, left)]),
        ([(first, left), (second, right)], [(ball, left), (wall, right)]),
    ):
        scene = ls.Scene([ls.SplatInstance(*s) for s in splats], [ls.MeshInstance(*m) for m in meshes])
        assert_equal(warm.render(scene, front_camera()), renderer_of(backend).render(scene, front_camera()))
    # The next image has another size. The size is smaller, so that a stale graph cannot write out of bounds.
    assert_equal(warm.render(scene, front_camera(40, 30)), renderer_of(backend).render(scene, front_camera(40, 30)))


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_sh_colours_of_gaussians_rotate_with_their_instance(renderer: ls.Renderer, degree: int) -> None:
    """An instance rotated by R equals the unrotated one seen from a camera rotated by R^-1."""
    asset = random_gaussians(79, 120, degree, center=(0.0, 0.0, 0.0), extent=(1.2, 1.0, 1.0))
    turn = similarity((0.5, 1.0, 0.3), 1.3)
    camera = front_camera(camera_from_world=similarity(offset=(0.0, 0.0, 4.0)))
    turned = renderer.render(ls.Scene([ls.SplatInstance(asset, turn)]), camera)
    around = front_camera(camera_from_world=camera.camera_from_world @ turn)
    expected = renderer.render(ls.Scene([asset]), around)
    band = oracles.render(ls.Scene([asset]), around)["band"]
    assert_close_outside_band(turned.color, expected.color, band, atol=1e-4, name="color")
    if degree:
        assert np.abs(turned.color - renderer.render(ls.Scene([asset]), camera).color).max() > 0.05


@pytest.mark.parametrize("background", [(0.0, 0.0, 0.0), (0.2, 0.5, 1.0), None])
def test_rasterised_view_without_visible_objects_shows_only_the_background(
    backend: str, background: tuple[float, float, float] | None
) -> None:
    """Without visible objects there is no alpha, surface or normal."""
    renderer = renderer_of(backend, ls.RenderConfig(lighting=False, background=background))
    behind = random_gaussians(80, 20, center=(0.0, 0.0, -5.0))
    for scene in (ls.Scene(), ls.Scene([behind]), ls.Scene([], [quad(-3.0)]), ls.Scene([behind], [quad(-3.0)])):
        frame = renderer.render(scene, front_camera(33, 17))
        assert (frame.color == np.asarray(background or (0.0, 0.0, 0.0), np.float32)).all()
        assert (frame.alpha == 0.0).all() and np.isinf(frame.depth).all() and np.isinf(frame.depth_z).all()
        assert (frame.normal == 0.0).all()
        assert (frame.gaussian_index == -1).all() and (frame.instance_index == -1).all()


@pytest.mark.parametrize("name", ["instances", "meshes and splats", "many small"])
def test_background_colour_is_composited_under_a_transparent_frame_by_its_alpha(backend: str, name: str) -> None:
    """For any background, the frame is the transparent frame plus (1 - alpha) times the background."""
    case = next(case for case in cases() if case.name == name)
    transparent, over = (
        renderer_of(backend, ls.RenderConfig(background=b, lighting=False)).render(case.scene, case.camera)
        for b in (None, (0.3, 0.9, 0.6))
    )
    expected = transparent.color + (1.0 - transparent.alpha)[..., None] * np.array([0.3, 0.9, 0.6], np.float32)
    assert_close(over.color, expected, atol=1e-6)


def test_new_asset_is_uploaded_even_if_it_has_the_memory_address_of_a_freed_one(renderer: ls.Renderer) -> None:
    """A frame never shows the freed asset."""

    def mean_color(make: Callable[[float], ls.Scene], value: float) -> np.ndarray:
        return renderer.render(make(value), front_camera()).color.max(axis=(0, 1))

    for value in np.linspace(0.1, 0.9, 9):
        shown = mean_color(lambda v: ls.Scene([one_gaussian(opacity=0.99, scale=1.0, color=(v, v, v))]), value)
        assert shown == pytest.approx(0.99 * value, abs=1e-2)


def test_rasteriser_allocates_nothing_after_the_first_frame(renderer: ls.Renderer) -> None:
    """Later frames of the same size, or smaller, allocate nothing."""
    scene = full_scene()
    renderer.render(scene, front_camera(90, 70))
    settled = renderer._buffers.allocations
    for size in ((90, 70), (90, 70), (64, 48), (90, 70)):
        renderer.render(scene, front_camera(*size))
    assert renderer._buffers.allocations == settled


def test_memory_that_a_renderer_reports_is_at_least_that_of_its_assets_and_images(renderer: ls.Renderer) -> None:
    """The reported memory is at least that of assets and images, and little more than the allocations."""
    gaussians = random_gaussians(82, 5000, degree=3)
    frame = renderer.render(ls.Scene([gaussians]), front_camera(300, 200))
    assert frame.stats is not None
    assets = sum(getattr(gaussians, name).nbytes for name in ("means", "rotations_wxyz", "scales", "opacities", "sh"))
    images = 40 * 300 * 200
    splats = 64 * 5000
    assert assets + images + splats <= frame.stats.memory_bytes <= 4 * (assets + images + splats)


def test_tile_lists_too_short_for_a_frame_grow_so_that_it_loses_no_splat(renderer: ls.Renderer) -> None:
    """Splats that cover every tile exceed the first capacity of the lists; none is lost in this or the next frame."""
    layers = random_gaussians(81, 600, scale_range=(20.0, 30.0))
    means = np.column_stack([layers.means[:, :2], np.random.default_rng(0).permutation(np.linspace(2.5, 5.5, 600))])
    faint = ls.Gaussians(means, layers.rotations_wxyz, layers.scales, np.full(600, 0.01), layers.sh)
    camera = front_camera(150, 90, 140.0)
    frame = renderer.render(ls.Scene([faint]), camera)
    assert frame.stats is not None and frame.stats.pair_count > 50 * frame.stats.visible_count
    twin = oracles.render(ls.Scene([faint]), camera)
    assert_close_outside_band(frame.color, twin["color"], twin["tie"], atol=1e-3, name="color")
    renderer.render(ls.Scene([one_gaussian()]), front_camera())
    assert_equal(renderer.render(ls.Scene([faint]), camera), frame)
