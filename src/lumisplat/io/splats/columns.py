"""Between what splat files hold (logarithms of scales, logits of opacities) and `Gaussians`."""

from __future__ import annotations

import logging
import os
from dataclasses import dataclass, fields, replace

import numpy as np
import numpy.typing as npt

from lumisplat.constants import KERNEL_DEGREE, LOGIT_MAX, SCALE_MIN
from lumisplat.errors import FormatError, SceneError
from lumisplat.io.files.source import PathLike
from lumisplat.math.arrays import FloatArray, handed_over
from lumisplat.scene.gaussians import Gaussians

_log = logging.getLogger("lumisplat")

Floats = npt.NDArray[np.floating]


@dataclass(slots=True, eq=False)
class SplatColumns:
    """N Gaussians as a file stores them, not yet validated."""

    means: Floats
    """Shape (N, 3)."""
    rotations_wxyz: Floats
    """Of any length, shape (N, 4)."""
    log_scales: Floats
    """Natural logarithms of the standard deviations, shape (N, 3)."""
    opacities: Floats
    """Logits, or 0..1 where ``opacities_are_logits`` is off, shape (N,)."""
    sh: Floats
    """DC first, shape (N, K, 3)."""
    normals: Floats | None = None
    albedo: Floats | None = None
    roughness: Floats | None = None
    metallic: Floats | None = None
    opacities_are_logits: bool = True
    antialiased: bool = False
    kernel_degree: int = KERNEL_DEGREE
    comments: tuple[str, ...] = ()

    @property
    def count(self) -> int:
        """Number of Gaussians, N."""
        return self.means.shape[0]


PROPERTY_NAMES = {
    "means": ("x", "y", "z"),
    "rotations_wxyz": ("rot_0", "rot_1", "rot_2", "rot_3"),
    "log_scales": ("scale_0", "scale_1", "scale_2"),
    "opacities": ("opacity",),
    "normals": ("nx", "ny", "nz"),
    "albedo": ("albedo_0", "albedo_1", "albedo_2"),
    "roughness": ("roughness",),
    "metallic": ("metallic",),
}
"""The PLY properties of each field, in order. The last three are ours, for relightable captures."""

MATERIALS = ("normals", "albedo", "roughness", "metallic")
"""The optional fields."""

PROBLEMS_LISTED = 6
"""Properties that an error about invalid values names, before it says "and more"."""


def sh_property_names(coefficients: int) -> list[str]:
    """PLY properties of SH in the order of ``sh.reshape(N, -1)``: f_rest is channel-major in files, ours is not."""
    rest = coefficients - 1
    names = [f"f_dc_{channel}" for channel in range(3)]
    return names + [f"f_rest_{channel * rest + k}" for k in range(rest) for channel in range(3)]


def gaussians_from_columns(path: PathLike, columns: SplatColumns, *, drop_invalid: bool = False) -> Gaussians:
    """Applies exp and sigmoid, and refuses or drops what cannot be rendered.

    Args:
        path: Named in errors.
        columns: As read.
        drop_invalid: Leave out Gaussians with NaN or infinite values, or a rotation or normal of zero length, and log
            a warning that says how many.

    Raises:
        FormatError: Invalid values, and ``drop_invalid`` is off; or nothing is left; or a value is out of its range.
    """
    if columns.count == 0:
        raise FormatError(path, "holds zero Gaussians: there is nothing to render")
    with np.errstate(over="ignore", under="ignore"):
        scales = np.maximum(np.exp(columns.log_scales), np.float32(SCALE_MIN))
        opacities = 1.0 / (1.0 + np.exp(-columns.opacities)) if columns.opacities_are_logits else columns.opacities
    if columns.normals is not None and not columns.normals.any():
        columns = replace(columns, normals=None)  # INRIA writes zeros where there are none
    kept = _kept_rows(path, columns, scales, drop_invalid)

    def picked(values: Floats) -> FloatArray:
        return handed_over(values[kept].astype(np.float32, copy=False))

    extras = {name: getattr(columns, name) for name in MATERIALS}
    try:
        return Gaussians(
            picked(columns.means),
            picked(columns.rotations_wxyz),
            picked(scales),
            picked(opacities),
            picked(columns.sh),
            **{name: picked(values) for name, values in extras.items() if values is not None},
            antialiased=columns.antialiased,
            kernel_degree=columns.kernel_degree,
            comments=columns.comments,
        )
    except SceneError as error:
        raise FormatError(path, str(error)) from None


