"""Opens stages of OpenUSD and reads their values and assets; `StageWriter` makes a stage.

`placed_prims` walks through what is shown, prim by prim, instances and point instancers included. An open stage has the
time that is shown, and its axes and units against ours. What is not read of a file, or not written of a scene, is
collected as `Remarks` and reported in one log line.
"""

from __future__ import annotations

import io
import logging
import math
import os
import re
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from lumisplat.constants import FILE_BYTES_MAX
from lumisplat.errors import FormatError, MissingFileError
from lumisplat.io.files.native import utf8_path
from lumisplat.io.files.source import PathLike, check_regular, read_reference, referenced_file
from lumisplat.io.usd.library import check_layers, pxr
from lumisplat.io.usd.process import raise_limit_for_asset
from lumisplat.math.arrays import Doubles
from lumisplat.math.transforms import axis_rotation
from lumisplat.scene.materials import Texture
from lumisplat.scene.placing import Vector, up_vector, y_up_from

_log = logging.getLogger("lumisplat")

USD_INSTANCES_MAX = 1_000_000
"""Most prims that a file may have, and most instances of point instancers: instances of instances multiply, so that a
small file could ask for any number."""

_NAMES_LISTED = 3
"""Names of things that a remark lists."""
_REMARKS_LISTED = 12
"""Remarks in one line."""

_CUSTOM_DATA_KEY = "lumisplat"
"""Dictionary in the custom data of a prim in which we note what the format has no place for."""
_UNIT_ERROR = 1e-9
"""Error of a unit of length that is none, relative."""

_ROOT = "/World"
"""Path of the prim that holds everything."""


@dataclass(slots=True)
class Remarks:
    """Remarks about a file: each once, with the names of the things that it is about."""

    path: PathLike
    head: str
    """Beginning of the line, after the file."""
    names: dict[str, list[str]] = field(default_factory=dict[str, list[str]])

    def add(self, remark: str, name: str = "") -> None:
        """Notes what a thing has that is left out, or how it is understood.

        Args:
            remark: Such as ``"the range of lights"``.
            name: The thing.
        """
        names = self.names.setdefault(remark, [])
        if name and name not in names:
            names.append(name)

    def report(self) -> None:
        """Logs the line, if there is anything to say."""
        if not self.names:
            return
        said = [remark + _listed(names) for remark, names in self.names.items()]
        more = f"; and {len(said) - _REMARKS_LISTED} more" if len(said) > _REMARKS_LISTED else ""
        _log.warning("%s: %s: %s%s", os.fspath(self.path), self.head, "; ".join(said[:_REMARKS_LISTED]), more)


def _listed(names: list[str]) -> str:
    """The first few names, in brackets."""
    more = f" and {len(names) - _NAMES_LISTED} more" if len(names) > _NAMES_LISTED else ""
    return f" ({', '.join(names[:_NAMES_LISTED])}{more})" if names else ""


@dataclass(slots=True)
class UsdFile:
    """An open file."""

    path: Path
    stage: Any
    time: Any
    """The time code that is shown."""
    world_from_stage: Doubles
    """The world has y up and metres; shape (4, 4)."""
    remarks: Remarks
    held: list[Any]
    """Layers that the library finds only as long as they are held."""

    @property
    def unit(self) -> float:
        """Unit of length of the stage, metres."""
        return float(np.linalg.norm(self.world_from_stage[:3, 0]))

    def world_transform(self, matrix: Any) -> Doubles:
        """``world_from_prim``, shape (4, 4), from a matrix of the library, which is for row vectors."""
        return self.world_from_stage @ np.array(matrix, dtype=np.float64).T


def open_usd(path: Path) -> UsdFile:
    """Opens a file, with all that it is composed of.

    Raises:
        FormatError: The file, or a layer that it names, is damaged, names a file outside of its folder, or says units
            or axes that do not exist.
    """
    px = pxr()
    if not path.exists():
        raise MissingFileError(path, "no such file")
    with utf8_path(path) as text:
        held = check_layers(path, text)
        stage = px.Usd.Stage.Open(text)
    if not stage:
        raise FormatError(path, "damaged, or not a USD file")
    remarks = Remarks(path, "not read, or read otherwise")
    for error in stage.GetCompositionErrors():
        remarks.add("layers that cannot be composed", _first_line(str(error), path))
    return UsdFile(path, stage, _first_time(stage), _world_from_stage(path, stage, remarks), remarks, held)


