"""Particle fields: Gaussian splats of OpenUSD 26.03 and later (UsdVol.ParticleField3DGaussianSplat).

Attributes exist as floats and, with an h behind their name, as halves; floats win. What is too long is cut, what is too
short is not used: no rotation, unit scale, opaque, grey. The order of harmonics is that of captures, all coefficients
of a particle together; the schema says nothing of their signs, and writers store those of captures. Colours are those
of the display unless the field, or the attribute, has a linear colour space.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from lumisplat.constants import FLAT_THICKNESS, KERNEL_DEGREE, KERNEL_DEGREE_MAX, SH_DEGREE_MAX
from lumisplat.io.splats.columns import SplatColumns, look_like_logits
from lumisplat.io.splats.orientation import orientation_of_text
from lumisplat.io.usd.library import pxr
from lumisplat.io.usd.stage import UsdFile
from lumisplat.io.usd.values import array, hints_of, number
from lumisplat.scene.ops.display_sh import display_sh

_TYPES = ("ParticleField3DGaussianSplat", "ParticleField", "ParticleField_3DGaussianSplat")
"""The second is described by applied schemas; the third is the name that Nuke 17.0 wrote."""
_KERNEL = "ParticleFieldKernel"
_ELLIPSOID, _SURFLET = "ParticleFieldKernelGaussianEllipsoidAPI", "ParticleFieldKernelGaussianSurfletAPI"
PRIMVARS = {"normals": 3, "albedo": 3, "roughness": 1, "metallic": 1}
"""Of relightable captures, one value for each particle: names of primvars, which are our fields, and their columns."""
COLOR_SPACE = "srgb_rec709_scene"
"""Colour space of captures, by its name in OpenUSD; others write srgb_rec709_display."""
_LINEAR = ("lin_rec709", "lin_srgb", "lin_rec709_scene", "lin_rec709_display")
_DEGREE_MAX = 10
"""Of harmonics; those above ours are left out."""

Floats = npt.NDArray[np.float32]


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
    means = _either(file, prim, "positions", 3)
    if means is None:
        file.remarks.add("fields without particles", str(prim.GetPath()))
        return None
    count = len(means)
    rotations = _sized(_either(file, prim, "orientations", 4), count, (0.0, 0.0, 0.0, 1.0))[:, [3, 0, 1, 2]]
    scales, are_logarithms = _scales(file, prim, count)
    if flat:
        file.remarks.add("surflets, which become flat Gaussians", str(prim.GetPath()))
        smaller = scales[:, :2].min(axis=1)
        scales[:, 2] = smaller + np.log(FLAT_THICKNESS) if are_logarithms else FLAT_THICKNESS * smaller
    opacities = _sized(_either(file, prim, "opacities", 1), count, 1.0)
    are_logits = look_like_logits(opacities, with_logarithms=are_logarithms)
    if are_logits:
        file.remarks.add("opacities outside 0..1, read as logits", str(prim.GetPath()))
    hints = hints_of(prim)
    return SplatColumns(
        means=means,
        rotations_wxyz=rotations,
        log_scales=scales,
        opacities=opacities,
        sh=_harmonics(file, prim, count),
        **_materials(file, prim, count),
        scales_are_logarithms=are_logarithms,
        opacities_are_logits=are_logits,
        antialiased=bool(hints.get("antialiased", False)),
        kernel_degree=int(np.clip(hints.get("kernelDegree", KERNEL_DEGREE), 0, KERNEL_DEGREE_MAX)),
        comments=tuple(str(line) for line in hints.get("comments", ())),
        orientation=orientation_of_text(file.path, hints.get("orientation", "{}")),
    )


def _scales(file: UsdFile, prim: Any, count: int) -> tuple[Floats, bool]:
    """Returns the scales, shape (N, 3), and whether they are logarithms.

    A scale is never negative; where most are, they are logarithms, of a writer who copied them from a capture. A few
    negative ones are mirrored.
    """
    scales = _sized(_either(file, prim, "scales", 3), count, (1.0, 1.0, 1.0))
    if 2 * np.count_nonzero(scales < 0.0) <= scales.size:
        return np.abs(scales), False
    file.remarks.add("negative scales, read as logarithms", str(prim.GetPath()))
    return scales, True


def _either(file: UsdFile, prim: Any, name: str, columns: int) -> Floats | None:
    """An attribute as floats, else as halves."""
    found = array(file, prim, name, columns)
    return array(file, prim, name + "h", columns) if found is None else found


def _sized(values: Floats | None, count: int, default: Any) -> Floats:
    """As many rows as there are particles: of longer arrays the first; the default if there are fewer."""
    if values is None or len(values) < count:
        return np.tile(np.array(default, np.float32), (count, 1) if np.ndim(default) else count)
    return values[:count]


def _harmonics(file: UsdFile, prim: Any, count: int) -> Floats:
    """SH, shape (N, K, 3)."""
    degree = number(file, prim, "radiance:sphericalHarmonicsDegree", SH_DEGREE_MAX)
    stored = _either(file, prim, "radiance:sphericalHarmonicsCoefficients", 3)
    size = int(degree + 1) ** 2 if 0.0 <= degree <= _DEGREE_MAX else 0
    if stored is None or size == 0 or len(stored) < count * size:
        if stored is not None:
            file.remarks.add("too few harmonics for their degree, so that particles are grey", str(prim.GetPath()))
        return np.zeros((count, 1, 3), np.float32)  # the colour is 0.5 more
    kept = min(size, (SH_DEGREE_MAX + 1) ** 2)
    if kept < size:
        file.remarks.add(f"harmonics above degree {SH_DEGREE_MAX}", str(prim.GetPath()))
    sh = stored[: count * size].reshape(count, size, 3)[:, :kept]
    space = _color_space(prim)
    if space.startswith("lin") and space not in _LINEAR:
        file.remarks.add(f"colour space {space}, taken for linear Rec.709", str(prim.GetPath()))
    return display_sh(sh) if space.startswith("lin") else sh


def _color_space(prim: Any) -> str:
    """Colour space of a field's harmonics, as they or the field say; empty if neither does."""
    attributes = (prim.GetAttribute(f"radiance:sphericalHarmonicsCoefficients{end}") for end in ("", "h"))
    said = [str(one.GetColorSpace()) for one in attributes if one and one.HasColorSpace()]
    own = prim.GetAttribute("colorSpace:name")
    return said[0] if said else str(own.Get() or "") if own else ""


def _materials(file: UsdFile, prim: Any, count: int) -> dict[str, Any]:
    """Normals and materials of relightable captures, as far as there is a value for each particle."""
    primvars, found = pxr().UsdGeom.PrimvarsAPI(prim), dict[str, Floats]()
    for name, columns in PRIMVARS.items():
        primvar = primvars.GetPrimvar(name)
        held = array(file, prim, f"primvars:{name}", columns) if primvar and primvar.HasAuthoredValue() else None
        if held is not None and len(held) >= count and not primvar.IsIndexed():
            found[name] = held[:count]
    return found