def _kept_rows(
    path: PathLike, columns: SplatColumns, scales: Floats, drop_invalid: bool
) -> slice | npt.NDArray[np.bool_]:
    """Selects the Gaussians to keep: all of them, or the valid ones if the others may be dropped."""
    invalid, problems = _invalid_rows(columns, scales)
    if not problems:
        return slice(None)
    dropped = np.count_nonzero(invalid)
    listed = ", ".join(problems[:PROBLEMS_LISTED]) + (", and more" if len(problems) > PROBLEMS_LISTED else "")
    summary = f"{listed}, in {dropped:,} of {columns.count:,} Gaussians"
    if not drop_invalid:
        raise FormatError(path, f"{summary}; --drop-invalid (drop_invalid=True) drops them")
    if dropped == columns.count:
        raise FormatError(path, f"{summary}: no valid Gaussian is left")
    _log.warning("%s: dropped %s Gaussians: %s", os.fspath(path), f"{dropped:,}", listed)
    return ~invalid


def _invalid_rows(columns: SplatColumns, scales: Floats) -> tuple[npt.NDArray[np.bool_], list[str]]:
    """Which Gaussians cannot be used, shape (N,), and what is wrong, one phrase per property."""
    invalid = np.zeros(columns.count, dtype=bool)
    problems = []
    for field in fields(columns):
        values = getattr(columns, field.name)
        if not isinstance(values, np.ndarray):
            continue
        finite = np.isfinite(values)
        if field.name == "log_scales":
            finite &= np.isfinite(scales)  # the exponential may overflow
        if not finite.all():
            names = PROPERTY_NAMES.get(field.name) or sh_property_names(columns.sh.shape[1])
            bad = ~finite.reshape(columns.count, -1)
            invalid |= bad.any(axis=1)
            counts = np.count_nonzero(bad, axis=0)
            problems += [f"{n:,} NaN or infinite values in {name}" for n, name in zip(counts, names, strict=True) if n]
    for name, values in (("rotations", columns.rotations_wxyz), ("normals", columns.normals)):
        zero = ~values.any(axis=1) if values is not None else invalid[:0]
        if zero.any():
            invalid |= zero
            problems.append(f"{np.count_nonzero(zero):,} {name} of zero length")
    return invalid, problems


def columns_from_gaussians(gaussians: Gaussians) -> SplatColumns:
    """The inverse of `gaussians_from_columns`: logarithms and logits, opacities of 0 and 1 made finite."""
    opacities = gaussians.opacities.astype(np.float64)
    with np.errstate(divide="ignore"):
        logits = np.clip(np.log(opacities) - np.log1p(-opacities), -LOGIT_MAX, LOGIT_MAX)
    return SplatColumns(
        means=gaussians.means,
        rotations_wxyz=gaussians.rotations_wxyz,
        log_scales=np.log(gaussians.scales),
        opacities=logits.astype(np.float32),
        sh=gaussians.sh,
        normals=gaussians.normals,
        albedo=gaussians.albedo,
        roughness=gaussians.roughness,
        metallic=gaussians.metallic,
        antialiased=gaussians.antialiased,
        kernel_degree=gaussians.kernel_degree,
        comments=gaussians.comments,
    )


def warn_lost_materials(path: PathLike, kind: str, gaussians: Gaussians) -> None:
    """Logs a warning about normals and materials, for formats that cannot hold them."""
    lost = [name for name in MATERIALS if getattr(gaussians, name) is not None]
    if lost:
        _log.warning("%s: %s cannot store %s: left out", os.fspath(path), kind, ", ".join(lost))
