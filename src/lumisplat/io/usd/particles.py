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
"""The second is described by applied schemas; the third is the name that Nuke 17.0 wrote."""
_KERNEL = "ParticleFieldKernel"
_ELLIPSOID, _SURFLET = "ParticleFieldKernelGaussianEllipsoidAPI", "ParticleFieldKernelGaussianSurfletAPI"
_PRIMVARS = {"normals": 3, "albedo": 3, "roughness": 1, "metallic": 1}
"""Of relightable captures, one value for each particle: names of primvars, which are our fields, and their columns."""
_COLOR_SPACE = "srgb_rec709_scene"
"""Colour space of captures, by its name in OpenUSD; others write srgb_rec709_display."""
_LINEAR = ("lin_rec709", "lin_srgb", "lin_rec709_scene", "lin_rec709_display")
_DEGREE_MAX = 10
"""Of harmonics; those above ours are left out."""

Floats = npt.NDArray[np.float32]

_EXTENT_SCALES = 3.0
"""Scales at which a Gaussian ends, for the extent of a field."""
_SH_ATTRIBUTE = "radiance:sphericalHarmonics"


def is_field(prim: Any) -> bool:
    """Whether a prim is a field of particles, whatever its kernel."""
    return str(prim.GetTypeName()) in _TYPES


def read_particles(file: UsdFile, prim: Any) -> SplatColumns | None:
    """The Gaussians of a field; None, with a remark, if its particles are no Gaussians, or there are none.

    Raises:
        FormatError: An attribute is no array of its kind.
    """
    kernels = [str(name) for name in prim.GetAppliedSchemas() if str(name).startswith(_KERNEL)]
    own = [name for name in kernels if name != "ParticleFieldKernelBaseAPI"]
    flat = own == [_SURFLET]
    if not flat and own not in ([], [_ELLIPSOID]):
        shapes = " and ".join(name.removeprefix(_KERNEL).removesuffix("API") for name in own)
        file.remarks.add(f"particles of kernel {shapes}, expected GaussianEllipsoid", str(prim.GetPath()))
        return None
    means = _float_or_half(file, prim, "positions", 3)
    if means is None:
        file.remarks.add("fields without particles", str(prim.GetPath()))
        return None
    count = len(means)
    rotations = _resized(_float_or_half(file, prim, "orientations", 4), count, (0.0, 0.0, 0.0, 1.0))[:, [3, 0, 1, 2]]
    scales, are_logarithms = _scales(file, prim, count)
    if flat:
        file.remarks.add("surflets, which become flat Gaussians", str(prim.GetPath()))
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
    """Returns the scales, shape (N, 3), and whether they are logarithms.

    A scale is never negative; where most are, they are logarithms, of a writer who copied them from a capture. A few
    negative ones are mirrored.
    """
    scales = _resized(_float_or_half(file, prim, "scales", 3), count, (1.0, 1.0, 1.0))
    if 2 * np.count_nonzero(scales < 0.0) <= scales.size:
        return np.abs(scales), False
    file.remarks.add("negative scales, read as logarithms", str(prim.GetPath()))
    return scales, True


def _float_or_half(file: UsdFile, prim: Any, name: str, columns: int) -> Floats | None:
    """An attribute as floats, else as halves."""
    found = array(file, prim, name, columns)
    return array(file, prim, name + "h", columns) if found is None else found


def _resized(values: Floats | None, count: int, default: Any) -> Floats:
    """As many rows as there are particles: of longer arrays the first; the default if there are fewer."""
    if values is None or len(values) < count:
        return np.tile(np.array(default, np.float32), (count, 1) if np.ndim(default) else count)
    return values[:count]


def _sh(file: UsdFile, prim: Any, count: int) -> Floats:
    """SH, shape (N, K, 3)."""
    degree = number(file, prim, "radiance:sphericalHarmonicsDegree", SH_DEGREE_MAX)
    stored = _float_or_half(file, prim, "radiance:sphericalHarmonicsCoefficients", 3)
    size = int(degree + 1) ** 2 if 0.0 <= degree <= _DEGREE_MAX else 0
    if stored is None or size == 0 or len(stored) < count * size:
        if stored is not None:
            file.remarks.add("too few harmonics for their degree, so that particles are grey", str(prim.GetPath()))
        return np.zeros((count, 1, 3), np.float32)  # the colour is 0.5 more
    read_size = min(size, (SH_DEGREE_MAX + 1) ** 2)
    if read_size < size:
        file.remarks.add(f"harmonics above degree {SH_DEGREE_MAX}", str(prim.GetPath()))
    sh = stored[: count * size].reshape(count, size, 3)[:, :read_size]
    space = _color_space(prim)
    if space.startswith("lin") and space not in _LINEAR:
        file.remarks.add(f"colour space {space}, taken for linear Rec.709", str(prim.GetPath()))
    return display_sh(sh) if space.startswith("lin") else sh


