"""Intersects rays with meshes in float64, and continues them at smooth materials, as part of the ray tracing oracle.

Triangles are intersected by Moeller and Trumbore (1997). Dielectrics use Fresnel's equations and Snell's law, metals
Schlick (1994). ``Ray`` also carries bounds on its deviation in float32.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lumisplat.math.color import encode_srgb
from lumisplat.scene.materials import MaterialPbr
from lumisplat.scene.scene import MeshInstance, Scene
from support.oracles.raster_oracle import base_color, mesh_normal, normalized

ROUNDING = 2.0**-22
"""Relative error of a coordinate in float32 after a few operations."""


@dataclass(frozen=True)
class Ray:
    """A ray in world space."""

    origin: np.ndarray  # (3,)
    direction: np.ndarray  # (3,), unit
    t_min: float = 0.0  # Hits at this distance or closer are ignored.
    path_length: float = 0.0  # Length of the path before the origin.
    spread: float = 0.0  # Width of the pixel over the length of the path.
    left: int = -1  # Triangle at the origin, which the ray cannot hit.
    blur: float = 0.0  # Largest error of the origin in float32.
    turn: float = ROUNDING  # Largest error of the direction in float32, radians.

    @property
    def eye(self) -> np.ndarray:
        """Start of the path if it had been straight, shape (3,)."""
        return self.origin - self.path_length * self.direction

    def at(self, t: float) -> np.ndarray:
        """Returns the point at distance ``t``, shape (3,)."""
        return self.origin + t * self.direction


@dataclass(frozen=True)
class Triangles:
    """All triangles of a scene in world space."""

    instances: tuple[MeshInstance, ...]
    corners: np.ndarray  # (F, 3, 3)
    outward: np.ndarray  # (F, 3), unit, towards the material's outside
    instance: np.ndarray  # (F,), among the mesh instances
    face: np.ndarray  # (F, 3), vertices of its mesh
    doubled_area: np.ndarray  # (F,)
    longest: np.ndarray  # (F,), length of the longest side
    size: np.ndarray  # (F,), largest coordinate


@dataclass(frozen=True)
class MeshHit:
    """Closest triangle on a ray."""

    t: float
    triangle: int  # -1: none
    weights: np.ndarray  # (3,), barycentric
    error: float  # Largest error of t in float32.
    doubtful: bool  # True if float32 may find another triangle.


@dataclass(frozen=True)
class Branch:
    """A ray that continues from a smooth surface."""

    weight: np.ndarray  # (3,), weight of the ray's colour, display-referred
    ray: Ray


def triangles_of(scene: Scene) -> Triangles:
    """Returns the world-space triangles of all mesh instances; mirroring transforms keep the outside outside."""
    corners, outward, number, face = [np.zeros((0, 3, 3))], [np.zeros((0, 3))], [], [np.zeros((0, 3), int)]
    for i, instance in enumerate(scene.meshes):
        linear = instance.transform[:3, :3]
        world = instance.mesh.positions.astype(np.float64) @ linear.T + instance.transform[:3, 3]
        corners.append(world[instance.mesh.indices])
        a, b, c = corners[-1].swapaxes(0, 1)
        outward.append(np.sign(np.linalg.det(linear)) * normalized(np.cross(b - a, c - a)))
        number += [i] * len(a)
        face.append(instance.mesh.indices)
    every = np.concatenate(corners)
    a, b, c = every.swapaxes(0, 1)
    return Triangles(
        instances=scene.meshes,
        corners=every,
        outward=np.concatenate(outward),
        instance=np.array(number, int),
        face=np.concatenate(face),
        doubled_area=np.linalg.norm(np.cross(b - a, c - a), axis=-1),
        longest=np.linalg.norm([b - a, c - b, a - c], axis=-1).max(axis=0),
        size=np.abs(every).max(axis=(1, 2)),
    )


def nearest(triangles: Triangles, ray: Ray) -> MeshHit:
    """Returns the closest triangle beyond ``t_min``, hit from either side."""
    if not len(triangles.face):
        return MeshHit(np.inf, -1, np.zeros(3), 0.0, False)
    a, b, c = triangles.corners.swapaxes(0, 1)
    edge1, edge2, from_a = b - a, c - a, ray.origin - a
    p, q = np.cross(ray.direction, edge2), np.cross(from_a, edge1)
    det = (edge1 * p).sum(axis=-1)  # Twice the area, times the cosine.
    usable = (np.abs(det) > 1e-300) & (np.arange(len(det)) != ray.left)
    inverse = np.divide(1.0, det, out=np.zeros_like(det), where=usable)
    u, v, t = (from_a * p).sum(axis=-1) * inverse, q @ ray.direction * inverse, (edge2 * q).sum(axis=-1) * inverse
    weights = np.stack([1.0 - u - v, u, v], axis=-1)
    least = weights.min(axis=-1)

    off = ray.blur + ray.turn * np.linalg.norm(from_a, axis=-1) + ROUNDING * triangles.size
    error = off * triangles.doubled_area * np.abs(inverse)
    edge_error = off * triangles.longest * np.abs(inverse)

    inside = usable & (least >= 0.0) & (t > ray.t_min)
    best = int(np.where(inside, t, np.inf).argmin())
    found = bool(inside[best])
    t_best = t[best] if found else np.inf
    ahead = usable & (t > ray.t_min - error) & (t < t_best + error + (error[best] if found else 0.0))
    unsure = ahead & ((np.abs(least) <= edge_error) | (inside & (np.arange(len(t)) != best)))
    unsure |= ahead & (least >= 0.0) & (np.abs(t - ray.t_min) <= error)
    return MeshHit(
        float(t_best), best if found else -1, weights[best], float(error[best]) if found else 0.0, bool(unsure.any())
    )


@dataclass(frozen=True)
class Facet:
    """Surface at a mesh hit."""

    instance: int  # Among the mesh instances.
    material: MaterialPbr
    base: np.ndarray  # (3,), linear base colour
    normal: np.ndarray  # (3,), unit, shading, towards the viewer
    side: np.ndarray  # (3,), unit, of the triangle itself, towards the viewer
    inside: bool  # True if the ray comes from inside the body.
    curvature: float  # Largest change of the normal, radians per length.
    doubtful: bool  # True if float32 may hit the other side.

    @property
    def color(self) -> np.ndarray:
        """Display-referred base colour, shape (3,)."""
        return encode_srgb(self.base)


def facet(triangles: Triangles, ray: Ray, hit: MeshHit) -> Facet:
    """Returns the surface at a hit."""
    number, face = int(triangles.instance[hit.triangle]), triangles.face[hit.triangle]
    instance, corners = triangles.instances[number], triangles.corners[hit.triangle]
    mesh = instance.mesh
    normal = mesh_normal(instance, face, corners, hit.weights[None], ray.direction[None])[0]
    outward = triangles.outward[hit.triangle]
    inside = bool(outward @ ray.direction > 0.0)
    assert isinstance(mesh.material, MaterialPbr)
    curvature = 0.0
    if mesh.normals is not None:
        ends = normalized(mesh.normals[face].astype(np.float64) @ np.linalg.inv(instance.transform[:3, :3]))
        sides = np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=-1)
        doubled_area = np.linalg.norm(np.cross(corners[1] - corners[0], corners[2] - corners[0]))
        curvature = np.linalg.norm(ends - np.roll(ends, 1, axis=0), axis=-1).max() * sides.max() / doubled_area
    return Facet(
        instance=number,
        material=mesh.material,
        base=base_color(mesh, face, hit.weights[None])[0],
        normal=normal,
        side=-outward if inside else outward,
        inside=inside,
        curvature=float(curvature),
        doubtful=bool(min(abs(outward @ ray.direction), abs(normal @ ray.direction)) < 1e-4),
    )


# --- Smooth surfaces ---


def fresnel(cosine: float, relative_ior: float) -> tuple[float, float]:
    """Returns reflectance of unpolarised light and the cosine beyond the surface; (1, 0) at total internal reflection.

    ``relative_ior`` is the index on the ray's side over the index on the other side.
    """
    sine2 = relative_ior**2 * (1.0 - cosine**2)
    if sine2 >= 1.0:
        return 1.0, 0.0
    beyond = np.sqrt(1.0 - sine2)
    across = (relative_ior * cosine - beyond) / (relative_ior * cosine + beyond)
    along = (relative_ior * beyond - cosine) / (relative_ior * beyond + cosine)
    return float(0.5 * (across**2 + along**2)), float(beyond)


def schlick(base: np.ndarray, cosine: float) -> np.ndarray:
    """Returns the reflectance of a metal with linear reflectance ``base`` at normal incidence, shape (3,)."""
    return base + (1.0 - base) * (1.0 - cosine) ** 5


def reflected(direction: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Mirrors a direction at a normal."""
    return normalized(direction - 2.0 * (direction @ normal) * normal)


