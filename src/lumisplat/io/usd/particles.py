"""Reads and writes Gaussian splats of OpenUSD 26.03 and later (UsdVol.ParticleField3DGaussianSplat)."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import numpy.typing as npt

from lumisplat.constants import FLAT_THICKNESS, KERNEL_DEGREE, KERNEL_DEGREE_MAX, SH_DEGREE_MAX
from lumisplat.io.splats.columns import SplatColumns, look_like_logits
from lumisplat.io.splats.orientation import orientation_of_text, orientation_values
from lumisplat.io.usd.library import pxr
from lumisplat.io.usd.stage import StageWriter, UsdFile, array, custom_data_of, number
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.ops.colors import display_sh

_TYPES = ("ParticleField3DGaussianSplat", "ParticleField", "ParticleField_3DGaussianSplat")
"""Type names of prims that may hold Gaussians: the name in OpenUSD 26.03, the base type with applied API schemas, and
the name that Nuke 17.0 writes."""
_KERNEL = "ParticleFieldKernel"
_ELLIPSOID, _SURFLET = "ParticleFieldKernelGaussianEllipsoidAPI", "ParticleFieldKernelGaussianSurfletAPI"
_PRIMVARS = {"normals": 3, "albedo": 3, "roughness": 1, "metallic": 1, "albedo_error": 1, "roughness_error": 1}
"""Number of values per Gaussian in the primvars for normals, materials and their errors. A primvar has the name of its
`Gaussians` field."""
_COLOR_SPACE = "srgb_rec709_scene"
"""OpenUSD name of the colour space of captures. Other programs write srgb_rec709_display."""
_LINEAR = ("lin_rec709", "lin_srgb", "lin_rec709_scene", "lin_rec709_display")
_DEGREE_MAX = 10
"""Largest SH degree accepted in a file; coefficients above `SH_DEGREE_MAX` are dropped."""

Floats = npt.NDArray[np.float32]

_EXTENT_SCALES = 3.0
"""Radius of a Gaussian in the ``extent`` of a particle field, in standard deviations along its longest axis."""
_SH_ATTRIBUTE = "radiance:sphericalHarmonics"


def is_field(prim: Any) -> bool:
    """Returns whether a prim is a particle field, with any kernel."""
    return str(prim.GetTypeName()) in _TYPES


def read_particles(file: UsdFile, prim: Any) -> SplatColumns | None:
    """Reads the Gaussians of a particle field; logs and returns None for a field with another kernel or no particles.

    Raises:
        FormatError: An attribute has the wrong type or shape.
    """
    kernels = [str(name) for name in prim.GetAppliedSchemas() if str(name).startswith(_KERNEL)]
    kernel_apis = [name for name in kernels if name != "ParticleFieldKernelBaseAPI"]
    flat = kernel_apis == [_SURFLET]
    if not flat and kernel_apis not in ([], [_ELLIPSOID]):
        shapes = " and ".join(name.removeprefix(_KERNEL).removesuffix("API") for name in kernel_apis)
        file.remarks.add(f"particles of kernel {shapes}, expected GaussianEllipsoid", str(prim.GetPath()))
        return None
    means = _float_or_half(file, prim, "positions", 3)
    if means is None:
        file.remarks.add("particle fields without particles", str(prim.GetPath()))
        return None
    count = len(means)
    rotations = _resized(_float_or_half(file, prim, "orientations", 4), count, (0.0, 0.0, 0.0, 1.0))[:, [3, 0, 1, 2]]
    scales, are_logarithms = _scales(file, prim, count)
    if flat:
        file.remarks.add("surflets, read as flat Gaussians", str(prim.GetPath()))
        smaller = scales[:, :2].min(axis=1)
        scales[:, 2] = smaller + np.log(FLAT_THICKNESS) if are_logarithms else FLAT_THICKNESS * smaller
    opacities = _resized(_float_or_half(file, prim, "opacities", 1), count, 1.0)
    are_logits = look_like_logits(opacities, with_logarithms=are_logarithms)
    if are_logits:
        file.remarks.add("opacities outside 0..1, read as logits", str(prim.GetPath()))
    custom_data = custom_data_of(prim)
    return SplatColumns(
        means=means,
        rotations_wxyz=rotations,
        log_scales=scales,
        opacities=opacities,
        sh=_sh(file, prim, count),
        **_materials(file, prim, count),
        scales_are_logarithms=are_logarithms,
        opacities_are_logits=are_logits,
        antialiased=bool(custom_data.get("antialiased", False)),
        kernel_degree=int(np.clip(custom_data.get("kernelDegree", KERNEL_DEGREE), 0, KERNEL_DEGREE_MAX)),
        comments=tuple(str(line) for line in custom_data.get("comments", ())),
        orientation=orientation_of_text(file.path, custom_data.get("orientation", "{}")),
    )


def _scales(file: UsdFile, prim: Any, count: int) -> tuple[Floats, bool]:
    """Returns the scales of N Gaussians, shape (N, 3), and whether the file stores their logarithms.

    Scales cannot be negative. If most stored values are negative, the writer copied logarithms from a capture. If only
    a few are negative, those Gaussians are mirrored, and the absolute values are used.
    """
    scales = _resized(_float_or_half(file, prim, "scales", 3), count, (1.0, 1.0, 1.0))
    if 2 * np.count_nonzero(scales < 0.0) <= scales.size:
        return np.abs(scales), False
    file.remarks.add("negative scales, read as logarithms", str(prim.GetPath()))
    return scales, True


def _float_or_half(file: UsdFile, prim: Any, name: str, columns: int) -> Floats | None:
    """Reads an attribute as float32, or else the half-precision attribute of the same name with "h" appended."""
    found = array(file, prim, name, columns)
    return array(file, prim, name + "h", columns) if found is None else found


def _resized(values: Floats | None, count: int, default: Any) -> Floats:
    """Returns the first ``count`` rows of ``values``. If there are fewer, all rows are ``default``."""
    if values is None or len(values) < count:
        return np.tile(np.array(default, np.float32), (count, 1) if np.ndim(default) else count)
    return values[:count]


def _sh(file: UsdFile, prim: Any, count: int) -> Floats:
    """Reads the K SH coefficients of each of N Gaussians, shape (N, K, 3). A field without SH becomes grey.

    SH of linear colours are encoded as sRGB.
    """
    degree = number(file, prim, "radiance:sphericalHarmonicsDegree", SH_DEGREE_MAX)
    stored = _float_or_half(file, prim, "radiance:sphericalHarmonicsCoefficients", 3)
    size = int(degree + 1) ** 2 if 0.0 <= degree <= _DEGREE_MAX else 0
    if stored is None or size == 0 or len(stored) < count * size:
        if stored is not None:
            file.remarks.add(
                "too few SH coefficients for their degree, so that particles are grey", str(prim.GetPath())
            )
        return np.zeros((count, 1, 3), np.float32)  # SH of zero is the colour 0.5
    read_size = min(size, (SH_DEGREE_MAX + 1) ** 2)
    if read_size < size:
        file.remarks.add(f"SH above degree {SH_DEGREE_MAX}", str(prim.GetPath()))
    sh = stored[: count * size].reshape(count, size, 3)[:, :read_size]
    space = _color_space(prim)
    if space.startswith("lin") and space not in _LINEAR:
        file.remarks.add(f"colour space {space}, read as linear Rec.709", str(prim.GetPath()))
    return display_sh(sh) if space.startswith("lin") else sh


def _color_space(prim: Any) -> str:
    """Returns the OpenUSD name of the colour space that the SH coefficients or the prim state; empty if none."""
    attributes = (prim.GetAttribute(f"radiance:sphericalHarmonicsCoefficients{end}") for end in ("", "h"))
    authored = [str(one.GetColorSpace()) for one in attributes if one and one.HasColorSpace()]
    attribute = prim.GetAttribute("colorSpace:name")
    return authored[0] if authored else str(attribute.Get() or "") if attribute else ""


def _materials(file: UsdFile, prim: Any, count: int) -> dict[str, Any]:
    """Reads normals and materials of ``count`` particles.

    A primvar is ignored if it is indexed or has fewer values than particles; surplus values are dropped.
    """
    primvars, found = pxr().UsdGeom.PrimvarsAPI(prim), dict[str, Floats]()
    for name, columns in _PRIMVARS.items():
        primvar = primvars.GetPrimvar(name)
        values = array(file, prim, f"primvars:{name}", columns) if primvar and primvar.HasAuthoredValue() else None
        if values is not None and len(values) >= count and not primvar.IsIndexed():
            found[name] = values[:count]
    return found


def define_field(writer: StageWriter, path: str, gaussians: Gaussians) -> Any:
    """Writes a capture as a particle field, in object space, and returns the prim."""
    px = pxr()
    prim = px.UsdVol.ParticleField3DGaussianSplat.Define(writer.stage, path).GetPrim()
    for name, values in particle_values(gaussians).items():
        prim.GetAttribute(name).Set(values)
    prim.GetAttribute(f"{_SH_ATTRIBUTE}Degree").Set(gaussians.sh_degree)
    # The schema leaves open the number of coefficients per particle and the colour space.
    coefficients = prim.GetAttribute(f"{_SH_ATTRIBUTE}Coefficients")
    coefficients.SetMetadata("elementSize", gaussians.sh.shape[1])
    coefficients.SetMetadata("interpolation", "vertex")
    coefficients.SetColorSpace(_COLOR_SPACE)
    prim.GetAttribute("projectionModeHint").Set("perspective")
    prim.GetAttribute("sortingModeHint").Set("zDepth")
    _write_materials(prim, gaussians)
    _write_custom_data(writer, prim, gaussians)
    return prim


def particle_values(gaussians: Gaussians) -> dict[str, Any]:
    """Returns the attributes of a particle field that an animation may sample, by name: means, SH, extent and so on."""
    vt = pxr().Vt
    return {
        "positions": vt.Vec3fArray.FromNumpy(gaussians.means),
        # Quaternion arrays of the library are x, y, z, w, though its text format is w, x, y, z.
        "orientations": vt.QuatfArray.FromNumpy(np.ascontiguousarray(gaussians.rotations_wxyz[:, [1, 2, 3, 0]])),
        "scales": vt.Vec3fArray.FromNumpy(gaussians.scales),
        "opacities": vt.FloatArray.FromNumpy(gaussians.opacities),
        f"{_SH_ATTRIBUTE}Coefficients": vt.Vec3fArray.FromNumpy(gaussians.sh.reshape(-1, 3)),
        "extent": vt.Vec3fArray.FromNumpy(_extent(gaussians)),
    }


def _extent(gaussians: Gaussians) -> npt.NDArray[np.float32]:
    """Returns the lower and the upper corner of a box around all Gaussians, shape (2, 3)."""
    reach = _EXTENT_SCALES * gaussians.scales.max(axis=1, keepdims=True)
    return np.stack([(gaussians.means - reach).min(axis=0), (gaussians.means + reach).max(axis=0)])


def _write_materials(prim: Any, gaussians: Gaussians) -> None:
    """Writes normals and materials of relightable captures as primvars."""
    px = pxr()
    types, primvars = px.Sdf.ValueTypeNames, px.UsdGeom.PrimvarsAPI(prim)
    kinds = {"normals": types.Normal3fArray, "albedo": types.Color3fArray}
    for name, columns in _PRIMVARS.items():
        values = getattr(gaussians, name)
        if values is not None:
            array = px.Vt.Vec3fArray if columns == 3 else px.Vt.FloatArray
            primvar = primvars.CreatePrimvar(name, kinds.get(name, types.FloatArray), px.UsdGeom.Tokens.vertex)
            primvar.Set(array.FromNumpy(values))


def _write_custom_data(writer: StageWriter, prim: Any, gaussians: Gaussians) -> None:
    """Writes training settings, orientation and comments of a capture to customData, which only Lumisplat reads."""
    if gaussians.antialiased:
        writer.set_custom_data(prim, antialiased=True)
        writer.remarks.add("the antialiased flag of captures, which only Lumisplat reads")
    if gaussians.kernel_degree != KERNEL_DEGREE:
        writer.set_custom_data(prim, kernelDegree=gaussians.kernel_degree)
        writer.remarks.add(f"kernel degree {gaussians.kernel_degree}, which only Lumisplat reads")
    if stated := orientation_values(gaussians.up, gaussians.first_view):
        writer.set_custom_data(prim, orientation=json.dumps(stated))
    if gaussians.comments:
        writer.set_custom_data(prim, comments=pxr().Vt.StringArray(list(gaussians.comments)))