def _color_space(prim: Any) -> str:
    """Colour space of a field's harmonics, as they or the field say; empty if neither does."""
    attributes = (prim.GetAttribute(f"radiance:sphericalHarmonicsCoefficients{end}") for end in ("", "h"))
    authored = [str(one.GetColorSpace()) for one in attributes if one and one.HasColorSpace()]
    own = prim.GetAttribute("colorSpace:name")
    return authored[0] if authored else str(own.Get() or "") if own else ""


def _materials(file: UsdFile, prim: Any, count: int) -> dict[str, Any]:
    """Normals and materials of relightable captures, as far as there is a value for each particle."""
    primvars, found = pxr().UsdGeom.PrimvarsAPI(prim), dict[str, Floats]()
    for name, columns in _PRIMVARS.items():
        primvar = primvars.GetPrimvar(name)
        held = array(file, prim, f"primvars:{name}", columns) if primvar and primvar.HasAuthoredValue() else None
        if held is not None and len(held) >= count and not primvar.IsIndexed():
            found[name] = held[:count]
    return found


def define_field(writer: StageWriter, path: str, gaussians: Gaussians) -> Any:
    """Writes a capture in its own coordinates; its prim."""
    px = pxr()
    prim = px.UsdVol.ParticleField3DGaussianSplat.Define(writer.stage, path).GetPrim()
    for name, values in particle_values(gaussians).items():
        prim.GetAttribute(name).Set(values)
    prim.GetAttribute(f"{_SH_ATTRIBUTE}Degree").Set(gaussians.sh_degree)
    # Which the schema leaves open: how many belong together, as others write it, and what the colours are.
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
    """The values of a field's attributes that may change with time, by their names."""
    vt = pxr().Vt
    return {
        "positions": vt.Vec3fArray.FromNumpy(gaussians.means),
        # The arrays of the library are x, y, z, w, though its texts are w, x, y, z.
        "orientations": vt.QuatfArray.FromNumpy(np.ascontiguousarray(gaussians.rotations_wxyz[:, [1, 2, 3, 0]])),
        "scales": vt.Vec3fArray.FromNumpy(gaussians.scales),
        "opacities": vt.FloatArray.FromNumpy(gaussians.opacities),
        f"{_SH_ATTRIBUTE}Coefficients": vt.Vec3fArray.FromNumpy(gaussians.sh.reshape(-1, 3)),
        "extent": vt.Vec3fArray.FromNumpy(_extent(gaussians)),
    }


def _extent(gaussians: Gaussians) -> npt.NDArray[np.float32]:
    """Corners of a box around all Gaussians, shape (2, 3)."""
    reach = _EXTENT_SCALES * gaussians.scales.max(axis=1, keepdims=True)
    return np.stack([(gaussians.means - reach).min(axis=0), (gaussians.means + reach).max(axis=0)])


def _write_materials(prim: Any, gaussians: Gaussians) -> None:
    """Normals and materials of relightable captures, as primvars."""
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
    """What only we read: how the capture was trained, and the comments of its file."""
    if gaussians.antialiased:
        writer.set_custom_data(prim, antialiased=True)
        writer.remarks.add("that a capture was trained antialiased, which only Lumisplat will know")
    if gaussians.kernel_degree != KERNEL_DEGREE:
        writer.set_custom_data(prim, kernelDegree=gaussians.kernel_degree)
        writer.remarks.add(f"kernel degree {gaussians.kernel_degree}, which only Lumisplat will know")
    if stated := orientation_values(gaussians.up, gaussians.first_view):
        writer.set_custom_data(prim, orientation=json.dumps(stated))
    if gaussians.comments:
        writer.set_custom_data(prim, comments=pxr().Vt.StringArray(list(gaussians.comments)))
