"""Writes captures, meshes, scenes and animations as OpenUSD files.

An asset with one instance is written directly, an asset with several as a prototype with scene-graph instances. Actors
and moving cameras get time samples, one time code per frame. The stage is built in memory, then written as a layer with
a texture folder beside it, or as a .usdz package that contains layer and textures.
"""

from __future__ import annotations

import os
import tempfile
import zipfile
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from lumisplat.constants import SH_DEGREE_MAX
from lumisplat.errors import FormatError
from lumisplat.io.files.atomic import atomic_write
from lumisplat.io.files.native import utf8_path
from lumisplat.io.files.source import PathLike
from lumisplat.io.meshes.mesh_arrays import flip_v
from lumisplat.io.usd.cameras import camera_transform, camera_values, define_camera, write_cameras
from lumisplat.io.usd.library import pxr, writing_usd
from lumisplat.io.usd.lights import write_light
from lumisplat.io.usd.materials import MaterialWriter
from lumisplat.io.usd.particles import define_field, particle_values
from lumisplat.io.usd.stage import StageWriter, folder_of, matrix
from lumisplat.scene.animation.actors import Actor, Animation
from lumisplat.scene.animation.lights import MovingLight, light_at
from lumisplat.scene.camera import Camera
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.lights import LightEnvironment
from lumisplat.scene.materials import MaterialPbr
from lumisplat.scene.mesh import Mesh
from lumisplat.scene.scene import MeshInstance, Scene, SplatInstance

USD_PACKAGE_BYTES_MAX = 2**32 - 1
"""Largest size of a .usdz package in bytes: the limit of the zip format without its zip64 extension, which USD does
not read."""

Instance = SplatInstance | MeshInstance
_PROTOTYPES = "/Prototypes"

_TRANSFORM_OP = "xformOp:transform"

_Key = tuple[str, int, int]


def write_usd(path: PathLike, subject: Gaussians | Mesh | Scene | Animation, cameras: Sequence[Camera] = ()) -> None:
    """Writes a capture, mesh, scene or animation. One log line lists what OpenUSD cannot store.

    Args:
        path: ``.usda`` is text, ``.usdc`` and ``.usd`` are binary, ``.usdz`` is a package with its textures.
        subject: What to write.
        cameras: Cameras to write, in addition to those of an animation.

    Raises:
        FormatError: The file cannot be written.
        MissingExtraError: usd-core is not installed.
    """
    pxr()
    scene = _as_scene(subject)
    with writing_usd(path):
        writer = StageWriter(Path(path), scene.up_direction)
        assets = AssetWriter(writer, MaterialWriter(writer))
        assets.write((*scene.splats, *scene.meshes))
        for light in scene.lights:
            write_light(writer, light)
        write_cameras(writer, cameras)
        if isinstance(subject, Animation):
            write_cameras(writer, subject.cameras)
            _write_motion(writer, assets, subject)
        _write_files(writer)
    writer.remarks.report()


def _as_scene(subject: Gaussians | Mesh | Scene | Animation) -> Scene:
    """Returns the scene of an animation at time 0, without actors; a capture or mesh becomes one at the origin."""
    match subject:
        case Gaussians():
            return Scene(splats=(SplatInstance(subject),))
        case Mesh():
            return Scene(meshes=(MeshInstance(subject),))
        case Animation():
            return replace(subject, lights=()).scene_at(0.0)
        case Scene():
            return subject


