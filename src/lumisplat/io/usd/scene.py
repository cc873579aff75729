"""Reads OpenUSD stages as scenes or captures."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from lumisplat.constants import SH_DEGREE_MAX
from lumisplat.errors import FormatError, SceneError
from lumisplat.io.files.source import PathLike, with_current_keys
from lumisplat.io.gltf.gaussians import single_capture
from lumisplat.io.meshes.mesh_arrays import TriangleSieve
from lumisplat.io.splats.columns import gaussians_from_columns
from lumisplat.io.usd.library import check_loaded, pxr, reading_usd
from lumisplat.io.usd.lights import is_light, read_light
from lumisplat.io.usd.materials import UsdMaterials
from lumisplat.io.usd.meshes import UsdMeshes
from lumisplat.io.usd.particles import is_field, read_particles
from lumisplat.io.usd.process import read_in_child
from lumisplat.io.usd.stage import RENDERED_PURPOSES, PlacedPrim, UsdFile, custom_data_of, open_usd, placed_prims
from lumisplat.math.arrays import Doubles
from lumisplat.scene.checks import with_checked
from lumisplat.scene.editing.transform import under_affine
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.lights import Light, LightEnvironment
from lumisplat.scene.scene import MeshInstance, Scene, SplatInstance, check_similarity

_NON_SHAPE_ATTRIBUTES = ("xformOp:", "visibility", "extent", "velocities", "accelerations", "angularVelocities")
"""Beginnings of attribute names whose time samples leave a prim's shape as it is, such as transforms and visibility."""
_HELD = 1e-3
"""Time codes before a sample of visibility at which a light still is as before."""


def read_usd(path: PathLike, drop_invalid: bool = False) -> Gaussians | Scene:
    """Reads a stage at its first time code: particle fields, meshes and lights, with their materials.

    A stage that contains one particle field and nothing else is returned as a capture, with y down as in Gaussian PLY
    files. A scene has y up and is in metres.

    Args:
        path: ``.usd``, ``.usda``, ``.usdc`` or ``.usdz``.
        drop_invalid: Drop Gaussians with invalid values instead of refusing the file.

    Raises:
        FormatError: The file, or a file that it names, is missing or damaged, or contains nothing that can be read.
        MissingExtraError: usd-core is not installed.
    """
    return read_in_child(path, scene_of, drop_invalid)


def scene_of(path: Path, drop_invalid: bool) -> Gaussians | Scene:
    """Reads a scene in the current process; see `read_usd`."""
    with reading_usd(path):
        file = open_usd(path)
        found = StageReader(file, drop_invalid).run()
        loaded = found.as_capture() or found.scene()
        check_loaded(path)
    file.remarks.report()
    return loaded


def holds_one_capture(path: PathLike) -> bool:
    """Returns whether a file contains one particle field and nothing else, so that `read_usd` returns Gaussians.

    Raises:
        FormatError: The file cannot be read.
        MissingExtraError: usd-core is not installed.
    """
    return read_in_child(path, _holds_one_capture)


def _holds_one_capture(path: Path) -> bool:
    """Looks for a single particle field in the current process; see `holds_one_capture`."""
    with reading_usd(path):
        file = open_usd(path)
        visible_prims = [one.prim for one in placed_prims(file) if one.visible and not one.is_degenerate]
        fields = [one for one in visible_prims if is_field(one)]
        others = (is_light(one) or UsdMeshes.reads(one) or str(one.GetTypeName()) == "Camera" for one in visible_prims)
        if len(fields) != 1 or any(others):
            return False
        return not (_settings(fields[0]) or UsdMaterials(file).bound_to(fields[0], remark=False))


def _settings(prim: Any) -> dict[str, Any]:
    """Returns the settings of a `SplatInstance` from a prim's customData, if Lumisplat wrote them; else empty."""
    custom_data = with_current_keys(custom_data_of(prim))
    names = ("sh_degree", "depth_iso_transmittance", "shadow_catcher")
    return {name: custom_data[name] for name in names if name in custom_data}


def transform_time_codes(prim: Any) -> Doubles:
    """Returns the sorted time codes at which the transform of a prim or of an ancestor has samples."""
    xformable, found = pxr().UsdGeom.Xformable, set[float]()
    while prim and not prim.IsPseudoRoot():
        xform = xformable(prim)
        if xform:
            found.update(xform.GetTimeSamples())
            if xform.GetResetXformStack():
                break
        prim = prim.GetParent()
    return np.array(sorted(found))


