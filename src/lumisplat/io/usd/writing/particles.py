"""Captures as particle fields."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import numpy.typing as npt

from lumisplat.constants import KERNEL_DEGREE
from lumisplat.io.splats.orientation import orientation_values
from lumisplat.io.usd.library import pxr
from lumisplat.io.usd.particles import COLOR_SPACE, PRIMVARS
from lumisplat.io.usd.writing.stage import StageWriter
from lumisplat.scene.gaussians import Gaussians

_REACH = 3.0
"""Scales at which a Gaussian ends, for the extent of a field."""
_HARMONICS = "radiance:sphericalHarmonics"


def define_field(writer: StageWriter, path: str, gaussians: Gaussians) -> Any:
    """Writes a capture in its own coordinates; its prim."""
    px = pxr()
    prim = px.UsdVol.ParticleField3DGaussianSplat.Define(writer.stage, path).GetPrim()
    for name, values in particle_values(gaussians).items():
        prim.GetAttribute(name).Set(values)
    prim.GetAttribute(f"{_HARMONICS}Degree").Set(gaussians.sh_degree)
    # Which the schema leaves open: how many belong together, as others write it, and what the colours are.
    coefficients = prim.GetAttribute(f"{_HARMONICS}Coefficients")
    coefficients.SetMetadata("elementSize", gaussians.sh.shape[1])
    coefficients.SetMetadata("interpolation", "vertex")
    coefficients.SetColorSpace(COLOR_SPACE)
    prim.GetAttribute("projectionModeHint").Set("perspective")
    prim.GetAttribute("sortingModeHint").Set("zDepth")
    _write_materials(prim, gaussians)
    _write_hints(writer, prim, gaussians)
    return prim


def particle_values(gaussians: Gaussians) -> dict[str, Any]:
    """The values of a field's attributes that may change with time, by their names."""
    vt = pxr().Vt
    return {
        "positions": vt.Vec3fArray.FromNumpy(gaussians.means),
        # The arrays of the library are x, y, z, w, though its texts are w, x, y, z.
        "orientations": vt.QuatfArray.FromNumpy(np.ascontiguousarray(gaussians.rotations_wxyz[:, [1, 2, 3, 0]])),
        "scales": vt.Vec3fArray.FromNumpy(gaussians.scales),
        "opacities": vt.FloatArray.FromNumpy(gaussians.opacities),
        f"{_HARMONICS}Coefficients": vt.Vec3fArray.FromNumpy(gaussians.sh.reshape(-1, 3)),
        "extent": vt.Vec3fArray.FromNumpy(_extent(gaussians)),
    }


def _extent(gaussians: Gaussians) -> npt.NDArray[np.float32]:
    """Corners of a box around all Gaussians, shape (2, 3)."""
    reach = _REACH * gaussians.scales.max(axis=1, keepdims=True)
    return np.stack([(gaussians.means - reach).min(axis=0), (gaussians.means + reach).max(axis=0)])


def _write_materials(prim: Any, gaussians: Gaussians) -> None:
    """Normals and materials of relightable captures, as primvars."""
    px = pxr()
    types, primvars = px.Sdf.ValueTypeNames, px.UsdGeom.PrimvarsAPI(prim)
    kinds = {"normals": types.Normal3fArray, "albedo": types.Color3fArray}
    for name, columns in PRIMVARS.items():
        values = getattr(gaussians, name)
        if values is not None:
            array = px.Vt.Vec3fArray if columns == 3 else px.Vt.FloatArray
            primvar = primvars.CreatePrimvar(name, kinds.get(name, types.FloatArray), px.UsdGeom.Tokens.vertex)
            primvar.Set(array.FromNumpy(values))


def _write_hints(writer: StageWriter, prim: Any, gaussians: Gaussians) -> None:
    """What only we read: how the capture was trained, and the comments of its file."""
    if gaussians.antialiased:
        writer.hint(prim, antialiased=True)
        writer.remarks.add("that a capture was trained antialiased, which only Lumisplat will know")
    if gaussians.kernel_degree != KERNEL_DEGREE:
        writer.hint(prim, kernelDegree=gaussians.kernel_degree)
        writer.remarks.add(f"kernel degree {gaussians.kernel_degree}, which only Lumisplat will know")
    if stated := orientation_values(gaussians.up, gaussians.first_view):
        writer.hint(prim, orientation=json.dumps(stated))
    if gaussians.comments:
        writer.hint(prim, comments=pxr().Vt.StringArray(list(gaussians.comments)))
