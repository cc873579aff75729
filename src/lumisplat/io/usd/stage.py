"""Opens OpenUSD stages, reads attribute values and assets, and builds new stages.

`UsdFile` is an open stage with its current time code and its transform to the world (y up, metres). `placed_prims`
traverses all prims, including instances and point instancers. `StageWriter` builds a stage in memory. Features that
cannot be read or written are collected as `Remarks` and reported in one log line.
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
"""Largest number of prims of a file, and largest number of instances that its point instancers make. Nested instances
multiply, so a small file could ask for any number."""

_NAMES_LISTED = 3
"""Largest number of prim names that a log line lists for each feature that is lost."""
_REMARKS_LISTED = 12
"""Largest number of lost features that one log line lists."""

_CUSTOM_DATA_KEY = "lumisplat"
"""Key in a prim's customData. Its value is a dictionary of the Lumisplat settings for which OpenUSD has no attribute.
"""
_UNIT_ERROR = 1e-9
"""metersPerUnit counts as 1, and no change of unit is logged, if it differs from 1 by at most this."""

_ROOT = "/World"
"""Path of the default prim, the parent of all written prims."""


@dataclass(slots=True)
class Remarks:
    """Collects remarks: features that are lost when a file is read or written, with the prims that have them."""

    path: PathLike
    head: str
    """Words of the log line between the file's path and the remarks, such as "not read, or read differently"."""
    names: dict[str, list[str]] = field(default_factory=dict[str, list[str]])

    def add(self, remark: str, name: str = "") -> None:
        """Records a feature of a file that Lumisplat leaves out, or reads with another meaning than the file gives it.

        Args:
            remark: The feature, such as ``"the range of lights"``.
            name: Name or path of the prim that has the feature; empty if the remark concerns the whole file.
        """
        names = self.names.setdefault(remark, [])
        if name and name not in names:
            names.append(name)

    def report(self) -> None:
        """Logs all lost features as one warning; logs nothing if there are none."""
        if not self.names:
            return
        messages = [remark + _listed(names) for remark, names in self.names.items()]
        more = f"; and {len(messages) - _REMARKS_LISTED} more" if len(messages) > _REMARKS_LISTED else ""
        _log.warning("%s: %s: %s%s", os.fspath(self.path), self.head, "; ".join(messages[:_REMARKS_LISTED]), more)


def _listed(names: list[str]) -> str:
    """Returns the first few names in brackets and how many more there are; an empty string for no names."""
    more = f" and {len(names) - _NAMES_LISTED} more" if len(names) > _NAMES_LISTED else ""
    return f" ({', '.join(names[:_NAMES_LISTED])}{more})" if names else ""


@dataclass(slots=True)
class UsdFile:
    """An open OpenUSD stage, its current time code and its transform to the world."""

    path: Path
    stage: Any
    time: Any
    """Time code at which attributes are read (`pxr.Usd.TimeCode`)."""
    world_from_stage: Doubles
    """Transform from stage space to the world, which has y up and metres, shape (4, 4)."""
    remarks: Remarks
    layers: list[Any]
    """Layers that this object keeps alive, because usd-core drops layers without references."""

    @property
    def unit(self) -> float:
        """Length of one stage unit in metres (metersPerUnit)."""
        return float(np.linalg.norm(self.world_from_stage[:3, 0]))

    def world_transform(self, matrix: Any) -> Doubles:
        """Returns ``world_from_prim``, shape (4, 4), from a ``Gf.Matrix4d``, which transforms row vectors."""
        return self.world_from_stage @ np.array(matrix, dtype=np.float64).T


def open_usd(path: Path) -> UsdFile:
    """Opens an OpenUSD file and composes its stage, after checking every layer.

    Raises:
        FormatError: The file or one of its layers is damaged or names a file outside of its folder, or upAxis or
            metersPerUnit is invalid.
        MissingFileError: There is no such file.
    """
    px = pxr()
    if not path.exists():
        raise MissingFileError(path, "no such file")
    with utf8_path(path) as text:
        layers = check_layers(path, text)
        stage = px.Usd.Stage.Open(text)
    if not stage:
        raise FormatError(path, "damaged, or not a USD file")
    remarks = Remarks(path, "not read, or read differently")
    for error in stage.GetCompositionErrors():
        remarks.add("layers that cannot be composed", _first_line(str(error), path))
    return UsdFile(path, stage, _first_time(stage), _world_from_stage(path, stage, remarks), remarks, layers)