def _first_time(stage: Any) -> Any:
    """The first time code of a stage that says its times, else that of the first key of each value."""
    code = pxr().Usd.TimeCode
    return code(stage.GetStartTimeCode()) if stage.HasAuthoredTimeCodeRange() else code.EarliestTime()


def _world_from_stage(path: Path, stage: Any, remarks: Remarks) -> Doubles:
    """What turns a stage so that y is up, and scales it to metres, shape (4, 4)."""
    geom, matrix = pxr().UsdGeom, np.eye(4)
    axis = str(geom.GetStageUpAxis(stage))
    if axis not in ("Y", "Z"):
        raise FormatError(path, f"has upAxis {axis!r}, expected Y or Z")
    if axis == "Z":
        matrix[:3, :3] = axis_rotation((1.0, 0.0, 0.0), -0.5 * math.pi).round()
        remarks.add("z is up in it: turned, so that y is")
    if geom.StageHasAuthoredMetersPerUnit(stage):
        unit = float(geom.GetStageMetersPerUnit(stage))
        if not 0.0 < unit < math.inf:
            raise FormatError(path, f"has metersPerUnit {unit:g}, expected a length above 0")
        if abs(unit - 1.0) > _UNIT_ERROR:
            matrix[:3, :3] *= unit
            remarks.add(f"its unit is {unit:g} m: scaled to metres")
    return matrix


def _first_line(text: str, path: Path) -> str:
    said = " ".join(text.replace(os.fspath(path), "it").split())
    return said[:120]


def value(file: UsdFile, prim: Any, name: str, default: Any = None) -> Any:
    """The value of an attribute at the time that is shown; the default if there is none."""
    attribute = prim.GetAttribute(name)
    found = attribute.Get(file.time) if attribute else None
    return default if found is None else found


def shortest(found: float) -> float:
    """A number; of one that has 32 bits, the shortest decimal that it stands for: 0.4, not 0.4000000059604645."""
    single = np.float32(found)
    return float(str(single)) if float(single) == found else float(found)


def custom_data_of(prim: Any) -> dict[str, Any]:
    """What we have noted at a prim, in files of ours."""
    found = prim.GetCustomDataByKey(_CUSTOM_DATA_KEY)
    return found if isinstance(found, dict) else {}  # pyright: ignore[reportUnknownVariableType]


def number(file: UsdFile, prim: Any, name: str, default: float) -> float:
    """A number.

    Raises:
        FormatError: It is none.
    """
    found = value(file, prim, name, default)
    try:
        return shortest(float(found))
    except (TypeError, ValueError):
        raise FormatError(file.path, f"{prim.GetPath()}.{name} is {str(found)[:40]!r}, expected a number") from None


def array(file: UsdFile, prim: Any, name: str, columns: int) -> npt.NDArray[np.float32] | None:
    """An array of rows, shape (N, columns), or (N,) for one column; None if it has no rows.

    Raises:
        FormatError: It has other rows.
    """
    found = value(file, prim, name)
    return None if found is None else rows(file, f"{prim.GetPath()}.{name}", found, columns)


def rows(file: UsdFile, label: str, found: Any, columns: int) -> npt.NDArray[np.float32] | None:
    """As `array`, of a value that is there."""
    try:
        held = np.array(found, dtype=np.float32)
    except (TypeError, ValueError):
        raise FormatError(file.path, f"{label} is no array of numbers") from None
    if held.size == 0:
        return None
    if held.shape[1:] != ((columns,) if columns > 1 else ()):
        raise FormatError(file.path, f"{label} has rows of shape {held.shape[1:]}, expected {columns} numbers")
    return held


def whole_numbers(file: UsdFile, prim: Any, name: str) -> npt.NDArray[np.int64]:
    """An array of whole numbers, shape (N,); empty if there is none.

    Raises:
        FormatError: They are none.
    """
    found = np.array(value(file, prim, name, ()))
    if found.size == 0:
        return np.zeros(0, np.int64)
    if found.dtype.kind not in "iu" or found.ndim != 1:
        raise FormatError(file.path, f"{prim.GetPath()}.{name} is no array of whole numbers")
    return found.astype(np.int64)


