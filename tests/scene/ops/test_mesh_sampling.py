"""Gaussians sampled on a mesh have even density and the mesh's appearance; invalid arguments are refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

import lumisplat as ls
from lumisplat.constants import ALPHA_MAX, SH_C0
from lumisplat.demo import shapes
from lumisplat.demo.textures import marble
from lumisplat.math.color import decode_srgb, encode_srgb
from lumisplat.math.transforms import quaternions_from_matrices
from lumisplat.scene.ops.mesh_sampling import gaussians_from_mesh
from lumisplat.scene.ops.neighbours import cross_pairs, neighbour_pairs
from lumisplat.scene.ops.surface_points import crease_points
from support.kinds import present

COUNT = 3000


def rotations(gaussians: ls.Gaussians) -> np.ndarray:
    """Returns rotation matrices of the Gaussians' quaternions, shape (N, 3, 3)."""
    w, x, y, z = gaussians.rotations_wxyz.T.astype(np.float64)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def alpha_at(gaussians: ls.Gaussians, points: np.ndarray) -> np.ndarray:
    """Returns the combined opacity of all discs at points of their plane, viewed from straight above."""
    near = cross_pairs(points, gaussians.means, 4.0 * float(gaussians.scales.max()))
    step = points[near.first] - gaussians.means[near.second]
    local = np.einsum("ij,ijk->ik", step, rotations(gaussians)[near.second]) / gaussians.scales[near.second]
    response = np.exp(-0.5 * (local[:, :2] ** 2).sum(axis=1))
    alpha = np.minimum(ALPHA_MAX, gaussians.opacities[near.second] * response)
    return 1.0 - np.exp(np.bincount(near.first, np.log1p(-alpha), len(points)))


def square(count: int = COUNT) -> tuple[ls.Gaussians, float]:
    """Returns Gaussians sampled on a unit square in y = 0, and their mean spacing."""
    return gaussians_from_mesh(shapes.plane(1.0, 1.0), count), (1.0 / count) ** 0.5


def test_equal_seeds_sample_identical_gaussians_on_a_mesh_and_different_seeds_others() -> None:
    """The same seed gives identical arrays; another seed gives another set."""
    mesh = shapes.torus(rows=16, columns=32)
    one, same, other = (gaussians_from_mesh(mesh, 500, seed=seed) for seed in (1, 1, 2))
    for name in ("means", "rotations_wxyz", "scales", "sh"):
        np.testing.assert_array_equal(getattr(one, name), getattr(same, name))
    assert np.abs(one.means - other.means).max() > 0.1


@pytest.mark.parametrize("count", [1, 2, 17, 1000])
def test_mesh_is_sampled_with_exactly_the_requested_number_of_gaussians(count: int) -> None:
    """The number of Gaussians is exactly the requested one."""
    assert gaussians_from_mesh(shapes.icosphere(subdivisions=2), count).count == count


def test_default_number_of_sampled_gaussians_is_mesh_area_over_squared_spacing_in_any_unit() -> None:
    """The default spacing is 1/300 of the diagonal, whatever the mesh's unit."""
    mesh = shapes.torus(1.0, 0.05, rows=16, columns=48)
    diagonal, area = np.linalg.norm(np.ptp(mesh.positions, axis=0)), 4.0 * np.pi**2 * 0.05
    count = gaussians_from_mesh(mesh).count
    assert count == pytest.approx(area / (diagonal / 300.0) ** 2, rel=0.03)
    tiny = gaussians_from_mesh(shapes.transform_mesh(mesh, np.diag([1e-4, 1e-4, 1e-4, 1.0])))
    assert tiny.count == pytest.approx(count, abs=2)


def test_disc_gaussians_sampled_on_a_sphere_lie_flat_on_its_surface() -> None:
    """Means are on the surface, thin axes and normals are radial, discs are thin and opaque."""
    gaussians = gaussians_from_mesh(shapes.sphere(0.5), COUNT)
    radii = np.linalg.norm(gaussians.means, axis=1)
    assert (np.abs(radii - 0.5) < 0.002).all()
    outwards = gaussians.means / radii[:, None]
    assert gaussians.normals is not None
    assert np.einsum("ij,ij->i", gaussians.normals, outwards).min() > 0.999
    assert np.abs(np.einsum("ij,ij->i", rotations(gaussians)[:, :, 2], outwards)).min() > 0.999
    assert (gaussians.scales[:, 2] <= 0.051 * gaussians.scales[:, :2].max(axis=1)).all()
    assert gaussians.opacities.min() > 0.99