def _first_time(stage: Any) -> Any:
    """Returns the stage's startTimeCode if its time range is authored, else the earliest time of each attribute."""
    code = pxr().Usd.TimeCode
    return code(stage.GetStartTimeCode()) if stage.HasAuthoredTimeCodeRange() else code.EarliestTime()


def _world_from_stage(path: Path, stage: Any, remarks: Remarks) -> Doubles:
    """Returns the transform from stage space to the world, shape (4, 4); a change of up axis or unit is logged."""
    geom, matrix = pxr().UsdGeom, np.eye(4)
    axis = str(geom.GetStageUpAxis(stage))
    if axis not in ("Y", "Z"):
        raise FormatError(path, f"has upAxis {axis!r}, expected Y or Z")
    if axis == "Z":
        matrix[:3, :3] = axis_rotation((1.0, 0.0, 0.0), -0.5 * math.pi).round()
        remarks.add("upAxis Z: rotated to y up")
    if geom.StageHasAuthoredMetersPerUnit(stage):
        unit = float(geom.GetStageMetersPerUnit(stage))
        if not 0.0 < unit < math.inf:
            raise FormatError(path, f"has metersPerUnit {unit:g}, expected a length above 0")
        if abs(unit - 1.0) > _UNIT_ERROR:
            matrix[:3, :3] *= unit
            remarks.add(f"metersPerUnit {unit:g}: scaled to metres")
    return matrix


def _first_line(text: str, path: Path) -> str:
    """Returns a message of usd-core on one line of at most 120 characters, without the file's path."""
    text_line = " ".join(text.replace(os.fspath(path), "it").split())
    return text_line[:120]


def value(file: UsdFile, prim: Any, name: str, default: Any = None) -> Any:
    """Returns the value of an attribute at the current time code, or ``default`` if the attribute has none."""
    attribute = prim.GetAttribute(name)
    found = attribute.Get(file.time) if attribute else None
    return default if found is None else found


def shortest(found: float) -> float:
    """Returns the shortest decimal number that rounds to the float32 value: 0.4, not 0.4000000059604645."""
    single = np.float32(found)
    return float(str(single)) if float(single) == found else float(found)


def custom_data_of(prim: Any) -> dict[str, Any]:
    """Returns the Lumisplat settings in a prim's customData; empty for files of other programs."""
    found = prim.GetCustomDataByKey(_CUSTOM_DATA_KEY)
    return found if isinstance(found, dict) else {}  # pyright: ignore[reportUnknownVariableType]


def number(file: UsdFile, prim: Any, name: str, default: float) -> float:
    """Reads a numeric attribute, with ``default`` if it has no value.

    Raises:
        FormatError: The value is not a number.
    """
    found = value(file, prim, name, default)
    try:
        return shortest(float(found))
    except (TypeError, ValueError):
        raise FormatError(file.path, f"{prim.GetPath()}.{name} is {str(found)[:40]!r}, expected a number") from None


def array(file: UsdFile, prim: Any, name: str, columns: int) -> npt.NDArray[np.float32] | None:
    """Reads an array attribute as float32: N rows, shape (N, columns), or (N,) for one column; None if it is empty.

    Raises:
        FormatError: The rows have another number of columns, or hold no numbers.
    """
    found = value(file, prim, name)
    return None if found is None else rows(file, f"{prim.GetPath()}.{name}", found, columns)


def rows(file: UsdFile, label: str, found: Any, columns: int) -> npt.NDArray[np.float32] | None:
    """Converts ``found``, the value of an array attribute, to float32.

    Args:
        file: The open file.
        label: Name of the attribute, for errors.
        found: The value.
        columns: Numbers per row.

    Returns:
        N rows, shape (N, columns), or (N,) if ``columns`` is 1; None if the array is empty.
    """
    try:
        values = np.array(found, dtype=np.float32)
    except (TypeError, ValueError):
        raise FormatError(file.path, f"{label} is not an array of numbers") from None
    if values.size == 0:
        return None
    if values.shape[1:] != ((columns,) if columns > 1 else ()):
        raise FormatError(file.path, f"{label} has rows of shape {values.shape[1:]}, expected {columns} numbers")
    return values


