"""Captures and meshes of a scene: what stands at one place there, what stands at several as instances of one."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lumisplat.constants import SH_DEGREE_MAX
from lumisplat.io.meshes.mesh_arrays import flip_v
from lumisplat.io.usd.library import pxr
from lumisplat.io.usd.writing.materials import MaterialWriter
from lumisplat.io.usd.writing.particles import define_field
from lumisplat.io.usd.writing.stage import StageWriter
from lumisplat.scene.materials import MaterialPbr
from lumisplat.scene.mesh import Mesh
from lumisplat.scene.scene import MeshInstance, SplatInstance

Instance = SplatInstance | MeshInstance
_PROTOTYPES = "/Prototypes"


@dataclass(slots=True)
class AssetWriter:
    """Writes instances; an asset that several of them show is written once."""

    writer: StageWriter
    materials: MaterialWriter
    _prototypes: dict[tuple[int, int, int], str] = field(default_factory=dict[tuple[int, int, int], str])

    def write(self, instances: Sequence[Instance]) -> None:
        """Writes instances at their places."""
        uses = Counter(_key(instance) for instance in instances)
        for instance in instances:
            name = instance.name or (instance.mesh.name if isinstance(instance, MeshInstance) else "gaussians")
            path = self.writer.path_of(name)
            if uses[_key(instance)] > 1:
                prim = self._instance(path, instance)
            else:
                prim = self.define(path, instance)
            self.writer.name(prim, instance.name)
            self.writer.place(prim, instance.transform)

    def define(self, path: str, instance: Instance) -> Any:
        """Writes what an instance shows, in its own coordinates; its prim."""
        if isinstance(instance, MeshInstance):
            prim = define_mesh(self.writer, path, instance.mesh)
            self.materials.bind(prim, instance.mesh.material, instance.mesh.colors is not None)
            if instance.mesh.colors is not None and instance.mesh.material.base_color_texture is not None:
                self.writer.hint(prim, multipliesColors=True)
            if instance.shadow_catcher:
                self.writer.hint(prim, shadow_catcher=True)
                self.writer.remarks.add(
                    "that a mesh is a shadow catcher, which only Lumisplat will know", instance.mesh.name
                )
            return prim
        prim = define_field(self.writer, path, instance.gaussians)
        if instance.material is not None:
            self.materials.bind(prim, instance.material)
            self.writer.remarks.add("that a capture is relit, which only Lumisplat will know", instance.name)
        if instance.shadow_catcher or instance.sh_degree < SH_DEGREE_MAX:
            self.writer.hint(prim, shadow_catcher=instance.shadow_catcher, sh_degree=instance.sh_degree)
            self.writer.remarks.add(
                "shadow_catcher and sh_degree of captures, which only Lumisplat will know", instance.name
            )
        return prim

    def _instance(self, path: str, instance: Instance) -> Any:
        """A prim that shows a prototype."""
        px, stage = pxr(), self.writer.stage
        key = _key(instance)
        if key not in self._prototypes:
            if not self._prototypes:
                stage.CreateClassPrim(_PROTOTYPES)
            held = px.UsdGeom.Xform.Define(stage, self.writer.path_of(_name(instance), _PROTOTYPES))
            self._prototypes[key] = str(held.GetPath())
            self.define(f"{held.GetPath()}/asset", instance)
        prim = px.UsdGeom.Xform.Define(stage, path).GetPrim()
        prim.GetReferences().AddInternalReference(self._prototypes[key])
        prim.SetInstanceable(True)
        return prim


def _name(instance: Instance) -> str:
    return (instance.mesh.name if isinstance(instance, MeshInstance) else instance.name) or "asset"


def _key(instance: Instance) -> tuple[int, int, int]:
    """What an instance shows: asset, material and settings."""
    if isinstance(instance, MeshInstance):
        return id(instance.mesh), 0, int(instance.shadow_catcher)
    return id(instance.gaussians), id(instance.material), instance.sh_degree + 4 * instance.shadow_catcher


def define_mesh(writer: StageWriter, path: str, mesh: Mesh) -> Any:
    """Writes a mesh in its own coordinates, without its material; its prim."""
    px = pxr()
    types, tokens, vt = px.Sdf.ValueTypeNames, px.UsdGeom.Tokens, px.Vt
    defined = px.UsdGeom.Mesh.Define(writer.stage, path)
    prim = defined.GetPrim()
    defined.CreateSubdivisionSchemeAttr("none")
    defined.CreateDoubleSidedAttr(not isinstance(mesh.material, MaterialPbr) or mesh.material.double_sided)
    defined.CreateFaceVertexCountsAttr(vt.IntArray.FromNumpy(np.full(mesh.face_count, 3, np.int32)))
    defined.CreateFaceVertexIndicesAttr(vt.IntArray.FromNumpy(mesh.indices.reshape(-1)))
    for name, values in mesh_values(mesh).items():
        prim.GetAttribute(name).Set(values)
    if mesh.normals is not None:
        defined.SetNormalsInterpolation(tokens.vertex)
    primvars = px.UsdGeom.PrimvarsAPI(prim)
    if mesh.uvs is not None:
        primvars.CreatePrimvar("st", types.TexCoord2fArray, tokens.vertex).Set(
            vt.Vec2fArray.FromNumpy(flip_v(mesh.uvs))
        )
    if mesh.colors is not None:
        primvars.CreatePrimvar("displayColor", types.Color3fArray, tokens.vertex).Set(
            vt.Vec3fArray.FromNumpy(_colors(mesh))
        )
    return prim


def mesh_values(mesh: Mesh) -> dict[str, Any]:
    """The values of a mesh's attributes that may change with time, by their names."""
    vt = pxr().Vt
    values = {
        "points": vt.Vec3fArray.FromNumpy(mesh.positions),
        "extent": vt.Vec3fArray.FromNumpy(np.stack(mesh.bounds())),
    }
    if mesh.normals is not None:
        values["normals"] = vt.Vec3fArray.FromNumpy(mesh.normals)
    return values


def _colors(mesh: Mesh) -> Any:
    """Colours of vertices, times the base colour where no texture has it, as a surface shader cannot multiply."""
    assert mesh.colors is not None
    material = mesh.material
    if material.base_color_texture is not None or material.base_color == (1.0, 1.0, 1.0):
        return mesh.colors
    factor = np.array(material.base_color)
    if not isinstance(material, MaterialPbr):
        factor = factor * material.diffuse
    return (mesh.colors * factor).astype(np.float32)