def asset_name(asset: Any) -> str:
    """The path of an asset, as the layer has it."""
    return str(getattr(asset, "path", asset))


def asset_bytes(file: UsdFile, asset: Any, label: str) -> bytes:
    """The contents of a file that a value names, to be decoded.

    Args:
        file: The open file.
        asset: A path of the library, which knows what it was resolved to.
        label: What names it, for messages.

    Raises:
        FormatError: There is no such file, it leaves the folder of the stage, or it cannot be read.
    """
    data = _stored_bytes(file, asset, label)
    raise_limit_for_asset(len(data))
    return data


def _stored_bytes(file: UsdFile, asset: Any, label: str) -> bytes:
    """As `asset_bytes`."""
    ar, name = pxr().Ar, asset_name(asset)
    found = str(getattr(asset, "resolvedPath", "")) or name
    if found == name and file.path.suffix.lower() == ".usdz":  # not found by the library: perhaps it is there
        found = ar.JoinPackageRelativePath([os.fspath(file.path), os.path.normpath(name)])
    if not ar.IsPackageRelativePath(found):
        return read_reference(file.path, found)
    package, inner = ar.SplitPackageRelativePathOuter(found)
    package_path = referenced_file(file.path, package)
    try:
        check_regular(package_path, package_path.stat())
        # A package in a package is not unpacked: USD advises against them.
        with zipfile.ZipFile(package_path) as held:
            entry = held.getinfo(inner)
            if entry.file_size > FILE_BYTES_MAX or entry.compress_type != zipfile.ZIP_STORED:
                raise FormatError(file.path, f"{label} names {name[:200]!r}, which is packed or too large")
            return held.read(entry)
    except FormatError:
        raise
    except (KeyError, OSError, zipfile.BadZipFile):
        raise FormatError(file.path, f"{label} names {name[:200]!r}, which {Path(package).name} lacks") from None


@dataclass(slots=True)
class StageWriter:
    """A stage in memory.

    It has y up, or z up if that is how the scene stands, and metres. The root turns scenes that stand otherwise.
    """

    path: Path
    up: Vector
    """Up of the scene."""
    stage: Any = field(init=False)
    remarks: Remarks = field(init=False)
    files: dict[str, bytes] = field(default_factory=dict[str, bytes])
    """What lies beside the layer, by the names that it has there."""
    _textures: dict[int, tuple[Texture, str]] = field(default_factory=dict[int, "tuple[Texture, str]"])
    """Textures that are written, by the identity of their texels: the texels, so that they live, and their name."""
    _paths: set[str] = field(default_factory=set[str])

    def __post_init__(self) -> None:
        px = pxr()
        self.remarks = Remarks(self.path, "OpenUSD has no package_path for all of it, left out or simplified")
        self.stage = px.Usd.Stage.CreateInMemory(".usdc")
        is_z_up = self.up == up_vector("z-up")
        px.UsdGeom.SetStageUpAxis(self.stage, "Z" if is_z_up else "Y")
        px.UsdGeom.SetStageMetersPerUnit(self.stage, 1.0)
        self._paths.add(f"{_ROOT}/Materials")
        root = px.UsdGeom.Xform.Define(self.stage, _ROOT)
        self.stage.SetDefaultPrim(root.GetPrim())
        rotation = np.eye(4)
        rotation[:3, :3] = np.eye(3) if is_z_up else y_up_from(self.up)
        self.set_transform(root.GetPrim(), rotation)

    def path_of(self, name: str, parent: str = _ROOT) -> str:
        """A path of its own below ``parent`` for something that is called so, as far as paths can be."""
        stem = re.sub(r"[^A-Za-z0-9_]", "_", name) or "unnamed"
        stem = f"_{stem}" if stem[0].isdigit() else stem
        path, count = f"{parent}/{stem}", 1
        while path in self._paths:
            count += 1
            path = f"{parent}/{stem}_{count}"
        self._paths.add(path)
        return path

    @property
    def materials(self) -> str:
        """Path of the prim above all materials, which is made when it is first asked for."""
        path = f"{_ROOT}/Materials"
        if not self.stage.GetPrimAtPath(path):
            pxr().UsdGeom.Scope.Define(self.stage, path)
        return path

    def set_custom_data(self, prim: Any, **noted: Any) -> None:
        """Notes at a prim what only we read."""
        for key, held in noted.items():
            prim.SetCustomDataByKey(f"{_CUSTOM_DATA_KEY}:{key}", held)

    def name(self, prim: Any, name: str) -> None:
        """Keeps the name of a prim whose path cannot be it."""
        if name and prim.GetName() != name:
            prim.SetDisplayName(name)

    def set_transform(self, prim: Any, world_from_object: Doubles) -> None:
        """Places a prim below the root."""
        if not np.array_equal(world_from_object, np.eye(4)):
            pxr().UsdGeom.Xformable(prim).AddTransformOp().Set(matrix(world_from_object))

    def texture(self, texels: Texture, name: str) -> str:
        """The path at which a texture lies beside the layer."""
        if id(texels) not in self._textures:
            self._textures[id(texels)] = texels, self.add_file(name, ".png", _png_bytes(texels))
        return self._textures[id(texels)][1]

    def add_file(self, name: str, suffix: str, data: bytes) -> str:
        """Keeps a file that lies beside the layer; the path by which the layer names it."""
        stem = self.path_of(name, "").removeprefix("/")
        self.files[f"{stem}{suffix}"] = data
        return f"./{folder_of(self.path)}/{stem}{suffix}"