def refracted(direction: np.ndarray, normal: np.ndarray, relative_ior: float, beyond: float) -> np.ndarray:
    """Refracts a direction by Snell's law; ``beyond`` is the cosine on the other side."""
    along = direction - (direction @ normal) * normal
    return normalized(relative_ior * along - beyond * normal)


def mirror_normal(surface: Facet, direction: np.ndarray, relative_ior: float) -> tuple[np.ndarray, bool]:
    """Returns the shading normal, or the triangle's normal if the shading normal sends a ray to the wrong side.

    Also returns whether float32 may decide otherwise.
    """
    normal = surface.normal if surface.normal @ surface.side >= 0.0 else -surface.normal
    cosine = -float(direction @ normal)
    margins = [cosine, float(reflected(direction, normal) @ surface.side)]
    if surface.material.transmission > 0.0 and cosine > 0.0:
        _, beyond = fresnel(min(cosine, 1.0), relative_ior)
        if beyond > 0.0:
            margins.append(-float(refracted(direction, normal, relative_ior, beyond) @ surface.side))
    return normal if min(margins) > 0.0 else surface.side, min(np.abs(margins)) < 1e-4


def branches(surface: Facet, ray: Ray, hit: MeshHit) -> tuple[np.ndarray, list[Branch], bool]:
    """Returns a smooth surface's own colour (display-referred), its branches, and whether rounding may change them.

    Materials without transmission have no inside: both sides face air.
    """
    material = surface.material
    relative_ior = material.ior if surface.inside and material.transmission > 0.0 else 1.0 / material.ior
    normal, doubtful = mirror_normal(surface, ray.direction, relative_ior)
    cosine = min(-float(ray.direction @ normal), 1.0)
    reflectance, beyond = fresnel(cosine, relative_ior)
    if beyond > 0.0:
        reflectance *= material.specular
    metallic = material.mesh_metallic
    passing = (1.0 - metallic) * (1.0 - reflectance) * surface.color
    mirrored = metallic * encode_srgb(schlick(surface.base, cosine)) + (1.0 - metallic) * reflectance

    # Branches start slightly off the surface.
    blur = hit.error + ray.blur + ray.turn * hit.t + 16.0 * ROUNDING * np.abs(ray.at(hit.t)).max()
    turn = ray.turn + ROUNDING + 2.0 * surface.curvature * blur

    def onward(direction: np.ndarray, turn: float) -> Ray:
        return Ray(ray.at(hit.t), direction, 0.0, ray.path_length + hit.t, ray.spread, hit.triangle, blur, turn)

    out = [Branch(mirrored, onward(reflected(ray.direction, normal), turn))]
    if beyond > 0.0:
        through = refracted(ray.direction, normal, relative_ior, beyond)
        out.append(Branch(passing * material.transmission, onward(through, turn * max(1.0, relative_ior / beyond))))
    flat = passing * (1.0 - material.transmission)
    return flat, [branch for branch in out if branch.weight.max() > 0.0], doubtful or surface.doubtful