def light_time_codes(prim: Any) -> Doubles:
    """Returns the sorted time codes at which an attribute, the visibility or the transform of a light has samples."""
    own = {code for attribute in prim.GetAttributes() for code in attribute.GetTimeSamples()}
    own |= set(transform_time_codes(prim).tolist())
    # Visibility is held up to its next sample: a code just before keeps the light from fading.
    switched = _visibility_time_codes(prim)
    start = min((*own, *switched), default=0.0)
    return np.array(sorted(own | switched | {code - _HELD for code in switched if code - _HELD > start}))


def _visibility_time_codes(prim: Any) -> set[float]:
    """Returns the time codes at which the visibility of a prim or of an ancestor has samples."""
    imageable, found = pxr().UsdGeom.Imageable, set[float]()
    while prim and not prim.IsPseudoRoot():
        if imageable(prim):
            found.update(imageable(prim).GetVisibilityAttr().GetTimeSamples())
        prim = prim.GetParent()
    return found


def shape_time_codes(prim: Any) -> Doubles:
    """Returns the sorted time codes at which the shape or appearance of a prim has samples."""
    shapes = (one for one in prim.GetAuthoredAttributes() if not one.GetName().startswith(_NON_SHAPE_ATTRIBUTES))
    return np.array(sorted({code for one in shapes for code in one.GetTimeSamples()}))


def _world_transform(file: UsdFile, prim: Any) -> Doubles:
    """Returns ``world_from_prim`` at the current time code, shape (4, 4)."""
    return file.world_transform(pxr().UsdGeom.XformCache(file.time).GetLocalToWorldTransform(prim))