def folder_of(path: PathLike) -> str:
    """The folder of the files beside a layer: in a package, that of its own; else one that is named after the layer."""
    stem = Path(path).stem.encode(errors="replace").decode()  # layers hold UTF-8
    return "textures" if Path(path).suffix.lower() == ".usdz" else f"{stem}_textures"


def matrix(target_from_source: Doubles) -> Any:
    """A matrix of the library, which is for row vectors."""
    return pxr().Gf.Matrix4d(*np.asarray(target_from_source, np.float64).T.ravel().tolist())


def _png_bytes(texels: Texture) -> bytes:
    """A texture as PNG."""
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(texels).save(buffer, format="PNG")
    return buffer.getvalue()


class PlacedPrim(NamedTuple):
    """A prim, once for each place at which it is shown."""

    prim: Any
    world_from_prim: Doubles
    """Shape (4, 4)."""
    name: str
    visible: bool
    """Whether it is shown: lights that are not are turned off, cameras take pictures all the same."""
    animated: bool = False
    """Whether its place changes with time."""
    instanced: bool = False
    """Whether a point instancer puts it there, where its own transform does not."""

    @property
    def asset(self) -> str:
        """What it shows: the same text for all instances of a prim."""
        shared = self.prim.GetPrimInPrototype() if self.prim.IsInstanceProxy() else self.prim
        return str(shared.GetPath())

    @property
    def is_degenerate(self) -> bool:
        """Whether its place has no volume: files hide things by scaling them to nothing."""
        linear = self.world_from_prim[:3, :3]
        size = np.abs(linear).max()
        return not np.isfinite(size) or size == 0.0 or abs(np.linalg.det(linear / size)) < 1e-9


def placed_prims(file: UsdFile) -> Iterator[PlacedPrim]:
    """All prims of a file that are active and defined, parents first, each in all its places.

    Raises:
        FormatError: There are too many instances.
    """
    walk = _Walk(file, pxr().UsdGeom.XformCache(file.time))
    yield from walk.descendants(file.stage.GetPseudoRoot(), file.world_from_stage, ())


def prim_name(prim: Any) -> str:
    """The name that people gave a prim, else that of its path; that of an instance for the only prim in it."""
    px, parent = pxr(), prim.GetParent()
    if prim.IsInstanceProxy() and parent.IsInstance():
        everything = px.Usd.TraverseInstanceProxies(px.Usd.PrimDefaultPredicate)
        if len(parent.GetFilteredChildren(everything)) == 1:
            prim = parent
    return str(prim.GetDisplayName() or prim.GetName())


