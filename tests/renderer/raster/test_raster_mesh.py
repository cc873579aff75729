"""Triangles alone, and splats in front of, behind and across them."""

from __future__ import annotations

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.math.color import decode_srgb, encode_srgb
from support.compare.backends import renderer_of
from support.compare.images import assert_close
from support.oracles import raster_oracle as oracles
from support.scenes.raster_scenes import (
    checker_quad,
    front_camera,
    octahedron,
    one_gaussian,
    quad,
    random_gaussians,
    rotation,
)

GREY = ls.MaterialPbr(base_color=(0.5, 0.25, 0.1))


@pytest.fixture
def renderer(backend: str) -> ls.Renderer:
    """Returns a renderer without headlight, which shows the unlit colours of meshes."""
    return renderer_of(backend, ls.RenderConfig(lighting=False))


def plane_depth(camera: ls.Camera, point: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Returns the view depth at which each pixel's ray hits a plane in camera space, shape (H, W)."""
    return (point @ normal) / (oracles.pixel_rays(camera) @ normal)


def test_unlit_mesh_shows_its_srgb_encoded_base_colour(renderer: ls.Renderer) -> None:
    """The mesh is opaque."""
    frame = renderer.render(ls.Scene([], [quad(3.0, 9.0, material=GREY)]), front_camera())
    assert_close(frame.color, np.broadcast_to(encode_srgb([0.5, 0.25, 0.1]), (48, 64, 3)), atol=1e-5)
    assert (frame.alpha == 1.0).all() and (frame.instance_index == 0).all() and (frame.gaussian_index == -1).all()


def test_texture_of_a_mesh_without_uv_coordinates_is_ignored(renderer: ls.Renderer) -> None:
    """A texture does not change a mesh without texture coordinates."""
    material = ls.MaterialPbr(base_color=(0.5, 0.25, 0.1), base_color_texture=np.zeros((2, 2, 3), np.uint8))
    frame = renderer.render(ls.Scene([], [quad(3.0, 9.0, material=material)]), front_camera())
    assert_close(frame.color, np.broadcast_to(encode_srgb([0.5, 0.25, 0.1]), (48, 64, 3)), atol=1e-5)


def test_rasterised_depth_and_normal_of_a_tilted_plane_are_exact(renderer: ls.Renderer) -> None:
    """Depth is exact at every pixel centre of a steep plane, and the normal is that of the plane."""
    frame = renderer.render(ls.Scene([], [quad(9.0, 6.0, tilt=1.3)]), front_camera())
    normal = np.array([1.3, 0.0, -1.0])
    expected = plane_depth(front_camera(), np.array([0.0, 0.0, 9.0]), normal)
    seen = frame.alpha > 0.0
    assert seen.mean() > 0.4
    assert_close(frame.depth_z[seen] / expected[seen], np.ones(seen.sum()), atol=2e-5)
    assert_close(frame.normal[seen], np.broadcast_to(normal / np.hypot(1.3, 1.0), (seen.sum(), 3)), atol=1e-5)


def crumpled_plane(count: int, half: float, normal: np.ndarray) -> ls.Mesh:
    """Returns a plane through (0, 0, 10) cut into irregular triangles."""
    rng = np.random.default_rng(0)
    y, x = (np.mgrid[:count, :count] + rng.uniform(-0.3, 0.3, (2, count, count))) / (count - 1) * 2.0 - 1.0
    x, y = half * x, half * y
    z = 10.0 - (normal[0] * x + normal[1] * y) / normal[2]
    corner = (np.arange(count - 1)[:, None] * count + np.arange(count - 1)).reshape(-1, 1)
    faces = np.concatenate([np.add(corner, [0, 1, count]), np.add(corner, [1, count + 1, count])])
    return ls.Mesh(np.stack([x, y, z], axis=-1).reshape(-1, 3), faces)


@pytest.mark.parametrize("count", [300, pytest.param(1200, marks=pytest.mark.deep)])
def test_pixel_sized_far_triangles_have_exact_depth_and_leave_no_gaps(renderer: ls.Renderer, count: int) -> None:
    """Triangles of a pixel and less, far from the eye, have the depth of their plane and cover every pixel."""
    normal = np.array([0.5, -0.3, -1.0])
    frame = renderer.render(ls.Scene([], [crumpled_plane(count, 30.0, normal)]), front_camera(200, 150, 140.0))
    expected = plane_depth(frame.camera, np.array([0.0, 0.0, 10.0]), normal)
    assert (frame.alpha == 1.0).all()
    assert_close(frame.depth_z / expected, np.ones((150, 200)), atol=2e-5)


@pytest.mark.parametrize("near", [0.01, 0.5, 2.0])
def test_rasterised_triangles_are_clipped_at_the_near_plane(renderer: ls.Renderer, near: float) -> None:
    """A floor from behind the camera to the horizon is visible exactly from the near plane on."""
    floor = ls.Mesh([[-500, 1, -500], [500, 1, -500], [500, 1, 900], [-500, 1, 900]], np.array([[0, 1, 2], [0, 2, 3]]))
    camera = front_camera(focal=20.0, near=near)
    frame = renderer.render(ls.Scene([], [floor]), camera)
    with np.errstate(divide="ignore"):
        depth = plane_depth(camera, np.array([0.0, 1.0, 0.0]), np.array([0.0, 1.0, 0.0]))
    seen = (depth > near) & (depth < 900.0)
    np.testing.assert_array_equal(frame.alpha == 1.0, seen)
    assert_close(frame.depth_z[seen] / depth[seen], np.ones(seen.sum()), atol=1e-4)


@pytest.mark.parametrize("seed", range(4))
def test_rasterised_grid_of_triangles_has_no_cracks(renderer: ls.Renderer, seed: int) -> None:
    """A crumpled grid of triangles over the image covers every pixel, on either side of the triangles' edges."""
    rng = np.random.default_rng(seed)
    count = 24
    y, x = np.mgrid[:count, :count] / (count - 1) * 2.0 - 1.0
    inner = (np.abs(x) < 1.0) & (np.abs(y) < 1.0)
    jitter = 0.03 * rng.normal(size=(3, count, count)) * inner
    points = np.stack([5.0 * x + jitter[0], 5.0 * y + jitter[1], 4.0 + 3.0 * jitter[2]], axis=-1).reshape(-1, 3)
    corner = (np.arange(count - 1)[:, None] * count + np.arange(count - 1)).reshape(-1, 1)
    faces = np.concatenate([np.add(corner, [0, 1, count]), np.add(corner, [1, count + 1, count])])
    camera = front_camera(90, 70, 70.0, camera_from_world=rotation((0, 0, 1), 0.3 * seed))
    frame = renderer.render(ls.Scene([], [ls.Mesh(points, rng.permutation(faces))]), camera)
    assert np.count_nonzero(frame.alpha < 1.0) == 0


def test_triangle_edges_at_pixel_centres_leave_no_holes(renderer: ls.Renderer) -> None:
    """Every pixel whose centre is on an edge or a vertex belongs to some triangle."""
    ticks = (np.arange(0, 65, 8) - 32 + 0.5) / 60.0 * 4.0
    x, y = np.meshgrid(ticks, ticks)
    points = np.stack([x, y, np.full_like(x, 4.0)], axis=-1).reshape(-1, 3)
    corner = (np.arange(8)[:, None] * 9 + np.arange(8)).reshape(-1, 1)
    mesh = ls.Mesh(points, np.concatenate([np.add(corner, [0, 1, 10]), np.add(corner, [0, 10, 9])]))
    frame = renderer.render(ls.Scene([], [mesh]), front_camera(64, 64))
    assert (frame.alpha[1:, 1:] == 1.0).all()


def test_nearest_of_intersecting_meshes_is_visible_in_any_list_order(renderer: ls.Renderer) -> None:
    """Each pixel shows the nearer mesh in any order of the list of meshes."""
    tilted, flat = quad(4.0, tilt=0.8), quad(4.1, 0.9)
    one = renderer.render(ls.Scene([], [tilted, flat]), front_camera())
    two = renderer.render(ls.Scene([], [flat, tilted]), front_camera())
    np.testing.assert_array_equal(one.depth, two.depth)
    np.testing.assert_array_equal(
        one.instance_index[one.instance_index >= 0], 1 - two.instance_index[two.instance_index >= 0]
    )
    assert set(np.unique(one.instance_index)) == {-1, 0, 1}


def test_both_sides_of_a_triangle_are_drawn_with_the_normal_towards_the_viewer(renderer: ls.Renderer) -> None:
    """Winding order and mirrored instances do not matter."""
    mesh = quad(4.0, tilt=0.5)
    turned = ls.Mesh(mesh.positions, mesh.indices[:, ::-1])
    mirrored = ls.MeshInstance(ls.Mesh(mesh.positions * [-1.0, 1.0, 1.0], mesh.indices), np.diag([-1.0, 1.0, 1.0, 1.0]))
    expected = renderer.render(ls.Scene([], [mesh]), front_camera())
    for other in (turned, mirrored):
        frame = renderer.render(ls.Scene([], [other]), front_camera())
        assert_close(frame.color, expected.color, atol=1e-6)
        assert_close(frame.normal, expected.normal, atol=1e-6)
    seen = expected.alpha > 0.0
    assert (np.einsum("hwc,hwc->hw", expected.normal, oracles.pixel_rays(front_camera()))[seen] < 0.0).all()


def test_shading_normals_of_a_stretched_mesh_use_the_inverse_transpose(renderer: ls.Renderer) -> None:
    """Shading normals of a stretched ball are those of the ellipsoid."""
    stretch = np.diag([2.0, 1.0, 0.5, 1.0])
    placed = np.eye(4)
    placed[:3, 3] = (0.0, 0.0, 6.0)
    frame = renderer.render(
        ls.Scene([], [ls.MeshInstance(octahedron((0, 0, 0), 1.0), placed @ stretch)]), front_camera()
    )
    y, x = 27, 38
    point = oracles.pixel_rays(front_camera())[y, x] * frame.depth_z[y, x] - (0.0, 0.0, 6.0)
    local = point / [2.0, 1.0, 0.5]
    expected = local / [2.0, 1.0, 0.5]
    assert frame.normal[y, x] == pytest.approx(expected / np.linalg.norm(expected), abs=1e-3)


def test_texture_coordinates_start_at_the_top_left_as_in_gltf(renderer: ls.Renderer) -> None:
    """(0, 0) is the texture's top left corner, u runs right and v down; texel centres show the exact texels."""
    texture = np.arange(4 * 4 * 3, dtype=np.uint8).reshape(4, 4, 3) * 5
    material = ls.MaterialPbr(base_color=(1.0, 1.0, 1.0), base_color_texture=texture)
    mesh = quad(1.0, 2.0, uvs=[[0, 0], [1, 0], [1, 1], [0, 1]], material=material)
    frame = renderer.render(ls.Scene([], [mesh]), front_camera(4, 4, 1.0))
    np.testing.assert_array_equal(np.round(frame.color * 255.0).astype(int), texture)


def test_texture_repeats_outside_0_to_1_and_multiplies_linear_colours(renderer: ls.Renderer) -> None:
    """Coordinates outside 0..1 wrap; base colour and vertex colours multiply in linear light."""
    texture = np.random.default_rng(1).integers(0, 256, (4, 4, 4), dtype=np.uint8)
    material = ls.MaterialPbr(base_color=(0.8, 0.5, 0.3), base_color_texture=texture)
    uvs = np.add([[0, 0], [1, 0], [1, 1], [0, 1]], (-3.0, 7.0))
    mesh = quad(1.0, 2.0, uvs=uvs, colors=np.full((4, 3), 0.6), material=material)
    frame = renderer.render(ls.Scene([], [mesh]), front_camera(4, 4, 1.0))
    expected = encode_srgb(decode_srgb(texture[..., :3] / 255.0) * [0.8, 0.5, 0.3] * 0.6)
    assert_close(frame.color, expected, atol=1e-4)


def test_texture_of_a_receding_floor_is_perspective_correct(renderer: ls.Renderer) -> None:
    """The midline of the texture is at half the distance along the floor, not at half of its image."""
    texture = np.zeros((64, 1, 3), np.uint8)
    texture[32:] = 255
    material = ls.MaterialPbr(base_color=(1.0, 1.0, 1.0), base_color_texture=texture)
    floor = ls.Mesh(
        [[-9, 1, 1], [9, 1, 1], [9, 1, 9], [-9, 1, 9]],
        np.array([[0, 1, 2], [0, 2, 3]]),
        uvs=[[0, 0], [1, 0], [1, 1], [0, 1]],
        material=material,
    )
    frame = renderer.render(ls.Scene([], [floor]), front_camera(8, 400, 100.0, cy=0.0))
    column = frame.color[:, 4, 0]
    depth = 100.0 / (np.arange(400) + 0.5)
    assert (column[(depth > 5.2) & (depth < 8.8)] > 0.999).all()
    assert (column[(depth > 1.2) & (depth < 4.8)] < 0.001).all()


def test_splats_behind_a_mesh_do_not_change_the_frame(renderer: ls.Renderer) -> None:
    """The bits are equal with and without the splats."""
    wall = quad(2.0, 3.0, material=GREY)
    alone = renderer.render(ls.Scene([], [wall]), front_camera())
    frame = renderer.render(ls.Scene([random_gaussians(95)], [wall]), front_camera())
    for name in ("color", "alpha", "depth", "normal"):
        np.testing.assert_array_equal(getattr(frame, name), getattr(alone, name))


def test_mesh_behind_splats_is_composited_with_their_transmittance(renderer: ls.Renderer) -> None:
    """The colour is that of the splats plus their transmittance times the colour of the mesh."""
    gaussians = random_gaussians(96)
    splats = renderer.render(ls.Scene([gaussians]), front_camera())
    frame = renderer.render(ls.Scene([gaussians], [quad(9.0, 9.0, material=GREY)]), front_camera())
    expected = splats.color + (1.0 - splats.alpha)[..., None] * encode_srgb([0.5, 0.25, 0.1])
    assert_close(frame.color, expected, atol=1e-5)
    reached = splats.gaussian_index >= 0
    np.testing.assert_array_equal(frame.gaussian_index, splats.gaussian_index)
    np.testing.assert_array_equal(frame.depth[reached], splats.depth[reached])
    assert_close(frame.depth_z[~reached], np.full((~reached).sum(), 9.0), atol=1e-4)


def test_mesh_that_passes_through_a_splat_hides_one_half_of_it_and_is_behind_the_other(renderer: ls.Renderer) -> None:
    """The mesh passes through the depth of the splat."""
    splat = one_gaussian((0.0, 0.0, 4.0), 0.5, 0.5, color=(1.0, 1.0, 1.0))
    frame = renderer.render(ls.Scene([splat], [quad(4.0, 3.0, tilt=0.5, material=GREY)]), front_camera())
    grey = encode_srgb([0.5, 0.25, 0.1])
    assert frame.color[24, 26] == pytest.approx(grey, abs=1e-5)  # The mesh is nearer on the left.
    weight = 0.5 * np.exp(-0.5 * (5.5**2 + 0.5**2) / ((60.0 * 0.5 / 4.0) ** 2 + 0.3))
    assert frame.color[24, 37] == pytest.approx(weight + (1.0 - weight) * grey, abs=1e-4)
    assert (frame.instance_index[24, 35], frame.instance_index[24, 26]) == (0, 1)


@pytest.mark.parametrize(("offset", "is_visible"), [(-1e-3, True), (1e-3, False)])
def test_splat_a_thousandth_of_a_unit_in_front_of_a_mesh_is_visible(
    renderer: ls.Renderer, offset: float, is_visible: bool
) -> None:
    """A splat a thousandth of a unit behind the mesh is hidden."""
    wall = quad(4.0, 9.0, material=GREY)
    frame = renderer.render(ls.Scene([one_gaussian((0.0, 0.0, 4.0 + offset), opacity=0.9)], [wall]), front_camera())
    assert (frame.gaussian_index[24, 32] == 0) == is_visible


@pytest.mark.parametrize(
    "points",
    [
        [[0, 0, 4], [1e-20, 0, 4], [0, 1e-20, 4]],
        [[-1, 0, 4], [0, 1e-9, 4], [1, 0, 4]],
        [[0, 0, 1], [0, 1e-9, 2], [0, 0, 3]],
        [[0, 0, 0], [1e-20, 0, 0], [0, 1e-20, 0]],
        [[1e-30, 0, 1e-30], [0, 1e-30, 1e-30], [0, 0, 1e-30]],
        [[1e30, 0, 1e30], [0, 1e30, 1e30], [-1e30, 0, 1e30]],
        [[1e19, 1e19, 1e19], [-1e19, 1e19, 1e19], [0, -1e19, 1e19]],
    ],
    ids=["point", "line", "through the eye", "at the eye", "tiny", "huge", "overflowing"],
)
def test_degenerate_and_huge_triangles_do_not_change_other_objects(
    renderer: ls.Renderer, points: list[list[float]]
) -> None:
    """Near-degenerate triangles, and sizes that overflow, keep every value finite and other objects unchanged."""
    wall = quad(5.0, 9.0, material=GREY)
    frame = renderer.render(ls.Scene([], [ls.Mesh(points, np.array([[0, 1, 2]])), wall]), front_camera())
    assert np.isfinite(frame.color).all() and np.isfinite(frame.normal).all() and (frame.alpha == 1.0).all()
    assert not np.isnan(frame.depth).any()
    assert (frame.instance_index == 1).mean() > 0.95


def test_two_instances_of_a_textured_mesh_look_the_same_together_as_separately(renderer: ls.Renderer) -> None:
    """The instances are in different positions."""
    mesh = checker_quad(0.0)
    left, right = np.eye(4), np.eye(4)
    left[:3, 3], right[:3, 3] = (-1.4, 0.0, 5.0), (1.4, 0.0, 5.0)
    both = renderer.render(ls.Scene([], [ls.MeshInstance(mesh, left), ls.MeshInstance(mesh, right)]), front_camera())
    for number, pose in enumerate((left, right)):
        alone = renderer.render(ls.Scene([], [ls.MeshInstance(mesh, pose)]), front_camera())
        here = both.instance_index == number
        assert here.sum() > 100
        np.testing.assert_array_equal(both.color[here], alone.color[here])


def test_mesh_wall_hides_splats_behind_it_and_changes_no_bit_of_splats_beside_it(renderer: ls.Renderer) -> None:
    """A wall over half of the image hides thousands of splats; the bits beside it are unchanged."""
    splats = random_gaussians(95, 3000, scale_range=(0.02, 0.1))
    camera = front_camera()
    open_view = renderer.render(ls.Scene([splats]), camera)
    wall = ls.Mesh([[0, -9, 1], [9, -9, 1], [9, 9, 1], [0, 9, 1]], [[0, 1, 2], [0, 2, 3]], material=GREY)
    walled = renderer.render(ls.Scene([splats], [wall]), camera)
    np.testing.assert_array_equal(walled.color[:, :32], open_view.color[:, :32])
    assert_close(walled.color[:, 32:], np.broadcast_to(encode_srgb([0.5, 0.25, 0.1]), (48, 32, 3)), atol=1e-5)
