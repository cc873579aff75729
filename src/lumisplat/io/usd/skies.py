"""Skies of OpenUSD files: dome lights, whose images have +z in the middle and +x to the left of it."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from lumisplat.errors import FormatError
from lumisplat.io.images.radiance import read_radiance
from lumisplat.io.images.texture import decode_texture
from lumisplat.io.usd.assets import asset_bytes, asset_name
from lumisplat.io.usd.library import pxr
from lumisplat.io.usd.stage import UsdFile
from lumisplat.io.usd.values import value
from lumisplat.io.usd.walk import Placed
from lumisplat.math.arrays import Doubles, FloatArray
from lumisplat.math.color import decode_srgb
from lumisplat.math.rotations import quaternions_from_matrices
from lumisplat.scene.lights import LightEnvironment

DOME_FROM_SKY = np.diag([-1.0, 1.0, -1.0])
"""Our skies have -z in the middle and +x to the right of it: half a turn about the pole."""
_Z_FROM_Y = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""Stands a dome whose pole is y up along z, so that its middle looks to -y."""
_RADIANCE = (".hdr", ".pic", ".exr")


def read_sky(
    file: UsdFile, placed: Placed, emission: float, shared: dict[str, Any], shadow_distance: float
) -> LightEnvironment | None:
    """A dome light as an environment; None, with a remark, if its image is no panorama.

    Raises:
        FormatError: The image is missing or damaged.
    """
    prim = placed.prim
    asset, layout = (
        value(file, prim, "inputs:texture:file"),
        str(value(file, prim, "inputs:texture:format", "automatic")),
    )
    image = None
    if asset is not None and asset_name(asset):
        if layout not in ("automatic", "latlong"):
            file.remarks.add(f"skies of format {layout}", str(prim.GetPath()))
            return None
        image = _image(file, asset, str(prim.GetPath()))
    world_from_dome = placed.world_from_prim[:3, :3]
    pole = str(value(file, prim, "poleAxis", "Y")) if str(prim.GetTypeName()) == "DomeLight_1" else "Y"
    if pole == "Z" or (pole == "scene" and str(pxr().UsdGeom.GetStageUpAxis(file.stage)) == "Z"):
        world_from_dome = world_from_dome @ _Z_FROM_Y
    turn = _rotation(world_from_dome)
    if np.linalg.det(world_from_dome) < 0.0:
        file.remarks.add("skies that are mirrored", str(prim.GetPath()))
    return LightEnvironment(
        image,
        intensity=emission,
        rotation_wxyz=quaternions_from_matrices((turn @ DOME_FROM_SKY)[None])[0],
        shadow_distance=shadow_distance,
        **shared,
    )


def _rotation(linear: Doubles) -> Doubles:
    """The rotation that is nearest to a matrix, shape (3, 3)."""
    left, _, right = np.linalg.svd(linear)
    return left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right


def _image(file: UsdFile, asset: Any, label: str) -> FloatArray:
    """Linear radiance, shape (H, W, 3)."""
    name, data = asset_name(asset), asset_bytes(file, asset, label)
    if Path(name).suffix.lower() not in _RADIANCE:
        texels = decode_texture(data, file.path, name)[:, :, :3]
        return decode_srgb(texels / np.float32(255.0)).astype(np.float32)
    with tempfile.TemporaryDirectory() as folder:  # the reader of OpenEXR takes a file
        copy = Path(folder) / f"sky{Path(name).suffix.lower()}"
        copy.write_bytes(data)
        try:
            return read_radiance(copy)
        except FormatError as error:
            raise FormatError(file.path, str(error).replace(os.fspath(copy), name)) from None