def test_disc_gaussians_sampled_on_a_mesh_lie_flat_in_its_faces_despite_smooth_normals() -> None:
    """On a cube with shared vertex normals, thin axes are face normals, while ``normals`` are the shading normals."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=np.float64)
    sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [face for a, b, c, d in sides for face in ((a, b, c), (a, c, d))]
    gaussians = gaussians_from_mesh(ls.Mesh(corners, faces, normals=corners / 3.0**0.5), 600)
    assert gaussians.normals is not None
    thin = np.abs(rotations(gaussians)[:, :, 2]).max(axis=1)
    assert (thin > 0.97).all()
    assert np.einsum("ij,ij->i", gaussians.normals, gaussians.means).min() > 0.9
    assert np.median(np.abs(gaussians.normals).max(axis=1)) < 0.95


def test_vertex_normals_of_zero_length_are_replaced_by_face_normals() -> None:
    """A mesh that fills missing normals with zeros is sampled like a mesh without normals."""
    plane = replace(shapes.plane(1.0, 1.0), normals=np.zeros((4, 3)))
    gaussians = gaussians_from_mesh(plane, 50)
    np.testing.assert_allclose(present(gaussians.normals), np.tile([0.0, 1.0, 0.0], (50, 1)), atol=1e-6)


def test_gaussians_sampled_on_a_mesh_are_never_close_together() -> None:
    """Nearest neighbours are never close; random points would come a hundred times nearer."""
    gaussians = gaussians_from_mesh(shapes.sphere(0.5), COUNT)
    spacing = (np.pi / COUNT) ** 0.5
    pairs = neighbour_pairs(gaussians.means, 1.2 * spacing)
    nearest = np.full(COUNT, 1.2 * spacing)
    np.minimum.at(nearest, pairs.first, pairs.distance)
    np.minimum.at(nearest, pairs.second, pairs.distance)
    assert nearest.min() > 0.55 * spacing
    assert np.median(nearest) > 0.75 * spacing


def test_density_of_gaussians_sampled_on_a_mesh_does_not_depend_on_triangle_sizes() -> None:
    """Counts in equal cells vary less than random ones, although the triangles of one half are 1600 times smaller."""
    fine = shapes.transform_mesh(shapes.plane(0.5, 1.0, segments=(20, 40)), translated(-0.25))
    coarse = shapes.transform_mesh(shapes.plane(0.5, 1.0), translated(0.25))
    gaussians = gaussians_from_mesh(shapes.join_meshes([fine, coarse]), 4000)
    cells, _, _ = np.histogram2d(gaussians.means[:, 0], gaussians.means[:, 2], bins=8, range=[[-0.5, 0.5]] * 2)
    chi2 = ((cells - 62.5) ** 2 / 62.5).sum()
    # Independent points give about 63 +- 11.
    assert chi2 < 20.0


def translated(x: float) -> np.ndarray:
    """Returns a translation along x."""
    matrix = np.eye(4)
    matrix[0, 3] = x
    return matrix


def test_gaussians_sampled_on_a_square_leave_no_holes_up_to_its_edge() -> None:
    """One layer of discs is nearly opaque inside, and mostly opaque at edges and corners."""
    gaussians, spacing = square()
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (20_000, 3)) * (1.0, 0.0, 1.0)
    alpha = alpha_at(gaussians, points)
    inside = np.abs(points).max(axis=1) < 0.5 - 0.5 * spacing
    assert np.percentile(alpha[inside], 1) > 0.995
    assert alpha[inside].min() > 0.88
    assert alpha[~inside].min() > 0.55


def test_disc_gaussians_sampled_on_a_mesh_hardly_extend_beyond_its_open_edges() -> None:
    """Opacity beyond the edge is mostly gone after one spacing, and zero after two and a half."""
    gaussians, spacing = square()
    along = np.linspace(-0.45, 0.45, 500)
    beyond = [alpha_at(gaussians, np.stack([0.5 + k * spacing + 0 * along, 0 * along, along], 1)) for k in (1.0, 2.5)]
    assert beyond[0].mean() < 0.4
    assert beyond[1].max() < 0.1


def test_gaussians_sampled_on_both_sides_of_a_thin_sheet_leave_no_gaps() -> None:
    """The sheet is thinner than the spacing, and each side is sampled independently of the other."""
    top = shapes.plane(1.0, 1.0)
    half_turn = np.diag([1.0, -1.0, -1.0, 1.0])
    half_turn[1, 3] = -1e-4
    bottom = shapes.transform_mesh(top, half_turn)
    gaussians = gaussians_from_mesh(shapes.join_meshes([top, bottom]), 2000)
    assert gaussians.normals is not None
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (2000, 3)) * (0.9, 0.0, 0.9)
    for side in (gaussians.normals[:, 1] > 0.0, gaussians.normals[:, 1] < 0.0):
        nearest = np.linalg.norm(points[:, None] - gaussians.means[side][None], axis=2).min(axis=1)
        assert nearest.max() < 1.1 * (1.0 / 1000) ** 0.5


def test_albedo_of_gaussians_sampled_on_a_mesh_is_base_vertex_and_texture_colour_product() -> None:
    """Albedo is the linear product at the Gaussian's uv, and SH its sRGB encoding."""
    v, u = np.mgrid[0:64, 0:64] / 63.0
    texture = np.round(255.0 * np.stack([0.2 + 0.6 * u, 0.3 + 0.5 * v, 0.5 + 0.0 * u], axis=-1)).astype(np.uint8)
    material = ls.MaterialPbr(base_color=(0.9, 0.8, 0.7), metallic=0.25, roughness=0.6, base_color_texture=texture)
    plane = shapes.plane(1.0, 1.0)
    mesh = replace(plane, material=material, colors=np.full((4, 3), 0.5, dtype=np.float32))
    gaussians = gaussians_from_mesh(mesh, 800)
    uv = gaussians.means[:, [0, 2]] + 0.5
    pixel = np.clip(uv * 64.0 - 0.5, 0.0, 63.0) / 63.0
    encoded = np.stack([0.2 + 0.6 * pixel[:, 0], 0.3 + 0.5 * pixel[:, 1], np.full(800, 0.5)], axis=1)
    expected = decode_srgb(encoded) * (0.9, 0.8, 0.7) * 0.5
    inner = np.abs(uv - 0.5).max(axis=1) < 0.45
    assert gaussians.albedo is not None
    np.testing.assert_allclose(gaussians.albedo[inner], expected[inner], atol=0.004)
    np.testing.assert_allclose(gaussians.sh[:, 0] * SH_C0 + 0.5, encode_srgb(gaussians.albedo), atol=1e-5)
    np.testing.assert_array_equal(gaussians.metallic, np.float32(0.25))
    np.testing.assert_array_equal(gaussians.roughness, np.float32(0.6))