def whole_numbers(file: UsdFile, prim: Any, name: str) -> npt.NDArray[np.int64]:
    """Reads an integer array attribute, a one-dimensional array; empty if the attribute has no value.

    Raises:
        FormatError: The array does not hold integers, or has more than one axis.
    """
    found = np.array(value(file, prim, name, ()))
    if found.size == 0:
        return np.zeros(0, np.int64)
    if found.dtype.kind not in "iu" or found.ndim != 1:
        raise FormatError(file.path, f"{prim.GetPath()}.{name} is not an array of integers")
    return found.astype(np.int64)


def asset_name(asset: Any) -> str:
    """Returns the path of an asset as the layer spells it, before it is resolved."""
    return str(getattr(asset, "path", asset))


def asset_bytes(file: UsdFile, asset: Any, label: str) -> bytes:
    """Reads the file that an asset attribute names, such as a texture.

    In the child process that reads OpenUSD files, the memory limit is raised first, because the asset will be decoded.

    Args:
        file: The open file.
        asset: An ``Sdf.AssetPath`` with its resolved path, or a path as text.
        label: The prim or shader that names the asset, for messages.

    Raises:
        FormatError: The asset is missing, outside of the stage's folder, or cannot be read.
    """
    data = _stored_bytes(file, asset, label)
    raise_limit_for_asset(len(data))
    return data


def _stored_bytes(file: UsdFile, asset: Any, label: str) -> bytes:
    """Reads the bytes of an asset: a separate file, or an uncompressed entry of a .usdz package."""
    ar, name = pxr().Ar, asset_name(asset)
    found = str(getattr(asset, "resolvedPath", "")) or name
    if found == name and file.path.suffix.lower() == ".usdz":  # a path that is not resolved may lie in the package
        found = ar.JoinPackageRelativePath([os.fspath(file.path), os.path.normpath(name)])
    if not ar.IsPackageRelativePath(found):
        return read_reference(file.path, found)
    package, inner = ar.SplitPackageRelativePathOuter(found)
    package_path = referenced_file(file.path, package)
    try:
        check_regular(package_path, package_path.stat())
        # Packages inside packages are not supported; USD advises against them.
        with zipfile.ZipFile(package_path) as archive:
            entry = archive.getinfo(inner)
            if entry.file_size > FILE_BYTES_MAX or entry.compress_type != zipfile.ZIP_STORED:
                raise FormatError(file.path, f"{label} names {name[:200]!r}, which is compressed or too large")
            return archive.read(entry)
    except FormatError:
        raise
    except (KeyError, OSError, zipfile.BadZipFile):
        raise FormatError(file.path, f"{label} names {name[:200]!r}, which is not in {Path(package).name}") from None


@dataclass(slots=True)
class StageWriter:
    """Builds a stage in memory.

    The stage is in metres, with z up if the scene has z up and y up otherwise. The root prim rotates a scene with any
    other up direction.
    """

    path: Path
    up: Vector
    """Up direction of the scene to write, a unit vector. In the stage, z up stays z up, and any other direction
    becomes y."""
    stage: Any = field(init=False)
    remarks: Remarks = field(init=False)
    files: dict[str, bytes] = field(default_factory=dict[str, bytes])
    """Contents of the texture files to write next to the layer, by file name."""
    _textures: dict[int, tuple[Texture, str]] = field(default_factory=dict[int, "tuple[Texture, str]"])
    """Texels and asset path of each texture written so far, by the ``id`` of the texels. The texels are stored so that
    no other object gets their id."""
    _paths: set[str] = field(default_factory=set[str])

    def __post_init__(self) -> None:
        px = pxr()
        self.remarks = Remarks(self.path, "OpenUSD cannot store everything, left out or simplified")
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
        """Returns an unused prim path below ``parent``, from ``name`` with ``_`` in place of invalid characters."""
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
        """Path of the scope that holds all materials; the scope is created on first use."""
        path = f"{_ROOT}/Materials"
        if not self.stage.GetPrimAtPath(path):
            pxr().UsdGeom.Scope.Define(self.stage, path)
        return path

    def set_custom_data(self, prim: Any, **settings: Any) -> None:
        """Stores Lumisplat settings in a prim's customData, which only Lumisplat reads."""
        for key, setting in settings.items():
            prim.SetCustomDataByKey(f"{_CUSTOM_DATA_KEY}:{key}", setting)

    def name(self, prim: Any, name: str) -> None:
        """Sets a prim's displayName to ``name`` if the prim path cannot contain the name."""
        if name and prim.GetName() != name:
            prim.SetDisplayName(name)

    def set_transform(self, prim: Any, world_from_object: Doubles) -> None:
        """Sets the transform of a prim that is a child of the root prim, shape (4, 4); the identity is not written."""
        if not np.array_equal(world_from_object, np.eye(4)):
            pxr().UsdGeom.Xformable(prim).AddTransformOp().Set(matrix(world_from_object))

    def texture(self, texels: Texture, name: str) -> str:
        """Returns the asset path of a texture; the first call for a texture also stores it as PNG."""
        if id(texels) not in self._textures:
            self._textures[id(texels)] = texels, self.add_file(name, ".png", _png_bytes(texels))
        return self._textures[id(texels)][1]

    def add_file(self, name: str, suffix: str, data: bytes) -> str:
        """Stores a file to be written next to the layer, and returns the asset path for it."""
        stem = self.path_of(name, "").removeprefix("/")
        self.files[f"{stem}{suffix}"] = data
        return f"./{folder_of(self.path)}/{stem}{suffix}"


