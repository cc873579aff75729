"""The stage that is written: its axes and units, the names of its prims, and the textures that go with it."""

from __future__ import annotations

import io
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from lumisplat.io.files.source import PathLike
from lumisplat.io.usd.library import pxr
from lumisplat.io.usd.remarks import Remarks
from lumisplat.io.usd.stage import HINT
from lumisplat.math.arrays import Doubles
from lumisplat.scene.textures import Texture
from lumisplat.scene.up import Vector, up_vector, y_up_from

ROOT = "/World"
"""Path of the prim that holds everything."""


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
        self.remarks = Remarks(self.path, "OpenUSD has no place for all of it, left out or simplified")
        self.stage = px.Usd.Stage.CreateInMemory(".usdc")
        is_z_up = self.up == up_vector("z-up")
        px.UsdGeom.SetStageUpAxis(self.stage, "Z" if is_z_up else "Y")
        px.UsdGeom.SetStageMetersPerUnit(self.stage, 1.0)
        self._paths.add(f"{ROOT}/Materials")
        root = px.UsdGeom.Xform.Define(self.stage, ROOT)
        self.stage.SetDefaultPrim(root.GetPrim())
        turn = np.eye(4)
        turn[:3, :3] = np.eye(3) if is_z_up else y_up_from(self.up)
        self.place(root.GetPrim(), turn)

    def path_of(self, name: str, parent: str = ROOT) -> str:
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
        path = f"{ROOT}/Materials"
        if not self.stage.GetPrimAtPath(path):
            pxr().UsdGeom.Scope.Define(self.stage, path)
        return path

    def hint(self, prim: Any, **noted: Any) -> None:
        """Notes at a prim what only we read."""
        for key, held in noted.items():
            prim.SetCustomDataByKey(f"{HINT}:{key}", held)

    def name(self, prim: Any, name: str) -> None:
        """Keeps the name of a prim whose path cannot be it."""
        if name and prim.GetName() != name:
            prim.SetDisplayName(name)

    def place(self, prim: Any, world_from_object: Doubles) -> None:
        """Places a prim below the root."""
        if not np.array_equal(world_from_object, np.eye(4)):
            pxr().UsdGeom.Xformable(prim).AddTransformOp().Set(matrix(world_from_object))

    def texture(self, texels: Texture, name: str) -> str:
        """The path at which a texture lies beside the layer."""
        if id(texels) not in self._textures:
            self._textures[id(texels)] = texels, self.add_file(name, ".png", png_bytes(texels))
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


def png_bytes(texels: Texture) -> bytes:
    """A texture as PNG."""
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(texels).save(buffer, format="PNG")
    return buffer.getvalue()