def test_gaussians_of_a_simple_material_have_albedo_but_no_roughness() -> None:
    """Gaussians of a simple material have its colour only; their instance's material defines reflection."""
    material = ls.MaterialSimple(base_color=(0.9, 0.8, 0.7), diffuse=1.0)
    gaussians = gaussians_from_mesh(replace(shapes.plane(1.0, 1.0), material=material), 50)
    assert gaussians.roughness is None and gaussians.metallic is None
    np.testing.assert_allclose(present(gaussians.albedo), [(0.9, 0.8, 0.7)] * 50, atol=1e-6)


def textured(texture: np.ndarray) -> ls.Mesh:
    """Returns a unit square with a texture."""
    material = ls.MaterialPbr(base_color=(1.0, 1.0, 1.0), base_color_texture=texture)
    return replace(shapes.plane(1.0, 1.0), material=material)


def test_texels_smaller_than_the_gaussian_sampled_on_them_are_averaged_in_linear_light() -> None:
    """Black and white noise with hundreds of texels per Gaussian averages to 0.5; no texture side is a power of two."""
    noise = np.random.default_rng(0).integers(0, 2, (1000, 777, 1)).astype(np.uint8) * np.uint8(255)
    gaussians = gaussians_from_mesh(textured(np.repeat(noise, 3, axis=2)), COUNT)
    assert gaussians.albedo is not None
    assert abs(gaussians.albedo.mean() - 0.5) < 0.01
    assert gaussians.albedo.std() < 0.07