def folder_of(path: PathLike) -> str:
    """Returns the name of the folder for textures: ``textures`` in a .usdz package, else ``NAME_textures``."""
    stem = Path(path).stem.encode(errors="replace").decode()  # layers store UTF-8
    return "textures" if Path(path).suffix.lower() == ".usdz" else f"{stem}_textures"


def matrix(target_from_source: Doubles) -> Any:
    """Returns a ``Gf.Matrix4d``, which transforms row vectors, from a matrix for column vectors, shape (4, 4)."""
    return pxr().Gf.Matrix4d(*np.asarray(target_from_source, np.float64).T.ravel().tolist())


def _png_bytes(texels: Texture) -> bytes:
    """Encodes a texture as PNG."""
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(texels).save(buffer, format="PNG")
    return buffer.getvalue()


RENDERED_PURPOSES = ("default", "render")
"""Purposes of prims that are rendered; those of proxies and guides are not."""


class PlacedPrim(NamedTuple):
    """A prim with its transform to the world. A prim with several instances has one `PlacedPrim` for each instance."""

    prim: Any
    world_from_prim: Doubles
    """Transform from the prim's space to the world, shape (4, 4)."""
    name: str
    visible: bool
    """True if the prim's visibility and purpose let it be rendered. A hidden light is read as disabled; a hidden
    camera is read as usual."""
    animated: bool = False
    """True if the prim's transform has time samples."""
    instanced: bool = False
    """True if a point instancer places the prim."""

    @property
    def asset(self) -> str:
        """Path of the prim in its prototype. All instances of the prim have the same path."""
        shared = self.prim.GetPrimInPrototype() if self.prim.IsInstanceProxy() else self.prim
        return str(shared.GetPath())

    @property
    def is_degenerate(self) -> bool:
        """True if the transform is singular or not finite. Files hide a prim by scaling it to zero."""
        linear = self.world_from_prim[:3, :3]
        size = np.abs(linear).max()
        return not np.isfinite(size) or size == 0.0 or abs(np.linalg.det(linear / size)) < 1e-9


def placed_prims(file: UsdFile) -> Iterator[PlacedPrim]:
    """Yields all active, defined prims of a file, parents first; a prim with several instances is yielded for each.

    Raises:
        FormatError: There are more than `USD_INSTANCES_MAX` prims or instances.
    """
    walk = _Walk(file, pxr().UsdGeom.XformCache(file.time))
    yield from walk.descendants(file.stage.GetPseudoRoot(), file.world_from_stage, ())


def prim_name(prim: Any) -> str:
    """Returns the display name of a prim, or else the last part of its path.

    The only prim inside an instance gets the name of the instance.
    """
    px, parent = pxr(), prim.GetParent()
    if prim.IsInstanceProxy() and parent.IsInstance():
        everything = px.Usd.TraverseInstanceProxies(px.Usd.PrimDefaultPredicate)
        if len(parent.GetFilteredChildren(everything)) == 1:
            prim = parent
    return str(prim.GetDisplayName() or prim.GetName())