@dataclass(slots=True)
class AssetWriter:
    """Writes instances of captures and meshes to a stage; an asset that several instances share is written once."""

    writer: StageWriter
    materials: MaterialWriter
    _prototypes: dict[tuple[Any, ...], str] = field(default_factory=dict[tuple[Any, ...], str])

    def write(self, instances: Sequence[Instance]) -> None:
        """Writes captures and meshes with their transforms to the world."""
        uses = Counter(_key(instance) for instance in instances)
        for instance in instances:
            name = instance.name or (instance.mesh.name if isinstance(instance, MeshInstance) else "gaussians")
            path = self.writer.path_of(name)
            if uses[_key(instance)] > 1:
                prim = self._instance(path, instance)
            else:
                prim = self.define(path, instance)
            self.writer.name(prim, instance.name)
            self.writer.set_transform(prim, instance.transform)

    def define(self, path: str, instance: Instance) -> Any:
        """Writes the capture or mesh of an instance, in object space, and returns the prim."""
        if isinstance(instance, MeshInstance):
            prim = _define_mesh(self.writer, path, instance.mesh)
            self.materials.bind(prim, instance.mesh.material, instance.mesh.colors is not None)
            if instance.mesh.colors is not None and instance.mesh.material.base_color_texture is not None:
                self.writer.set_custom_data(prim, multipliesColors=True)
            if instance.shadow_catcher:
                self.writer.set_custom_data(prim, shadow_catcher=True)
                self.writer.remarks.add("shadow catchers, which only Lumisplat reads", instance.mesh.name)
            return prim
        prim = define_field(self.writer, path, instance.gaussians)
        if instance.material is not None:
            self.materials.bind(prim, instance.material, on_splats=True)
            self.writer.remarks.add("relighting of captures, which only Lumisplat reads", instance.name)
        iso = instance.depth_iso_transmittance
        if instance.shadow_catcher or instance.sh_degree < SH_DEGREE_MAX or iso is not None:
            own = {} if iso is None else {"depth_iso_transmittance": iso}
            self.writer.set_custom_data(
                prim, shadow_catcher=instance.shadow_catcher, sh_degree=instance.sh_degree, **own
            )
            self.writer.remarks.add(
                "shadow_catcher, sh_degree and depth_iso_transmittance of captures, which only Lumisplat reads",
                instance.name,
            )
        return prim

    def _instance(self, path: str, instance: Instance) -> Any:
        """Writes a prim that references the prototype of an instance; the first instance also writes the prototype."""
        px, stage = pxr(), self.writer.stage
        key = _key(instance)
        if key not in self._prototypes:
            if not self._prototypes:
                stage.CreateClassPrim(_PROTOTYPES)
            prototype = px.UsdGeom.Xform.Define(stage, self.writer.path_of(_name(instance), _PROTOTYPES))
            self._prototypes[key] = str(prototype.GetPath())
            self.define(f"{prototype.GetPath()}/asset", instance)
        prim = px.UsdGeom.Xform.Define(stage, path).GetPrim()
        prim.GetReferences().AddInternalReference(self._prototypes[key])
        prim.SetInstanceable(True)
        return prim


def _name(instance: Instance) -> str:
    return (instance.mesh.name if isinstance(instance, MeshInstance) else instance.name) or "asset"


def _key(instance: Instance) -> tuple[Any, ...]:
    """Returns the asset's id, the material's id and the settings of an instance. Equal keys share a USD prototype."""
    if isinstance(instance, MeshInstance):
        return id(instance.mesh), 0, int(instance.shadow_catcher)
    own = (instance.sh_degree, instance.shadow_catcher, instance.depth_iso_transmittance)
    return id(instance.gaussians), id(instance.material), own


def _define_mesh(writer: StageWriter, path: str, mesh: Mesh) -> Any:
    """Writes a mesh without its material, in object space, and returns the prim."""
    px = pxr()
    types, tokens, vt = px.Sdf.ValueTypeNames, px.UsdGeom.Tokens, px.Vt
    defined = px.UsdGeom.Mesh.Define(writer.stage, path)
    prim = defined.GetPrim()
    defined.CreateSubdivisionSchemeAttr("none")
    defined.CreateDoubleSidedAttr(not isinstance(mesh.material, MaterialPbr) or mesh.material.double_sided)
    defined.CreateFaceVertexCountsAttr(vt.IntArray.FromNumpy(np.full(mesh.face_count, 3, np.int32)))
    defined.CreateFaceVertexIndicesAttr(vt.IntArray.FromNumpy(mesh.indices.reshape(-1)))
    for name, values in _mesh_values(mesh).items():
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


def _mesh_values(mesh: Mesh) -> dict[str, Any]:
    """Returns by name the attributes of a mesh prim that may differ from frame to frame; faces are left out."""
    vt = pxr().Vt
    values = {
        "points": vt.Vec3fArray.FromNumpy(mesh.positions),
        "extent": vt.Vec3fArray.FromNumpy(np.stack(mesh.bounds())),
    }
    if mesh.normals is not None:
        values["normals"] = vt.Vec3fArray.FromNumpy(mesh.normals)
    return values