def test_texture_averaged_over_sampled_gaussians_is_neither_shifted_nor_recoloured() -> None:
    """An averaged ramp stays the same ramp, and a constant texture of any size keeps its colour."""
    ramp = np.round(255.0 * encode_srgb((np.arange(1001) + 0.5) / 1001.0)).astype(np.uint8)
    gaussians = gaussians_from_mesh(textured(np.tile(ramp[None, :, None], (3, 1, 3))), 200)
    u = gaussians.means[:, 0] + 0.5
    inner = np.abs(u - 0.5) < 0.4
    assert gaussians.albedo is not None
    np.testing.assert_allclose(gaussians.albedo[inner, 0], u[inner], atol=0.01)
    even = gaussians_from_mesh(textured(np.full((37, 101, 4), 188, np.uint8)), 50).albedo
    np.testing.assert_allclose(present(even), decode_srgb(np.full((50, 3), 188 / 255.0)), rtol=1e-5)


def test_sampling_skips_degenerate_triangles_of_a_mesh() -> None:
    """Triangles that are lines or points get no Gaussians."""
    positions = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [9.0, 9.0, 9.0], [2.0, 0.0, 0.0]]
    mesh = ls.Mesh(np.array(positions, np.float32), np.array([[3, 3, 3], [0, 1, 2], [0, 1, 4], [3, 0, 3]], np.int32))
    gaussians = gaussians_from_mesh(mesh, 300)
    assert gaussians.means.min() >= 0.0
    assert (gaussians.means.sum(axis=1) <= 1.0 + 1e-6).all()


def test_number_of_gaussians_sampled_along_the_edges_of_a_sliver_triangle_is_limited() -> None:
    """A triangle of nearly no area would need billions of points along its edges at its spacing."""
    sliver = ls.Mesh([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1e-11, 0.0]], [[0, 1, 2]])
    normal = np.array([[0.0, 0.0, 1.0]])
    assert 400 <= len(crease_points(sliver, normal, 1e-9, limit=1000).positions) <= 1003
    assert gaussians_from_mesh(sliver, 40).count == 40


def test_gaussians_from_mesh_refuses_invalid_counts_and_objects() -> None:
    """Counts below 1, fractional or too large counts, and arguments other than meshes are refused."""
    with pytest.raises(ls.SceneError, match="count is 0"):
        gaussians_from_mesh(shapes.plane(1.0, 1.0), 0)
    with pytest.raises(ls.SceneError, match=r"count is 10\.5, expected a whole number"):
        gaussians_from_mesh(shapes.plane(1.0, 1.0), 10.5)  # pyright: ignore[reportArgumentType]
    with pytest.raises(ls.SceneError, match="from 1 to 50000000"):
        gaussians_from_mesh(shapes.plane(1.0, 1.0), 10**12)
    with pytest.raises(ls.SceneError, match=r"takes a Mesh, got a Scene: give scene\.meshes\[0\]\.mesh"):
        gaussians_from_mesh(ls.Scene([], [shapes.plane(1.0, 1.0)]))  # pyright: ignore[reportArgumentType]
    with pytest.raises(ls.SceneError, match=r"takes a Mesh, got a MeshInstance: give its \.mesh"):
        gaussians_from_mesh(ls.MeshInstance(shapes.plane(1.0, 1.0)))  # pyright: ignore[reportArgumentType]


def test_creases_of_a_mesh_are_its_sharp_and_open_edges_and_no_others() -> None:
    """A cone's rim and a square's outline are creases; spheres and diagonals have none."""
    assert creases_of(shapes.icosphere(subdivisions=3)).size == 0
    assert creases_of(shapes.icosphere(subdivisions=1)).size == 0  # facets of 18 to 23 degrees
    outline = creases_of(shapes.plane(1.0, 1.0))
    assert np.allclose(np.abs(outline).max(axis=1), 0.5)
    assert len(outline) >= 4 / 0.02
    rim = creases_of(shapes.lathe([(0, 1), (0.5, 0), (0.5, 0), (0, 0)]))
    assert np.allclose(np.linalg.norm(rim, axis=1), 0.5, atol=1e-3)
    assert len(rim) >= np.pi / 0.02


