"""Builds closed scenes of diffuse surfaces with known irradiance, as meshes and as Gaussians."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

import lumisplat as ls
from lumisplat.demo.shapes import sphere
from lumisplat.scene.ops.surface_points import face_areas_and_normals, stratified_points

Doubles = npt.NDArray[np.float64]


def diffuse(albedo: float, emitted: float = 0.0) -> ls.MaterialPbr:
    """Returns a purely diffuse material that may emit."""
    return ls.MaterialPbr(base_color=(albedo,) * 3, specular=0.0, roughness=1.0, emissive=(emitted,) * 3)


def ball(radius: float, material: ls.MaterialPbr, *, hollow: bool = False, rows: int = 48) -> ls.Mesh:
    """Returns a sphere around the origin; with ``hollow``, its triangles face inwards."""
    mesh = sphere(radius, rows=rows, columns=2 * rows)
    indices = mesh.indices[:, ::-1] if hollow else mesh.indices
    return ls.Mesh(mesh.positions, indices, material=material)


def as_splats(mesh: ls.Mesh, count: int | None = None) -> ls.SplatInstance:
    """Returns the surface of a mesh as relit diffuse Gaussians."""
    return ls.SplatInstance(ls.gaussians_from_mesh(mesh, count), material=ls.MaterialPbr(specular=0.0, roughness=1.0))


def quad(corner: npt.ArrayLike, u: npt.ArrayLike, v: npt.ArrayLike, material: ls.MaterialPbr) -> ls.Mesh:
    """Returns a parallelogram."""
    o, u, v = (np.asarray(x, np.float64) for x in (corner, u, v))
    return ls.Mesh(np.array([o, o + u, o + u + v, o + v]), np.array([[0, 1, 2], [0, 2, 3]]), material=material)


def cube_without_ceiling(material: ls.MaterialPbr) -> list[ls.Mesh]:
    """Returns the floor and the walls of the unit cube."""
    x, y, z = np.eye(3)
    walls = ((0 * x, x), (z, x), (0 * x, z), (x, z))
    return [quad(0 * x, x, z, material), *(quad(corner, along, y, material) for corner, along in walls)]


def wide_sheet(z: float, opacity: float, albedo: float) -> ls.SplatInstance:
    """Returns one flat Gaussian that is wide enough to have the same opacity everywhere in view."""
    gaussians = ls.Gaussians(
        means=np.array([[0.0, 0.0, z]]),
        rotations_wxyz=np.array([[1.0, 0.0, 0.0, 0.0]]),
        scales=np.array([[1e4, 1e4, 1e-4]]),
        opacities=np.array([opacity]),
        sh=np.zeros((1, 1, 3)),
        albedo=np.full((1, 3), albedo),
        normals=np.array([[0.0, 0.0, 1.0]]),
    )
    return ls.SplatInstance(gaussians, material=ls.MaterialPbr(specular=0.0, roughness=1.0))


def paths(scene: ls.Scene, camera: ls.Camera, samples: int, max_bounces: int, **changes: object) -> ls.Frame:
    """Renders a frame with the path tracer."""
    config = ls.RenderConfig(pipeline=ls.Pipeline.PATH, samples=samples, max_bounces=max_bounces)
    return ls.render(scene, camera, replace(config, **changes), device="cpu")


def assert_is(values: npt.NDArray[np.floating], truth: float, *, share: float = 0.01) -> None:
    """Asserts that the mean of pixel values with a common expectation is within four standard errors of the truth.

    Args:
        values: Independent values of any shape.
        truth: Expectation of the values.
        share: Largest standard error, relative to the truth; above it, the test is too noisy to prove anything.
    """
    error = values.std() / np.sqrt(values.size)
    assert error < share * truth, "the test is too noisy to show anything"
    assert abs(values.mean() - truth) < 4.0 * max(error, 2e-5 * truth), f"{values.mean()} +- {error}, expected {truth}"


def irradiance(frame: ls.Frame, albedo: float) -> Doubles:
    """Returns the irradiance at each pixel of a frame that shows only diffuse surfaces of one albedo."""
    values: Doubles = np.pi / albedo * frame.color[..., 1].astype(np.float64)
    return values


def area_of(mesh: ls.Mesh) -> float:
    """Returns the total area of a mesh's triangles."""
    areas, _ = face_areas_and_normals(mesh)
    return float(areas.sum())


def irradiance_over(
    scene: ls.Scene, meshes: Sequence[ls.Mesh], samples: int, max_bounces: int, count: int = 4096
) -> Doubles:
    """Returns incident irradiance at points spread evenly over diffuse meshes of the scene, shape (count,).

    Args:
        scene: Scene whose instances are not transformed.
        meshes: Meshes of the scene that get points, on their front sides.
        samples: Samples per ray.
        max_bounces: Largest number of bounces.
        count: Number of points.
    """
    rng = np.random.default_rng(1)
    shares = np.cumsum([area_of(mesh) for mesh in meshes])
    numbers = np.searchsorted(shares, (np.arange(count) + 0.5) / count * shares[-1])
    found: Doubles = np.empty(0)
    for number, mesh in enumerate(meshes):
        areas, normals = face_areas_and_normals(mesh)
        points = stratified_points(mesh, areas, int((numbers == number).sum()), rng)
        outwards = normals[points.faces]
        config = ls.RenderConfig(pipeline=ls.Pipeline.PATH, samples=samples, max_bounces=max_bounces, seed=number)
        hits = ls.trace_rays(scene, points.positions + 1e-4 * outwards, -outwards, config, device="cpu")
        material = mesh.material
        assert isinstance(material, ls.MaterialPbr)
        radiance = hits.radiance[:, 1].astype(np.float64) - material.emissive[1]
        found = np.concatenate([found, np.pi / material.mesh_color[1] * radiance])
    return found
