"""Reads OpenUSD meshes with their primvars and materials, and cubes, spheres and planes."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from lumisplat.errors import FormatError
from lumisplat.io.meshes.mesh_arrays import TriangleSieve, drop_textures_without_uvs, fan_triangles, flip_v
from lumisplat.io.usd.library import pxr
from lumisplat.io.usd.materials import GREY, ReadMaterial, UsdMaterials
from lumisplat.io.usd.stage import PlacedPrim, UsdFile, array, custom_data_of, number, rows, value, whole_numbers
from lumisplat.math.arrays import Flags, FloatArray, IntArray, Rows, read_only_view
from lumisplat.scene.materials import MaterialPbr
from lumisplat.scene.mesh import Mesh
from lumisplat.scene.ops.normals import smooth_normals
from lumisplat.scene.primitives import box, plane, sphere
from lumisplat.scene.scene import MeshInstance

_OF_VERTICES = ("vertex", "varying")

_SHAPES = ("Cube", "Sphere", "Plane")


@dataclass(frozen=True, slots=True, eq=False)
class Attribute:
    """Values of an attribute or primvar of a mesh, with their USD interpolation."""

    values: FloatArray
    """Values as float32, shape (N, C): N values of C numbers, one for each element that ``interpolation`` names."""
    interpolation: str
    """USD interpolation: constant (one value), uniform (per face), vertex or varying (per vertex), faceVarying (per
    corner)."""
    label: str


@dataclass(slots=True)
class Polygons:
    """Polygons of a mesh with their attributes: V vertices, P faces and, over all faces, C corners."""

    path: object
    """Path of the file that holds the mesh, for error messages."""
    label: str
    positions: FloatArray
    """Vertex positions, shape (V, 3)."""
    counts: Rows
    """Number of corners of each face, shape (P,)."""
    indices: Rows
    """Vertex index of each corner, shape (C,)."""
    attributes: dict[str, Attribute] = field(default_factory=dict[str, Attribute])

    def __post_init__(self) -> None:
        if (self.counts < 0).any() or int(self.counts.sum()) != len(self.indices):
            raise FormatError(
                str(self.path),
                f"{self.label} has {len(self.indices):,} faceVertexIndices, expected {int(self.counts.sum()):,} "
                "by its faceVertexCounts",
            )

    def add(self, name: str, attribute: Attribute | None) -> None:
        """Adds an attribute; does nothing if ``attribute`` is None.

        Raises:
            FormatError: The attribute has fewer values than its interpolation needs.
        """
        if attribute is None:
            return
        needed = self._needed(attribute.interpolation)
        if len(attribute.values) < needed:
            raise FormatError(
                str(self.path),
                f"{attribute.label} has {len(attribute.values):,} values, expected {needed:,} "
                f"({attribute.interpolation or 'no'} interpolation)",
            )
        self.attributes[name] = attribute

    def _needed(self, interpolation: str) -> int:
        """Returns how many values an attribute must have for its interpolation, such as one per face for "uniform"."""
        sizes = {"uniform": len(self.counts), "faceVarying": len(self.indices), "constant": 1}
        return sizes.get(interpolation, len(self.positions))

    def vertices(self) -> tuple[Rows, dict[str, FloatArray]]:
        """Returns the vertex index of each corner, shape (C,), and all attributes, including positions, by vertex.

        A vertex whose corners have different values is split into several vertices.
        """
        splitting = {
            name: a for name, a in self.attributes.items() if a.interpolation not in (*_OF_VERTICES, "constant")
        }
        arrays = {"positions": self.positions}
        for name, attribute in self.attributes.items():
            if attribute.interpolation == "constant":
                arrays[name] = np.repeat(attribute.values[:1], len(self.positions), axis=0)
            elif name not in splitting:
                arrays[name] = attribute.values[: len(self.positions)]
        inside = (self.indices >= 0) & (self.indices < len(self.positions))
        if not splitting or not len(self.indices):
            return np.where(inside, self.indices, -1), arrays
        corner_face = np.repeat(np.arange(len(self.counts)), self.counts)
        at_corners = {
            name: a.values[corner_face] if a.interpolation == "uniform" else a.values[: len(self.indices)]
            for name, a in splitting.items()
        }
        vertex = np.where(inside, self.indices, 0)
        keys = [vertex[:, None], *(np.ascontiguousarray(v, np.float32).view(np.int32) for v in at_corners.values())]
        _, first, merged = np.unique(np.concatenate(keys, axis=1), axis=0, return_index=True, return_inverse=True)
        arrays = {name: values[vertex[first]] for name, values in arrays.items()}
        arrays |= {name: np.asarray(values[first]) for name, values in at_corners.items()}
        return np.where(inside, merged.reshape(-1), -1), arrays


class UsdMeshes:
    """Reads the meshes of a USD file; a mesh is read once for all its instances.

    Args:
        file: The open file.
        materials: Materials of the file.
        sieve: Counts the unusable triangles.
    """

    def __init__(self, file: UsdFile, materials: UsdMaterials, sieve: TriangleSieve) -> None:
        self._file, self._materials, self._sieve = file, materials, sieve
        self._cache: dict[tuple[str, int], list[Mesh]] = {}

    @staticmethod
    def reads(prim: Any) -> bool:
        """Returns whether a prim is a mesh, or a cube, sphere or plane, which are read as meshes."""
        return str(prim.GetTypeName()) in ("Mesh", *_SHAPES)

    def instances(self, placed: PlacedPrim) -> list[MeshInstance]:
        """Returns the meshes of a prim as instances in world space, one for each of its materials."""
        bound = self._materials.bound_to(placed.prim)
        key = placed.asset, id(bound)
        if key not in self._cache:
            is_mesh = str(placed.prim.GetTypeName()) == "Mesh"
            self._cache[key] = self._read(placed, bound) if is_mesh else [self._shape(placed, bound)]
        catches = custom_data_of(placed.prim).get("shadow_catcher") is True
        at = placed.world_from_prim
        return [MeshInstance(mesh, at, name=placed.name, shadow_catcher=catches) for mesh in self._cache[key]]

    def _read(self, placed: PlacedPrim, bound: ReadMaterial | None) -> list[Mesh]:
        """Reads a mesh prim as one mesh for each material that its faces have; empty if it has no faces.

        Args:
            placed: The prim.
            bound: Material of the faces that no geometry subset contains; None if none is bound.
        """
        file, prim = self._file, placed.prim
        positions = array(file, prim, "points", 3)
        counts, indices = whole_numbers(file, prim, "faceVertexCounts"), whole_numbers(file, prim, "faceVertexIndices")
        if positions is None or not len(counts):
            return []
        meshes: list[Mesh] = []
        for faces, material in self._groups(prim, len(counts), bound):
            polygons = Polygons(file.path, str(prim.GetPath()), positions, counts, indices)
            mesh = self._group(placed, polygons, faces, material)
            if mesh is not None:
                meshes.append(mesh)
        return meshes

    def _groups(self, prim: Any, count: int, bound: ReadMaterial | None) -> list[tuple[Flags, ReadMaterial | None]]:
        """Returns the materials of a mesh prim, each with a mask of the faces that have it, shape (faces,).

        Geometry subsets with a material come first, then all other faces, which have the material ``bound``. Holes are
        left out.

        Args:
            prim: The mesh prim.
            count: Number of faces.
            bound: Material of the whole prim; None if none is bound.
        """
        ungrouped = np.ones(count, bool)
        holes = whole_numbers(self._file, prim, "holeIndices")
        ungrouped[holes[(holes >= 0) & (holes < count)]] = False
        groups: list[tuple[Flags, ReadMaterial | None]] = []
        for subset in pxr().UsdShade.MaterialBindingAPI(prim).GetMaterialBindSubsets():
            numbers = whole_numbers(self._file, subset.GetPrim(), "indices")
            faces = np.zeros(count, bool)
            faces[numbers[(numbers >= 0) & (numbers < count)]] = True
            faces &= ungrouped
            ungrouped &= ~faces
            groups.append((faces, self._materials.bound_to(subset.GetPrim())))
        return [group for group in (*groups, (ungrouped, bound)) if group[0].any()]

    def _group(self, placed: PlacedPrim, polygons: Polygons, faces: Flags, read: ReadMaterial | None) -> Mesh | None:
        """Returns the faces of a mesh prim with one material as a mesh; None if none of their triangles is usable.

        Args:
            placed: The prim.
            polygons: Its polygons.
            faces: Mask of the faces, shape (P,) for P faces.
            read: Material of these faces; None without one.
        """
        file, prim = self._file, placed.prim
        subdivided = value(file, prim, "subdivisionScheme", "catmullClark") != "none"
        polygons.add("normals", _normals(file, prim))
        polygons.add("uvs", _primvar(file, prim, "st" if read is None else read.uv_transform.primvar, 2))
        # Meshes that Lumisplat wrote multiply textures by vertex colours, which UsdPreviewSurface cannot express.
        multiplies_colors = custom_data_of(prim).get("multipliesColors", False)
        colored = "displayColor" if read is None or multiplies_colors else read.color_primvar
        polygons.add("colors", _primvar(file, prim, colored, 3) if colored else None)
        corner_vertex, arrays = polygons.vertices()
        triangles = fan_triangles(polygons.counts)
        triangles = triangles[np.repeat(faces, np.maximum(polygons.counts - 2, 0))]
        if value(file, prim, "orientation", "rightHanded") == "leftHanded":
            triangles = triangles[:, ::-1]
        triangles = corner_vertex[triangles]
        triangles = triangles[self._sieve.usable(arrays["positions"], triangles)]
        if not len(triangles):
            return None
        if not faces.all():
            triangles, arrays = _used(triangles, arrays)
        material = MaterialPbr(base_color=(1.0,) * 3 if "colors" in arrays else (GREY,) * 3)
        if read is not None:
            material = self._materials.sided(read.material, prim)
            if "uvs" in arrays:
                arrays["uvs"] = flip_v(read.uv_transform.apply(arrays["uvs"]))
        if "colors" in arrays:
            arrays["colors"] = np.clip(arrays["colors"], 0.0, 1.0)
        attributes = {name: read_only_view(values) for name, values in arrays.items() if name != "positions"}
        mesh = Mesh(read_only_view(arrays["positions"]), triangles, material=material, name=placed.name, **attributes)
        if subdivided:
            file.remarks.add("subdivision surfaces, read as their control meshes", str(prim.GetPath()))
            mesh = mesh if mesh.normals is not None else smooth_normals(mesh, math.pi)
        return drop_textures_without_uvs(file.path, mesh)

    def _shape(self, placed: PlacedPrim, read: ReadMaterial | None) -> Mesh:
        """Returns a cube, sphere or plane prim as a mesh with the material ``read``."""
        file, prim = self._file, placed.prim
        material = MaterialPbr(base_color=(GREY,) * 3) if read is None else self._materials.sided(read.material, prim)
        match str(prim.GetTypeName()):
            case "Cube":
                mesh = box(number(file, prim, "size", 2.0), material=material)
            case "Sphere":
                mesh = sphere(number(file, prim, "radius", 1.0), material=material)
            case _:
                width, length = number(file, prim, "width", 2.0), number(file, prim, "length", 2.0)
                mesh = _rotated_plane(plane(width, length, material=material), str(value(file, prim, "axis", "Z")))
        return drop_textures_without_uvs(file.path, replace(mesh, name=placed.name))


def _rotated_plane(mesh: Mesh, axis: str) -> Mesh:
    """Rotates a plane that faces +y to face ``axis``. Its width then lies along z if ``axis`` is x, else along x."""
    order, signs = {"X": ([1, 2, 0], (1, 1, 1)), "Z": ([0, 2, 1], (1, -1, 1))}.get(axis, ([0, 1, 2], (1, 1, 1)))
    assert mesh.normals is not None
    return replace(mesh, positions=mesh.positions[:, order] * signs, normals=mesh.normals[:, order] * signs)


def _normals(file: UsdFile, prim: Any) -> Attribute | None:
    """Returns the normals primvar of a mesh, else its normals attribute; None if the mesh has neither."""
    found = _primvar(file, prim, "normals", 3)
    if found is not None:
        return found
    values = array(file, prim, "normals", 3)
    interpolation_name = str(pxr().UsdGeom.PointBased(prim).GetNormalsInterpolation())
    return None if values is None else Attribute(values, interpolation_name, f"{prim.GetPath()}.normals")


def _primvar(file: UsdFile, prim: Any, name: str, columns: int) -> Attribute | None:
    """Returns a primvar of a mesh, its own or an inherited one, with indices resolved; None if there is neither.

    Args:
        file: The open file.
        prim: The mesh prim.
        name: Name of the primvar.
        columns: Numbers per value.
    """
    primvar = pxr().UsdGeom.PrimvarsAPI(prim).FindPrimvarWithInheritance(name)
    if not primvar or not primvar.HasValue():
        return None
    label = f"{prim.GetPath()}.primvars:{name}"
    values = rows(file, label, primvar.ComputeFlattened(file.time), columns)
    return None if values is None else Attribute(values, str(primvar.GetInterpolation()), label)


def _used(triangles: Rows, arrays: dict[str, FloatArray]) -> tuple[IntArray, dict[str, FloatArray]]:
    """Removes vertices that no triangle uses. Returns the triangles with new vertex indices, and the remaining rows.

    Args:
        triangles: Vertex indices, shape (F, 3).
        arrays: Rows of V vertices by attribute name; ``positions`` is one of them.
    """
    used = np.zeros(len(arrays["positions"]), bool)
    used[triangles] = True
    if used.all():
        return triangles.astype(np.int32), arrays
    renumbered = (np.cumsum(used) - 1).astype(np.int32)
    return renumbered[triangles], {name: values[used] for name, values in arrays.items()}