def _colors(mesh: Mesh) -> Any:
    """Returns the vertex colours of a mesh, multiplied by the base colour unless a texture replaces the base colour.

    UsdPreviewSurface shaders cannot multiply vertex colours by a base colour.
    """
    assert mesh.colors is not None
    material = mesh.material
    if material.base_color_texture is not None or material.mesh_color == (1.0, 1.0, 1.0):
        return mesh.colors
    factor = np.array(material.mesh_color)
    if not isinstance(material, MaterialPbr):
        factor = factor * material.diffuse
    return (mesh.colors * factor).astype(np.float32)


def _write_motion(writer: StageWriter, assets: AssetWriter, animation: Animation) -> None:
    """Writes the actors and the camera path of an animation as time samples, and the animation's frame range and rate.

    Transforms, and the attributes of deforming prims, have a time sample at each frame where they change. Readers
    interpolate between frames.
    """
    stage = writer.stage
    stage.SetTimeCodesPerSecond(animation.fps)
    stage.SetFramesPerSecond(animation.fps)
    stage.SetStartTimeCode(0.0)
    stage.SetEndTimeCode(animation.frame_count - 1.0)
    for light in animation.lights:
        _write_moving_light(writer, light, animation)
    for actor in animation.actors:
        _write_actor(writer, assets, actor, animation)
    if animation.camera_path is not None:
        cameras = [animation.camera_path.at(float(time)) for time in animation.times]
        prim = define_camera(writer, cameras[0])
        samples = _Samples(prim)
        for frame, camera in enumerate(cameras):
            samples.add(frame, _TRANSFORM_OP, matrix(camera_transform(camera)), camera.camera_from_world.tobytes())
            for name, value in camera_values(camera).items():
                samples.add(frame, name, value, value)


def _write_moving_light(writer: StageWriter, moving: MovingLight, animation: Animation) -> None:
    """Writes a light with time samples of its transform and of all its attributes that change."""
    prim = write_light(writer, light_at(moving, 0.0))
    samples, scratch = _Samples(prim), StageWriter(writer.path, animation.scene.up_direction)
    for frame, time in enumerate(animation.times.tolist()):
        light = light_at(moving, time)
        if isinstance(light, LightEnvironment):
            light = replace(light, image=None)  # the image is written once
        for attribute in write_light(scratch, light).GetAuthoredAttributes():
            if attribute.GetName() != "xformOpOrder":
                samples.add(frame, attribute.GetName(), attribute.Get(), attribute.Get())


@dataclass(slots=True)
class _Samples:
    """Writes time samples of a prim's attributes at the frames where values change.

    Readers interpolate between samples. If a value was constant for several frames before a change, the old value is
    therefore sampled again at the last frame before the change.
    """

    prim: Any
    _last: dict[str, tuple[int, Any, Any]] = field(default_factory=dict[str, "tuple[int, Any, Any]"])
    """Frame, value and ``mark`` of the last value that `add` wrote, by the attribute's name."""

    def add(self, frame: int, name: str, value: Any, mark: Any) -> None:
        """Records the value of an attribute at a frame.

        Args:
            frame: The frame, which is also the time code.
            name: The attribute.
            value: Value of the attribute.
            mark: Cheap substitute for comparing values: equal marks mean equal values. A value whose mark equals the
                mark of the last written value is not written.
        """
        attribute = self.prim.GetAttribute(name)
        if name == _TRANSFORM_OP and not attribute:
            attribute = pxr().UsdGeom.Xformable(self.prim).AddTransformOp().GetAttr()
        if name not in self._last:
            attribute.Set(value)
        else:
            last_frame, last_value, last_mark = self._last[name]
            if last_mark == mark:
                return
            if last_frame == 0:
                attribute.Set(last_value, 0.0)
            if last_frame < frame - 1:
                attribute.Set(last_value, frame - 1.0)
            attribute.Set(value, float(frame))
        self._last[name] = frame, value, mark