@dataclass(slots=True)
class StageReader:
    """Collects the captures, meshes and lights of a stage."""

    file: UsdFile
    drop_invalid: bool = False
    for_animation: bool = False
    """Whether deforming prims are collected in `deforming`, to be read again at other time codes."""
    splats: list[SplatInstance] = field(default_factory=list[SplatInstance])
    meshes: list[MeshInstance] = field(default_factory=list[MeshInstance])
    lights: list[Light] = field(default_factory=list[Light])
    moving: dict[str, list[SplatInstance | MeshInstance]] = field(
        default_factory=dict[str, "list[SplatInstance | MeshInstance]"]
    )
    """Captures and meshes whose transform has time samples, by prim path; those in `deforming` are not included."""
    deforming: dict[str, tuple[PlacedPrim, list[SplatInstance | MeshInstance]]] = field(
        default_factory=dict[str, "tuple[PlacedPrim, list[SplatInstance | MeshInstance]]"]
    )
    """Prims whose shape has time samples, each with its instances, by prim path. Instances made by a point instancer
    are not included and keep the shape of the first time code."""
    moving_lights: list[tuple[PlacedPrim, Light]] = field(default_factory=list["tuple[PlacedPrim, Light]"])
    """Lights with time samples, with `for_animation` alone; `lights` then lacks them."""
    has_cameras: bool = False
    _captures: dict[str, Gaussians | None] = field(default_factory=dict[str, "Gaussians | None"])
    _materials: UsdMaterials = field(init=False)

    def run(self) -> StageReader:
        """Traverses the stage and collects its captures, meshes and lights. Returns this reader.

        Raises:
            FormatError: A prim cannot be read, or the stage has nothing to read.
        """
        file, sieve = self.file, TriangleSieve(self.file.path)
        self._materials = materials = UsdMaterials(file)
        meshes = UsdMeshes(file, materials, sieve)
        for placed in placed_prims(file):
            prim, kind = placed.prim, str(placed.prim.GetTypeName())
            if kind == "Camera":
                self.has_cameras = True
            elif is_light(prim):
                self._add_light(placed)
            elif not placed.visible or placed.is_degenerate:
                continue
            elif is_field(prim):
                self._collect(placed, self.splats, self._splats(placed, materials))
            elif meshes.reads(prim):
                self._collect(placed, self.meshes, meshes.instances(placed))
            elif prim.IsA(pxr().UsdGeom.Gprim):
                file.remarks.add(f"prims of type {kind}", str(prim.GetPath()))
        is_lit = bool(self.lights or self.moving_lights)
        if not (self.splats or self.meshes or is_lit or self.has_cameras or sieve.problems):
            messages = "; ".join(file.remarks.names)
            raise FormatError(
                file.path, "contains no particle field, mesh, light or camera" + (f" ({messages})" if messages else "")
            )
        sieve.report(any_usable=bool(self.splats or self.meshes or is_lit or self.has_cameras))
        return self

    def scene(self) -> Scene:
        """Returns all captures, meshes and lights as a scene."""
        return Scene(self.splats, self.meshes, self.lights, up="y-up")

    def as_capture(self) -> Gaussians | None:
        """Returns the Gaussians if the stage has a single particle field and nothing else; otherwise None."""
        if len(self.splats) != 1 or self.meshes or self.lights or self.has_cameras:
            return None
        only = self.splats[0]
        if only.material is not None or only.shadow_catcher or only.sh_degree < SH_DEGREE_MAX:
            return None
        return single_capture(only)

    def instances_at(self, placed: PlacedPrim, code: float) -> list[SplatInstance | MeshInstance]:
        """Returns the instances of a deforming prim at a time code, in world space."""
        file, px = self.file, pxr()
        before, file.time = file.time, px.Usd.TimeCode(code)
        try:
            visible = px.UsdGeom.Imageable(placed.prim).ComputeVisibility(file.time) != px.UsdGeom.Tokens.invisible
            now = placed._replace(world_from_prim=_world_transform(file, placed.prim))
            if now.is_degenerate or not visible:
                return []
            self._captures.pop(placed.asset, None)
            if is_field(placed.prim):
                return [*self._splats(now, self._materials)]
            return [*UsdMeshes(file, self._materials, TriangleSieve(file.path)).instances(now)]
        finally:
            file.time = before

    def light_at(self, placed: PlacedPrim, first: Light, code: float) -> Light:
        """Returns a light of `moving_lights` at a time code; one that is hidden then has an intensity of 0.

        Args:
            placed: The light's prim.
            first: The light at the first time code.
            code: Time code.
        """
        file, px = self.file, pxr()
        before, file.time = file.time, px.Usd.TimeCode(code)
        try:
            imageable = px.UsdGeom.Imageable(placed.prim)
            visible = imageable.ComputeVisibility(file.time) != px.UsdGeom.Tokens.invisible
            rendered = imageable.ComputePurpose() in RENDERED_PURPOSES
            now = placed._replace(world_from_prim=_world_transform(file, placed.prim), visible=rendered)
            light = None if now.is_degenerate else read_light(file, now)
        finally:
            file.time = before
        if light is None or type(light) is not type(first):
            return replace(first, enabled=rendered, intensity=0.0)
        if isinstance(light, LightEnvironment) and isinstance(first, LightEnvironment):
            light = with_checked(light, image=first.image)  # one object at all times
        return light if visible else replace(light, intensity=0.0)

    def _collect(self, placed: PlacedPrim, collection: list[Any], instances: list[Any]) -> None:
        """Adds instances of a prim to ``collection``, and to `moving` or `deforming` if the prim has time samples.

        Args:
            placed: The prim.
            collection: This reader's list `splats` or `meshes`.
            instances: The instances.
        """
        collection.extend(instances)
        if not instances:
            return
        path = str(placed.prim.GetPath())
        if shape_time_codes(placed.prim).size > 1:
            if self.for_animation and not placed.instanced:
                self.deforming[path] = placed, instances
                return
            self.file.remarks.add("animated shapes, of which only the first is used", placed.name)
        if placed.animated:
            self.moving.setdefault(path, []).extend(instances)

    def _splats(self, placed: PlacedPrim, materials: UsdMaterials) -> list[SplatInstance]:
        """Returns a particle field as an instance; a transform that is no similarity is applied to the Gaussians."""
        if placed.asset not in self._captures:
            columns = read_particles(self.file, placed.prim)
            self._captures[placed.asset] = columns and gaussians_from_columns(
                self.file.path, columns, drop_invalid=self.drop_invalid
            )
        gaussians, matrix = self._captures[placed.asset], placed.world_from_prim
        if gaussians is None:
            return []
        try:
            check_similarity(matrix[:3, :3])
        except SceneError:
            gaussians, matrix = under_affine(gaussians, matrix), np.eye(4)
        # Other programs bind materials of their renderer, which show the colours as captured: no remark.
        bound = materials.bound_to(placed.prim, remark=False)
        settings = _settings(placed.prim)
        return [SplatInstance(gaussians, matrix, bound and bound.on_splats, name=placed.name, **settings)]

    def _add_light(self, placed: PlacedPrim) -> None:
        """Adds a light to `lights`, unless its transform is singular or it is a second enabled environment."""
        light = None if placed.is_degenerate else read_light(self.file, placed)
        if light is None:
            return
        others = (*self.lights, *(one for _, one in self.moving_lights))
        has_environment = any(isinstance(one, LightEnvironment) and one.enabled for one in others)
        if isinstance(light, LightEnvironment) and light.enabled and has_environment:
            self.file.remarks.add("all dome lights but the first", str(placed.prim.GetPath()))
            return
        if self.for_animation and not placed.instanced and light_time_codes(placed.prim).size > 1:
            self.moving_lights.append((placed, light))
        else:
            self.lights.append(light)