@dataclass(slots=True)
class _Walk:
    """A traversal of a stage that counts prims and instances, hidden ones too, up to `USD_INSTANCES_MAX` of each."""

    file: UsdFile
    xform_cache: Any
    """``UsdGeom.XformCache`` at the current time code."""
    prims: int = 0
    instances: int = 0

    def descendants(self, root: Any, world_from_base: Doubles, instancers: tuple[Any, ...]) -> Iterator[PlacedPrim]:
        """Yields ``root`` and the prims below it.

        Args:
            root: A prim.
            world_from_base: Transform, shape (4, 4), applied after each prim's transform in ``xform_cache``: from stage
                space to the world or, below a prototype, from the prototype to an instance in the world.
            instancers: Paths of the enclosing point instancers. An instancer that instances itself is skipped.
        """
        file, px = self.file, pxr()
        walk = iter(px.Usd.PrimRange(root, px.Usd.TraverseInstanceProxies(px.Usd.PrimDefaultPredicate)))
        for prim in walk:
            self.prims = self._incremented(self.prims)
            # Prims of types that the library does not know, such as particle fields, inherit visibility.
            imageable = px.UsdGeom.Imageable(prim if px.UsdGeom.Imageable(prim) else prim.GetParent())
            if not imageable and not _is_unknown_field(prim):
                continue
            local = np.array(self.xform_cache.GetLocalToWorldTransform(prim), dtype=np.float64).T
            world_from_prim = world_from_base @ local
            visible = not imageable or (
                imageable.ComputeVisibility(file.time) != "invisible"
                and imageable.ComputePurpose() in RENDERED_PURPOSES
            )
            if not prim.IsA(px.UsdGeom.PointInstancer):
                animated = not instancers and _is_animated(prim)
                yield PlacedPrim(prim, world_from_prim, prim_name(prim), visible, animated, instanced=bool(instancers))
                continue
            walk.PruneChildren()  # prototypes are not rendered by themselves
            if visible and prim.GetPath() not in instancers:
                yield from self._instanced(prim, world_from_prim, (*instancers, prim.GetPath()))

    def _instanced(self, prim: Any, world_from_prim: Doubles, instancers: tuple[Any, ...]) -> Iterator[PlacedPrim]:
        """Yields the prims of each instance that a point instancer makes, with their transforms."""
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
                file.path, f"{prim.GetPath()} has {len(indices):,} instances, but {len(transforms):,} transforms"
            )
        for number, (which, transform) in enumerate(zip(indices, transforms, strict=True)):
            if mask and not mask[number]:
                continue
            self.instances = self._incremented(self.instances)
            if not 0 <= which < len(prototypes) or not prototypes[which]:
                raise FormatError(
                    file.path, f"{prim.GetPath()} refers to prototype {which}, but has {len(prototypes)} prototypes"
                )
            root = prototypes[which]
            # A prototype keeps its own transform, but not those of its ancestors.
            above = np.array(self.xform_cache.GetParentToWorldTransform(root), dtype=np.float64).T
            placed = world_from_prim @ np.array(transform, dtype=np.float64).T @ np.linalg.inv(above)
            yield from self.descendants(root, placed, instancers)

    def _incremented(self, before: int) -> int:
        """Returns ``before + 1``, the new number of prims or instances.

        Raises:
            FormatError: ``before`` has reached `USD_INSTANCES_MAX`.
        """
        if before >= USD_INSTANCES_MAX:
            raise FormatError(self.file.path, f"has more than {USD_INSTANCES_MAX:,} prims or instances")
        return before + 1


def _is_unknown_field(prim: Any) -> bool:
    """Returns whether a prim is a particle field of a type that this version of usd-core does not know."""
    return str(prim.GetTypeName()).startswith("ParticleField") and not pxr().UsdGeom.Imageable(prim)


def _is_animated(prim: Any) -> bool:
    """Returns whether the transform of a prim or of an ancestor has time samples."""
    px = pxr()
    while prim and not prim.IsPseudoRoot():
        xformable = px.UsdGeom.Xformable(prim)
        if xformable and xformable.TransformMightBeTimeVarying():
            return True
        if xformable and xformable.GetResetXformStack():
            return False
        prim = prim.GetParent()
    return False