@dataclass(slots=True)
class _Walk:
    """A walk through a stage. It ends where there is too much of it, shown or not."""

    file: UsdFile
    xform_cache: Any
    """Transforms of prims."""
    prims: int = 0
    instances: int = 0

    def descendants(self, root: Any, world_from_base: Doubles, instancers: tuple[Any, ...]) -> Iterator[PlacedPrim]:
        """The prims at and below ``root``.

        Args:
            root: A prim.
            world_from_base: The world from the space in which the transforms of prims end, shape (4, 4).
            instancers: Paths of the point instancers around: those that show themselves end here.
        """
        file, px = self.file, pxr()
        walk = iter(px.Usd.PrimRange(root, px.Usd.TraverseInstanceProxies(px.Usd.PrimDefaultPredicate)))
        for prim in walk:
            self.prims = self._incremented(self.prims)
            # Types that the library does not know have no visibility of their own; one of them we read.
            imageable = px.UsdGeom.Imageable(prim if px.UsdGeom.Imageable(prim) else prim.GetParent())
            if not imageable and not _is_unknown_field(prim):
                continue
            local = np.array(self.xform_cache.GetLocalToWorldTransform(prim), dtype=np.float64).T
            world_from_prim = world_from_base @ local
            visible = not imageable or (
                imageable.ComputeVisibility(file.time) != "invisible"
                and imageable.ComputePurpose() in ("default", "render")
            )
            if not prim.IsA(px.UsdGeom.PointInstancer):
                animated = not instancers and _is_animated(prim)
                yield PlacedPrim(prim, world_from_prim, prim_name(prim), visible, animated, instanced=bool(instancers))
                continue
            walk.PruneChildren()  # its prototypes, which are not shown by themselves
            if visible and prim.GetPath() not in instancers:
                yield from self._instanced(prim, world_from_prim, (*instancers, prim.GetPath()))

    def _instanced(self, prim: Any, world_from_prim: Doubles, instancers: tuple[Any, ...]) -> Iterator[PlacedPrim]:
        """What a point instancer shows."""
        file, px = self.file, pxr()
        instancer = px.UsdGeom.PointInstancer(prim)
        prototypes = [file.stage.GetPrimAtPath(path) for path in instancer.GetPrototypesRel().GetForwardedTargets()]
        indices = np.array(instancer.GetProtoIndicesAttr().Get(file.time) or (), dtype=np.int64)
        mask = list(instancer.ComputeMaskAtTime(file.time))
        transforms = instancer.ComputeInstanceTransformsAtTime(
            file.time, file.time, px.UsdGeom.PointInstancer.ExcludeProtoXform, px.UsdGeom.PointInstancer.IgnoreMask
        )
        if len(transforms) != len(indices):
            raise FormatError(
                file.path, f"{prim.GetPath()} has {len(indices):,} instances, but {len(transforms):,} places"
            )
        for number, (which, transform) in enumerate(zip(indices, transforms, strict=True)):
            if mask and not mask[number]:
                continue
            self.instances = self._incremented(self.instances)
            if not 0 <= which < len(prototypes) or not prototypes[which]:
                raise FormatError(file.path, f"{prim.GetPath()} shows prototype {which} of {len(prototypes)}")
            root = prototypes[which]
            # Where the prototype lies in the file does not matter: its own transform does, those above it do not.
            above = np.array(self.xform_cache.GetParentToWorldTransform(root), dtype=np.float64).T
            placed = world_from_prim @ np.array(transform, dtype=np.float64).T @ np.linalg.inv(above)
            yield from self.descendants(root, placed, instancers)

    def _incremented(self, before: int) -> int:
        """One more."""
        if before >= USD_INSTANCES_MAX:
            raise FormatError(self.file.path, f"shows more than {USD_INSTANCES_MAX:,} prims: instances of instances")
        return before + 1


def _is_unknown_field(prim: Any) -> bool:
    return str(prim.GetTypeName()).startswith("ParticleField") and not pxr().UsdGeom.Imageable(prim)


def _is_animated(prim: Any) -> bool:
    """Whether the transform of a prim, or of one above it, changes with time."""
    px = pxr()
    while prim and not prim.IsPseudoRoot():
        xformable = px.UsdGeom.Xformable(prim)
        if xformable and xformable.TransformMightBeTimeVarying():
            return True
        if xformable and xformable.GetResetXformStack():
            return False
        prim = prim.GetParent()
    return False