def _write_actor(writer: StageWriter, assets: AssetWriter, actor: Actor, animation: Animation) -> None:
    """Writes an actor, one prim for each of its instances, with time samples of transform, shape and visibility."""
    if not actor.casts_shadow or not actor.relight:
        writer.remarks.add("lighting settings of actors (relight, casts_shadow)", actor.name)
    prims: dict[_Key, _Samples] = {}
    written_assets: dict[_Key, Any] = {}
    for frame, time in enumerate(animation.times):
        present = dict(_with_keys(actor.at(float(time))))
        for key, instance in present.items():
            if key not in prims:
                name = instance.name or actor.name or "actor"
                path = writer.path_of(name)
                prim = assets.define(path, instance)
                writer.name(prim, name)
                prims[key] = _Samples(prim)
                if frame > 0:
                    prims[key].add(0, "visibility", "invisible", "invisible")
            samples = prims[key]
            samples.add(frame, _TRANSFORM_OP, matrix(instance.transform), instance.transform.tobytes())
            asset = instance.mesh if isinstance(instance, MeshInstance) else instance.gaussians
            if written_assets.get(key) is not asset:
                for name, value in _varying_values(instance).items():
                    samples.add(frame, name, value, np.asarray(value).tobytes())
                written_assets[key] = asset
        for key, samples in prims.items():
            visibility = "inherited" if key in present else "invisible"
            samples.add(frame, "visibility", visibility, visibility)


def _with_keys(instances: Iterable[Instance]) -> Iterator[tuple[_Key, Instance]]:
    """Yields the instances of an actor in one frame, each with a key that is the same in all frames.

    A key has the kind, the material of a mesh, and the index among instances with equal kind and material.
    """
    counts: Counter[tuple[str, int]] = Counter()
    for instance in instances:
        group = ("mesh", id(instance.mesh.material)) if isinstance(instance, MeshInstance) else ("splats", 0)
        yield (group[0], group[1], counts[group]), instance
        counts[group] += 1


def _varying_values(instance: Instance) -> dict[str, Any]:
    """Returns by name the attributes of an instance's prim that may differ from frame to frame."""
    if not isinstance(instance, MeshInstance):
        return particle_values(instance.gaussians)
    mesh, vt = instance.mesh, pxr().Vt
    return {
        **_mesh_values(mesh),
        "faceVertexCounts": vt.IntArray.FromNumpy(np.full(mesh.face_count, 3, np.int32)),
        "faceVertexIndices": vt.IntArray.FromNumpy(mesh.indices.reshape(-1)),
    }


def _write_files(writer: StageWriter) -> None:
    """Writes a stage. Each file appears complete or not at all, and the layer is written last."""
    path = writer.path
    if path.suffix.lower() == ".usdz":
        _write_package(writer)
        return
    for name, data in writer.files.items():
        with atomic_write(path.parent / folder_of(path) / name) as temporary:
            temporary.write_bytes(data)
    with atomic_write(path) as temporary:
        _export(writer, temporary)


def _write_package(writer: StageWriter) -> None:
    path, folder_name = writer.path, folder_of(writer.path)
    with tempfile.TemporaryDirectory() as folder:
        layer = Path(folder) / f"{_ascii_stem(path.stem)}.usdc"
        _export(writer, layer)
        files = {layer: layer.name}
        for name, data in writer.files.items():
            file = Path(folder) / name
            file.write_bytes(data)
            files[file] = f"{folder_name}/{name}"
        size = sum(file.stat().st_size for file in files)
        if size > USD_PACKAGE_BYTES_MAX:
            raise FormatError(path, f"would have {size:,} bytes, more than a .usdz can hold: write a .usdc instead")
        with atomic_write(path) as temporary, utf8_path(temporary) as text:
            package = pxr().Sdf.ZipFileWriter.CreateNew(text)
            for file, name in files.items():  # USD opens the first file of a package
                package.AddFile(os.fspath(file), name)
            if not package.Save() or not _is_complete(temporary, len(files)):
                raise FormatError(path, "cannot be written: is the disk full?")


def _is_complete(package: Path, count: int) -> bool:
    """Returns whether a .usdz package has ``count`` undamaged files; usd-core does not report a full disk."""
    try:
        with zipfile.ZipFile(package) as written:
            return len(written.infolist()) == count and written.testzip() is None
    except zipfile.BadZipFile:
        return False


def _export(writer: StageWriter, file: Path) -> None:
    with utf8_path(file) as text:
        if not writer.stage.GetRootLayer().Export(text):
            raise FormatError(writer.path, "cannot be written: is the disk full?")


def _ascii_stem(stem: str) -> str:
    """Returns the name for the layer inside a package: ``stem`` with "_" for all but ASCII letters and digits."""
    return "".join(c if c.isascii() and (c.isalnum() or c in "_-") else "_" for c in stem)[:64] or "scene"