def creases_of(mesh: ls.Mesh) -> np.ndarray:
    """Returns points every 2 cm along the mesh's creases."""
    corners = mesh.positions.astype(np.float64)[mesh.indices]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return crease_points(mesh, normals / np.linalg.norm(normals, axis=1, keepdims=True), 0.02, limit=10_000).positions


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 10_000))
def test_rotation_matrices_convert_to_quaternions_and_back(seed: int) -> None:
    """Any rotation, including half turns, survives conversion from matrix to quaternion and back."""
    rng = np.random.default_rng(seed)
    frames, _ = np.linalg.qr(rng.normal(size=(8, 3, 3)))
    frames *= np.linalg.det(frames)[:, None, None]
    half_turns = np.stack([np.diag(d) for d in ([1, -1, -1], [-1, 1, -1], [-1, -1, 1], [1, 1, 1])]).astype(float)
    axes = np.concatenate([frames, half_turns])
    one = np.ones(len(axes))
    quaternions = quaternions_from_matrices(axes)
    gaussians = ls.Gaussians(np.zeros((len(axes), 3)), quaternions, np.ones((len(axes), 3)), one, np.zeros((12, 1, 3)))
    np.testing.assert_allclose(rotations(gaussians), axes, atol=1e-5)


SHAPES = {
    "textured sphere": lambda: replace(
        shapes.sphere(0.5),
        material=ls.MaterialPbr(
            base_color=(1.0, 1.0, 1.0),
            base_color_texture=marble((0.7, 0.5, 0.3), (0.1, 0.1, 0.3), np.random.default_rng(0), cells=2),
        ),
    ),
    "cone with a rim": lambda: shapes.lathe([(0, 0.5), (0.5, -0.4), (0.5, -0.4), (0, -0.4)]),
    "knot": lambda: shapes.torus_knot(major=0.35, minor=0.15, radius=0.08),
}


@pytest.mark.parametrize("name", SHAPES)
def test_gaussians_sampled_on_a_mesh_render_like_the_mesh(name: str) -> None:
    """From all sides, the silhouette is opaque in the mesh's colour, and nothing shows far outside."""
    mesh = SHAPES[name]()
    gaussians = gaussians_from_mesh(mesh)
    renderer = ls.create_renderer(ls.RenderConfig(lighting=False), device="cpu")
    for eye in ([0.9, 0.5, 1.4], [-1.5, -0.2, 0.3], [0.1, 1.7, -0.2]):
        camera = ls.Camera.look_at(eye, [0.0, 0.0, 0.0], width=320, height=240, fov_y=0.7)
        solid, splats = (
            renderer.render(scene, camera) for scene in (ls.Scene(meshes=(mesh,)), ls.Scene(splats=(gaussians,)))
        )
        inside = shrunk(solid.alpha > 0.5, 2)
        assert splats.alpha[inside].min() > 0.985
        assert np.abs(splats.color - solid.color)[inside].mean() < 0.01
        # A pixel is about as wide as the spacing of Gaussians, and the rasteriser's dilation adds another pixel.
        assert splats.alpha[shrunk(solid.alpha < 0.5, 5)].max() < 0.05


def shrunk(mask: np.ndarray, steps: int) -> np.ndarray:
    """Returns the mask without pixels within ``steps`` of its border."""
    for _ in range(steps):
        mask = mask & np.roll(mask, 1, 0) & np.roll(mask, -1, 0) & np.roll(mask, 1, 1) & np.roll(mask, -1, 1)
    return mask


def test_rasteriser_dilation_widens_outlines_of_gaussians_from_meshes_by_under_20_percent() -> None:
    """Dilation by cameras enlarges a small ball's area by less than a fifth."""
    mesh = ls.sphere(1.0)
    camera = ls.Camera.look_at((0, 0, -8), (0, 0, 0), (0, 1, 0), width=48, height=48, fov_y=0.5)
    config = ls.RenderConfig(samples=16, jitter=True, background=(0.0, 0.0, 0.0))
    solid = ls.render(ls.Scene(meshes=[ls.MeshInstance(mesh)]), camera, config, device="cpu").alpha.sum()
    discs = ls.gaussians_from_mesh(mesh, 4000)
    covered = ls.render(ls.Scene(splats=[ls.SplatInstance(discs)]), camera, config, device="cpu").alpha.sum()
    assert discs.antialiased
    assert solid < covered < 1.2 * solid
