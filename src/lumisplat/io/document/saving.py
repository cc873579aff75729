"""What a saved scene file needs beside it: paths that start from its folder, and files of what is in memory."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, cast

import numpy as np

from lumisplat.errors import FormatError
from lumisplat.io.document.entries import EntryReader, SceneEntry
from lumisplat.io.document.written import material_table
from lumisplat.io.images.exr import write_exr
from lumisplat.io.images.png import write_png
from lumisplat.io.meshes.obj_writer import write_obj
from lumisplat.io.splats.splat_ply import write_splat_ply
from lumisplat.math.arrays import FloatArray
from lumisplat.math.transforms import transform_points
from lumisplat.scene.materials import Material, texture_names
from lumisplat.scene.mesh import Mesh
from lumisplat.scene.scene import MeshInstance


def relocated(values: Mapping[str, Any], source: Path, target: Path) -> dict[str, Any]:
    """A table whose paths start from another folder; those to other drives become absolute.

    Args:
        values: The table, and tables in it: ``path``, and what ends in ``_texture``, are paths.
        source: Folder from which they start.
        target: Folder from which they shall start.
    """
    moved: dict[str, Any] = {}
    for key, value in values.items():
        if isinstance(value, Mapping):
            moved[key] = relocated(cast(Mapping[str, Any], value), source, target)
        elif isinstance(value, list) and value and all(isinstance(item, Mapping) for item in cast(list[object], value)):
            moved[key] = [relocated(item, source, target) for item in cast(list[Mapping[str, Any]], value)]
        elif isinstance(value, str) and (key == "path" or key.endswith("_texture")) and not value.startswith("<"):
            moved[key] = _relative(source / value, target)
        else:
            moved[key] = value
    return moved


def _relative(path: Path, folder: Path) -> str:
    try:
        return Path(os.path.relpath(path, folder)).as_posix()
    except ValueError:  # another drive
        return path.absolute().as_posix()


def saved_assets(entries: Iterable[SceneEntry], reader: EntryReader, target: Path) -> tuple[SceneEntry, ...]:
    """Entries with files in place of what is in memory, which are written for them into ``NAME.assets``.

    Args:
        entries: Of a document.
        reader: Has what is in memory.
        target: The scene file that is to be written.

    Raises:
        FormatError: Something has no file format, or cannot be written.
    """
    folder = _Folder(target.with_name(f"{target.stem}.assets"), reader)
    changed: list[SceneEntry] = []
    for entry in entries:
        path = str(entry.table.get("path", ""))
        if entry.actor is not None and not path:
            raise FormatError(target, f"{entry.name} was made by a program, and no file holds such an actor: remove it")
        table = folder.written(path, entry.table) if path.startswith("<") else entry.table
        changed.append(replace(entry, table=table))
    return tuple(changed)


@dataclass(slots=True)
class _Folder:
    """The folder beside a scene file, and what has been written there."""

    path: Path
    reader: EntryReader
    _files: dict[str, Path] = field(default_factory=dict[str, Path])

    def written(self, memory_path: str, table: Mapping[str, Any]) -> dict[str, Any]:
        """The table of an entry that names a file in place of something in memory."""
        self.path.mkdir(parents=True, exist_ok=True)
        name = memory_path.strip("<>").replace(" ", "_")
        if memory_path in self.reader.skies:
            file = self._once(memory_path, f"{name}.exr", lambda file: _write_sky(file, self.reader.skies[memory_path]))
            return dict(table) | {"path": str(file)}
        asset = self.reader.memory[memory_path]
        if asset.splats:
            gaussians = asset.splats[0].gaussians
            file = self._once(memory_path, f"{name}.ply", lambda file: write_splat_ply(file, gaussians))
            return dict(table) | {"path": str(file)}
        mesh = _baked(asset.meshes[0])
        file = self._once(memory_path, f"{name}.obj", lambda file: write_obj(file, mesh))
        own = material_table(mesh.material) | self._textures(mesh.material, name)
        given: Any = table.get("material")
        merged: Any = given or own
        if isinstance(given, Mapping):
            merged = own | dict(cast(Mapping[str, Any], given))
        return dict(table) | {"path": str(file), "material": merged}

    def _once(self, memory_path: str, name: str, write: Callable[[Path], None]) -> Path:
        """The absolute path of a file, written when it is asked for first."""
        if memory_path not in self._files:
            file = (self.path / name).absolute()
            write(file)
            self._files[memory_path] = file
        return self._files[memory_path]

    def _textures(self, material: Material, name: str) -> dict[str, str]:
        """The textures of a material, as files."""
        textures: dict[str, str] = {}
        for key in texture_names(material):
            texture = getattr(material, key)
            if texture is not None:
                file = (self.path / f"{name}.{key}.png").absolute()
                write_png(file, texture.astype(np.float32) / 255.0)
                textures[key] = str(file)
        return textures


def _baked(instance: MeshInstance) -> Mesh:
    """The mesh of an instance, its transform applied."""
    if np.array_equal(instance.transform, np.eye(4)):
        return instance.mesh
    mesh, linear = instance.mesh, instance.transform[:3, :3]
    flipped = np.linalg.det(linear) < 0.0
    return replace(
        mesh,
        positions=transform_points(instance.transform, mesh.positions).astype(np.float32),
        normals=None if mesh.normals is None else (mesh.normals @ np.linalg.inv(linear)).astype(np.float32),
        indices=mesh.indices[:, ::-1] if flipped else mesh.indices,
    )


def _write_sky(file: Path, image: FloatArray) -> None:
    write_exr(file, {name: image[..., channel] for channel, name in enumerate("RGB")})
